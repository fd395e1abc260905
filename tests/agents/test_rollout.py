"""Agents that look ahead know the scripts of the others."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.agents import registry
from ethbrake_marl.agents.registry import Team, drive, make_agent, register_agent, script_agents
from ethbrake_marl.engine import Engine
from ethbrake_marl.envs.interfaces import make_engine
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation import evaluate
from ethbrake_marl.evaluation.episodes import Task, film_scenes, follow_episodes, record_episode, record_episodes
from ethbrake_marl.observations import observe
from ethbrake_marl.physics import advance
from ethbrake_marl.rewards import RewardParams
from ethbrake_marl.scenario import load_scenario, observation_for
from ethbrake_marl.shield import HybridAgent

PAPER = load_scenario("paper-random")


def with_role(role, vehicle="vehicle_3"):
    return PAPER.replace(roles={**PAPER.roles, vehicle: role}, early_impacts="keep")


def harm(agent, scenario, worlds):
    return drive(worlds, agent, scenario, 1).ledger.world_harm("first")


@pytest.mark.parametrize("role", ["constant:3", "coast", "copy_leader", "gentlest_front", "e_v2x_bm"])
def test_e_v2x_bm__predicts_and_beats_constants_whatever_script_the_others_follow(role):
    scenario = with_role(role)
    worlds = scenario.sample(60, 7).worlds
    agent = make_agent("e_v2x_bm")
    episodes = drive(worlds, agent, scenario, 1)
    realised = episodes.ledger.world_harm("first")
    np.testing.assert_allclose(realised, episodes.memories[1]["predicted_harm"], atol=1e-6)
    for deceleration in np.linspace(0.0, 7.0, 15):
        assert (realised <= harm(make_agent(f"constant:{deceleration}"), scenario, worlds) + 1e-6).all()


def test_e_v2x_bm__full_braking_of_the_others_is_the_papers_case():
    worlds = PAPER.sample(40, 7).worlds
    agent = make_agent("e_v2x_bm")
    told, alone = drive(worlds, agent, PAPER, 1).memories[1], agent.begin(worlds, 1, {})
    assert told["deceleration_mps2"].tolist() == alone["deceleration_mps2"].tolist()


def test_e_v2x_bm__knows_who_drives_in_the_engines_of_all_interfaces():
    scenario = PAPER.replace(
        roles={"vehicle_1": "full_brake", "vehicle_2": "e_v2x_bm", "vehicle_3": "constant:3"}, early_impacts="keep"
    )
    scenario = scenario.replace(roles={**scenario.roles, "vehicle_1": "learner"}, obstacle_gap_m=60)
    engine = make_engine(scenario, 4, seed=3)
    alert = scenario.sample(4, 3, channel="training").worlds
    told = make_agent("e_v2x_bm").begin(alert, 1, script_agents(scenario))
    alone = make_agent("e_v2x_bm").begin(alert, 1, {})
    assert engine.memories[1]["deceleration_mps2"].tolist() == told["deceleration_mps2"].tolist()
    assert told["deceleration_mps2"].tolist() != alone["deceleration_mps2"].tolist()


class Steering:
    """Brakes by what it sees: nobody can look ahead through it."""

    name = "steering"

    def act(self, worlds, vehicle):
        return -3.0 / (1.0 + worlds.gaps_m[:, vehicle - 1])


def test_e_v2x_bm__refuses_others_whose_command_is_not_fixed():
    worlds = PAPER.sample(2, 7).worlds
    agent = make_agent("e_v2x_bm")
    with pytest.raises(InvalidInput, match="vehicle_3 is driven by 'steering', whose command is not fixed"):
        agent.begin(worlds, 1, {2: Steering()})


def test_e_v2x_bm__two_that_wait_for_each_other_are_refused():
    roles = {"vehicle_1": "learner", "vehicle_2": "e_v2x_bm", "vehicle_3": "e_v2x_bm"}
    ahead = PAPER.replace(obstacle_gap_m=42, early_impacts="keep")
    with pytest.raises(InvalidInput, match="vehicle_3 is driven by 'e_v2x_bm'"):
        make_engine(ahead.replace(roles=roles), 1)
    make_engine(ahead.replace(roles=roles | {"vehicle_3": "e_v2x_bm:pairwise"}), 1)


def test_drive__a_scripted_vehicle_that_is_driven_follows_its_script_in_nobodys_plan():
    plain = with_role("e_v2x_bm")
    overridden = plain.replace(roles=plain.roles | {"vehicle_2": "coast"})
    worlds = plain.sample(5, 7).worlds
    agent = make_agent("full_brake")
    assert harm(agent, overridden, worlds).tolist() == harm(agent, plain, worlds).tolist()


def test_hybrid__its_parts_know_the_others_too():
    scenario = with_role("constant:3")
    worlds = scenario.sample(30, 7).worlds
    hybrid = HybridAgent(make_agent("e_v2x_bm", harm_count="total"), scenario)
    episodes = drive(worlds, hybrid, scenario, 1)
    memory = episodes.memories[1]
    assert episodes.ledger.world_harm("first").tolist() == memory["predicted_harm"].tolist()
    best = harm(make_agent("e_v2x_bm"), scenario, worlds)
    np.testing.assert_allclose(memory["bound_harm"], best, atol=1e-9)


@pytest.mark.parametrize("script", ["copy_leader", "gentlest_front"])
def test_scripts__fixed_at_the_alert_are_asked_once_to_the_same_motion(script):
    fixed, remembering = make_agent(script), make_agent(script)
    remembering.state_free = False
    worlds = PAPER.sample(30, 7).worlds
    one, other = drive(worlds, fixed, PAPER, 1), drive(worlds, remembering, PAPER, 1)
    assert one.final.gaps_m.tolist() == other.final.gaps_m.tolist()
    assert one.ledger.total_harm.tolist() == other.ledger.total_harm.tolist()


class Looking(Steering):
    """Brakes half, and keeps what a learner with the usual observation would have seen."""

    def __init__(self):
        self.seen = []

    def act(self, worlds, vehicle):
        self.seen.append(observe(worlds, vehicle, observation_for(PAPER)))
        return np.full(worlds.n, -3.5)


def test_drive__an_agent_sees_what_a_learner_sees_from_the_first_decision_on():
    worlds, agent = PAPER.sample(20, 7).worlds, Looking()
    drive(worlds, agent, PAPER, 1)
    engine = Engine(PAPER, 20, learners=(1,), scripts=script_agents(PAPER, except_for=1), worlds=worlds)
    for seen in agent.seen[:3]:
        assert engine.observe(1).tobytes() == seen.tobytes()
        engine.step(np.full((20, 1), -0.5))


def test_drive__a_policy_as_a_role_does_what_it_does_when_it_is_driven():
    def with_roles(**roles):
        return PAPER.replace(early_impacts="keep", roles={"vehicle_1": "full_brake", **roles})

    universal, braking = make_agent("universal@shipped"), make_agent("full_brake")
    driven = with_roles(vehicle_2="learner", vehicle_3="full_brake")
    role = with_roles(vehicle_2="universal@shipped", vehicle_3="learner")
    both = with_roles(vehicle_2="learner", vehicle_3="learner")
    worlds = driven.sample(20, 7).worlds
    harm = drive(worlds, universal, driven, 1).ledger.world_harm("first")
    for episodes in (drive(worlds, braking, role, 2), drive(worlds, Team({1: universal, 2: braking}, "both"), both)):
        assert np.abs(episodes.ledger.world_harm("first") - harm).max() < 1e-9
    assert 0.0 < harm.mean() < drive(worlds, braking, driven, 1).ledger.world_harm("first").mean()


class Swinging:
    """Brakes the harder the later it is: every decision is another command."""

    name = "swinging"

    def act(self, worlds, vehicle):
        return -worlds.vehicles.braking_capacity_mps2[:, vehicle] * (0.3 + 0.6 * np.sin(7.0 * worlds.time_s) ** 2)


def make_swinging(argument, settings):
    return Swinging()


@pytest.fixture
def swinging(monkeypatch):
    """Lines whose first and last vehicle follow a script that decides within the steps of Vehicle 2."""
    monkeypatch.setattr(registry, "_ENTRIES", dict(registry._ENTRIES))
    register_agent("swinging", make_swinging)
    roles = {"vehicle_1": "swinging", "vehicle_2": "learner", "vehicle_3": "swinging"}
    latency = [0.04, 0.5, {"uniform": [0.2, 0.9]}]
    return PAPER.replace(early_impacts="keep", roles=roles, latency_s=latency, gaps_m=4)


def test_drive__shows_every_part_of_a_step_within_which_nobody_decides(swinging):
    class Replay:
        def __init__(self, worlds):
            self.now, self.harm = worlds, np.zeros((worlds.n, 2))

        def see(self, before, command_mps2, until_s):
            assert np.array_equal(before.gaps_m, self.now.gaps_m) or np.allclose(before.gaps_m, self.now.gaps_m)
            self.now, impacts = advance(before, command_mps2, until_s=until_s)
            self.harm += np.stack([impacts.first_impact_harm.sum(axis=1), impacts.total_harm.sum(axis=1)], axis=1)

    worlds = swinging.sample(30, 7).worlds
    replay = Replay(worlds)
    episodes = drive(worlds, make_agent("universal@shipped"), swinging, 1, watched_by=[replay])
    assert np.abs(replay.now.gaps_m - episodes.final.gaps_m).max() < 1e-9
    for k, count in enumerate(("first", "total")):
        assert np.abs(replay.harm[:, k] - episodes.ledger.world_harm(count)).max() < 1e-9
    assert episodes.ledger.world_harm("total").max() > 1.0


def test_record__motion_and_dataset_follow_scripts_that_decide_within_a_step(swinging):
    sample = swinging.sample(4, 7)
    agent = make_agent("constant:3")
    outcome = evaluate(sample, {"it": agent}, scenario=swinging).outcome("it")
    motions = follow_episodes(sample.worlds, agent, swinging)
    task = Task(swinging, 7, RewardParams(), observation_for(swinging))
    recording = record_episodes(sample, agent, "it", task)
    assert outcome.sampled_harm is None  # its samples are the decisions of Vehicle 2 alone
    for k, motion in enumerate(motions):
        record = record_episode(sample.worlds.take([k]), agent, scenario=swinging)
        for impacts in (record.impacts, motion.impacts):
            assert (impacts.closing_speed_mps**2).sum() == pytest.approx(outcome.total_harm[k])
        assert record.gaps_m[-1] == pytest.approx(outcome.final.gaps_m[k])
        last = recording.positions_m[recording.decisions[k], k]
        assert record.positions_m[-1] == pytest.approx(last, abs=1e-6)
        scene = film_scenes(sample.worlds.take([k]), agent, scenario=swinging)[-1]
        assert scene.total_harm == pytest.approx(outcome.total_harm[k])
        assert scene.front_m[0] == pytest.approx(last[0], abs=1e-6)
