"""A training: the folder that it leaves, the policies that it keeps, and what stops it."""

from __future__ import annotations

import io
import json
import os
import random
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from ethbrake_marl.training.finite import TrainingDiverged
from stable_baselines3 import A2C
from stable_baselines3.common.vec_env import VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ethbrake_marl.agents.drive import drive
from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.motion.digest import physics_digest
from ethbrake_marl.names import make_agent, team_of
from ethbrake_marl.policies.bundle import load_policy
from ethbrake_marl.progress import Progress
from ethbrake_marl.training import train as train_module
from ethbrake_marl.training.algorithm import Algorithm, name_in_sb3
from ethbrake_marl.training.ppo import Ppo
from ethbrake_marl.training.recipe import ALGORITHMS, PpoRecipe, TrainingRecipe, load_recipe, register_algorithm
from ethbrake_marl.training.run import RunFolder
from ethbrake_marl.training.train import train
from ethbrake_marl.worlds.game import game_of
from tests.refused import refused
from tests.training.tiny import TINY, TINY_SAC, UPDATE, begin, dying_after, go_on, kept, killed


def test_train__leaves_a_folder_whose_policy_is_the_best_on_the_list(tmp_path: Path) -> None:
    run, reports = tmp_path / "run", list[Progress]()
    result = train(TINY, "paper-random", run, on_progress=reports.append, settings=["x=1"])
    names = ["config.json", "policy", "policy-last", "progress.csv", "run.json", "run.lock", "team.json", "tensorboard"]
    assert sorted(path.name for path in run.iterdir()) == names
    assert (result.status, result.steps, result.updates) == ("finished", 9 * UPDATE, 9)
    assert [each["updates"] for each in result.evaluations] == [0, 3, 6, 9]
    assert [report.done for report in reports] == [UPDATE * k for k in range(10)]
    assert {report.total for report in reports} == {9 * UPDATE}

    harm = [each["first_impact_harm"] for each in result.evaluations]
    assert result.metrics == result.evaluations[int(np.argmin(harm))]
    policy, last = load_policy(run), load_policy(run / "policy-last")
    assert policy.manifest == result.policy.manifest and last.manifest == result.last_policy.manifest
    assert (policy.manifest.steps, last.manifest.steps) == (result.metrics["steps"], 9 * UPDATE)
    assert policy.manifest.versions["physics"] == physics_digest()
    assert policy.manifest.learners == ("vehicle_2",) and policy.manifest.seeds == {"training": 0, "evaluation": 7}

    scenario, game = game_of("paper-random")
    assert result.agent == f"policy@{run}"
    ended = drive(game, scenario.sample(10, 7), team_of(make_agent(result.agent), scenario))
    assert ended.harm("first").mean() == pytest.approx(min(harm), rel=1e-12)

    status, config = (json.loads((run / name).read_text()) for name in ("run.json", "config.json"))
    found = status["status"], status["steps"], status["policy"], status["checkpoints"]
    assert found == ("finished", 9 * UPDATE, "policy", [])
    assert TrainingRecipe.model_fields.keys() - config["recipe"].keys() == {"observation"} and config["settings"] == [
        "x=1"
    ]
    rows = RunFolder(run).rows()
    assert [int(row["steps"]) for row in rows] == [UPDATE * k for k in range(10)]
    assert [float(row["eval/first_impact_harm"]) for row in rows[::3]] == pytest.approx(harm)
    events = EventAccumulator(str(run / "tensorboard"))
    events.Reload()
    told = [(event.step, event.value) for event in events.Scalars("eval/first_impact_harm")]
    assert told == [(3 * UPDATE * k, pytest.approx(value, rel=1e-6)) for k, value in enumerate(harm)]


def test_train__is_the_same_twice_and_leaves_the_global_generators(tmp_path: Path) -> None:
    def states() -> Any:
        numpy_state = np.random.get_state()[1].tolist()  # noqa: NPY002
        return random.getstate(), numpy_state, torch.get_rng_state().tolist(), torch.get_num_threads()

    torch.set_num_threads(2)
    before = states()
    begin("ppo", tmp_path / "one")
    assert states() == before
    np.random.rand(3)  # noqa: NPY002
    begin("ppo", tmp_path / "two")
    assert kept(tmp_path / "one") == kept(tmp_path / "two")
    other = train(TINY, "paper-random", tmp_path / "other", seed=1, on_progress=None, measure=None)
    assert (
        load_policy(tmp_path / "one/policy-last").manifest.weights_sha256 != other.last_policy.manifest.weights_sha256
    )


