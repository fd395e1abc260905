"""Results in files and back, edited files, and comparisons of two results."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.evaluation.compare import compare_results
from ethbrake_marl.evaluation.evaluate import Result
from ethbrake_marl.evaluation.results import read_result, write_results, write_rows
from ethbrake_marl.evaluation.statistics import difference, mean, unpaired
from ethbrake_marl.evaluation.summary import summarise
from ethbrake_marl.worlds.catalogue import load_scenario
from tests.evaluation.lines import COAST, FULL_BRAKE, GENTLE, PAIR, Foreteller, evaluated, recorded
from tests.refused import refused


def written(folder: Path, result: Result, rows: Any = "csv", **more: Any) -> Path:
    folder.mkdir(exist_ok=True)
    write_results(folder, summarise(result), result, rows, **more)
    return folder / "results.json"


def called_mine(scenario: Any, n: int, agent: Any) -> Result:
    found = evaluated(scenario, n, [agent])
    return replace(found, columns={"mine": found[agent.name]}, knows={"mine": ""}, policies={"mine": {}})


@pytest.mark.parametrize("rows", ["csv", "parquet"])
def test_result__comes_back_as_it_was(rows: str, tmp_path: Path) -> None:
    if rows == "parquet":
        pytest.importorskip("pyarrow")
    result = evaluated(recorded(4), 30, [FULL_BRAKE, Foreteller()])
    saved, table = read_result(written(tmp_path / "out", result, rows)), summarise(result)
    assert saved.rows is not None and saved.no_rows_because == ""
    for name in ("agent", "world", "recording", "first_impact_harm", "total_harm"):
        assert saved.rows[name].tolist() == result.arrays()[name].tolist()
    own = {name: {k: v for k, v in each.items() if k != "per_world"} for name, each in saved.agents.items()}
    assert own == {each["agent"]: each for each in table.to_json()}
    assert saved.estimate("foreteller", "predicted_harm") == table[1]["predicted_harm"]
    assert compare_results(saved, result).differences["full_brake"]["total_harm"].interval == (0.0, 0.0)


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
    written(tmp_path / "out", evaluated(PAIR, 3), force=True)
    assert path.read_bytes() != before and read_result(path).about["episodes"] == 3
    with refused("must end in .csv or .parquet"):
        write_rows(tmp_path / "w.txt", result)


THERE: dict[str, tuple[str, Any]] = {  # name of the file that is there already, and rows to write beside it
    "results, then with rows": ("results.json", "csv"),
    "results, then with other rows": ("results.json", "parquet"),
    "results of another name": ("mine.json", "csv"),
    "results alone": ("results.json", None),
}


def content(folder: Path) -> dict[str, Any]:
    return {path.name: path.is_file() and path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("case", THERE)
@pytest.mark.parametrize("kind", ["file", "link", "folder"])
def test_refused_results__leave_every_file_as_it_was(case: str, kind: str, tmp_path: Path) -> None:
    name, rows = THERE[case]
    result = evaluated(PAIR, 2)
    if kind == "file":
        written(tmp_path, result, None, name=name)
    elif kind == "link":
        (tmp_path / name).symlink_to("elsewhere.json")
    else:
        (tmp_path / name).mkdir()
    before = content(tmp_path)
    with pytest.raises(AlreadyExists if kind == "file" else InvalidInput, match=rf"{name}: (already exists|is a )"):
        written(tmp_path, evaluated(PAIR, 3), rows, name=name)
    assert content(tmp_path) == before


@pytest.mark.parametrize("rows", ["csv", "parquet"])
def test_refused_rows__leave_no_results_beside_them(rows: str, tmp_path: Path) -> None:
    if rows == "parquet":
        pytest.importorskip("pyarrow")
    (tmp_path / f"worlds.{rows}").write_text("mine")
    with refused(f"worlds.{rows}: already exists", AlreadyExists):
        written(tmp_path, evaluated(PAIR, 2), rows)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


EDITS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "episodes": lambda row: row.update(episodes=2),
    "interval": lambda row: row.update(total_harm_interval=[0.0, 1e30]),
    "error": lambda row: row.update(total_harm_error=1e-9),
    "name": lambda row: row.update(agent="mine"),
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


OTHER = {
    "": "must contain complete JSON", "[]": "is not a results file", '{"kind": "shield"}': "is not a results file",
    '[{"kind": "evaluate"}, 3]': "is not a results file", '{"a": NaN}': "NaN is not a JSON number",
}  # fmt: skip


@pytest.mark.parametrize("content", OTHER)
def test_other_file__is_refused(content: str, tmp_path: Path) -> None:
    (tmp_path / "results.json").write_text(content)
    with refused(OTHER[content]):
        read_result(tmp_path / "results.json")


def test_rows__that_were_changed_or_removed_are_not_paired(tmp_path: Path) -> None:
    path, rows = written(tmp_path / "out", evaluated("paper-random", 20)), tmp_path / "out" / "worlds.csv"
    rows.write_text(rows.read_text().replace("full_brake,1,", "full_brake,2,"))
    assert "was changed after" in read_result(path).no_rows_because
    rows.unlink()
    found = compare_results(read_result(path), evaluated("paper-random", 20))
    assert "does not exist" in found.unpaired_because and found.to_json()["intervals"] == "unpaired"


# ---- comparisons


def test_comparison__is_paired_by_world_where_both_have_rows(tmp_path: Path) -> None:
    one = evaluated("paper-random", 60, [FULL_BRAKE, COAST])
    other = evaluated("paper-random", 60, [GENTLE._replace(name="constant:4"), FULL_BRAKE])
    mine = {"full_brake": other["constant:4"], "constant:4": other["full_brake"]}
    other = replace(other, columns=mine)
    found = compare_results(*(read_result(written(tmp_path / name, each)) for name, each in (("1", one), ("2", other))))
    (harms,) = found.differences.values()
    assert harms["total_harm"] == difference(other["full_brake"]["total_harm"], one["full_brake"]["total_harm"])
    assert found.left_over == (("coast",), ("constant:4",)) and found.unpaired_because == ""
    assert found.to_json()["intervals"] == "paired" and json.dumps(found.to_json(), allow_nan=False)
    assert found == compare_results(one, other)
    notes = " ".join(found.notes())
    assert "paired by world." in notes and "Only in the first result: coast." in notes


@pytest.mark.parametrize("stored", [False, True])
@pytest.mark.parametrize("rows", ["csv", None])
def test_comparison__is_of_each_agent_with_itself_in_whatever_order(rows: Any, stored: bool, tmp_path: Path) -> None:
    one = evaluated("paper-random", 40, [FULL_BRAKE, COAST, GENTLE])
    full, coast, gentle = one.columns.values()
    other = replace(one, columns={"constant:4.0": coast, "full_brake": full, "coast": gentle})
    pair = [read_result(written(tmp_path / name, each, rows)) for name, each in (("1", one), ("2", other))]
    found = compare_results(*(pair if stored or rows is None else (one, other)))
    assert [*found.differences] == [*one.columns] and found.left_over == ((), ())
    for agent, harms in found.differences.items():
        for harm, estimate in harms.items():
            after, before = other[agent][harm], one[agent][harm]
            expected = difference(after, before) if rows else unpaired(mean(after), mean(before))
            assert estimate.value == pytest.approx(expected.value) and estimate.interval == expected.interval
    values = [harms["total_harm"].value for harms in found.differences.values()]
    assert values[0] == 0.0 and values[1] < -10.0 and values[2] > 10.0


def test_comparison__is_by_recording(tmp_path: Path) -> None:
    one, other = (called_mine(recorded(8), 100, agent) for agent in (FULL_BRAKE, GENTLE))
    found = compare_results(read_result(written(tmp_path / "one", one)), other)
    expected = difference(other["mine"]["total_harm"], one["mine"]["total_harm"], one.clusters)
    assert found.recordings == 8 and found.differences["mine"]["total_harm"] == expected
    assert "95 % intervals by 8 recordings" in " ".join(found.notes())


@pytest.mark.parametrize("n", [3, 60])
def test_comparison__without_rows_uses_the_stored_errors(n: int, tmp_path: Path) -> None:
    one, other = (called_mine("realistic-motorway", n, agent) for agent in (FULL_BRAKE, COAST))  # intervals cut at 0
    saved = [read_result(written(tmp_path / name, each, None)) for name, each in (("one", one), ("two", other))]
    found = compare_results(*saved)
    x, y = (each["mine"]["total_harm"] for each in (other, one))
    welch = stats.ttest_ind(x, y, equal_var=False).confidence_interval()
    assert found.differences["mine"]["total_harm"].interval == pytest.approx((welch.low, welch.high), rel=1e-9)
    assert "NOT paired by world" in next(found.notes()) and "evaluate again with --per-world" in found.unpaired_because


def test_comparison__notes_other_policies_settings_versions_and_physics() -> None:
    result = evaluated(PAIR, 4)
    versions = {**result.about["versions"], "numpy": "1.0"}
    about = {"physics_digest": "0" * 64, "versions": versions, "agent_settings": {"harm_count": "total"}}
    policies = {"full_brake": {"vehicle_2": "a"}, "constant:4.0": {}}
    found = compare_results(result, replace(result, about={**result.about, **about}, policies=policies))
    notes = [*found.notes()]
    assert "Note: harm_count: missing in the first result, total in the second." in notes
    assert any(note.startswith("Note: physics_digest: ") for note in notes)
    assert any(note.startswith("Note: numpy: ") and note.endswith("1.0 in the second.") for note in notes)
    assert "Note: policy of vehicle_2 in full_brake: missing in the first result, a in the second." in notes


def changed(**settings: Any) -> Callable[[], Result]:
    return lambda: evaluated(load_scenario("paper-random").replace(**settings).declared(), 20)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (lambda: evaluated("paper-random", 21), "cannot be compared: their worlds differ (worlds_sha256 is "),
        (lambda: evaluated("paper-random", 20, [COAST]), "have no agent in common"),
        (changed(horizon_s=7.0), "their scenarios differ"),
        (changed(roles={"vehicle_2": "full_brake", "vehicle_3": "learner"}), "worlds differ"),
    ],
)
def test_comparison__of_what_is_not_comparable(other: Callable[[], Result], message: str) -> None:
    with refused(message):
        compare_results(evaluated("paper-random", 20, [FULL_BRAKE]), other())


def test_comparison__of_other_parts_of_a_result_is_refused() -> None:
    result = evaluated("paper-random", 20)
    with refused("they do not list the same worlds"):
        compare_results(result.take(np.arange(5)), result.take(np.arange(5, 10)))
