"""Pages that show what all extensions together print."""

import re
from pathlib import Path

from tests.fixtures.commands import Command

ROOT = Path(__file__).resolve().parents[2]
TUTORIAL = (ROOT / "docs" / "first-ten-minutes.md").read_text("utf-8")
ADD = (ROOT / "docs" / "scenarios.md").read_text("utf-8").partition("\n## From Python\n")[0]


def change_lines(path: str, page: str) -> None:
    """The lines of a scenario that the page's first YAML block changes."""
    block = re.search(r"```yaml\n(.*?)```", page, re.DOTALL)
    text = Path(path).read_text()
    for line in block[1].splitlines():
        text, count = re.subn(rf"(?m)^{line.partition(':')[0]}: .*$", line, text)
        assert count == 1
    Path(path).write_text(text)


def test_tutorial__its_changed_scenario_is_valid_and_evaluates_to_the_printed_table(
    ethbrake: Command, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert ethbrake("scenario", "new", "rainy").status == 0
    change_lines("rainy.yaml", TUTORIAL)
    assert ethbrake("scenario", "validate", "rainy.yaml").out.partition("\n")[0] in TUTORIAL
    command = "evaluate --scenario rainy.yaml --agents full_brake,e_v2x_bm --episodes 2000"
    printed = TUTORIAL.partition(f"$ ethbrake {command}\n")[2].partition("\n...")[0].splitlines()
    told = ethbrake(*command.split()).out.splitlines()
    assert len(printed) == 7 and [line.rstrip() for line in told[:7]] == printed


def test_how_to_add__its_commands_lead_from_a_copy_to_worlds_and_results(
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
