"""Agents that search: never worse than what they began with, as they predicted, and each world by itself."""

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import PhysicsError
from ethbrake_marl.extensions.search import refine as refine_module
from ethbrake_marl.extensions.search.around import Searched
from ethbrake_marl.extensions.search.refine import refine
from ethbrake_marl.first_edition.agents.driving import drive, script_agents
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.engine.profiles import profile_problem
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS
from ethbrake_marl.first_edition.shields.drivers import ShieldedDriver
from tests.first_edition.shield.test_step_shield import Remembering
from tests.first_edition.rest.fixture_asked import Asked

SCENARIO = eb.load_scenario("paper-random")
WORLDS = SCENARIO.sample(80, 3).worlds


def agent_of(spec, scenario=SCENARIO, harm_count="first"):
    return make_agent(spec, scenario=scenario, harm_count=harm_count)


def searched(inside="constant:5", scenario=SCENARIO, **settings):
    """The search around an agent, with few candidates."""
    return Searched(agent_of(inside), scenario, **{"candidates": 60, **settings})


def harm(agent, harm_count="first", worlds=WORLDS, scenario=SCENARIO):
    return drive(worlds, agent, scenario, 1).ledger.world_harm(harm_count)


@pytest.mark.parametrize("harm_count", HARM_COUNTS)
@pytest.mark.parametrize("inside", ["constant:5", "ppo"])
def test_searched__is_never_worse_and_as_predicted(inside, harm_count):
    plain, agent = harm(agent_of(inside), harm_count), searched(inside, harm_count=harm_count)
    episodes = drive(WORLDS, agent, SCENARIO, 1)
    realised, predicted = episodes.ledger.world_harm(harm_count), episodes.memories[1]["predicted_harm"]
    assert realised.tolist() == predicted.tolist()
    assert (realised <= plain).all() and (realised < plain - 0.1).any()


def test_searched__is_told_what_the_others_do():
    episodes = drive(WORLDS.take(np.arange(6)), searched("ppo", GENTLE, candidates=9), GENTLE, 1)
    assert episodes.ledger.world_harm("first").tolist() == episodes.memories[1]["predicted_harm"].tolist()


GENTLE = SCENARIO.replace(roles={"vehicle_1": "constant:3", "vehicle_2": "learner", "vehicle_3": "coast"})


@pytest.mark.parametrize(
    ("spec", "name", "vehicle", "changes"),
    [
        ("best_harm:100", "paper-random", 1, {"time_step_s": 0.05}),
        ("best_harm:100", "paper-random", 1, {"time_step_s": 0.2}),
        ("full_brake+search", "paper-random", 1, {"time_step_s": 0.05}),
        ("full_brake+search", "paper-random", 2, {}),
        ("full_brake+search", "cooperation-2-five", 1, {}),
        ("full_brake+search", "paper-random-obstacle", 1, {}),
    ],
)
def test_search__of_any_line_obstacle_and_step_keeps_what_it_predicted(spec, name, vehicle, changes):
    scenario = eb.load_scenario(name).replace(**changes)
    scenario = scenario.with_learners([scenario.vehicle_names[vehicle]])
    worlds = scenario.sample(20, 4).worlds
    episodes = drive(worlds, agent_of(spec, scenario, "total"), scenario, vehicle)
    realised, predicted = episodes.ledger.world_harm("total"), episodes.memories[vehicle]["predicted_harm"]
    plain = drive(worlds, make_agent("full_brake"), scenario, vehicle).ledger.world_harm("total")
    assert (realised <= predicted + 1e-9).all() and (realised < plain - 0.1).any()
    if "+search" in spec:
        assert realised.tolist() == predicted.tolist() and (realised <= plain).all()


def test_search__in_a_role_decides_when_its_scenario_does():
    roles = {"vehicle_2": "best_harm:100", "vehicle_3": "learner"}
    role = SCENARIO.replace(early_impacts="keep", roles=roles, time_step_s=0.2)
    assert script_agents(role)[1]._outlook.time_step_s == 0.2


def test_searched__of_more_candidates_is_better():
    assert harm(searched(candidates=200)).mean() < harm(searched(candidates=20)).mean()


def test_searched__where_nothing_is_better_drives_as_the_policy_does():
    apart = WORLDS.take(np.flatnonzero(harm(make_agent("full_brake")) == 0.0))
    agent = Asked(searched("full_brake")).begin(apart, 1)
    assert agent.act(apart, 1).tolist() == (-apart.vehicles.braking_capacity_mps2[:, 1]).tolist()


def test_refine__is_a_function_of_the_world_and_the_seed(monkeypatch):
    problem = profile_problem(WORLDS, [1])
    given = np.repeat(-WORLDS.vehicles.braking_capacity_mps2[:, 1:2], int(problem.last_step.max()), axis=1)
    found = refine(problem, given, budget=300)
    assert found[1].mean() < 0.5 * harm(make_agent("full_brake")).mean()
    assert refine(problem, given, budget=300)[0].tobytes() == found[0].tobytes()
    assert refine(problem, given, budget=300, seed=1)[0].tobytes() != found[0].tobytes()

    def fail(*arguments):
        arguments[-1][4] = True

    monkeypatch.setattr(refine_module, "_refine_worlds", fail)
    with pytest.raises(PhysicsError, match="world 4: the given commands cannot be simulated"):
        refine(problem, given, budget=5)


def test_rollout__also_of_a_searched_policy_that_cannot_be_divided():
    driver = ShieldedDriver(Searched(Remembering(), SCENARIO, candidates=20), SCENARIO)
    episodes = drive(WORLDS.take(np.arange(20)), driver, SCENARIO, 1)
    assert episodes.ledger.world_harm("first").tolist() == episodes.guarded.shield.bound.tolist()
