"""Train one policy: recipe and scenario in, a run's folder with a policy bundle out."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from stable_baselines3.common.vec_env import VecEnv

from ethbrake_marl.envs.sb3 import make_sb3_vec_env
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning.bundle import Policy, make_policy, save_policy
from ethbrake_marl.learning.callback import BetweenUpdates, Course, Evaluate, Progress, StopRequested
from ethbrake_marl.learning.divergence import TrainingDiverged, watch_gradients, weights_are_finite
from ethbrake_marl.learning.manifest import observation_schema
from ethbrake_marl.learning.progress_table import ProgressTable
from ethbrake_marl.learning.recipe import TrainingRecipe
from ethbrake_marl.learning.run_directory import RunDirectory, RunRecord, RunStatus, create_run
from ethbrake_marl.learning.sb3_policy import policy_arguments, tensors_of
from ethbrake_marl.learning.stop_signal import stop_on_signal
from ethbrake_marl.learning.versions import installed_versions
from ethbrake_marl.observations import ObservationSpec
from ethbrake_marl.scenario import Scenario

OBSERVATION = ObservationSpec()  # what a learner sees: itself, and one neighbour on each side


@dataclass(frozen=True, slots=True)
class TrainResult:
    """What a training left behind."""

    directory: Path
    policy: Policy  # also saved as directory/policy
    status: Literal["finished", "interrupted"]
    steps: int  # decisions of learners, a multiple of rows x n_steps
    updates: int
    wall_s: float
    evaluations: tuple[Mapping[str, float], ...]


def train(
    recipe: TrainingRecipe,
    scenario: Scenario,
    directory: str | Path,
    *,
    seed: int | None = None,
    steps: int | None = None,
    force: bool = False,
    evaluate: Evaluate | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> TrainResult:
    """Train on ``scenario`` (its roles say who learns; several learners share one policy) into the new ``directory``.

    ``seed`` and ``steps`` override the recipe. Training ends after the first update at or beyond ``steps``.
    ``evaluate(policy)`` is called before the first update, then as the recipe says, and at the end. The same recipe,
    scenario, seed and machine give the same policy, bit for bit; global random states are left as they were.

    Ctrl-C stops after the update in progress (status ``interrupted``); a second one raises ``KeyboardInterrupt``.
    Whatever ends it, ``policy/`` holds the last good policy. Raises ``AlreadyExists`` for an existing directory without
    ``force``, ``InvalidInput`` for a scenario without learners, ``TrainingDiverged`` for numbers that are not finite.
    """
    changes = {"seed": seed, "total_steps": steps}
    recipe = recipe.replace(**{name: value for name, value in changes.items() if value is not None})
    if not scenario.learners:
        raise InvalidInput(f"scenario {scenario.name!r}: no vehicle learns; give at least one the role learner")
    with _own_random_state(), stop_on_signal() as stop, _environment(recipe, scenario) as environment:
        model = _model(recipe, environment)
        run = create_run(Path(directory), force=force)
        record = RunRecord(run)
        run.write_json(run.config, _config(recipe, scenario))
        policy_now = _policy_maker(recipe, scenario)
        between = BetweenUpdates(recipe, run, policy_now, stop=stop, evaluate=evaluate, on_progress=on_progress)
        return _learn(model, between, run, record)


def _learn(model: PPO, between: BetweenUpdates, run: RunDirectory, record: RunRecord) -> TrainResult:
    """Train to the end, and leave the folder complete whatever that end is."""
    course = between.course
    logger = Logger(str(run.path), [ProgressTable(run.progress), TensorBoardOutputFormat(str(run.tensorboard))])
    model.set_logger(logger)
    status: Literal["finished", "interrupted"] = "finished"
    try:
        model.learn(between.total_steps, callback=between, log_interval=None)  # type: ignore[arg-type]
    except StopRequested:
        status = "interrupted"
    except BaseException as error:
        cause = _diverged(model, error)
        _close(record, run, course, "interrupted" if isinstance(error, KeyboardInterrupt) else "failed", cause)
        if cause is error:
            raise
        raise cause from error
    finally:
        logger.close()
    _close(record, run, course, status)
    assert course.policy is not None  # set before the first rollout
    evaluations = tuple(course.evaluations)
    return TrainResult(run.path, course.policy, status, course.steps, course.updates, course.wall_s, evaluations)


def _close(
    record: RunRecord, run: RunDirectory, course: Course, status: RunStatus, cause: BaseException | None = None
) -> None:
    """Save the last good policy, then say how the run ended."""
    if course.policy is not None:
        save_policy(course.policy, run.policy)
    reason = None if cause is None else f"{type(cause).__name__}: {cause}"
    record.end(status, reason, steps=course.steps, updates=course.updates, checkpoints=course.checkpoints)


def _diverged(model: PPO, error: BaseException) -> BaseException:
    """The error to report: torch's own when a distribution gets a NaN says little about a training."""
    if isinstance(error, ValueError) and not weights_are_finite(model):
        return TrainingDiverged(
            f"training: a weight or the exploration noise is not finite at step {model.num_timesteps};"
            " try a smaller learning_rate"
        )
    return error


