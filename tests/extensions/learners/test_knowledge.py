"""Whether policies that these algorithms train use no more than the messages that they say they know."""

import pytest

from ethbrake_marl.first_edition.agents.protocol import Source
from tests.first_edition.agents.test_knowledge import (
    BLOCKED,
    agent_of,
    changed_decisions,
    check_stated,
    in_two,
    with_channels,
)

STATED = {"rollout-obstacle": (Source.MESSAGES,)}
APART = {"vine@PATH", "rollout-classification@PATH"}  # they need a run, and have tests of their own
HONEST, _ = in_two(STATED)


@pytest.mark.parametrize(("spec", "knows"), STATED.items())
def test_knowledge__every_agent_states_it(spec, knows):
    check_stated(spec, agent_of(spec), knows)


@pytest.mark.parametrize(("spec", "channel"), with_channels(HONEST), ids=str)
def test_own_sensors_and_messages__what_was_not_received_changes_no_action(spec, channel):
    scenario = BLOCKED.replace(v2x=channel)
    assert changed_decisions(agent_of(spec, scenario), scenario, n=10) == 0
