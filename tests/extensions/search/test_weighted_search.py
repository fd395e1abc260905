"""A search that minimises weighted harm of the vehicles, or the largest, instead of the harm of the line."""

from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import EthBrakeError, InvalidInput
from ethbrake_marl.extensions.search.best_harm import best_harm, fold_episodes, search_list, task_problem
from ethbrake_marl.extensions.search.problem import search_profiles
from ethbrake_marl.first_edition.engine.profiles import Profiles
from ethbrake_marl.first_edition.game.objectives import aim_of, parse_objective
from ethbrake_marl.first_edition.scenario.task import Task

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
    with pytest.raises(InvalidInput, match=r"objective 'injury': is not a weighted sum of the vehicles' harm"):
        aim_of(parse_objective("injury:lr4s"), eb.load_scenario("paper-random").sample(1, 0).worlds.vehicles, 1)


@pytest.mark.parametrize("spec", ["best_harm:300", "universal+search"])
def test_agent__that_searches_follows_the_objective_of_the_scenario(spec: str) -> None:
    scenario = eb.load_scenario("paper-random").replace(objective=["total", "weighted:1,0,0", "own"])
    worlds = scenario.sample(30, 8).worlds
    agents = {name: eb.make_agent(name, scenario=scenario) for name in ("full_brake", "universal", spec)}
    found = eb.evaluate(worlds, agents, scenario=scenario, aftermath=False)
    least = found.outcome(spec).vehicle_harm("first")[:, 0].mean()
    assert least < 0.95 * min(found.outcome(name).vehicle_harm("first")[:, 0].mean() for name in [*agents][:2])
    predicted = found.outcome(spec).predicted_harm  # the amount of the objective: 3 times Vehicle 1's harm
    assert (3.0 * found.outcome(spec).vehicle_harm("first")[:, 0] <= predicted + 1e-6).all()


@pytest.mark.parametrize("spec", ["best_harm:300", "full_brake+search"])
def test_agent__that_searches_refuses_an_objective_that_is_no_sum(spec: str) -> None:
    scenario = eb.load_scenario("paper-random").replace(objective="injury:lr4s")
    agent = eb.make_agent(spec, scenario=scenario)
    with pytest.raises(EthBrakeError, match="is not a weighted sum of the vehicles' harm"):
        eb.evaluate(scenario.sample(2, 8).worlds, {"it": agent}, scenario=scenario)


def test_table__of_an_objective_says_so_and_is_not_folded_with_harm_of_the_line() -> None:
    scenario = eb.load_scenario("paper-random")
    worlds = scenario.sample(6, 8).worlds
    table = best_harm(scenario, worlds, counts=("first",), budget=300, objective="weighted:1,0,0", threads=1)
    plain = best_harm(scenario, worlds, counts=("first",), budget=300, threads=1)
    again = best_harm(scenario, worlds, counts=("first",), budget=300, objective="weighted:1,0,0", known=plain)
    assert (
        table.header["objective"] == again.header["objective"] == "weighted:1,0,0" and "objective" not in plain.header
    )
    profiles, _ = plain.profiles(plain.identity, "first", problem_of(scenario, worlds).last_step)
    of_first = 3.0 * problem_of(scenario, worlds).borne(profiles)["first"][:, 0]
    assert (again.best["first"].harm <= of_first + 1e-6).all()
    with pytest.raises(InvalidInput, match="the table contains values of the objective 'weighted:1,0,0'; give a table"):
        fold_episodes(table, scenario, worlds, "coast", {"first": eb.make_agent("coast")})


def test_vehicles__that_minimise_different_amounts_cannot_be_searched_together() -> None:
    pair = eb.load_scenario("cooperation-3-pair")
    with pytest.raises(InvalidInput, match="the 2 controlled vehicles have different objectives"):
        best_harm(pair, pair.sample(2, 1).worlds, counts=("first",), budget=50, objective="own")


def test_chunks__of_another_objective_are_searched_again(tmp_path: Path) -> None:
    scenario = eb.load_scenario("paper-random")
    sample = scenario.sample(3, 8)
    found = [
        search_list(scenario, sample, counts=("first",), budget=100, chunks=tmp_path, objective=text).best["first"].harm
        for text in ("total", "weighted:1,0,0", "total")
    ]
    assert found[0].tolist() == found[2].tolist() != found[1].tolist()
