"""A search that minimises weighted harm of the vehicles, or the largest, instead of the harm of the line."""

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.engine.profiles import Profiles
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.search.best_harm import task_problem
from ethbrake_marl.extensions.search.problem import search_profiles
from ethbrake_marl.game.objectives import aim_of, parse_objective
from ethbrake_marl.scenario.task import Task

SCENARIOS = ["paper-random", "cooperation-3-pair", "cooperation-4-all", "realistic-truck"]


def problem_of(scenario: eb.Scenario, worlds: eb.Worlds, count: str = "first"):
    return task_problem(worlds, Task(scenario, scenario.learners, count))


@pytest.mark.parametrize("name", SCENARIOS)
def test_borne__is_what_the_engine_says_each_vehicle_bears(name: str) -> None:
    """Constant commands, driven by an evaluation and followed by the problem."""
    scenario = eb.load_scenario(name)
    worlds = scenario.sample(40, 5).worlds
    problem = problem_of(scenario, worlds)
    braking = problem.constant(problem.bounds[:, np.newaxis, :, 0])
    agent = eb.make_agent("full_brake")
    outcome = eb.evaluate(worlds, {"it": agent}, scenario=scenario, aftermath=False).outcome("it")
    for count, borne in problem.borne(braking).items():
        assert borne.tolist() == outcome.vehicle_harm(count).tolist()
    first, total = problem.follow(braking)
    assert first.tolist() == outcome.first_impact_harm.tolist() and total.tolist() == outcome.total_harm.tolist()


@pytest.mark.parametrize("text", ["own", "social:60", "maximin", "mass-weighted", "weighted:1,4,2"])
@pytest.mark.parametrize("count", ["first", "total"])
def test_search__of_an_objective_does_no_worse_by_it_than_what_it_starts_with(text: str, count: str) -> None:
    scenario = eb.load_scenario("paper-random")
    worlds = scenario.sample(25, 8).worlds
    objective, line = parse_objective(text), worlds.vehicles
    found = {}
    for aim in (text, "total", "weighted:4,1,1", "weighted:1,1,4"):
        weights, largest = aim_of(parse_objective(aim), line, 1)
        problem = problem_of(scenario, worlds, count).minimising(weights, largest=largest)
        found[aim] = search_profiles(problem, problem.constant(problem.even_grid(29)), budget=3_000)[0]
    problem = problem_of(scenario, worlds, count)
    start = [profiles for aim, profiles in found.items() if aim != text]
    ends = np.stack([each.ends for each in start], axis=1).reshape(-1, start[0].ends.shape[1])
    commands = np.stack([each.commands_mps2 for each in start], axis=1).reshape(len(ends), -1, 1)
    weights, largest = aim_of(objective, line, 1)
    again, _ = search_profiles(problem.minimising(weights, largest=largest), Profiles(ends, commands), budget=1_000)

    def amounts(profiles: Profiles) -> np.ndarray:
        borne = problem.borne(profiles)[count] * weights
        return borne.max(axis=1) if largest else borne.sum(axis=1)

    for other in start:
        assert (amounts(again) <= amounts(other) + 1e-6).all()


def test_aim__of_what_is_no_weighted_sum_is_refused() -> None:
    with pytest.raises(InvalidInput, match=r"objective 'injury': is no weighted sum of the vehicles' harm; known: "):
        aim_of(parse_objective("injury:lr4s"), eb.load_scenario("paper-random").sample(1, 0).worlds.vehicles, 1)
