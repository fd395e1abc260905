"""Summaries, tables and files of an evaluation."""

import csv
import io
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.exploits import Exploits
from ethbrake_marl.first_edition.evaluation.lineup import make_lineup
from ethbrake_marl.first_edition.evaluation.own_measures import load_measures
from ethbrake_marl.first_edition.evaluation.per_world import read_harms, write_per_world
from ethbrake_marl.first_edition.evaluation.rollout import evaluate
from ethbrake_marl.first_edition.evaluation.summary import SummaryTable, summarise
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS, injury_probability
from ethbrake_marl.first_edition.game.objectives import STANDARD, parse_objective, scored
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.scenario.tables import worlds_from_table
from ethbrake_marl.first_edition.training.experiment import results_csv
from tests.first_edition.contract.interfaces import CRASH

BRAKE = {"full_brake": eb.make_agent("full_brake")}

# ---------------------------------------------------------------- the summary

ESTIMATES = {
    "collision_rate", "first_impact_harm", "total_harm", "sampled_harm", "vehicle_1_shoved_m",
    "vehicle_1_shoved_far_rate", "first_impact_harm_difference", "total_harm_difference", "harm_decrease_first",
    "harm_decrease_total",
}  # fmt: skip
ALWAYS = {
    "kind", "agent", "knows", "sees_through_channel", "hidden_share", "episodes", "collisions", "horizon_ends",
    "exploits", "left_out", "worlds_sha256", "scenario_sha256", "policy_sha256", "versions", "parameters",
    *ESTIMATES, *(f"{name}_interval" for name in ESTIMATES),
}  # fmt: skip


def printed(table: SummaryTable, width: int = 80) -> str:
    """The table in a terminal, its white space made one."""
    console = Console(width=width, file=io.StringIO(), color_system=None)
    console.print(table.terminal())
    text = console.file.getvalue()
    assert all(len(line) <= width for line in text.splitlines())
    return " ".join(text.split())


@pytest.mark.usefixtures("core_alone")
def test_summarise__keys_and_values_are_those_of_the_worlds(evaluation: Evaluation) -> None:
    full, constant, gap = (row.to_json() for row in summarise(evaluation))
    assert set(full) == set(constant) == ALWAYS
    assert set(gap) == ALWAYS | {"predicted_harm", "predicted_harm_interval", "policy_share"}
    assert json.loads(json.dumps([full, constant, gap], allow_nan=False)) == [full, constant, gap]
    outcomes = evaluation.outcomes
    assert [row["agent"] for row in (full, constant, gap)] == [*outcomes]
    first = {name: outcome.first_impact_harm.mean() for name, outcome in outcomes.items()}
    total = {name: outcome.total_harm.mean() for name, outcome in outcomes.items()}
    collisions = np.count_nonzero(outcomes["constant:4.5"].collided)
    expected = {
        "episodes": 200,
        "collisions": collisions,
        "collision_rate": collisions / 200,
        "first_impact_harm": first["constant:4.5"],
        "total_harm": total["constant:4.5"],
        "sampled_harm": outcomes["constant:4.5"].sampled_harm.mean(),
        "first_impact_harm_difference": first["constant:4.5"] - first["full_brake"],
        "total_harm_difference": total["constant:4.5"] - total["full_brake"],
        "harm_decrease_first": 1 - first["constant:4.5"] / first["full_brake"],
        "harm_decrease_total": 1 - total["constant:4.5"] / total["full_brake"],
    }
    assert {name: constant[name] for name in expected} == pytest.approx(expected, rel=1e-9)
    for name in expected.keys() - {"episodes", "collisions"}:
        low, high = constant[f"{name}_interval"]
        assert low < constant[name] < high
    assert gap["predicted_harm"] == pytest.approx(evaluation.worlds.gaps_m[:, 0].mean(), rel=1e-12)
    assert gap["policy_share"] == np.mean(evaluation.worlds.gaps_m[:, 0] > 7.5)
    assert full["harm_decrease_first"] == full["harm_decrease_total"] == 0.0


def test_summarise__without_full_braking_there_is_no_decrease_and_of_one_world_no_interval(pair: Scenario) -> None:
    (row,) = summarise(evaluate(pair.sample(1, 0), {"coast": eb.make_agent("coast")}, scenario=pair))
    told = row.to_json()
    names = ("harm_decrease_first", "harm_decrease_total", "total_harm_difference")
    names += ("harm_decrease_first_interval", "first_impact_harm_interval")
    assert {told[name] for name in names} == {None} and told["collision_rate_interval"] is not None


# ---------------------------------------------------------------- its tables


# ---------------------------------------------------------------- exploits


