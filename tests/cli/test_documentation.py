"""What docs/cli.md and the tutorial show is what happens."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import pytest
from ethbrake_marl.cli.recipe import recipe_app
from typer.main import get_command

from ethbrake_marl.agents.registry import agent_names
from ethbrake_marl.cli.app import app
from ethbrake_marl.cli.scenario import scenario_app

DOCS = Path(__file__).resolve().parents[2] / "docs"
CLI = (DOCS / "cli.md").read_text("utf-8")
TUTORIAL = (DOCS / "tutorials" / "first-ten-minutes.md").read_text("utf-8")

TABLE_OF_COMMANDS, _, GENERAL = CLI.partition("\n## run\n")[0].partition("\n## What holds for every command\n")

WORLDS = "gap_1_m,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps\n10,8,20,18,20\n5,9,22,18,20\n7,7,20,18,20\n"


def names(typer_app) -> set[str]:
    found = (command.name or command.callback.__name__ for command in typer_app.registered_commands)
    return {name.replace("_", "-") for name in found}


def test_cli_page__has_every_command_and_agent():
    training = {
        "run",
        "train",
        "resume",
        "learning-curves",
        "sweep",
        "tune",
        "ablate",
        "generalise",
        "export",
    }
    measuring = {"evaluate", "compare", "falsify", "shield", "best-harm", "benchmark", "leaderboard"}
    looking = {"agents", "record", "replay", "explore", "reproduce"}
    assert names(app) == training | measuring | looking | {"doctor", "bench", "dataset"}
    for command in names(app) | {"scenario", "recipe"}:
        assert f"\n## {command}\n" in CLI and f"`{command}" in TABLE_OF_COMMANDS
    about_scenarios = CLI.partition("\n## scenario\n")[2].partition("\n## ")[0]
    for command in names(scenario_app):
        assert f"ethbrake scenario {command}" in about_scenarios or f"`{command}" in about_scenarios
    about_recipes = CLI.partition("\n## recipe\n")[2].partition("\n## ")[0]
    for command in names(recipe_app):
        assert f"`{command}" in about_recipes or f"ethbrake recipe {command}" in about_recipes
    for agent in agent_names():
        assert f"`{agent}" in CLI


@pytest.mark.parametrize("command", ["", "scenario", "recipe", "picture"])
def test_cli_page__has_every_option(command):
    group = get_command(app) if not command else get_command(app).commands[command]
    for name in sorted(group.commands.keys() - {"generalise"}):  # whose section shows the usual ones only
        section = CLI.partition(f"\n## {command or name}\n")[2].partition("\n## ")[0]
        shown = set(re.findall(r"--[a-z-]+", GENERAL + section))
        options = {option for each in group.commands[name].params for option in each.opts if option.startswith("--")}
        assert options <= shown | {"--help"}, name


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
