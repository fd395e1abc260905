"""Agents by name: one registry, one grammar, what each asks for, and what can be put around whom."""

import pickle

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents import (
    Refined,
    agent_entries,
    agent_names,
    make_agent,
    optimise_coupled,
    optimise_pairwise,
    parse_spec,
    register_agent,
)
from ethbrake_marl.agents.registry import AgentSpec
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import AlreadyExists
from ethbrake_marl.physics import Floats, Worlds, advance
from ethbrake_marl.shield import HybridAgent, ShieldedDriver
from tests.fixtures.asked import Asked

SCENARIO = eb.load_scenario("paper-random")


def asked(spec: str, worlds: Worlds, vehicle: int = 1, **settings) -> Floats:
    return Asked(make_agent(spec, **settings)).begin(worlds, vehicle).act(worlds, vehicle)


@pytest.mark.parametrize(
    ("spec", "parts"),
    [
        ("full_brake", AgentSpec("full_brake", None, None, ())),
        ("constant:-5+step", AgentSpec("constant", "-5", None, ("step",))),
        ("ppo@shipped+refined+step", AgentSpec("ppo", None, "shipped", ("refined", "step"))),
        ("ppo@runs/a+b:c@d+episode:pairwise", AgentSpec("ppo", None, "runs/a+b:c@d", ("episode:pairwise",))),
        ("ppo@runs/my+step/", AgentSpec("ppo", None, "runs/my+step/", ())),
        ("mine:x@path+robust", AgentSpec("mine", "x", "path", ("robust",))),
        ("mine:a+b", AgentSpec("mine", "a+b", None, ())),
    ],
)
def test_spec__is_taken_apart_and_written_again(spec, parts):
    assert parse_spec(spec) == parts and str(parts) == spec


@pytest.mark.parametrize(
    ("spec", "kind"),
    [
        ("full_brake+step", ShieldedDriver),
        ("constant:-5+step", ShieldedDriver),
        ("planner:8+episode", HybridAgent),
        ("best_harm:20+refined", Refined),
        ("e_v2x_bm+refined+episode", HybridAgent),
        ("gentlest_front+robust", ShieldedDriver),
        ("ppo@shipped+refined+step", ShieldedDriver),
        ("full_brake+refined:10+episode", HybridAgent),
        ("full_brake+refined:10+step", ShieldedDriver),
        ("full_brake+refined:profile+step", ShieldedDriver),
    ],
)
def test_shields__go_around_any_agent_and_hold(spec, kind):
    agents = {spec: make_agent(spec, scenario=SCENARIO, harm_count="total", uncertainty="gaps_m=0.2")}
    assert isinstance(agents[spec], kind)
    outcome = eb.evaluate(SCENARIO.sample(3, 5), agents, scenario=SCENARIO).outcome(spec)
    assert (outcome.total_harm <= outcome.predicted_harm + 1e-9).all()


@pytest.mark.parametrize(
    ("spec", "capacity", "expected"),
    [
        ("full_brake", 7, -7.0),
        ("coast", 7, 0.0),
        ("constant:3.5", 7, -3.5),
        ("constant:-2", 7, 2.0),
        ("copy_leader", 7, -6.0),
        ("copy_leader", 4, -4.0),  # no harder than its own brakes
    ],
)
def test_scripts__ask_for_their_acceleration(spec, capacity, expected):
    worlds = SCENARIO.replace(braking_capacity_mps2=[6, capacity, 6]).sample(3, 7).worlds
    assert asked(spec, worlds).tolist() == [expected] * 3


def test_gentlest_front__spares_the_front_vehicle_and_nothing_gentler_does():
    worlds = SCENARIO.sample(300, 31).worlds
    command = -worlds.vehicles.braking_capacity_mps2
    command[:, 1] = asked("gentlest_front", worlds)
    reachable = command[:, 1] > -7.0
    assert 100 < reachable.sum() < 300
    alone = worlds.take(reachable)
    alone.gaps_m[:, 1] = 1000.0  # nobody behind
    _, impacts = advance(alone, command[reachable], until_s=20.0)
    assert impacts.count.sum() == 0
    command[:, 1] += 1e-4
    _, impacts = advance(alone, command[reachable], until_s=20.0)
    assert np.all(impacts.count[:, 0] >= 1)


