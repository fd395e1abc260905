"""An agent around an agent hands on what it does not change."""

from __future__ import annotations

from ethbrake_marl.agents.planner import Refined
from ethbrake_marl.agents.registry import AgentAround, Knowledge, Source, drive, make_agent
from ethbrake_marl.scenario import load_scenario
from tests.fixtures.asked import Asked

SCENARIO = load_scenario("paper-random")


def test_around__drives_knows_and_is_called_as_the_agent_inside():
    worlds = SCENARIO.sample(20, 2).worlds
    alone, around = (
        Asked(agent).begin(worlds, 1) for agent in (make_agent("e_v2x_bm"), AgentAround(make_agent("e_v2x_bm")))
    )
    assert around.act(worlds, 1).tolist() == alone.act(worlds, 1).tolist()
    assert (around.name, Knowledge.of(around.agent)) == ("e_v2x_bm", (Source.MODEL,))


def test_refined__a_planner_is_told_the_others_scripts_while_it_searches():
    scenario = SCENARIO.replace(roles={"vehicle_1": "constant:3", "vehicle_2": "learner", "vehicle_3": "coast"})
    worlds = scenario.sample(6, 4).worlds
    agent = Refined(make_agent("planner:8", scenario=scenario), scenario, tries=1, rounds=1)
    episodes = drive(worlds, agent, scenario, 1)
    assert episodes.ledger.world_harm("first").tolist() == episodes.memories[1]["predicted_harm"].tolist()
