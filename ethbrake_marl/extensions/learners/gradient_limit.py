"""``gradient_limit: auto``: the limit and the smallest offset follow the gradients measured last."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.physics.elementary import exp, log
from ethbrake_marl.physics.state import Floats

# ``gradient_limit: auto``: limit and smallest offset follow the gradients that were measured last.

REMEMBERED = 65_536  # measured gradients

CUT = 0.1  # share of the sum of their sizes that the limit cuts

SPREAD = 2.0  # at the smallest offset the spread of gradients is at most so many times that at the largest

NARROWEST = 4.0  # but offsets are drawn from a range at least so wide


def limit_that_cuts(sizes: Floats, share: float) -> float:
    """The limit at which cutting takes this share of the sum of these sizes [n]."""
    rising = np.sort(sizes)
    kept = np.cumsum(rising) + np.arange(len(rising) - 1, -1, -1) * rising  # of the sum, by each of them as the limit
    return float(np.interp((1.0 - share) * kept[-1], kept, rising))


def smallest_offset(measured: Floats, least: float, most: float) -> float:
    """The smallest offset to draw: ``least``, or more where the spread of gradients falls steeply with the offset.

    A jump of the harm makes the spread fall as the root of the offset, a smooth harm leaves it as it is. The slope is
    that between the smaller and the larger half of the offsets of ``measured`` [n, 2], sizes and offsets (0: none yet).
    """
    known = measured[measured[:, 1] > 0.0]
    halves = np.array_split(known[np.argsort(known[:, 1], kind="stable")], 2)
    if not all(half[:, 0].any() for half in halves):
        return least
    near, far = (log(float(np.mean(half[:, 0] * half[:, 0]))) / 2.0 for half in halves)
    apart = log(float(np.median(halves[1][:, 1]) / np.median(halves[0][:, 1])))
    lower = exp(-log(SPREAD) * apart / (near - far)) if near > far else 0.0
    return max(least, most * min(lower, 1.0 / NARROWEST))
