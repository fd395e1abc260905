from __future__ import annotations

import csv
import json
import os
import random
import signal
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.envs.sb3 import EthBrakeVecEnv, make_sb3_vec_env
from ethbrake_marl.errors import AlreadyExists, InvalidInput, Progress
from ethbrake_marl.evaluation import evaluate, measures as outcome_module, summarise
from ethbrake_marl.harm import objective_harm, objectives_of
from ethbrake_marl.learning import runs as train_module
from ethbrake_marl.learning.runs import TrainingDiverged
from ethbrake_marl.learning.training import TrainingRecipe, load_recipe
from ethbrake_marl.policies import Policy, load_policy
from ethbrake_marl.scenario import load_scenario
from tests.learning.tiny import TINY_PPO

train = partial(train_module.train, measure=None)
SCENARIO = load_scenario("paper-random")
ROLLOUT = 16 * 32


@pytest.fixture
def recipe() -> TrainingRecipe:
    return load_recipe("ppo").replace(
        total_steps=3 * ROLLOUT,
        n_envs=16,
        n_steps=32,
        batch_size=128,
        n_epochs=2,
        network={"policy": [8], "value": [8, 4]},
        evaluation={"every_updates": 2, "worlds": 10, "seed": 7},
        checkpoint_every_updates=2,
    )


def _mean_weight(policy: Policy) -> dict[str, float]:
    return {"mean_weight": float(policy.tensors["policy.0.weight"].mean())}


def _bytes(folder: Path) -> tuple[bytes, bytes]:
    return (folder / "manifest.json").read_bytes(), (folder / "weights.safetensors").read_bytes()


def _rows(table: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(table.read_text().splitlines()))


def _spoiled_steps(monkeypatch: pytest.MonkeyPatch, spoil: Callable[[int, tuple[Any, ...]], tuple[Any, ...]]) -> None:
    """Let every step's answer pass through ``spoil(number of the step, answer)``."""

    class Spoiled(EthBrakeVecEnv):
        count = 0

        def step_wait(self) -> tuple[Any, ...]:
            self.count += 1
            return spoil(self.count, super().step_wait())

    def make(*args: Any, **kwargs: Any) -> EthBrakeVecEnv:
        environment = make_sb3_vec_env(*args, **kwargs)
        environment.__class__ = Spoiled
        return environment

    monkeypatch.setattr(train_module, "make_sb3_vec_env", make)


def test_train__leaves_a_complete_folder(recipe: TrainingRecipe, tmp_path: Path) -> None:
    seen: list[Progress] = []
    result = train(recipe, SCENARIO, tmp_path / "run", measure=lambda training: _mean_weight, on_progress=seen.append)
    assert (result.status, result.steps, result.updates) == ("finished", 3 * ROLLOUT, 3)
    assert [e["updates"] for e in result.evaluations] == [0, 2, 3]
    assert [p.done for p in seen] == [0, ROLLOUT, 2 * ROLLOUT, 3 * ROLLOUT]
    assert seen[-1].metrics["episode_return"] < 0.0

    names = sorted(str(p.relative_to(tmp_path / "run")) for p in (tmp_path / "run").rglob("*") if p.is_dir())
    assert names == ["policy", "policy-last", "tensorboard"]
    assert [p.stat().st_size > 0 for p in (tmp_path / "run" / "tensorboard").iterdir()] == [True]

    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert TrainingRecipe.of(config["recipe"]) == recipe
    assert config["scenario"]["name"] == "paper-random"
    assert (
        config["versions"]["torch"] == torch.__version__.split("+")[0]
        or config["versions"]["torch"] == torch.__version__
    )
    status = json.loads((tmp_path / "run" / "run.json").read_text())
    assert (status["status"], status["steps"], status["policy"]) == ("finished", 3 * ROLLOUT, "policy")
    assert (status["checkpoints"], status["alarms"]) == ([], [])

    rows = _rows(tmp_path / "run" / "progress.csv")
    assert [int(row["steps"]) for row in rows] == [0, ROLLOUT, 2 * ROLLOUT, 3 * ROLLOUT]
    assert [row["eval/mean_weight"] != "" for row in rows] == [True, False, True, True]
    assert float(rows[-1]["eval/mean_weight"]) == result.evaluations[-1]["mean_weight"]
    rates = [float(row["train/learning_rate"]) for row in rows[1:]]
    assert rates == pytest.approx([recipe.learning_rate.at(share) for share in (2 / 3, 1 / 3, 0.0)])
    for row in rows[2:]:  # an episode of this scenario is longer than one short rollout
        assert 0.0 <= float(row["rollout/collision_rate"]) <= 1.0
        assert float(row["rollout/total_harm"]) >= float(row["rollout/first_impact_harm"]) > 0.0

    loaded = load_policy(tmp_path / "run")
    assert loaded.manifest == result.policy.manifest
    assert loaded.manifest.learners == ("vehicle_2",)
    assert loaded.manifest.steps == 3 * ROLLOUT


