"""Results in files and back, and edited files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.evaluation.evaluate import Result
from ethbrake_marl.evaluation.results import read_result, write_results, write_rows
from ethbrake_marl.evaluation.summary import summarise
from tests.evaluation.lines import FULL_BRAKE, PAIR, Foreteller, evaluated, recorded
from tests.refused import refused


def written(folder: Path, result: Result, rows: Any = "csv", **more: Any) -> Path:
    folder.mkdir(exist_ok=True)
    write_results(folder, summarise(result), result, rows, **more)
    return folder / "results.json"


def test_result__comes_back_as_it_was(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    result = evaluated(recorded(4), 30, [FULL_BRAKE, Foreteller()])
    saved = read_result(written(tmp_path / "out", result))
    beside = {each.pop("per_world")["file"] for each in saved.values()}
    assert saved == {each["agent"]: each for each in summarise(result).to_json()}
    frame = pandas.read_csv(tmp_path / "out" / beside.pop())
    for name in ("agent", "world", "recording", "first_impact_harm", "total_harm"):
        assert frame[name].tolist() == result.arrays()[name].tolist()


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
    assert path.read_bytes() != before and read_result(path)["full_brake"]["episodes"] == 3
    with refused("w.parquet: the name of the file must end in .csv"):
        write_rows(tmp_path / "w.parquet", result)


THERE: dict[str, tuple[str, Any]] = {  # name of the file that is there already, and rows to write beside it
    "results, then with rows": ("results.json", "csv"),
    "results alone": ("results.json", None),
}


def content(folder: Path) -> dict[str, Any]:
    return {path.name: path.is_file() and path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize(
    ("kind", "case"), [*(("file", case) for case in THERE), *((kind, next(iter(THERE))) for kind in ("link", "folder"))]
)
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


def test_refused_rows__leave_no_results_beside_them(tmp_path: Path) -> None:
    (tmp_path / "worlds.csv").write_text("mine")
    with refused("worlds.csv: already exists", AlreadyExists):
        written(tmp_path, evaluated(PAIR, 2), "csv")
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


EDITS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "episodes": lambda row: row.update(episodes=2),
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
    '{"kind": "shield"}': "is not a results file",
    '[{"kind": "evaluate"}, 3]': "is not a results file", '{"a": NaN}': "NaN is not a JSON number",
}  # fmt: skip


@pytest.mark.parametrize("content", OTHER)
def test_other_file__is_refused(content: str, tmp_path: Path) -> None:
    (tmp_path / "results.json").write_text(content)
    with refused(OTHER[content]):
        read_result(tmp_path / "results.json")
