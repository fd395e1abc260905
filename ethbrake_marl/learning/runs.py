"""Train: recipe and scenario in, a run's folder with the policies out; or go on with a training that stopped."""

from __future__ import annotations

import copy
import hashlib
import json
import math
import os
import random
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from io import BufferedReader
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import safetensors.numpy
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import CSVOutputFormat, KVWriter, Logger, TensorBoardOutputFormat
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from tensorboard.compat.proto.event_pb2 import Event, SessionLog

from ethbrake_marl.agents import Driver, LearnedAgent, Team
from ethbrake_marl.engine import Arrays
from ethbrake_marl.envs import EthBrakeVecEnv, make_sb3_vec_env
from ethbrake_marl.errors import CorruptBundle, EthBrakeError, InvalidInput, OnProgress, Progress, Told, stop_on_signal
from ethbrake_marl.evaluation import evaluate, mean
from ethbrake_marl.files.store import (
    hold_lock,
    new_file,
    new_folder,
    open_plain,
    parse_strict_json,
    read_object,
    read_plain,
    remove_folder,
    remove_unfinished,
    write_file,
)
from ethbrake_marl.harm import HarmCount, objective_harm
from ethbrake_marl.learning.algorithms import tensors_of
from ethbrake_marl.learning.training import Algorithm, RunDirectory, RunStatus, Scheme, Training, TrainingRecipe
from ethbrake_marl.policies import Float32s, NetworkSpec, Policy, PolicyTeam, Trained, installed_versions
from ethbrake_marl.registry import versions_used
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
        other_versions: go on from a checkpoint that other versions wrote, although its numbers may differ.

    Raises ``InvalidInput`` for a folder without a training, one that has finished, one in which another process trains,
    one whose ``config.json`` was edited since the checkpoint, and a checkpoint of other versions.

    """
    run = RunDirectory(Path(directory))
    config = run.read_config()
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
                session.restore(state)
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
    if state.numbers.get("training") != training:
        name = run.checkpoint(state.steps).name
        raise InvalidInput(
            f"{run.config}: was changed after the checkpoint {name} of this training; put it back as it was, or"
            " train again in another folder"
        )
    now, then = installed_versions(), state.numbers["versions"]
    asked = then.keys() | (now.keys() - versions_used().keys())  # other parts may have been loaded here since
    other = sorted(name for name in asked if now.get(name) != then.get(name))
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
        model.set_logger(Logger(str(run.path), []))
        self._reason: str | None = None  # to stop at the next rest
        self.updates = 0
        self.course = Course(self.recipe.reward.harm_count)
        self.notes: list[str] = []  # to be told when the training begins
        self._objective = objective_in_words(training)
        self._ended: dict[str, list[float]] = {column: [] for column in EPISODE_COLUMNS}
        self._resumed = False  # what is due at this rest was done before the checkpoint was written

    def restore(self, state: TrainingState) -> None:
        """Bring model and course to ``state``; raises ``CorruptBundle`` where that is of another model."""
        numbers, course = state.numbers, self.course
        try:
            restore_model(self.model, self.algorithm, state)
            for name in ("steps", "updates"):
                _check_counter(name, numbers[name], int)
            self.updates = numbers["updates"]
            self._ended = {column: [float(each) for each in numbers["ended"][column]] for column in EPISODE_COLUMNS}
            course.restore(numbers["course"])
            self._rest()
            if numbers["best_steps"] is not None:
                best = partial(_group, state.arrays)
                course.best = make_policies(self.training, numbers["best_steps"], lambda k, _: best(f"best.{k}."))
        except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
            raise CorruptBundle(
                f"{self.run.checkpoints}: the checkpoint of step {state.steps} is not of this training:"
                f" {' '.join(str(error).split())}; delete it to go on from the one before"
            ) from None
        self._resumed = True

    def learn(self, state: TrainingState | None) -> Ended:
        """Train from ``state`` (None: from the beginning) to the end, and leave the folder complete whatever it is."""
        model, logger = self.model, self.model.logger
        self.run.write_status("running", start=self.training.begins)
        logger.output_formats = open_logs(self.run, state)
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
            self.logger.record("steps", self.model.num_timesteps, exclude="tensorboard")
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
            actors = self.algorithm.actors(self.model)
            course.policy = make_policies(
                self.training, self.model.num_timesteps, lambda k, network: tensors_of(actors[k], network)
            )
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
        numbers, arrays = capture_model(self.model, self.algorithm)
        numbers |= {
            "training": self.training.identity,
            "versions": installed_versions(),
            "steps": course.steps,
            "updates": course.updates,
            "ended": self._ended,
            "course": course.to_json(),
            "best_steps": None if course.best is None else course.best.steps,
            "progress": self.run.progress.read_text("utf-8"),
        }
        if course.best is not None:
            best = (course.best,) if isinstance(course.best, Policy) else course.best.drivers.values()
            for k, policy in enumerate(best):
                arrays |= {f"best.{k}.{name}": tensor for name, tensor in policy.tensors.items()}
        write_checkpoint(folder, TrainingState(numbers, arrays))

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


def make_policies(
    training: Training, steps: int, tensors: Callable[[int, NetworkSpec], Mapping[str, Float32s]]
) -> Trained:
    """One policy for all learners, or one for each; ``tensors(k, network)`` are those of the k-th."""
    recipe, scenario = training.recipe, training.scenario
    names = tuple(training.drivers)
    apart = training.scheme == "independent"
    policies = []
    for k, learners in enumerate([(name,) for name in names] if apart else [names]):
        observation = training.observations[learners[0]]
        network = recipe.network_spec(observation.size)
        if training.scheme == "centralised":
            network = network.model_copy(update={"value_hidden": ()})  # its critic sees what no vehicle sees
        policy = Policy.make(
            tensors(k, network),
            algorithm=recipe.algorithm,
            network=network,
            observation=observation,
            learners=learners,
            scenario=scenario.model_dump(mode="json"),
            reward=recipe.reward.model_dump(mode="json"),
            seeds={"training": recipe.seed, "evaluation": recipe.evaluation.seed},
            steps=steps,
        )
        policies.append(policy)
    return PolicyTeam(dict(zip(names, policies, strict=True))) if apart else policies[0]


def open_logs(run: RunDirectory, state: TrainingState | None) -> list[KVWriter]:
    """``progress.csv`` and TensorBoard's events, which go on after the rows of ``state``; None: from the beginning."""
    run.progress.unlink(missing_ok=True)  # it may be a link
    if state is None:
        for left in run.tensorboard.glob("events.out.tfevents.*"):
            left.unlink()
    table = CSVOutputFormat(str(run.progress))
    events: Any = TensorBoardOutputFormat(str(run.tensorboard))  # whose writer torch declares as None
    if state is not None:
        table.file.write(state.numbers["progress"])
        table.file.flush()
        table.keys = [name for name in state.numbers["progress"].partition("\n")[0].split(",") if name]
        restart = Event(step=state.steps + 1, session_log=SessionLog(status=SessionLog.START))
        events.writer.file_writer.add_event(restart)  # TensorBoard forgets what was written from this step on
    return [table, events]


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


