"""Intervals by recording: worlds whose rows come from the same recording form a cluster."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.evaluation.chunks import Lineup, evaluate_held, summarise_tally, tally_list
from ethbrake_marl.first_edition.evaluation.comparison import compare_results
from ethbrake_marl.first_edition.evaluation.per_world import read_result, results_to_json, write_per_world
from ethbrake_marl.first_edition.evaluation.statistics import (
    Moments,
    mean,
    paired_difference,
    rate,
    relative_decrease,
    share_of,
    unpaired_difference,
    wilson,
)
from ethbrake_marl.first_edition.scenario.sample import clusters_of
from tests.refused import refused

T_2 = 4.302652729911275  # quantile of Student's t with 2 degrees of freedom at 97.5 %

NAMES = np.array(["a", "a", "b", "c", "c", "c"])


def test_mean__by_clusters_by_hand() -> None:
    # Mean 6; deviations -5 -3 | -1 | 1 3 5, their sums -8, -1, 9: 3 / 2 (64 + 1 + 81) / 36 = 6.08333.
    found = mean(np.array([1.0, 3.0, 5.0, 7.0, 9.0, 11.0]) - 10.0, NAMES)
    half = T_2 * math.sqrt(219 / 36)
    assert found.value == -4.0
    assert found.interval == pytest.approx((-4.0 - half, -4.0 + half), rel=1e-9)


def test_ratio_and_difference__by_clusters_by_hand() -> None:
    x, y = np.array([1.0, 3.0, 2.0, 0.0, 1.0, 5.0]), np.array([2.0, 2.0, 4.0, 4.0, 4.0, 8.0])
    # r = 12 / 24; residuals x - y / 2: 0 2 | 0 | -2 -1 1, their sums 2, 0, -2: 3 / 2 (4 + 0 + 4) / 24^2 = 1 / 48.
    found, half = relative_decrease(x, y, NAMES), T_2 / math.sqrt(48)
    assert found.value == 0.5
    assert found.interval == pytest.approx((0.5 - half, 0.5 + half), rel=1e-9)
    # x - y: -1 1 | -2 | -4 -3 -3, mean -2; sums of deviations 4, 0, -4: 3 / 2 (16 + 0 + 16) / 36 = 4 / 3.
    found, half = paired_difference(x, y, NAMES), T_2 * math.sqrt(4 / 3)
    assert found.value == -2.0
    assert found.interval == pytest.approx((-2.0 - half, -2.0 + half), rel=1e-9)


def test_rate__by_clusters_by_hand() -> None:
    # p = 1 / 2; sums of deviations 1, 1/2, -3/2: 3 / 2 (1 + 1/4 + 9/4) / 36 = 7 / 48; 1 + 1/4 / (7/48) = 19 / 7 draws.
    found = share_of(np.array([True, True, True, False, False, False]), NAMES)
    assert found.value == 0.5
    assert found.interval == pytest.approx(wilson(0.5, 19 / 7 * 3.841458820694124 / T_2**2), rel=1e-9)
    # Nobody was hit in three recordings: no more is known than of three worlds.
    none = share_of(np.zeros(6, np.bool_), NAMES).interval
    assert none == pytest.approx(wilson(0.0, 3 * 3.841458820694124 / T_2**2), rel=1e-9)
    # All recordings are alike: no interval is narrower than that of as many independent worlds.
    alike = share_of(np.tile([True, False], 30), np.repeat([f"{k}" for k in range(30)], 2)).interval
    assert alike[0] < rate(30, 60).interval[0] and rate(30, 60).interval[1] < alike[1]


def test_vehicles_of_one_recording__are_one_cluster() -> None:
    texts = np.array(["a.csv: 1-2-3", "a.csv: 4-5-6", "b/c: d.csv: 1-2-3", "alone", ""])
    assert clusters_of({"recording": texts}, np.arange(5)).tolist() == ["a.csv", "a.csv", "b/c: d.csv", "alone", " 4"]


@pytest.mark.parametrize("k", [1, 2, 50])
def test_rows_that_are_repeated_in_one_cluster__tell_no_more_than_one_of_them(k: int) -> None:
    x, y = np.random.default_rng(5).exponential(3.0, (2, 40))
    names = np.repeat([f"drive_{number}.csv: 1-2-3" for number in range(40)], k)
    again, other = np.repeat(x, k), np.repeat(y, k)
    assert mean(again, names) == mean(x)
    assert paired_difference(again, other, names) == paired_difference(x, y)
    assert relative_decrease(again, other, names) == relative_decrease(x, y)
    few = share_of(again > 4.0, names).interval
    factor = (stats.norm.ppf(0.975) / stats.t.ppf(0.975, 39)) ** 2
    assert few == pytest.approx(wilson(float((x > 4.0).mean()), 40 * factor), rel=1e-9)


def test_intervals__of_one_cluster_are_unknown() -> None:
    x, one = np.array([1.0, 2.0, 3.0]), np.array(["a"] * 3)
    assert mean(x, one).interval is None
    assert paired_difference(x, x[::-1], one).interval is None
    assert relative_decrease(x, x[::-1], one).interval is None
    assert share_of(x > 1.0, one).interval is None
    with refused("statistics: clusters has 2 entries, but there are 3 values; must have one entry", InvalidInput):
        mean(x, one[:2])


def test_moments__of_parts_that_share_clusters_are_those_of_the_whole() -> None:
    rng = np.random.default_rng(3)
    values, names = rng.exponential(20.0, 999) - 5.0, np.char.add("r", rng.integers(0, 30, 999).astype(str))
    values[:2] = 1e-300, 1e100
    whole = Moments.of(values, names)
    parts = [Moments.of(values[part], names[part]) for part in np.array_split(rng.permutation(999), 7)]
    assert sum(parts, Moments()) == whole
    assert len(whole.clusters) == whole.independent == 30
    assert sum(total for _, total in whole.clusters.values()) == whole.total


def test_intervals__by_clusters_cover_the_truth_as_often_as_they_say() -> None:
    rng, hits = np.random.default_rng(9), np.zeros((4, 2))
    for _ in range(300):
        sizes = rng.integers(5, 16, 25)
        names = np.repeat(np.char.add("drive ", np.arange(25).astype(str)), sizes)
        own = np.repeat(rng.exponential(1.0, 25), sizes)
        full = own + rng.exponential(1.0, len(own))  # mean 2
        saved = full * np.repeat(rng.uniform(0.2, 0.8, 25), sizes)  # half as much
        hit = rng.random(len(own)) < np.repeat(rng.beta(1.0, 4.0, 25), sizes)  # in a fifth
        for column, by in enumerate((names, None)):
            found = mean(full, by), relative_decrease(saved, full, by), paired_difference(saved, full, by)
            for row, (each, truth) in enumerate(zip((*found, share_of(hit, by)), (2.0, 0.5, -1.0, 0.2), strict=True)):
                hits[row, column] += each.interval[0] <= truth <= each.interval[1]
    covered = hits / 300
    assert ((covered[:, 0] > 0.88) & (covered[:, 0] < 0.985)).all(), covered
    assert (covered[:, 1] < 0.83).all(), covered


PAPER = eb.load_scenario("paper-random")
AGENTS = {name: eb.make_agent(name) for name in ("full_brake", "e_v2x_bm")}


def in_one_line(table):
    return " ".join(str(table).split())


def recorded(recordings, rows_of_each=20, **changes):
    """A scenario of rows of several recordings, each with gaps and speeds of its own."""
    rng, rows = np.random.default_rng(2), []
    for k in range(recordings):
        gap_m, speed_mps = rng.uniform(4, 12), rng.uniform(14, 22)
        rows += [[gap_m + rng.uniform(0, 1), speed_mps, f"drive_{k}.csv: 1-2-3"] for _ in range(rows_of_each)]
    table = {"columns": ["gap_1_m", "speed_2_mps", "recording"], "rows": rows}
    return eb.Scenario(**{**PAPER.declared(), "name": "recorded", "table": table, **changes})


@pytest.fixture(scope="module")
def found():
    scenario = recorded(8)
    return eb.evaluate(scenario.sample(400, 7), AGENTS, scenario=scenario, seed=7)


def test_evaluation__has_the_recording_of_each_world_and_intervals_by_it(found) -> None:
    sample, column = found.scenario.sample(400, 7), found.kinds["recording"]
    assert column.tolist() == sample.recordings.tolist()
    assert found.recordings == len(set(column.tolist())) == 8
    rows = eb.summarise(found)
    harm, braking = found.outcome("e_v2x_bm"), found.outcome("full_brake")
    assert rows[1].total_harm == mean(harm.total_harm, column)
    assert rows[1].collision_rate == share_of(harm.collided, column)
    assert rows[1]["harm_decrease_total"] == relative_decrease(harm.total_harm, braking.total_harm, column)
    assert rows[1]["total_harm_difference"] == paired_difference(harm.total_harm, braking.total_harm, column)
    assert rows[1].total_harm.interval[1] > 1.05 * mean(harm.total_harm).interval[1]
    assert rows[0].parameters["recordings"] == 8
    assert "400 worlds, seed 7; 95 % intervals by 8 recordings; d = " in in_one_line(rows)
    assert "with their 95 % intervals; 95 % intervals by 8 recordings." in in_one_line(found.rescore(["total"]))
    assert found.rescore(["total"])[1].each[1] == mean(found.outcome("full_brake").total_harm, column)
    assert found.take(column == column[0]).recordings == 1


def test_long_list__has_the_same_intervals_by_recording() -> None:
    scenario = recorded(8, latency_s=[0, {"uniform": [0.3, 1.5]}, 1.6])
    lineup = Lineup.of(["full_brake", "coast"], scenario)
    held = evaluate_held(lineup, scenario.sample(6_000, 7), 7)
    tally = tally_list(lineup, 6_000, 7, objectives=["total"])
    long, rows = summarise_tally(lineup, tally, 7), eb.summarise(held)
    for one, other in zip(long, rows, strict=True):
        for name in ("total_harm", "collision_rate", "harm_decrease_first"):
            assert one[name] == other[name]
    assert long[0].parameters["recordings"] == rows[0].parameters["recordings"] == 8
    assert long[0].parameters["rejected_draws"] == rows[0].parameters["rejected_draws"] == held.rejected > 0
    assert tally.rescore(["total"], 3).recordings == 8


def test_single_recording__has_no_interval_and_the_table_says_so() -> None:
    scenario = recorded(1)
    rows = eb.summarise(eb.evaluate(scenario.sample(50, 7), AGENTS, scenario=scenario))
    assert rows[0].total_harm.interval is None and rows[0].collision_rate.interval is None
    assert "no 95 % intervals: all worlds come from one recording" in in_one_line(rows)


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_comparison__of_results_that_were_read_again_is_by_recording(found, ending: str, tmp_path: Path) -> None:
    if ending == "parquet":
        pytest.importorskip("pyarrow")
    other = replace(found, outcomes={"full_brake": found.outcome("e_v2x_bm")})
    results = []
    for name, each in (("one", found), ("two", other)):
        (tmp_path / name).mkdir()
        write_per_world(tmp_path / name / f"worlds.{ending}", each)
        told = results_to_json(eb.summarise(each), per_world=tmp_path / name / f"worlds.{ending}")
        (tmp_path / name / "results.json").write_text(json.dumps(told))
        results.append(read_result(tmp_path / name / "results.json"))
    paired = compare_results(*results)
    harms = [each.outcome("full_brake").total_harm for each in (other, found)]
    assert paired.differences[0].harms["total_harm"] == paired_difference(*harms, found.kinds["recording"])
    assert paired.recordings == paired.to_json()["recordings"] == 8
    (tmp_path / "two" / f"worlds.{ending}").unlink()
    unpaired = compare_results(*results).differences[0].harms["total_harm"]
    both = [mean(each, found.kinds["recording"]) for each in harms]
    assert unpaired == unpaired_difference(both[0], 8, both[1], 8)


def test_mixture__counts_a_world_without_recording_as_a_cluster_of_its_own() -> None:
    mixed = eb.Scenario(name="mixed", mixture=[{"scenario": PAPER}, {"scenario": recorded(4)}])
    sample = mixed.sample(60, 7)
    alone = int((sample.scenarios == "paper-random").sum())
    assert len(set(sample.clusters.tolist())) == alone + 4
