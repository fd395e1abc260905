"""docs/reproduction.md is what its committed data say, and the data are what the worlds give."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from ethbrake_marl.studies.reproduction import (
    FIGURES,
    FULL_BRAKE,
    GAPS,
    ITEMS,
    NAMES,
    PERCENT,
    PREFIX,
    READINGS,
    Reproduction,
    Result,
    checked_result,
    collision_rate,
    docs_page,
    drive_list,
    lineup,
    summarise_verdicts,
)

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGE = (DOCS / "reproduction.md").read_text("utf-8")


def _cells(table: dict) -> dict:
    """Each cell as the folder of a reproduction keeps it: a value, and an interval."""
    return table | {"rows": [[[cell] for cell in row] for row in table["rows"]]}


RESULTS: dict[str, Result] = {
    each["name"]: checked_result(each | {"tables": list(map(_cells, each["tables"]))}, "docs", each["name"])
    for each in json.loads((DOCS / "reproduction.json").read_text("utf-8"))
}
MOST_BYTES = 200_000  # of a figure


def test_page__is_made_of_the_committed_data() -> None:
    assert docs_page(list(RESULTS.values())) == PAGE


def test_page__has_every_item_and_every_gap() -> None:
    assert list(RESULTS) == [item.name for item in ITEMS]
    rows = RESULTS["gaps"].tables[0].rows
    assert [row[0].value for row in rows] == [gap.name for gap in GAPS]


def test_page__every_figure_is_there_and_small_and_no_other() -> None:
    shown = set(re.findall(rf"\]\({FIGURES}/({PREFIX}[a-z0-9-]+\.svg)\)", PAGE))
    assert shown == {path.name for path in (DOCS / FIGURES).glob(f"{PREFIX}*")}
    assert {f"{PREFIX}{each.stem}.svg" for result in RESULTS.values() for each in result.figures} == shown
    for name in shown:
        assert 1_000 < (DOCS / FIGURES / name).stat().st_size < MOST_BYTES, name


@pytest.mark.parametrize("name", [item.name for item in ITEMS])
def test_verdict__is_that_of_the_comparisons(name: str) -> None:
    assert summarise_verdicts(RESULTS[name].comparisons) == RESULTS[name].verdict


def test_trajectories__are_as_committed(tmp_path: Path) -> None:
    (item,) = Reproduction.choose(["trajectories"])
    made = item.make(Reproduction("quick", tmp_path))
    committed = RESULTS["trajectories"]
    assert made.verdicts == committed.comparisons
    (table,), (kept,) = made.tables, committed.tables
    assert [[cell.in_words for cell in row] for row in table.shown()] == [
        [cell.value for cell in row] for row in kept.rows
    ]


def test_random_table__full_braking_is_as_committed(tmp_path: Path) -> None:
    tables = {table.title: table for table in RESULTS["random-table"].tables}
    for reading in READINGS:
        scenario = reading.scenario("paper-random")
        evaluation = drive_list(scenario, lineup(scenario, FULL_BRAKE), 10_000, Reproduction("quick", tmp_path))
        outcome = evaluation.outcome(NAMES[FULL_BRAKE])
        (row,) = (row for row in tables[reading.name].rows if row[0].value == NAMES[FULL_BRAKE])
        assert row[1].value == PERCENT.show(collision_rate(outcome.collided)).in_words


def test_page__is_where_the_docs_speak_of_it() -> None:
    for name in ("README", "cli", "paper"):
        assert "(reproduction.md)" in (DOCS / f"{name}.md").read_text("utf-8"), name
    assert all(f"`{item.name}`" in (DOCS / "cli.md").read_text("utf-8") for item in ITEMS)
