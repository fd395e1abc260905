"""Whether the controllers of the field use no more than the messages that they say they know."""

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

STATED = {
    **dict.fromkeys(("idm", "acc", "cacc", "rss", "r157_human", "r157_fsm", "aeb", "idm:T=1.5"), (Source.MESSAGES,)),
    **dict.fromkeys(("acc:T=1.1", "cacc:T=1.0", "rss:rho=1.0", "r157_human:reaction=0.75"), (Source.MESSAGES,)),
    **dict.fromkeys(("r157_fsm:reaction=0.75", "aeb:ttc=1.5"), (Source.MESSAGES,)),
}
HONEST, _ = in_two(STATED)


@pytest.mark.parametrize(("spec", "knows"), STATED.items())
def test_knowledge__every_agent_states_it(spec, knows):
    check_stated(spec, agent_of(spec), knows)


@pytest.mark.parametrize(("spec", "channel"), with_channels(HONEST), ids=str)
def test_own_sensors_and_messages__what_was_not_received_changes_no_action(spec, channel):
    scenario = BLOCKED.replace(v2x=channel)
    assert changed_decisions(agent_of(spec, scenario), scenario, n=10) == 0
