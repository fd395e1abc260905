"""The three tests that are shown beside each other."""

from __future__ import annotations

from ethbrake_marl.scenario.catalogue import load_scenario
from ethbrake_marl.scenario.schema import Scenario

TESTS = {
    "paper-random": "Main test, the paper's rules: Vehicle 2 may drive, nothing stands ahead of Vehicle 1, and pushing"
    " it on costs nothing in either count.",
    "paper-random-brake-only": "Brake-only test: the same worlds, but Vehicle 2 may only brake and coast; it can"
    " neither drive on nor push with its motor.",
    "paper-random-obstacle": "Obstacle test: the same worlds with the obstacle that Vehicle 1 brakes for, 1.7 m beyond"
    " where it stops by itself. Vehicle 1's impact with it is harm.",
}


def is_as_shipped(scenario: Scenario) -> bool:
    """Whether every value of the scenario is that of the shipped one of its name, whatever its texts say."""
    one, other = (
        each.model_dump(exclude={"title", "description", "source"}) for each in (scenario, load_scenario(scenario.name))
    )
    return one == other


def other_tests(scenario: Scenario) -> tuple[Scenario, ...]:
    """The two tests that belong beside results on ``scenario``; none where it is not one of the three as shipped."""
    if scenario.name not in TESTS or not is_as_shipped(scenario):
        return ()
    return tuple(load_scenario(name) for name in TESTS if name != scenario.name)
