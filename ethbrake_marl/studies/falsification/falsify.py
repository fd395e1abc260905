"""Search the ranges of a scenario for the worlds where an agent is worst."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Floats
from ethbrake_marl.scenario import Sample
from ethbrake_marl.scenario.ranges import ranges_of
from ethbrake_marl.studies.falsification.measures import Measure, Measured
from ethbrake_marl.studies.falsification.search import Watcher, far_apart, search


@dataclass(frozen=True, slots=True)
class Falsified:
    """The worst worlds that a search found, worst first, and what all that it tried were like."""

    sample: Sample  # the worst worlds
    measured: Measured  # in them
    scores: Floats  # of every world tried, in their order; minus infinity: the scenario does not have it
    first_above: int | None  # how many worlds were tried until one had a score above zero

    @property
    def share_above(self) -> float:
        """Share of the tried worlds, of those that count, with a score above zero."""
        good = self.scores[np.isfinite(self.scores)]
        return float((good > 0.0).mean()) if len(good) else 0.0


def falsify(
    measure: Measure,
    budget: int,
    seed: int,
    *,
    most: int = 20,
    adaptive: bool = True,
    on_round: Watcher | None = None,
) -> Falsified:
    """Try ``budget`` worlds of the measure's scenario, and keep the worst, at most ``most``, that are far apart.

    Worlds without harm, regret or difference are not kept: the result may hold none.

    Raises ``InvalidInput`` where the scenario draws nothing, or has none of the worlds that were tried, and what
    ``ranges_of`` raises.
    """
    ranges = ranges_of(measure.scenario)

    def score(points: Floats) -> Floats:
        sample, accepted = ranges.sample(points)
        found, rows = np.full(len(points), -np.inf), np.flatnonzero(accepted)
        if len(rows):
            found[rows] = measure(sample.take(rows)).score
        return found

    tried = search(score, len(ranges.names), budget, seed, adaptive=adaptive, on_round=on_round)
    worst = far_apart(tried, most)
    if measure.name != "bound":
        worst = worst[tried.scores[worst] > 0.0]
    if not np.isfinite(tried.scores).any():
        raise InvalidInput(
            f"scenario {measure.scenario.name!r}: none of {budget:,} worlds tried counts: all have an impact before"
            " anybody may act, or the physics fails; give early_impacts: keep, or a larger --budget"
        )
    above = np.flatnonzero(tried.scores > 0.0)
    sample, _ = ranges.sample(tried.points[worst])
    measured = measure(sample) if len(worst) else Measured(np.empty(0), np.empty(0), None)
    return Falsified(sample, measured, tried.scores, int(above[0]) + 1 if len(above) else None)
