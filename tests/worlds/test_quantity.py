"""Quantities by hand, and random numbers by counter."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from ethbrake_marl.worlds.counters import uniform_numbers
from ethbrake_marl.worlds.quantities import NEWS, QUANTITIES, TYPES
from ethbrake_marl.worlds.quantity import Choice, LogNormal, LogUniform, Normal, Uniform, support, values
from ethbrake_marl.worlds.vehicle_types import WithLoad

near = pytest.approx
ALMOST_ONE = 1.0 - 2.0**-53
NORMAL = partial(Normal.model_validate, {"normal": {"mean": 20.0, "sd": 1.0, "low": 18.0, "high": 22.0}})
HALF_NORMAL = partial(Normal.model_validate, {"normal": {"mean": 0.0, "sd": 1.0, "low": 0.0, "high": 9.0}})
LOG_NORMAL = partial(LogNormal.model_validate, {"lognormal": {"median": 2.0, "sigma": 0.5, "low": 1.0, "high": 4.0}})


@pytest.mark.parametrize(
    ("quantity", "u", "drawn", "bounds"),
    [
        (3.5, [0.0, 0.3, 0.9], [3.5, 3.5, 3.5], (3.5, 3.5)),
        (Uniform(uniform=(5.0, 10.0)), [0.0, 0.2, 0.5], [5.0, 6.0, 7.5], (5.0, 10.0)),
        (LogUniform(loguniform=(1.0, 16.0)), [0.0, 0.25, 0.5], near([1.0, 2.0, 4.0], rel=1e-15), (1.0, 16.0)),
        (NORMAL, [0.0, 0.5], near([18.0, 20.0], rel=1e-12), (18.0, 22.0)),
        (HALF_NORMAL, [0.5], near([0.6744897501960817], rel=1e-12), (0.0, 9.0)),  # the quartile of a normal value
        (LOG_NORMAL, [0.0, 0.5], near([1.0, 2.0], rel=1e-12), (1.0, 4.0)),
        (Choice(choice=(6, 8, 7)), [0.0, 0.33, 0.34, 0.66, 0.67, ALMOST_ONE], [6, 6, 8, 8, 7, 7], (6.0, 8.0)),
        (
            Choice(choice=(1, 2, 3), weights=(1, 2, 1)),
            [0.0, 0.249, 0.25, 0.749, 0.75, ALMOST_ONE],
            [1, 1, 2, 2, 3, 3],
            (1.0, 3.0),
        ),
    ],
    ids=lambda value: type(value).__name__,
)
def test_quantity__by_hand(quantity: Any, u: list[float], drawn: Any, bounds: tuple[float, float]) -> None:
    quantity = quantity() if callable(quantity) else quantity
    assert values(quantity, np.array(u)).tolist() == drawn
    assert support(quantity) == bounds


def test_with_load__is_linear_in_the_load_with_a_spread() -> None:
    brakes = WithLoad.model_validate({"with_load": [8.0, 6.0], "spread": {"uniform": [-0.5, 0.5]}})
    assert brakes.value(np.array([0.0, 0.5, 1.0]), np.array([0.5, 0.0, 0.75])).tolist() == [8.0, 6.5, 6.25]
    assert support(brakes) == (5.5, 8.5)


@given(st.floats(1e-3, 1e4), st.floats(1e-3, 1e4), st.lists(st.floats(0, ALMOST_ONE), min_size=2, max_size=5))
def test_distribution__grows_with_u_inside_its_bounds(a: float, b: float, u: list[float]) -> None:
    low, high = sorted((a, b))
    for quantity in (Uniform(uniform=(low, high)), LogUniform(loguniform=(low, high))):
        drawn = quantity.value(np.array(sorted(u)))
        assert (np.diff(drawn) >= 0.0).all()
        assert ((drawn >= low) & (drawn <= high)).all()


def test_random_numbers__are_those_of_numpys_own_generator() -> None:
    key = np.random.SeedSequence([7], spawn_key=(0, 0)).generate_state(2, np.uint64)
    expected = np.random.Generator(np.random.Philox(key=key)).random(5 * 24).reshape(5, 24)
    assert uniform_numbers(7, "list", 0, np.arange(5))(24, ()).tolist() == expected.tolist()
    assert uniform_numbers(7, "list", 0, np.array([1, 3, 4]))(24, ()).tolist() == expected[[1, 3, 4]].tolist()


def test_random_numbers__differ_by_seed_channel_attempt_and_stream() -> None:
    index = np.arange(3)
    drawn = [
        uniform_numbers(seed, purpose, attempt, index)(8, stream).tobytes()
        for seed, purpose, attempt, stream in [
            (7, "list", 0, ()), (8, "list", 0, ()), (7, "training", 0, ()), (7, "list", 1, ()), (7, "list", 0, TYPES),
            (7, "list", 0, NEWS),
        ]
    ]  # fmt: skip
    assert len(set(drawn)) == 6


def test_no_two_quantities_of_one_scenario__share_a_random_number() -> None:
    together = [key for key in QUANTITIES if key not in ("gaps_m", "speeds_mps", "obstacle_gap_m")]
    places = [QUANTITIES[key].place(i) for key in together for i in range(QUANTITIES[key].count(4))]
    assert len(set(places)) == len(places)
