"""Regret: the best known harm of each world, what is proven beside it, and the distance of an agent from both."""

from __future__ import annotations

import csv
import io
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.errors import IncompleteTable
from ethbrake_marl.evaluation import Evaluation, Outcome, evaluate, measures, summarise, write_per_world
from ethbrake_marl.evaluation.measures import Between, SummaryTable, proven_of_table, shipped_bounds
from ethbrake_marl.harm import Ledger
from ethbrake_marl.limits import limits as limits_module
from ethbrake_marl.limits.limits import BestHarmTable, Unproven, known_limits, shipped_tables, unproven_because
from ethbrake_marl.physics import Worlds
from ethbrake_marl.physics.batch import Impacts
from ethbrake_marl.scenario import Scenario, Task, load_scenario

BRAKE = {"full_brake": make_agent("full_brake")}
SILENT = pytest.mark.filterwarnings("ignore::ethbrake_marl.errors.IncompleteTable")

# Four worlds by hand: the first is avoidable, the second is in the table, in the third the agent is below the table,
# the fourth is in no table.
AVOIDABLE = np.array([True, False, False, False])
REASON = np.array(["", "front", "rear", "rear"])
PROVEN = np.array([0.0, 1.5, 0.0, 5.0])  # in the third world, contact is unavoidable and no impact proven
TABLE = {"first": np.array([0.5, 2.0, 4.0, np.nan]), "total": np.array([0.5, 3.0, 5.0, np.nan])}
FULL = ([10.0, 10.0, 10.0, 10.0], [12.0, 12.0, 12.0, 12.0])
AGENT = ([1.0, 4.0, 3.0, 6.0], [1.0, 4.0, 5.0, 7.0])
NULLS = {
    "unavoidable_rate", "impact_proven_rate", "avoidable_collision_rate", "best_known_first_impact_harm",
    "best_known_total_harm", "proven_harm", "best_known_minus_proven_first", "best_known_minus_proven_total",
    "mean_regret", "mean_regret_first", "mean_regret_total", "realised_share", "realised_share_first",
    "realised_share_total", "known_best_share", "below_best_known",
}  # fmt: skip


def outcome(evaluation: Evaluation, harms: tuple[list[float], list[float]], n: int) -> Outcome:
    """An outcome with these first-impact and total harms, all of the front pair."""
    first, total = (np.column_stack([harm[:n], np.zeros(n)]) for harm in harms)
    final = evaluation.worlds.take(np.arange(n))
    count = (total > 0.0).astype(np.int64)
    ledger = Ledger(first, total, count, *Impacts.no_obstacle(n), final.vehicles.mass_t)
    return Outcome(ledger, final, np.ones(n, np.bool_), None, None)


def first_worlds(evaluation: Evaluation, n: int, **harms: tuple[list[float], list[float]]) -> Evaluation:
    outcomes = {name: outcome(evaluation, each, n) for name, each in harms.items()}
    rows = np.arange(n)
    return Evaluation(evaluation.scenario, (1,), evaluation.worlds.take(rows), rows, 7, outcomes)


@pytest.fixture
def four(evaluation: Evaluation, monkeypatch: pytest.MonkeyPatch) -> Evaluation:
    """An evaluation of full_brake and another agent in the four worlds."""

    def bound(worlds: Worlds, vehicle: int, **settings: Any) -> SimpleNamespace:
        contact = SimpleNamespace(avoidable=AVOIDABLE[: worlds.n], reason_name=REASON[: worlds.n])
        return SimpleNamespace(harm=PROVEN[: worlds.n], contact=contact)

    def best(worlds: Worlds, task: Task) -> dict[str, np.ndarray]:
        return {count: harm[: worlds.n] for count, harm in TABLE.items()}

    monkeypatch.setattr(limits_module, "lower_bound", bound)
    monkeypatch.setattr(limits_module, "best_known", best)
    return first_worlds(evaluation, 4, full_brake=FULL, a=AGENT)


