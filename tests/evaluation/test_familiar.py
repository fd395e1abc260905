"""A policy that drives in worlds unlike those of its training is warned of."""

import warnings
from typing import Any

import pytest

import ethbrake_marl as eb
from ethbrake_marl.errors import Unfamiliar

PAPER = eb.load_scenario("paper-random")


def told(scenario: Any, agents: str = "ppo") -> str:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        eb.evaluate(scenario, agents, episodes=40)
    return " | ".join(str(each.message) for each in caught if each.category is Unfamiliar)


def test_nothing_is_said_where_it_was_trained() -> None:
    assert told(PAPER, "ppo,full_brake") == told(PAPER.replace(harm_weight=[1, 4, 1])) == ""
    assert told("cooperation-3-pair", "vine-pair") == ""


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"time_step_s": 0.2}, "ppo: decided every 0.1 s in its training, but decides every 0.2 s in scenario"),
        ({"mass_t": [4.5, 12.0, 5.9]}, "ppo: was trained in paper-random: mass_2_t is new in 100 % of these worlds"),
        ({"obstacle_gap_m": 60.0, "early_impacts": "keep"}, "obstacle_gap_m is new"),
        ({"brake_rate_mps3": 12.65}, "brake_rate_1_mps3 is new"),
        ({"roles": {"vehicle_3": "learner", "vehicle_2": "full_brake"}}, "vehicle_3 is new to it"),
    ],
    ids=str,
)
def test_what_is_new_is_said(changes: dict[str, Any], text: str) -> None:
    assert text in told(PAPER.replace(**changes))


def test_another_number_of_vehicles_is_said() -> None:
    assert "ppo: was trained in paper-random: 5 vehicles are new to it" in told("cooperation-2-five")
