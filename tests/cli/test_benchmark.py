"""The commands ``benchmark`` and ``leaderboard``, on a suite of two small lists."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ethbrake_marl.limits.limits import search_list
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.studies import benchmark as suites
from tests.docs.site import load

freezing = load("../studies/freeze_suite")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the suite ``small``; not to be changed."""
    lists = []
    for name, count, seed in (("paper-random", "first", 911), ("cooperation-3-pair", "total", 912)):
        scenario = load_scenario(name)
        table = search_list(scenario, scenario.sample(8, seed), counts=(count,), budget=200, threads=1)
        lists.append(freezing.NewList(name, "small", scenario, seed, 8, count, table))
    path = tmp_path_factory.mktemp("suites")
    freezing.freeze_suite("small", lists, path)
    return path


@pytest.fixture
def small(folder, ethbrake, monkeypatch, tmp_path):
    """The commands with the suite ``small``, in an empty folder."""
    monkeypatch.setattr(suites, "SUITES", folder)
    monkeypatch.chdir(tmp_path)
    return ethbrake


def test_entry__is_written_and_printed_list_by_list(small, tmp_path):
    found = small("benchmark", "small", "--agent", "coast", "--output", "coast.json")
    assert found.status == 0 and "entry: coast.json" in found.err
    assert "coast: overall " in found.out and "mean over 2 lists of suite small" in found.out
    assert "paper-random " in found.out and "Worst decile" in found.out
    printed = small("benchmark", "small", "--agent", "coast", "--json")
    assert json.loads(printed.out) == json.loads((tmp_path / "coast.json").read_text())
    again = small("benchmark", "small", "--agent", "coast", "--output", "coast.json")
    assert again.status == 2 and "coast.json: is there already" in again.err


def test_lists_that_are_not_driven__are_said_and_there_is_no_overall_score(small):
    found = small("benchmark", "small", "--agent", "full_brake+episode")
    assert found.status == 0 and "no overall score, as it drives 1 of 2 lists" in found.out
    assert "cooperation-3-pair: " in found.out and "not driven" in found.out


def test_leaderboard__is_a_table_markdown_or_json(small, tmp_path):
    for agent in ("coast", "full_brake"):
        assert small("benchmark", "small", "--agent", agent, "--output", f"{agent}.json").status == 0
    files = ("coast.json", "full_brake.json")
    found = small("benchmark", "table", *files, "--output", "table.md")
    assert found.status == 0 and "full_brake" in found.out
    assert (tmp_path / "table.md").read_text().startswith("|  | Agent | Overall |")
    told = json.loads(small("benchmark", "table", *files, "--json").out)
    assert {entry["agent"] for entry in told["entries"]} == {"coast", "full_brake"}
