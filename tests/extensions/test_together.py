"""What all extensions together give: every agent that is registered stands in a list of the tests."""

from typing import Any

import pytest
from ethbrake_marl.first_edition.agents.registry import agent_names
from tests.first_edition.agents import test_knowledge as core, test_roles as roles

from tests.extensions.certified import test_knowledge as certified, test_roles as certified_roles
from tests.extensions.field import test_knowledge as field, test_roles as field_roles
from tests.extensions.learners import test_branches, test_knowledge as learners, test_roles as learners_roles
from tests.extensions.search import test_knowledge as search, test_roles as search_roles


def test_knowledge__every_agent_of_the_registry_stands_in_a_table():
    stated = core.STATED | certified.STATED | field.STATED | learners.STATED | search.STATED
    missing = core.missing_in(stated, core.USUAL | search.USUAL, core.APART | learners.APART)
    assert not missing, "registered, and in no STATED, so nobody tests whether they are honest"


def test_specs__are_of_every_kind_of_agent():
    every = (roles, certified_roles, field_roles, learners_roles, search_roles)
    assert {kind for each in every for kind in each.SPECS} - {"theirs"} == set(agent_names())


@pytest.mark.parametrize("options", [{"estimated": True}, {"mode": "robust", "uncertainty": "gaps_m=0.5"}], ids=str)
def test_branch__of_a_shield_that_does_not_know_the_line_is_what_the_engine_does(options: dict[str, Any]) -> None:
    test_branches.test_branch__of_what_remembers_is_what_the_engine_does(test_branches.shielded, options)
