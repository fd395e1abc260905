"""Measures of the literature: least time to collision, largest deceleration required, and whose front struck."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import Step
from ethbrake_marl.evaluation.measures import MeasureValue, Statistic
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.registry import Part

FREE_S = 60.0  # time to collision that counts for a gap that does not close, and the largest one
CRITICAL_S = 1.5  # a shorter time to collision is critical (van der Horst and Hogema 1993)
CRITICAL_MPS2 = 3.4  # more than the comfortable deceleration of AASHTO's Green Book is critical


def _approach(state: State) -> tuple[Floats, Floats]:
    """Gap (m) and closing speed (m/s) of each pair, [n, N - 1]; 1 and 0 where it opens or has had an impact."""
    closing = state.speeds_mps[:, 1:] - state.speeds_mps[:, :-1]
    closes = ~state.pair_hit & (state.gaps_m > 0.0) & (closing > 0.0)
    return np.where(closes, state.gaps_m, 1.0), np.where(closes, closing, 0.0)


def time_to_collision_s(state: State) -> Floats:
    """Time in which each gap closes at present speeds, [n, N - 1] s, at most ``FREE_S``."""
    gap, closing = _approach(state)
    return gap / np.maximum(closing, gap / FREE_S)


def required_mps2(state: State) -> Floats:
    """Deceleration with which each rear vehicle just avoids the vehicle ahead if that keeps its speed, [n, N - 1]."""
    gap, closing = _approach(state)
    return closing**2 / (2.0 * gap)


class Extreme:
    """Most dangerous value of each pair at the alert and at all decisions before its first impact (a ``Watch``)."""

    def __init__(self, of: Callable[[State], Floats], extreme: np.ufunc, limit: float, alert: State) -> None:
        self.of, self.extreme, self.limit, self.value = of, extreme, limit, of(alert)

    def see(self, before: State, step: Step | None, after: State) -> None:
        self.value = self.extreme(self.value, self.of(after))

    def result(self, last: State) -> MeasureValue:
        line = self.extreme.reduce(self.value, axis=1)
        pairs = {f"{i + 1}": column for i, column in enumerate(self.value.T)}
        return {"": line, **pairs, "critical": self.extreme(line, self.limit) != self.limit}


def ttc_s(game: Game, alert: State) -> Extreme:
    """Least time to collision, gap / closing speed, at the alert and at all decisions before a pair's first impact; 60
    s if no gap closes. Without a number: of the line; with the number of a vehicle: of this vehicle and the one behind
    it; critical: whether that of the line is below 1.5 s.
    """
    return Extreme(time_to_collision_s, np.minimum, CRITICAL_S, alert)


def drac_mps2(game: Game, alert: State) -> Extreme:
    """Largest deceleration required to avoid a collision (DRAC), closing speed^2 / (2 gap), at the alert and at all
    decisions before a pair's first impact; large where a collision follows. Without a number: of the line; with the
    number of a vehicle: of the one behind it; critical: whether that of the line is above 3.4 m/s2.
    """
    return Extreme(required_mps2, np.maximum, CRITICAL_MPS2, alert)


def whose_front(game: Game, alert: State, last: State) -> MeasureValue:
    """Total harm of rear-end impacts of the learners. strikes: with their fronts, against the vehicle or obstacle
    ahead; struck: at their rears, by the vehicle behind.
    """
    pairs = last.pair_harm("total")
    obstacle = last.harm("total") - pairs.sum(axis=1)
    harm = np.column_stack([obstacle, pairs, np.zeros(last.n)])  # column b - 1: vehicle b strikes; b: it is struck
    bodies = game.settings.learners
    return {"strikes": harm[:, bodies - 1].sum(axis=1), "struck": harm[:, bodies].sum(axis=1)}


TTC = Part(
    watch=ttc_s, unit="s",
    statistics=(Statistic("ttc_critical_rate", "rate", "TTC < 1.5 s", "TTC\n< 1.5 s", "critical"),),
)  # fmt: skip
DRAC = Part(
    watch=drac_mps2, unit="m/s2",
    statistics=(Statistic("drac_critical_rate", "rate", "DRAC > 3.4 m/s2", "DRAC\n> 3.4", "critical"),),
)  # fmt: skip
WHOSE_FRONT = Part(
    whose_front, unit="m2/s2",
    statistics=(
        Statistic("strikes", "mean", "Strikes ahead", "Strikes\nahead", "strikes"),
        Statistic("struck", "mean", "Is struck behind", "Struck\nbehind", "struck"),
    ),
)  # fmt: skip
