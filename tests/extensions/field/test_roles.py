"""A role of a scenario is the same agent as a driver of that vehicle, for agents of this extension, too."""

import pytest

from tests.first_edition.agents.test_roles import SCENARIOS, check_role

SPECS = {"acc": ["acc"], "aeb": ["aeb:ttc=2"], "cacc": ["cacc:T=0.8"], "idm": ["idm:T=1.0"], "r157_fsm": ["r157_fsm"],
         "r157_human": ["r157_human"], "rss": ["rss"]}  # fmt: skip


@pytest.mark.parametrize("kind", SPECS)
@pytest.mark.parametrize("name", SCENARIOS)
def test_role__is_the_same_agent_as_a_driver(name, kind):
    check_role(name, SPECS[kind])
