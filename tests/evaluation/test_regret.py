from __future__ import annotations

import csv
import json
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.errors import IncompleteTable
from ethbrake_marl.evaluation import Evaluation, Outcome, evaluate, summarise, write_per_world
from ethbrake_marl.evaluation.measures import SummaryTable
from ethbrake_marl.harm import Ledger
from ethbrake_marl.limits import limits as limits_module
from ethbrake_marl.limits.limits import Unproven, known_limits, unproven_because
from ethbrake_marl.physics import Worlds
from ethbrake_marl.physics.batch import Impacts
from ethbrake_marl.scenario import Scenario, Task, load_scenario

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


def outcome(evaluation: Evaluation, harms: tuple[list[float], list[float]]) -> Outcome:
    """An outcome with these first-impact and total harms, all of the front pair."""
    first, total = (np.column_stack([harm, np.zeros(len(harm))]) for harm in harms)
    count = (total > 0.0).astype(np.int64)
    final = evaluation.worlds.take(np.arange(len(first)))
    ledger = Ledger(first, total, count, *Impacts.no_obstacle(final.n), final.vehicles.mass_t)
    return Outcome(ledger, final, np.ones(len(first), np.bool_), None, None)


@pytest.fixture
def four(evaluation: Evaluation, monkeypatch: pytest.MonkeyPatch) -> Evaluation:
    """An evaluation of full_brake and another agent in the four worlds."""
    monkeypatch.setattr(
        limits_module,
        "lower_bound",
        lambda worlds, vehicle, **settings: SimpleNamespace(
            harm=PROVEN[: worlds.n],
            contact=SimpleNamespace(avoidable=AVOIDABLE[: worlds.n], reason_name=REASON[: worlds.n]),
        ),
    )
    monkeypatch.setattr(
        limits_module, "best_known", lambda worlds, task: {count: harm[: worlds.n] for count, harm in TABLE.items()}
    )
    return first_worlds(evaluation, 4)


def first_worlds(evaluation: Evaluation, n: int) -> Evaluation:
    outcomes = {
        name: outcome(evaluation, (harms[0][:n], harms[1][:n])) for name, harms in (("full_brake", FULL), ("a", AGENT))
    }
    rows = np.arange(n)
    return Evaluation(evaluation.scenario, (1,), evaluation.worlds.take(rows), rows, 7, outcomes)


@pytest.mark.filterwarnings("ignore::ethbrake_marl.errors.IncompleteTable")
def test_best_known__is_the_witness_the_table_or_an_agent(four: Evaluation) -> None:
    found = four.regrets
    assert found is not None
    assert found.first_impact_harm.tolist() == [0.0, 2.0, 3.0, 6.0]
    assert found.total_harm.tolist() == [0.0, 3.0, 5.0, 7.0]
    assert found.source.tolist() == ["witness", "table", "below_table", "agents"]
    assert found.limits.known.tolist() == [True, True, True, False]
    assert found.regret(four.outcome("a"), "first").tolist() == [1.0, 2.0, 0.0, 0.0]
    assert found.regret(four.outcome("full_brake"), "total").tolist() == [12.0, 9.0, 7.0, 5.0]
    assert found.below(four.outcome("a")).tolist() == [False, False, True, False]


@pytest.mark.filterwarnings("ignore::ethbrake_marl.errors.IncompleteTable")
def test_best_known__rounding_below_the_table_is_not_below_it(four: Evaluation) -> None:
    close = outcome(four, ([1.0, 2.0 - 9e-7, 4.0 - 2e-6, 6.0], [1.0, 4.0, 6.0, 7.0]))
    found = Evaluation(four.scenario, (1,), four.worlds, four.index, 7, {"a": close}).regrets
    assert found is not None
    assert found.below(close).tolist() == [False, False, True, False]
    assert found.source.tolist() == ["witness", "table", "below_table", "agents"]
    assert (found.regret(close, "first") >= 0.0).all()


