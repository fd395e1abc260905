"""Train: recipe and scenario in, a run's folder with the policies out; or go on with a training that stopped."""

from __future__ import annotations

import copy
import csv
import hashlib
import io
import json
import math
import os
import random
import re
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import safetensors.numpy
import torch
from numpy.typing import NDArray
from pydantic import AfterValidator, ConfigDict, Field
from safetensors import SafetensorError
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger, filter_excluded_keys
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter
from typing_extensions import TypedDict

from ethbrake_marl.agents import Driver, LearnedAgent, Team
from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.engine import Arrays
from ethbrake_marl.envs import EthBrakeVecEnv, make_sb3_vec_env
from ethbrake_marl.errors import CorruptBundle, EthBrakeError, InvalidInput, OnProgress, Progress, Told, stop_on_signal
from ethbrake_marl.evaluation import evaluate, mean
from ethbrake_marl.files.arrays import ArrayHeader, ArrayRow, check_arrays, map_npy, safetensors_headers
from ethbrake_marl.files.store import (
    hold_lock,
    new_folder,
    open_plain,
    parse_strict_json,
    read_object,
    read_plain,
    remove_folder,
    remove_unfinished,
    write_file,
)
from ethbrake_marl.files.yaml import FileModel, read_json_model
from ethbrake_marl.harm import objective_harm
from ethbrake_marl.learning.algorithms import tensors_of
from ethbrake_marl.learning.training import Algorithm, RunDirectory, RunStatus, Scheme, Training, TrainingRecipe
from ethbrake_marl.policies import Policy, PolicyTeam, Sha256, Trained, installed_versions, read_trained
from ethbrake_marl.scenario import Appended, Scenario

Model = BaseAlgorithm  # of Stable-Baselines3
Evaluate = Callable[[Any], Mapping[str, float]]  # of what is trained: a ``Policy``, or a ``PolicyTeam``
StopAt = Callable[[Mapping[str, float]], str | None]  # of an evaluation, a reason to stop there, or None
Measure = Callable[[Training], Evaluate]


Ended = Literal["finished", "interrupted"]


class StopRequested(Exception):
    """Raised inside the training loop, with its reason, to leave it between two updates; never seen outside."""


class _Wishes(NamedTuple):
    """What is asked of a training beside its result."""

    measure: Measure | None
    stop_at: StopAt | None
    on_progress: OnProgress | None


@dataclass(frozen=True, slots=True)
class TrainResult:
    """What a training left behind.

    ``trained`` is of the moment of least harm on the fixed list, or of the end where nothing was measured.

    >>> import ethbrake_marl as eb
    >>> short = {"n_envs": 8, "n_steps": 16, "batch_size": 64, "n_epochs": 1}
    >>> recipe = eb.load_recipe("ppo").replace(**short, network={"policy": [8], "value": [8]})
    >>> result = eb.train(recipe, "paper-random", "runs/example", steps=128, measure=None)
    >>> result.status, result.steps, result.policy.manifest.algorithm
    ('finished', 128, 'ppo')

    """

    directory: Path  # the run's folder
    training: Training  # recipe, scenario and what they come to
    trained: Trained  # one policy for all learners, or one for each; also saved as directory/policy
    last: Trained  # of the end; also saved as directory/policy-last
    status: Ended  # finished or interrupted
    steps: int  # decisions of all learners, a multiple of rows x rounds
    updates: int  # rounds of collecting and learning
    wall_s: float  # s, of all stretches together
    evaluations: tuple[Mapping[str, float], ...]  # what was measured on the way, in order

    @property
    def policies(self) -> dict[str, Policy]:
        """Vehicle -> the policy that drives it."""
        return dict(self.trained.drivers)

    @property
    def policy(self) -> Policy:
        """The policy that drives all learners; raises ``InvalidInput`` where each has its own."""
        return _only(self.trained)

    @property
    def last_policy(self) -> Policy:
        """The same of the training's end."""
        return _only(self.last)


def _only(trained: Trained) -> Policy:
    if isinstance(trained, Policy):
        return trained
    raise InvalidInput(f"training: {', '.join(trained.drivers)} have a policy each; take one of policies")


def measure_on_list(training: Training) -> Evaluate:
    """What measures the learners' policies on the recipe's fixed list: the means that ``evaluate`` gives on it.

    These alone: no bound is proven and no best known harm is looked up, as nobody is shown them. Where a learner has
    another objective than total, also what each one's makes of the harm, and the mean of these.
    """
    recipe, scenario = training.recipe, training.scenario
    names = scenario.vehicle_names
    objectives = recipe.reward.settled(scenario.objective, scenario.vehicles)[1]
    worlds = scenario.sample(recipe.evaluation.worlds, recipe.evaluation.seed)

    def measure(trained: Trained) -> dict[str, float]:
        driver: Driver = (
            LearnedAgent(trained, "policy")
            if isinstance(trained, Policy)
            else Team({names.index(name): LearnedAgent(p, "policy") for name, p in trained.drivers.items()}, "policy")
        )
        outcome = evaluate(worlds, {"policy": driver}, scenario=scenario, aftermath=False).outcome("policy")
        metrics = {
            "first_impact_harm": mean(outcome.first_impact_harm).value,
            "total_harm": mean(outcome.total_harm).value,
            "collision_rate": float(outcome.collided.mean()),
            AT_HORIZON: float((~outcome.at_rest).mean()),
        }
        if objectives:
            harm = objective_harm(outcome.ledger, recipe.reward.harm_count, objectives)
            each = {names[i]: mean(harm[:, i]).value for i in scenario.learners}
            metrics[RunDirectory.OBJECTIVE] = sum(each.values()) / len(each)
            metrics |= {f"{RunDirectory.OBJECTIVE}_{name}": value for name, value in each.items()}
        return metrics

    return measure


def train(
    recipe: TrainingRecipe | str | Path,
    scenario: Scenario | str | Path,
    directory: str | Path,
    *,
    scheme: Scheme | None = None,
    turns: int | None = None,
    seed: int | None = None,
    steps: int | None = None,
    force: bool = False,
    settings: Sequence[str] = (),
    measure: Measure | None = measure_on_list,
    stop_at: StopAt | None = None,
    on_progress: Told = "show",
) -> TrainResult:
    """Train the learners of ``scenario`` into the new ``directory``.

    Ctrl-C stops after the update in progress (status ``interrupted``); a second one raises ``KeyboardInterrupt``.
    Whatever ends it but a kill, ``policy/`` holds the best policy so far and ``policy-last/`` the last good one;
    ``resume`` goes on. The same recipe, scenario, seed and machine give the same policy, bit for bit; global random
    states are left as they were.

    Args:
        recipe: a recipe, its name, or the path of its file.
        scenario: a scenario, its name, or the path of its file; its roles say who learns.
        directory: the run's folder.
        scheme: overrides the recipe's; without any, one learner is ``single`` and several are ``shared``.
        turns: overrides the recipe's, of independent learners (docs/training-schemes.md).
        seed: overrides the recipe's.
        steps: overrides the recipe's decisions of learners; training ends after the first update at or beyond them.
        force: replace an earlier run.
        settings: by which recipe and scenario differ from their files, ``KEY=VALUE`` each: noted in ``config.json``.
        measure: makes of the training what measures its policies before the first update, then as the recipe says, and
            at the end: by default on the recipe's fixed list. None: nothing is measured.
        stop_at: is given every evaluation, as it stands in ``TrainResult.evaluations``, and gives a reason to stop
            there, ``interrupted``, or None.
        on_progress: is told how far the training is; by default stderr shows it, None: nobody is told.

    Raises ``AlreadyExists`` for an existing directory without ``force``, ``InvalidInput`` where recipe and scenario do
    not fit each other, ``TrainingDiverged`` for numbers that are not finite.

    """
    changes = {"scheme": scheme, "turns": turns, "seed": seed, "total_steps": steps}
    training = Training.of(recipe, scenario, **{name: value for name, value in changes.items() if value is not None})
    run = RunDirectory(Path(directory))
    begin = partial(run.create, training.config(settings), team=training.team(), force=force)
    return _run(run, begin, training, _Wishes(measure, stop_at, Progress.listener(on_progress)))


