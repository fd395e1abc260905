"""Operations on samples, which are decelerations with their simulated harm: sort, merge, estimate, select. Compiled.

The search for the best deceleration uses about 560 samples per world, sorted by deceleration.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.state import Floats, Ints

STEEPER = 2.0  # assumption: between two samples, harm falls at most this many times as fast as beside them

NARROWEST_MPS2 = 1e-9  # decelerations closer than this count as equal

TIE = 1e-9  # harms (m2/s2) closer than this count as equal


class Samples(NamedTuple):
    """Decelerations of one vehicle in one world, with the simulated harm of each deceleration."""

    at: Floats  # [k] decelerations (m/s2)
    harm: Floats  # [k] harm that is minimised, first-impact or total (m2/s2)
    other: Floats  # [k] harm under the other count, which decides ties (m2/s2)
    course: Floats  # [k] code of the number of impacts of each pair; where the code changes, the harm may jump


@compiled
def make_samples(most: int) -> Samples:
    """Return arrays for at most ``most`` samples. The values of the arrays are not yet set."""
    return Samples(np.empty(most), np.empty(most), np.empty(most), np.empty(most))


@compiled(bare=True)
def copy_sample(one: Samples, k: int, other: Samples, to: int) -> None:
    """Copy sample ``k`` of ``one`` to the index ``to`` in ``other``."""
    other.at[to] = one.at[k]
    other.harm[to] = one.harm[k]
    other.other[to] = one.other[k]
    other.course[to] = one.course[k]


@compiled(bare=True)
def merge(one: Samples, n: int, other: Samples, m: int, into: Samples) -> None:
    """Merge the first ``n`` samples of ``one`` with the first ``m`` of ``other``; both are sorted by deceleration.

    The first ``n + m`` samples of ``into`` are overwritten with the result, which is sorted as well.
    """
    i, j = 0, 0
    for to in range(n + m):
        if j == m or (i < n and one.at[i] <= other.at[j]):
            copy_sample(one, i, into, to)
            i += 1
        else:
            copy_sample(other, j, into, to)
            j += 1


@compiled(bare=True)
def put_in_order(samples: Samples, n: int) -> None:
    """Sort the first ``n`` samples by deceleration, in place. Sorting is fast for few or nearly sorted samples."""
    for k in range(1, n):
        at, harm, other, course = samples.at[k], samples.harm[k], samples.other[k], samples.course[k]
        to = k
        while to > 0 and samples.at[to - 1] > at:
            copy_sample(samples, to - 1, samples, to)
            to -= 1
        samples.at[to], samples.harm[to], samples.other[to], samples.course[to] = at, harm, other, course


@compiled(bare=True)
def bound_cells(samples: Samples, n: int, bounds: Floats) -> None:
    """Estimate the least harm in each interval between two neighbouring samples; write it to ``bounds`` [n - 1], m2/s2.

    The first ``n`` samples are used; they must be sorted by deceleration. If the harm falls towards an interval from
    one side, the harm is assumed to go on falling inside the interval, at most ``STEEPER`` times as steeply as outside.
    """
    before, slope = 0.0, _slope(samples, 0)
    for k in range(n - 1):
        after = _slope(samples, k + 1) if k < n - 2 else 0.0
        reach = STEEPER * (samples.at[k + 1] - samples.at[k])
        from_left = samples.harm[k] + reach * min(before, 0.0)
        from_right = samples.harm[k + 1] - reach * max(after, 0.0)
        bounds[k] = min(from_left, from_right)
        before, slope = slope, after


@compiled(bare=True)
def _slope(samples: Samples, k: int) -> float:
    """Return the slope of the harm between samples ``k`` and ``k + 1``, m2/s2 per m/s2."""
    width = samples.at[k + 1] - samples.at[k]
    return float((samples.harm[k + 1] - samples.harm[k]) / max(width, NARROWEST_MPS2))


@compiled(bare=True)
def least_harm(samples: Samples, n: int) -> float:
    """Return the smallest harm among the first ``n`` samples, m2/s2."""
    least = math.inf
    for k in range(n):
        least = min(least, samples.harm[k])
    return least


@compiled(bare=True)
def find_smallest(values: Floats, n: int, places: Ints) -> None:
    """Write the indices of the smallest of the first ``n`` entries of ``values`` to ``places``, smallest entry first.

    As many indices are written as ``places`` has entries, at most ``n``. Of equal values, the one with the lower index
    comes first.
    """
    count = 0
    for k in range(n):
        if count == places.shape[0] and not values[k] < values[places[count - 1]]:
            continue
        to = count if count < places.shape[0] else count - 1
        while to > 0 and values[places[to - 1]] > values[k]:
            places[to] = places[to - 1]
            to -= 1
        places[to] = k
        count = min(count + 1, places.shape[0])


@compiled(bare=True)
def find_minima(samples: Samples, n: int, depth: Floats, places: Ints) -> None:
    """Write to ``places`` the indices of the lowest local minima among the first ``n`` samples, lowest harm first.

    ``depth`` [n or more] receives the harm at each local minimum, and infinity at all other samples. If there are fewer
    local minima than entries in ``places``, the remaining entries are indices of other samples.
    """
    for k in range(n):
        falls = k == 0 or samples.harm[k] < samples.harm[k - 1]
        rises = k == n - 1 or samples.harm[k] <= samples.harm[k + 1]
        depth[k] = samples.harm[k] if falls and rises else math.inf
    find_smallest(depth, n, places)


@compiled(bare=True)
def choose(samples: Samples, n: int, room: Floats) -> float:
    """Return the deceleration (m/s2) with the least harm among the first ``n`` samples.

    Of several samples with the least harm, those with the least harm under the other harm count (``other``) remain, and
    the middle one of these is returned. ``room`` [n or more] is an array for intermediate results. The function is
    faster if the samples are sorted.
    """
    least, rest = least_harm(samples, n) + TIE, math.inf
    for k in range(n):
        if samples.harm[k] <= least:
            rest = min(rest, samples.other[k])
    rest += TIE
    good = 0
    for k in range(n):
        if samples.harm[k] <= least and samples.other[k] <= rest:
            to = good
            while to > 0 and room[to - 1] > samples.at[k]:
                room[to] = room[to - 1]
                to -= 1
            room[to] = samples.at[k]
            good += 1
    return float(room[(good - 1) // 2])