def test_distance__by_hand(four: Evaluation, evaluation: Evaluation) -> None:
    three = first_worlds(evaluation, 3)
    (_, found) = summarise(three)
    told = {name: each.value for name, each in found.estimates.items() if each is not None}
    assert told["realised_share_first"] == pytest.approx((30.0 - 8.0) / (30.0 - 5.0), rel=1e-12)
    assert told["realised_share_total"] == pytest.approx((36.0 - 10.0) / (36.0 - 8.0), rel=1e-12)
    assert told["mean_regret_first"] == 1.0 and told["mean_regret_total"] == pytest.approx(2.0 / 3.0, rel=1e-12)
    assert told["unavoidable_rate"] == pytest.approx(2.0 / 3.0)
    assert told["avoidable_collision_rate"] == pytest.approx(1.0 / 3.0)
    assert told["impact_proven_rate"] == pytest.approx(1.0 / 3.0) and told["proven_harm"] == pytest.approx(0.5)
    assert told["best_known_minus_proven_first"] == pytest.approx((0.0 + 0.5 + 3.0) / 3.0)
    assert told["best_known_minus_proven_total"] == pytest.approx((0.0 + 1.5 + 5.0) / 3.0)
    assert (found.known_best_share, found.below_best_known) == (1.0, 1)


def test_distance__a_best_that_is_not_known_everywhere_realises_nothing(four: Evaluation) -> None:
    with pytest.warns(IncompleteTable, match=r"holds 2 of these 4 worlds, and not 1 others \(25.0 %\)"):
        full, agent = (row.to_json() for row in summarise(four))
    assert "(25.0 %)" in agent["best_known_warning"] and agent["best_known_warning"] == full["best_known_warning"]
    assert agent["known_best_share"] == full["known_best_share"] == 0.75
    assert agent["realised_share"] is agent["realised_share_total"] is None
    assert agent["mean_regret"] == agent["mean_regret_first"] == 0.75
    assert agent["mean_regret_total"] == 0.5
    assert full["mean_regret"] == (10.0 + 8.0 + 7.0 + 4.0) / 4.0
    assert (full["below_best_known"], agent["below_best_known"]) == (0, 1)
    table = summarise(four).markdown()
    assert "WARNING: the table of best known harm holds 2 of these 4 worlds" in table
    assert "≥ 0.75" in table
    assert "Found beforehand in 75.0 % of the worlds" in table
    assert "Below what was known: a in 1 world." in table


def test_limits__of_a_list_longer_than_its_table_are_told_in_a_warning_and_of_no_table_are_not(
    paper_random: Scenario,
) -> None:
    agents = {"full_brake": make_agent("full_brake")}
    listed, unlisted = (paper_random.sample(8, seed).worlds for seed in (7, 4711))
    for worlds, holds in ((listed, True), (unlisted, False), (Worlds.concatenate([listed, unlisted]), None)):
        found = evaluate(worlds, agents, scenario=paper_random, aftermath=False)
        with nullcontext() if holds is not None else pytest.warns(IncompleteTable):
            (row,) = summarise(found)
        known = row.known_best_share
        assert known is not None and (known == 1.0) == bool(holds)
        assert (row.to_json()["best_known_warning"] is None) == ("WARNING" not in SummaryTable([row]).markdown())
        assert (row.warning == "") == (holds is not None)
        assert ("WARNING" in SummaryTable([row])._repr_html_()) == (holds is None)


def test_distance__without_full_braking_nothing_is_realised(four: Evaluation, evaluation: Evaluation) -> None:
    three = first_worlds(evaluation, 3)
    alone = Evaluation(three.scenario, (1,), three.worlds, three.index, 7, {"a": three.outcome("a")})
    (row,) = (row.to_json() for row in summarise(alone))
    assert row["realised_share"] is row["realised_share_first"] is row["realised_share_total"] is None
    assert row["mean_regret"] == 1.0


