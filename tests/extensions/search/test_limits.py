"""What is proven and best known, beside the harm of an evaluation: regret, tables, and lists too long for a proof."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.extensions.search import limits, regret
from ethbrake_marl.extensions.search.limit_measures import LIMITS
from ethbrake_marl.extensions.search.limits import IncompleteTable, Unproven, known_limits, prove, unproven_because
from ethbrake_marl.extensions.search.regret import KNOWN_OF_WORLDS, Between, limits_of, regrets_of
from ethbrake_marl.extensions.search.shipped import shipped_tables
from ethbrake_marl.extensions.search.tables import BestHarmTable
from ethbrake_marl.first_edition.evaluation.chunks import Lineup
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.measure_sets import measures
from ethbrake_marl.first_edition.evaluation.outcome import Outcome
from ethbrake_marl.first_edition.evaluation.rollout import chunks_of, drive_chunk, evaluate
from ethbrake_marl.first_edition.evaluation.summary import summarise
from ethbrake_marl.first_edition.evaluation.tally import Tally
from ethbrake_marl.first_edition.game.harm import Ledger
from ethbrake_marl.first_edition.physics.left_out import Impacts
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.scenario.task import Task
from tests.docs.site import load
from tests.first_edition.evaluation.test_measures import ALWAYS, per_world
from tests.first_edition.evaluation.test_rollout import AGENTS, in_both_ways
from tests.first_edition.learning.test_runs import check_measured
from tests.first_edition.scenario.test_roads import final

RECORDED_AGENTS = ("full_brake", "e_v2x_bm", "e_v2x_bm:pairwise")


# SHA-256 of the tally of 1,200 worlds of seed 11, its first 16 digits, by the code of 20 November 2026 (6d87c15);
# `stress-wide` and `realistic-mixed` on worlds that are the same on every processor.
RECORDED = {
    ("paper-random", "first"): "5ae559be31df8505",
    ("paper-random", "total"): "29b0ca9c08a04ae9",
    ("stress-wide", "first"): "22b5e762e6c951d0",
    ("stress-wide", "total"): "4664512f66236619",
    ("cooperation-2-five", "first"): "1922c828a6f1ea16",
    ("cooperation-2-five", "total"): "e9edef37a4098d2f",
    ("paper-random-obstacle", "first"): "e7a03a0982bc18ea",
    ("paper-random-obstacle", "total"): "10f6acd3dcfedde5",
    ("realistic-mixed", "first"): "1ae5e4977847725f",
    ("realistic-mixed", "total"): "616b5cb07da1c8d6",
}


# Of the first 250 of them, by code that gives the digests above.
FIRST_250 = {
    ("paper-random", "first"): "f306298691aca961",
    ("stress-wide", "total"): "6f54af14b777f89e",
    ("cooperation-2-five", "first"): "26c835879bdcb2a3",
    ("paper-random-obstacle", "total"): "8a39f7348bd5252a",
    ("realistic-mixed", "first"): "21ef20f79df3a8cf",
}


# Measures by the names that sums had then.
NAMES = {
    "collision_rate": "collisions", "vehicle_1_shoved_far_rate": "shoved_far", "unavoidable_rate": "unavoidable",
    "avoidable_collision_rate": "avoidable_collisions", "impact_proven_rate": "impact_proven",
    "vehicle_1_shoved_m": "shoved_m", "mean_regret_first": "regret_first", "mean_regret_total": "regret_total",
    "best_known_first_impact_harm": "best_known_first", "best_known_total_harm": "best_known_total",
    "best_known_minus_proven_first": "gap_first", "best_known_minus_proven_total": "gap_total",
}  # fmt: skip


def digest_of(tally: Tally) -> str:
    """Sums are written as they were kept then: multiples of 2^-1074, products of 2^-2148."""
    agents = {}
    for name, agent in tally.agents.items():
        assert all(of == tally.worlds for _, of in agent.counts.values())
        counts = {NAMES.get(of, of): so for of, (so, _) in agent.counts.items()}
        moments = {
            NAMES.get(of, of): [each.count, hex(int(each.total * 2**1074)), hex(int(each.squares * 2**2148))]
            for of, each in agent.moments.items()
        }
        products = {NAMES.get(of, of): hex(int(value * 2**2148)) for of, value in agent.products.items()}
        agents[name] = {"counts": counts, "moments": moments, "products": products}
    told = {
        "worlds": tally.worlds, "hidden": tally.hidden, "worlds_hash": hex(tally.worlds_hash), "agents": agents,
        "ranges": {name: [list(each) for each in entries] for name, entries in tally.ranges.items()},
        "left_out": [list(left) for left in tally.left_out],
    }  # fmt: skip
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:16]


@pytest.mark.parametrize(
    ("worlds", "scenario", "harm_count", "digest"),
    [
        *(pytest.param(1_200, *key, digest, marks=pytest.mark.slow) for key, digest in RECORDED.items()),
        *((250, *key, digest) for key, digest in FIRST_250.items()),
    ],
)
def test_tally__is_the_one_that_was_recorded(worlds: int, scenario: str, harm_count: str, digest: str) -> None:
    lineup, parts = Lineup.of(RECORDED_AGENTS, load_scenario(scenario), harm_count=harm_count), []
    for first, part in chunks_of(lineup.scenario.sample(worlds, 11), 1_000):
        driven = drive_chunk(part, lineup.make(), lineup.scenario, 11, lineup.scenario.learners, first)
        limits = limits_of(driven)
        parts.append(Tally.of(driven, (), long_list=isinstance(limits, Unproven) or not limits.known.all()))
    assert digest_of(sum(parts[1:], parts[0])) == digest


SILENT = pytest.mark.filterwarnings("ignore::ethbrake_marl.extensions.search.limits.IncompleteTable")


BRAKE = {"full_brake": eb.make_agent("full_brake")}


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
    "mean_regret", "mean_regret_first", "mean_regret_total",
    "share_of_possible_reduction", "share_of_possible_reduction_first",
    "share_of_possible_reduction_total", "known_best_share", "below_best_known",
}  # fmt: skip


def outcome(evaluation: Evaluation, harms: tuple[list[float], list[float]], n: int) -> Outcome:
    """An outcome with these first-impact and total harms, all of the front pair."""
    first, total = (np.column_stack([harm[:n], np.zeros(n)]) for harm in harms)
    final = evaluation.worlds.take(np.arange(n))
    count = (total > 0.0).astype(np.int64)
    of = final.vehicles
    ledger = Ledger(first, total, count, *Impacts.no_obstacle(n), of.mass_t, of.restitution, of.harm_weight)
    return Outcome(ledger, final, np.ones(n, np.bool_), None, None)


def first_worlds(evaluation: Evaluation, n: int, **harms: tuple[list[float], list[float]]) -> Evaluation:
    outcomes = {name: outcome(evaluation, each, n) for name, each in harms.items()}
    rows = np.arange(n)
    return Evaluation(evaluation.scenario, (1,), evaluation.worlds.take(rows), rows, 7, outcomes)


@pytest.fixture
def four(evaluation: Evaluation, monkeypatch: pytest.MonkeyPatch) -> Evaluation:
    """An evaluation of full_brake and another agent in the four worlds."""

    def bound(worlds: eb.Worlds, vehicle: int, **settings: Any) -> SimpleNamespace:
        contact = SimpleNamespace(avoidable=AVOIDABLE[: worlds.n], reason_name=REASON[: worlds.n])
        return SimpleNamespace(harm=PROVEN[: worlds.n], contact=contact)

    def best(worlds: eb.Worlds, task: Task) -> dict[str, np.ndarray]:
        return {count: harm[: worlds.n] for count, harm in TABLE.items()}

    monkeypatch.setattr(limits, "lower_bound", bound)
    monkeypatch.setattr(limits, "best_known", best)
    return first_worlds(evaluation, 4, full_brake=FULL, a=AGENT)


def columns_of(result: Evaluation, folder: Path) -> dict[str, list[str]]:
    """The columns of the file of one row per agent and world."""
    lines = per_world(result, folder)
    return {name: [line[name] for line in lines] for name in lines[0]}


@SILENT
def test_best_known__is_the_witness_the_table_or_an_agent(four: Evaluation, tmp_path: Path) -> None:
    found, agent, full = regrets_of(four), four.outcome("a"), four.outcome("full_brake")
    assert found.limits.known.tolist() == [True, True, True, False]
    assert found.regret(full, "total").tolist() == [12.0, 9.0, 7.0, 5.0]
    assert found.below(agent).tolist() == [False, False, True, False]
    columns = columns_of(four, tmp_path)
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
def test_best_known__equal_to_the_table_and_rounding_below_it_are_not_below_it(four: Evaluation) -> None:
    close = first_worlds(four, 4, a=([1.0, 2.0 - 9e-7, 4.0 - 2e-6, 6.0], [1.0, 3.0, 6.0, 7.0]))
    found = regrets_of(close)
    assert found.below(close.outcome("a")).tolist() == [False, False, True, False]
    assert found.source.tolist() == ["witness", "table", "below_table", "agents"]
    assert (found.regret(close.outcome("a"), "first") >= 0.0).all()


def test_distance__by_hand(four: Evaluation) -> None:
    (_, found) = summarise(first_worlds(four, 3, full_brake=FULL, a=AGENT))
    expected = {
        "share_of_possible_reduction_first": (30.0 - 8.0) / (30.0 - 5.0),
        "share_of_possible_reduction_total": (36.0 - 10.0) / (36.0 - 8.0),
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
    assert (found.more["limits"]["known_best_share"], found.more["limits"]["below_best_known"]) == (1.0, 1)
    (alone,) = summarise(first_worlds(four, 3, a=AGENT))  # without full braking nothing is realised
    assert alone["share_of_possible_reduction_first"] is alone["share_of_possible_reduction_total"] is None
    assert alone["mean_regret_first"].value == 1.0


def test_distance__a_best_that_is_not_known_everywhere_realises_nothing(four: Evaluation) -> None:
    with pytest.warns(IncompleteTable, match=r"contains 2 of the 4 worlds. The best known harm of 1 world \(25.0 %\)"):
        full, agent = (row.to_json() for row in summarise(four))
    assert "(25.0 %)" in agent["best_known_warning"] and agent["best_known_warning"] == full["best_known_warning"]
    assert agent["known_best_share"] == full["known_best_share"] == 0.75
    assert agent["share_of_possible_reduction"] is agent["share_of_possible_reduction_total"] is None
    assert (agent["mean_regret"], agent["mean_regret_first"], agent["mean_regret_total"]) == (0.75, 0.75, 0.5)
    assert full["mean_regret"] == (10.0 + 8.0 + 7.0 + 4.0) / 4.0
    assert (full["below_best_known"], agent["below_best_known"]) == (0, 1)
    table = summarise(four).markdown()
    assert "WARNING: the table of best known harm contains 2 of the 4 worlds" in table and "≥ 0.75" in table
    assert (
        "An earlier search covers 75.0 % of the worlds. Elsewhere" in table
        and "Less harm than the earlier best known harm: a in 1 world." in table
    )


LINE = load_scenario("paper-random")


@pytest.mark.parametrize(
    ("scenario", "vehicle", "reason"),
    [
        (LINE.replace(roles={"vehicle_1": "coast", "vehicle_2": "learner", "vehicle_3": "full_brake"}), 1,
         "vehicle_1 follows the script coast"),
        (LINE.with_learners([2]), 2, "the controlled vehicle is vehicle_3"),
        (LINE.replace(latency_s=[0.6, 0.5, 0.8]), 1, "vehicle_1 may brake later than vehicle_2"),
        (load_scenario("paper-random-obstacle").replace(obstacle_gap_m=30.0), 1,
         "vehicle_1 reaches the obstacle although it brakes; avoidability is proven where it stops in time"),
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


def test_limits__an_obstacle_out_of_vehicle_1_s_own_reach_leaves_avoidability(tmp_path: Path) -> None:
    scenarios = [load_scenario(name) for name in ("paper-random-obstacle", "paper-random")]
    results = [evaluate(each.sample(50, 7), BRAKE, scenario=each, seed=7) for each in scenarios]
    row, other = (summarise(each)[0].to_json() for each in results)
    assert row["unavoidable_rate"] == other["unavoidable_rate"] > 0.0
    assert row["impact_proven_rate"] is None and row["proven_harm"] is None
    assert 0.0 < row["best_known_first_impact_harm"] <= row["best_known_total_harm"]
    assert row["mean_regret"] is not None and row["parameters"]["no_limits_because"] is None
    assert "no command of Vehicle 2 avoids contact (proven)" in summarise(results[0]).markdown()
    columns = columns_of(results[0], tmp_path)
    assert set(columns["avoidable"]) == {"0", "1"} and set(columns["proven_harm"]) == {""}


def test_limits__of_another_line_up_are_null_with_the_reason(pair: Scenario, tmp_path: Path) -> None:
    result = evaluate(pair.sample(2, 0), BRAKE, scenario=pair)
    row = summarise(result)[0].to_json()
    assert {row[name] for name in NULLS} == {None} and row["mean_regret_interval"] is None
    assert row["parameters"]["no_limits_because"] == "the line has 2 vehicles; avoidability is proven for 3 vehicles"
    columns = columns_of(result, tmp_path)
    assert columns["avoidable"] == columns["regret_total_harm"] == columns["best_known_source"] == ["", ""]
    assert regrets_of(result) is None and "proven" not in summarise(result).markdown()


@pytest.mark.parametrize(("name", "unavoidable"), [("paper-random", 309), ("paper-random-early", 272)])
def test_limits__of_the_first_500_worlds_of_the_papers_random_test(name: str, unavoidable: int) -> None:
    scenario = load_scenario(name)
    agents = {spec: eb.make_agent(spec) for spec in ("full_brake", "e_v2x_bm")}
    result = evaluate(scenario.sample(500, 7), agents, scenario=scenario, seed=7, aftermath=False)
    proof, rows = limits_of(result).proof, summarise(result)
    assert [row["unavoidable_rate"].value for row in rows] == [unavoidable / 500] * 2
    for driven in result.outcomes.values():
        assert driven.collided[proof.impact].all()  # nobody avoids what is proven
        assert (driven.first_impact_harm >= proof.harm - 1e-9).all()
    full, best = (row["avoidable_collision_rate"].value for row in rows)
    assert best < 0.02 < full


STUDY = load("../studies/best_harm")


def shipped_table(name: str, **header: Any) -> BestHarmTable:
    (table,) = (table for table in shipped_tables() if table.header["scenario"] == name)
    return replace(table, header={**table.header, **header})


def test_shipped__stress_wide_has_a_loose_proof_and_says_so() -> None:
    (found,), sheet = STUDY.shipped_bounds([shipped_table("stress-wide")])
    proven, inside = found["proven"], found["proven"]["between"]
    assert (found["worlds"], found["list_seed"]) == (5000, 7)
    assert (found["gap_first"], found["gap_total"]) == pytest.approx((0.057, 0.122), abs=5e-4)
    assert proven["contact_proven_rate"] - proven["impact_proven_rate"] == pytest.approx(inside["rate"])
    assert inside["mean_first"] > 0.9 and inside["harmless_rate"] < 0.55  # nobody leans there
    (_, _, line) = sheet.markdown().splitlines()
    assert "| 5.7 % |" in line and "| 12.2 % |" in line
    (leaning,), _ = STUDY.shipped_bounds([shipped_table("paper-delay-low", episodes=1000)])
    assert leaning["proven"]["between"]["mean_first"] < 0.03  # in the paper's lists leaning explains what is between


def test_between__proven_contact_and_proven_impact() -> None:
    contact, impact = np.array([0, 1, 1, 1, 1], bool), np.array([0, 1, 0, 0, 0], bool)
    first, total = np.array([0, 9, 1e-4, 6, np.nan]), np.array([0, 9, 2e-4, 8, np.nan])
    found, nobody = (Between.of(contact, proven, first, total) for proven in (impact, contact))
    assert found.rate == 0.6
    assert found.harmless_rate == 0.5
    assert round(found.mean_first, 9) == 3.00005
    assert round(found.mean_total, 9) == 4.0001
    assert nobody.rate == 0.0
    assert nobody.mean_first is None
    assert nobody.harmless_rate is None


PAPER = eb.load_scenario("paper-random")


FIXED = PAPER.replace(gaps_m=40, speeds_mps=20, latency_s=0, early_impacts="keep", horizon_s=30)


def test_proof__reads_what_the_road_allows() -> None:
    # The proof reads what the road allows; and 20 x 0.5 = 10 m are lost where all brake alike.
    near = FIXED.replace(gaps_m=30, braking_capacity_mps2=[9, 7, 6], latency_s=[0, 0.5, 0.8])
    assert [
        prove(near.replace(friction=mu).sample(1, 7).worlds, Task(near, (1,))).avoidable.tolist() for mu in (0.3, 1.0)
    ] == [[True], [True]]
    assert final(FIXED.replace(gaps_m=[4, 40], latency_s=[0, 0.5, 0.5], friction=0.3)).pair_hit[0].tolist() == [
        True,
        False,
    ]


@pytest.fixture(scope="module")
def slow() -> Scenario:
    """Paper-random, whose brakes build up."""
    return load_scenario("paper-random").replace(brake_rate_mps3=12.65, release_rate_mps3=25)


def test_search_and_shield__execute_what_they_foresee(slow: Scenario) -> None:
    worlds = slow.sample(40, seed=7)
    names = ("full_brake", "e_v2x_bm", "best_harm", "constant:2+step")
    result = eb.evaluate(worlds, {name: eb.make_agent(name, scenario=slow) for name in names}, scenario=slow)
    harm = {name: result.outcome(name).first_impact_harm for name in names}
    told = result.outcome("e_v2x_bm").predicted_harm
    np.testing.assert_allclose(told, harm["e_v2x_bm"], rtol=1e-9, atol=1e-9)
    assert harm["best_harm"].mean() < harm["e_v2x_bm"].mean() < harm["full_brake"].mean()
    assert (harm["constant:2+step"] <= harm["e_v2x_bm"] + 1e-9).all()  # its bound
    assert (harm["constant:2+step"] != harm["e_v2x_bm"]).any()


def test_train__proves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The evaluations of a training need no limits; the evaluation that they are compared with proves them once."""
    prove = Mock(side_effect=limits.known_limits)
    monkeypatch.setattr(regret, "known_limits", prove)
    check_measured(tmp_path / "run")
    prove.assert_called_once()


