"""``ethbrake evaluate``: what its options change, what it leaves, and what it needs."""

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

import ethbrake_marl as eb
from ethbrake_marl.evaluation import comparison
from tests.fixtures.commands import Command, check_refused, rows_of, told_json


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_harm_count__is_what_agents_lower(ethbrake: Command) -> None:
    arguments = ("evaluate", "--episodes", "200", "--agents", "e_v2x_bm", "--json", "--set")
    (first,), (total,) = (told_json(ethbrake(*arguments, f"harm_count={count}")) for count in ("first", "total"))
    assert total["total_harm"] < first["total_harm"] and total["first_impact_harm"] > first["first_impact_harm"]


def test_tables__show_all_counts_and_say_which_one_agents_minimise(ethbrake: Command) -> None:
    arguments = ("evaluate", "--episodes", "40", "--agents", "full_brake,e_v2x_bm,ppo")
    usual, paper = (ethbrake(*arguments, *more).out for more in ((), ("--set", "harm_count=first")))
    for shown in (usual, paper):
        assert {"First-impact", "Total", "Honest"} <= {*shown.split()}
    assert "Agents minimise honest cost" in usual and "Agents minimise first-impact harm" in paper
    assert "Push" in usual and "trained for first-impact harm" in usual and "trained for" not in paper
    line = "evaluate --scenario stress --episodes 2 --agents coast"
    group = ethbrake(*line.split())
    assert "Honest" in group.out and "stress-wide-obstacle" in group.out


def test_standards__every_row_names_its_scenario_and_full_braking_passes_as_published(ethbrake: Command) -> None:
    words = ("evaluate", "--scenario", "standards", "--agents", "full_brake,coast", "--episodes", "20", "--json")
    rows = told_json(ethbrake(*words))
    assert len(rows) == 10 and len({row["scenario"] for row in rows}) == 5
    for row in rows:
        passes = row["agent"] == "full_brake"
        assert row["result"] == ("passed" if passes else "failed")
        assert (row["collision_rate"] == row["hardest_impact_kmh"] == row["total_harm"] == 0.0) == passes
    refused = ethbrake(*words, "--report", "--output", "new")
    check_refused(refused, "--report: cannot be used with standards, a group of 5 scenarios; name one scenario")


def test_group__has_a_folder_of_results_for_each_scenario(ethbrake: Command) -> None:
    words = ("evaluate", "--scenario", "stress", "--agents", "coast", "--episodes", "3", "--output", "new")
    assert ethbrake(*words, "--per-world", "csv").status == 0
    for name in ("stress-wide", "stress-wide-obstacle"):
        assert len(rows_of(Path("new", name, "worlds.csv"))) == 3
        assert eb.read_result(f"new/{name}/results.json")["coast"]["parameters"]["scenario"] == name
    check_refused(ethbrake(*words), "already exists")
    assert ethbrake(*words, "--force").status == 0
    assert not Path("new/stress-wide/worlds.csv").exists()


@pytest.mark.slow
def test_in_processes__it_prints_the_same(ethbrake: Command, tmp_path: Path) -> None:
    line = ("evaluate", "--agents", "full_brake,e_v2x_bm:pairwise", "--episodes", "2600", "--json")
    here = ethbrake(*line)
    found = ethbrake(*line, "--jobs", "2", "--output", tmp_path)
    assert found.status == 0 and found.out == here.out
    written = json.loads((tmp_path / "results.json").read_text())
    assert [each | {"results_sha256": None} for each in json.loads(here.out)] == [
        each | {"results_sha256": None} for each in written
    ]


@pytest.mark.parametrize(
    ("package", "extra", "line"), [("joblib", "cluster", "evaluate --agents coast --episodes 2 --output new --jobs 2")]
)
def test_file__of_an_extra_that_is_missing_says_the_line_that_installs_it(
    ethbrake: Command, package: str, extra: str, line: str, monkeypatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    missing = f"needs the package {package}, which is not installed; install it with: {sys.executable} -m pip install"
    check_refused(ethbrake(*line.split()), f"{missing} 'ethbrake-marl[{extra}]'\n")
    assert list(Path().iterdir()) == []


def test_output__deletes_the_files_of_earlier_results_and_nothing_else(ethbrake: Command, tmp_path: Path) -> None:
    line = ("evaluate", "--agents", "coast", "--episodes", "2", "--output", tmp_path / "out", "--force")
    assert ethbrake(*line, "--per-world", "csv").status == 0
    (tmp_path / "out" / "notes.txt").write_text("mine")
    assert ethbrake(*line).status == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"results.json", "notes.txt"}


@pytest.mark.parametrize(
    ("options", "files"),
    [
        ("--per-world csv", {"results.json", "worlds.csv"}),
        ("--scenario stress", {"stress-wide", "stress-wide-obstacle"}),
        ("--scenario benchmark-pair", {"results.json", "rows.csv"}),
    ],
)
def test_output__of_a_process_that_comes_late_is_beside_that_of_the_first(
    options: str, files: set[str], ethbrake: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = f"evaluate --agents coast --episodes 2 {options} --output"
    for folder in ("first", "taken-2"):
        assert ethbrake(*line.split(), tmp_path / folder).status == 0
    content = {path: path.read_bytes() for path in (tmp_path / "first").rglob("*.*") if path.is_file()}
    of_one = comparison.evaluate

    def evaluate_meanwhile(*arguments: Any, **settings: Any) -> Any:
        shutil.copytree(tmp_path / "first", tmp_path / "taken", dirs_exist_ok=True)  # what another process writes
        return of_one(*arguments, **settings)

    monkeypatch.setattr(comparison, "evaluate", evaluate_meanwhile)
    late = ethbrake(*line.split(), tmp_path / "taken")
    assert late.status == 3 and "another process has written results here meanwhile; these" in late.err
    assert late.err.splitlines()[-1].endswith(f"results are in {tmp_path / 'taken-3'}")
    assert {path.name for path in (tmp_path / "taken-3").iterdir()} == files
    for path, data in content.items():
        assert (tmp_path / "taken" / path.relative_to(tmp_path / "first")).read_bytes() == data
    forced = ethbrake(*line.split(), tmp_path / "taken", "--force")
    assert forced.status == 0 and not (tmp_path / "taken-4").exists()
