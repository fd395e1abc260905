"""What a training has reached: its policies, its evaluations, and an alarm when the return misleads."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ethbrake_marl.harm import HarmCount
from ethbrake_marl.learning.policy_team import Trained

HARM_METRIC: dict[HarmCount, str] = {"first": "first_impact_harm", "total": "total_harm"}
RETURN = "episode_return"

ALARM_AFTER = 5  # evaluations that are looked at
RISEN = 0.05  # by this share of its size the return must have grown to count as risen


@dataclass
class Course:
    """The last good policy, the best one, and the evaluations on the way.

    The best is that of least harm on the fixed list, in the ``count`` that the reward is about, not that of highest
    return; where no harm is measured there is none.
    """

    count: HarmCount = "first"
    policy: Trained | None = None  # none until the first weights were checked
    best: Trained | None = None
    best_harm: float = math.inf
    steps: int = 0
    updates: int = 0
    evaluations: list[dict[str, float]] = field(default_factory=list)  # steps, updates and what ``evaluate`` gave
    alarms: list[str] = field(default_factory=list)
    wall_before_s: float = 0.0  # of the parts of this training that other processes did
    started: float = field(default_factory=time.monotonic)

    @property
    def wall_s(self) -> float:
        """Seconds of training, the time between a kill and the resume left out."""
        return self.wall_before_s + time.monotonic() - self.started

    @property
    def kept(self) -> Trained | None:
        """The policy to use: the best, or the last where nothing was measured."""
        return self.best or self.policy

    def measured(self, policy: Trained, metrics: Mapping[str, float], episode_return: float | None) -> str | None:
        """Take in an evaluation of ``policy``; gives the alarm, if this one raises it."""
        extra = {} if episode_return is None else {RETURN: episode_return}
        self.evaluations.append({"steps": self.steps, "updates": self.updates, **metrics, **extra})
        name = HARM_METRIC[self.count]
        if name in metrics and metrics[name] < self.best_harm:
            self.best, self.best_harm = policy, metrics[name]
        alarm = misleading_return(self.evaluations, name)
        if alarm is not None:
            self.alarms.append(alarm)
        return alarm

    def to_json(self) -> dict[str, Any]:
        """Everything but the policies."""
        return {
            "evaluations": self.evaluations,
            "alarms": self.alarms,
            "best_harm": None if math.isinf(self.best_harm) else self.best_harm,
            "wall_s": self.wall_s,
        }

    def restore(self, content: Mapping[str, Any]) -> None:
        """Take back what ``to_json`` gave."""
        self.evaluations = [dict(entry) for entry in content["evaluations"]]
        self.alarms = list(content["alarms"])
        self.best_harm = math.inf if content["best_harm"] is None else float(content["best_harm"])
        self.wall_before_s = float(content["wall_s"])


def misleading_return(evaluations: Sequence[Mapping[str, float]], harm: str) -> str | None:
    """The alarm if the return has risen over the last evaluations while none of them has less harm than the first.

    The return is the mean of the training's recent episodes, exploration included; its rise counts from a twentieth
    of its size on. A policy that learns to please the reward instead of sparing people looks like this.
    """
    last = [entry for entry in evaluations if RETURN in entry and harm in entry][-ALARM_AFTER:]
    if len(last) < ALARM_AFTER:
        return None
    first = last[0]
    risen = last[-1][RETURN] - first[RETURN]
    lowest = min(entry[harm] for entry in last[1:])
    if not (risen > RISEN * abs(first[RETURN]) and lowest >= first[harm]):
        return None
    return (
        f"step {int(last[-1]['steps']):,}: since step {int(first['steps']):,} the return rose from {first[RETURN]:.4g}"
        f" to {last[-1][RETURN]:.4g}, but {harm} did not fall ({first[harm]:.4g}, since then at best {lowest:.4g});"
        " does the reward say what you mean?"
    )
