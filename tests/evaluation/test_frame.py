"""One row per agent and world as a frame and as Parquet."""

from __future__ import annotations

import csv
import io
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.errors import InvalidInput, MissingExtra, UnknownName
from ethbrake_marl.evaluation.results import read_harms, write_per_world

SCENARIO = eb.load_scenario("paper-random")


@pytest.fixture(scope="module")
def evaluation() -> eb.Evaluation:
    agents = {"full_brake": eb.make_agent("full_brake"), "coast": eb.make_agent("coast")}
    return eb.evaluate(SCENARIO.sample(20, seed=7), agents, scenario=SCENARIO, seed=7)


def test_columns__are_those_of_the_csv_file(evaluation: eb.Evaluation, tmp_path: Path) -> None:
    columns = evaluation.to_frame("columns")
    write_per_world(tmp_path / "worlds.csv", evaluation)
    rows = list(csv.DictReader(io.StringIO((tmp_path / "worlds.csv").read_text())))
    assert list(columns) == list(rows[0]) and {len(column) for column in columns.values()} == {40} == {len(rows)}
    assert columns["agent"].tolist() == [row["agent"] for row in rows]
    assert columns["total_harm"].tolist() == [float(row["total_harm"]) for row in rows]
    assert columns["world"].dtype.kind == "i" and np.isnan(columns["predicted_harm"]).all()


@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_frame__is_made_by_the_library_that_is_there(
    evaluation: eb.Evaluation, library: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    planted: Any = ModuleType(library)
    planted.DataFrame = lambda columns: (library, columns)
    monkeypatch.setitem(sys.modules, library, planted)
    monkeypatch.setattr("ethbrake_marl.evaluation.measures.find_spec", lambda name: name == library or None)
    made, columns = evaluation.to_frame()
    assert made == library and len(columns["agent"]) == 40


def test_frame__without_any_library_is_a_mapping_of_columns(
    evaluation: eb.Evaluation, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ethbrake_marl.evaluation.measures.find_spec", lambda name: None)
    assert isinstance(evaluation.to_frame(), dict)
    with pytest.raises(UnknownName, match="did you mean 'pandas'"):
        evaluation.to_frame("panda")


@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_frame__of_the_library_itself_has_a_row_per_agent_and_world(evaluation: eb.Evaluation, library: str) -> None:
    pytest.importorskip(library)
    frame = evaluation.to_frame(library)
    assert type(frame).__module__.split(".")[0] == library and len(frame) == 40
    assert float(frame["total_harm"].sum()) == pytest.approx(
        sum(float(outcome.total_harm.sum()) for outcome in evaluation.outcomes.values())
    )


def test_parquet__without_pyarrow_names_the_extra(
    evaluation: eb.Evaluation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingExtra, match=r"pyarrow, which is not installed: .*pip install 'ethbrake-marl\[data\]'"):
        write_per_world(tmp_path / "worlds.parquet", evaluation)
    write_per_world(tmp_path / "worlds.csv", evaluation)


def test_parquet__holds_what_the_csv_file_holds(evaluation: eb.Evaluation, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    for name in ("worlds.csv", "worlds.parquet"):
        write_per_world(tmp_path / name, evaluation)
    csv_file, other = tmp_path / "worlds.csv", tmp_path / "worlds.parquet"
    assert read_harms(csv_file, csv_file.read_bytes()) == read_harms(other, other.read_bytes())
    assert parquet.read_table(tmp_path / "worlds.parquet").column("predicted_harm").null_count == 40


_HEAD = "agent,world,first_impact_harm,total_harm\n"


@pytest.mark.parametrize(
    "text", ["a,b\n1,2\n", f"{_HEAD}a,x,1,1\n", f"{_HEAD}a,1,nan,1\n", f"{_HEAD}a,1,1,1e300\n", "\xff"]
)
def test_read_harms__refuses_another_table(text: str) -> None:
    with pytest.raises(InvalidInput, match=r"x\.csv: is no file of --per-world"):
        read_harms(Path("x.csv"), text.encode("latin-1"))
