"""Honest costs of 20 worlds each: of the line, and of the vehicle that bears most. Who bears what must not drift."""

from __future__ import annotations

import numpy as np
import pytest

import ethbrake_marl as eb

COSTS = {  # who drives: full braking is pushed by weaker brakes; who coasts pushes scripts until the horizon
    ("paper-random", "full_brake"): (27.1661625, 13.6464474),
    ("paper-random", "e_v2x_bm"): (15.1165412, 7.7438172),
    ("paper-random-obstacle", "full_brake"): (59.6555834, 32.2833986),
    ("paper-random-obstacle", "e_v2x_bm"): (51.957439, 28.3353921),
    ("paper-random-obstacle", "coast"): (609.772033, 373.56364),
    ("paper-random-buildup", "coast"): (429.356088, 381.177386),
    ("benchmark-truck", "full_brake"): (67.8212755, 47.5234638),
    ("cooperation-3-five", "coast"): (1574.43402, 604.468758),
    ("realistic-mixed", "coast"): (680.535677, 454.971444),
    ("standards-ccrm-2026", "coast"): (520.640975, 281.501251),
    ("stress-wide", "coast"): (772.562275, 614.640643),
}


@pytest.mark.parametrize(("scenario", "agent"), COSTS)
def test_honest_costs__are_those_of_the_record(scenario: str, agent: str) -> None:
    outcome = eb.evaluate(scenario, agent, episodes=20)[agent]
    worst_off = np.max([column for name, column in outcome.items() if name.startswith("honest_cost_")], axis=0)
    assert (outcome["honest_cost"].mean(), worst_off.mean()) == pytest.approx(COSTS[scenario, agent], rel=1e-7)
