"""What the pages show is what is printed, and their links lead somewhere."""

import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest
import yaml

import ethbrake_marl as eb
from ethbrake_marl.agents.pairwise import CLOSED_FORM_CANDIDATES, find_candidates, harm_of_deceleration, pairwise
from ethbrake_marl.motion.layout import BRAKING, LATENCY
from ethbrake_marl.training.recipe_file import recipe_schema
from ethbrake_marl.worlds.scenario_file import new_scenario_text, scenario_json_schema
from ethbrake_marl.worlds.user_worlds import worlds_from_table
from tests.docs.printed import BLOCK, PAGES, PICTURES, ROOT, TABLES, missing_figures, pictures, rows, tables
from tests.docs.site import DOCS, load
from tests.fixtures.snapshots import check_snapshot
from tests.programmes import bounds


def test_everything_compared__is_still_on_a_page() -> None:
    assert {each.begin for each in pictures()} == PICTURES.keys()
    assert {each.begin for each in tables()} >= TABLES.keys()
    assert [each.begin for each in tables() if not each.commands] == []


@pytest.mark.slow
def test_table_of_shipped_lists__is_printed_by_its_command(capsys: pytest.CaptureFixture[str]) -> None:
    load("best_harm").main(["--shipped"])
    printed = capsys.readouterr().out.splitlines()
    for row in rows("least-harm", "## Proven and best known harm"):
        assert any(one.startswith(f"| {' | '.join(row)}") for one in printed), row


def test_reference_values__are_those_of_the_closed_form() -> None:
    for world, *ends in rows("proofs/constant-deceleration", "## Checks")[1:]:
        gaps, speeds, latency = ([float(word) for word in part.split(",")] for part in world.split(";"))
        scenario = eb.load_scenario("paper-random").replace(latency_s=[0.0, *latency])
        start = {f"gap_{k}_m": [gap] for k, gap in enumerate(gaps, 1)}
        start |= {f"speed_{k}_mps": [speed] for k, speed in enumerate(speeds, 1)}
        worlds = worlds_from_table(scenario, start)
        candidates, parts = (
            np.empty(CLOSED_FORM_CANDIDATES),
            (worlds.line[0], worlds.car[0, BRAKING], worlds.car[0, LATENCY], 2),
        )
        find_candidates(*parts, candidates)
        told = [*candidates, *(column[0] for column in pairwise(worlds, 2)), harm_of_deceleration(*parts, 7.0)]
        assert missing_figures(" ".join(ends), " ".join(repr(float(each)) for each in told)) == [], world


@pytest.mark.parametrize(
    ("table", "printed", "missing"),
    [
        ("| a | 1.25 |", "1.2496", []),
        ("| a | 1.25 |", "1.244", ["1.25"]),
        ("| a | 0.5 %, 12 |", "0.0049 13", []),  # of whole numbers nothing is said
    ],
)
def test_missing_figures__are_those_that_nothing_rounds_to(table: str, printed: str, missing: list[str]) -> None:
    assert missing_figures(table, printed) == missing


def test_codes_of_the_shield__stand_in_its_page() -> None:
    page = (DOCS / "shield.md").read_text("utf-8")
    assert [each.name for each in eb.ShieldReason if f"| {each.value} | `{each.name}` |" not in page] == []


@pytest.mark.slow
def test_programs_of_train__run_and_beat_full_braking(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    programs = (DOCS / "train.md").read_text("utf-8").partition("\n## With a recipe\n")[0]
    names: dict[str, Any] = {"__name__": "copied"}
    monkeypatch.chdir(tmp_path)
    for code in re.findall("```python\n(.*?)```", programs, re.DOTALL):
        exec(compile(code, "train.md", "exec"), names)
    assert names["harm"].keys() == {"one", "pair"}
    for trained, harms in names["harm"].items():
        full, theirs = harms.values()
        assert theirs < full, f"{trained}: {theirs:.2f} does not beat full braking, {full:.2f}"


NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))