def per_world(result: Evaluation, folder: Path) -> dict[str, list[str]]:
    """The columns of the file of one row per agent and world."""
    write_per_world(folder / "out.csv", result)
    lines = list(csv.DictReader(io.StringIO((folder / "out.csv").read_text())))
    return {name: [line[name] for line in lines] for name in lines[0]}


# ---------------------------------------------------------------- four worlds by hand


@SILENT
def test_best_known__is_the_witness_the_table_or_an_agent(four: Evaluation, tmp_path: Path) -> None:
    found, agent, full = four.regrets, four.outcome("a"), four.outcome("full_brake")
    assert found.limits.known.tolist() == [True, True, True, False]
    assert found.regret(full, "total").tolist() == [12.0, 9.0, 7.0, 5.0]
    assert found.below(agent).tolist() == [False, False, True, False]
    columns = per_world(four, tmp_path)
    expected = {
        "avoidable": ["1", "0", "0", "0"],
        "unavoidable_reason": ["", "front", "rear", "rear"],
        "best_known_first_impact_harm": ["0.0", "2.0", "3.0", "6.0"],
        "best_known_total_harm": ["0.0", "3.0", "5.0", "7.0"],
        "impact_proven": ["0", "1", "0", "1"],
        "proven_harm": ["0.0", "1.5", "0.0", "5.0"],
        "best_known_source": ["witness", "table", "below_table", "agents"],
        "regret_first_impact_harm": ["1.0", "2.0", "0.0", "0.0"],
        "regret_total_harm": ["1.0", "1.0", "0.0", "0.0"],
    }
    assert {name: columns[name][4:] for name in expected} == expected


@SILENT
def test_best_known__rounding_below_the_table_is_not_below_it(four: Evaluation) -> None:
    close = first_worlds(four, 4, a=([1.0, 2.0 - 9e-7, 4.0 - 2e-6, 6.0], [1.0, 4.0, 6.0, 7.0]))
    found = close.regrets
    assert found.below(close.outcome("a")).tolist() == [False, False, True, False]
    assert found.source.tolist() == ["witness", "table", "below_table", "agents"]
    assert (found.regret(close.outcome("a"), "first") >= 0.0).all()


def test_distance__by_hand(four: Evaluation) -> None:
    (_, found) = summarise(first_worlds(four, 3, full_brake=FULL, a=AGENT))
    expected = {
        "realised_share_first": (30.0 - 8.0) / (30.0 - 5.0),
        "realised_share_total": (36.0 - 10.0) / (36.0 - 8.0),
        "mean_regret_first": 1.0,
        "mean_regret_total": 2.0 / 3.0,
        "unavoidable_rate": 2.0 / 3.0,
        "avoidable_collision_rate": 1.0 / 3.0,
        "impact_proven_rate": 1.0 / 3.0,
        "proven_harm": 0.5,
        "best_known_minus_proven_first": (0.0 + 0.5 + 3.0) / 3.0,
        "best_known_minus_proven_total": (0.0 + 1.5 + 5.0) / 3.0,
    }
    assert {name: found[name].value for name in expected} == pytest.approx(expected, rel=1e-12)
    assert (found.known_best_share, found.below_best_known) == (1.0, 1)
    (alone,) = summarise(first_worlds(four, 3, a=AGENT))  # without full braking nothing is realised
    assert alone["realised_share_first"] is alone["realised_share_total"] is None
    assert alone["mean_regret_first"].value == 1.0


def test_distance__a_best_that_is_not_known_everywhere_realises_nothing(four: Evaluation) -> None:
    with pytest.warns(IncompleteTable, match=r"holds 2 of these 4 worlds, and not the other 1 \(25.0 %\)"):
        full, agent = (row.to_json() for row in summarise(four))
    assert "(25.0 %)" in agent["best_known_warning"] and agent["best_known_warning"] == full["best_known_warning"]
    assert agent["known_best_share"] == full["known_best_share"] == 0.75
    assert agent["realised_share"] is agent["realised_share_total"] is None
    assert (agent["mean_regret"], agent["mean_regret_first"], agent["mean_regret_total"]) == (0.75, 0.75, 0.5)
    assert full["mean_regret"] == (10.0 + 8.0 + 7.0 + 4.0) / 4.0
    assert (full["below_best_known"], agent["below_best_known"]) == (0, 1)
    table = summarise(four).markdown()
    assert "WARNING: the table of best known harm holds 2 of these 4 worlds" in table and "≥ 0.75" in table
    assert (
        "Found beforehand in 75.0 % of the worlds" in table
        and "Less harm than the best known before: a in 1 world." in table
    )


