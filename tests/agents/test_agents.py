"""Agents by name, what they ask for, and how they keep their episodes apart."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents import agent_names, make_agent, optimise_coupled, optimise_pairwise, register_agent, registry
from ethbrake_marl.agents.registry import agent_entries
from ethbrake_marl.errors import AlreadyExists, InvalidInput, UnknownName
from ethbrake_marl.physics import Floats, Worlds, advance, make_worlds
from tests.fixtures.asked import Asked

ALL = ["full_brake", "coast", "constant:3.5", "copy_leader", "gentlest_front", "e_v2x_bm", "e_v2x_bm:pairwise"]


def random_worlds(n: int, seed: int = 31, *, capacity: tuple[float, float, float] = (6, 7, 6)) -> Worlds:
    rng = np.random.default_rng(seed)
    return make_worlds(
        rng.uniform(5, 10, (n, 2)),
        rng.uniform(18, 22, (n, 3)),
        braking_capacity_mps2=capacity,
        driving_capacity_mps2=[6, 5, 6],
        latency_s=[0, 0.5, 0.8],
        mass_t=[4.5, 5.5, 5.9],
        restitution=0.1,
    )


def asked(spec: str, worlds: Worlds, vehicle: int = 1, **settings) -> Floats:
    return Asked(make_agent(spec, **settings)).begin(worlds, vehicle).act(worlds, vehicle)


@pytest.mark.parametrize(
    ("spec", "expected"),
    [("full_brake", -7.0), ("coast", 0.0), ("constant:3.5", -3.5), ("constant:-2", 2.0), ("copy_leader", -6.0)],
)
def test_scripts__ask_for_their_acceleration(spec, expected):
    assert asked(spec, random_worlds(3)).tolist() == [expected] * 3


def test_copy_leader__brakes_no_harder_than_its_own_brakes():
    assert asked("copy_leader", random_worlds(2, capacity=(6, 4, 6))).tolist() == [-4.0, -4.0]


def test_gentlest_front__spares_the_front_vehicle_and_nothing_gentler_does():
    worlds = random_worlds(300)
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


def test_gentlest_front__collides_in_the_worlds_of_e_v2x_bm():
    worlds = random_worlds(400)
    collided = []
    for spec in ("gentlest_front", "e_v2x_bm", "e_v2x_bm:pairwise"):
        command = -worlds.vehicles.braking_capacity_mps2
        command[:, 1] = asked(spec, worlds)
        collided.append(advance(worlds, command, until_s=8.0)[1].count.sum(axis=1) > 0)
    assert np.array_equal(collided[0], collided[1]) and np.array_equal(collided[1], collided[2])


@pytest.mark.parametrize("harm_count", ["first", "total"])
def test_e_v2x_bm__predicts_what_it_realises(harm_count):
    worlds = random_worlds(100)
    agent = Asked(make_agent("e_v2x_bm", harm_count=harm_count)).begin(worlds, 1)
    command = -worlds.vehicles.braking_capacity_mps2
    realised = np.zeros(100)
    for time in np.arange(0.1, 8.05, 0.1):
        command[:, 1] = agent.act(worlds, 1)
        worlds, impacts = advance(worlds, command, until_s=time)
        harm = impacts.first_impact_harm if harm_count == "first" else impacts.total_harm
        realised += harm.sum(axis=1)
    assert np.abs(realised - agent.predicted_harm).max() < 1e-6


def test_e_v2x_bm__pairwise_predicts_the_closed_form():
    worlds = random_worlds(50)
    agent = Asked(make_agent("e_v2x_bm:pairwise")).begin(worlds, 1)
    closed = optimise_pairwise(worlds, 1)
    assert np.array_equal(agent.predicted_harm, closed.harm)
    assert np.array_equal(agent.act(worlds, 1), -closed.deceleration_mps2)


def test_e_v2x_bm__uses_the_count_and_the_horizon_it_was_given():
    worlds = random_worlds(40)
    for settings in ({"harm_count": "first"}, {"harm_count": "total"}, {"horizon_s": 1.5}):
        assert np.array_equal(asked("e_v2x_bm", worlds, **settings), -optimise_coupled(worlds, 1, **settings)[0])
    assert not np.array_equal(asked("e_v2x_bm", worlds), asked("e_v2x_bm", worlds, harm_count="total"))
    assert not np.array_equal(asked("e_v2x_bm", worlds), asked("e_v2x_bm", worlds, horizon_s=1.5))


@pytest.mark.parametrize("spec", ALL)
def test_agents__new_episodes_change_their_rows_only(spec):
    worlds, fresh = random_worlds(6), random_worlds(2, seed=32)
    agent = Asked(make_agent(spec)).begin(worlds, 1)
    before = agent.act(worlds, 1)
    agent.begin(fresh, 1, np.array([4, 1]))
    after = agent.act(worlds, 1)
    assert after[[0, 2, 3, 5]].tolist() == before[[0, 2, 3, 5]].tolist()
    assert after[[4, 1]].tolist() == asked(spec, fresh).tolist()


@pytest.mark.parametrize("spec", ALL)
def test_agents__can_be_pickled(spec):
    worlds = random_worlds(4)
    agent = Asked(make_agent(spec)).begin(worlds, 1)
    command = agent.act(worlds, 1)
    again = Asked(pickle.loads(pickle.dumps(agent.agent)), memory=agent.memory)
    assert again.act(worlds, 1).tolist() == command.tolist()
    assert agent.name == spec


@pytest.mark.parametrize("spec", ["copy_leader", "gentlest_front"])
def test_front_only_scripts__refuse_the_first_vehicle(spec):
    with pytest.raises(InvalidInput, match="vehicle_1 has no vehicle in front"):
        asked(spec, random_worlds(1), vehicle=0)


@pytest.mark.parametrize("spec", ["constant:7.5", "constant:-5.5"])
def test_constant__beyond_the_capacity_is_refused_when_the_episode_begins(spec):
    with pytest.raises(InvalidInput, match="capacity"):
        asked(spec, random_worlds(2))


@pytest.mark.parametrize(
    "spec",
    [
        *("constant", "constant:", "constant:fast", "constant:nan", "full_brake:1", "coast:1", "copy_leader:1"),
        *("gentlest_front:1", "e_v2x_bm:total", "", "Full", "full_brake@", "e_v2x_bm@coupled@x", "a:b c", None),
    ],
)
def test_make_agent__refuses_bad_arguments(spec):
    with pytest.raises(InvalidInput):
        make_agent(spec)


@pytest.mark.parametrize("settings", [{"harm_count": "both"}, {"horizon_s": 0.0}, {"horizon_s": math.nan}])
def test_make_agent__refuses_bad_settings(settings):
    with pytest.raises(InvalidInput, match=next(iter(settings)).removeprefix("harm_")):
        make_agent("e_v2x_bm", **settings)


def test_make_agent__suggests_the_name_that_was_meant():
    with pytest.raises(UnknownName, match="did you mean 'full_brake'"):
        make_agent("full_break")


def test_agent_names__are_those_that_ship():
    scripts = ("coast", "constant", "copy_leader", "e_v2x_bm", "full_brake", "gentlest_front", "planner")
    assert agent_names() == tuple(
        sorted((*scripts, "best_harm", "ppo", "sac", "counterfactual", "policy", "universal", "team"))
    )
    for entry in agent_entries():
        assert callable(entry.load()) and entry.about and entry.knows


def test_register_agent__makes_names_and_policies_known(monkeypatch):
    monkeypatch.setattr(registry, "_ENTRIES", dict(registry._ENTRIES))
    seen = []

    def factory(argument, settings):
        seen.append((argument, settings.policy, settings.harm_count))
        return make_agent("coast")

    register_agent("mine", factory, takes_policy=True)
    register_agent("mine", factory, takes_policy=True)
    for spec in ("mine", "mine:x", "mine@my-run", "mine:x@C:/runs/my run@2"):
        make_agent(spec, harm_count="total")
    assert [each[:2] for each in seen] == [(None, None), ("x", None), (None, "my-run"), ("x", "C:/runs/my run@2")]
    assert {each[2] for each in seen} == {"total"} and "mine" in agent_names()
    with pytest.raises(AlreadyExists):
        register_agent("mine", lambda argument, settings: make_agent("coast"))
    for taken in ("coast", "ppo"):
        with pytest.raises(AlreadyExists):
            register_agent(taken, factory)
    for name in ("mine:x", "mine@x", "mine+step"):
        with pytest.raises(InvalidInput, match="must be a plain name"):
            register_agent(name, factory)


def test_registered__takes_a_policy_only_where_it_says_so(monkeypatch):
    monkeypatch.setattr(registry, "_ENTRIES", dict(registry._ENTRIES))
    register_agent("leads", lambda argument, settings: make_agent(f"constant:{argument}"))
    register_agent("learned", lambda argument, settings: make_agent(f"constant:{settings.policy}"), takes_policy=True)
    assert make_agent("learned@2").name == "constant:2"
    scenario = eb.load_scenario("paper-random").replace(early_impacts="keep")
    for role in ("leads:3@anything", "leads@anything"):
        with pytest.raises(InvalidInput, match=r"leads takes no policy; register_agent\(..., takes_policy=True\) says"):
            make_agent(role)
        with pytest.raises(InvalidInput, match="leads takes no policy"):
            eb.parallel_env(scenario.replace(roles={"vehicle_1": role, "vehicle_2": "learner"}))


def test_ladder__as_one_agent_says_what_it_stands_for():
    with pytest.raises(InvalidInput, match="agent 'ladder': stands for several agents in --agents; here one is needed"):
        make_agent("ladder")


def test_role__that_commands_beyond_its_capacity_is_blamed_itself(monkeypatch):
    class Beyond:
        name = "beyond"

        def act(self, worlds, vehicle):
            return np.full(worlds.n, -99.0)

    monkeypatch.setattr(registry, "_ENTRIES", dict(registry._ENTRIES))
    register_agent("beyond", lambda argument, settings: Beyond())
    scenario = eb.load_scenario("paper-random").replace(
        early_impacts="keep", roles={"vehicle_1": "beyond", "vehicle_2": "learner"}
    )
    with pytest.raises(InvalidInput, match=r"agent 'beyond', world 0, vehicle_1 at 0.00 s: command -99 m/s2"):
        eb.evaluate(scenario.sample(3, 7), {"mine": make_agent("full_brake")}, scenario=scenario)