def pushing(shoved_m: float, moving: int, worlds: int = 20) -> Evaluation:
    """Full braking, and the same one as if it shoved Vehicle 1 so far, and were not at rest in so many worlds."""
    scenario = load_scenario("paper-random")
    found = evaluate(scenario.sample(worlds, 7), BRAKE, scenario=scenario, seed=7)
    braking = found.outcome("full_brake")
    shoved = np.linspace(0.0, 2.0 * shoved_m, worlds)
    mine = replace(braking, shoved_m=shoved, at_rest=np.arange(worlds) >= moving)
    return replace(found, outcomes={"full_brake": braking, "mine": mine})


EXPLOITS = [(4.9, 1, ()), (5.1, 1, ("shoves",)), (4.9, 2, ("moving",)), (25.0, 12, ("shoves", "moving"))]


@pytest.mark.parametrize(("shoved_m", "moving", "names"), EXPLOITS)
def test_exploits__mark_the_row_and_are_one_sentence_below(shoved_m: float, moving: int, names: tuple[str]) -> None:
    found = pushing(shoved_m, moving)
    rows = summarise(found)
    assert [row.exploits.names for row in rows] == [(), names]
    assert [row.to_json()["exploits"] for row in rows] == [[], list(names)]
    assert Exploits.of_json(rows[1].to_json()) == rows[1].exploits
    for text in (str(rows), rows.markdown(), rows._repr_html_() if names else ""):
        assert ("mine ‡" in text) == bool(names and text) and "full_brake ‡" not in text
    sentences = [text for kind, text in rows.notes() if text.startswith("‡") and kind == "note"]
    assert len(sentences) == bool(names)
    for sentence in sentences:
        assert (f"mine shoves Vehicle 1 by {shoved_m:.1f} m on average" in sentence) == ("shoves" in names)
        leaves = f"runs past the horizon in {5 * moving:.1f} % of worlds"
        assert (leaves in sentence) == ("moving" in names)
        assert sentence in " ".join(str(rows).split()) and sentence in rows.markdown()


# ---------------------------------------------------------------- harm that was not seen


# ---------------------------------------------------------------- who knows what

SPECS = ("full_brake", "ppo", "ppo+episode", "e_v2x_bm:pairwise")
KNOWN = ("own sensors", "messages", "messages + true model", "true state", "not stated")


def check_marked(text: str, share: float) -> None:
    assert all(words in text for words in (*SPECS, *KNOWN, "† messages + true model", "† true state"))
    assert "† messages |" not in text and "† own sensors" not in text
    assert f"In {100 * share:.1f} % of these worlds the V2X channel hides something" in text
    assert "† ppo+episode, e_v2x_bm:pairwise: reads hidden values nevertheless" in text
    assert "These agents do not state what they know: mine." in text


class Silent:
    name = "silent"

    def act(self, worlds: Any, vehicle: int) -> np.ndarray:
        return np.zeros(worlds.n)


def knowing(v2x: Any) -> Evaluation:
    scenario = load_scenario("cooperation-2-blocked").replace(v2x=v2x)
    agents = {**make_lineup(SPECS, scenario), "mine": Silent()}
    return evaluate(scenario.sample(12, 7), agents, scenario=scenario, seed=7)


@pytest.mark.usefixtures("core_alone")
def test_knowledge__a_hiding_channel_marks_who_sees_through_it_in_every_table(tmp_path: Path) -> None:
    hiding = knowing("blocked")
    rows, share = summarise(hiding), hiding.hidden.mean()
    told = [row.to_json() for row in rows]
    assert [row["knows"] for row in told] == list(KNOWN) and 0.0 < share < 1.0
    assert [row["sees_through_channel"] for row in told] == [False, False, True, True, False]
    assert {row["hidden_share"] for row in told} == {share}
    markdown = rows.markdown()
    for text in (printed(rows, 160), markdown):
        check_marked(text, share)
    lines = markdown.splitlines()
    assert lines[0].startswith("| Agent | Knows | ") and len({line.count("|") for line in lines[:7]}) == 1
    assert [row["knows"] for row in csv.DictReader(io.StringIO(results_csv(rows)))] == list(KNOWN)
    lines = per_world(hiding, tmp_path)
    assert [row["knows"] for row in lines] == [each for each in KNOWN for _ in range(12)]
    assert [int(row["hidden"]) for row in lines] == 5 * hiding.hidden.astype(int).tolist()


CLEAR = ("paper", {"preset": "paper", "link_latency_s": 0.2, "senses": "both"})


@pytest.mark.usefixtures("core_alone")
@pytest.mark.parametrize("v2x", CLEAR)
def test_knowledge__where_nothing_is_hidden_nobody_is_marked(v2x: Any) -> None:
    result = knowing(v2x)
    rows = summarise(result)
    check_unmarked(printed(rows, 160) + rows.markdown())
    assert {row.to_json()["sees_through_channel"] for row in rows} == {False} and not result.hidden.any()


