"""Proven and best known harm beside each other, and the worlds between proven contact and proven impact."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from ethbrake_marl.evaluation import measures
from ethbrake_marl.evaluation.measures import Between, proven_of_table, shipped_bounds
from ethbrake_marl.limits.limits import BestHarmTable, shipped_tables
from ethbrake_marl.scenario import Task, load_scenario


def shipped(name: str) -> BestHarmTable:
    (table,) = (table for table in shipped_tables() if table.header["scenario"] == name)
    return table


def test_between__by_hand() -> None:
    nan = np.nan
    contact, impact = np.array([0, 1, 1, 1, 1], bool), np.array([0, 1, 0, 0, 0], bool)
    first, total = np.array([0, 9, 1e-4, 6, nan]), np.array([0, 9, 2e-4, 8, nan])
    found = Between.of(contact, impact, first, total)
    assert (found.rate, found.harmless_rate) == (0.6, 0.5)
    assert (found.mean_first, found.mean_total) == pytest.approx((3.00005, 4.0001))
    nobody = Between.of(contact, contact, first, total)
    assert (nobody.rate, nobody.mean_first, nobody.harmless_rate) == (0.0, None, None)


def test_shipped__stress_wide_has_a_loose_proof_and_says_so() -> None:
    (found,), sheet = shipped_bounds([shipped("stress-wide")])
    assert (found["worlds"], found["list_seed"]) == (5000, 7)
    assert found["gap_first"] == pytest.approx(0.057, abs=5e-4)
    assert found["gap_total"] == pytest.approx(0.122, abs=5e-4)
    proven = found["proven"]
    inside = proven["between"]
    assert proven["contact_proven_rate"] - proven["impact_proven_rate"] == pytest.approx(inside["rate"])
    assert inside["mean_first"] > 0.9  # nobody leans there
    assert inside["harmless_rate"] < 0.55
    (_, _, line) = sheet.markdown().splitlines()
    assert "| 5.7 % |" in line and "| 12.2 % |" in line
    assert json.loads(json.dumps(found))["proven"]["between"]["rate"] == inside["rate"]


def test_shipped__in_the_papers_lists_leaning_explains_what_is_between() -> None:
    (found,), _ = shipped_bounds([shipped("paper-delay-low")])
    assert found["proven"]["between"]["mean_first"] < 0.03


def test_shipped__every_table_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    few = [replace_header(table, episodes=20) for table in shipped_tables()]
    monkeypatch.setattr(measures, "shipped_tables", lambda: few)
    found, sheet = shipped_bounds()
    assert [one["scenario"] for one in found] == [table.header["scenario"] for table in shipped_tables()]
    assert len(sheet.markdown().splitlines()) == 2 + len(found)


def replace_header(table: BestHarmTable, **changes: object) -> BestHarmTable:
    return replace(table, header={**table.header, **changes})


def test_shipped__where_nothing_is_proven_the_reason_stands_there(monkeypatch: pytest.MonkeyPatch) -> None:
    table = replace_header(shipped("paper-delay-low"), episodes=5)
    monkeypatch.setattr(measures, "unproven_because", lambda *_: "an obstacle stands ahead of vehicle_1")
    (found,), sheet = shipped_bounds([table])
    assert found["proven"] is None and found["gap_first"] is None
    assert "an obstacle stands ahead" in sheet.markdown().splitlines()[2]


def test_proven__of_a_table_leaves_out_what_cannot_be_advanced() -> None:
    scenario, table = load_scenario("paper-delay-low"), shipped("paper-delay-low")
    worlds, task = scenario.sample(6, 7).worlds, Task(scenario, (1,))
    whole = proven_of_table(worlds.take([0, 1, 3, 4, 5]), task, table)
    worlds.gaps_m[2], worlds.speeds_mps[2] = [0.2, -1.0], [10.0, 20.0, 16.0]
    assert whole is not None and proven_of_table(worlds, task, table) == whole