def _model(recipe: TrainingRecipe, environment: VecEnv) -> PPO:
    network = recipe.network.spec(OBSERVATION.size)
    model = PPO(
        "MlpPolicy",
        environment,
        learning_rate=recipe.learning_rate.at,
        n_steps=recipe.n_steps,
        batch_size=recipe.batch_size,
        n_epochs=recipe.n_epochs,
        gamma=recipe.gamma,
        gae_lambda=recipe.gae_lambda,
        clip_range=recipe.clip_range,
        ent_coef=recipe.ent_coef,
        vf_coef=recipe.vf_coef,
        max_grad_norm=recipe.max_grad_norm,
        target_kl=recipe.target_kl,
        stats_window_size=max(100, environment.num_envs),
        policy_kwargs=policy_arguments(network, recipe.network.initial_log_std),
        seed=recipe.seed,
        device="cpu",
    )
    watch_gradients(model)
    return model


def _policy_maker(recipe: TrainingRecipe, scenario: Scenario) -> Callable[[PPO], Policy]:
    """How to make a policy of the model's present weights."""
    network = recipe.network.spec(OBSERVATION.size)
    fixed = {
        "algorithm": recipe.algorithm,
        "network": network,
        "observation": observation_schema(OBSERVATION),
        "learners": tuple(scenario.vehicle_names[vehicle] for vehicle in scenario.learners),
        "scenario": scenario.model_dump(mode="json"),
        "reward": recipe.reward.model_dump(mode="json"),
        "seeds": {"training": recipe.seed},
        "versions": installed_versions(),
    }
    return lambda model: make_policy(tensors_of(model.policy, network), steps=model.num_timesteps, **fixed)


def _config(recipe: TrainingRecipe, scenario: Scenario) -> dict[str, Any]:
    return {
        "recipe": recipe.model_dump(mode="json"),
        "scenario": scenario.model_dump(mode="json"),
        "seeds": {"training": recipe.seed, "evaluation": recipe.evaluation.seed},
        "versions": installed_versions(),
    }


@contextmanager
def _environment(recipe: TrainingRecipe, scenario: Scenario) -> Iterator[VecEnv]:
    environment = make_sb3_vec_env(scenario, recipe.n_envs, recipe.seed, reward=recipe.reward, observation=OBSERVATION)
    try:
        yield environment
    finally:
        environment.close()


@contextmanager
def _own_random_state() -> Iterator[None]:
    """Stable-Baselines3 seeds and uses the global generators: give them back as they were. One torch thread.

    A second thread makes a network this small 3 to 15 times slower as soon as another process wants a core.
    """
    states = random.getstate(), np.random.get_state(), torch.get_rng_state(), torch.get_num_threads()  # noqa: NPY002
    torch.set_num_threads(1)
    try:
        yield
    finally:
        random.setstate(states[0])
        np.random.set_state(states[1])  # noqa: NPY002
        torch.set_rng_state(states[2])
        torch.set_num_threads(states[3])