# ---------------------------------------------------------------- lists with and without limits


@pytest.mark.parametrize(("seeds", "share"), [((7,), 1.0), ((4711,), None), ((7, 4711), None)])
def test_limits__of_a_list_longer_than_its_table_are_told_in_a_warning_and_of_no_table_are_not(
    seeds: tuple[int, ...], share: float | None, paper_random: Scenario
) -> None:
    worlds, partly = Worlds.concatenate([paper_random.sample(8, seed).worlds for seed in seeds]), len(seeds) > 1
    found = evaluate(worlds, BRAKE, scenario=paper_random, aftermath=False)
    with pytest.warns(IncompleteTable) if partly else nullcontext():
        (row,) = summarise(found)
    assert (row.known_best_share == 1.0) == (share == 1.0)
    assert (row.to_json()["best_known_warning"] is not None) == (row.warning != "") == partly
    for text in (SummaryTable([row]).markdown(), SummaryTable([row])._repr_html_()):
        assert ("WARNING" in text) == partly


LINE = load_scenario("paper-random")


@pytest.mark.parametrize(
    ("scenario", "vehicle", "reason"),
    [
        (LINE.replace(roles={"vehicle_1": "coast", "vehicle_2": "learner", "vehicle_3": "full_brake"}), 1,
         "vehicle_1 follows coast"),
        (LINE.with_learners([2]), 2, "vehicle_3 is driven"),
        (LINE.replace(latency_s=[0.6, 0.5, 0.8]), 1, "vehicle_1 may brake later than vehicle_2"),
        (load_scenario("paper-random-obstacle").replace(obstacle_gap_m=30.0), 1,
         "vehicle_1 reaches the obstacle ahead by itself; nothing is proven then"),
        (LINE, 1, None),
    ],
)  # fmt: skip
def test_limits__do_not_apply_to_other_scripts_vehicles_and_latencies(
    scenario: Scenario, vehicle: int, reason: str | None
) -> None:
    worlds, task = scenario.sample(50, 7).worlds, Task(scenario, (vehicle,))
    found = unproven_because(worlds, task)
    assert found is None if reason is None else found is not None and reason in found
    assert isinstance(known_limits(worlds, task), Unproven) == (reason is not None)


def test_limits__an_obstacle_out_of_vehicle_1_s_own_reach_leaves_avoidability_and_a_least_harm(tmp_path: Path) -> None:
    scenarios = [load_scenario(name) for name in ("paper-random-obstacle", "paper-random")]
    results = [evaluate(each.sample(50, 7), BRAKE, scenario=each, seed=7) for each in scenarios]
    row, other = (summarise(each)[0].to_json() for each in results)
    assert all(row[name] == other[name] > 0.0 for name in ("unavoidable_rate", "impact_proven_rate"))
    assert 0.0 < row["proven_harm"] <= row["best_known_first_impact_harm"] <= row["best_known_total_harm"]
    assert row["mean_regret"] is not None and row["parameters"]["no_limits_because"] is None
    assert f"proven: no less than {row['proven_harm']:.2f}" in summarise(results[0]).markdown()
    columns = per_world(results[0], tmp_path)
    proven, best = (np.array(columns[name], float) for name in ("proven_harm", "best_known_first_impact_harm"))
    assert proven.mean() == pytest.approx(row["proven_harm"]) and (proven <= best + 1e-9).all()
    assert set(columns["avoidable"]) == {"0", "1"}


