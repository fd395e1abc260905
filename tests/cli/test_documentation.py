"""What docs/cli.md and the tutorial show is what happens."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import pytest

from ethbrake_marl.agents.registry import agent_names
from ethbrake_marl.cli.app import whole_command
from ethbrake_marl.cli.command import DEFAULTS, MOVED

DOCS = Path(__file__).resolve().parents[2] / "docs"
CLI = (DOCS / "cli.md").read_text("utf-8")
TUTORIAL = (DOCS / "tutorials" / "first-ten-minutes.md").read_text("utf-8")

TABLE_OF_COMMANDS, _, GENERAL = CLI.partition("\n## run\n")[0].partition("\n## Where commands were before\n")

WORLDS = "gap_1_m,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps\n10,8,20,18,20\n5,9,22,18,20\n7,7,20,18,20\n"


def section(name: str) -> str:
    """What the page says of a command: from its heading to the next one of its level."""
    found = re.search(rf"^(##+) {name}\n(.*?)(?=^##? |^\1 |\Z)", CLI, re.DOTALL | re.MULTILINE)
    assert found is not None, name
    return found[2]


def options_of(command) -> set[str]:
    return {option for each in command.params for option in each.opts if option.startswith("--")} - {"--help"}


def test_cli_page__has_every_command_with_every_option_and_every_agent():
    commands = whole_command().commands
    assert len(commands) == 14
    for name, command in commands.items():
        assert f"`{name}" in TABLE_OF_COMMANDS
        for inner, each in getattr(command, "commands", {name: command}).items():
            in_short = f"`{inner}" in section(name) or f"ethbrake {name} {inner}" in section(name)
            alone = inner == name or inner == DEFAULTS.get(name) or (in_short and f"### {inner}\n" not in section(name))
            about = section(name) if alone else section(inner)
            assert inner in (name, DEFAULTS.get(name)) or in_short or f"### {inner}\n" in section(name), inner
            wanted = set().union(*map(options_of, getattr(each, "commands", {inner: each}).values()))
            if inner != "generalise":  # whose section shows the usual ones only
                assert wanted <= set(re.findall(r"--[a-z-]+", GENERAL + about)), f"{name} {inner}"
    for agent in agent_names():
        assert f"`{agent}" in CLI


def test_cli_page__tells_where_each_old_command_is_now():
    told = CLI.partition("## Where commands were before\n")[2].partition("\n## ")[0]
    for row in re.findall(r"^\| (`.*?) \| (`.*) \|$", told, re.MULTILINE):
        before, now = ([name.removesuffix(" ...") for name in re.findall("`(.*?)`", cell)] for cell in row)
        assert [MOVED[name] for name in before] == now
    assert all(f"`{old}" in told for old in MOVED)


@pytest.mark.parametrize("page", [CLI, TUTORIAL])
def test_own_worlds__give_the_printed_harms(ethbrake, tmp_path, page):
    assert WORLDS in page
    (tmp_path / "worlds.csv").write_text(WORLDS)
    out = tmp_path / "out.csv"
    arguments = ("--initial-states", tmp_path / "worlds.csv", "--agents", "full_brake,e_v2x_bm", "--per-world", out)
    assert ethbrake("evaluate", *arguments).status == 0
    printed = re.search(r"\n(agent,world,[^`]+)```", page)
    assert printed is not None
    shown = list(csv.DictReader(printed[1].splitlines()))
    now = list(csv.DictReader(out.read_text().splitlines()))
    for old, new in zip(shown, now, strict=True):
        assert (old["agent"], old["world"], old["impacts"]) == (new["agent"], new["world"], new["impacts"])
        assert float(old["total_harm"]) == pytest.approx(float(new["total_harm"]), rel=1e-9)
        assert float(old["first_impact_harm"]) == pytest.approx(float(new["first_impact_harm"]), rel=1e-9)


def test_tutorial_program__prints_what_stands_below_it(capsys):
    found = re.search(r"```python\n(import numpy.*?)```\n\n```\n(.*?)```", TUTORIAL, re.DOTALL)
    assert found is not None
    exec(found[1], {})
    now = [float(word) for word in capsys.readouterr().out.split()]
    assert now == pytest.approx([float(word) for word in found[2].split()], rel=1e-9)


@pytest.fixture
def rainy(ethbrake, tmp_path) -> Path:
    """The scenario file of the tutorial, with its two changed lines."""
    assert ethbrake("scenario", "new", "rainy", "--output", tmp_path).status == 0
    path = tmp_path / "rainy.yaml"
    changed = re.search(r"```yaml\n(gaps_m: .*)\n(braking_capacity_mps2: .*)\n```", TUTORIAL)
    assert changed is not None
    text = path.read_text()
    for line in changed.groups():
        key = line.partition(":")[0]
        text, count = re.subn(rf"(?m)^{key}: .*$", line, text)
        assert count == 1
    path.write_text(text)
    return path


def test_tutorial_scenario__its_two_changed_lines_make_a_valid_file(ethbrake, rainy):
    answer = ethbrake("scenario", "validate", rainy)
    assert answer.out.strip() in TUTORIAL


def test_tutorial_scenario__evaluates_to_the_printed_table(ethbrake, rainy, monkeypatch):
    command = "evaluate --scenario rainy.yaml --agents full_brake,gentlest_front,e_v2x_bm --episodes 2000"
    printed = TUTORIAL.partition(f"$ ethbrake {command}\n")[2].partition("\n...")[0].splitlines()
    monkeypatch.chdir(rainy.parent)
    told = ethbrake(*command.split()).out.splitlines()
    assert len(printed) == 9 and [line.rstrip() for line in told[:9]] == printed
