"""Pages that show what all extensions together print."""

import re
from pathlib import Path

from tests.cli.test_scenarios import ROOT, TUTORIAL, change_lines
from tests.fixtures.commands import Command

ADD = (ROOT / "docs" / "scenarios.md").read_text("utf-8").partition("\n## From Python\n")[0]


def test_tutorial__its_changed_scenario_is_valid_and_evaluates_to_the_printed_table(
    ethbrake: Command, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert ethbrake("scenario", "new", "rainy").status == 0
    change_lines("rainy.yaml", TUTORIAL)
    assert ethbrake("scenario", "validate", "rainy.yaml").out.strip() in TUTORIAL
    command = "evaluate --scenario rainy.yaml --agents full_brake,e_v2x_bm --episodes 2000"
    printed = TUTORIAL.partition(f"$ ethbrake {command}\n")[2].partition("\n...")[0].splitlines()
    told = ethbrake(*command.split()).out.splitlines()
    assert len(printed) == 7 and [line.rstrip() for line in told[:7]] == printed


def test_how_to_add__its_commands_lead_from_a_copy_to_the_figures_that_it_tells(
    ethbrake: Command, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    told = {}
    for command in re.findall(r"^\$ ethbrake (.*)$", ADD, re.MULTILINE):
        told[command.split()[1]] = (done := ethbrake(*command.split())).out
        assert done.status == 0, command
        if command.startswith("scenario new"):
            change_lines("rainy.yaml", ADD)
    assert told["validate"].startswith("OK  rainy: 3 vehicles")
    assert Path("worlds.csv").read_text().splitlines()[0].split(",")[:2] == ["gap_1_m", "gap_2_m"]
    each = r"collides in ([\d.]+ %) .*? mean first-impact harm is ([\d.]*\d)"
    figures = re.search(f"{each}.*?{each}", ADD.replace("\n", " "))
    assert [figure for figure in figures.groups() if figure not in told["--scenario"]] == []
