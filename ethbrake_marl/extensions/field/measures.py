"""Measures of the literature: least time to collision, largest deceleration required, and whose front struck."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ethbrake_marl.episode.departures import BRAKES_EXACTLY
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State, require
from ethbrake_marl.episode.step import Step
from ethbrake_marl.evaluation.measures import MeasureValue, Statistic
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.registry import Part

FREE_S = 60.0  # time to collision that counts for a gap that does not close, and the largest one
CRITICAL_S = 1.5  # a shorter time to collision is critical (van der Horst and Hogema 1993)
CRITICAL_MPS2 = 3.4  # more than the comfortable deceleration of AASHTO's Green Book is critical


def approach(state: State) -> tuple[Floats, Floats]:
    """1 / (time to collision), 1/s, and deceleration required, m/s2, of each pair, [n, N - 1] each.

    0 if the gap does not close, or after an impact of the pair.
    """
    closing = np.maximum(state.speeds_mps[:, 1:] - state.speeds_mps[:, :-1], 0.0)
    is_open = ~state.pair_hit & (state.gaps_m > 0.0)
    rate = np.where(is_open, closing / np.where(is_open, state.gaps_m, 1.0), 0.0)
    return rate, 0.5 * closing * rate


class Closest:
    """Largest value of ``approach`` of each pair at the alert and at all decisions (a ``Watch``)."""

    def __init__(self, row: int, limit: float, shown: Callable[[Floats], Floats], alert: State) -> None:
        self.row, self.limit, self.shown, self.value = row, limit, shown, approach(alert)[row]

    def see(self, before: State, step: Step | None, after: State) -> None:
        self.value = np.maximum(self.value, approach(after)[self.row])

    def result(self, last: State) -> MeasureValue:
        line = self.value.max(axis=1)
        pairs = {f"{i + 1}": self.shown(column) for i, column in enumerate(self.value.T)}
        return {"": self.shown(line), **pairs, "critical": line > self.limit}


def ttc_s(game: Game, alert: State) -> Closest:
    """Least time to collision, gap / closing speed, at the alert and at all decisions before a pair's first impact; 60
    s if no gap closes. Without a number: of the line; with the number of a vehicle: of this vehicle and the one behind
    it; critical: whether that of the line is below 1.5 s.
    """
    require(alert, "time to collision", BRAKES_EXACTLY)
    return Closest(0, 1.0 / CRITICAL_S, lambda rate: 1.0 / np.maximum(rate, 1.0 / FREE_S), alert)


def drac_mps2(game: Game, alert: State) -> Closest:
    """Largest deceleration required to avoid a collision (DRAC), closing speed^2 / (2 gap), at the alert and at all
    decisions before a pair's first impact; large where a collision follows. Without a number: of the line; with the
    number of a vehicle: of the one behind it; critical: whether that of the line is above 3.4 m/s2.
    """
    require(alert, "required deceleration", BRAKES_EXACTLY)
    return Closest(1, CRITICAL_MPS2, np.asarray, alert)


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
