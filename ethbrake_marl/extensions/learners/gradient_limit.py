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
    """Return the limit to which large gradients are reduced, so that the sum of all sizes falls by ``share``.

    ``sizes`` [n] are absolute gradients. For example, reducing ``[1, 1, 4]`` to at most 2 lowers the sum 6 to 4, so 2
    is the limit for the share 1/3.
    """
    rising = np.sort(sizes)
    remaining = (
        np.cumsum(rising) + np.arange(len(rising) - 1, -1, -1) * rising
    )  # sum of all sizes if the limit is each size in turn
    return float(np.interp((1.0 - share) * remaining[-1], remaining, rising))


def smallest_offset(measured: Floats, least: float, most: float) -> float:
    """Return the smallest offset (change of an action) with which gradients should be measured.

    Where harm jumps, gradients scatter more the smaller the offset; where harm is smooth, they do not. So the result is
    the offset at which their root mean square is expected to be ``SPREAD`` times as large as at ``most``. It is limited
    to ``most / NARROWEST``, and is never below ``least``. If gradients do not scatter more at small offsets, it is
    ``least``.

    Args:
        measured: [n, 2] absolute value of each measured gradient, and the offset with which it was measured (0: no
            measurement yet). The smaller half of the offsets is compared with the larger half.
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
