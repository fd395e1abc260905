"""``ethbrake train``, on trainings of a few small updates."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.cli.test_run import ctrl_c_when
from tests.fixtures.commands import Command, check_refused, told_json


def status_of(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "run.json").read_text())
    return content


def test_train__ends_with_harm_beside_full_braking_and_a_command_that_measures_the_same(
    ethbrake: Command, tiny_recipe: Path, empty_folder: Path
) -> None:
    chosen = ("--recipe", tiny_recipe, "--set", "mass_t=40", "--set", "gamma=0.98", "--set", "reward.harm_count=total")
    answer = ethbrake("train", *chosen, "--output", "runs/mine")
    command = (
        "ethbrake evaluate --scenario paper-random --agents full_brake,policy@runs/mine --set mass_t=40"
        " --set harm_count=total"
    )
    assert answer.status == 0 and answer.out.splitlines()[-1].strip() == command
    assert "The agent is policy@runs/mine." in answer.out and "the 10 worlds of seed 7" in answer.out
    assert f"finished after 256 training steps: {Path('runs/mine')}" in answer.err
    again = ethbrake("train", *chosen, "--output", "runs/mine")
    assert again.status == 2 and "runs/mine" in again.err and "(--output), resume the run" in again.err
    figures = told_json(ethbrake("train", *chosen, "--output", "runs/mine", "--force", "--json"))
    assert (figures["agent"], figures["next_command"]) == ("policy@runs/mine", command)
    rows = told_json(ethbrake(*shlex.split(command)[1:], "--episodes", "10", "--json"))  # the recipe's fixed list
    assert (figures["fixed_list"]["worlds"], figures["fixed_list"]["seed"]) == (10, 7)
    for told, row in zip(figures["fixed_list"]["results"], rows, strict=True):
        assert told == {name: pytest.approx(row[name]) if name != "agent" else row[name] for name in told}
        assert f"{row['first_impact_harm']:.2f}" in answer.out and f"{row['total_harm']:.2f}" in answer.out


def test_train__with_a_file_of_ones_own_prints_a_command_that_loads_it_again(
    ethbrake: Command, tiny_recipe: Path, empty_folder: Path
) -> None:
    Path("own.py").write_text(
        "import ethbrake_marl as eb\n"
        "def heavy(state, body):\n    '''Mass.'''\n    return state.mass_t[:, body - 1]\n"
        "eb.register_feature('heavy', heavy, unit='t', scale=10.0, low=0.0, high=9.0)\n"
    )
    words = ("--recipe", tiny_recipe, "--set", "recipe.observation=[own, heavy]", "--output", "runs/mine")
    check_refused(ethbrake("train", *words), "unknown feature 'heavy'")
    command = ethbrake("train", *words, "--load", "own.py").out.splitlines()[-1]
    assert f"--load {Path('own.py').resolve()} " in command
    assert ethbrake(*shlex.split(command)[1:], "--episodes", "3").status == 0


def test_folder_that_exists__is_refused_before_torch_is_loaded(empty_folder: Path) -> None:
    Path("mine").mkdir()
    program = (
        "import sys; from ethbrake_marl.cli.app import run_command\n"
        "print(run_command(['run', '--output', 'mine']), 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "2 False\n" and "mine: already exists and is not the folder of a run" in done.stderr


def test_train__of_several_learners_leaves_a_team_that_evaluate_takes(
    ethbrake: Command, tiny_recipe: Path, empty_folder: Path
) -> None:
    chosen = ("--scenario", "cooperation-3-pair", "--recipe", tiny_recipe, "--set", "scheme=independent")
    answer = ethbrake("train", *chosen)
    run = Path("runs/cooperation-3-pair-tiny-independent-seed3")
    told = "policy/vehicle_2 drives vehicle_2; policy/vehicle_3 drives vehicle_3"
    assert answer.status == 0 and f"scheme independent: {told}" in answer.err
    words = ("--scenario", "cooperation-3-pair", "--episodes", "20", "--agents")
    alone, team = told_json(ethbrake("evaluate", *words, f"ppo@{run},team@{run}", "--json"))
    assert alone["first_impact_harm"] == team["first_impact_harm"]
    check_refused(ethbrake("evaluate", *words, f"sac@{run}"), "was trained by ppo", f"ppo@{run}")
    again = ethbrake("train", "--resume", run)
    check_refused(again, "evaluate --scenario cooperation-3-pair --agents full_brake,team@")


def test_resume__goes_on_and_says_what_is_next(
    ethbrake: Command, tiny_recipe: Path, empty_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        ctrl_c_when(patch, lambda shown: bool(shown.done == 128))
        answer = ethbrake("train", "--recipe", tiny_recipe, "--seed", "5", "--output", "stopped")
    assert answer.status == 130 and (Path("stopped") / "policy").is_dir()
    assert status_of(Path("stopped"))["status"] == "interrupted"
    last = answer.err.splitlines()[-1]
    assert "interrupted after 128 training steps" in last and "continue with: ethbrake train --resume stopped" in last
    told = told_json(ethbrake("train", "--resume", "stopped", "--json"))
    assert (told["status"], told["steps"]) == ("finished", 256)
    check_refused(
        ethbrake("train", "--resume", "stopped"),
        "has finished", "ethbrake evaluate --scenario paper-random --agents full_brake,policy@",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("--resume runs/mine --steps 5", "--steps: cannot be combined with --resume"),
        ("--other-versions", "--other-versions: has no effect on a new run"),
    ],
)
def test_options__that_do_not_go_together_are_refused(ethbrake: Command, words: str, text: str) -> None:
    check_refused(ethbrake("train", *words.split()), text)
