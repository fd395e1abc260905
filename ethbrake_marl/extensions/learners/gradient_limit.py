"""``gradient_limit: auto``: derive the gradient limit and the smallest offset from recently measured gradients."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.physics.elementary import exp, log
from ethbrake_marl.physics.state import Floats

REMEMBERED = 65_536  # number of measured gradients in memory

CUT = 0.1  # share of the sum of gradient sizes that the limit removes

SPREAD = 2.0  # largest ratio of the spread of gradients at the smallest offset to the spread at the largest

NARROWEST = 4.0  # least ratio of the largest to the smallest offset, which takes precedence over SPREAD


def limit_that_cuts(sizes: Floats, share: float) -> float:
    """Return the limit for gradient sizes [n] such that cutting larger ones to it removes ``share`` of their sum."""
    rising = np.sort(sizes)
    kept = (
        np.cumsum(rising) + np.arange(len(rising) - 1, -1, -1) * rising
    )  # remaining sum if the limit is each size in turn
    return float(np.interp((1.0 - share) * kept[-1], kept, rising))


def smallest_offset(measured: Floats, least: float, most: float) -> float:
    """Return the smallest offset of an action to draw when gradients are measured.

    It is ``least``, or more if the spread of gradients falls steeply with the offset.

    Where harm jumps, the spread falls with the square root of the offset; where harm is smooth, it is constant. The
    slope is measured between the smaller and the larger half of the offsets.

    Args:
        measured: [n, 2] sizes of measured gradients, and the offsets with which they were measured (0: no measurement
            yet).
        least: lower end of the range of offsets.
        most: upper end of the range of offsets.

    """
    known = measured[measured[:, 1] > 0.0]
    halves = np.array_split(known[np.argsort(known[:, 1], kind="stable")], 2)
    if not all(half[:, 0].any() for half in halves):
        return least
    near, far = (log(float(np.mean(half[:, 0] * half[:, 0]))) / 2.0 for half in halves)
    apart = log(float(np.median(halves[1][:, 1]) / np.median(halves[0][:, 1])))
    lower = exp(-log(SPREAD) * apart / (near - far)) if near > far else 0.0
    return max(least, most * min(lower, 1.0 / NARROWEST))
