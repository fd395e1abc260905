"""What happens between two updates: measure, log, save, report, and stop when asked to."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from ethbrake_marl.learning.bundle import Policy, save_policy
from ethbrake_marl.learning.divergence import check_rollout, check_update
from ethbrake_marl.learning.recipe import TrainingRecipe
from ethbrake_marl.learning.run_directory import RunDirectory

# Column of the log -> info of an episode's end; means over the episodes of one rollout, exploration included.
EPISODE_COLUMNS = {
    "rollout/first_impact_harm": "world_first_impact_harm",
    "rollout/total_harm": "world_total_harm",
    "rollout/collision_rate": "collided",
}

Evaluate = Callable[[Policy], Mapping[str, float]]


class StopRequested(Exception):
    """Raised inside the training loop to leave it between two updates; never seen outside this room."""


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a training is."""

    steps: int
    total_steps: int  # at the end: the wanted ones, rounded up to whole updates
    updates: int
    wall_s: float
    metrics: Mapping[str, float]  # of the last evaluation, and the mean return of recent episodes


@dataclass
class Course:
    """What a training has reached: the last good policy and the evaluations on the way."""

    policy: Policy | None = None  # none until the first weights were checked
    steps: int = 0
    updates: int = 0
    evaluations: list[dict[str, float]] = field(default_factory=list)  # steps, updates and what ``evaluate`` gave
    checkpoints: list[str] = field(default_factory=list)
    started: float = field(default_factory=time.monotonic)

    @property
    def wall_s(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self.started


class BetweenUpdates(BaseCallback):
    """Runs before the first rollout and after each update.

    ``stop`` is asked before every rollout; ``StopRequested`` is raised when it says yes, with everything saved.
    """

    model: PPO

    def __init__(
        self,
        recipe: TrainingRecipe,
        run: RunDirectory,
        policy_now: Callable[[PPO], Policy],
        *,
        stop: Callable[[], bool],
        evaluate: Evaluate | None,
        on_progress: Callable[[Progress], None] | None,
    ) -> None:
        super().__init__()
        self._recipe, self._run, self._policy_now = recipe, run, policy_now
        self._stop, self._evaluate, self._on_progress = stop, evaluate, on_progress
        self._rollouts = 0
        self._ended: list[dict[str, Any]] = []  # infos of the episodes that ended in this rollout
        self.course = Course()

    @property
    def total_steps(self) -> int:
        """Decisions that are wanted; the training ends after the first update at or beyond them."""
        return self._recipe.total_steps

    @property
    def planned_steps(self) -> int:
        """Decisions at that end: whole rollouts."""
        rollout = self.model.n_envs * self.model.n_steps
        return -(-self.total_steps // rollout) * rollout

    def _on_rollout_start(self) -> None:
        self._after_update()
        if self._stop():
            raise StopRequested

    def _on_step(self) -> bool:
        infos = self.locals["infos"]
        self._ended += [infos[row] for row in np.flatnonzero(self.locals["dones"])]
        return True

    def _on_rollout_end(self) -> None:
        check_rollout(self.model)
        self._rollouts += 1
        if self._ended:
            for column, name in EPISODE_COLUMNS.items():
                self.logger.record(column, float(np.mean([info[name] for info in self._ended])))
        self._ended = []

    def _on_training_end(self) -> None:
        self._after_update(last=True)

    def _after_update(self, *, last: bool = False) -> None:
        course = self.course
        check_update(self.model)
        course.policy = self._policy_now(self.model)
        course.steps, course.updates = self.model.num_timesteps, self._rollouts
        if self._evaluate is not None and (last or course.updates % self._recipe.evaluation.every_updates == 0):
            self._measure(course.policy, self._evaluate)
        if course.updates and course.updates % self._recipe.checkpoint_every_updates == 0:
            folder = self._run.checkpoint(course.steps)
            save_policy(course.policy, folder)
            course.checkpoints.append(folder.name)
        self._log(course)

    def _measure(self, policy: Policy, evaluate: Evaluate) -> None:
        metrics = {name: float(value) for name, value in evaluate(policy).items()}
        self.course.evaluations.append({"steps": self.course.steps, "updates": self.course.updates, **metrics})
        for name, value in metrics.items():
            self.logger.record(f"eval/{name}", value)

    def _log(self, course: Course) -> None:
        if course.updates:
            self.model.dump_logs(course.updates)
        elif course.evaluations:
            self.logger.dump(step=0)
        if self._on_progress is not None:
            metrics = dict(course.evaluations[-1]) if course.evaluations else {}
            episodes = self.model.ep_info_buffer or ()
            if episodes:
                metrics["episode_return"] = sum(float(e["r"]) for e in episodes) / len(episodes)
            self._on_progress(Progress(course.steps, self.planned_steps, course.updates, course.wall_s, metrics))