def test_train__is_bitwise_reproducible_and_leaves_global_random_states(recipe: TrainingRecipe, tmp_path: Path) -> None:
    random.seed(1)
    np.random.seed(1)  # noqa: NPY002
    torch.manual_seed(1)
    expected = random.Random(1).random(), np.random.RandomState(1).rand(), torch.get_rng_state()
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        train(recipe, SCENARIO, tmp_path / name, seed=seed, steps=2 * ROLLOUT)
    assert _bytes(tmp_path / "a" / "policy") == _bytes(tmp_path / "b" / "policy")
    assert _bytes(tmp_path / "a" / "policy")[1] != _bytes(tmp_path / "c" / "policy")[1]
    assert (random.random(), np.random.rand()) == expected[:2]  # noqa: NPY002
    assert torch.equal(torch.get_rng_state(), expected[2])
    assert load_policy(tmp_path / "c").manifest.seeds == {"training": 6, "evaluation": recipe.evaluation.seed}


def test_train__learners_share_one_policy(recipe: TrainingRecipe, tmp_path: Path) -> None:
    scenario = SCENARIO.with_learners(["vehicle_2", "vehicle_3"])
    result = train(recipe, scenario, tmp_path / "run", steps=1)
    assert result.steps == 2 * ROLLOUT
    assert load_policy(tmp_path / "run").manifest.learners == ("vehicle_2", "vehicle_3")


def test_train__takes_names_and_paths(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="recipe 'ppo': total_steps = 0"):
        train("ppo", "paper-random", tmp_path / "run", steps=0)
    with pytest.raises(InvalidInput, match="unknown recipe 'pppo'"):
        train("pppo", SCENARIO, tmp_path / "run")
    with pytest.raises(InvalidInput, match="unknown scenario 'paper-randm'"):
        train("ppo", "paper-randm", tmp_path / "run")


def test_train__refuses_before_it_makes_anything(recipe: TrainingRecipe, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="'paper-random': no vehicle learns"):
        train(recipe, SCENARIO.replace(early_impacts="keep").with_learners([]), tmp_path / "run")
    with pytest.raises(InvalidInput, match="total_steps = 0"):
        train(recipe, SCENARIO, tmp_path / "run", steps=0)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "run").mkdir()
    with pytest.raises(AlreadyExists, match="run: is there already"):
        train(recipe, SCENARIO, tmp_path / "run")
    assert list((tmp_path / "run").iterdir()) == []


