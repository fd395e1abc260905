"""A role of a scenario is the same agent as a driver of that vehicle, for agents of this extension, too."""

import pytest

from tests.first_edition.agents.test_roles import SCENARIOS, check_role

SPECS = {"vine": ["vine@mine"], "rollout-classification": ["rollout-classification@mine"]}


@pytest.mark.parametrize("kind", SPECS)
@pytest.mark.parametrize("name", SCENARIOS)
def test_role__is_the_same_agent_as_a_driver(name, kind):
    check_role(name, SPECS[kind])
