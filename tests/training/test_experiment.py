"""A whole experiment on a training of two small updates: what is compared, what is written, how it ends."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.counts import HarmCount
from ethbrake_marl.progress import Progress
from ethbrake_marl.training.experiment import Experiment, run_experiment
from ethbrake_marl.training.run import RunFolder
from tests.refused import refused
from tests.training.tiny import PAIR, TINY, UPDATE

SHORT = TINY.replace(total_steps=UPDATE)
EPISODES = 20


def quick(run: Path, scenario: str = "paper-random", recipe: Any = SHORT, **settings: Any) -> Experiment:
    return run_experiment(recipe, eb.load_scenario(scenario), run, episodes=EPISODES, **settings)[0]


def status(run: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((run / "run.json").read_text())
    return content


@pytest.mark.parametrize("count", ["first", "honest"])
def test_one_learner__is_compared_alone_and_in_the_hybrid(count: str, tmp_path: Path) -> None:
    run = tmp_path / "run"
    found = quick(run, recipe=SHORT.replace(reward={"harm": 1.0, "harm_count": count}))
    names = ["full_brake", "e_v2x_bm", "e_v2x_bm:pairwise", "trained policy", "hybrid"]
    assert [*found.compared.teams] == names and found.learned == "trained policy"
    assert found.compared.harm_count == HarmCount.of(count)
    specs = {"e_v2x_bm": "e_v2x_bm", "trained policy": f"policy@{run}", "hybrid": f"policy@{run}+episode"}
    again = eb.evaluate("paper-random", [*specs.values()], episodes=EPISODES, harm_count=count)
    for name, spec in specs.items():
        assert (
            found.compared.result[name][HarmCount.of(count).column].tolist()
            == again[spec][HarmCount.of(count).column].tolist()
        )
    saved = eb.read_result(run / "results.json")
    assert [*saved] == names and len((run / "worlds.csv").read_text().splitlines()) == 1 + len(names) * EPISODES
    assert ("pushed_mps" in saved["hybrid"]) == (count == "honest")
    assert "pushed_m_1" in saved["hybrid"]
    end = status(run)
    assert (end["status"], end["stage"], end["steps"], end["reason"]) == ("finished", "evaluation", UPDATE, None)
    assert end["written"] == ["results.json", "worlds.csv"] and end["started_utc"]


def test_policy__may_learn_in_another_scenario_than_that_of_the_comparison(tmp_path: Path) -> None:
    experiment = quick(tmp_path / "run", train_on=eb.load_scenario("paper-random-obstacle"))
    assert experiment.trained.training.scenario.name == "paper-random-obstacle"
    assert experiment.compared.scenario.name == "paper-random"
    again = eb.evaluate("paper-random", f"policy@{tmp_path / 'run'}", episodes=EPISODES)
    (columns,) = again.columns.values()
    assert experiment.compared.result["trained policy"]["total_harm"].tolist() == columns["total_harm"].tolist()


@pytest.mark.parametrize("scheme", ["independent", "shared"])
def test_several_learners__are_compared_whole_without_each_and_shielded(scheme: str, tmp_path: Path) -> None:
    run = tmp_path / "run"
    found = quick(run, PAIR, SHORT.replace(scheme=scheme))
    names = ["full_brake", "e_v2x_bm", "trained team", "all but vehicle_2", "all but vehicle_3", "shielded team"]
    assert [*found.compared.teams] == names and found.learned == "trained team"
    policies = found.trained.policies
    rear = {"vehicle_2": "full_brake", "vehicle_3": eb.LearnedAgent(policies["vehicle_3"])}
    front = {"vehicle_2": eb.LearnedAgent(policies["vehicle_2"]), "vehicle_3": "full_brake"}
    specs = {"all but vehicle_2": rear, "all but vehicle_3": front, "trained team": f"team@{run}"}
    again = eb.evaluate(PAIR, specs, episodes=EPISODES)
    for name in specs:
        assert np.array_equal(found.compared.result[name]["total_harm"], again[name]["total_harm"]), name


def test_report__gets_the_measures_that_there_are_and_writes_into_the_run(tmp_path: Path) -> None:
    class Mine:
        measures: tuple[str, ...] = ("pushed_mps", "nobody_has_this")

        def write(self, experiment: Experiment, tell: Callable[[Progress], None]) -> tuple[list[str], str]:
            (experiment.trained.directory / "mine.txt").write_text("x")
            other = experiment.in_another(eb.load_scenario("paper-random-obstacle"), 10, ["coast"], ())
            assert [*other.teams] == ["coast", "trained policy", "hybrid"] and other.result.n == 10
            return ["table"], "there"

    run, notes = tmp_path / "run", list[str]()
    found, tables, where = run_experiment(
        SHORT, eb.load_scenario("paper-random-buildup"), run, episodes=10, list_seed=3, report=Mine(),
        on_progress=lambda progress: notes.append(progress.note),
    )  # fmt: skip
    assert (found.measures, tables, where) == (("pushed_mps",), ["table"], "there")
    assert found.compared.result.about["seed"] == 3 and "mine.txt" in status(run)["written"]
    (said,) = filter(None, notes)
    assert said.startswith("e_v2x_bm:pairwise is left out: e_v2x_bm:pairwise does not cover build-up")


def test_evaluation__that_is_interrupted_keeps_the_policy_and_says_so(tmp_path: Path) -> None:
    run = tmp_path / "run"

    def told(progress: Progress) -> None:
        if progress.name == "evaluation":
            with refused("another process is training in this folder"), RunFolder(run).held():
                pass
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        quick(run, on_progress=told)
    end = status(run)
    assert (end["status"], end["stage"], end["written"]) == ("interrupted", "evaluation", [])
    assert (run / "policy" / "weights.safetensors").is_file()
    with refused("has finished and cannot be resumed"):
        eb.resume(run, on_progress=None)


def test_report__that_fails_says_so(tmp_path: Path) -> None:
    class Broken:
        measures: tuple[str, ...] = ()

        def write(self, experiment: Experiment, tell: Any) -> Any:
            raise RuntimeError("no space left")

    run = tmp_path / "run"
    with pytest.raises(RuntimeError):
        quick(run, report=Broken())
    end = status(run)
    assert (end["status"], end["reason"]) == ("failed", "RuntimeError('no space left')")
    assert end["written"] == ["results.json", "worlds.csv"] and end["steps"] == UPDATE


@pytest.mark.parametrize(
    ("settings", "said"), [({"scenario": "level-0-sensors"}, "has no learner"), ({"list_seed": -1}, "seed")]
)
def test_refused__before_anything_is_written(settings: dict[str, Any], said: str, tmp_path: Path) -> None:
    with refused(said):
        quick(tmp_path / "run", **settings)
    assert not (tmp_path / "run").exists()