@pytest.mark.parametrize(("count", "best"), [("first", 3), ("total", 6)])
def test_train__keeps_the_best_by_the_count_of_the_reward(count: str, best: int, tmp_path: Path) -> None:
    planted = iter([(9.0, 9.0), (1.0, 8.0), (2.0, 3.0), (3.0, 4.0)])

    def measure(training: Any) -> Any:
        return lambda policies: dict(zip(("first_impact_harm", "total_harm"), next(planted), strict=True))

    recipe = TINY.replace(reward={"harm": 0.05, "harm_count": count})
    result = train(recipe, "paper-random", tmp_path / "run", measure=measure, on_progress=None)
    assert result.policy.manifest.steps == best * UPDATE
    assert (result.last_policy.manifest.steps, result.metrics["updates"]) == (9 * UPDATE, best)


def test_train__objectives_decide_where_they_are_not_the_harm_of_the_line(tmp_path: Path) -> None:
    recipe = TINY.replace(reward={"harm": 0.05, "objective": "own"}, total_steps=UPDATE)
    result = train(recipe, "cooperation-3-pair", tmp_path / "run", on_progress=None)
    for each in result.evaluations:
        own = [each["objective_vehicle_2"], each["objective_vehicle_3"]]
        assert each["objective"] == pytest.approx(sum(own) / 2) and 0.0 < sum(own) < each["first_impact_harm"]


def closed() -> Any:
    """Return a stream that is closed."""
    stream = io.StringIO()
    stream.close()
    return stream


def full(text: str) -> int:
    """Write to a full disk."""
    raise OSError(28, "No space left on device")


STREAMS: dict[str, Callable[[], Any]] = {
    "none": lambda: None,
    "closed": closed,
    "without isatty": lambda: SimpleNamespace(write=len, flush=lambda: None),
    "without flush": lambda: SimpleNamespace(write=len, isatty=lambda: False),
    "full": lambda: SimpleNamespace(write=full, flush=lambda: None, isatty=lambda: True),
}