# A training at rest between two updates: a folder with its arrays and its plain numbers, whole or not there.

ARRAYS, NUMBERS = "arrays.safetensors", "numbers.json"
_KINDS = {
    "training": str,
    "versions": dict,
    "steps": int,
    "updates": int,
    "ended": dict,
    "course": dict,
    "progress": str,
}
KEPT = 2  # checkpoints of a running training; a torn last one leaves the one before
COUNTERS = ("num_timesteps", "_n_updates", "_episode_num", "_current_progress_remaining", "_total_timesteps")


class TrainingState(NamedTuple):
    """What a training needs to go on."""

    numbers: dict[str, Any]  # plain JSON
    arrays: Arrays

    @property
    def steps(self) -> int:
        """Decisions of all learners so far."""
        return int(self.numbers["steps"])


def write_checkpoint(folder: Path, state: TrainingState) -> None:
    """Write ``folder``, completely or not at all, with every byte on the disk before it has its name; old ones go."""
    arrays = {name: np.ascontiguousarray(array).reshape(array.shape) for name, array in state.arrays.items()}
    with new_folder(folder) as partial:
        with new_file(partial / ARRAYS) as file:
            safetensors.numpy.save_file(arrays, file)
        with (partial / ARRAYS).open("rb") as stream:
            numbers = state.numbers | {"sha256": _digest(stream, state.numbers)}
        write_file(partial / NUMBERS, json.dumps(numbers, allow_nan=False).encode())
    for old in checkpoint_folders(folder.parent)[KEPT:]:
        remove_folder(old)


