"""What searching agents say they know, and whether they say no more than they need."""

import pytest

from ethbrake_marl.first_edition.agents.protocol import Source
from tests.first_edition.agents.test_knowledge import BLOCKED, agent_of, changed_decisions, check_stated, in_two

MESSAGES, MODEL = Source.MESSAGES, Source.MODEL
STATED = {
    "best_harm:20": (MODEL,),
    "ppo+search+episode": (MESSAGES, MODEL),
    "ppo+search+step": (MESSAGES, MODEL),
    "ppo+search": (MESSAGES, MODEL),
}
USUAL = {"best_harm": "best_harm:20"}  # budgets
_, SEEING = in_two(STATED)


@pytest.mark.parametrize(("spec", "knows"), STATED.items())
def test_knowledge__every_agent_states_it(spec, knows):
    check_stated(spec, agent_of(spec), knows)


@pytest.mark.parametrize("spec", SEEING)
def test_true_state_and_model__is_not_said_without_need(spec):
    scenario = BLOCKED.replace(v2x={"preset": "paper", "hears": "front"})
    assert changed_decisions(agent_of(spec, scenario), scenario, vehicle=1, decisions=1, n=4) > 0
