"""Results in files and back, hostile and edited files, and comparisons of two results."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.evaluation.compare import compare_results
from ethbrake_marl.evaluation.evaluate import Result
from ethbrake_marl.evaluation.results import _digest, read_result, write_results, write_rows
from ethbrake_marl.evaluation.statistics import difference
from ethbrake_marl.evaluation.summary import summarise
from tests.evaluation.lines import COAST, FULL_BRAKE, GENTLE, PAIR, Foreteller, evaluated, recorded
from tests.refused import refused

ROWS = ["csv", "parquet", "json"]


def written(folder: Path, result: Result, rows: Any = "csv", **more: Any) -> Path:
    folder.mkdir(exist_ok=True)
    write_results(folder, summarise(result), result, rows, **more)
    return folder / "results.json"


def same(one: Result, other: Result) -> None:
    for mine, theirs in ((one.worlds, other.worlds), *((one[team], other[team]) for team in one.columns)):
        assert mine.keys() == theirs.keys()
        for name, column in mine.items():
            assert column.dtype.kind == theirs[name].dtype.kind, name
            assert np.array_equal(column, theirs[name], equal_nan=column.dtype.kind == "f"), name


@pytest.mark.parametrize("rows", ROWS)
@pytest.mark.parametrize("scenario", ["paper-random", "mixture-obstacle", "recorded", "engineering-loaded-lorries"])
def test_result__comes_back_as_it_was(scenario: str, rows: str, tmp_path: Path) -> None:
    if rows == "parquet":
        pytest.importorskip("pyarrow")
    declared = recorded(4).declared() if scenario == "recorded" else scenario
    result = evaluated(declared, 30, [FULL_BRAKE, Foreteller()], ["sampled_harm", "jerk", "own"])
    saved = read_result(written(tmp_path / "out", result, rows))
    assert saved.result is not None and saved.no_rows_because == ""
    same(saved.result, result)
    assert summarise(saved.result).to_json() == summarise(result).to_json()
    assert {
        (c.unpaired_because, c.differences[0].harms["total_harm"].value) for c in [compare_results(saved, result)]
    } == {("", 0.0)}


def test_rows__have_empty_cells_and_numbers_for_truths(tmp_path: Path) -> None:
    write_rows(tmp_path / "w.csv", evaluated(PAIR, 1, [FULL_BRAKE, Foreteller()]))
    head, first, second = (line.split(",") for line in (tmp_path / "w.csv").read_text().splitlines())
    row, foretold = dict(zip(head, first, strict=True)), dict(zip(head, second, strict=True))
    assert (row["agent"], row["world"], row["collided"], row["predicted_harm"]) == ("full_brake", "0", "1", "")
    assert (foretold["predicted_harm"], foretold["ended"], foretold["hidden"]) == ("1.0", "at_rest", "0")
    assert float(row["total_harm_2"]) == pytest.approx(4.05)


def test_files__are_not_overwritten_unless_forced(tmp_path: Path) -> None:
    result = evaluated(PAIR, 2)
    path = written(tmp_path / "out", result)
    before = path.read_bytes()
    with refused("already exists", AlreadyExists):
        written(tmp_path / "out", result)
    written(tmp_path / "out", evaluated(PAIR, 3), force=True, more={"agent_settings": {"harm_count": "total"}})
    assert path.read_bytes() != before and read_result(path).about["agent_settings"] == {"harm_count": "total"}
    with refused("must end in .csv, .parquet or .json"):
        write_rows(tmp_path / "w.txt", result)


EDITS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "episodes": lambda row: row.update(episodes=2),
    "interval": lambda row: row.update(total_harm_interval=[0.0, 1e30]),
    "mean": lambda row: row.update(total_harm=1.0),
    "error": lambda row: row.update(total_harm_error=1e-9),
    "name": lambda row: row.update(agent="mine"),
    "digest of the worlds": lambda row: row.update(worlds_sha256="0" * 64),
    "one key less": lambda row: row.pop("collisions"),
    "one key more": lambda row: row.update(extra=1),
    "another digest": lambda row: row.update(results_sha256="0" * 64),
    "no digest": lambda row: row.pop("results_sha256"),
}


@pytest.mark.parametrize("edit", EDITS)
def test_edited_file__is_refused_in_one_line(edit: str, tmp_path: Path) -> None:
    path = written(tmp_path / "out", evaluated("paper-random", 20), None)
    rows = json.loads(path.read_text())
    EDITS[edit](rows[0])
    path.write_text(json.dumps(rows))
    with refused("was edited after it was written, or is of another version; evaluate again"):
        read_result(path)


HOSTILE: dict[str, Callable[[dict[str, Any]], Any]] = {
    "episodes is missing or not of type int": lambda row: row.update(episodes=True),
    "must be numbers of worlds": lambda row: row.update(episodes=0),
    "episodes, collisions, horizon_ends must be": lambda row: row.update(collisions=21),
    "total_harm = -1.0": lambda row: row.update(total_harm=-1.0),
    "total_harm = 1e+300": lambda row: row.update(total_harm=1e300, total_harm_interval=None),
    "total_harm_interval = [0.0, 0.1]": lambda row: row.update(total_harm_interval=[0.0, 0.1]),
    "total_harm_interval = [1]": lambda row: row.update(total_harm_interval=[1]),
    "must be a mean harm": lambda row: row.update(total_harm="12"),
    "and an interval [low, high] that contains it": lambda row: row.update(total_harm_freedom=None),
    "policy_sha256 is missing or not of type dict": lambda row: row.update(policy_sha256=[]),
    "its rows per world cannot be read": lambda row: row.update(per_world={"file": ["x"], "sha256": 1}),
}


@pytest.mark.parametrize("message", HOSTILE)
def test_hostile_file__with_a_digest_of_its_own_is_refused(message: str, tmp_path: Path) -> None:
    path = written(tmp_path / "out", evaluated("paper-random", 20), None)
    rows = [
        {key: value for key, value in row.items() if key != "results_sha256"} for row in json.loads(path.read_text())
    ]
    HOSTILE[message](rows[0])
    path.write_text(json.dumps([{**row, "results_sha256": _digest(rows)} for row in rows]))
    with refused(message):
        read_result(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "must contain complete JSON"),
        ("[]", "is not a results file"),
        ('{"kind": "shield"}', "is not a results file"),
        ('[{"kind": "evaluate"}, 3]', "is not a results file"),
        ('{"a": NaN}', "NaN is not a JSON number"),
        ("[" * 100_000, "must contain complete JSON"),
    ],
)
def test_other_file__is_refused(content: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "results.json").write_text(content)
    with refused(message):
        read_result(tmp_path / "results.json")


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace("full_brake", "full_break"),
        lambda text: text[: len(text) // 2],
        lambda text: "agent\n",
        lambda text: text.replace("at_rest", "1e999"),
    ],
)
def test_changed_rows__are_not_paired_and_damaged_ones_are_refused(
    change: Callable[[str], str], tmp_path: Path
) -> None:
    path, rows = written(tmp_path / "out", evaluated("paper-random", 20)), tmp_path / "out" / "worlds.csv"
    text = change(rows.read_text())
    rows.write_text(text)
    assert "was changed after" in read_result(path).no_rows_because
    objects = [{k: v for k, v in row.items() if k != "results_sha256"} for row in json.loads(path.read_text())]

    for row in objects:
        row["per_world"]["sha256"] = hashlib.sha256(rows.read_bytes()).hexdigest()
    path.write_text(json.dumps([{**row, "results_sha256": _digest(objects)} for row in objects]))
    if "1e999" not in text:
        with refused("its rows per world cannot be read"):
            read_result(path)


# ---- comparisons


def test_comparison__is_paired_by_world_where_both_have_rows(tmp_path: Path) -> None:
    one = evaluated("paper-random", 60, [FULL_BRAKE, COAST])
    other = evaluated("paper-random", 60, [GENTLE._replace(name="constant:4"), FULL_BRAKE])
    mine = {"full_brake": other["constant:4"], "constant:4": other["full_brake"]}
    other = Result(mine, other.worlds, other.measures, other.knows, other.policies, other.about)
    found = compare_results(
        read_result(written(tmp_path / "one", one, "csv")), read_result(written(tmp_path / "two", other, "json"))
    )
    (each,) = found.differences
    assert each.harms["total_harm"] == difference(other["full_brake"]["total_harm"], one["full_brake"]["total_harm"])
    assert found.left_over == (("coast",), ("constant:4",)) and found.unpaired_because == ""
    assert found.to_json()["intervals"] == "paired" and json.dumps(found.to_json(), allow_nan=False)
    assert found == compare_results(one, other)
    notes = " ".join(found.notes())
    assert "paired by world." in notes and "Only in the first result: coast." in notes


def test_comparison__is_by_recording(tmp_path: Path) -> None:
    one, other = (evaluated(recorded(8), 100, [agent._replace(name="mine")]) for agent in (FULL_BRAKE, GENTLE))
    found = compare_results(read_result(written(tmp_path / "one", one)), other)
    expected = difference(other["mine"]["total_harm"], one["mine"]["total_harm"], one.clusters)
    assert found.recordings == 8 and found.differences[0].harms["total_harm"] == expected
    assert "95 % intervals by 8 recordings" in " ".join(found.notes())


@pytest.mark.parametrize("n", [3, 12, 60])
def test_comparison__without_rows_uses_the_stored_errors(n: int, tmp_path: Path) -> None:
    scenario = "realistic-motorway"  # rare harm: intervals are cut at 0
    one, other = (evaluated(scenario, n, [agent._replace(name="mine")]) for agent in (FULL_BRAKE, COAST))
    saved = [read_result(written(tmp_path / name, each, None)) for name, each in (("one", one), ("two", other))]
    found = compare_results(*saved)
    x, y = (each["mine"]["total_harm"] for each in (other, one))
    welch = stats.ttest_ind(x, y, equal_var=False).confidence_interval()
    assert found.differences[0].harms["total_harm"].interval == pytest.approx((welch.low, welch.high), rel=1e-9)
    assert "NOT paired by world" in found.notes()[0] and "evaluate again with --per-world" in found.unpaired_because


def test_comparison__notes_other_settings_versions_and_physics(tmp_path: Path) -> None:
    result = evaluated(PAIR, 4)
    about = {**result.about, "physics_digest": "0" * 64, "versions": {**result.about["versions"], "numpy": "1.0"}}
    other = Result(result.columns, result.worlds, result.measures, result.knows, result.policies, about)
    one = written(tmp_path / "one", result, more={"agent_settings": {"harm_count": "first"}})
    two = written(tmp_path / "two", other, more={"agent_settings": {"harm_count": "total"}})
    notes = compare_results(read_result(one), read_result(two)).notes()
    assert "Note: physics_digest differs." in notes
    assert "Note: harm_count: first in the first result, total in the second." in notes
    assert any(note.startswith("Note: numpy: ") and note.endswith("1.0 in the second.") for note in notes)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (lambda: evaluated("paper-random", 21), "cannot be compared: their worlds differ (worlds_sha256 is "),
        (lambda: evaluated("paper-random", 20, [COAST]), "have no agent in common"),
        (lambda: evaluated(slow("time_step_s", 0.2), 20), "their scenarios differ"),
        (lambda: evaluated(slow("roles", {"vehicle_2": "full_brake", "vehicle_3": "learner"}), 20), "worlds differ"),
    ],
)
def test_comparison__of_what_is_not_comparable(other: Callable[[], Result], message: str) -> None:
    with refused(message, InvalidInput):
        compare_results(evaluated("paper-random", 20, [FULL_BRAKE]), other())


def slow(key: str, value: Any) -> dict[str, Any]:
    from ethbrake_marl.worlds.catalogue import load_scenario

    return dict(load_scenario("paper-random").replace(**{key: value}).declared())
