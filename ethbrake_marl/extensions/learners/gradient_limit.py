"""``gradient_limit: auto``: the limit and the smallest offset follow the gradients measured last."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.physics.elementary import exp, log
from ethbrake_marl.physics.state import Floats

REMEMBERED = 65_536  # measured gradients

CUT = 0.1  # share of the sum of their sizes that the limit cuts

SPREAD = 2.0  # at the smallest offset the spread of gradients is at most so many times that at the largest

NARROWEST = 4.0  # but offsets are drawn from a range at least so wide


def limit_that_cuts(sizes: Floats, share: float) -> float:
    """The limit that removes this share of the sum of the sizes [n]."""
    rising = np.sort(sizes)
    kept = np.cumsum(rising) + np.arange(len(rising) - 1, -1, -1) * rising  # of the sum, by each of them as the limit
    return float(np.interp((1.0 - share) * kept[-1], kept, rising))


def smallest_offset(measured: Floats, least: float, most: float) -> float:
    """The smallest offset to draw: ``least``, or more if the spread of gradients falls steeply with the offset.

    If the harm jumps, the spread falls with the square root of the offset. If the harm is smooth, it stays. The slope
    is taken between the smaller and the larger half of the offsets. ``measured`` [n, 2] holds sizes of gradients and
    their offsets (0: not measured yet).
    """
    known = measured[measured[:, 1] > 0.0]
    halves = np.array_split(known[np.argsort(known[:, 1], kind="stable")], 2)
    if not all(half[:, 0].any() for half in halves):
        return least
    near, far = (log(float(np.mean(half[:, 0] * half[:, 0]))) / 2.0 for half in halves)
    apart = log(float(np.median(halves[1][:, 1]) / np.median(halves[0][:, 1])))
    lower = exp(-log(SPREAD) * apart / (near - far)) if near > far else 0.0
    return max(least, most * min(lower, 1.0 / NARROWEST))
