"""Recipe setting ``gradient_limit: auto``: compute the gradient limit and the smallest offset from recent gradients."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.first_edition.physics.elementary import exp, log
from ethbrake_marl.first_edition.physics.state import Floats

REMEMBERED = 65_536  # number of measured gradients in memory

CUT = 0.1  # share of the sum of gradient sizes that the limit removes

SPREAD = 2.0  # ratio: root mean square of gradients at the smallest offset / the same at the largest offset

NARROWEST = 4.0  # least ratio of the largest offset to the smallest; takes precedence over SPREAD


def limit_that_cuts(sizes: Floats, share: float) -> float:
    """Return the limit to which absolute gradients must be clipped so that their sum falls by the fraction ``share``.

    ``sizes`` [n] are the absolute gradients. With ``sizes`` = [1, 1, 4] and ``share`` = 1/3 the limit is 2: clipping at
    2 gives [1, 1, 2], and the sum falls from 6 to 4, by one third.
    """
    rising = np.sort(sizes)
    remaining = (
        np.cumsum(rising) + np.arange(len(rising) - 1, -1, -1) * rising
    )  # sum of all sizes if the limit is each size in turn
    return float(np.interp((1.0 - share) * remaining[-1], remaining, rising))


def smallest_offset(measured: Floats, least: float, most: float) -> float:
    """Return the smallest offset (change of an action) with which gradients should be measured.

    If harm is a smooth function of the action, large and small offsets give similar gradients. If harm is
    discontinuous, smaller offsets give larger gradients. The result is the offset whose gradients are expected to be
    ``SPREAD`` times as large (in root mean square) as the gradients with the largest offset, ``most``. The result is
    limited to the range from ``least`` to ``most / NARROWEST``. If small offsets do not give larger gradients than
    large offsets, the result is ``least``.

    ``measured`` [n, 2] has rows of (absolute gradient, offset with which it was measured); offset 0 means that the row
    is still empty. The gradients measured with the smaller half of the offsets are compared with the gradients measured
    with the larger half. ``least`` and ``most`` are the smallest and the largest offset that the recipe allows.
    """
    known = measured[measured[:, 1] > 0.0]
    halves = np.array_split(known[np.argsort(known[:, 1], kind="stable")], 2)
    if not all(half[:, 0].any() for half in halves):
        return least
    near, far = (log(float(np.mean(half[:, 0] * half[:, 0]))) / 2.0 for half in halves)
    apart = log(float(np.median(halves[1][:, 1]) / np.median(halves[0][:, 1])))
    lower = exp(-log(SPREAD) * apart / (near - far)) if near > far else 0.0
    return max(least, most * min(lower, 1.0 / NARROWEST))
