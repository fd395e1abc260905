"""``ethbrake run`` and ``train``, on trainings of a few small updates."""

import inspect
import json
import shlex
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.cli.command import Out
from tests.fixtures.commands import Command, check_refused, rows_of, told_json

AGENTS = ["full_brake", "e_v2x_bm", "e_v2x_bm:pairwise", "trained policy", "hybrid"]


def status_of(folder: Path, *names: str) -> tuple[Any, ...]:
    """These entries of run.json."""
    content = json.loads((folder / "run.json").read_text())
    return tuple(content[name] for name in names)


def ctrl_c_when(monkeypatch: pytest.MonkeyPatch, *moments: Callable[[dict[str, Any]], bool]) -> None:
    """Press Ctrl-C when what is shown first fits the first moment, then when it first fits the second, ..."""
    waiting, progress = list(moments), Out.progress

    def press(*args: Any, **kwargs: Any) -> None:
        progress(*args, **kwargs)
        shown = inspect.signature(progress).bind(*args, **kwargs).arguments
        if waiting and waiting[0](shown):
            waiting.pop(0)
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Out, "progress", press)


# A run: training, tests, report


def test_run__results_agree_in_json_and_csv(finished_run: Path) -> None:
    """Whoever compares results reads the worlds of ``per_world.csv``, too."""
    rows, flat = json.loads((finished_run / "results.json").read_text()), rows_of(finished_run / "results.csv")
    assert [row["agent"] for row in rows] == [row["agent"] for row in flat] == AGENTS
    for row, line in zip(rows, flat, strict=True):
        told = [float(line[name]) for name in ("episodes", "total_harm", "total_harm_low", "total_harm_high")]
        assert told == [60, row["total_harm"], *row["total_harm_interval"]]
    assert (flat[0]["predicted_harm"], flat[0]["scenario"]) == ("", "paper-random")


def test_run__its_policy_evaluates_to_the_same_figures_afterwards(ethbrake: Command, finished_run: Path) -> None:
    agents = f"full_brake,ppo@{finished_run},ppo@{finished_run}+episode"
    now = told_json(ethbrake("evaluate", "--agents", agents, "--episodes", "60", "--json"))
    then = {row["agent"]: row for row in json.loads((finished_run / "results.json").read_text())}
    assert {row.pop("per_world")["file"] for row in then.values()} == {"per_world.csv"}
    names = {f"ppo@{finished_run}": "trained policy", f"ppo@{finished_run}+episode": "hybrid"}
    for row in now:
        before = then[names.get(row["agent"], row["agent"])]
        for name in ("episodes", "collision_rate", "first_impact_harm", "total_harm", "total_harm_interval"):
            nearly = 5e-4 if row["agent"].endswith("+episode") else 1e-12  # its plan is the other edition's
            assert row[name] == pytest.approx(before[name], rel=nearly), name
        assert row["policy_sha256"] == before["policy_sha256"]


def test_run__interrupted_twice_stops_at_once_and_keeps_the_policy(ethbrake, tiny_recipe, tmp_path, monkeypatch):
    ctrl_c_when(monkeypatch, lambda shown: shown["done"] == 128, lambda shown: shown["name"] == "evaluation")
    folder = tmp_path / "stopped"
    answer = ethbrake("run", "--recipe", tiny_recipe, "--episodes", "40", "--output", folder)
    assert (answer.status, answer.out) == (130, "") and answer.err.splitlines()[-1].startswith("interrupted; ")
    assert status_of(folder, "status", "stage") == ("interrupted", "evaluation")
    assert not (folder / "results.json").exists() and (folder / "policy" / "weights.safetensors").is_file()


def test_run__failed_says_so_in_its_status(ethbrake, tiny_recipe, tmp_path, monkeypatch) -> None:
    broken = Mock(side_effect=RuntimeError("no space left"))
    monkeypatch.setattr("ethbrake_marl.first_edition.training.experiment.write_results", broken)
    with pytest.raises(RuntimeError, match="no space left"):
        ethbrake("run", "--recipe", tiny_recipe, "--episodes", "20", "--output", tmp_path / "failed")
    status, stage, reason = status_of(tmp_path / "failed", "status", "stage", "reason")
    assert (status, stage) == ("failed", "evaluation") and "no space left" in reason


def test_evaluate__interrupted_writes_nothing(ethbrake: Command, tmp_path: Path, monkeypatch) -> None:
    ctrl_c_when(monkeypatch, lambda shown: shown["name"] == "worlds")
    answer = ethbrake("evaluate", "--episodes", "5", "--agents", "coast", "--output", tmp_path / "new")
    assert (answer.status, answer.out) == (130, "")
    assert answer.err.splitlines()[-1] == "interrupted; nothing was written" and list(tmp_path.iterdir()) == []


