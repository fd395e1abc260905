"""What stands beside what was reached."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.evaluation import evaluate
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.studies.ablation import Level, Plan, measure


def test_measure__all_brake_fully_whatever_their_roles():
    braking = load_scenario("paper-random").replace(name="braking", roles={"vehicle_1": "full_brake"})
    coasting = braking.replace(name="coasting", roles={"vehicle_1": "full_brake", "vehicle_3": "coast"})
    plan = Plan((Level(braking), Level(coasting)), (), 1, 1, 20, 7, 5, 10, Path("unused"))
    first, second = measure(plan)
    worlds = coasting.sample(20, 7)
    told = evaluate(worlds, {"b": make_agent("full_brake")}, scenario=braking, vehicle="vehicle_2").outcome("b")
    np.testing.assert_allclose(second.full_brake.world["total"][0], told.total_harm, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(first.reached.world["total"], second.full_brake.world["total"])
    assert second.reached.world["total"].mean() > 2.0 * told.total_harm.mean()
