"""``Course``: last policy, best policy and evaluations of a training run so far."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.policies.teams import Trained
from ethbrake_marl.first_edition.training.run_folder import RunDirectory
from ethbrake_marl.first_edition.training.training import Training

RETURN = "episode_return"


@dataclass
class Course:
    """Last policy, best policy and evaluations of a training run in progress.

    The best policy is the policy with the smallest mean of the learners' objectives on the fixed list of worlds. If all
    learners have the harm of the line as objective, it is the policy with the least harm of the line (``harm_count``
    says which impacts count). Before the first evaluation there is no best policy.
    """

    harm_count: HarmCount = "first"  # count of harm by which the best policy is chosen
    policy: Trained | None = None  # last policy with finite weights; None before the first check
    best: Trained | None = None  # best policy on the fixed list; None before the first evaluation
    best_harm: float = math.inf  # harm (or mean objective) of ``best`` on the fixed list
    steps: int = 0  # number of decisions of all learners up to ``policy``
    updates: int = 0  # number of updates up to ``policy``
    evaluations: list[dict[str, float]] = field(default_factory=list)  # steps, updates and metrics of each evaluation
    wall_before_s: float = 0.0  # wall time that earlier processes spent on this training (s)
    started: float = field(default_factory=time.monotonic)  # ``time.monotonic`` when this process started to train (s)
    cpu_s: dict[int, float] = field(default_factory=dict)  # steps at an evaluation -> processor time of learning (s)
    cpu_started: float = field(default_factory=time.process_time)  # ``time.process_time`` at which ``cpu_s`` is 0

    @property
    def wall_s(self) -> float:
        """Wall time of this training run so far (s), without the time between a stop and the call of ``resume``."""
        return self.wall_before_s + time.monotonic() - self.started

    @property
    def chosen(self) -> Trained | None:
        """Policy to save as the result: the best policy, or the last policy if there was no evaluation yet."""
        return self.best or self.policy

    def add_evaluation(self, policy: Trained, metrics: Mapping[str, float], episode_return: float | None) -> None:
        """Record an evaluation of ``policy``, and remember the policy if it is the best so far.

        ``policy`` is the policy after ``self.steps`` decisions and ``self.updates`` updates. ``metrics`` are its
        metrics by name, such as ``total_harm``. ``episode_return`` is the mean return of the latest training episodes;
        None if no episode has ended yet.
        """
        extra = {} if episode_return is None else {RETURN: episode_return}
        self.evaluations.append({"steps": self.steps, "updates": self.updates, **metrics, **extra})
        self.cpu_s[self.steps] = time.process_time() - self.cpu_started
        name = RunDirectory.chosen_by(self.evaluations, self.harm_count)
        if name in metrics and metrics[name] < self.best_harm:
            self.best, self.best_harm = policy, metrics[name]

    def to_json(self) -> dict[str, Any]:
        """Return everything except the policies as plain data for JSON, which ``restore`` reads."""
        return {
            "evaluations": self.evaluations,
            "best_harm": None if math.isinf(self.best_harm) else self.best_harm,
            "wall_s": self.wall_s,
            "cpu_s": [[steps, spent] for steps, spent in self.cpu_s.items()],
            "cpu_spent_s": time.process_time() - self.cpu_started,
        }

    def restore(self, content: Mapping[str, Any]) -> None:
        """Set everything except the policies to the values in ``content``, a result of ``to_json``."""
        self.evaluations = [dict(entry) for entry in content["evaluations"]]
        self.best_harm = math.inf if content["best_harm"] is None else float(content["best_harm"])
        self.wall_before_s = float(content["wall_s"])
        self.cpu_s = {int(steps): float(spent) for steps, spent in content.get("cpu_s", [])}
        self.cpu_started = time.process_time() - float(content.get("cpu_spent_s", 0.0))


def objective_in_words(training: Training) -> str:
    """Return the name of the quantity that the learners minimise, such as ``total harm (own)``.

    The name is empty if all learners minimise the harm of the whole line. A weighted sum of harms is called an
    objective, not a harm.
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