def resume(
    directory: str | Path,
    *,
    measure: Measure | None = measure_on_list,
    stop_at: StopAt | None = None,
    on_progress: Told = "show",
    other_versions: bool = False,
) -> TrainResult:
    """Go on with a training that was stopped or killed, to the policies that it would have come to: the same bits.

    It goes on from the newest checkpoint that is whole, or from the beginning when there is none; rows and events after
    that checkpoint are dropped, so that nothing stands twice.

    Args:
        directory: the run's folder.
        measure: as it was given to ``train``.
        stop_at: as it was given to ``train``; it hears of new evaluations only.
        on_progress: is told how far the training is; by default stderr shows it, None: nobody is told.
        other_versions: go on from a checkpoint that other versions, or other plug-ins, wrote, although its numbers may
            differ.

    Raises ``InvalidInput`` for a folder without a training, one that has finished, one in which another process trains,
    one whose ``config.json`` was edited since the checkpoint, a checkpoint of other versions, and other plug-ins.

    """
    run = RunDirectory(Path(directory))
    config = run.read_config()
    if not other_versions:
        run.check_plugins(config, "or go on all the same with --other-versions")
    training = run.training(config)
    status = read_object(run.status)
    resumable = any(run.checkpoints.glob("step_*"))
    if status["status"] == "finished" or (status.get("stage") is not None and not resumable):  # its report may be open
        alone = len(training.drivers) == 1
        agents = f"{training.recipe.algorithm}@{directory}+episode" if alone else f"team@{directory}"
        raise InvalidInput(
            f"{directory}: this training has finished; measure what it has learned with: ethbrake evaluate --scenario"
            f" {training.scenario.name} --agents {agents}"
        )

    begin = partial(run.write_json, run.team, training.team())  # a damaged one would stay
    wishes = _Wishes(measure, stop_at, Progress.listener(on_progress))
    return _run(run, begin, training, wishes, partial(_newest, run, training.identity, other_versions))


def _run(
    run: RunDirectory,
    begin: Callable[[], object],
    training: Training,
    wishes: _Wishes,
    find: Callable[[], tuple[TrainingState | None, list[str]]] = lambda: (None, []),
) -> TrainResult:
    """Train in the folder that ``begin`` makes or mends, once nothing can be wrong with environment and model.

    ``find`` gives the checkpoint to go on from, if there is one, and why newer ones are not whole.
    """
    evaluate = None if wishes.measure is None else wishes.measure(training)
    algorithm = training.recipe.make_algorithm()
    with own_random_state(), stop_on_signal() as stop, closing(make_environment(training)) as environment:
        model = make_model(algorithm, training, environment)
        begin()
        with hold_lock(run.lock, "another process is training here"):
            state, damaged = find()
            session = Session(run, training, algorithm, model, wishes, evaluate, stop)
            if state is not None:
                check_fits(run.checkpoints, state, model, algorithm, trained_policies(training, algorithm, model))
            if state is None and training.begins is not None:
                session.notes.append(f"begins with {training.begins}")
            session.notes += [f"a damaged checkpoint was left aside: {reason}" for reason in damaged]
            status = session.learn(state)
    course = session.course
    assert course.policy is not None and course.kept is not None  # set before the first rollout
    return TrainResult(
        run.path, training, course.kept, course.policy, status, course.steps, course.updates, course.wall_s,
        tuple(course.evaluations),
    )  # fmt: skip


def _newest(run: RunDirectory, training: str, other_versions: bool) -> tuple[TrainingState | None, list[str]]:
    """The newest whole checkpoint, if there is one, and what was wrong with newer ones."""
    remove_unfinished(run.path)
    if run.checkpoints.is_dir():
        remove_unfinished(run.checkpoints)
    state, damaged = newest_usable(run.checkpoints)
    if state is None:
        return None, damaged
    if state.numbers["training"] != training:
        name = run.checkpoint(state.steps).name
        raise InvalidInput(
            f"{run.config}: was changed after the checkpoint {name} of this training; put it back as it was, or"
            " train again in another folder"
        )
    now, then = installed_versions(), state.versions
    other = sorted(name for name in now.keys() | then.keys() if now.get(name) != then.get(name))
    if other and not other_versions:
        name = other[0]
        raise InvalidInput(
            f"{run.path}: was trained with {name} {then.get(name)}, here is {now.get(name)}: the numbers would"
            " differ; install that version, or go on all the same with --other-versions"
        )
    return state, damaged