def check_unmarked(text: str) -> None:
    assert [word for word in ("†", "hides", "Not stated") if word in text] == []


# ---------------------------------------------------------------- other objectives


def test_rescored__one_impact_by_hand_in_json_and_as_columns(pair: Scenario, tmp_path: Path) -> None:
    # Harm 9, of which the vehicles bear 4.95 and 4.05 (see conftest).
    result = evaluate(pair.sample(2, 0), BRAKE, scenario=pair)
    rows = {row.objective: row for row in result.rescore([*STANDARD, "weighted:1,3"]) if row.harm_count == "total"}
    shown = str(result.rescore(["own"])).splitlines()
    assert [line.split() for line in shown if " own " in line] == [["full_brake", "own", "4.95", "4.05"]] * 2
    assert "Objectives, total harm" in result.rescore(["own"])._repr_html_()
    weighted = 2 * (4.95 + 3 * 4.05) / 4.0
    expected = {
        "total": (9.0, 9.0),
        "own": (4.95, 4.05),
        "social:45": (math.sqrt(0.5) * 9.0,) * 2,
        "maximin": (4.95, 4.95),
        "mass-weighted": (2 * (4.5 * 4.95 + 5.5 * 4.05) / 10.0,) * 2,
        "weighted:1,3": (weighted,) * 2,
    }
    told = {name: tuple(estimate.value for estimate in row.each) for name, row in rows.items()}
    assert list(told) == list(expected) and told == {name: pytest.approx(each) for name, each in expected.items()}
    found = json.loads(json.dumps(rows["own"].to_json(), allow_nan=False))
    own = {"objective": "own", "harm_count": "total", "vehicle_1_interval": pytest.approx([4.95] * 2)}
    assert {name: found[name] for name in own} == own
    plain, more = per_world(result, tmp_path), per_world(result, tmp_path, objectives=["own", "weighted:1,3"])
    assert [name for name in more[0] if name not in plain[0]] == [
        f"{objective}_{count}_{i}" for objective in ("own", "weighted:1,3") for count in HARM_COUNTS for i in (1, 2)
    ]
    assert more[0]["own_total_2"] == more[0]["total_harm_2"]
    assert float(more[1]["weighted:1,3_total_1"]) == pytest.approx(weighted)


# ---------------------------------------------------------------- one row per agent and world


def per_world(result: Evaluation, folder: Path, **options: Any) -> list[dict[str, str]]:
    """The rows that are written."""
    path = folder / "out.csv"
    write_per_world(path, result, force=True, **options)
    return list(csv.DictReader(io.StringIO(path.read_text("utf-8"), newline="")))


@pytest.mark.usefixtures("core_alone")
def test_per_world__every_number_reads_back_as_the_same_bits(tmp_path: Path, evaluation: Evaluation) -> None:
    rows = per_world(evaluation, tmp_path)
    assert [(row["agent"], row["world"]) for row in rows] == [
        (agent, str(k)) for agent in ("full_brake", "constant:4.5", "gap") for k in range(200)
    ]
    outcome, worlds = evaluation.outcome("gap"), evaluation.worlds
    expected = {
        "collided": outcome.collided,
        "impacts": outcome.impacts,
        "first_impact_harm": outcome.first_impact_harm,
        "total_harm": outcome.total_harm,
        "sampled_harm": outcome.sampled_harm,
        "vehicle_1_shoved_m": outcome.shoved_m,
        "predicted_harm": outcome.predicted_harm,
        "chosen_policy": outcome.chosen_policy,
        "end_s": outcome.final.time_s,
    }
    for i in range(3):
        expected[f"speed_{i + 1}_mps"] = worlds.speeds_mps[:, i]
        expected[f"final_speed_{i + 1}_mps"] = outcome.final.speeds_mps[:, i]
        expected[f"first_impact_harm_{i + 1}"] = outcome.vehicle_harm("first")[:, i]
        expected[f"total_harm_{i + 1}"] = outcome.vehicle_harm("total")[:, i]
    for p in range(2):
        expected[f"gap_{p + 1}_m"] = worlds.gaps_m[:, p]
        expected[f"final_gap_{p + 1}_m"] = outcome.final.gaps_m[:, p]
    columns = {name: np.array([row[name] for row in rows[400:]]) for name in rows[0]}
    for name, values in expected.items():
        np.testing.assert_array_equal(columns[name].astype(float), values.astype(float), err_msg=name)
    assert set(columns["ended"]) == {"at_rest"}
    assert set(rows[0]) == {"agent", "knows", "world", "hidden", "ended", *expected}
    names = ("gap_1_m", "gap_2_m", "speed_1_mps", "speed_2_mps", "speed_3_mps")
    again = worlds_from_table(evaluation.scenario, {name: columns[name].astype(float) for name in names})
    assert (
        again.gaps_m.tobytes() == worlds.gaps_m.tobytes() and again.speeds_mps.tobytes() == worlds.speeds_mps.tobytes()
    )