def read_checkpoint(folder: Path) -> TrainingState:
    """Read ``folder``; raises ``CorruptBundle`` unless it is as it was written, ``InvalidInput`` of another form."""
    if not os.path.lexists(folder / NUMBERS):
        raise InvalidInput(
            f"{folder}: has no {NUMBERS}, so another version of this package wrote it; go on with that version, or"
            " delete the checkpoint to go on from the one before"
        )
    data = read_plain(folder / NUMBERS, 256 << 20, refusal=CorruptBundle, follow_links=False)
    with open_plain(folder / ARRAYS, 1 << 36, refusal=CorruptBundle, follow_links=False) as stream:
        try:
            numbers = parse_strict_json(data)
            whole = isinstance(numbers, dict) and numbers.pop("sha256", None) == _digest(stream, numbers)
        except ValueError:
            whole = False
    if not whole:
        raise CorruptBundle(f"{folder}: its files are not those that were written (the SHA-256 differs)")
    try:
        state = TrainingState(numbers, safetensors.numpy.load_file(folder / ARRAYS))
    except SafetensorError as error:
        raise InvalidInput(f"{folder / ARRAYS}: {error}; delete the checkpoint to go on from the one before") from None
    for name, kind in _KINDS.items():
        if type(numbers.get(name)) is not kind:
            raise InvalidInput(
                f"{folder / NUMBERS}: {name} = {numbers.get(name)!r:.60}: must be of type {kind.__name__}; delete the"
                " checkpoint to go on from the one before"
            )
    return state


def _digest(arrays: BufferedReader, numbers: Mapping[str, Any]) -> str:
    """SHA-256 of both files of a checkpoint, in hexadecimal digits."""
    digest = hashlib.file_digest(arrays, "sha256")
    digest.update(json.dumps(numbers, sort_keys=True).encode())
    return digest.hexdigest()


def checkpoint_folders(folder: Path) -> list[Path]:
    """Checkpoints in ``folder``, the newest first; whether they are whole is not known yet."""
    found = (path for path in folder.glob("step_*") if path.is_dir() and not path.is_symlink())
    return sorted(found, reverse=True)


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


