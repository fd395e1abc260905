"""The table of results: its estimates, its looks in terminals, and the texts below it."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.errors import InvalidInput, UnknownName
from ethbrake_marl.evaluation import statistics
from ethbrake_marl.evaluation.evaluate import Result
from ethbrake_marl.evaluation.summary import SummaryTable, summarise, summarise_by, summarise_lists
from ethbrake_marl.files.sheet import terminal_text
from tests.evaluation.lines import COAST, FULL_BRAKE, GENTLE, PAIR, Foreteller, evaluated, recorded
from tests.refused import refused

EXPENSIVE = ["pushed_mps", "pushed_m"]


@pytest.fixture(scope="module")
def result() -> Result:
    return evaluated("paper-random", 100, [FULL_BRAKE, GENTLE, Foreteller()], EXPENSIVE)


def at(width: int, table: SummaryTable, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv("COLUMNS", str(width))
    text = str(table)
    assert all(len(line) <= width for line in text.splitlines()), text
    return text


def test_estimates__are_those_of_the_columns(result: Result) -> None:
    full, gentle, foretold = summarise(result)
    mine, other = result["constant:4.0"], result["full_brake"]
    expected = {
        "collision_rate": statistics.rate(mine["collided"]),
        "total_harm": statistics.mean(mine["total_harm"]),
        "total_harm_3": statistics.mean(mine["total_harm_3"]),
        "pushed_mps": statistics.mean(mine["pushed_mps"]),
        "pushed_far_rate": statistics.rate(mine["pushed_m_1"] > 5.0),
        "first_impact_harm_difference": statistics.difference(mine["first_impact_harm"], other["first_impact_harm"]),
        "harm_decrease_total": statistics.decrease(mine["total_harm"], other["total_harm"]),
        "predicted_harm": None,
    }
    assert {key: gentle[key] for key in expected} == expected
    assert foretold["predicted_harm"] == statistics.mean(result.worlds["gap_1_m"])
    assert (gentle.collisions, gentle.episodes) == (int(mine["collided"].sum()), 100)
    assert full["harm_decrease_first"] == statistics.Estimate(0.0, (0.0, 0.0))
    with refused("unknown estimate 'total_harms'; did you mean 'total_harm'?", UnknownName):
        full["total_harms"]


def test_policy_outside_its_training__is_told_in_one_line() -> None:
    at_home, elsewhere = (eb.evaluate(name, "full_brake,ppo", episodes=20) for name in ("paper-random", PAIR))
    assert at_home["ppo"]["outside"].mean() < 0.02 and "outside" not in at_home["full_brake"]
    share = elsewhere["ppo"]["outside"].mean()
    notes = summarise(elsewhere).notes()
    assert not any("outside" in note for note in summarise(at_home).notes()) and share > 0.3
    assert [note for note in notes if f"range of the policy's training: ppo in {100 * share:.0f} %." in note]
    assert summarise(elsewhere).to_json()[1]["outside"] == pytest.approx(share)
    results = {"home": at_home, "pair": elsewhere}
    sheet = summarise_lists({name: summarise(result) for name, result in results.items()}, results)
    assert sheet.note.endswith("outside the range of its training: ppo in pair.")


def test_baseline__can_be_another_or_missing(result: Result) -> None:
    gentle = summarise(result, baseline="constant:4.0")
    same = [row["total_harm_difference"] == statistics.Estimate(0.0, (0.0, 0.0)) for row in gentle]
    assert same == [False, True, False]
    with refused("unknown baseline 'nobody'; known: ", UnknownName):
        summarise(result, baseline="nobody")
    nobody = summarise(evaluated(PAIR, 2, [COAST, GENTLE]))  # without full braking
    assert {row["harm_decrease_first"] for row in nobody} == {None} and "–" in str(nobody)
    one = summarise(evaluated(PAIR, 1, [COAST]))[0]
    assert one["total_harm"].interval is None and one["collision_rate"].interval is not None  # type: ignore[union-attr]


def test_json__has_estimates_with_interval_and_error_and_the_identity(result: Result) -> None:
    rows = summarise(result).to_json()
    assert json.loads(json.dumps(rows, allow_nan=False)) == rows
    row, harm = rows[1], summarise(result)[1]["total_harm"]
    assert harm is not None and harm.interval is not None
    assert [row[f"total_harm{end}"] for end in ("", "_interval", "_error", "_freedom")] == [
        harm.value, list(harm.interval), harm.error, 99.0,
    ]  # fmt: skip
    assert row["kind"] == "evaluate" and row["agent"] == "constant:4.0" and row["knows"] == "own sensors"
    assert row["predicted_harm"] is None and row["predicted_harm_error"] is None
    assert {"worlds_sha256", "scenario_sha256", "physics_digest", "versions"} <= row.keys()
    parameters = row["parameters"]
    assert (parameters["scenario"], parameters["seed"], parameters["count"]) == ("paper-random", 7, 100)
    assert parameters["restitution"] == 0.1 and parameters["mass_t"] == [4.5, 5.5, 5.9]
    assert 5.0 <= parameters["gaps_m"][0][0] < parameters["gaps_m"][0][1] <= 10.0


def test_terminal_of_80__shows_both_harms_with_intervals_and_what_was_asked_for(
    result: Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = at(80, summarise(result), monkeypatch)
    head = " ".join(text.splitlines()[0].split())
    assert head == "Agent, First-impact Total Honest Push Pushed"
    assert "constant:4.0 ‡" in text and "own sensors" in text and "95 % interval" in text
    narrow = at(56, summarise(result), monkeypatch)
    assert "Total" in narrow and "First-impact" in narrow and "Push" not in narrow
    assert "Decrease" in at(140, summarise(result), monkeypatch)


@pytest.mark.parametrize("where", ["terminal", "notebook"])
def test_text__is_plain_wherever_it_is_made(where: str, result: Result, monkeypatch: pytest.MonkeyPatch) -> None:
    table, usual = summarise(result), str(summarise(result))
    if where == "terminal":
        monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
        monkeypatch.setenv("FORCE_COLOR", "1")
        monkeypatch.setenv("TERM", "xterm-256color")
    if where == "notebook":
        shell = type("ZMQInteractiveShell", (), {})()
        monkeypatch.setattr("builtins.get_ipython", lambda: shell, raising=False)
        type(shell).__module__ = "ipykernel.zmqshell"
        monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    assert str(table) == usual and "\x1b" not in usual and len(usual) > 500


def test_meanings__also_of_measures_without_a_column_and_without_marks() -> None:
    told = summarise(eb.evaluate("paper-random", "full_brake", episodes=20, measures="jerk,own", harm_count="honest"))
    meanings = told.meanings()
    assert meanings["jerk"] == "Sum of the term jerk over all steps." and meanings["own"].startswith("What the vehicle")
    assert "``" not in str(meanings) and "docs/game.md" in meanings["Honest cost"]


def test_heading__of_a_measure_of_ones_own_is_shown_whatever_its_name(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(
        "from ethbrake_marl import Part\nfrom ethbrake_marl.evaluation.measures import Statistic\n\n\n"
        "def value(game, alert, last):\n    'Nothing.'\n    return alert.time_s\n\n\n"
        "honest_gap = Part(value, statistics=(Statistic('honest_gap', 'mean', 'Honest gap'),))\n"
    )
    result = eb.evaluate("paper-random", "full_brake", episodes=3, measures=f"{tmp_path / 'mine.py'}:honest_gap")
    assert "honest_gap" in summarise(result).sheet().names


def test_meanings__are_of_the_column_and_not_only_of_its_measure() -> None:
    told = summarise(eb.evaluate("paper-random", "full_brake", episodes=20, measures="pushed_m")).meanings()
    assert told["Vehicle 1 pushed > 5 m"].startswith("Share of worlds") and "Share" not in told["Vehicle 1 pushed (m)"]


def test_data_frame(result: Result) -> None:
    pytest.importorskip("pandas")
    frame, row = summarise(result).to_pandas(), summarise(result)[1]
    assert frame.loc["constant:4.0", "total_harm"] == row["total_harm"].value  # type: ignore[union-attr]
    assert frame.loc["constant:4.0", "total_harm_high"] == row["total_harm"].interval[1]  # type: ignore[union-attr, index]
    assert np.isnan(frame.loc["constant:4.0", "predicted_harm"])


def test_measures_without_a_heading__have_a_table_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    table = summarise(evaluated("paper-random", 20, measures=["jerk", "own"]))
    text = at(80, table, monkeypatch)
    assert "jerk_2 (m2/s6)" in text and "own_total_3 (m2/s2)" in text
    assert summarise(evaluated("paper-random", 20)).measures() is None


def test_vehicles_that_are_equal_under_every_agent__share_a_row() -> None:
    result = evaluated("cooperation-2-five", 2, [FULL_BRAKE, COAST], ["jerk"])
    values = {"full_brake": [1.0, 1.0, 3.0, 1.0, 5.0], "coast": [1.0, 9.0, 3.0, 1.0, 5.0]}
    columns = {
        team: {**result[team], **{f"jerk_{i}": np.full(2, value) for i, value in enumerate(numbers, 1)}}
        for team, numbers in values.items()
    }
    sheet = summarise(replace(result, columns=columns)).measures()
    assert sheet is not None and sheet.headings == ["Measure", "full_brake", "coast"]
    assert [[str(row[0]), *(cell.value for cell in row[1:])] for row in sheet.rows] == [
        ["jerk_1, _4 (m2/s6)", 1.0, 1.0],
        ["jerk_2 (m2/s6)", 1.0, 9.0],
        ["jerk_3 (m2/s6)", 3.0, 3.0],
        ["jerk_5 (m2/s6)", 5.0, 5.0],
    ]


def test_mixed_team__says_who_drives_which_vehicle(monkeypatch: pytest.MonkeyPatch) -> None:
    teams = {"mixed": {"vehicle_2": "coast", "vehicle_3": "constant:4"}, "alike": "coast"}
    table = summarise(eb.evaluate("cooperation-3-pair", teams, episodes=2))
    lines = [line.split("  ")[0].rstrip() for line in at(80, table, monkeypatch).splitlines()]
    assert lines[4:8] == ["mixed", "own sensors", "vehicle_2: coast", "vehicle_3: constant:4"]
    assert "vehicle_2: coast" not in lines[8:] and table[0].to_json()["drivers"]["vehicle_3"] == "constant:4"


# ---- below the table


def pushing(pushed_m: float, moving: int) -> SummaryTable:
    """Full braking, and the same as if it pushed Vehicle 1 so far, and were not at rest in so many of 20 worlds."""
    result = evaluated("paper-random", 20, [FULL_BRAKE], EXPENSIVE)
    ends = np.where(np.arange(20) < moving, "horizon", "at_rest")
    mine = {**result["full_brake"], "pushed_m_1": np.linspace(0.0, 2.0 * pushed_m, 20), "ended": ends}
    columns = {"full_brake": result["full_brake"], "mine": mine}
    both: dict[str, Any] = {"knows": dict.fromkeys(columns, "")} | {
        field: {key: {} for key in columns} for field in ("drivers", "policies", "remarks")
    }
    return summarise(replace(result, columns=columns, **both))


@pytest.mark.parametrize(
    ("pushed_m", "moving", "names"), [(5.1, 1, ["pushes"]), (4.9, 2, ["moving"]), (25.0, 12, ["pushes", "moving"])]
)
def test_exploits__mark_the_row_and_are_a_sentence_below(pushed_m: float, moving: int, names: list[str]) -> None:
    table = pushing(pushed_m, moving)
    assert [row["exploits"] for row in table.to_json()] == [[], names]
    text = " ".join(str(table).split())
    assert ("mine ‡" in text) == bool(names) and "full_brake ‡" not in text
    assert (f"pushes Vehicle 1 by {pushed_m:.1f} m on average" in text) == ("pushes" in names)
    assert (f"runs past the horizon in {5 * moving:.1f} % of worlds" in text) == ("moving" in names)


def test_notes__of_rejected_draws_and_recordings() -> None:
    rejecting = {**recorded(8).declared(), "early_impacts": "reject", "latency_s": [0.0, {"uniform": [0.3, 1.5]}, 1.6]}
    table = summarise(evaluated(rejecting, 60))
    text = " ".join(str(table).split())
    rejected = table.parameters["rejected_draws"]
    share = f"{100 * rejected / (60 + rejected):.1f} %"
    assert rejected > 0 and f"{rejected} of {60 + rejected} drawn worlds ({share}) were rejected" in text
    assert "60 worlds, seed 7; 95 % intervals by 8 recordings; d = " in text
    single = summarise(evaluated(recorded(1), 20))
    assert "no 95 % intervals: all worlds come from one recording" in " ".join(str(single).split())
    assert single[0]["total_harm"].interval is None  # type: ignore[union-attr]


# ---- groups and lists


def test_groups__have_the_estimates_of_their_worlds() -> None:
    result = evaluated("mixture-delays", 30)
    tables = summarise_by(result, "scenario")
    assert {name: table[0].episodes for name, table in tables.items()} == {
        "paper-delay-high": 11, "paper-delay-low": 8, "paper-delay-middle": 11,
    }  # fmt: skip
    mine = result.worlds["scenario"] == "paper-delay-low"
    harm = result["constant:4.0"]["total_harm"][mine]
    assert tables["paper-delay-low"][1]["total_harm"] == statistics.mean(harm)
    assert "mixture-delays: 8 worlds, seed 7; d =" in " ".join(str(tables["paper-delay-low"]).split())
    with refused("unknown group 'scenarios'; did you mean 'scenario'?", UnknownName):
        summarise_by(result, "scenarios")
    with refused("by = 'scenario': these worlds have no groups", InvalidInput):
        summarise_by(evaluated(PAIR, 2), "scenario")


def test_lists__stand_below_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    far = {**PAIR, "name": "far", "gaps_m": 1000.0}
    results = {str(each["name"]): evaluated(each, 3, [FULL_BRAKE]) for each in (PAIR, far)}
    monkeypatch.setenv("COLUMNS", "80")
    text = terminal_text(summarise_lists({name: summarise(each) for name, each in results.items()}, results))
    rows = [line.split() for line in text.splitlines() if line.startswith(("pair", "far", "full"))]
    assert rows == [
        ["pair"], ["full_brake", "failed", "100.0", "%", "10.8", "9.00", "9.00", "9.00"],
        ["far"], ["full_brake", "passed", "0.0", "%", "0.0", "0.00", "0.00", "0.00"],
    ]  # fmt: skip


def test_lists__of_worlds_that_differ_show_the_worst_impact_and_the_mean_harm() -> None:
    result = evaluated("paper-random", 20)
    collided = result["full_brake"]["collided"]
    one = result.take(np.append(np.flatnonzero(collided)[:1], np.flatnonzero(~collided)[:3]))
    results = {"twenty": result, "one of four collides": one}
    sheet = summarise_lists({name: summarise(each) for name, each in results.items()}, results)
    rows = iter(sheet.rows)
    for name, each in results.items():
        assert next(rows) == name
        for agent, own in each.columns.items():
            assert next(rows) == (
                agent,
                "failed" if own["collided"].any() else "passed",
                pytest.approx(own["collided"].mean()),
                pytest.approx(3.6 * max(own["hardest_impact_mps"].tolist())),
                pytest.approx(own["first_impact_harm"].mean()),
                pytest.approx(own["total_harm"].mean()),
                pytest.approx(own["honest_cost"].mean()),
            )
    assert one["full_brake"]["collided"].tolist() == [True, False, False, False]


def test_summary__of_one_scenario_of_a_mixture_has_no_range_of_what_is_not_there() -> None:
    both = [{"scenario": "paper-random"}, {"scenario": "paper-random-obstacle"}]
    mixture = eb.load_scenario({"name": "both", "mixture": both})
    tables = eb.summarise_by(eb.evaluate(mixture, "coast", episodes=8), "scenario")
    assert any("obstacle_gap_m" not in table.parameters for table in tables.values())
