"""Plug-ins in one file: named on the command line, used in training and evaluation, and held to on resume."""

from __future__ import annotations

import hashlib
import json
import os
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import yaml

from ethbrake_marl.cli.app import app, whole_command
from ethbrake_marl.files import plugins
from ethbrake_marl.learning.training import Training, load_recipe
from ethbrake_marl.scenario import load_scenario, new_scenario_text
from ethbrake_marl.studies.jobs import JobFolder, TrainingJob
from tests.cli.conftest import TINY_RECIPE, check_refused
from tests.fixtures.registered import restore, tables

PLUGIN = '''
import numpy as np
import ethbrake_marl as eb


def calm(step):
    """Minus the square of the own command in force."""
    return -(step.command_mps2**2)


def time_gap(worlds, vehicle):
    """Time to where the vehicle ahead is now, 1 m/s at the least."""
    return worlds.gaps_m[:, vehicle - 1] / np.maximum(worlds.speeds_mps[:, vehicle], 1.0)


def make_gentle(argument: str, settings):
    share = float(argument or 0.5)
    return eb.policy_agent(lambda seen: np.full((len(seen), 1), -share), name="gentle", scenario=settings.scenario)


eb.register_term("calm", calm, unit="m2/s4")
eb.register_feature("time_gap_s", time_gap, unit="s", scale=1.0, low=0.0, high=10.0)
eb.register_preset("hilly", {"preset": "nominal", "lost": 0.3})
eb.register_agent("gentle", make_gentle, about="brakes with a constant share")
assert make_gentle.__annotations__ == {"argument": str}  # a plug-in means what Python says it means
'''


@pytest.fixture
def again():
    """Call it to go on as in a new process."""
    before = tables()
    return lambda: restore(before)


@pytest.fixture
def parts(tmp_path: Path) -> Path:
    path = tmp_path / "my_parts.py"
    path.write_text(PLUGIN)
    return path


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    """A scenario with the plug-in's preset."""
    path = tmp_path / "hills.yaml"
    content = yaml.safe_load(new_scenario_text("hills"))
    path.write_text(yaml.safe_dump(content | {"v2x": "hilly", "early_impacts": "keep"}))
    return path


def write_recipe(folder: Path, **changes: object) -> Path:
    path = folder / "calm.yaml"
    path.write_text(yaml.safe_dump({**TINY_RECIPE, "name": "calm", "reward": {"harm": 1.0, "calm": 0.01}, **changes}))
    return path


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    """A recipe with the plug-in's term and feature."""
    return write_recipe(tmp_path, observation=["own", "front_1", "rear_1", "time_gap_s"])


@pytest.mark.filterwarnings("ignore::ethbrake_marl.errors.IncompleteTable")  # a list that shares worlds with a table
@pytest.mark.usefixtures("undrawn")
def test_one_file__adds_agent_term_feature_and_preset_and_is_seen_in_the_report(
    ethbrake, tmp_path, parts, scenario, recipe, again
):
    assert len(PLUGIN.strip().splitlines()) <= 40
    run = tmp_path / "run"
    named = ("--plugin", parts)
    made = ethbrake("run", *named, "--scenario", scenario, "--recipe", recipe, "--episodes", "20", "--output", run)
    assert made.status == 0, made.err
    config = json.loads((run / "config.json").read_text())
    sha256 = hashlib.sha256(parts.read_bytes()).hexdigest()
    assert config["plugins"] == [{"name": "my_parts.py", "source": str(parts), "sha256": sha256}]
    assert config["recipe"]["reward"]["terms"] == {"calm": 0.01} and config["scenario"]["v2x"] == {"preset": "hilly"}
    page = (run / "report.html").read_text()
    assert f"my_parts.py (SHA-256 {sha256})" in page and "calm" in page
    again()
    driven = ethbrake(
        "evaluate", *named, "--scenario", scenario, "--episodes", "20", "--agents", f"gentle,gentle:0.2+step,ppo@{run}"
    )
    assert driven.status == 0 and "gentle:0.2+step" in driven.out


def test_agents_from_a_file__drive_on_the_command_line_behind_a_shield(ethbrake, parts):
    spec = f"{parts}:make_gentle:0.3"
    answer = ethbrake("evaluate", "--episodes", "10", "--agents", f"{spec},{spec}+step", "--json")
    assert [row["agent"] for row in json.loads(answer.out)] == [spec, f"{spec}+step"]
    assert ethbrake("shield", "--episodes", "10", "--agents", spec).status == 0


