"""The course of a training so far: its last and best policy, and its evaluations."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.policies.teams import Trained
from ethbrake_marl.training.run_folder import RunDirectory
from ethbrake_marl.training.training import Training

RETURN = "episode_return"


@dataclass
class Course:
    """The last good policy, the best policy, and the evaluations of a running training.

    The best policy is not the one of highest return, but the one of least harm on the fixed list, by the learners'
    objectives and in the ``harm_count`` of the reward. Without evaluations there is no best policy.
    """

    harm_count: HarmCount = "first"  # harm by which the best policy is chosen
    policy: Trained | None = None  # last policy with finite weights; None until the first weights were checked
    best: Trained | None = None  # policy with the least harm on the fixed list; None before the first evaluation
    best_harm: float = math.inf  # harm, or objective, of ``best``
    steps: int = 0  # decisions of all learners at ``policy``
    updates: int = 0  # updates at ``policy``
    evaluations: list[dict[str, float]] = field(default_factory=list)  # one entry each: steps, updates and metrics
    wall_before_s: float = 0.0  # time that earlier processes spent on this training (s)
    started: float = field(default_factory=time.monotonic)  # start of this process's part, by ``time.monotonic`` (s)
    cpu_s: dict[int, float] = field(default_factory=dict)  # steps at an evaluation -> processor time of learning (s)
    cpu_started: float = field(default_factory=time.process_time)  # ``time.process_time`` at which ``cpu_s`` is 0

    @property
    def wall_s(self) -> float:
        """Time spent on this training so far (s), without the time between a stop and the resume."""
        return self.wall_before_s + time.monotonic() - self.started

    @property
    def chosen(self) -> Trained | None:
        """The policy to save as the result: the best one, or the last one if there was no evaluation yet."""
        return self.best or self.policy

    def add_evaluation(self, policy: Trained, metrics: Mapping[str, float], episode_return: float | None) -> None:
        """Record an evaluation of ``policy``, and remember the policy if it is the best so far.

        Args:
            policy: the evaluated policy, at the current ``steps`` and ``updates``.
            metrics: its results by name, such as ``total_harm``.
            episode_return: mean return of the latest training episodes; None if no episode has ended yet.

        """
        extra = {} if episode_return is None else {RETURN: episode_return}
        self.evaluations.append({"steps": self.steps, "updates": self.updates, **metrics, **extra})
        self.cpu_s[self.steps] = time.process_time() - self.cpu_started
        name = RunDirectory.chosen_by(self.evaluations, self.harm_count)
        if name in metrics and metrics[name] < self.best_harm:
            self.best, self.best_harm = policy, metrics[name]

    def to_json(self) -> dict[str, Any]:
        """Return evaluations, least harm and times as plain data for JSON, which ``restore`` takes; no policies."""
        return {
            "evaluations": self.evaluations,
            "best_harm": None if math.isinf(self.best_harm) else self.best_harm,
            "wall_s": self.wall_s,
            "cpu_s": [[steps, spent] for steps, spent in self.cpu_s.items()],
            "cpu_spent_s": time.process_time() - self.cpu_started,
        }

    def restore(self, content: Mapping[str, Any]) -> None:
        """Set all values but the policies from ``content``, which ``to_json`` returned."""
        self.evaluations = [dict(entry) for entry in content["evaluations"]]
        self.best_harm = math.inf if content["best_harm"] is None else float(content["best_harm"])
        self.wall_before_s = float(content["wall_s"])
        self.cpu_s = {int(steps): float(spent) for steps, spent in content.get("cpu_s", [])}
        self.cpu_started = time.process_time() - float(content.get("cpu_spent_s", 0.0))


def objective_in_words(training: Training) -> str:
    """Return the name of the quantity that the learners minimise on average, for users: ``total harm (own)``.

    It is empty if all learners minimise the harm of the whole line. Only harm that vehicles bear is called harm; a
    weighted sum of harms is called an objective.
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
