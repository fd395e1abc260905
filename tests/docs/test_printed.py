"""Everything that the pages show as printed has its place where it is compared; what is quick is compared here."""

import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from ethbrake_marl.agents.e_v2x_bm import optimise_pairwise, pairwise_harm
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.scenario import load_scenario
from tests.docs.printed import (
    BLOCKS,
    EXACT,
    MEASURED,
    PICTURES,
    ROOT,
    TABLES,
    How,
    Shown,
    agrees,
    commands_of,
    how,
    missing_figures,
    pages,
    pictures,
    printed_blocks,
    results,
    tables_of_figures,
    where_rows,
)
from tests.docs.site import DOCS, load
from tests.programmes.libraries import harm_of_howto

Run = Callable[..., tuple[str, str]]


KINDS = [
    pytest.param(printed_blocks, BLOCKS, id="blocks"),
    pytest.param(tables_of_figures, TABLES, id="tables"),
    pytest.param(pictures, PICTURES, id="pictures"),
]


@pytest.mark.parametrize(("shown", "table"), KINDS)
def test_everything_shown__has_its_place(shown: Callable[[], Iterator[Shown]], table: dict[str, How]) -> None:
    found = [(each, how(table, each.begin)) for each in shown()]
    assert [f"{each.page}: {each.begin}" for each, place in found if place is None] == []
    used = {place[0] for _, place in found if place is not None}
    assert [key for key in table if key not in used] == []


def test_everything_shown__names_tests_and_programs_that_are_there() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE))
    for place in (*BLOCKS.values(), *TABLES.values(), *PICTURES.values(), *(place for _, place in results())):
        for by in place.by:
            assert not by.startswith("tests/") or (ROOT / by).exists(), by
            assert not by.startswith("make ") or by.split()[1] in targets, by


def test_page__shows_where_each_is_compared() -> None:
    assert "\n".join(where_rows()) + "\n" in (ROOT / "docs" / "tests.md").read_text("utf-8")


def test_results__are_linked_where_they_are_and_written_row_by_row() -> None:
    anchors = [(Path(each.page).stem, each.begin) for each, _ in results()]
    text = "".join(page.read_text("utf-8") for page in pages())
    assert set(re.findall(r"results/([a-z-]+)\.md#([a-z0-9-]+)\)", text)) <= set(anchors)
    assert len({anchor for _, anchor in anchors}) == len(anchors)
    for path in MEASURED.RESULTS.glob("*.json"):
        assert MEASURED.text_of(MEASURED.read_tables(path.stem)) == path.read_text("utf-8")
        with pytest.raises(ValueError, match="notes"):
            MEASURED.TABLES.validate_json(path.read_bytes().replace(b'"note"', b'"notes"'))


