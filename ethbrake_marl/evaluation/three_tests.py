"""The three tests that stand beside each other: the paper's own, and two that close its ways out.

All three have the same gaps and speeds in world k. ``docs/decisions/0011`` says why the first is the main one, and why
none is shown alone.
"""

from __future__ import annotations

from ethbrake_marl.scenario import Scenario, load_scenario

MAIN_TEST = "paper-random"
TESTS = {
    MAIN_TEST: "Main test, the paper's rules: Vehicle 2 may drive, nothing stands ahead of Vehicle 1, and pushing it on"
    " costs nothing in either count.",
    "paper-random-brake-only": "Brake-only test: the same worlds, but Vehicle 2 may only brake and coast; it can"
    " neither drive on nor push with its motor.",
    "paper-random-obstacle": "Obstacle test: the same worlds with the obstacle that Vehicle 1 brakes for, 1.7 m beyond"
    " where it stops by itself. Vehicle 1's impact with it is harm.",
}

_TEXTS = {"title", "description", "source"}


def is_as_shipped(scenario: Scenario) -> bool:
    """Whether every value of the scenario is that of the shipped one of its name, whatever its texts say."""
    return scenario.model_dump(exclude=_TEXTS) == load_scenario(scenario.name).model_dump(exclude=_TEXTS)


def other_tests(scenario: Scenario) -> tuple[Scenario, ...]:
    """The two tests that belong beside results on ``scenario``; none where it is not one of the three as shipped."""
    if scenario.name not in TESTS or not is_as_shipped(scenario):
        return ()
    return tuple(load_scenario(name) for name in TESTS if name != scenario.name)
