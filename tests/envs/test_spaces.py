from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.envs.interfaces import action_box, feature_box
from ethbrake_marl.observations import Feature, ObservationSpec
from ethbrake_marl.physics import make_worlds
from ethbrake_marl.scenario import Scenario, full_state, state_features
from tests.contract.interfaces import FIVE, PAPER


def test_feature_box__has_the_features_bounds() -> None:
    box = feature_box([Feature("a", "1", 1.0, -2.0, 4.0, ""), Feature("b", "1", 5.0, 0.0, 1.0, "")])
    assert (box.low.tolist(), box.high.tolist(), box.dtype) == ([-2.0, 0.0], [4.0, 1.0], np.float32)


def test_action_box__is_one_number() -> None:
    box = action_box()
    assert (box.low.tolist(), box.high.tolist(), box.dtype) == ([-1.0], [1.0], np.float32)


@pytest.mark.parametrize("scenario", [PAPER, FIVE])
def test_state_features__fit_the_state(scenario: Scenario) -> None:
    features = state_features(scenario)
    worlds = scenario.sample(3, 0).worlds
    state = full_state(worlds, scenario)
    N = scenario.vehicles
    assert state.shape == (3, 7 * N + 2 * (N - 1) + 1) == (3, len(features))
    assert len({feature.name for feature in features}) == len(features)
    assert state.dtype == np.float32 and state.flags.owndata
    column = {feature.name: state[:, k] for k, feature in enumerate(features)}
    for i in range(N - 1):
        assert column[f"pair_{i + 1}.gap"] == pytest.approx(worlds.gaps_m[:, i] / 10.0)
        assert column[f"vehicle_{i + 2}.speed"] == pytest.approx(worlds.speeds_mps[:, i + 1] / 20.0)


def test_full_state__is_clipped_to_its_bounds() -> None:
    worlds = make_worlds(
        500.0,
        [90.0, 90.0, 90.0],
        braking_capacity_mps2=60,
        driving_capacity_mps2=60,
        latency_s=9,
        mass_t=400,
        restitution=1,
        speed_limit_mps=90,
    )
    box = feature_box(state_features(PAPER))
    state = full_state(worlds, PAPER)[0]
    assert state in box
    assert state[0] == 4.0 and state[21] == 10.0


@pytest.mark.parametrize("spec", [ObservationSpec(), ObservationSpec(0, 0), ObservationSpec(3, 2)])
def test_feature_box__has_the_length_of_an_observation(spec: ObservationSpec) -> None:
    assert feature_box(spec.features).shape == (spec.size,)