def capture_model(model: Model, algorithm: Algorithm) -> tuple[dict[str, Any], Arrays]:
    """Plain numbers and arrays of a model between two updates: all that changes in it while it learns."""
    arrays: Arrays = {f"policy.{name}": _copy(tensor) for name, tensor in model.policy.state_dict().items()}
    arrays |= {name: _copy(tensor) for name, tensor in algorithm.learned_beside(model).items()}
    optimizers = algorithm.optimizers(model)
    for name, optimizer in optimizers.items():
        for index, entries in optimizer.state_dict()["state"].items():
            arrays |= {f"optimizer.{name}.{index}.{key}": _copy(value) for key, value in entries.items()}
    environment: Any = model.env
    arrays |= {f"environment.{name}": array for name, array in environment.snapshot().items()}
    numpy_state: Any = np.random.get_state(legacy=False)  # noqa: NPY002
    version, python_state, gauss = random.getstate()
    observations: Any = model._last_obs
    episodes = list(model.ep_info_buffer or ())
    arrays |= {
        "random.torch": torch.get_rng_state().numpy().copy(),
        "random.numpy": np.array(numpy_state["state"]["key"], np.uint32),
        "random.python": np.array(python_state, np.uint64),
        "last.observations": observations.copy(),
        "last.episode_starts": np.array(model._last_episode_starts, np.bool_),
        "episodes.return": np.array([episode["r"] for episode in episodes], np.float64),
        "episodes.steps": np.array([episode["l"] for episode in episodes], np.int64),
    }
    memory: Any = getattr(model, "replay_buffer", None)  # none in PPO
    if memory is not None:
        arrays |= {f"replay.{name}": getattr(memory, name)[: memory.size()] for name in REPLAY}
    log, pending = model.logger, {}
    for name, value in log.name_to_value.items():
        number = value.item() if isinstance(value, np.generic | torch.Tensor) else value
        pending[name] = [number, log.name_to_count[name], list(log.name_to_excluded[name] or ())]
    numbers = {
        "counters": {name: getattr(model, name) for name in COUNTERS},
        "learning_rates": {name: float(each.param_groups[0]["lr"]) for name, each in optimizers.items()},
        "random": {
            "numpy": [int(numpy_state["state"]["pos"]), int(numpy_state["has_gauss"]), float(numpy_state["gauss"])],
            "python": [version, gauss],
            "actions": model.action_space.np_random.bit_generator.state,
        },
        "log": pending,
        "replay": None if memory is None else [memory.pos, memory.full],
    }
    return numbers, arrays


def restore_model(model: Model, algorithm: Algorithm, state: TrainingState) -> None:
    """Bring a freshly built model of the same recipe, whose logger is set, to the state of ``capture_model``."""
    plain, arrays = state
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
        _try_step(optimizer)
    environment: Any = model.env
    environment.restore(_group(arrays, "environment."))
    for name in COUNTERS:
        _check_counter(name, plain["counters"][name], type(getattr(model, name)))
        setattr(model, name, plain["counters"][name])
    space = environment.observation_space
    seen = np.zeros((environment.num_envs, *space.shape), space.dtype)
    model._last_obs = _like(seen, arrays, "last.observations").copy()
    model._last_episode_starts = _like(np.zeros(len(seen), np.bool_), arrays, "last.episode_starts").copy()
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
        position, full = plain["replay"]
        if (type(position), type(full)) != (int, bool) or not 0 <= position < memory.buffer_size:
            raise ValueError(f"replay = {plain['replay']!r:.60}: is no place in its memory")
        memory.pos, memory.full = position, full
        for name in REPLAY:
            filled = getattr(memory, name)[: memory.size()]
            filled[:] = _like(filled, arrays, f"replay.{name}")


def _try_step(optimizer: torch.optim.Optimizer) -> None:
    """Make a step in a copy; raises what a state raises that is not of these weights."""
    tried = copy.deepcopy(optimizer)
    for group in tried.param_groups:
        for weights in group["params"]:
            weights.grad = torch.zeros_like(weights)
    tried.step()


def _check_counter(name: str, value: object, kind: type) -> None:
    if type(value) is not kind or (kind is int and not 0 <= value < 1 << 53):  # type: ignore[operator]  # an int
        right = "a whole number, at least 0" if kind is int else f"of type {kind.__name__}"
        raise ValueError(f"{name} = {value!r:.60}: must be {right}")


def _like(model: NDArray[Any], arrays: Arrays, name: str) -> NDArray[Any]:
    """The array of this name; raises ``ValueError`` unless it is finite, and of shape and type as ``model``."""
    found = arrays[name]
    if (found.shape, found.dtype) != (model.shape, model.dtype) or not np.isfinite(found).all():
        raise ValueError(f"{name}: {model.shape} finite {model.dtype} are needed")
    return found


def _group(arrays: Mapping[str, NDArray[Any]], prefix: str) -> Arrays:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def _copy(tensor: Any) -> NDArray[Any]:
    return np.array(torch.as_tensor(tensor).detach().cpu().numpy())
