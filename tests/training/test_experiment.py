"""A whole experiment on a training of two small updates: what is compared, what is written, how it ends."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.progress import Progress
from ethbrake_marl.training.experiment import Experiment, compared_teams, run_experiment
from ethbrake_marl.training.run import RunFolder
from tests.training.tiny import PAIR, TINY

SHORT = TINY.replace(total_steps=256, evaluation={"every_updates": 1, "worlds": 10, "seed": 7})
EPISODES = 40


def quick(run: Path, scenario: str = "paper-random", recipe: Any = SHORT, **settings: Any) -> Experiment:
    return run_experiment(recipe, eb.load_scenario(scenario), run, episodes=EPISODES, **settings)[0]


def status(run: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((run / "run.json").read_text())
    return content


def test_one_learner__is_compared_alone_and_in_the_hybrid(tmp_path: Path) -> None:
    run = tmp_path / "run"
    found = quick(run, force=False)
    names = ["full_brake", "e_v2x_bm", "e_v2x_bm:pairwise", "trained policy", "hybrid"]
    assert [*found.compared.teams] == names and found.learned == "trained policy"
    again = eb.evaluate("paper-random", f"policy@{run},policy@{run}+episode", episodes=EPISODES)
    for name, spec in (("trained policy", f"policy@{run}"), ("hybrid", f"policy@{run}+episode")):
        assert found.compared.result[name]["total_harm"].tolist() == again[spec]["total_harm"].tolist()
    worst = np.maximum(*(found.compared.result[name]["first_impact_harm"] for name in ("trained policy", "e_v2x_bm")))
    assert (found.compared.result["hybrid"]["first_impact_harm"] <= worst).all()
    saved = eb.read_result(run / "results.json")
    assert [*saved.agents] == names and saved.rows is not None and len(saved.rows["world"]) == len(names) * EPISODES
    assert {"sampled_harm", "vehicle_1_shoved_m"} <= saved.agents["hybrid"].keys()
    end = status(run)
    assert (end["status"], end["stage"], end["steps"], end["reason"]) == ("finished", "evaluation", 256, None)
    assert end["written"] == ["results.json", "worlds.csv"] and end["policy"] == "policy" and end["started_utc"]


def test_several_learners__are_compared_whole_without_each_and_shielded(tmp_path: Path) -> None:
    found = quick(tmp_path / "run", PAIR, SHORT.replace(scheme="independent"))
    names = ["full_brake", "e_v2x_bm", "trained team", "all but vehicle_2", "all but vehicle_3", "shielded team"]
    assert [*found.compared.teams] == names and found.learned == "trained team"
    again = eb.evaluate(PAIR, f"team@{tmp_path / 'run'}", episodes=EPISODES)[f"team@{tmp_path / 'run'}"]
    assert found.compared.result["trained team"]["total_harm"].tolist() == again["total_harm"].tolist()
    teams = found.compared.teams
    assert [teams["all but vehicle_2"].drivers[body].name for body in (2, 3)] == ["full_brake", "learned"]
    assert [teams["all but vehicle_3"].drivers[body].name for body in (2, 3)] == ["learned", "full_brake"]


def test_harm_count__of_the_reward_is_what_all_agents_minimise(tmp_path: Path) -> None:
    total = quick(tmp_path / "run", recipe=SHORT.replace(reward={"harm": 1.0, "harm_count": "total"}))
    assert total.compared.harm_count == "total" and total.compared.teams["hybrid"].shield.count == "total"
    right = eb.evaluate("paper-random", "e_v2x_bm", episodes=EPISODES, harm_count="total")["e_v2x_bm"]["total_harm"]
    assert total.compared.result["e_v2x_bm"]["total_harm"].tolist() == right.tolist()


def test_baseline__that_cannot_drive_is_left_out_with_a_word(tmp_path: Path) -> None:
    notes: list[str] = []
    found = quick(tmp_path / "run", "paper-random-buildup", on_progress=lambda progress: notes.append(progress.note))
    assert [*found.compared.teams] == ["full_brake", "e_v2x_bm", "trained policy", "hybrid"]
    (said,) = filter(None, notes)
    assert said.startswith("e_v2x_bm:pairwise is left out: e_v2x_bm:pairwise: brakes build up gradually")


def test_report__gets_the_measures_that_there_are_and_writes_into_the_run(tmp_path: Path) -> None:
    class Mine:
        measures: tuple[str, ...] = ("injury_lr4s", "nobody_has_this")

        def write(self, experiment: Experiment, tell: Callable[[Progress], None]) -> tuple[list[str], str]:
            (experiment.trained.directory / "mine.txt").write_text("x")
            other = experiment.in_another(eb.load_scenario("paper-random-obstacle"), 10, ["coast"], ())
            assert [*other.teams] == ["coast", "trained policy", "hybrid"] and other.result.n == 10
            return ["table"], "there"

    run = tmp_path / "run"
    found, tables, where = run_experiment(
        SHORT, eb.load_scenario("paper-random"), run, episodes=20, list_seed=3, report=Mine()
    )
    assert (found.measures, tables, where) == (("injury_lr4s",), ["table"], "there")
    assert found.compared.result.about["seed"] == 3 and "mine.txt" in status(run)["written"]


def stop_when(done: Callable[[Progress], bool]) -> Callable[[Progress], None]:
    def told(progress: Progress) -> None:
        if done(progress):
            raise KeyboardInterrupt

    return told


def test_interrupted_evaluation__keeps_the_policy_and_says_so(tmp_path: Path) -> None:
    run = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        quick(run, on_progress=stop_when(lambda progress: progress.name == "evaluation"))
    end = status(run)
    assert (end["status"], end["stage"], end["written"]) == ("interrupted", "evaluation", [])
    assert (run / "policy" / "weights.safetensors").is_file()
    with pytest.raises(eb.EthBrakeError, match="has finished and cannot be resumed"):
        eb.resume(run, on_progress=None)


def test_failed_report__says_so(tmp_path: Path) -> None:
    class Broken:
        measures: tuple[str, ...] = ()

        def write(self, experiment: Experiment, tell: Any) -> Any:
            raise RuntimeError("no space left")

    run = tmp_path / "run"
    with pytest.raises(RuntimeError):
        run_experiment(SHORT, eb.load_scenario("paper-random"), run, episodes=20, report=Broken())
    end = status(run)
    assert (end["status"], end["reason"]) == ("failed", "RuntimeError('no space left')")
    assert end["written"] == ["results.json", "worlds.csv"] and end["steps"] == 256


def test_evaluation__lets_nobody_train_in_the_folder(tmp_path: Path) -> None:
    run = tmp_path / "run"

    def told(progress: Progress) -> None:
        if progress.name == "evaluation":
            with pytest.raises(eb.EthBrakeError, match="another process is training in this folder"), folder.held():
                pass
            tried.append(progress)

    folder, tried = RunFolder(run), list[Progress]()
    quick(run, on_progress=told)
    assert tried


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"scenario": "cooperation-0-sensors"}, "has no learner"),
        ({"list_seed": -1}, "seed"),
        ({"recipe": SHORT.replace(scheme="independent")}, "needs several learners"),
    ],
)
def test_refused__before_anything_is_written(settings: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(eb.EthBrakeError, match=said):
        quick(tmp_path / "run", **settings)
    assert not (tmp_path / "run").exists()


def test_folder__that_exists_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(eb.EthBrakeError, match="already exists and is not the folder of a run"):
        quick(tmp_path, force=True)
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_compared_teams__may_be_others() -> None:
    scenario, policy = eb.load_scenario("paper-random"), eb.load_shipped("ppo")
    assert [*compared_teams({"vehicle_2": policy}, scenario, "first", ["coast"])] == [
        "coast",
        "trained policy",
        "hybrid",
    ]
