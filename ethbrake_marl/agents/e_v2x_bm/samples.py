"""Samples of one world's harm over decelerations, compiled: joined, bounded between, followed downhill, chosen from.

A world has about 560 of them; they are kept in rising order of the deceleration.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.state import Floats, Ints

STEEPER = 2.0  # the harm between two samples may fall this much faster than beside them

NARROWEST_MPS2 = 1e-9  # decelerations closer than this are not told apart

TIE = 1e-9  # harms (m2/s2) closer than this are one harm


class Samples(NamedTuple):
    """Simulated decelerations of one world, each [k]."""

    at: Floats  # decelerations (m/s2)
    harm: Floats  # under the count that is minimised (m2/s2)
    other: Floats  # under the other count
    course: Floats  # differs where the numbers of impacts differ: there the harm may jump


@compiled
def make_samples(most: int) -> Samples:
    """Room for ``most`` samples."""
    return Samples(np.empty(most), np.empty(most), np.empty(most), np.empty(most))


@compiled(bare=True)
def copy_sample(one: Samples, k: int, other: Samples, to: int) -> None:
    """Copy sample ``k`` to another place."""
    other.at[to] = one.at[k]
    other.harm[to] = one.harm[k]
    other.other[to] = one.other[k]
    other.course[to] = one.course[k]


@compiled(bare=True)
def merge(one: Samples, n: int, other: Samples, m: int, into: Samples) -> None:
    """The first ``n`` and ``m`` of two lists in rising order as one in rising order."""
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
    """Put the first ``n``, few or nearly in order, in rising order."""
    for k in range(1, n):
        at, harm, other, course = samples.at[k], samples.harm[k], samples.other[k], samples.course[k]
        to = k
        while to > 0 and samples.at[to - 1] > at:
            copy_sample(samples, to - 1, samples, to)
            to -= 1
        samples.at[to], samples.harm[to], samples.other[to], samples.course[to] = at, harm, other, course


@compiled(bare=True)
def bound_cells(samples: Samples, n: int, bounds: Floats) -> None:
    """Least harm expected between neighbours of ``n`` samples into ``bounds`` [n - 1].

    The sides that fall into a cell run on, ``STEEPER`` times as fast.
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
    """Of the harm from sample ``k`` to the next one."""
    width = samples.at[k + 1] - samples.at[k]
    return float((samples.harm[k + 1] - samples.harm[k]) / max(width, NARROWEST_MPS2))


@compiled(bare=True)
def least_harm(samples: Samples, n: int) -> float:
    """Of the first ``n``."""
    least = math.inf
    for k in range(n):
        least = min(least, samples.harm[k])
    return least


@compiled(bare=True)
def find_smallest(values: Floats, n: int, places: Ints) -> None:
    """Fill ``places`` with those of the smallest of ``n`` values, in rising order; the first one of equals first."""
    found = 0
    for k in range(n):
        if found == places.shape[0] and not values[k] < values[places[found - 1]]:
            continue
        to = found if found < places.shape[0] else found - 1
        while to > 0 and values[places[to - 1]] > values[k]:
            places[to] = places[to - 1]
            to -= 1
        places[to] = k
        found = min(found + 1, places.shape[0])


@compiled(bare=True)
def find_minima(samples: Samples, n: int, depth: Floats, places: Ints) -> None:
    """Fill ``places`` with the lowest local minima of ``n`` samples, in rising order of the harm.

    ``depth`` [n] receives the harm where there is one, infinity elsewhere. Where there are too few, the rest of the
    places are those of the first samples that are none.
    """
    for k in range(n):
        falls = k == 0 or samples.harm[k] < samples.harm[k - 1]
        rises = k == n - 1 or samples.harm[k] <= samples.harm[k + 1]
        depth[k] = samples.harm[k] if falls and rises else math.inf
    find_smallest(depth, n, places)


@compiled(bare=True)
def choose(samples: Samples, n: int, room: Floats) -> float:
    """Deceleration of least harm; ties by the other count, then the middle one of those that are left.

    ``room`` [n or more] is used up. The first samples may be in rising order, which is faster.
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