def test_train__ctrl_c_stops_after_the_update_in_progress(
    recipe: TrainingRecipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ctrl_c(step: int, answer: tuple[Any, ...]) -> tuple[Any, ...]:
        if step == 40:  # in the second rollout of 32 steps
            os.kill(os.getpid(), signal.SIGINT)
        return answer

    _spoiled_steps(monkeypatch, ctrl_c)
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    result = train(recipe, SCENARIO, tmp_path / "run", steps=100 * ROLLOUT)
    assert (result.status, result.updates, result.steps) == ("interrupted", 2, 2 * ROLLOUT)
    assert json.loads((tmp_path / "run" / "run.json").read_text())["status"] == "interrupted"
    assert load_policy(tmp_path / "run").manifest.steps == 2 * ROLLOUT
    assert len(_rows(tmp_path / "run" / "progress.csv")) == 2
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


class _Planted:
    """Measures a harm that was written down before, so that a training seems to collapse."""

    def __init__(self, *harms: float) -> None:
        self._left = list(harms)

    def __call__(self, policy: Policy) -> dict[str, float]:
        return {"first_impact_harm": self._left.pop(0)}


def test_train__a_collapse_raises_an_alarm_and_by_default_goes_on(recipe: TrainingRecipe, tmp_path: Path) -> None:
    said: list[str] = []
    planted = _Planted(90.0, 7.0, 60.0, 60.0, 7.0)
    result = train(
        recipe, SCENARIO, tmp_path / "run", steps=8 * ROLLOUT, measure=lambda training: planted,
        on_progress=lambda progress: said.append(progress.note),
    )  # fmt: skip
    assert (result.status, result.updates, len(result.alarms)) == ("finished", 8, 1)
    assert "training is lost" in result.alarms[0]
    assert [note for note in said if note] == [f"alarm: {result.alarms[0]}"]
    rows = [row for row in _rows(tmp_path / "run" / "progress.csv") if row["eval/alarm"]]
    assert [row["eval/alarm"] for row in rows] == ["0", "0", "0", "1", "0"]


def test_train__stops_when_lost_and_goes_on_to_the_same_bits(recipe: TrainingRecipe, tmp_path: Path) -> None:
    harms = (90.0, 7.0, 60.0, 61.0, 7.0)
    whole = train(recipe, SCENARIO, tmp_path / "whole", steps=8 * ROLLOUT, measure=lambda training: _Planted(*harms))
    stopped = train(
        recipe, SCENARIO, tmp_path / "run", steps=8 * ROLLOUT, measure=lambda training: _Planted(*harms),
        stop_when_lost=True,
    )  # fmt: skip
    assert (stopped.status, stopped.updates) == ("interrupted", 6)
    status = json.loads((tmp_path / "run" / "run.json").read_text())
    assert (status["status"], status["reason"]) == ("interrupted", stopped.alarms[0])
    assert load_policy(tmp_path / "run").manifest.steps == 2 * ROLLOUT  # of the least harm
    result = train_module.resume(
        tmp_path / "run", measure=lambda training: _Planted(*harms[4:]), on_progress=None, stop_when_lost=True
    )
    assert (result.status, result.alarms) == ("finished", whole.alarms)
    assert _bytes(tmp_path / "run" / "policy-last") == _bytes(tmp_path / "whole" / "policy-last")


def test_train__stops_at_an_evaluation_that_is_not_good_enough_and_goes_on_to_the_same_bits(
    recipe: TrainingRecipe, tmp_path: Path
) -> None:
    harms, heard = (90.0, 50.0, 8.0, 7.0, 6.0), []

    def judge(evaluation: Mapping[str, float]) -> str | None:
        heard.append((evaluation["updates"], evaluation["first_impact_harm"]))
        return "8 will not do" if evaluation["first_impact_harm"] == 8.0 else None

    whole = train(recipe, SCENARIO, tmp_path / "whole", steps=8 * ROLLOUT, measure=lambda training: _Planted(*harms))
    stopped = train(
        recipe, SCENARIO, tmp_path / "run", steps=8 * ROLLOUT, measure=lambda training: _Planted(*harms), stop_at=judge
    )
    assert (stopped.status, stopped.updates) == ("interrupted", 4) and whole.updates == 8
    assert json.loads((tmp_path / "run" / "run.json").read_text())["reason"] == "8 will not do"
    result = train_module.resume(
        tmp_path / "run", measure=lambda training: _Planted(*harms[3:]), on_progress=None, stop_at=judge
    )
    assert result.status == "finished" and heard == [(0, 90.0), (2, 50.0), (4, 8.0), (6, 7.0), (8, 6.0)]
    assert _bytes(tmp_path / "run" / "policy") == _bytes(tmp_path / "whole" / "policy")


def test_train__measures_what_an_evaluation_of_the_kept_policy_tells_and_proves_nothing(
    recipe: TrainingRecipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    prove = outcome_module.known_limits
    monkeypatch.setattr(outcome_module, "known_limits", lambda *given: asked.append("limits") or prove(*given))
    result = train_module.train(recipe, SCENARIO, tmp_path / "run", steps=ROLLOUT, on_progress=None)
    assert asked == []
    worlds = result.training.scenario.sample(recipe.evaluation.worlds, recipe.evaluation.seed)
    agents = {"policy": LearnedAgent(result.last_policy, "policy")}
    (row,) = summarise(evaluate(worlds, agents, scenario=result.training.scenario))
    assert asked == ["limits"]
    names = ("first_impact_harm", "total_harm", "collision_rate")
    told = {name: getattr(row, name).value for name in names} | {"horizon_rate": row.horizon_ends / row.episodes}
    assert {name: result.evaluations[-1][name] for name in told} == told


def test_train__second_ctrl_c_stops_at_once_and_keeps_the_last_policy(
    recipe: TrainingRecipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def impatient(step: int, answer: tuple[Any, ...]) -> tuple[Any, ...]:
        if step in (40, 41):
            os.kill(os.getpid(), signal.SIGINT)
        return answer

    _spoiled_steps(monkeypatch, impatient)
    with pytest.raises(KeyboardInterrupt):
        train(recipe, SCENARIO, tmp_path / "run", steps=100 * ROLLOUT)
    assert json.loads((tmp_path / "run" / "run.json").read_text())["status"] == "interrupted"
    assert load_policy(tmp_path / "run").manifest.steps == ROLLOUT


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # the training library's own statistics overflow first
@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda reward: reward * np.nan, r"rewards\[row 0\] = nan at step 640"),
        (lambda reward: reward * 0.0 + np.float32(1e25), r"train/loss = inf after step 1024: must be finite"),
        (lambda reward: reward * 0.0 + np.float32(3e38), r"the gradient of the loss is not finite at step 1024"),
    ],
)
def test_train__numbers_that_are_not_finite_stop_it_and_keep_the_last_good_policy(
    spoil: Callable[[Any], Any], message: str, recipe: TrainingRecipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train(recipe, SCENARIO, tmp_path / "sound", steps=ROLLOUT)
    _spoiled_steps(monkeypatch, lambda step, a: (a[0], spoil(a[1]) if step == 40 else a[1], *a[2:]))
    with pytest.raises(TrainingDiverged, match=message):
        train(recipe, SCENARIO, tmp_path / "run", steps=ROLLOUT + 1)
    status = json.loads((tmp_path / "run" / "run.json").read_text())
    assert status["status"] == "failed"
    assert status["reason"].startswith("TrainingDiverged: training: ")
    kept = load_policy(tmp_path / "run")
    assert kept.manifest.steps == ROLLOUT
    assert np.isfinite(kept.tensors["policy.0.weight"]).all()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda reward: reward * np.nan, r"rewards\[row 0\] = nan at step 640: must be finite"),
        (lambda reward: reward * 0.0 + np.float32(3e38), r"(the gradient of the loss is not finite|critic_loss = inf)"),
    ],
)
def test_train__sac_stops_on_numbers_that_are_not_finite_too(
    spoil: Callable[[Any], Any], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = {"n_envs": 16, "total_steps": 1280, "learning_starts": 100, "batch_size": 64, "buffer_size": 64}
    recipe = load_recipe("sac").replace(
        **small, network={"policy": [8], "value": [8]}, log_every_updates=5, checkpoint_every_updates=1000
    )
    _spoiled_steps(monkeypatch, lambda step, a: (a[0], spoil(a[1]) if step == 40 else a[1], *a[2:]))
    with pytest.raises(TrainingDiverged, match=message):
        train(recipe, SCENARIO, tmp_path / "run")
    assert load_policy(tmp_path / "run").manifest.steps in (35 * 16, 40 * 16)


def test_train__an_error_of_the_callers_function_is_passed_on(recipe: TrainingRecipe, tmp_path: Path) -> None:
    def broken(policy: Policy) -> dict[str, float]:
        raise RuntimeError("no worlds")

    with pytest.raises(RuntimeError, match="no worlds"):
        train(recipe, SCENARIO, tmp_path / "run", measure=lambda training: broken)
    status = json.loads((tmp_path / "run" / "run.json").read_text())
    assert (status["status"], status["reason"]) == ("failed", "RuntimeError: no worlds")
    assert load_policy(tmp_path / "run").manifest.steps == 0


def _fits(recipe: Any, decisions: int) -> bool:
    """Whether an update of a counterfactual recipe can be made of so many decisions; one of SAC always can."""
    sac = recipe.algorithm == "sac"
    return sac or (decisions % recipe.batch_size == 0 and decisions >= recipe.counterfactuals)


OF_THEIR_KIND = ("cooperation", "cooperation-ppo", "modes", "ppo-paper", "sac-paper")  # others differ in numbers


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in OF_THEIR_KIND else pytest.mark.slow)
        for name in sorted(TrainingRecipe.shipped())
    ],
)
def test_shipped_recipe__trains_for_one_update(name: str, tmp_path: Path) -> None:
    recipe = load_recipe(name)
    if recipe.algorithm == "ppo":
        recipe = recipe.replace(n_envs=16, n_steps=recipe.batch_size // 16)
    else:
        sizes = (2**k for k in range(10))
        fewest = next(n for n in sizes if _fits(recipe, n * recipe.rounds))
        recipe = recipe.replace(n_envs=fewest)
    result = train(recipe, SCENARIO, tmp_path / "run", steps=1)
    assert (result.status, result.updates, result.steps) == ("finished", 1, recipe.n_envs * recipe.rounds)
    assert load_policy(tmp_path / "run").manifest.algorithm == recipe.algorithm


def test_train__shows_its_progress_on_stderr_unless_told_not_to(tmp_path, capsys):
    recipe = TINY_PPO.replace(total_steps=256)
    train_module.train(recipe, "paper-random", tmp_path / "shown")
    told = capsys.readouterr()
    lines = told.err.splitlines()
    assert told.out == "" and lines[0].startswith("training: 0 of 256, first-impact harm ")
    assert lines[-1].startswith("training: 256 of 256, first-impact harm ") and len(lines) == len(set(lines))
    train_module.train(recipe, "paper-random", tmp_path / "quiet", on_progress=None)
    assert capsys.readouterr().err == ""


def test_train__on_a_terminal_rewrites_one_line(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    train_module.train(TINY_PPO.replace(total_steps=256), "paper-random", tmp_path / "run")
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and told.endswith("\n") and told.count("\r") > 1


def test_train__keeps_and_tells_what_the_learners_objectives_make_of_the_harm(tmp_path: Path) -> None:
    objectives = ["total", "own", "weighted:0.001,0.001,1"]
    scenario = SCENARIO.replace(
        objective=objectives, roles={"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "learner"}
    )
    recipe = TINY_PPO.replace(total_steps=6 * 128, evaluation={"every_updates": 1, "worlds": 10, "seed": 7})
    result = train_module.train(recipe, scenario, tmp_path / "run", on_progress=None)
    rows = [row for row in _rows(tmp_path / "run" / "progress.csv") if row["eval/objective"]]
    best = min(result.evaluations, key=lambda each: each["objective"])
    worlds = scenario.sample(10, 7).worlds
    kept = load_policy(tmp_path / "run" / "policy")
    assert len(rows) == len(result.evaluations) > 3 and kept.manifest.steps == best["steps"]
    ledger = evaluate(worlds, {"kept": LearnedAgent(kept)}, scenario=scenario).outcome("kept").ledger
    for name, vehicle in (("vehicle_2", 1), ("vehicle_3", 2)):
        harm = objective_harm(ledger, "first", objectives_of(objectives, 3))[:, vehicle].mean()
        assert best[f"objective_{name}"] == pytest.approx(harm)
    assert best["objective"] == (best["objective_vehicle_2"] + best["objective_vehicle_3"]) / 2
    plain = train_module.train(recipe, SCENARIO, tmp_path / "plain", on_progress=None)
    assert not any("objective" in name for name in plain.evaluations[0])
