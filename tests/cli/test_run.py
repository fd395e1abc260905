"""``ethbrake run``, on trainings of a few small updates."""

import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import ethbrake_marl as eb
from ethbrake_marl.cli.run import quickest
from ethbrake_marl.progress import Progress, ShownProgress
from tests.fixtures.commands import Command, Refuse, told_json

AGENTS = ["full_brake", "e_v2x_bm", "e_v2x_bm:pairwise", "trained policy", "hybrid"]


def status_of(folder: Path, *names: str) -> tuple[Any, ...]:
    content = json.loads((folder / "run.json").read_text())
    return tuple(content[name] for name in names)


def ctrl_c_when(monkeypatch: pytest.MonkeyPatch, *moments: Callable[[Progress], bool]) -> None:
    """Press Ctrl-C when what is shown first fits the first moment, then when it first fits the second, ..."""
    waiting, show = list(moments), ShownProgress.__call__

    def press(self: ShownProgress, shown: Progress) -> None:
        show(self, shown)
        if waiting and waiting[0](shown):
            waiting.pop(0)
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(ShownProgress, "__call__", press)


def test_run__its_policy_evaluates_to_the_same_figures_afterwards(ethbrake: Command, finished_run: Path) -> None:
    agents = f"full_brake,ppo@{finished_run},ppo@{finished_run}+episode"
    now = told_json(ethbrake("evaluate", "--agents", agents, "--episodes", "60", "--json"))
    then = {row["agent"]: row for row in json.loads((finished_run / "results.json").read_text())}
    assert [*then] == AGENTS and {row["per_world"]["file"] for row in then.values()} == {"worlds.csv"}
    names = {f"ppo@{finished_run}": "trained policy", f"ppo@{finished_run}+episode": "hybrid"}
    for row in now:
        before = then[names.get(row["agent"], row["agent"])]
        for name in ("episodes", "collision_rate", "first_impact_harm", "total_harm_interval", "policy_sha256"):
            assert row[name] == before[name], name


def test_run__interrupted_twice_stops_at_once_and_keeps_the_policy(ethbrake, tiny_recipe, tmp_path, monkeypatch):
    ctrl_c_when(monkeypatch, lambda shown: shown.done == 128, lambda shown: shown.name == "evaluation")
    folder = tmp_path / "stopped"
    answer = ethbrake("run", "--recipe", tiny_recipe, "--episodes", "40", "--output", folder)
    assert (answer.status, answer.out) == (130, "") and answer.err.splitlines()[-1].startswith("interrupted; ")
    assert status_of(folder, "status", "stage") == ("interrupted", "evaluation")
    assert not (folder / "results.json").exists() and (folder / "policy" / "weights.safetensors").is_file()


@pytest.mark.usefixtures("core_alone")
def test_run__without_extensions_prints_the_tables_and_says_who_learned_what(
    ethbrake: Command, tiny_recipe: Path, tmp_path: Path
) -> None:
    words = ("--scenario", "cooperation-3-pair", "--set", "objective=own", "--set", "scheme=independent", "--seed", "5")
    answer = ethbrake("run", "--recipe", tiny_recipe, *words, "--episodes", "10", "--output", tmp_path / "run")
    text = " ".join(answer.out.split())
    assert answer.status == 0 and text.startswith(
        "Trained on cooperation-3-pair by recipe tiny, seed 5: 256 decisions in "
    )
    assert "shielded team: the trained team (scheme independent) with a shield." in text
    assert "All agents minimise honest cost, except that the trained team minimises own." in text
    assert "all but vehicle_3" in text and "Pushed" in text
    assert answer.err.splitlines()[-2:] == [
        f"results: {tmp_path / 'run' / 'results.json'}", f"finished after 256 training steps: {tmp_path / 'run'}"
    ]  # fmt: skip
    assert {path.name for path in (tmp_path / "run").iterdir()} >= {"results.json", "worlds.csv"}


@pytest.mark.usefixtures("core_alone")
def test_run__by_default_trains_what_is_installed() -> None:
    assert (quickest(), quickest(several=True)) == ("ppo", "cooperation-ppo")


@pytest.mark.parametrize(
    ("words", "trained_on", "compared_in", "horizon_s"),
    [
        (["--set", "horizon_s=9"], "mixture-three-tests", "paper-random", 9.0),  # a setting changes nothing else
        (["--scenario", "paper-random-obstacle"], "paper-random-obstacle", "paper-random-obstacle", 8.0),
    ],
)
@pytest.mark.usefixtures("core_alone")
def test_run__trains_on_the_scenario_of_the_command_or_else_of_the_recipe(
    words: list[str],
    trained_on: str,
    compared_in: str,
    horizon_s: float,
    ethbrake: Command,
    tiny_recipe: Path,
    tmp_path: Path,
) -> None:
    recipe = tmp_path / "tiny.yaml"
    recipe.write_text(f"{tiny_recipe.read_text()}\nscenario: mixture-three-tests\n")
    answer = ethbrake("run", "--recipe", recipe, *words, "--episodes", "10", "--output", tmp_path / "run")
    assert answer.status == 0 and answer.out.startswith(f"Trained on {trained_on} by recipe tiny")
    (row, *_) = json.loads((tmp_path / "run" / "results.json").read_text())
    assert (row["parameters"]["scenario"], row["parameters"]["horizon_s"]) == (compared_in, horizon_s)
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["scenario"]["name"] == trained_on
    members = [entry["scenario"] for entry in config["scenario"].get("mixture", [])] or [config["scenario"]]
    assert {member["horizon_s"] for member in members} == {horizon_s}


def test_run__is_refused(refuse: Refuse) -> None:
    refuse("run --scenario level-0-sensors", "has no learner that the agents could drive")
    refuse("run --episodes 0", "--episodes", "1")
    refuse("run --recipe nobody", "unknown recipe 'nobody'")
    refuse("run --set gamma=2", "gamma")


def test_evaluate__interrupted_writes_nothing(ethbrake: Command, tmp_path: Path, monkeypatch) -> None:
    ctrl_c_when(monkeypatch, lambda shown: shown.name == "worlds")
    answer = ethbrake("evaluate", "--episodes", "5", "--agents", "coast", "--output", tmp_path / "new")
    assert (answer.status, answer.out) == (130, "")
    assert answer.err.splitlines()[-1] == "interrupted; nothing was written" and list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("core_alone")
def test_resume__deletes_the_results_of_the_policy_before_and_nothing_else(
    ethbrake, tiny_recipe, tmp_path, monkeypatch
) -> None:
    folder = tmp_path / "stopped"
    with monkeypatch.context() as patch:
        ctrl_c_when(patch, lambda shown: shown.done == 128)
        assert ethbrake("run", "--recipe", tiny_recipe, "--episodes", "20", "--output", folder).status == 130
    written = {"results.json", "worlds.csv"}
    assert {*status_of(folder, "written")[0]} == written and all((folder / name).exists() for name in written)
    (folder / "notes.txt").write_text("mine")
    (tmp_path / "precious.txt").write_text("mine")
    status = json.loads((folder / "run.json").read_text())
    hostile = {"written": [*written, "policy", "../precious.txt", "..", ".", 7]}
    (folder / "run.json").write_text(json.dumps(status | hostile))
    eb.resume(folder, on_progress=None)
    there = {path.name for path in folder.iterdir()}
    assert not there & written and {"notes.txt", "policy", "config.json"} <= there
    assert (tmp_path / "precious.txt").exists()
