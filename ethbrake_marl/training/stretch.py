"""One stretch of a training in one process: what is logged, measured and saved between two updates."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Literal, NamedTuple

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from ethbrake_marl.errors import CorruptBundle, OnProgress, Progress
from ethbrake_marl.files.store import remove_folder
from ethbrake_marl.policies.manifest import installed_versions
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.training.algorithm import Algorithm
from ethbrake_marl.training.checkpoint import TrainingState, write_checkpoint
from ethbrake_marl.training.fixed_list import Evaluate, Measure
from ethbrake_marl.training.model_state import capture_model, check_counter, group_of, restore_model
from ethbrake_marl.training.models import Model, TrainingDiverged, make_policies, open_logs, weights_are_finite
from ethbrake_marl.training.networks import tensors_of
from ethbrake_marl.training.progress import RETURN, Course, objective_in_words
from ethbrake_marl.training.run_folder import RunDirectory, RunStatus
from ethbrake_marl.training.training import Training

# Column of the log -> info of an episode's end; means over the episodes since the last row, exploration included.
EPISODE_COLUMNS = {
    "rollout/first_impact_harm": "world_first_impact_harm",
    "rollout/total_harm": "world_total_harm",
    "rollout/collision_rate": "collided",
}

LOSSES = ("loss", "policy_loss", "value_loss", "policy_gradient_loss", "actor_loss", "critic_loss", "ent_coef_loss")

StopAt = Callable[[Mapping[str, float]], str | None]  # of an evaluation, a reason to stop there, or None

Ended = Literal["finished", "interrupted"]


class StopRequested(Exception):
    """Raised inside the training loop, with its reason, to leave it between two updates; never seen outside."""


class Wishes(NamedTuple):
    """What is asked of a training beside its result."""

    measure: Measure | None
    stop_at: StopAt | None
    on_progress: OnProgress | None


class Session(BaseCallback):
    """One stretch of a training in one process: from a fresh model or a checkpoint, to the end or the next stop.

    It keeps the run's folder complete. What is due stands in ``_after_update``, before the first rollout and after each
    update. ``stop`` is asked before every rollout; ``StopRequested`` is raised when it says yes, with everything saved.
    The same where ``stop_at`` gave a reason at the evaluation just before.
    """

    model: Model

    def __init__(
        self, run: RunDirectory, training: Training, algorithm: Algorithm, model: Model, wishes: Wishes,
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
                check_counter(name, numbers[name], int)
            self.updates = numbers["updates"]
            self._ended = {column: [float(each) for each in numbers["ended"][column]] for column in EPISODE_COLUMNS}
            course.restore(numbers["course"])
            self._rest()
            if numbers["best_steps"] is not None:
                best = partial(group_of, state.arrays)
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
        for name in (name for loss in LOSSES for name in logged if name.rpartition("/")[2] == loss):
            if not np.isfinite(logged[name]):  # it may well leave finite weights
                raise TrainingDiverged(
                    f"training: {name} = {float(logged[name])} after step {self.model.num_timesteps}: must be finite;"
                    " try a smaller learning_rate, or smaller weights of the reward"
                )
        updates, recipe = self.updates, self.recipe
        measure = self._evaluate is not None and (last or updates % recipe.evaluation.every_updates == 0)
        if last or measure or updates % recipe.updates_per_row == 0:
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
