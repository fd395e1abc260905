"""One stretch of a training in one process: from a fresh model or a checkpoint, to the end or the next stop."""

from __future__ import annotations

from typing import Any, Literal

from stable_baselines3.common.logger import Logger

from ethbrake_marl.files.durable import remove_folder
from ethbrake_marl.learning.algorithms.protocol import Algorithm
from ethbrake_marl.learning.checkpoint import TrainingState, prune, write_checkpoint
from ethbrake_marl.learning.loop import BetweenUpdates, StopRequested
from ethbrake_marl.learning.model_state import (
    Model,
    capture_model,
    replay_arrays,
    restore_log,
    restore_model,
    restore_replay,
)
from ethbrake_marl.learning.progress import TrainingDiverged, weights_are_finite
from ethbrake_marl.learning.run_folder import RunDirectory, RunRecord, RunStatus
from ethbrake_marl.learning.run_log import EventFile, ProgressTable, cut_back, event_sizes
from ethbrake_marl.learning.training import Training
from ethbrake_marl.policies.manifest import installed_versions
from ethbrake_marl.policies.team import Trained, save_trained, steps_of

Ended = Literal["finished", "interrupted"]


class Session:
    """Keeps the run's folder complete while a model learns in it."""

    def __init__(self, run: RunDirectory, model: Model, algorithm: Algorithm, training: Training) -> None:
        self._run, self._model, self._algorithm, self._training = run, model, algorithm, training
        self._record = RunRecord(run)
        self._table = ProgressTable(run.progress)
        self._restored: TrainingState | None = None

    def save(self, between: BetweenUpdates) -> None:
        """Write a checkpoint of this moment, unless there is one, and delete those that are old."""
        course, folder = between.course, self._run.checkpoint(between.course.steps)
        if folder.exists():
            return
        assert course.policy is not None
        arrays, numbers = capture_model(self._model, self._algorithm)
        replay, replay_numbers = replay_arrays(self._model)
        numbers |= {
            "training": self._training.identity,
            "between": between.state(),
            "replay": replay_numbers,
            "events": event_sizes(self._run.tensorboard),
        }
        state = TrainingState(
            course.steps,
            course.updates,
            numbers,
            arrays,
            replay,
            course.policy,
            course.best,
            self._table.content(),
            installed_versions(),
        )
        write_checkpoint(folder, state)
        prune(self._run.checkpoints)

    def restore(self, between: BetweenUpdates, state: TrainingState | None) -> None:
        """Bring model, callback, table and events back to ``state``; None: to the beginning."""
        if state is None:
            self._run.progress.unlink(missing_ok=True)
            cut_back(self._run.tensorboard, {})
            return
        restore_model(self._model, self._algorithm, state.arrays, state.numbers)
        restore_replay(self._model, state.replay, state.numbers["replay"])
        between.restore(state.numbers["between"], state.steps, state.policy, state.best)
        self._table.restore(state.table)
        cut_back(self._run.tensorboard, state.numbers["events"])
        self._restored = state

    def learn(self, between: BetweenUpdates) -> Ended:
        """Train to the end, and leave the folder complete whatever that end is."""
        model, state = self._model, self._restored
        logger = Logger(str(self._run.path), [self._table, EventFile(self._run.tensorboard)])
        model.set_logger(logger)
        if state is not None:
            restore_log(model, state.numbers)
        status: Ended = "finished"
        reason: str | None = None
        try:
            steps = self._training.recipe.total_steps - model.num_timesteps
            model.learn(steps, callback=between, log_interval=None, reset_num_timesteps=state is None)  # type: ignore[arg-type]
        except StopRequested as stop:
            status, reason = "interrupted", stop.reason
        except BaseException as error:
            cause = self._explain(error)
            ended: RunStatus = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
            self._close(between, ended, f"{type(cause).__name__}: {cause}")
            if cause is error:
                raise
            raise cause from error
        finally:
            logger.close()
        self._close(between, status, reason)
        return status

    def _close(self, between: BetweenUpdates, status: RunStatus, reason: str | None) -> None:
        """Save the best and the last good policy, say how the run ended; a finished one needs no checkpoint."""
        course = between.course
        self._save_policy(course.kept, "policy")
        self._save_policy(course.policy, "policy-last")
        left: dict[str, Any] = {
            "wall_s": round(course.wall_s, 3),
            "steps": course.steps,
            "updates": course.updates,
            "policy_steps": None if course.kept is None else steps_of(course.kept),
            "alarms": course.alarms,
        }
        self._record.end(status, reason, left)
        if status == "finished" and self._run.checkpoints.is_dir():
            remove_folder(self._run.checkpoints)

    def _save_policy(self, policy: Trained | None, name: str) -> None:
        if policy is not None:
            save_trained(policy, self._run.path / name, replace=True)

    def _explain(self, error: BaseException) -> BaseException:
        """The error to report: torch's own when a distribution gets a NaN says little about a training."""
        if isinstance(error, ValueError) and not weights_are_finite(self._model, self._algorithm):
            return TrainingDiverged(
                f"training: a weight or the exploration noise is not finite at step {self._model.num_timesteps};"
                " try a smaller learning_rate"
            )
        return error
