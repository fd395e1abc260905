"""A role of a scenario is the same agent as a driver of that vehicle, for agents of this extension, too."""

import pytest

from tests.first_edition.agents.test_roles import SCENARIOS, check_nothing_around, check_role

SPECS = {"best_harm": ["best_harm:50", "best_harm"]}


@pytest.mark.parametrize("kind", SPECS)
@pytest.mark.parametrize("name", SCENARIOS)
def test_role__is_the_same_agent_as_a_driver(name, kind):
    check_role(name, SPECS[kind])


@pytest.mark.parametrize("around", ["+search", "+episode", "+step"])
def test_role__has_nothing_around_it(around):
    check_nothing_around("best_harm:8", around)
