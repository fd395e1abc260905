"""A batch watched closely: many short steps, and what its motion did in each."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ethbrake_marl.physics import Bools, Worlds, advance
from tests.physics.measures import energy_rise_eps
from tests.physics.random_worlds import driving_lines
from tests.reference.tolerances import ENERGY_EPS

STEADY_MPS = 1e-12  # a step is steady when the speed at its middle is this near to the mean of its ends


class Watched:
    """Random lines in steps of two halves.

    ``worst``: largest difference, in steady steps without impacts, between a stored gap and the one that follows from
    the speeds alone (by Simpson's rule, exact there, and never clipped at 0), or its depth below 0. [m]
    """

    def __init__(self, key: int, n: int, N: int, *, drive: bool, steps: int = 300, horizon_s: float = 6.0) -> None:
        self.start, self.command = driving_lines(key, n, N, drive=drive)
        self.states, self.impacts, self.worst, self.checked = [self.start], [], 0.0, 0
        edges = np.linspace(0.0, horizon_s, 2 * steps + 1)
        for a, b in zip(edges[1::2], edges[2::2], strict=True):
            middle, first = advance(self.states[-1], self.command, until_s=a)
            end, second = advance(middle, self.command, until_s=b)
            self.impacts.append((first.count + second.count).sum(axis=1))
            self._check_gaps(self.states[-1], middle, end)
            self.states.append(end)

    def _check_gaps(self, a: Worlds, b: Worlds, c: Worlds) -> None:
        bend = np.abs(a.speeds_mps - 2.0 * b.speeds_mps + c.speeds_mps).max(axis=1)
        steady: Bools = (bend < STEADY_MPS) & (self.impacts[-1] == 0)
        opening = [w.speeds_mps[:, :-1] - w.speeds_mps[:, 1:] for w in (a, b, c)]
        span = (c.time_s - a.time_s)[:, None]
        unclipped = a.gaps_m + span * (opening[0] + 4.0 * opening[1] + opening[2]) / 6.0
        self.worst = max(self.worst, float(np.abs(unclipped - c.gaps_m)[steady].max()), float(-unclipped[steady].min()))
        self.checked += int(steady.sum())

    def energy_rises(self) -> int:
        """Steps in which the energy of a line that nobody drives rose: by more than ENERGY_EPS for each impact."""
        steps = zip(pairwise(self.states), self.impacts, strict=True)
        return sum(int((energy_rise_eps(a, b) > ENERGY_EPS * np.maximum(k, 1)).sum()) for (a, b), k in steps)

    def unexplained_negative_speeds(self) -> int:
        """Negative speeds that no bounce-back explains, or that brakes do not bring towards 0."""
        found = 0
        for (a, b), impacts in zip(pairwise(self.states), self.impacts, strict=True):
            back = b.speeds_mps < 0.0
            bounced = np.zeros(back.shape, bool)
            bounced[:, :-1] |= b.pair_hit
            bounced[:, 1:] |= b.pair_hit
            bounced &= b.vehicles.restitution[:, None] > 0.0
            sinking = (impacts == 0)[:, None] & (b.speeds_mps < a.speeds_mps - STEADY_MPS)
            found += int((back & (~bounced | sinking)).sum())
        return found
