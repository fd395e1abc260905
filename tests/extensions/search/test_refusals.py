"""What searches and searching agents refuse."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.extensions.search.around import Searched
from ethbrake_marl.extensions.search.refine import refine
from ethbrake_marl.extensions.search.templates import best_templates
from ethbrake_marl.first_edition.agents.driving import drive
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.engine.profiles import ProfileProblem, profile_problem
from tests.first_edition.agents.test_refusals import check_failure
from tests.refused import refused

PAPER = eb.load_scenario("paper-random")
WORLDS = PAPER.sample(12, 7).worlds
BRAKE = make_agent("full_brake")


@cache
def problem(*vehicles: int) -> ProfileProblem:
    return profile_problem(WORLDS, vehicles)


REFUSED: dict[str, Callable[[], object]] = {
    "agent 'best_harm+step+episode': may have at most one search": lambda: make_agent(
        "best_harm+step+episode", scenario=PAPER
    ),
    "agent 'best_harm:1.5': after the colon, give the number of profiles": lambda: make_agent("best_harm:1.5"),
    "best_harm: budget = 0: the number of profiles to try must be at least 1": lambda: make_agent(
        "best_harm", most_candidates=0
    ),
    "search: candidates = 0: must be a whole number in 1..1000000": lambda: Searched(BRAKE, PAPER, candidates=0),
    "the commands have the shape (3, 75); give one controlled vehicle and commands of shape": lambda: refine(
        problem(1), np.zeros((3, 75)), budget=5
    ),
    "refine: a command exceeds the capacity of the vehicle": lambda: refine(
        problem(1), np.full((12, problem(1).last_step.max()), -50.0), budget=5
    ),
    "budget = 0: must be a whole number, at least 1": lambda: refine(
        problem(1), np.zeros((12, problem(1).last_step.max())), budget=0
    ),
    "templates = 0: must be a whole number, at least 1": lambda: best_templates(
        problem(1), np.full(12, np.inf), number=0
    ),
    "templates: the problem has 2 controlled vehicles; give a problem with one": lambda: best_templates(
        problem(1, 2), np.full(12, np.inf), number=40
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_search__is_refused(message: str) -> None:
    with refused(message):
        REFUSED[message]()


@pytest.mark.parametrize("around", ["+search", "+search+step"])
def test_failure__is_told_with_its_world_where_a_search_stands_around_the_agent(around: str) -> None:
    check_failure(around)


PLANS = PAPER.replace(
    early_impacts="keep", roles={"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "ppo"}
)


def test_looking_ahead__needs_commands_that_are_fixed_at_the_alert() -> None:
    with refused("vehicle_3 is driven by 'ppo', whose command is not fixed at the alert; to look ahead,"):
        drive(WORLDS, Searched(BRAKE, PLANS), PLANS, 1)
