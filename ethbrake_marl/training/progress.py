"""The progress of a training: its policies and its evaluations."""

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