def test_summary__has_the_fields_of_the_limit(evaluation: Evaluation) -> None:
    for row in summarise(evaluation):
        found = row.to_json()
        assert set(found) >= NULLS
        assert found["mean_regret"] == found["mean_regret_first"] >= 0.0
        assert found["mean_regret_first"] == pytest.approx(
            found["first_impact_harm"] - found["best_known_first_impact_harm"], rel=1e-9
        )
        proven, avoidable = (found["impact_proven_rate"], found["avoidable_collision_rate"])
        assert proven + avoidable - 1e-12 <= found["collision_rate"] <= found["unavoidable_rate"] + avoidable + 1e-12
        for count in ("first", "total"):
            name = "first_impact_harm" if count == "first" else "total_harm"
            gap = found[f"best_known_{name}"] - found["proven_harm"]
            assert 0.0 <= found[f"best_known_minus_proven_{count}"] == pytest.approx(gap, rel=1e-9)
        assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert evaluation.conditions["no_limits_because"] is None


@pytest.mark.parametrize(
    ("roles", "vehicle", "reason"),
    [
        (("coast", "learner", "full_brake"), 1, "vehicle_1 follows coast"),
        (("full_brake", "full_brake", "learner"), 2, "vehicle_3 is driven"),
        (("full_brake", "learner", "full_brake"), 1, None),
    ],
)
def test_limits__do_not_apply_to_other_scripts_and_vehicles(
    paper_random: Scenario, roles: tuple[str, ...], vehicle: int, reason: str | None
) -> None:
    scenario = paper_random.replace(roles=dict(zip(paper_random.vehicle_names, roles, strict=True)))
    worlds = scenario.sample(2, 7).worlds
    task = Task(scenario, (vehicle,))
    found = unproven_because(worlds, task)
    assert found is None if reason is None else found is not None and found.startswith(reason)
    assert isinstance(known_limits(worlds, task), Unproven) == (reason is not None)


def test_limits__an_obstacle_out_of_vehicle_1_s_own_reach_leaves_avoidability_and_a_least_harm(tmp_path: Path) -> None:
    scenario, plain = load_scenario("paper-random-obstacle"), load_scenario("paper-random")
    agents = {"full_brake": make_agent("full_brake")}
    result, usual = (evaluate(s.sample(50, 7), agents, scenario=s, seed=7) for s in (scenario, plain))
    (row,), (other,) = ([one.to_json() for one in summarise(each)] for each in (result, usual))
    assert row["unavoidable_rate"] == other["unavoidable_rate"] > 0.0
    assert row["impact_proven_rate"] == other["impact_proven_rate"] > 0.0
    assert 0.0 < row["proven_harm"] <= row["best_known_first_impact_harm"] <= row["best_known_total_harm"]
    assert row["mean_regret"] is not None and row["parameters"]["no_limits_because"] is None
    text = summarise(result).markdown()
    assert f"proven: no less than {row['proven_harm']:.2f}" in text
    write_per_world(tmp_path / "out.csv", result)
    with (tmp_path / "out.csv").open(newline="") as stream:
        lines = list(csv.DictReader(stream))
    assert sum(float(line["proven_harm"]) for line in lines) / 50 == pytest.approx(row["proven_harm"])
    assert all(float(line["proven_harm"]) <= float(line["best_known_first_impact_harm"]) + 1e-9 for line in lines)
    assert {line["avoidable"] for line in lines} == {"0", "1"}
    near = scenario.replace(obstacle_gap_m=30.0)
    found = unproven_because(near.sample(50, 7).worlds, Task(near, (1,)))
    assert found == "vehicle_1 reaches the obstacle ahead by itself; nothing is proven then"


def test_limits__do_not_apply_where_vehicle_1_may_brake_after_vehicle_2(paper_random: Scenario) -> None:
    late = paper_random.replace(latency_s=[0.6, 0.5, 0.8])
    result = evaluate(late.sample(2, 7), {"coast": make_agent("coast")}, scenario=late)
    assert "vehicle_1 may brake later than vehicle_2" in result.conditions["no_limits_because"]
    assert result.regrets is None


