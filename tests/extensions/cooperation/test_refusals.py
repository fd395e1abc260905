"""What levels of cooperation refuse."""

from collections.abc import Callable

import pytest

import ethbrake_marl as eb
from ethbrake_marl.extensions.cooperation.levels import Level, common_worlds
from tests.refused import refused


def level(scenario: eb.Scenario) -> Level:
    return Level(scenario.name, scenario)


LEVEL_2 = eb.load_scenario("cooperation-2-paper")


def compare(**changes: object) -> None:
    """Level 2 of cooperation beside one that differs from it in the vehicle that learns, and in this."""
    mine = LEVEL_2.replace(name="mine", roles={"vehicle_3": "learner"}, **changes)
    common_worlds([level(LEVEL_2), level(mine)], 5, 7)


LEVELS: dict[str, Callable[[], object]] = {
    "level 'mine': mass_t is 4.5, 5.5, 6, but 4.5, 5.5": lambda: compare(mass_t=[4.5, 5.5, 6]),
    "level 'mine': restitution is 0.2, but 0.1 at level 'cooperation-2-paper'": lambda: compare(restitution=0.2),
    "level 'mine': latency_s is 0, 0.5, 0.9, but 0, 0.5, 0.8": lambda: compare(latency_s=[0, 0.5, 0.9]),
}


@pytest.mark.parametrize("message", LEVELS)
def test_levels__are_compared_on_the_same_lines(message: str) -> None:
    with refused(message):
        LEVELS[message]()


def test_levels__may_differ_in_roles_objective_obstacle_and_channel_alone() -> None:
    roles = {"vehicle_1": "learner", "vehicle_3": "coast"}
    free = LEVEL_2.replace(name="mine", roles=roles, objective="own", obstacle_gap_m=42, v2x="blocked")
    late = LEVEL_2.replace(name="late", v2x="blocked")
    assert len(common_worlds([level(LEVEL_2), level(free), level(late)], 5, 7)) == 3
    with refused("level 'late': latency_s is 0, 0.5, 0.9, but 0, 0.5, 0.8 at level 'mine'"):
        common_worlds([level(LEVEL_2), level(free), level(late.replace(latency_s=[0, 0.5, 0.9]))], 5, 7)
