"""The range that a training records of what its policies observe: numbers by hand, and from which worlds."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.episode.features import register_feature
from ethbrake_marl.episode.observe import View
from ethbrake_marl.episode.state import State
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.training import training_range
from ethbrake_marl.training.training import Training
from ethbrake_marl.training.training_range import record_ranges, with_ranges
from tests.contract.interfaces import REST
from tests.policies.test_networks import FIELDS, network, tensors_for
from tests.training.tiny import TINY


def full_braking(*names: str) -> Policy:
    """Policy that brakes fully whatever it observes."""
    spec = network("clip", observation_size=len(names))
    tensors = {name: np.full_like(each, -5.0 * (each.ndim == 1)) for name, each in tensors_for(spec).items()}
    return Policy.make(tensors, network=spec, observation=View(names), **FIELDS)


def test_range__is_that_of_the_decisions_before_rest() -> None:
    """5.7 m/s, and 0.6 m/s less at each of ten decisions, without the least and the largest; the unit is 20 m/s."""
    policy = full_braking("own.speed", "own.acceleration", "front_1.gap")
    (ranged,) = record_ranges({"vehicle_2": policy}, REST, 1, seed=0).values()
    known = ranged.manifest.training_range
    assert known is not None
    assert (known.low[0], known.high[0]) == pytest.approx((0.9 / 20, 5.1 / 20), abs=1e-6)


@pytest.fixture
def counted() -> dict[int, int]:
    """Largest number of worlds of an observation with the feature ``counts``, for lines of so many vehicles."""
    numbers: dict[int, int] = {}

    def count(state: State, body: int) -> Floats:
        """Nothing."""
        numbers[state.vehicles] = max(numbers.get(state.vehicles, 0), state.n)
        return np.zeros(state.n)

    register_feature("counts", count, unit="1", scale=1.0, low=0.0, high=1.0)
    return numbers


@pytest.mark.parametrize(("most", "driven"), [(4, 4), (1000, 10)])
def test_range__is_from_the_fixed_list_or_from_its_beginning(
    most: int, driven: int, counted: dict[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training_range, "MOST_WORLDS", most)
    with_ranges({"vehicle_2": full_braking("counts")}, Training.of(TINY, "paper-random"))
    assert counted == {3: driven}