def test_e_v2x_bm__drives_by_its_optimum_of_the_count_and_horizon_it_was_given():
    worlds = SCENARIO.sample(40, 31).worlds
    pairwise, closed = Asked(make_agent("e_v2x_bm:pairwise")).begin(worlds, 1), optimise_pairwise(worlds, 1)
    assert np.array_equal(pairwise.predicted_harm, closed.harm)
    assert np.array_equal(pairwise.act(worlds, 1), -closed.deceleration_mps2)
    for settings in ({"harm_count": "first"}, {"harm_count": "total"}, {"horizon_s": 1.5}):
        assert np.array_equal(asked("e_v2x_bm", worlds, **settings), -optimise_coupled(worlds, 1, **settings)[0])
        other = {"harm_count": "first", "horizon_s": 4.0}
        assert not np.array_equal(asked("e_v2x_bm", worlds, **settings), asked("e_v2x_bm", worlds, **other))
    short = SCENARIO.replace(horizon_s=4)  # whose horizon is the agent's
    assert np.array_equal(asked("e_v2x_bm", worlds, scenario=short), asked("e_v2x_bm", worlds, horizon_s=4.0))


@pytest.mark.parametrize(
    "spec", ["full_brake", "coast", "constant:3.5", "copy_leader", "gentlest_front", "e_v2x_bm", "e_v2x_bm:pairwise"]
)
def test_agents__new_episodes_change_their_rows_only_and_agents_can_be_pickled(spec):
    worlds, fresh = SCENARIO.sample(6, 31).worlds, SCENARIO.sample(2, 32).worlds
    agent = Asked(make_agent(spec)).begin(worlds, 1)
    before = agent.act(worlds, 1)
    agent.begin(fresh, 1, np.array([4, 1]))
    again = Asked(pickle.loads(pickle.dumps(agent.agent)), memory=agent.memory)
    for after in (again.act(worlds, 1), agent.act(worlds, 1)):
        assert after[[0, 2, 3, 5]].tolist() == before[[0, 2, 3, 5]].tolist()
        assert after[[4, 1]].tolist() == asked(spec, fresh).tolist()
    assert again.name == spec


def test_agent_names__are_those_that_ship_and_are_listed(capsys):
    scripts = ("coast", "constant", "copy_leader", "e_v2x_bm", "full_brake", "gentlest_front", "planner")
    names = (*scripts, "best_harm", "ppo", "sac", "counterfactual", "options", "policy", "universal", "team")
    assert agent_names() == tuple(sorted(names))
    assert run_command(["agent", "list"]) == 0
    table = capsys.readouterr().out
    assert [name for name in (*names, "+refined", "+episode", "+step", "+robust") if name not in table] == []
    for entry in agent_entries():
        assert callable(entry.load()) and entry.about and entry.knows


def test_register_agent__makes_names_and_policies_known():
    seen = []

    def factory(argument, settings):
        seen.append((argument, settings.policy, settings.harm_count))
        return make_agent("coast")

    register_agent("mine", factory, takes_policy=True)
    register_agent("mine", factory, takes_policy=True)  # the same again changes nothing
    for spec in ("mine", "mine:x", "mine@my-run", "mine:x@C:/runs/my run@2"):
        make_agent(spec, harm_count="total")
    assert [each[:2] for each in seen] == [(None, None), ("x", None), (None, "my-run"), ("x", "C:/runs/my run@2")]
    assert {each[2] for each in seen} == {"total"} and "mine" in agent_names()
    with pytest.raises(AlreadyExists, match="agent 'mine' is registered already"):
        register_agent("mine", lambda argument, settings: make_agent("coast"))