@pytest.fixture
def stopped(ethbrake, tmp_path, parts, again):
    """A training with the plug-in, stopped before its end, and a new process."""
    folder = tmp_path / "stopped"
    recipe = write_recipe(tmp_path, checkpoint_every_updates=1)
    assert ethbrake("train", "--plugin", parts, "--recipe", recipe, "--output", folder).status == 0
    status = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps(status | {"status": "interrupted"}))
    again()
    return folder


def test_resume__needs_the_same_plugins_and_says_how_to_go_on(ethbrake, tmp_path, parts, stopped, again):
    def refuse(told: str, *files: Path) -> None:
        answer = ethbrake("train", "resume", stopped, *(word for file in files for word in ("--plugin", file)))
        again()
        check_refused(answer, told)

    other, config = tmp_path / "other.py", (stopped / "config.json").read_text()
    other.touch()
    all_the_same = "or go on all the same with --other-versions"
    refuse(f"needs the plug-in my_parts.py, which is not loaded; name it: --plugin {parts}")
    refuse(f"was made without the plug-in {other}; leave it out, {all_the_same}", parts, other)
    parts.write_text(PLUGIN + "# changed\n")
    refuse("the plug-in my_parts.py was another file then (SHA-256 ", parts)
    refuse(f"put it back as it was, {all_the_same}", parts)
    assert ethbrake("train", "resume", stopped, "--plugin", parts, "--other-versions").status == 0
    again()
    parts.write_text(PLUGIN)
    moved = parts.rename(tmp_path / "moved.py")  # the content counts, not the place
    (stopped / "config.json").write_text(json.dumps(json.loads(config) | {"plugins": [{"name": 3}]}))
    refuse("plugins must be a list of name, source and sha256", moved)
    (stopped / "config.json").write_text(config)
    refuse("this training has finished", moved)


def test_option__stands_on_every_command_and_before_it(ethbrake, parts):
    waiting = [whole_command()]
    for command in waiting:
        waiting += getattr(command, "commands", {}).values()
        assert [each.name for each in command.params].count("plugin") == 1, command.name
    answer = ethbrake("--plugin", parts, "agent", "list")
    assert answer.status == 0 and "gentle[:ARGUMENT]" in answer.out


def test_installed_plugin__is_loaded_only_when_it_is_named(ethbrake, tmp_path, monkeypatch):
    (tmp_path / "installed_parts.py").write_text(PLUGIN)
    monkeypatch.syspath_prepend(tmp_path)
    point = EntryPoint("hills", "installed_parts", plugins.GROUP)
    monkeypatch.setattr(plugins, "entry_points", lambda group: [point] if group == plugins.GROUP else [])
    assert "gentle[" not in ethbrake("agent", "list").out and "installed_parts" not in sys.modules
    assert "gentle[" in ethbrake("agent", "list", "--plugin", "hills").out
    (noted,) = plugins.noted_plugins()
    assert noted["name"] == "hills" and noted["sha256"] == hashlib.sha256(PLUGIN.encode()).hexdigest()
    assert "unknown plug-in 'hill'; did you mean 'hills'?" in ethbrake("agent", "list", "--plugin", "hill").err
    del sys.modules["installed_parts"]


@pytest.mark.slow
def test_worker_processes__load_the_plugins_of_their_parent(tmp_path, parts, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.getcwd())
    plugins.load_plugin(parts)
    recipe = load_recipe(str(write_recipe(tmp_path)))
    scenario, kept = load_scenario("paper-random"), JobFolder(tmp_path / "trainings", "trainings")
    wanted = [TrainingJob(Training.of(recipe, scenario, seed=seed), tmp_path / f"seed{seed}") for seed in (0, 1)]
    with kept.work():
        assert kept.train(wanted, 2)
    for training in wanted:
        config = json.loads((training.folder / "config.json").read_text())
        assert [each["name"] for each in config["plugins"]] == ["my_parts.py"]


@pytest.mark.parametrize(("content", "told"), [(b"x = 1\n\0\n", "null bytes"), (b"def f(:\n", "line 1: SyntaxError")])
def test_plugin__that_is_no_python_names_no_line_that_is_not_there(ethbrake, tmp_path, content: bytes, told: str):
    (tmp_path / "bad.py").write_bytes(content)
    answer = ethbrake("agent", "list", "--plugin", tmp_path / "bad.py")
    check_refused(answer, f"plug-in '{tmp_path / 'bad.py'}'", told)
    assert "None" not in answer.err


def test_command__of_the_users_cannot_take_the_place_of_a_built_in_one(ethbrake, monkeypatch):
    monkeypatch.setattr(app, "registered_commands", [*app.registered_commands])

    @app.command()
    def evaluate() -> None:
        """Another one."""

    answer = ethbrake("evaluate", "--episodes", "3")
    check_refused(answer, "command 'evaluate' is there already; give yours another name: app.command('my-evaluate')")
