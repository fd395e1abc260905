"""The work between two updates of a training: measure, log, save, report, and stop when asked to."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.agents.protocol import Driver, Team
from ethbrake_marl.errors import OnProgress, Progress
from ethbrake_marl.evaluation import evaluate
from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.harm import objective_harm
from ethbrake_marl.learning.algorithms.protocol import Algorithm
from ethbrake_marl.learning.progress import (
    AT_HORIZON,
    OBJECTIVE,
    RETURN,
    Course,
    Model,
    check_losses,
    check_rollout,
    check_step,
    check_weights,
)
from ethbrake_marl.learning.recipe import TrainingRecipe
from ethbrake_marl.learning.training import Training
from ethbrake_marl.policies.bundle import Policy, Trained
from ethbrake_marl.rewards import resolved_objective
from ethbrake_marl.scenario import Scenario

# Column of the log -> info of an episode's end; means over the episodes since the last row, exploration included.
EPISODE_COLUMNS = {
    "rollout/first_impact_harm": "world_first_impact_harm",
    "rollout/total_harm": "world_total_harm",
    "rollout/collision_rate": "collided",
}

Evaluate = Callable[[Any], Mapping[str, float]]  # of what is trained: a ``Policy``, or a ``PolicyTeam``
StopAt = Callable[[Mapping[str, float]], str | None]  # of an evaluation, a reason to stop there, or None


class StopRequested(Exception):
    """Raised inside the training loop to leave it between two updates, for this reason; never seen outside."""

    def __init__(self, reason: str | None = None) -> None:
        super().__init__(reason)
        self.reason = reason


class Save(Protocol):
    """Writes a checkpoint of the training at rest."""

    def __call__(self, between: BetweenUpdates) -> None:
        """Write one."""


class BetweenUpdates(BaseCallback):
    """Runs before the first rollout and after each update.

    ``stop`` is asked before every rollout; ``StopRequested`` is raised when it says yes, with everything saved. With
    ``stop_when_lost`` also where the evaluation just before has found the training lost, with ``stop_at`` where that
    gave a reason.
    """

    model: Model

    def __init__(
        self,
        recipe: TrainingRecipe,
        algorithm: Algorithm,
        policy_now: Callable[[Model], Trained],
        *,
        save: Save,
        stop: Callable[[], bool],
        stop_when_lost: bool,
        stop_at: StopAt | None,
        evaluate: Evaluate | None,
        on_progress: OnProgress | None,
    ) -> None:
        super().__init__()
        self.recipe, self._algorithm, self._policy_now, self._save = recipe, algorithm, policy_now, save
        self._stop, self._stop_when_lost, self._evaluate, self._on_progress = (
            stop, stop_when_lost, evaluate, on_progress,
        )  # fmt: skip
        self._stop_at = stop_at
        self._reason: str | None = None  # to stop at the next rest
        self.updates = 0
        self.course = Course(recipe.reward.harm_count)
        self.notes: list[str] = []  # to be told when the training begins
        self._ended: dict[str, list[float]] = {column: [] for column in EPISODE_COLUMNS}
        self._resumed = False  # what is due at this rest was done before the checkpoint was written

    def state(self) -> dict[str, Any]:
        """What a checkpoint must hold of this object."""
        return {"updates": self.updates, "ended": self._ended, "course": self.course.to_json()}

    def restore(self, content: Mapping[str, Any], steps: int, policy: Trained, best: Trained | None) -> None:
        """Go on from a checkpoint."""
        self.updates = self.course.updates = int(content["updates"])
        self._ended = {column: list(content["ended"][column]) for column in EPISODE_COLUMNS}
        self.course.restore(content["course"])
        self.course.steps, self.course.policy, self.course.best = steps, policy, best
        self._resumed = True

    @property
    def planned_steps(self) -> int:
        """Decisions at the end: whole rollouts."""
        rollout = self.model.n_envs * self.recipe.rounds
        return -(-self.recipe.total_steps // rollout) * rollout

    def tell(self, note: str = "") -> None:
        """Report how far the training is."""
        if self._on_progress is None:
            return
        course = self.course
        metrics = dict(course.evaluations[-1]) if course.evaluations else {}
        recent = self._recent_return()
        if recent is not None:
            metrics[RETURN] = recent
        self._on_progress(
            Progress("training", course.steps, self.planned_steps, metrics, note, course.updates, course.wall_s)
        )

    def _on_rollout_start(self) -> None:
        while self.notes:
            self.tell(self.notes.pop(0))
        if not self._resumed:
            self._after_update()
        self._resumed = False
        lost = self.course.lost if self._stop_when_lost else None
        reason = lost or self._reason
        if self._stop() or reason is not None:
            self._rest()
            self._save(self)
            raise StopRequested(reason)

    def _on_step(self) -> bool:
        infos = self.locals["infos"]
        if not isinstance(self.model, OnPolicyAlgorithm):
            check_step(self.model, self.locals["rewards"], self.locals["new_obs"])
        for row in np.flatnonzero(self.locals["dones"]):
            for column, name in EPISODE_COLUMNS.items():
                self._ended[column].append(float(infos[row][name]))
        return True

    def _on_rollout_end(self) -> None:
        if isinstance(self.model, OnPolicyAlgorithm):
            check_rollout(self.model)
        self.updates += 1

    def _on_training_end(self) -> None:
        self._after_update(last=True)

    def _after_update(self, *, last: bool = False) -> None:
        """Do what is due at this rest, the checkpoint after all the rest of it."""
        check_losses(self.model)
        updates, recipe = self.updates, self.recipe
        measure = self._evaluate is not None and (last or updates % recipe.evaluation.every_updates == 0)
        if last or measure or updates % recipe.logged_updates == 0:
            self._rest()
            if measure:
                self._measure()
            self._log()
        if not last and updates and updates % recipe.checkpoint_every_updates == 0:
            self._rest()
            self._save(self)

    def _rest(self) -> None:
        """Bring the course to this moment."""
        course = self.course
        if course.policy is None or (course.steps, course.updates) != (self.model.num_timesteps, self.updates):
            check_weights(self.model, self._algorithm)
            course.policy = self._policy_now(self.model)
            course.steps, course.updates = self.model.num_timesteps, self.updates

    def _measure(self) -> None:
        assert self.course.policy is not None and self._evaluate is not None
        metrics = {name: float(value) for name, value in self._evaluate(self.course.policy).items()}
        alarm = self.course.add_evaluation(self.course.policy, metrics, self._recent_return())
        for name, value in metrics.items():
            self.logger.record(f"eval/{name}", value)
        self.logger.record("eval/alarm", int(alarm is not None))
        if alarm is not None:
            self.tell(f"alarm: {alarm}")
        if self._stop_at is not None:
            self._reason = self._stop_at(self.course.evaluations[-1])

    def _recent_return(self) -> float | None:
        episodes = self.model.ep_info_buffer or ()
        return sum(float(e["r"]) for e in episodes) / len(episodes) if episodes else None

    def _log(self) -> None:
        if any(self._ended.values()):
            for column, values in self._ended.items():
                self.logger.record(column, float(np.mean(values)))
        self._ended = {column: [] for column in EPISODE_COLUMNS}
        if self.updates and isinstance(self.model, OnPolicyAlgorithm):
            self.model.dump_logs(self.updates)
        elif self.updates and isinstance(self.model, OffPolicyAlgorithm):
            self.model.dump_logs()
        elif self.updates:
            self.logger.dump(step=self.model.num_timesteps)
        elif self.course.evaluations:
            self.logger.dump(step=0)
        self.tell()


def measure_on_list(training: Training) -> Evaluate:
    """What measures the learners' policies on the recipe's fixed list: the means that ``evaluate`` gives on it.

    These alone: no bound is proven and no best known harm is looked up, as nobody is shown them. Where a learner has
    another objective than total, also what each one's makes of the harm, and the mean of these.
    """
    recipe, scenario = training.recipe, training.scenario
    objectives = resolved_objective(recipe.reward, scenario.objective, scenario.vehicles)[1]
    worlds = scenario.sample(recipe.evaluation.worlds, recipe.evaluation.seed)

    def measure(trained: Trained) -> dict[str, float]:
        agents = {"policy": driver_of(trained, scenario)}
        outcome = evaluate(worlds, agents, scenario=scenario, aftermath=False).outcome("policy")
        metrics = {
            "first_impact_harm": mean(outcome.first_impact_harm).value,
            "total_harm": mean(outcome.total_harm).value,
            "collision_rate": float(outcome.collided.mean()),
            AT_HORIZON: float((~outcome.at_rest).mean()),
        }
        if objectives:
            harm = objective_harm(outcome.ledger, recipe.reward.harm_count, objectives)
            each = {scenario.vehicle_names[i]: mean(harm[:, i]).value for i in scenario.learners}
            metrics[OBJECTIVE] = sum(each.values()) / len(each)
            metrics |= {f"{OBJECTIVE}_{name}": value for name, value in each.items()}
        return metrics

    return measure


def driver_of(trained: Trained, scenario: Scenario, name: str = "policy") -> Driver:
    """What drives the scenario's learners by what was trained for them."""
    if isinstance(trained, Policy):
        return LearnedAgent(trained, name)
    numbers = {each: i for i, each in enumerate(scenario.vehicle_names)}
    return Team({numbers[each]: LearnedAgent(policy, name) for each, policy in trained.members.items()}, name)
