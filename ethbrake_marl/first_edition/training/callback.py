"""Callback of a training run: between updates, it measures policies, logs, writes checkpoints, and may stop the run."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from ethbrake_marl.errors import CorruptBundle
from ethbrake_marl.first_edition.policies.manifest import installed_versions
from ethbrake_marl.first_edition.policies.policy import Policy
from ethbrake_marl.first_edition.training.checkpoint import TrainingState, write_checkpoint
from ethbrake_marl.first_edition.training.finite import TrainingDiverged, weights_are_finite
from ethbrake_marl.first_edition.training.fixed_list import Evaluate
from ethbrake_marl.first_edition.training.model_state import capture_model, check_counter, group_of, restore_model
from ethbrake_marl.first_edition.training.models import Learner, Model, make_policies
from ethbrake_marl.first_edition.training.progress import RETURN, Course, objective_in_words
from ethbrake_marl.first_edition.training.run_folder import RunDirectory
from ethbrake_marl.progress import OnProgress, Progress

# Column of the log -> key of ``info`` at the end of an episode. The log has means over the episodes since its last row.
EPISODE_COLUMNS = {
    "rollout/first_impact_harm": "world_first_impact_harm",
    "rollout/total_harm": "world_total_harm",
    "rollout/collision_rate": "collided",
}

# Function of the metrics of an evaluation that returns a reason to stop the training, or None to continue.
StopAt = Callable[[Mapping[str, float]], str | None]


class StopRequested(Exception):
    """Internal exception that the callback raises to leave Stable-Baselines3's training loop between two updates.

    Its argument is the reason that ``StopAt`` returned, or None after Ctrl-C.
    """


class Watchers(NamedTuple):
    """Functions that a training run calls to measure its policies, to ask whether to stop, and to report progress."""

    evaluate: Evaluate | None  # takes the current policies and returns their metrics; None: no measurements
    stop_at: StopAt | None  # takes the metrics of an evaluation; returns a reason to stop, or None to continue
    on_progress: OnProgress | None  # takes a ``Progress``; None: progress is not reported
    stop: Callable[[], bool]  # called before every rollout; returns True if Ctrl-C was pressed


class RunCallback(BaseCallback):
    """Callback that measures policies, logs and writes checkpoints between two updates, and stops the run on request.

    The callback calls ``_between_updates`` before the first rollout, after each update, and at the end of the training.
    To stop the training, it writes a checkpoint and raises ``StopRequested``.
    """

    model: Model  # the model that learns

    def __init__(self, run: RunDirectory, learner: Learner, watchers: Watchers) -> None:
        super().__init__()
        self.run, self.learner, self.model, self._watchers = run, learner, learner.model, watchers
        self.recipe = learner.training.recipe
        self.model.set_logger(Logger(str(run.path), []))
        self.updates = 0
        self.course = Course(self.recipe.reward.harm_count)
        self.notes: list[str] = []  # notes that are passed to ``on_progress`` when the training begins
        self._stop_reason: str | None = None
        self._objective = objective_in_words(learner.training)
        self._ended: dict[str, list[float]] = {column: [] for column in EPISODE_COLUMNS}
        self._is_done_here = False  # True after ``restore``: the work after this update was done before the checkpoint

    def _on_rollout_start(self) -> None:
        while self.notes:
            self.tell(self.notes.pop(0))
        if not self._is_done_here:
            self._between_updates()
        self._is_done_here = False
        if self._watchers.stop() or self._stop_reason is not None:
            self._take_policies()
            self._write_checkpoint()
            raise StopRequested(self._stop_reason)

    def _on_step(self) -> bool:
        for row in np.flatnonzero(self.locals["dones"]):
            for column, name in EPISODE_COLUMNS.items():
                self._ended[column].append(float(self.locals["infos"][row][name]))
        return True

    def _on_rollout_end(self) -> None:
        self.updates += 1

    def _on_training_end(self) -> None:
        self._between_updates(last=True)

    def _between_updates(self, *, last: bool = False) -> None:
        updates, recipe = self.updates, self.recipe
        measure = self._watchers.evaluate is not None and (last or updates % recipe.evaluation.every_updates == 0)
        if last or measure or updates % recipe.updates_per_row == 0:
            self._take_policies()
            if measure:
                self._measure()
            self._log_row()
            self.tell()
        if not last and updates and updates % recipe.checkpoint_every_updates == 0:
            self._take_policies()
            self._write_checkpoint()

    def _take_policies(self) -> None:
        """Store policies with the current weights in ``course``, unless it has the weights of this update already.

        Raises ``TrainingDiverged`` if a weight is not finite.
        """
        course, steps = self.course, self.model.num_timesteps
        if course.policy is None or (course.steps, course.updates) != (steps, self.updates):
            if not weights_are_finite(self.model, self.learner.algorithm):
                raise TrainingDiverged(
                    f"training: a weight is not finite after step {steps}; try a smaller learning_rate"
                )
            course.policy, course.steps, course.updates = self.learner.policies(), steps, self.updates

    def _measure(self) -> None:
        assert self.course.policy is not None and self._watchers.evaluate is not None
        begun = time.process_time()
        metrics = {name: float(value) for name, value in self._watchers.evaluate(self.course.policy).items()}
        self.course.cpu_started += time.process_time() - begun
        self.course.add_evaluation(self.course.policy, metrics, self._recent_return())
        for name, value in metrics.items():
            self.logger.record(f"eval/{name}", value)
        if self._watchers.stop_at is not None:
            self._stop_reason = self._watchers.stop_at(self.course.evaluations[-1])

    def _log_row(self) -> None:
        self.logger.record("steps", self.model.num_timesteps, exclude="tensorboard")
        if any(self._ended.values()):
            for column, values in self._ended.items():
                self.logger.record(column, float(np.mean(values)))
        self._ended = {column: [] for column in EPISODE_COLUMNS}
        if self.updates and isinstance(self.model, OnPolicyAlgorithm):
            self.model.dump_logs(self.updates)
        elif self.updates and isinstance(self.model, OffPolicyAlgorithm):
            self.model.dump_logs()
        elif self.updates or self.course.evaluations:
            self.logger.dump(step=self.model.num_timesteps)

    def _recent_return(self) -> float | None:
        episodes = self.model.ep_info_buffer or ()
        return sum(float(e["r"]) for e in episodes) / len(episodes) if episodes else None

    def tell(self, note: str = "") -> None:
        """Report the progress of the training to ``on_progress``. The message ``note`` is shown only once."""
        if self._watchers.on_progress is None:
            return
        course = self.course
        metrics = dict(course.evaluations[-1]) if course.evaluations else {}
        if metrics and self.recipe.reward.harm_count == "total":  # the harm that the reward counts comes first
            metrics = {"total_harm": metrics["total_harm"], **metrics}
        recent = self._recent_return()
        if recent is not None:
            metrics[RETURN] = recent
        rollout = self.model.n_envs * self.recipe.rounds
        planned = -(-self.recipe.total_steps // rollout) * rollout  # rounded up to whole rollouts
        self._watchers.on_progress(
            Progress("training", course.steps, planned, metrics, note, course.updates, course.wall_s, self._objective)
        )

    def _write_checkpoint(self) -> None:
        """Write a checkpoint of the current state, unless the folder of this checkpoint already exists."""
        folder = self.run.checkpoint(self.course.steps)
        if not folder.exists():
            write_checkpoint(folder, self._state())

    def _state(self) -> TrainingState:
        """Return the state of model, environment, random generators and logs, for ``restore``."""
        course = self.course
        numbers, arrays = capture_model(self.model, self.learner.algorithm)
        best: tuple[Policy, ...] = ()
        if course.best is not None:
            best = (course.best,) if isinstance(course.best, Policy) else tuple(course.best.drivers.values())
        arrays |= {f"best.{k}.{name}": array for k, each in enumerate(best) for name, array in each.tensors.items()}
        numbers |= {
            "training": self.learner.training.identity,
            "versions": installed_versions(),
            "steps": course.steps,
            "updates": course.updates,
            "ended": self._ended,
            "course": course.to_json(),
            "best_steps": None if course.best is None else course.best.steps,
            "progress": self.run.progress.read_text("utf-8"),
        }
        return TrainingState(numbers, arrays)

    def restore(self, state: TrainingState) -> None:
        """Restore model and progress from a checkpoint; raise ``CorruptBundle`` if it does not fit this model."""
        numbers, course = state.numbers, self.course
        try:
            restore_model(self.model, self.learner.algorithm, state)
            for name in ("steps", "updates"):
                check_counter(name, numbers[name], int)
            self.updates = numbers["updates"]
            self._ended = {column: [float(each) for each in numbers["ended"][column]] for column in EPISODE_COLUMNS}
            course.restore(numbers["course"])
            self._take_policies()
            if numbers["best_steps"] is not None:
                best: Callable[[str], Any] = partial(group_of, state.arrays)
                course.best = make_policies(
                    self.learner.training, numbers["best_steps"], lambda k, _: best(f"best.{k}.")
                )
        except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
            raise CorruptBundle(
                f"{self.run.checkpoints}: the checkpoint of step {state.steps} does not fit this training run:"
                f" {' '.join(str(error).split())}; delete this checkpoint to resume from an earlier one"
            ) from None
        self._is_done_here = True
