"""Agents that look ahead know the scripts of the others."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.agents.rollout import drive, script_agents
from ethbrake_marl.agents.team import Team
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.envs.setup import make_engine
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.observations import observation_for, observe
from ethbrake_marl.scenario import load_scenario
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
    realised = harm(agent, scenario, worlds)
    np.testing.assert_allclose(realised, agent.predicted_harm, atol=1e-6)
    for deceleration in np.linspace(0.0, 7.0, 15):
        assert (realised <= harm(make_agent(f"constant:{deceleration}"), scenario, worlds) + 1e-6).all()


def test_e_v2x_bm__full_braking_of_the_others_is_the_papers_case():
    worlds = PAPER.sample(40, 7).worlds
    told, alone = make_agent("e_v2x_bm"), make_agent("e_v2x_bm")
    drive(worlds, told, PAPER, 1)
    alone.begin(worlds, 1, np.arange(40))
    assert sorted(told.others) == [0, 2] and not alone.others
    assert told.deceleration_mps2.tolist() == alone.deceleration_mps2.tolist()


def test_e_v2x_bm__knows_who_drives_in_the_engines_of_all_interfaces():
    scenario = PAPER.replace(
        roles={"vehicle_1": "full_brake", "vehicle_2": "e_v2x_bm", "vehicle_3": "constant:3"}, early_impacts="keep"
    )
    scripts = script_agents(scenario)
    assert scripts[1].others == {0: scripts[0], 2: scripts[2]}


class Steering:
    """Brakes by what it sees: nobody can look ahead through it."""

    name = "steering"

    def begin(self, worlds, vehicle, rows):
        pass

    def act(self, worlds, vehicle):
        return -3.0 / (1.0 + worlds.gaps_m[:, vehicle - 1])


def test_e_v2x_bm__refuses_others_whose_command_is_not_fixed():
    worlds = PAPER.sample(2, 7).worlds
    agent = make_agent("e_v2x_bm")
    agent.others = {2: Steering()}
    with pytest.raises(InvalidInput, match="vehicle_3 is driven by 'steering', whose command is not fixed"):
        agent.begin(worlds, 1, np.arange(2))


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
    realised = harm(hybrid, scenario, worlds)
    assert realised.tolist() == hybrid.predicted_harm.tolist()
    best = harm(make_agent("e_v2x_bm"), scenario, worlds)
    np.testing.assert_allclose(hybrid.bound_harm, best, atol=1e-9)


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
    for episodes in (
        drive(worlds, braking, role, 2),
        drive(worlds, Team({1: universal, 2: braking}, "both"), both),
    ):
        assert np.abs(episodes.ledger.world_harm("first") - harm).max() < 1e-9
    assert 0.0 < harm.mean() < drive(worlds, braking, driven, 1).ledger.world_harm("first").mean()