def test_figures__of_a_list_that_is_not_held_are_those_of_evaluate_that_need_no_proof(monkeypatch) -> None:
    lineup = Lineup.of(AGENTS, load_scenario("paper-random"))
    for one, other in in_both_ways(lineup, monkeypatch):
        for measure in measures():
            assert one[measure.name] == (None if measure in LIMITS.measures else other[measure.name]), measure.name
        told, expected = ({**each.to_json(), "parameters": None} for each in (one, other))
        proven = {name for name in told if told[name] is None}
        assert [expected[name] for name in told if name not in proven] == [
            told[name] for name in told if name not in proven
        ]
        assert {**one.parameters, "no_limits_because": None} == other.parameters
        assert (
            one.parameters["no_limits_because"] == "proofs and regrets are computed for lists of at most 100,000 worlds"
        )


# ---------------------------------------------------------------- what the limits add to summaries and files

ESTIMATES = {
    "unavoidable_rate", "impact_proven_rate", "proven_harm", "best_known_minus_proven_first",
    "best_known_minus_proven_total", "avoidable_collision_rate", "best_known_first_impact_harm",
    "best_known_total_harm", "mean_regret", "mean_regret_first", "mean_regret_total", "share_of_possible_reduction",
    "share_of_possible_reduction_first", "share_of_possible_reduction_total",
}  # fmt: skip
MORE = {
    "impact_unproven", "known_best_share", "best_known_warning", "below_best_known",
    *ESTIMATES, *(f"{name}_interval" for name in ESTIMATES),
}  # fmt: skip


def test_summarise__has_the_keys_of_the_limits_beside_its_own(evaluation: Evaluation) -> None:
    full, constant, gap = (row.to_json() for row in summarise(evaluation))
    assert set(full) == set(constant) == ALWAYS | MORE
    assert set(gap) == ALWAYS | MORE | {"predicted_harm", "predicted_harm_interval", "policy_share"}


def test_per_world__has_the_columns_of_the_limits(evaluation: Evaluation, tmp_path: Path) -> None:
    assert set(KNOWN_OF_WORLDS) < set(per_world(evaluation, tmp_path)[0])


def test_below__is_less_than_the_best_known_harm_and_not_equal_to_it() -> None:
    known = SimpleNamespace(first_impact_harm=np.array([3.0, 3.0, 3.0]), total_harm=np.array([5.0, 5.0, 5.0]))
    found = SimpleNamespace(first_impact_harm=np.array([3.0, 3.0, 2.9]), total_harm=np.array([5.0, 4.9, 6.0]))
    regrets = regret.Regrets(known, known.first_impact_harm, known.total_harm, np.array(["table"] * 3))
    assert regrets.below(found).tolist() == [False, True, True]