def code_cells(notebook: Path) -> list[dict[str, Any]]:
    return [cell for cell in json.loads(notebook.read_text("utf-8"))["cells"] if cell["cell_type"] == "code"]


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook__is_committed_with_its_outputs(notebook: Path) -> None:
    cells = code_cells(notebook)
    assert "%pip install" in cells[0]["source"][-1]  # for a hosted notebook
    assert any(cell["outputs"] for cell in cells)
    assert [cell for cell in cells if any(each["output_type"] == "error" for each in cell["outputs"])] == []


# ---------------------------------------------------------------- pages


def anchors(page: Path) -> set[str]:
    headings = re.findall(r"(?m)^#+ (.*)$", BLOCK.sub("", page.read_text("utf-8")))
    texts = [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower() for heading in headings]
    return {re.sub(r"[^\w\- ]", "", text).strip().replace(" ", "-") for text in texts}


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links__lead_to_files_and_headings_that_are_there(page: Path) -> None:
    text = BLOCK.sub("", page.read_text("utf-8"))
    for path, anchor in re.findall(r"\]\((?!https?:|mailto:)([^)\s#]*)#?([^)\s]*)\)", text):
        target = page.parent / path if path else page
        assert target.exists(), path
        assert not anchor or anchor in anchors(target), f"{path}#{anchor}"


def test_version__is_the_same_wherever_it_stands() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert project["version"] == eb.__version__ == citation["version"]
    assert f"version = {{{eb.__version__}}}" in (ROOT / "README.md").read_text("utf-8")
    assert citation["license"] == project["license"]
    assert [author["name"] for author in citation["authors"]] == [author["name"] for author in project["authors"]]


def test_pythons__are_the_same_wherever_they_stand() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    first, *_, last = bounds.PYTHONS
    behind = f"3.{int(last.removeprefix('3.')) + 1}"
    assert project["requires-python"] == f">={first},<{behind}"
    named = [each.rpartition(" ")[2] for each in project["classifiers"] if ":: Python :: 3." in each]
    assert named == [*bounds.PYTHONS]
    for file in ("README.md", ".github/CONTRIBUTING.md", "docs/installing.md", "docs/first-ten-minutes.md", "Makefile"):
        assert f"Python {first} to {last}" in (ROOT / file).read_text("utf-8"), file
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text("utf-8"))["jobs"]
    assert jobs["versions"]["strategy"]["matrix"]["include"] == [
        {"kind": "lowest", "python": first},
        {"kind": "highest", "python": last},
    ]


@pytest.mark.parametrize(("version", "suits"), [("3, 11", True), ("3, 15", False)])
def test_make__takes_only_a_python_that_suits(version: str, suits: bool, tmp_path: Path) -> None:
    python = tmp_path / "python"  # this Python under another number; it makes no environment
    program = f'import sys; sys.version_info = ({version}); exec(sys.argv[2] if sys.argv[1] == "-c" else "sys.exit(3)")'
    python.write_text(f"#!/bin/sh\nexec {sys.executable} -c '{program}' \"$@\"\n")
    python.chmod(0o755)
    command = ["make", "-s", "venv", f"PYTHON={python}", f"VENV={tmp_path / 'environment'}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert ("cannot make a virtual environment" in done.stderr) == suits
    assert (f"Python 3.11 to 3.14 is needed; {python} gives" in done.stderr) != suits


@pytest.mark.parametrize(
    ("schema", "file"), [(scenario_json_schema, "scenarios/scenario"), (recipe_schema, "train/recipe")]
)
def test_schema__that_ships_is_that_of_the_code(schema: Callable[[], dict[str, Any]], file: str) -> None:
    """``ETHBRAKE_SNAPSHOTS=write`` writes the file."""
    check_snapshot(ROOT / f"{file}.schema.json", json.dumps(schema(), indent=2) + "\n")


def test_new_scenario__names_its_schema() -> None:
    named = re.search(r"^# yaml-language-server: \$schema=file://(\S+)$", new_scenario_text("mine"), re.MULTILINE)
    assert named and Path(unquote(named[1])) == ROOT / "scenarios" / "scenario.schema.json"