@pytest.mark.parametrize("broken", STREAMS)
def test_train__needs_no_stream_for_its_progress(broken: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", STREAMS[broken]())
        result = begin("ppo", tmp_path / "run", steps=UPDATE, on_progress="show")
    assert result.status == "finished"


def test_train__shows_its_progress(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = begin("ppo", tmp_path / "run", steps=2 * UPDATE, on_progress="show")
    harm = [f"first-impact harm {each['first_impact_harm']:.2f}" for each in result.evaluations]
    lines = [f"training: 0 of 256, {harm[0]}", f"training: 128 of 256, {harm[0]}", f"training: 256 of 256, {harm[1]}"]
    assert capsys.readouterr().err.splitlines() == lines


def test_train__in_two_threads_is_refused_and_the_first_one_is_as_alone(tmp_path: Path) -> None:
    errors: list[BaseException] = []

    def second() -> None:
        try:
            begin("ppo", tmp_path / "second")
        except InvalidInput as error:
            errors.append(error)

    def meanwhile(progress: Progress) -> None:
        if progress.updates == 2:
            thread = threading.Thread(target=second)
            thread.start()
            thread.join()

    begin("ppo", tmp_path / "first", on_progress=meanwhile)
    begin("ppo", tmp_path / "alone")
    assert "another thread of this process is training" in str(errors[0]) and not (tmp_path / "second").exists()
    assert kept(tmp_path / "first") == kept(tmp_path / "alone")


def test_train__a_second_ctrl_c_stops_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Impatient(train_module.EthBrakeVecEnv):
        count = 0

        def step_wait(self) -> Any:
            self.count += 1
            if self.count in (40, 41):
                os.kill(os.getpid(), signal.SIGINT)
            return super().step_wait()

    with monkeypatch.context() as patch:
        patch.setattr(train_module, "EthBrakeVecEnv", Impatient)
        with pytest.raises(KeyboardInterrupt):
            begin("ppo", tmp_path / "run")
    status = json.loads((tmp_path / "run/run.json").read_text())
    assert (status["status"], status["updates"]) == ("interrupted", 2)
    go_on(tmp_path / "run")
    begin("ppo", tmp_path / "whole")
    assert kept(tmp_path / "run") == kept(tmp_path / "whole")


SPOILED = {
    "rewards": (lambda answer: answer[1].__setitem__(3, np.nan), r"rewards\[row 3\] = nan at step"),
    "observations": (lambda answer: answer[0].__setitem__((2, 5), np.inf), r"observations\[row 2\] = inf"),
    "huge": (lambda answer: answer[1].__imul__(np.float32(1e38)), r"the gradient of the loss is not finite|loss"),
}


@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning", "ignore:invalid value:RuntimeWarning")
@pytest.mark.parametrize("kind", SPOILED)
@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_train__numbers_that_are_not_finite_stop_it(
    name: str, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spoil, message = SPOILED[kind]

    class Spoiled(train_module.EthBrakeVecEnv):
        count = 0

        def step_wait(self) -> Any:
            self.count += 1
            answer = super().step_wait()
            if self.count > 36:
                spoil(answer)
            return answer

    monkeypatch.setattr(train_module, "EthBrakeVecEnv", Spoiled)
    with pytest.raises(TrainingDiverged, match=message):
        begin(name, tmp_path / "run")
    status = json.loads((tmp_path / "run/run.json").read_text())
    assert status["status"] == "failed" and status["reason"].startswith("TrainingDiverged: training: ")
    policy = load_policy(tmp_path / "run/policy-last")
    assert all(np.isfinite(each).all() for each in policy.tensors.values())


def test_train__a_weight_that_is_not_finite_stops_it(tmp_path: Path) -> None:
    class Broken(Ppo):
        def build(self, training: Any, environment: Any) -> Any:
            model = super().build(training, environment)
            with torch.no_grad():
                model.policy.log_std.fill_(-200.0)  # no noise
            return model

    class BrokenRecipe(PpoRecipe):
        algorithm: str = "broken"  # type: ignore[assignment]

    register_algorithm("broken", BrokenRecipe, Broken)
    try:
        with pytest.raises(TrainingDiverged, match="noise of exploration is not finite at step 0"):
            train(TINY.replace(algorithm="broken"), "paper-random", tmp_path / "run", on_progress=None)
    finally:
        del ALGORITHMS.loaded["broken"]


class A2cRecipe(TrainingRecipe):
    """Recipe of an algorithm of a user."""

    algorithm: str = "a2c"
    n_steps: int = 8
    gae_lambda: float = 1.0
    network: Any = None

    def network_spec(self, observation_size: int) -> Any:
        """Return PPO's: A2C has the same networks."""
        return TINY.network_spec(observation_size)


class A2c(Algorithm):
    """An algorithm of a user: only what must be written."""

    def build(self, training: Any, environment: Any) -> A2C:
        """Return the model."""
        recipe = training.recipe
        return A2C(
            "MlpPolicy",
            environment,
            learning_rate=recipe.learning_rate.at,
            n_steps=recipe.n_steps,
            gamma=recipe.gamma,
            policy_kwargs={"net_arch": {"pi": [8], "vf": [8, 4]}, "activation_fn": torch.nn.ReLU},
            seed=recipe.seed,
            device="cpu",
        )


def test_algorithm__of_a_user_trains_resumes_to_the_bit_and_drives(tmp_path: Path) -> None:
    register_algorithm("a2c", A2cRecipe, A2c)
    try:
        content = TINY.model_dump(mode="json", include={*TrainingRecipe.model_fields})
        recipe = load_recipe({**content, "name": "mine", "algorithm": "a2c", "total_steps": 9 * 64})
        whole = train(recipe, "paper-random", tmp_path / "whole", on_progress=None)
        killed(train, recipe, "paper-random", tmp_path / "run", on_progress=dying_after(5))
        go_on(tmp_path / "run")
        assert kept(tmp_path / "run") == kept(tmp_path / "whole")
        assert load_policy(tmp_path / "run").manifest.algorithm == "a2c" and whole.updates == 9
    finally:
        del ALGORITHMS.loaded["a2c"]


def test_algorithm__that_normalises_by_itself_is_refused(tmp_path: Path) -> None:
    class Normalising(A2c):
        def build(self, training: Any, environment: Any) -> A2C:
            return super().build(training, VecNormalize(environment))

    register_algorithm("normalising", A2cRecipe, Normalising)
    try:
        recipe = TINY.model_dump(mode="json", include={*TrainingRecipe.model_fields}) | {"algorithm": "normalising"}
        with refused("algorithm 'normalising': its model uses VecNormalize"):
            train(recipe, "paper-random", tmp_path / "run")
        assert not (tmp_path / "run").exists()
    finally:
        del ALGORITHMS.loaded["normalising"]


@pytest.mark.parametrize("recipe", [TINY, TINY_SAC])
def test_policy__acts_as_the_model_does_without_exploration(recipe: TrainingRecipe, tmp_path: Path) -> None:
    models: list[Any] = []
    original = train_module.BetweenUpdates

    class Remembering(original):  # type: ignore[misc,valid-type]
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            models.append(self.model)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train_module, "BetweenUpdates", Remembering)
        result = train(recipe, "paper-random", tmp_path / "run", on_progress=None, measure=None)
    seen = game_of("paper-random")[1].start(50, 3, 0)
    observations = game_of("paper-random")[1].observe(seen, np.array([2]))[0]
    expected = models[0].predict(observations, deterministic=True)[0]
    np.testing.assert_allclose(result.last_policy(observations), expected, atol=1e-5)
    names = {name_in_sb3(name, result.policy.manifest.network) for name in result.policy.tensors}
    assert len(names) == len(result.policy.tensors) and names <= models[0].policy.state_dict().keys()


REFUSED: dict[str, Any] = {
    "scenario 'cooperation-3-pair' has no learner": ({}, []),
    "scheme single: scenario 'cooperation-3-pair' has 2 learners": ({"scheme": "single"}, None),
    "scheme independent: needs several learners": ({"scheme": "independent"}, ["vehicle_2"]),
    "turns = 5 for each of 2 learners needs at least 10 updates": (
        {"scheme": "independent", "turns": 5, "steps": 2 * UPDATE},
        None,
    ),
    "recipe 'ppo': seed = -1: must be": ({"seed": -1}, None),
}


@pytest.mark.parametrize("message", REFUSED)
def test_train__is_refused(message: str, tmp_path: Path) -> None:
    settings, learners = REFUSED[message]
    scenario = game_of("cooperation-3-pair")[0]
    scenario = scenario if learners is None else scenario.with_learners(learners)
    with refused(message):
        train(TINY, scenario, tmp_path / "run", **settings)
    assert not (tmp_path / "run").exists()


def test_train__several_learners_need_an_algorithm_that_supports_the_scheme(tmp_path: Path) -> None:
    with refused("the algorithm sac of recipe 'sac' does not support this scheme"):
        train(TINY_SAC, "cooperation-3-pair", tmp_path / "run", scheme="centralised")


def test_train__replaces_a_run_only_if_it_is_asked_to_and_nobody_trains_there(tmp_path: Path) -> None:
    run = tmp_path / "run"
    killed(begin, "ppo", run, on_progress=dying_after(5))
    with refused(f"{run}: this run already exists; choose another folder (--output), resume", AlreadyExists):
        begin("ppo", run)
    with RunFolder(run).held(), refused("another process is training in this folder"):
        begin("ppo", run, force=True)
    assert list((run / "checkpoints").glob("*.pt"))
    result = begin("ppo", run, force=True, measure=None)
    assert result.status == "finished" and not (run / "checkpoints").exists()
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis/chapter-1").touch()
    (tmp_path / "link").symlink_to(run)
    for name in ("thesis", "link"):
        with refused(f"{name}: ", AlreadyExists):
            begin("ppo", tmp_path / name, force=True)
    assert (tmp_path / "thesis/chapter-1").exists()


def changed(run: Path, file: str, **content: Any) -> None:
    """Change entries of a JSON file."""
    before = json.loads((run / file).read_text())
    (run / file).write_text(json.dumps({**before, **content}))


HOSTILE: dict[str, Any] = {
    ": is not the folder of a run; name the folder": lambda run: [path.unlink() for path in run.glob("*.json")],
    "run.json: status = 'done': must be": lambda run: changed(run, "run.json", status="done"),
    "run.json: format = None": lambda run: changed(run, "run.json", format=None),
    "run.json: is damaged: ": lambda run: (run / "run.json").write_text("{"),
    "config.json: is missing": lambda run: (run / "config.json").unlink(),
    "config.json: does not describe a training, because the key recipe": lambda run: changed(
        run, "config.json", recipe=1
    ),
    "config.json: scenario 'paper-random': horizon_s": lambda run: changed(
        run, "config.json", scenario={"name": "paper-random", "horizon_s": -1}
    ),
    "config.json: recipe: gamma: missing": lambda run: changed(
        run, "config.json", recipe={key: value for key, value in TINY.model_dump(mode="json").items() if key != "gamma"}
    ),
    "policy: must be a plain folder": lambda run: (run / "policy").write_text(""),
}


@pytest.mark.parametrize("message", HOSTILE)
def test_resume__a_hostile_folder_is_refused(message: str, tmp_path: Path) -> None:
    run = tmp_path / "run"
    killed(begin, "ppo", run, on_progress=dying_after(1))
    HOSTILE[message](run)
    with refused(message):
        go_on(run)


def test_resume__deletes_the_results_of_the_training_so_far_and_nothing_else(tmp_path: Path) -> None:
    run = tmp_path / "run"
    killed(begin, "ppo", run, on_progress=dying_after(5))
    for name in ("results.json", "mine.txt"):
        (run / name).write_text("x")
    changed(run, "run.json", written=["results.json", "config.json", "../precious.txt", "tensorboard", 3])
    (tmp_path / "precious.txt").write_text("x")
    go_on(run)
    assert not (run / "results.json").exists()
    assert all((run / name).exists() for name in ("mine.txt", "config.json", "tensorboard", "../precious.txt"))