# A training


def test_train__ends_with_harm_beside_full_braking_and_a_command_that_measures_the_same(
    ethbrake, tiny_recipe, tmp_path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    chosen = ("--recipe", tiny_recipe, "--set", "mass_t=40", "--set", "gamma=0.98", "--set", "reward.harm_count=total")
    answer = ethbrake("train", *chosen, "--output", "runs/mine")
    command = (
        "ethbrake evaluate --scenario paper-random --agents full_brake,policy@runs/mine --set mass_t=40"
        " --set harm_count=total"
    )
    assert answer.status == 0 and answer.out.splitlines()[-1].strip() == command
    assert "The agent is policy@runs/mine." in answer.out and "the 10 worlds of seed 7" in answer.out
    figures = told_json(ethbrake("train", *chosen, "--output", "runs/mine", "--force", "--json"))
    assert (figures["agent"], figures["next_command"]) == ("policy@runs/mine", command)
    rows = told_json(ethbrake(*shlex.split(command)[1:], "--episodes", "10", "--json"))  # the recipe's fixed list
    assert (figures["fixed_list"]["worlds"], figures["fixed_list"]["seed"]) == (10, 7)
    for told, row in zip(figures["fixed_list"]["results"], rows, strict=True):
        assert told == {name: pytest.approx(row[name]) if name != "agent" else row[name] for name in told}
        assert f"{row['first_impact_harm']:.2f}" in answer.out and f"{row['total_harm']:.2f}" in answer.out


def test_train__by_a_scheme_leaves_a_team_that_evaluate_takes(ethbrake, tiny_recipe, tmp_path) -> None:
    scenario, folder = ("--scenario", "cooperation-3-pair"), tmp_path / "run"
    told = "policy/vehicle_2 drives vehicle_2; policy/vehicle_3 drives vehicle_3"
    answer = ethbrake("train", *scenario, "--recipe", tiny_recipe, "--set", "scheme=independent", "--output", folder)
    assert answer.status == 0 and f"scheme independent: {told}" in answer.err
    words = ("--episodes", "20", "--agents", f"ppo@{folder},team@{folder}", "--json")
    alone, team = told_json(ethbrake("evaluate", *scenario, *words))
    assert alone["first_impact_harm"] == team["first_impact_harm"]
    check_refused(ethbrake("evaluate", *scenario, "--agents", f"sac@{folder}"), "was trained by ppo", f"ppo@{folder}")
    check_refused(
        ethbrake("train", "--resume", folder), "evaluate --scenario cooperation-3-pair --agents full_brake,team@"
    )


def test_resume__goes_on_and_says_what_is_next(ethbrake, tiny_recipe, tmp_path, monkeypatch) -> None:
    folder = tmp_path / "stopped"
    with monkeypatch.context() as patch:
        ctrl_c_when(patch, lambda shown: shown["done"] == 128)
        answer = ethbrake("train", "--recipe", tiny_recipe, "--output", folder)
    assert answer.status == 130 and status_of(folder, "policy") == ("policy",)
    last = answer.err.splitlines()[-1]
    assert "interrupted after 128 training steps" in last and f"continue with: ethbrake train --resume {folder}" in last
    told = told_json(ethbrake("train", "--resume", folder, "--json"))
    assert (told["status"], told["steps"]) == ("finished", 256)
    again = ethbrake("train", "--resume", folder)
    check_refused(again, "has finished", "ethbrake evaluate --scenario paper-random --agents full_brake,policy@")


@pytest.mark.usefixtures("core_alone")
def test_resume__deletes_the_results_of_the_policy_before_and_nothing_else(
    ethbrake, tiny_recipe, tmp_path, monkeypatch
) -> None:
    folder = tmp_path / "stopped"
    with monkeypatch.context() as patch:
        ctrl_c_when(patch, lambda shown: shown["done"] == 128)
        assert ethbrake("run", "--recipe", tiny_recipe, "--episodes", "20", "--output", folder).status == 130
    written = {"results.json", "results.csv", "per_world.csv"}
    assert {*status_of(folder, "written")[0]} == written and all((folder / name).exists() for name in written)
    (folder / "notes.txt").write_text("mine")
    (tmp_path / "precious.txt").write_text("mine")
    status = json.loads((folder / "run.json").read_text())
    hostile = {"written": [*written, "policy", "config.json", "../precious.txt", "..", ".", 7]}
    (folder / "run.json").write_text(json.dumps(status | hostile))
    eb.resume(folder, on_progress=None)  # of the edition that has written the run
    there = {path.name for path in folder.iterdir()}
    assert not there & written and {"notes.txt", "policy", "config.json"} <= there
    assert (tmp_path / "precious.txt").exists()
