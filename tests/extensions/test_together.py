"""What all extensions together give: every agent that is registered stands in a list of the tests."""

import runpy
from typing import Any

import pytest

from ethbrake_marl.agents.registry import agent_entries, agent_names
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.extensions.field.controllers import FIELD
from ethbrake_marl.policies.shipped import shipped_policies
from tests.agents import test_knowledge as core, test_roles as roles
from tests.cli.test_scenarios import SCRIPTS
from tests.extensions.certified import test_knowledge as certified, test_roles as certified_roles
from tests.extensions.field import test_knowledge as field, test_roles as field_roles
from tests.extensions.learners import test_branches, test_knowledge as learners, test_roles as learners_roles
from tests.extensions.search import test_knowledge as search, test_roles as search_roles
from tests.fixtures.commands import Command, told_json


def test_knowledge__every_agent_of_the_registry_stands_in_a_table():
    stated = core.STATED | certified.STATED | field.STATED | learners.STATED | search.STATED
    missing = core.missing_in(stated, core.USUAL | search.USUAL, core.APART | learners.APART)
    assert not missing, "registered, and in no STATED, so nobody tests whether they are honest"


def test_agent_names__are_those_that_ship_and_are_listed(capsys):
    scripts = ("coast", "constant", "e_v2x_bm", "full_brake")
    learned = ("ppo", "sac", "vine", "rollout-classification", "policy", "universal", "team")
    names = (*scripts, *FIELD, "best_harm", *learned)
    names = (*names, *(name for name in shipped_policies() if name not in names))
    assert agent_names() == tuple(sorted(names)) and run_command(["agent", "list"]) == 0
    table = capsys.readouterr().out
    assert [name for name in (*names, "+search", "+episode", "+step", "+robust") if name not in table] == []
    assert all(callable(entry.make) and entry.about and entry.knows for entry in agent_entries())


def test_specs__are_of_every_kind_of_agent():
    every = (roles, certified_roles, field_roles, learners_roles, search_roles)
    assert {kind for each in every for kind in each.SPECS} - {"theirs"} == set(agent_names())


def test_validate__tells_which_agents_and_shields_refuse_a_script(ethbrake: Command, scenario_file, tmp_path) -> None:
    (tmp_path / "scripts.py").write_text(SCRIPTS)
    runpy.run_path(str(tmp_path / "scripts.py"))

    def refused_by(script: str) -> set[str]:
        path = scenario_file("\n  vehicle_3: full_brake\n", f"\n  vehicle_3: {script}\n")
        path.write_text(path.read_text().replace("early_impacts: reject", "early_impacts: keep"))
        return set(told_json(ethbrake("scenario", "validate", path, "--json"))["refused_by"])

    assert {"e_v2x_bm", "best_harm", "+step"} < refused_by("own_calm")
    assert refused_by("own_fixed") == {"early_impacts: reject"}


@pytest.mark.parametrize("options", [{"estimated": True}, {"mode": "robust", "uncertainty": "gaps_m=0.5"}], ids=str)
def test_branch__of_a_shield_that_does_not_know_the_line_is_what_the_engine_does(options: dict[str, Any]) -> None:
    test_branches.test_branch__of_what_remembers_is_what_the_engine_does(test_branches.shielded, options)
