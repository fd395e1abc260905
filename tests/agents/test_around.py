"""An agent around an agent hands on what it does not change."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.agents.protocol import AgentAround, Source, is_divisible, knowledge_of
from ethbrake_marl.agents.refined import Refined
from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.agents.rollout import drive
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.policies.shipped import load_named_policy
from ethbrake_marl.scenario import load_scenario

SCENARIO = load_scenario("paper-random")


def test_around__drives_knows_and_is_called_as_the_agent_inside():
    worlds = SCENARIO.sample(20, 2).worlds
    alone, around = make_agent("e_v2x_bm"), AgentAround(make_agent("e_v2x_bm"))
    for agent in (alone, around):
        agent.begin(worlds, 1, np.arange(20))
    assert around.act(worlds, 1).tolist() == alone.act(worlds, 1).tolist()
    assert (around.name, knowledge_of(around)) == ("e_v2x_bm", (Source.MODEL,))


def test_refined__a_planner_is_told_the_others_scripts_while_it_searches():
    scenario = SCENARIO.replace(roles={"vehicle_1": "constant:3", "vehicle_2": "learner", "vehicle_3": "coast"})
    worlds = scenario.sample(6, 4).worlds
    agent = Refined(make_agent("planner:8", scenario=scenario), scenario, tries=1, rounds=1)
    harm = drive(worlds, agent, scenario, 1).ledger.world_harm("first")
    assert harm.tolist() == agent.predicted_harm.tolist()


def test_take__goes_on_apart_only_where_both_can():
    policy = LearnedAgent(load_named_policy("shipped"))
    assert is_divisible(policy) and is_divisible(Refined(policy, SCENARIO))
    for agent in (AgentAround(policy), Refined(make_agent("full_brake"), SCENARIO)):
        assert not is_divisible(agent)
        with pytest.raises(InvalidInput, match=r"has no take\(rows\)"):
            agent.take(np.array([0]))
