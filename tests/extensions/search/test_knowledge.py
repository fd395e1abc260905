"""What searching agents say they know, and whether they say no more than they need."""

import pytest

from ethbrake_marl.agents.making import make_agent
from ethbrake_marl.agents.protocol import Source
from tests.agents.test_knowledge import BLOCKED, agent_of, changed_decisions, check_stated, in_two, with_channels
from tests.extensions.certified.test_knowledge import LINES, drives_each_world_alone, line_of

MESSAGES, ESTIMATES, MODEL = Source.MESSAGES, Source.ESTIMATES, Source.MODEL
STATED = {
    "planner:20": (MODEL,),
    "best_harm:20": (MODEL,),
    "planner:20:estimated": (ESTIMATES,),
    "ppo+search+episode": (MESSAGES, MODEL),
    "ppo+search+step": (MESSAGES, MODEL),
    "ppo+search": (MESSAGES, MODEL),
}
USUAL = {"planner": "planner:20", "planner:estimated": "planner:20:estimated", "best_harm": "best_harm:20"}  # budgets
HONEST, SEEING = in_two(STATED)


@pytest.mark.parametrize(("spec", "knows"), STATED.items())
def test_knowledge__every_agent_states_it(spec, knows):
    check_stated(spec, agent_of(spec), knows)


@pytest.mark.parametrize(("spec", "channel"), with_channels(HONEST), ids=str)
def test_own_sensors_and_messages__what_was_not_received_changes_no_action(spec, channel):
    scenario = BLOCKED.replace(v2x=channel)
    assert changed_decisions(agent_of(spec, scenario), scenario, n=10) == 0


@pytest.mark.parametrize("spec", SEEING)
def test_true_state_and_model__is_not_said_without_need(spec):
    scenario = BLOCKED.replace(v2x={"preset": "paper", "hears": "front"})
    assert changed_decisions(agent_of(spec, scenario), scenario, vehicle=1, decisions=1, n=4) > 0


@pytest.mark.parametrize(("vehicles", "v2x"), LINES)
def test_estimating__drives_every_line_and_no_world_depends_on_the_batch(vehicles: int, v2x: object) -> None:
    scenario = line_of(vehicles, v2x)
    drives_each_world_alone(make_agent("planner:8:estimated", scenario=scenario), scenario)