def test_limits__of_another_line_up_are_null_with_the_reason(pair: Scenario, tmp_path: Path) -> None:
    result = evaluate(pair.sample(2, 0), {"full_brake": make_agent("full_brake")}, scenario=pair)
    (row,) = (row.to_json() for row in summarise(result))
    assert {row[name] for name in NULLS} == {None}
    assert row["mean_regret_interval"] is None
    assert row["parameters"]["no_limits_because"] == "2 vehicles; avoidability is proven for 3"
    write_per_world(tmp_path / "out.csv", result)
    with (tmp_path / "out.csv").open(newline="") as stream:
        lines = list(csv.DictReader(stream))
    assert {line["avoidable"] + line["regret_total_harm"] + line["best_known_source"] for line in lines} == {""}
    assert "proven" not in summarise(result).markdown()


@pytest.mark.filterwarnings("ignore::ethbrake_marl.errors.IncompleteTable")
def test_per_world__shows_the_limit_of_each_world(four: Evaluation, tmp_path: Path) -> None:
    write_per_world(tmp_path / "out.csv", four)
    with (tmp_path / "out.csv").open(newline="") as stream:
        lines = [line for line in csv.DictReader(stream) if line["agent"] == "a"]
    assert [line["avoidable"] for line in lines] == ["1", "0", "0", "0"]
    assert [line["unavoidable_reason"] for line in lines] == ["", "front", "rear", "rear"]
    assert [float(line["best_known_first_impact_harm"]) for line in lines] == [0.0, 2.0, 3.0, 6.0]
    assert [float(line["best_known_total_harm"]) for line in lines] == [0.0, 3.0, 5.0, 7.0]
    assert [line["impact_proven"] for line in lines] == ["0", "1", "0", "1"]
    assert [float(line["proven_harm"]) for line in lines] == [0.0, 1.5, 0.0, 5.0]
    assert [line["best_known_source"] for line in lines] == ["witness", "table", "below_table", "agents"]
    assert [float(line["regret_first_impact_harm"]) for line in lines] == [1.0, 2.0, 0.0, 0.0]
    assert [float(line["regret_total_harm"]) for line in lines] == [1.0, 1.0, 0.0, 0.0]


@pytest.mark.parametrize(("name", "unavoidable"), [("paper-random", 309), ("paper-random-early", 272)])
def test_limits__of_the_first_500_worlds_of_the_papers_random_test(name: str, unavoidable: int) -> None:
    scenario = load_scenario(name)
    agents = {spec: make_agent(spec) for spec in ("full_brake", "e_v2x_bm")}
    result = evaluate(scenario.sample(500, 7), agents, scenario=scenario, seed=7)
    full, best = (row.to_json() for row in summarise(result))
    found = result.regrets
    assert found is not None
    assert full["unavoidable_rate"] == best["unavoidable_rate"] == unavoidable / 500
    for spec in agents:
        driven = result.outcome(spec)
        assert driven.collided[found.limits.proof.impact].all()  # nobody avoids what is proven
        assert (driven.first_impact_harm >= found.limits.proof.harm - 1e-9).all()
        assert (found.regret(driven, "first") >= 0.0).all()
        assert (found.regret(driven, "total") >= 0.0).all()
    assert not (found.limits.proof.avoidable & found.limits.proof.impact).any()
    assert (found.first_impact_harm >= found.limits.proof.harm - 1e-9).all()
    assert best["avoidable_collision_rate"] < 0.02 < full["avoidable_collision_rate"]


def test_leaning__is_contact_without_an_impact_and_no_collision(tmp_path: Path) -> None:
    """Gap 2 is 0: Vehicle 3 leans on the braking Vehicle 2 and is braked by it; coasting, it could not stop in time."""
    scenario = load_scenario("paper-delay-low").replace(gaps_m=[12.0, 0.0], speeds_mps=20.0, latency_s=[0.0, 0.1, 0.8])
    result = evaluate(scenario.sample(1, 7), {"full_brake": make_agent("full_brake")}, scenario=scenario)
    (row,) = (row.to_json() for row in summarise(result))
    assert (row["unavoidable_rate"], row["impact_proven_rate"], row["collision_rate"]) == (1.0, 0.0, 0.0)
    assert row["best_known_first_impact_harm"] == row["proven_harm"] == 0.0
    text = summarise(result).markdown()
    assert "In 100.0 %" in text and "avoids contact" in text and "in 0.0 %" in text and "avoids an impact" in text