class Session(BaseCallback):
    """One stretch of a training in one process: from a fresh model or a checkpoint, to the end or the next stop.

    It keeps the run's folder complete. What is due stands in ``_after_update``, before the first rollout and after each
    update. ``stop`` is asked before every rollout; ``StopRequested`` is raised when it says yes, with everything saved.
    The same where ``stop_at`` gave a reason at the evaluation just before.
    """

    model: Model

    def __init__(
        self, run: RunDirectory, training: Training, algorithm: Algorithm, model: Model, wishes: _Wishes,
        evaluate: Evaluate | None, stop: Callable[[], bool],
    ) -> None:  # fmt: skip
        super().__init__()
        self.run, self.training, self.algorithm, self.model = run, training, algorithm, model
        self.recipe, self._wishes, self._evaluate, self._stop = training.recipe, wishes, evaluate, stop
        self._table = ProgressTable(run.progress)
        self._reason: str | None = None  # to stop at the next rest
        self.updates = 0
        self.course = Course(self.recipe.reward.harm_count)
        self.notes: list[str] = []  # to be told when the training begins
        self._objective = objective_in_words(training)
        self._ended: dict[str, list[float]] = {column: [] for column in EPISODE_COLUMNS}
        self._resumed = False  # what is due at this rest was done before the checkpoint was written

    def learn(self, state: TrainingState | None) -> Ended:
        """Train from ``state`` (None: from the beginning) to the end, and leave the folder complete whatever it is."""
        model = self.model
        self.run.write_status("running", start=self.training.begins)
        if state is None:
            self.run.progress.unlink(missing_ok=True)
        else:
            self._table.restore(state.table)
        cut_back(self.run.tensorboard, {} if state is None else state.numbers["events"])
        logger = Logger(str(self.run.path), [self._table, EventFile(self.run.tensorboard)])
        model.set_logger(logger)
        if state is not None:
            restore_model(model, self.algorithm, state)
            between = state.numbers["between"]
            self.updates = self.course.updates = int(between["updates"])
            self._ended = {column: list(between["ended"][column]) for column in EPISODE_COLUMNS}
            self.course.restore(between["course"])
            self.course.steps, self.course.policy, self.course.best = state.steps, state.policy, state.best
        self._resumed = state is not None
        status: Ended = "finished"
        reason: str | None = None
        try:
            steps = self.recipe.total_steps - model.num_timesteps
            model.learn(steps, callback=self, log_interval=None, reset_num_timesteps=state is None)  # type: ignore[arg-type]
        except StopRequested as stop:
            status, reason = "interrupted", stop.args[0]
        except BaseException as error:
            cause = error  # torch's own when a distribution gets a NaN says little about a training
            if isinstance(error, ValueError) and not weights_are_finite(model, self.algorithm):
                cause = TrainingDiverged(
                    f"training: a weight or the exploration noise is not finite at step {model.num_timesteps};"
                    " try a smaller learning_rate"
                )
            ended: RunStatus = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
            self._close(ended, f"{type(cause).__name__}: {cause}")
            if cause is error:
                raise
            raise cause from error
        finally:
            logger.close()
        self._close(status, reason)
        return status

    def _on_rollout_start(self) -> None:
        while self.notes:
            self.tell(self.notes.pop(0))
        if not self._resumed:
            self._after_update()
        self._resumed = False
        if self._stop() or self._reason is not None:
            self._rest()
            self._save()
            raise StopRequested(self._reason)

    def _on_step(self) -> bool:
        infos = self.locals["infos"]
        for name, entries in (("observations", self.locals["new_obs"]), ("rewards", self.locals["rewards"])):
            good = np.isfinite(entries)
            if not good.all():
                row = np.argwhere(~good)[0][0]
                raise TrainingDiverged(
                    f"training: {name}[row {row}] = {entries[~good][0]} at step {self.model.num_timesteps}: must be"
                    " finite; the environment or its reward is at fault"
                )
        for row in np.flatnonzero(self.locals["dones"]):
            for column, name in EPISODE_COLUMNS.items():
                self._ended[column].append(float(infos[row][name]))
        return True

    def _on_rollout_end(self) -> None:
        self.updates += 1

    def _on_training_end(self) -> None:
        self._after_update(last=True)

    def _after_update(self, *, last: bool = False) -> None:
        """Do what is due at this rest, the checkpoint after all the rest of it."""
        logged = self.logger.name_to_value  # train/loss, or vehicle_2/loss where learners are independent
        for name in (name for loss in _LOSSES for name in logged if name.rpartition("/")[2] == loss):
            if not np.isfinite(logged[name]):  # it may well leave finite weights
                raise TrainingDiverged(
                    f"training: {name} = {float(logged[name])} after step {self.model.num_timesteps}: must be finite;"
                    " try a smaller learning_rate, or smaller weights of the reward"
                )
        updates, recipe = self.updates, self.recipe
        measure = self._evaluate is not None and (last or updates % recipe.evaluation.every_updates == 0)
        if last or measure or updates % getattr(recipe, "log_every_updates", 1) == 0:
            self._rest()
            if measure:
                self._measure()
            if any(self._ended.values()):
                for column, values in self._ended.items():
                    self.logger.record(column, float(np.mean(values)))
            self._ended = {column: [] for column in EPISODE_COLUMNS}
            if updates and isinstance(self.model, OnPolicyAlgorithm):
                self.model.dump_logs(updates)
            elif updates and isinstance(self.model, OffPolicyAlgorithm):
                self.model.dump_logs()
            elif updates or self.course.evaluations:
                self.logger.dump(step=self.model.num_timesteps)
            self.tell()
        if not last and updates and updates % recipe.checkpoint_every_updates == 0:
            self._rest()
            self._save()

    def _rest(self) -> None:
        """Bring the course to this moment."""
        course = self.course
        if course.policy is None or (course.steps, course.updates) != (self.model.num_timesteps, self.updates):
            if not weights_are_finite(self.model, self.algorithm):
                raise TrainingDiverged(f"training: a weight is not finite after step {self.model.num_timesteps}")
            course.policy = trained_policies(self.training, self.algorithm, self.model)
            course.steps, course.updates = self.model.num_timesteps, self.updates

    def _measure(self) -> None:
        assert self.course.policy is not None and self._evaluate is not None
        begun = time.process_time()
        metrics = {name: float(value) for name, value in self._evaluate(self.course.policy).items()}
        self.course.cpu_started += time.process_time() - begun
        self.course.add_evaluation(self.course.policy, metrics, self._recent_return())
        for name, value in metrics.items():
            self.logger.record(f"eval/{name}", value)
        if self._wishes.stop_at is not None:
            self._reason = self._wishes.stop_at(self.course.evaluations[-1])

    def _recent_return(self) -> float | None:
        episodes = self.model.ep_info_buffer or ()
        return sum(float(e["r"]) for e in episodes) / len(episodes) if episodes else None

    def tell(self, note: str = "") -> None:
        """Report how far the training is."""
        if self._wishes.on_progress is None:
            return
        course = self.course
        metrics = dict(course.evaluations[-1]) if course.evaluations else {}
        if metrics and self.recipe.reward.harm_count == "total":  # what is trained for stands first
            metrics = {"total_harm": metrics["total_harm"], **metrics}
        recent = self._recent_return()
        if recent is not None:
            metrics[RETURN] = recent
        rollout = self.model.n_envs * self.recipe.rounds
        planned = -(-self.recipe.total_steps // rollout) * rollout  # whole rollouts
        self._wishes.on_progress(
            Progress("training", course.steps, planned, metrics, note, course.updates, course.wall_s, self._objective)
        )

    def _save(self) -> None:
        """Write a checkpoint of this moment, unless there is one, and delete those that are old."""
        course, folder = self.course, self.run.checkpoint(self.course.steps)
        if folder.exists():
            return
        assert course.policy is not None
        arrays, numbers, replay = capture_model(self.model, self.algorithm)
        numbers |= {
            "training": self.training.identity,
            "between": {"updates": self.updates, "ended": self._ended, "course": course.to_json()},
            "events": event_sizes(self.run.tensorboard),
        }
        state = TrainingState(
            course.steps, course.updates, numbers, arrays, replay, course.policy, course.best, self._table.content(),
            installed_versions(),
        )  # fmt: skip
        write_checkpoint(folder, state)

    def _close(self, status: RunStatus, reason: str | None) -> None:
        """Save the best and the last good policy, say how the run ended; a finished one needs no checkpoint."""
        course, run = self.course, self.run
        for policy, folder in ((course.kept, run.policy), (course.policy, run.last_policy)):
            if policy is not None:
                policy.save(folder, replace=True)
        left_over = () if status == "finished" else run.checkpoints.glob("step_*")
        told = {
            "start": self.training.begins,
            "reason": reason,
            "wall_s": round(course.wall_s, 3),
            "cpu_s": {str(steps): round(spent, 3) for steps, spent in course.cpu_s.items()},
            "steps": course.steps,
            "updates": course.updates,
            "policy_steps": None if course.kept is None else course.kept.steps,
            "policy": run.policy.name if run.policy.is_dir() else None,
            "checkpoints": sorted(path.name for path in left_over),
        }
        run.write_status(status, **told)
        if status == "finished" and run.checkpoints.is_dir():
            remove_folder(run.checkpoints)


# From a training to its environment, its model, and from a model's present weights to policies.


def make_environment(training: Training) -> EthBrakeVecEnv:
    """The worlds of a training, in which its learners are the rows."""
    recipe = training.recipe
    appended: dict[Scheme, Appended] = {"independent": "number", "centralised": "state"}
    return make_sb3_vec_env(
        training.scenario,
        recipe.n_envs,
        recipe.seed,
        reward=recipe.reward,
        observation=training.observation,
        horizon_is_end=recipe.horizon_is_end,
        appended=appended.get(training.scheme),
    )


def make_model(algorithm: Algorithm, training: Training, environment: EthBrakeVecEnv) -> Model:
    """The model of a training, whose optimisers refuse gradients that are not finite."""
    model = algorithm.build(training, environment)
    if getattr(model, "get_vec_normalize_env", lambda: None)() is not None:
        raise InvalidInput(
            f"algorithm {training.recipe.algorithm!r}: its model is trained under VecNormalize, whose statistics are no"
            " part of a policy bundle; observations here are scaled already"
        )
    hint = "learning_rate or max_grad_norm" if hasattr(model, "max_grad_norm") else "learning_rate"

    def check(optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
        sums = [p.grad.sum() for group in optimizer.param_groups for p in group["params"] if p.grad is not None]
        if not torch.isfinite(torch.stack(sums)).all():
            raise TrainingDiverged(
                f"training: the gradient of the loss is not finite at step {model.num_timesteps}; try a smaller {hint}"
            )

    for optimizer in algorithm.optimizers(model).values():
        optimizer.register_step_pre_hook(check)
    return model


def trained_policies(training: Training, algorithm: Algorithm, model: Model) -> Trained:
    """Policies of a model's present weights: one for all learners, or one for each."""
    recipe, scenario = training.recipe, training.scenario
    names, actors = tuple(training.drivers), algorithm.actors(model)
    apart = training.scheme == "independent"
    policies = []
    for learners, actor in zip([(name,) for name in names] if apart else [names], actors, strict=True):
        observation = training.observations[learners[0]]
        network = recipe.network_spec(observation.size)
        if training.scheme == "centralised":
            network = network.model_copy(update={"value_hidden": ()})  # its critic sees what no vehicle sees
        policy = Policy.make(
            tensors_of(actor, network),
            algorithm=recipe.algorithm,
            network=network,
            observation=observation,
            learners=learners,
            scenario=scenario.model_dump(mode="json"),
            reward=recipe.reward.model_dump(mode="json"),
            seeds={"training": recipe.seed, "evaluation": recipe.evaluation.seed},
            steps=model.num_timesteps,
        )
        policies.append(policy)
    return PolicyTeam(dict(zip(names, policies, strict=True))) if apart else policies[0]


# The progress of a training: its policies and its evaluations.

# Column of the log -> info of an episode's end; means over the episodes since the last row, exploration included.
EPISODE_COLUMNS = {
    "rollout/first_impact_harm": "world_first_impact_harm",
    "rollout/total_harm": "world_total_harm",
    "rollout/collision_rate": "collided",
}
RETURN = "episode_return"
AT_HORIZON = "horizon_rate"  # share of the fixed list's episodes in which something still moves at the horizon


@dataclass
class Course:
    """The last good policy, the best one, and the evaluations on the way.

    The best is that of least harm on the fixed list, by the learners' objectives and in the ``harm_count`` of the
    reward, not that of highest return; where no harm is measured there is none.
    """

    harm_count: HarmCount = "first"
    policy: Trained | None = None  # none until the first weights were checked
    best: Trained | None = None
    best_harm: float = math.inf
    steps: int = 0
    updates: int = 0
    evaluations: list[dict[str, float]] = field(default_factory=list)  # steps, updates and what ``evaluate`` gave
    wall_before_s: float = 0.0  # of the parts of this training that other processes did
    started: float = field(default_factory=time.monotonic)
    cpu_s: dict[int, float] = field(default_factory=dict)  # steps of an evaluation -> processor seconds of learning
    cpu_started: float = field(default_factory=time.process_time)

    @property
    def wall_s(self) -> float:
        """Seconds of training, the time between a kill and the resume left out."""
        return self.wall_before_s + time.monotonic() - self.started

    @property
    def kept(self) -> Trained | None:
        """The policy to use: the best, or the last where nothing was measured."""
        return self.best or self.policy

    def add_evaluation(self, policy: Trained, metrics: Mapping[str, float], episode_return: float | None) -> None:
        """Take in an evaluation of ``policy``."""
        extra = {} if episode_return is None else {RETURN: episode_return}
        self.evaluations.append({"steps": self.steps, "updates": self.updates, **metrics, **extra})
        self.cpu_s[self.steps] = time.process_time() - self.cpu_started
        name = RunDirectory.chosen_by(self.evaluations, self.harm_count)
        if name in metrics and metrics[name] < self.best_harm:
            self.best, self.best_harm = policy, metrics[name]

    def to_json(self) -> dict[str, Any]:
        """Everything but the policies."""
        return {
            "evaluations": self.evaluations,
            "best_harm": None if math.isinf(self.best_harm) else self.best_harm,
            "wall_s": self.wall_s,
            "cpu_s": [[steps, spent] for steps, spent in self.cpu_s.items()],
            "cpu_spent_s": time.process_time() - self.cpu_started,
        }

    def restore(self, content: Mapping[str, Any]) -> None:
        """Take back what ``to_json`` gave."""
        self.evaluations = [dict(entry) for entry in content["evaluations"]]
        self.best_harm = math.inf if content["best_harm"] is None else float(content["best_harm"])
        self.wall_before_s = float(content["wall_s"])
        self.cpu_s = {int(steps): float(spent) for steps, spent in content.get("cpu_s", [])}
        self.cpu_started = time.process_time() - float(content.get("cpu_spent_s", 0.0))


def objective_in_words(training: Training) -> str:
    """What the mean over the learners of their objectives is, where one is another than total; else empty.

    Only what some vehicles bear is called harm: a weighted sum of it is an objective.
    """
    scenario, learners = training.scenario, training.scenario.learners
    reward, objectives = training.recipe.reward.settled(scenario.objective, scenario.vehicles)
    declared = reward.objective
    if declared is None:
        return ""
    names = [declared] if isinstance(declared, str) else dict.fromkeys(declared[i] for i in learners)
    kinds, first = {objectives[i].kind for i in learners}, reward.harm_count == "first"
    if not kinds <= {"total", "own", "maximin"} and kinds != {"injury"}:
        return f"objective by {'first' if first else 'all'} impacts ({', '.join(names)})"
    what = "injuries in 1,000 lines" if kinds == {"injury"} else "harm"
    return f"{'first-impact' if first else 'total'} {what} ({', '.join(names)})"


_LOSSES = ("loss", "policy_loss", "value_loss", "policy_gradient_loss", "actor_loss", "critic_loss", "ent_coef_loss")


class TrainingDiverged(EthBrakeError, ArithmeticError):
    """A reward, a loss or a weight is no longer a finite number; the last good policy was kept."""


def weights_are_finite(model: Model, algorithm: Algorithm) -> bool:
    """Whether every weight is finite, and the exploration noise a usable one."""
    logarithm = algorithm.log_noise(model)
    noise = torch.ones(1) if logarithm is None else torch.exp(logarithm)
    usable = torch.isfinite(noise) & (noise > 0.0)
    return bool(usable.all()) and all(bool(torch.isfinite(p).all()) for p in model.policy.parameters())


# The logs of a run while it learns: ``progress.csv`` and TensorBoard's event files.
#
# ``progress.csv`` has one row per update, its columns in an order that is the same in every run.


class ProgressTable(KVWriter):
    """Writer for Stable-Baselines3's logger; its own CSV writer orders columns by the hash of their names."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._rows: list[dict[str, Any]] = []
        self._columns: list[str] = []

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Add a row; when a column is new the table is written again, in one step, with that column."""
        values = {"steps": step} | filter_excluded_keys(key_values, key_excluded, "csv")
        row = {name: value.item() if isinstance(value, np.generic) else value for name, value in values.items()}
        self._rows.append(row)
        if row.keys() <= set(self._columns):
            with self._path.open("a", newline="", encoding="utf-8") as file:
                file.write(_lines([row], self._columns))
            return
        self._columns = ["steps", *sorted({name for row in self._rows for name in row} - {"steps"})]
        heading = _lines([dict(zip(self._columns, self._columns, strict=True))], self._columns)
        write_file(self._path, (heading + _lines(self._rows, self._columns)).encode())

    def latest(self, name: str, rows: int) -> list[float]:
        """A column in the last rows, where there is a value."""
        return [float(row[name]) for row in self._rows[-rows:] if name in row]

    def content(self) -> bytes:
        """The file as it is; empty before the first row."""
        return self._path.read_bytes() if self._rows else b""

    def restore(self, content: bytes) -> None:
        """Go back to an earlier ``content``, in the file too."""
        self._columns, self._rows = parse_progress(content)
        write_file(self._path, content)

    def close(self) -> None:
        """Nothing is held open between rows."""


def parse_progress(content: bytes) -> tuple[list[str], list[dict[str, Any]]]:
    """Columns and rows of a progress table, whose first column is ``steps``; what is empty is not there.

    Raises ``ValueError`` for anything that no ``ProgressTable`` has written.
    """
    try:
        lines = list(csv.reader(io.StringIO(content.decode("utf-8"), newline=""), strict=True))
    except csv.Error as error:
        raise ValueError(f"the progress table is no CSV ({error})") from None
    columns, rows = (lines[0], lines[1:]) if lines else ([], [])
    if columns and (columns[0] != "steps" or len(set(columns)) < len(columns)):
        raise ValueError("the progress table must have the column steps first, and no column twice")
    for number, row in enumerate(rows, start=1):
        if len(row) != len(columns) or not row[0].isdecimal():
            raise ValueError(f"row {number} of the progress table must have {len(columns)} values, the first one steps")
    return columns, [{n: value for n, value in zip(columns, row, strict=True) if value != ""} for row in rows]


def _lines(rows: list[dict[str, Any]], columns: list[str]) -> str:
    text = io.StringIO()
    csv.DictWriter(text, columns, restval="", lineterminator="\n").writerows(rows)
    return text.getvalue()


_PREFIX = "events.out.tfevents."


class EventFile(KVWriter):
    """Writer for Stable-Baselines3's logger: a new file of numbers, which TensorBoard reads after all that are there.

    Its name ends in a number of ten digits, one more than the largest in the folder (files of TensorBoard's own writer
    carry their second in that place); the first is 1. Every row is in the file when ``write`` returns.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        found = (re.match(rf"{re.escape(_PREFIX)}(\d{{10}})", path.name) for path in folder.iterdir())
        number = max((int(match[1]) for match in found if match), default=0) + 1
        self._file = (folder / f"{_PREFIX}{number:010d}").open("xb")
        self._records = RecordWriter(self._file)
        self._add(Event(wall_time=time.time(), file_version="brain.Event:2"))

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Add one row of numbers."""
        row = filter_excluded_keys(key_values, key_excluded, "tensorboard")
        values = [Summary.Value(tag=name, simple_value=float(row[name])) for name in sorted(row)]
        self._add(Event(wall_time=time.time(), step=step, summary=Summary(value=values)))

    def close(self) -> None:
        self._file.close()

    def _add(self, event: Any) -> None:
        self._records.write(event.SerializeToString())
        self._file.flush()


def event_sizes(folder: Path) -> dict[str, int]:
    """Name -> bytes of the event files."""
    return {path.name: path.stat().st_size for path in sorted(folder.iterdir())} if folder.is_dir() else {}


def cut_back(folder: Path, sizes: Mapping[str, int]) -> None:
    """Drop what was written after ``event_sizes`` gave ``sizes``: later records, and later files.

    Only plain files are cut; links and pipes in their place go, folders stay.
    """
    if not folder.is_dir():
        return
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            continue  # nothing that a training wrote
        if path.name not in sizes or path.is_symlink() or not path.is_file():
            path.unlink()  # of a link the link alone
        elif path.stat().st_size > sizes[path.name]:
            os.truncate(path, sizes[path.name])


# A training at rest between two updates, as a folder of plain files: whole or not there, and checked when read.
#
# ``checkpoint.json`` lists every other file with its size and SHA-256; numbers are JSON, safetensors and ``.npy``
# without objects, so reading one runs no code from it.

# The schema of a checkpoint's JSON files: their keys, types and bounds.

Count = Annotated[int, Field(ge=0, lt=2**63)]
Number = Annotated[int | float, Field(ge=-1e300, le=1e300)]


class _ListedFile(FileModel):
    bytes: Count
    sha256: Sha256


class Listing(FileModel):
    """``checkpoint.json``: every other file of the checkpoint, and from where and when it is."""

    format: Literal["ethbrake-checkpoint"]
    format_version: Literal[1]
    steps: Count
    updates: Count
    versions: dict[str, str]
    files: dict[str, _ListedFile]


# The names of Stable-Baselines3's own counters, which begin with an underscore.
_COUNTERS: dict[str, Any] = {
    "num_timesteps": Count,
    "_n_updates": Count,
    "_episode_num": Count,
    "_current_progress_remaining": Number,
    "_total_timesteps": Count,
}
_Counters = TypedDict("_Counters", _COUNTERS)  # type: ignore[misc]  # mypy wants the keys written out here
_Counters.__pydantic_config__ = ConfigDict(strict=True, extra="forbid")  # type: ignore[attr-defined]


class _Words(FileModel):
    state: Annotated[int, Field(ge=0, lt=2**128)]
    inc: Annotated[int, Field(ge=0, lt=2**128)]


class _ActionGenerator(FileModel):
    bit_generator: Literal["PCG64"]
    state: _Words
    has_uint32: Literal[0, 1]
    uinteger: Annotated[int, Field(ge=0, lt=2**32)]


class _Generators(FileModel):
    numpy: tuple[Annotated[int, Field(ge=0, le=624)], Literal[0, 1], Number]
    python: tuple[Literal[3], Number | None]
    actions: _ActionGenerator


class _Replay(FileModel):
    pos: Count | None = None
    full: bool | None = None


def _check_place(evaluation: dict[str, Number]) -> dict[str, Number]:
    for key in ("steps", "updates"):
        if not isinstance(evaluation.get(key), int):
            raise ValueError(f"{key} is missing or no whole number")
    return evaluation


class _Course(FileModel):
    evaluations: list[Annotated[dict[str, Number], AfterValidator(_check_place)]]
    best_harm: Number | None
    wall_s: Annotated[float, Field(strict=False, ge=0.0, allow_inf_nan=False)]
    cpu_s: list[Annotated[list[Number], Field(min_length=2, max_length=2)]] = Field(default=[])
    cpu_spent_s: Number = 0.0  # earlier checkpoints say nothing of it


def _every_column(ended: dict[str, list[Number]]) -> dict[str, list[Number]]:
    if ended.keys() != EPISODE_COLUMNS.keys():
        raise ValueError(f"the columns must be {', '.join(EPISODE_COLUMNS)}")
    return ended


class _Between(FileModel):
    updates: Count
    ended: Annotated[dict[str, list[Number]], AfterValidator(_every_column)]
    course: _Course


class Numbers(FileModel):
    """``state.json``: what ``capture_model`` and the session keep of a training."""

    training: Sha256  # which one, see ``Training.identity``
    counters: _Counters
    learning_rates: dict[str, Annotated[float, Field(strict=False, ge=0.0, le=1.0)]]
    random: _Generators
    log: dict[str, tuple[Number, Count, list[str]]]
    between: _Between
    replay: _Replay
    events: dict[str, Count]


FORMAT_VERSION = 1
LISTING = "checkpoint.json"
KEPT = 2  # checkpoints of a running training; a torn last one leaves the one before

_NUMBERS, _ARRAYS, _TABLE, _POLICY, _BEST, _MEMORY = (
    "state.json",
    "arrays.safetensors",
    "progress.csv",
    "policy",
    "best",
    "replay",
)
_HELD_LIMITS_BYTES = {_NUMBERS: 256 << 20, _ARRAYS: 1 << 30, _TABLE: 256 << 20}  # of what is read as a whole
_SIZE_LIMIT_BYTES = 1 << 36  # of any other file: a replay memory of ten million decisions
_DTYPES = {"BOOL", "F32", "F64", "I32", "I64", "U8", "U32", "U64"}


@dataclass(frozen=True, slots=True)
class TrainingState:
    """What a training needs to go on."""

    steps: int
    updates: int
    numbers: dict[str, Any]  # plain JSON
    arrays: Arrays
    replay: Arrays  # memory-mapped when read
    policy: Trained  # as it was checked last
    best: Trained | None  # of least harm so far
    table: bytes  # progress.csv
    versions: Mapping[str, str]


def write_checkpoint(folder: Path, state: TrainingState) -> None:
    """Write ``folder``, completely or not at all, with every byte on the disk before it has its name; old ones go."""
    with new_folder(folder) as partial:
        write_file(partial / _NUMBERS, json.dumps(state.numbers, allow_nan=False).encode())
        arrays = {name: np.ascontiguousarray(array).reshape(array.shape) for name, array in state.arrays.items()}
        write_file(partial / _ARRAYS, safetensors.numpy.save(arrays))
        write_file(partial / _TABLE, state.table)
        state.policy.save(partial / _POLICY)
        if state.best is not None:
            state.best.save(partial / _BEST)
        for name, array in state.replay.items():
            with (partial / f"{_MEMORY}-{name}.npy").open("wb") as file:
                np.lib.format.write_array(file, np.asarray(array), allow_pickle=False)
                file.flush()
                os.fsync(file.fileno())
        files: dict[str, Any] = {}
        for path in sorted(path for path in partial.rglob("*") if path.is_file()):
            with path.open("rb") as file:
                sha256 = hashlib.file_digest(file, "sha256").hexdigest()
            files[path.relative_to(partial).as_posix()] = {"bytes": path.stat().st_size, "sha256": sha256}
        listing = {
            "format": "ethbrake-checkpoint",
            "format_version": FORMAT_VERSION,
            "steps": state.steps,
            "updates": state.updates,
            "versions": dict(state.versions),
            "files": files,
        }
        write_file(partial / LISTING, json.dumps(listing, indent=2).encode() + b"\n")
    for old in checkpoint_folders(folder.parent)[KEPT:]:
        remove_folder(old)


def read_checkpoint(folder: Path) -> TrainingState:
    """Read and check every file of ``folder``; raises ``CorruptBundle`` naming the file that is damaged.

    Raises ``InvalidInput`` where all files are as they were written, and one is not as this version writes it.
    """
    listing, data = _check_files(folder)
    place = folder / _NUMBERS
    try:
        numbers, _ = read_json_model(data[_NUMBERS], Numbers)
        place = folder / _ARRAYS
        for name, header in safetensors_headers(data[_ARRAYS]).items():
            if header.dtype not in _DTYPES:
                raise ValueError(f"array {name!r} is {header.dtype}; must be one of {', '.join(sorted(_DTYPES))}")
        arrays = dict(safetensors.numpy.load(data[_ARRAYS]))
        replay = {}
        for place in sorted(folder.glob(f"{_MEMORY}-*.npy")):
            with open_plain(place, _SIZE_LIMIT_BYTES, refusal=CorruptBundle, follow_links=False) as stream:
                replay[place.stem.removeprefix(f"{_MEMORY}-")] = map_npy(stream, place.stem)
        place = folder / _TABLE
        parse_progress(data[_TABLE])
        place = folder / _POLICY
        policy = read_trained(place)
        place = folder / _BEST
        best = read_trained(place) if place.is_dir() else None
    except KeyError:
        raise CorruptBundle(f"{place}: is missing") from None
    except (ValueError, EthBrakeError, SafetensorError) as error:
        raise _of_another_version(f"{place}: {error}", listing.versions) from None
    return TrainingState(
        listing.steps, listing.updates, numbers, arrays, replay, policy, best, data[_TABLE], listing.versions
    )


def _of_another_version(what: str, versions: Mapping[str, Any]) -> InvalidInput:
    """The error for a checkpoint that is not damaged: nobody deletes it."""
    wrote, here = versions.get("ethbrake-marl"), installed_versions()["ethbrake-marl"]
    return InvalidInput(
        f"{what}; every file of this checkpoint is as version {wrote} of this package wrote it, and version {here}"
        " would write another one: go on with that version, or delete the checkpoint to go on from the one before"
    )


def checkpoint_folders(folder: Path) -> list[Path]:
    """Checkpoints in ``folder``, the newest first; whether they are whole is not known yet."""
    return sorted((path for path in folder.glob("step_*") if _is_folder(path)), reverse=True)


def newest_usable(folder: Path) -> tuple[TrainingState | None, list[str]]:
    """The newest checkpoint in ``folder`` that is whole, and why each newer one is not; damaged ones are deleted.

    Raises ``InvalidInput`` at one of another version, which stays.
    """
    reasons: list[str] = []
    for path in checkpoint_folders(folder):
        try:
            return read_checkpoint(path), reasons
        except CorruptBundle as error:
            reasons.append(str(error))
            remove_folder(path)
    return None, reasons


def _check_files(folder: Path) -> tuple[Listing, dict[str, bytes]]:
    """The listing, and the content of the files beside it; every file is there, and is what the listing says."""
    path, read = folder / LISTING, partial(read_plain, refusal=CorruptBundle, follow_links=False)
    try:
        data = read(path, 1 << 20)
        content = parse_strict_json(data)
        version = content.get("format_version") if isinstance(content, dict) else None
        if type(version) is int and version != FORMAT_VERSION:
            versions = content.get("versions")
            what = f"{path}: format_version = {version}: must be {FORMAT_VERSION}"
            raise _of_another_version(what, versions if isinstance(versions, dict) else {})
        _, listing = read_json_model(data, Listing)
        found = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if not _is_folder(path)}
    except OSError as error:
        raise CorruptBundle(f"{folder}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        if isinstance(error, EthBrakeError):
            raise
        raise CorruptBundle(f"{path}: is damaged ({error})") from None
    files = listing.files
    if found.keys() != files.keys() | {LISTING}:
        different = sorted(found.keys() ^ (files.keys() | {LISTING}))[0]
        raise CorruptBundle(f"{folder / different}: is {'extra' if different in found else 'missing'}")
    held = {}
    for name, entry in files.items():
        if name in _HELD_LIMITS_BYTES:
            held[name] = read(found[name], _HELD_LIMITS_BYTES[name])
            digest, size = hashlib.sha256(held[name]), len(held[name])
        else:
            with open_plain(found[name], _SIZE_LIMIT_BYTES, refusal=CorruptBundle, follow_links=False) as stream:
                digest, size = hashlib.file_digest(stream, "sha256"), stream.tell()
        if (size, digest.hexdigest()) != (entry.bytes, entry.sha256):
            raise CorruptBundle(f"{found[name]}: is not the file that was written (size or SHA-256 differ)")
    return listing, held


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


# The random generators that a training uses: kept apart from the caller's, written down, and brought back.


@contextmanager
def own_random_state() -> Iterator[None]:
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


REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def capture_arrays(model: Model, algorithm: Algorithm) -> Arrays:
    """Weights, optimisers, environment, random generators and recent episodes of a model between two updates."""
    arrays: Arrays = {f"policy.{name}": _copy(tensor) for name, tensor in model.policy.state_dict().items()}
    arrays |= {name: _copy(tensor) for name, tensor in algorithm.learned_beside(model).items()}
    for name, optimizer in algorithm.optimizers(model).items():
        arrays |= _optimizer_arrays(name, optimizer)
    environment: Any = model.env
    arrays |= {f"environment.{name}": array for name, array in environment.snapshot().items()}
    numpy_state: Any = np.random.get_state(legacy=False)  # noqa: NPY002
    observations: Any = model._last_obs
    episodes = list(model.ep_info_buffer or ())
    return arrays | {
        "random.torch": torch.get_rng_state().numpy().copy(),
        "random.numpy": np.array(numpy_state["state"]["key"], np.uint32),
        "random.python": np.array(random.getstate()[1], np.uint64),
        "last.observations": observations.copy(),
        "last.episode_starts": np.array(model._last_episode_starts, np.bool_),
        "episodes.return": np.array([episode["r"] for episode in episodes], np.float64),
        "episodes.steps": np.array([episode["l"] for episode in episodes], np.int64),
    }


def _optimizer_arrays(name: str, optimizer: torch.optim.Optimizer) -> Arrays:
    kept = optimizer.state_dict()["state"].items()
    return {
        f"optimizer.{name}.{index}.{key}": _copy(value) for index, entries in kept for key, value in entries.items()
    }


def capture_model(model: Model, algorithm: Algorithm) -> tuple[Arrays, dict[str, Any], Arrays]:
    """The arrays of a model between two updates, its counters, generators and log as plain JSON, and replay memory.

    Of the replay memory (nothing without one, as in PPO) the filled part, as views.
    """
    log, pending = model.logger, {}
    for name, value in log.name_to_value.items():
        number = value.item() if isinstance(value, np.generic | torch.Tensor) else value
        pending[name] = [number, log.name_to_count[name], list(log.name_to_excluded[name] or ())]
    numpy_state: Any = np.random.get_state(legacy=False)  # noqa: NPY002
    version, _, gauss = random.getstate()
    memory: Any = getattr(model, "replay_buffer", None)
    numbers = {
        "counters": {name: getattr(model, name) for name in _COUNTERS},
        "learning_rates": {
            name: float(optimizer.param_groups[0]["lr"]) for name, optimizer in algorithm.optimizers(model).items()
        },
        "random": {
            "numpy": [int(numpy_state["state"]["pos"]), int(numpy_state["has_gauss"]), float(numpy_state["gauss"])],
            "python": [version, gauss],
            "actions": model.action_space.np_random.bit_generator.state,
        },
        "log": pending,
        "replay": {} if memory is None else {"pos": memory.pos, "full": memory.full},
    }
    replay = {} if memory is None else {name: getattr(memory, name)[: memory.size()] for name in REPLAY}
    return capture_arrays(model, algorithm), numbers, replay


def restore_model(model: Model, algorithm: Algorithm, state: TrainingState) -> None:
    """Bring a freshly built model of the same recipe, whose logger is set, to the state of ``capture_model``."""
    arrays, plain = state.arrays, state.numbers
    model.policy.load_state_dict({name: torch.from_numpy(array) for name, array in _group(arrays, "policy.").items()})
    for name, tensor in algorithm.learned_beside(model).items():
        tensor.data.copy_(torch.from_numpy(arrays[name]))
    for name, optimizer in algorithm.optimizers(model).items():
        kept: dict[int, dict[str, torch.Tensor]] = {}
        for place, array in _group(arrays, f"optimizer.{name}.").items():
            index, key = place.split(".")
            kept.setdefault(int(index), {})[key] = torch.from_numpy(array.copy())
        groups = optimizer.state_dict()["param_groups"]
        for group in groups:
            group["lr"] = plain["learning_rates"][name]
        optimizer.load_state_dict({"state": kept, "param_groups": groups})
    environment: Any = model.env
    environment.restore(_group(arrays, "environment."))
    for name in _COUNTERS:
        setattr(model, name, plain["counters"][name])
    model._last_obs = arrays["last.observations"].copy()
    model._last_episode_starts = arrays["last.episode_starts"].copy()
    model.ep_info_buffer, model.ep_success_buffer = (deque[Any](maxlen=model._stats_window_size) for _ in range(2))
    for gained, steps in zip(arrays["episodes.return"].tolist(), arrays["episodes.steps"].tolist(), strict=True):
        model.ep_info_buffer.append({"r": gained, "l": steps, "t": 0.0})
    position, has_gauss, cached = plain["random"]["numpy"]
    np.random.set_state(("MT19937", arrays["random.numpy"], position, has_gauss, cached))  # noqa: NPY002
    version, gauss = plain["random"]["python"]
    random.setstate((version, tuple(arrays["random.python"].tolist()), gauss))
    torch.set_rng_state(torch.from_numpy(arrays["random.torch"].copy()))
    model.action_space.np_random.bit_generator.state = plain["random"]["actions"]
    for name, (value, count, excluded) in plain["log"].items():
        model.logger.name_to_value[name] = value
        model.logger.name_to_count[name] = count
        model.logger.name_to_excluded[name] = tuple(excluded)
    memory: Any = getattr(model, "replay_buffer", None)
    if memory is not None:
        for name in REPLAY:
            getattr(memory, name)[: len(state.replay[name])] = state.replay[name]
        memory.pos, memory.full = plain["replay"]["pos"], plain["replay"]["full"]


def _group(arrays: Mapping[str, NDArray[Any]], prefix: str) -> Arrays:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def _copy(tensor: Any) -> NDArray[Any]:
    return np.array(torch.as_tensor(tensor).detach().cpu().numpy())


# The check that a checkpoint belongs to a model: arrays, counters and policies as this model would write them.
#
# A listing whose hashes agree says that a checkpoint was not damaged, not that it is of this training.

_ENGINE = "environment.engine."
_SCRIPT = f"{_ENGINE}script."
_MAY_BE_INFINITE = (f"{_ENGINE}state", f"{_ENGINE}params")  # no obstacle; news that never comes
_STREAM = f"{_ENGINE}stream"


def check_fits(folder: Path, state: TrainingState, model: Model, algorithm: Algorithm, policy: Trained) -> None:
    """Raise ``CorruptBundle`` unless ``state`` is one of this freshly built ``model``, whose policy is ``policy``.

    ``folder`` is where the checkpoints stand, for the message.

    Resets the model's environment, which the state is going to replace.
    """
    try:
        _check_arrays(state.arrays, model, algorithm)
        counters = state.numbers["counters"]
        if counters["num_timesteps"] != state.steps or state.numbers["between"]["updates"] != state.updates:
            raise ValueError("state.json: steps or updates are not those of the listing")
        if counters["_total_timesteps"] < counters["num_timesteps"]:
            raise ValueError("state.json: counters._total_timesteps is below the steps done")
        optimizers = algorithm.optimizers(model)
        if state.numbers["learning_rates"].keys() != optimizers.keys():
            raise ValueError(f"state.json: learning_rates must be of {', '.join(optimizers)}")
        _check_replay(state, model)
        right = [(each.manifest.network, each.manifest.observation) for each in policy.drivers.values()]
        for name, trained in (("policy", state.policy), ("best", state.best)):
            if trained is not None and (
                type(trained) is not type(policy)
                or [*trained.drivers] != [*policy.drivers]
                or [(each.manifest.network, each.manifest.observation) for each in trained.drivers.values()] != right
            ):
                raise ValueError(f"{name}: is not a policy of these learners and this network")
    except ValueError as error:
        raise CorruptBundle(
            f"{folder}: the checkpoint of step {state.steps} is not of this training: {error}; delete it to go on from"
            " the one before"
        ) from None


def _check_arrays(arrays: Arrays, model: Model, algorithm: Algorithm) -> None:
    environment: Any = model.env
    model._last_obs, model._last_episode_starts = environment.reset(), np.ones(environment.num_envs, np.bool_)
    fresh = capture_arrays(model, algorithm)
    for name, optimizer in algorithm.optimizers(model).items():
        shown = copy.deepcopy(optimizer)  # what it keeps of a parameter, one step shows; its hooks are not copied
        for parameter in shown.param_groups[0]["params"]:
            parameter.grad = torch.zeros_like(parameter)
        shown.step()
        had = {each.split(".")[2] for each in arrays if each.startswith(f"optimizer.{name}.")}  # a gradient once
        fresh |= {at: array for at, array in _optimizer_arrays(name, shown).items() if at.split(".")[2] in had}
    check_arrays(_headers(arrays), [_row(name, array) for name, array in fresh.items()])
    (seed, drawn), (right, _) = arrays[_STREAM].tolist(), fresh[_STREAM].tolist()
    if seed != right or drawn > 1 << 53:
        raise ValueError(f"array {_STREAM!r} is [{seed}, {drawn}]; must be [{right}, worlds drawn so far]")
    for name in sorted(arrays):
        if not name.startswith(_SCRIPT) and arrays[name].dtype.kind == "f":
            wrong = np.isnan(arrays[name]) if name in _MAY_BE_INFINITE else ~np.isfinite(arrays[name])
            if wrong.any():
                raise ValueError(f"array {name!r} holds a number that is not finite")
    numbers = arrays["random.python"]
    if not ((numbers < 2**32).all() and numbers[-1] <= 624):
        raise ValueError("array 'random.python' is no state of Python's generator")
    try:
        torch.Generator().set_state(torch.from_numpy(arrays["random.torch"].copy()))
    except RuntimeError as error:
        raise ValueError(f"array 'random.torch' is no state of torch's generator ({error})") from None


def _row(name: str, array: NDArray[Any]) -> ArrayRow:
    """What an array must be like: there may be any number of episodes, and a script's memory may depend on worlds.

    What a script keeps of a plan has as many columns as its longest plan.
    """
    shape: tuple[int | str, ...] = array.shape
    if name.startswith("episodes."):
        shape = ("episodes",)
    elif name.startswith(_SCRIPT):
        record = name.rpartition(".")[0]
        shape = (*array.shape[:1], *(f"axis {k} of {record}" for k in range(1, array.ndim)))
    return ArrayRow(name, array.dtype.str, shape)


def _check_replay(state: TrainingState, model: Model) -> None:
    memory: Any = getattr(model, "replay_buffer", None)
    place = state.numbers["replay"]
    if memory is None:
        if state.replay or place:
            raise ValueError("it has a replay memory, and this algorithm has none")
        return
    arrays = {name: getattr(memory, name) for name in REPLAY}
    rows = [ArrayRow(name, array.dtype.str, ("filled", *array.shape[1:])) for name, array in arrays.items()]
    filled = check_arrays(_headers(state.replay), rows)["filled"]
    position, full = place.get("pos"), place.get("full")
    somewhere = full is True and filled == memory.buffer_size and position is not None and position < filled
    if filled > memory.buffer_size or not (somewhere or (position, full) == (filled, False)):
        raise ValueError(f"state.json: replay = {place}: does not go with a memory of {filled} entries")


def _headers(arrays: Arrays) -> dict[str, ArrayHeader]:
    return {name: ArrayHeader(array.dtype.str, array.shape) for name, array in arrays.items()}
