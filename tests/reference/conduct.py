"""Who bears a push, and which speed is a vehicle's own: from samples of its motion, by the words of docs/physics.md.

Shares nothing with ``motion``: between two samples forces count as constant, and every sum is a Riemann sum. The motion
and the push of every pair are given.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
SAME = 1e-9


class Samples(NamedTuple):
    """One line at T + 1 times, and its vehicles; index 0 is the front vehicle, and of pairs that with the obstacle."""

    times: Floats  # [T + 1] s
    speeds: Floats  # [T + 1, N] m/s
    forces: Floats  # [T + 1, N] m/s2
    gaps: Floats  # [T + 1, N] m
    pushed: Floats  # [T + 1, N] m/s
    impacts: Floats  # [T + 1, N]
    mass: Floats  # [N] t
    capacity: Floats  # [N] m/s2
    latency: Floats  # [N] s
    limit: Floats  # [N] m/s


class Bearing(NamedTuple):
    answered: Floats  # [N] m/s
    shared: Floats  # [N] m/s
    own_speed: Floats  # [N] m/s at the end, without what contacts have given


def own_acceleration(force: float, speed: float, limit: float) -> float:
    """Acceleration of a vehicle alone."""
    if force > 0.0:
        return force if speed < limit - SAME else 0.0
    return force if speed > 0.0 else -force if speed < 0.0 else 0.0


def together(first: int, last: int, own: list[float], at: Any, k: int) -> float:
    """Acceleration of the vehicles ``first..last`` if they were one."""
    mass = at.mass[first : last + 1]
    if abs(at.speeds[k, last]) > 0.0 or max(at.forces[k, first : last + 1]) <= 0.0:
        return float((mass * own[first : last + 1]).sum() / mass.sum())
    return float(max((mass * at.forces[k, first : last + 1]).sum() / mass.sum(), 0.0))  # brakes hold at rest


def bearing(at: Samples) -> Bearing:
    """Who bears the pushes of one line."""
    N = len(at.mass)
    answered, shared, given = np.zeros(N), np.zeros(N), np.zeros(N)
    eased = np.zeros(N, bool)
    for k in range(len(at.times) - 1):
        h = at.times[k + 1] - at.times[k]
        acts = (at.latency <= 0.0) | (at.latency < at.times[k + 1] - SAME)
        full = acts & (at.forces[k + 1] <= SAME - at.capacity)
        eases = eased | ~full
        struck = at.impacts[k + 1] > at.impacts[k]
        touching = struck | (at.gaps[k] <= SAME) | (at.gaps[k + 1] <= SAME)
        middle = 0.5 * (at.forces[k] + at.forces[k + 1])
        own = [own_acceleration(middle[i], at.speeds[k, i], at.limit[i]) for i in range(N)]
        for p in np.flatnonzero(at.pushed[k + 1] > at.pushed[k]).tolist():  # vehicle p, and what is ahead of it
            push = at.pushed[k + 1, p] - at.pushed[k, p]
            first = last = p
            while first > 0 and touching[first]:
                first -= 1
            while last + 1 < N and touching[last + 1]:
                last += 1
            parts = np.zeros(N)
            if struck[p]:
                pressing = [i for i in range(p + 1, last + 1) if eases[i]]
                pressing = [p] if eases[p] else pressing
                for i in pressing:
                    parts[i] = push / len(pressing)
            else:
                ahead = min([together(i, p - 1, own, at, k) for i in range(first, p)], default=0.0)
                ahead = min(ahead, 0.0) if first == 0 and touching[0] else ahead
                part = min(max(own[p] - ahead, 0.0) * h, push)
                parts[p] = 0.0 if full[p] else part
                level, reach = max(own[p], ahead), range(p, last + 1)
                best = max(reach, key=lambda j: together(p, j, own, at, k))
                excess = [at.mass[j] * max(own[j] - level, 0.0) for j in range(p + 1, best + 1)]
                for j, each in zip(range(p + 1, best + 1), excess, strict=True):
                    parts[j] = 0.0 if full[j] or sum(excess) == 0.0 else (push - part) * each / sum(excess)
            left = push - parts.sum()
            backward = at.speeds[k, max(p - 1, 0)] < 0.0
            easing = [i for i in range(first, last + 1) if eases[i]] if backward else []
            for i in easing:
                parts[i] += left / len(easing)
            answered += parts
            if not easing:
                shared[first : last + 1] += left / (last + 1 - first)
        eased |= acts & ~full
        eased[struck] = (acts & ~full)[struck]
        by_contacts = at.speeds[k + 1] - at.speeds[k] - np.array(own) * h
        given = np.minimum(np.maximum(given + by_contacts, 0.0), np.maximum(at.speeds[k + 1], 0.0))
    return Bearing(answered, shared, np.maximum(at.speeds[-1], 0.0) - given)
