"""``universal`` follows the plan outside the range of its training; every shipped policy has a range."""

from __future__ import annotations

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.policies.bundle import load_shipped, shipped_policies
from tests.fixtures.commands import Command


def test_shipped_policies__all_have_a_range_and_universal_has_the_plan_as_its_fallback() -> None:
    ranges = {name: load_shipped(name).manifest.training_range for name in shipped_policies()}
    assert len(ranges) == 5 and all(known is not None for known in ranges.values())
    assert {name: known.fallback for name, known in ranges.items() if known.fallback} == {"universal": "plan.action"}


def test_universal__is_the_plan_where_nothing_is_as_in_its_training() -> None:
    trucks = eb.load_scenario("paper-random").replace(speeds_mps=55, speed_limit_mps=60, gaps_m=20, mass_t=60)
    result = eb.evaluate(trucks, "plan,universal", episodes=50)
    assert (result["universal"]["outside"] == 1.0).all()
    np.testing.assert_array_equal(result["universal"]["honest_cost"], result["plan"]["honest_cost"])
    note = "range of the policy's training: universal in 100 %."
    assert any(note in text for text in eb.summarise(result).notes())


def test_universal__is_its_network_in_its_training() -> None:
    agents = {"universal": "universal", "network": eb.LearnedAgent(load_shipped("universal").with_range(None))}
    result = eb.evaluate("paper-random", agents, episodes=300)
    assert result["universal"]["outside"].mean() < 1e-3 and "outside" not in result["network"]
    np.testing.assert_allclose(
        result["universal"]["honest_cost"].mean(), result["network"]["honest_cost"].mean(), rtol=1e-3
    )


def test_universal__strikes_nobody_where_nobody_is_behind() -> None:
    assert not eb.evaluate("standards-fmvss-127", "universal", episodes=100)["universal"]["collided"].any()


def test_show__names_the_fallback(ethbrake: Command) -> None:
    text = " ".join(ethbrake("agent", "show", "universal", "--scenario", "paper-random").out.split())
    assert text.startswith("universal: vehicle_1, vehicle_2, vehicle_3, vehicle_4")
    assert (
        "vehicle_8 in lines, by vine. Outside the range of its training it follows plan.action. In paper-random, 0 %"
        in text
    )