def test_limits__of_another_line_up_are_null_with_the_reason(pair: Scenario, tmp_path: Path) -> None:
    result = evaluate(pair.sample(2, 0), BRAKE, scenario=pair)
    row = summarise(result)[0].to_json()
    assert {row[name] for name in NULLS} == {None} and row["mean_regret_interval"] is None
    assert row["parameters"]["no_limits_because"] == "2 vehicles; avoidability is proven for 3"
    columns = per_world(result, tmp_path)
    assert columns["avoidable"] == columns["regret_total_harm"] == columns["best_known_source"] == ["", ""]
    assert result.regrets is None and "proven" not in summarise(result).markdown()


@pytest.mark.parametrize(("name", "unavoidable"), [("paper-random", 309), ("paper-random-early", 272)])
def test_limits__of_the_first_500_worlds_of_the_papers_random_test(name: str, unavoidable: int) -> None:
    scenario = load_scenario(name)
    agents = {spec: make_agent(spec) for spec in ("full_brake", "e_v2x_bm")}
    result = evaluate(scenario.sample(500, 7), agents, scenario=scenario, seed=7, aftermath=False)
    proof, rows = result.regrets.limits.proof, summarise(result)
    assert [row["unavoidable_rate"].value for row in rows] == [unavoidable / 500] * 2
    for driven in result.outcomes.values():
        assert driven.collided[proof.impact].all()  # nobody avoids what is proven
        assert (driven.first_impact_harm >= proof.harm - 1e-9).all()
    full, best = (row["avoidable_collision_rate"].value for row in rows)
    assert best < 0.02 < full


# ---------------------------------------------------------------- proven and best known harm beside each other


def shipped(name: str, **header: Any) -> BestHarmTable:
    (table,) = (table for table in shipped_tables() if table.header["scenario"] == name)
    return replace(table, header={**table.header, **header})


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
    proven, inside = found["proven"], found["proven"]["between"]
    assert (found["worlds"], found["list_seed"]) == (5000, 7)
    assert (found["gap_first"], found["gap_total"]) == pytest.approx((0.057, 0.122), abs=5e-4)
    assert proven["contact_proven_rate"] - proven["impact_proven_rate"] == pytest.approx(inside["rate"])
    assert inside["mean_first"] > 0.9 and inside["harmless_rate"] < 0.55  # nobody leans there
    (_, _, line) = sheet.markdown().splitlines()
    assert "| 5.7 % |" in line and "| 12.2 % |" in line
    (leaning,), _ = shipped_bounds([shipped("paper-delay-low", episodes=1000)])
    assert leaning["proven"]["between"]["mean_first"] < 0.03  # in the paper's lists leaning explains what is between


def test_shipped__every_table_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    names = [table.header["scenario"] for table in shipped_tables()]
    few = [replace(table, header={**table.header, "episodes": 20}) for table in shipped_tables()]
    monkeypatch.setattr(measures, "shipped_tables", lambda: few)
    found, sheet = shipped_bounds()
    assert [one["scenario"] for one in found] == names and len(sheet.markdown().splitlines()) == 2 + len(found)


def test_shipped__where_nothing_is_proven_the_reason_stands_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measures, "unproven_because", lambda *_: "an obstacle stands ahead of vehicle_1")
    (found,), sheet = shipped_bounds([shipped("paper-delay-low", episodes=5)])
    assert found["proven"] is None and found["gap_first"] is None
    assert "an obstacle stands ahead" in sheet.markdown().splitlines()[2]


def test_proven__of_a_table_leaves_out_what_cannot_be_advanced() -> None:
    scenario, table = load_scenario("paper-delay-low"), shipped("paper-delay-low")
    worlds, task = scenario.sample(6, 7).worlds, Task(scenario, (1,))
    whole = proven_of_table(worlds.take([0, 1, 3, 4, 5]), task, table)
    worlds.gaps_m[2], worlds.speeds_mps[2] = [0.2, -1.0], [10.0, 20.0, 16.0]
    assert whole is not None and proven_of_table(worlds, task, table) == whole