@pytest.fixture
def told(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Runs a command line in this process in an empty folder; stderr and stdout."""
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.chdir(tmp_path)

    def call(command: str) -> tuple[str, str]:
        capsys.readouterr()
        run_command(command.split()[1:])
        captured = capsys.readouterr()
        return captured.err, captured.out

    return call


def _blocks() -> list[Shown]:
    places = [(each, how(BLOCKS, each.begin)) for each in printed_blocks()]
    own = [each for each, place in places if place is not None and place[1] == EXACT and "ethbrake" in each.begin]
    return [each for each in own if "tutorials" not in each.page]  # of which tests/cli/test_scenarios.py takes care


@pytest.mark.parametrize("block", _blocks(), ids=lambda block: block.begin[:60])
def test_block__is_what_its_commands_print(block: Shown, told: Run) -> None:
    if block.begin == "ethbrake scenario validate rainy.yaml":  # whose mistake the page tells
        told("ethbrake scenario new rainy")
        text = Path("rainy.yaml").read_text("utf-8")
        Path("rainy.yaml").write_text(text.replace("\nmass_t:", "\nmass_kg:"))
    for command, shown in commands_of(block.text):
        assert agrees(shown, "".join(told(command)).splitlines()), command


@pytest.mark.slow
def test_table_of_shipped_lists__is_printed_by_its_command(told: Run) -> None:
    (table,) = (each for each in MEASURED.read_tables("best-harm") if each.id == "proven-and-found")
    printed = told("ethbrake search best-harm --shipped")[1].splitlines()
    for row in (table.columns, *table.rows):
        assert any(one.startswith(f"| {' | '.join(row)}") for one in printed), row


def test_reference_values__are_those_of_the_closed_form() -> None:
    (table,) = (each for each in MEASURED.read_tables("baselines") if each.id == "closed-form-values")
    for row in table.rows:
        world, ends, optimum, full = row
        gaps, speeds, latency = ([float(word) for word in part.split(",")] for part in world.split(";"))
        scenario = load_scenario("paper-random").replace(latency_s=[0.0, *latency])
        start = {f"gap_{k}_m": [gap] for k, gap in enumerate(gaps, 1)}
        start |= {f"speed_{k}_mps": [speed] for k, speed in enumerate(speeds, 1)}
        worlds = scenario.worlds_from_table(start)
        found = optimise_pairwise(worlds, 1)
        told = [found.spares_front_mps2, found.spares_rear_mps2, found.deceleration_mps2, found.harm]
        told.append(pairwise_harm(worlds, [6, 7, 6]).sum(axis=1))
        assert missing_figures(f"{ends} {optimum} {full}", " ".join(repr(float(each[0])) for each in told)) == [], row


@pytest.mark.slow
def test_speeds__outside_their_range_are_as_shown() -> None:
    (block,), speeds = (
        [b for b in printed_blocks() if b.begin.startswith("paper-random full_brake  ")],
        load("../studies/speeds"),
    )
    assert [speeds.line(*case) for case in speeds.CASES] == block.text.splitlines()


@pytest.mark.parametrize(
    ("shown", "printed", "same"),
    [
        ("a", "a", True),
        ("a", "b", False),
        ("a\n...\nd", "a\nb\nc\nd", True),
        ("a\n...\nd", "a\nd", True),
        ("a\n...", "a\nb", True),
        ("a\n  ...\nc", "a\nb", False),
        ("...\na", "b\na\n\n", True),
        ("a", "a\nb", False),
        ("", "a", False),
        ("a ...", "a b c", True),
        ("a ...", "b", False),
        ("a...", "ab", False),
    ],
)
def test_agrees__where_dots_stand_for_any_lines(shown: str, printed: str, same: bool) -> None:
    assert agrees(shown.splitlines(), printed.splitlines()) == same


@pytest.mark.parametrize(
    ("table", "printed", "missing"),
    [
        ("| a | 1.25 |", "1.2496", []),
        ("| a | 1.25 |", "1.244", ["1.25"]),
        ("| a | 65.1 % [64.1, 66.0] |", "0.6508 0.641 0.66", []),
        ("| a | 65.1 |", "0.651", ["65.1"]),
        ("| a | 0.5 %, 12 |", "0.0049 13", []),  # of whole numbers nothing is said
        ("| a | −3.14 |", "-3.141", []),
    ],
)
def test_missing_figures__are_those_that_nothing_rounds_to(table: str, printed: str, missing: list[str]) -> None:
    assert missing_figures(table, printed) == missing


PAGES = ("shipped-policies", pytest.param("../README", marks=pytest.mark.slow))


PROGRAM = re.compile(r"```python\n(.*?)```(?:\n\n```\n(.*?)```)?", re.DOTALL)


@pytest.mark.parametrize("page", PAGES)
def test_programs__of_a_page_run_and_print_what_stands_below_them(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "my_file"}
    programs = PROGRAM.findall((DOCS / f"{page}.md").read_text("utf-8"))
    assert programs
    for code, printed in programs:
        exec(compile(code, f"{page}.md", "exec"), names)
        assert capsys.readouterr().out == printed or not printed


@pytest.mark.slow
def test_howto_train__runs_and_beats_full_braking(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # MAPPO of BenchMARL, where it is missing here, is run by ``make test-libraries``
    assert {"one", "pair"} <= harm_of_howto().keys()


CELL = re.compile(r"^```\{code-cell\} python\n(?::tags: .*\n)?(.*?)^```$", re.DOTALL | re.MULTILINE)


TRAIN = ("cooperative-learner", "read-a-report", "train-and-shield")


NOTEBOOKS = sorted(
    path.stem for path in (DOCS / "tutorials").glob("*.md") if "\nfile_format: mystnb\n" in path.read_text("utf-8")
)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.long if name in TRAIN else pytest.mark.slow) for name in NOTEBOOKS]
)
def test_notebook__runs_from_its_first_cell_to_its_last(name: str, tmp_path: Path) -> None:
    cells = CELL.findall((DOCS / "tutorials" / f"{name}.md").read_text("utf-8"))
    assert cells
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(cells)],
        env={**os.environ, "PYTHONPATH": str(DOCS.parent), "OMP_NUM_THREADS": "1"},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]


def test_notebooks__that_train_are_there() -> None:
    assert set(TRAIN) < set(NOTEBOOKS)
    assert len(NOTEBOOKS) == 6
