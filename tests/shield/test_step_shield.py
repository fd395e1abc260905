"""The step shield around an engine, in a few worlds of two vehicles: small enough to run uncompiled."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.scenario import Scenario
from ethbrake_marl.shield import StepShield
from ethbrake_marl.shield.step_shield import REASONS
from tests.shield.attacks import attack, extremes, random_actions

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")  # uncompiled, a division by 0 warns

TWO = Scenario(
    name="two",
    vehicles=2,
    gaps_m={"uniform": [3, 5]},
    speeds_mps={"uniform": [14, 16]},
    braking_capacity_mps2=[8, 5],
    driving_capacity_mps2=3,
    mass_t=2,
    latency_s=[0, 0.35],
    restitution=0.2,
    horizon_s=5.0,
    roles={"vehicle_1": "full_brake", "vehicle_2": "learner"},
)
WORLDS = TWO.sample(3, 1).worlds


def test_attack__realised_harm_is_the_last_bound_to_the_bit() -> None:
    for adversary in (random_actions, extremes):
        found = attack(TWO, WORLDS, adversary)
        assert (found.bound > 0.0).any()
        assert (found.realised <= found.bound).all()
        assert found.realised.tolist() == found.last_bound.tolist()


def test_surprise__a_front_vehicle_that_brakes_too_hard_is_flagged() -> None:
    shield = StepShield(TWO, 1)
    shield.begin(WORLDS, np.arange(3))
    shield.decide(np.full(3, -0.5), seen=shield.running.states[:, :4].copy())
    seen = shield.running.states[:, :4].copy()
    seen[2, 0] -= 0.1
    decision = shield.decide(np.full(3, 1.0), seen=seen)
    assert shield.distrusted.tolist() == [False, False, True]
    assert REASONS[decision.reason[2]] == "assumption broken"