def test_per_world__a_quantity_that_differs_between_worlds_has_its_columns(tmp_path: Path, pair: Scenario) -> None:
    columns = {"gap_1_m": [1.0, 1.0], "speed_1_mps": [20.0, 20.0], "speed_2_mps": [20.0, 20.0]}
    worlds = worlds_from_table(pair, {**columns, "latency_2_s": [0.5, 0.25], "mass_1_t": [4.5, 4.5]})
    rows = per_world(evaluate(worlds, BRAKE, scenario=pair), tmp_path)
    told = [(row["latency_2_s"], row["latency_1_s"], row["predicted_harm"], row["chosen_policy"]) for row in rows]
    assert told == [("0.5", "0.0", "", ""), ("0.25", "0.0", "", "")] and "mass_1_t" not in rows[0]


def test_parquet_and_columns__hold_what_the_csv_file_holds(evaluation: Evaluation, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    rows, columns = per_world(evaluation, tmp_path), evaluation.arrays()
    write_per_world(tmp_path / "out.parquet", evaluation)
    one, other = (read_harms(file, file.read_bytes()) for file in (tmp_path / "out.csv", tmp_path / "out.parquet"))
    table = parquet.read_table(tmp_path / "out.parquet")
    assert one == other and table.column("predicted_harm").null_count == 400
    assert list(columns) == list(rows[0]) == table.column_names
    assert {len(column) for column in columns.values()} == {600} == {len(rows)}
    for name, kind in (("agent", str), ("total_harm", float), ("world", int)):
        assert columns[name].tolist() == [kind(row[name]) for row in rows] == table.column(name).to_pylist()
    assert np.isnan(columns["predicted_harm"][:400]).all()


def injuries(agent, scenario):
    found = eb.evaluate(scenario.sample(2, 7), {"a": eb.make_agent(agent)}, scenario=scenario)
    told = found.outcome("a").metrics | scored(found.outcome("a").ledger, "first", ["injury:lr4s"])
    return {n: round(float(np.ravel(v)[0]), 6) for n, v in told.items() if "lr4s" in n}


def test_objective__of_an_angle() -> None:
    assert parse_objective("social:45").angle_deg == 45.0


@pytest.mark.parametrize(
    ("speeds", "side", "curve", "expected"),
    [
        ([0.0], "front", "lr4s", [0.011464152]),  # 1 / (1 + exp(4.457))
        ([-10.0], "rear", "lr4s", [0.042370849]),  # 1 / (1 + exp(4.888 - 1.77))
        ([10.0, 0.0, 99.0], "front", "reference", [0.081842489, 0.0, 1.0]),  # (10 / 51.287)^1.531, never above 1
        ([10.0, 0.0, 99.0], "rear", "reference", [0.054414704, 0.0, 1.0]),  # (10 / 66.956)^1.531
        ([10.0], "front", "gidas", [0.052153563]),  # 1 / (1 + exp(2.9))
    ],
)
def test_injury_probability__by_hand(speeds, side, curve, expected) -> None:
    assert np.round(injury_probability(np.array(speeds), side, curve), 9).tolist() == expected


def test_injuries__of_a_crash_by_hand() -> None:
    for _ in range(2):
        load_measures(["injury"])
    # Vehicle 2 hits with 6 m/s, masses 1 and 3: 4.5 m/s at the rear of Vehicle 1, 1.5 m/s in front of Vehicle 2; in
    # 1,000 lines 1000 / (1 + exp(4.888 - 0.7965)) and 1000 / (1 + exp(4.457 - 0.2655)). Who is not hit has none.
    crash = {
        "injury_lr4s": 31.337641,
        "injury_lr4s_vehicle_1": 16.439373,
        "injury_lr4s_vehicle_2": 14.898267,
        "injury_lr4s_every": 31.337641,
        "injury:lr4s": 31.337641,
    }
    assert injuries("coast", CRASH) == crash
    assert injuries("full_brake", CRASH.replace(gaps_m=30)) == dict.fromkeys(crash, 0.0)


def test_injuries__of_several_impacts_count_the_largest_or_each() -> None:
    load_measures(["injury"])
    # Vehicle 2 pushes Vehicle 1 into a wall.
    pushed = CRASH.replace(obstacle_gap_m=20, restitution=0.5, horizon_s=6, driving_capacity_mps2=6)
    wall = injuries("constant:-6", pushed)
    assert wall["injury_lr4s_every"] > wall["injury_lr4s"]
    assert round(wall["injury_lr4s_vehicle_1"] + wall["injury_lr4s_vehicle_2"], 5) == 976.60554
