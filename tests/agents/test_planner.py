from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.agents import make_agent, optimise_coupled
from ethbrake_marl.agents.planner import Planner
from ethbrake_marl.agents.registry import drive, script_agents
from ethbrake_marl.defaults import HARM_COUNTS, HarmCount
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Worlds
from ethbrake_marl.scenario import Scenario, load_scenario
from tests.fixtures.asked import Asked


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario("paper-random")


@pytest.fixture(scope="module")
def worlds(scenario: Scenario) -> Worlds:
    return scenario.sample(10, seed=3).worlds


@pytest.mark.parametrize("harm_count", HARM_COUNTS)
def test_planner__does_no_more_harm_than_its_first_plan_and_improves_on_constants(
    scenario: Scenario, worlds: Worlds, harm_count: HarmCount
) -> None:
    agent = make_agent("planner:150", harm_count=harm_count)
    episodes = drive(worlds, agent, scenario, 1)
    harm = episodes.ledger.world_harm(harm_count)
    assert (harm <= episodes.memories[1]["predicted_harm"] + 1e-4).all()
    assert harm.mean() < 0.7 * optimise_coupled(worlds, 1, harm_count=harm_count).harm.mean()


def test_planner__is_deterministic_and_a_world_does_not_depend_on_its_batch(scenario: Scenario, worlds: Worlds) -> None:
    whole = drive(worlds, Planner("40"), scenario, 1).ledger.world_harm("first")
    rows = np.array([6, 1])
    part = drive(worlds.take(rows), Planner("40"), scenario, 1).ledger.world_harm("first")
    assert np.array_equal(part, whole[rows])


def test_planner__with_a_time_per_decision_plans_at_least_one_round(scenario: Scenario, worlds: Worlds) -> None:
    few = worlds.take(np.arange(2))
    harm = drive(few, make_agent("planner:0.5ms"), scenario, 1).ledger.world_harm("first")
    assert (harm <= optimise_coupled(few, 1).harm + 1e-2).all()


def test_planner__knows_what_the_others_do(scenario: Scenario, worlds: Worlds) -> None:
    gentle = scenario.replace(roles={**scenario.roles, "vehicle_3": "constant:3"})
    agent = Planner("60")
    episodes = drive(worlds, agent, gentle, 1)
    assert (episodes.ledger.world_harm("first") <= episodes.memories[1]["predicted_harm"] + 1e-4).all()


def test_planner__starts_new_episodes_in_some_rows(worlds: Worlds) -> None:
    agent = Asked(Planner("20")).begin(worlds, 1)
    before = agent.act(worlds, 1)
    rows = np.array([8, 2])
    agent.begin(worlds.take(rows), 1, rows)
    assert np.array_equal(agent.act(worlds, 1), before)


@pytest.mark.parametrize("argument", ["0", "-5", "fast", "0ms", "1.5", "5s", ""])
def test_planner__refuses_a_budget_that_is_none(argument: str) -> None:
    with pytest.raises(InvalidInput, match="candidates per decision"):
        Planner(argument)


@pytest.mark.parametrize("spec", ["planner:30", "best_harm:100"])
@pytest.mark.parametrize("time_step_s", [0.05, 0.2])
def test_search__decides_when_its_scenario_does(spec, time_step_s):
    scenario = load_scenario("paper-random").replace(time_step_s=time_step_s)
    agent = make_agent(spec, scenario=scenario)
    episodes = drive(scenario.sample(20, 7).worlds, agent, scenario, 1)
    assert (episodes.ledger.world_harm("first") <= episodes.memories[1]["predicted_harm"] + 1e-9).all()
    role = scenario.replace(early_impacts="keep", roles={"vehicle_2": spec, "vehicle_3": "learner"})
    assert script_agents(role)[1]._outlook.time_step_s == time_step_s


@pytest.mark.parametrize("most", [0, -1])
def test_best_harm__without_a_candidate_is_refused(most: int) -> None:
    with pytest.raises(InvalidInput, match=f"best_harm: budget = {most}; at least 1 candidate is needed"):
        make_agent("best_harm", most_candidates=most)
