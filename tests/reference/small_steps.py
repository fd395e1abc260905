"""Brakes that build up, by small steps of time: slow, approximate, and written from the law alone.

In each step the force of a vehicle moves towards its command; touching vehicles of equal speed share accelerations by
the min-max formula of isotonic regression; speeds stop at 0 and at the limit; then pairs that overlap and approach
exchange speeds. It shares no code with the package. Errors are of the order of the step.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

TOUCH_MPS, PLASTIC_MPS = 1e-5, 0.05


@numba.njit(cache=False)
def _nearest_to_rest(low: float, high: float) -> float:
    return low if low > 0.0 else (high if high < 0.0 else 0.0)


@numba.njit(cache=False)
def _regression(low: Floats, high: Floats, mass: Floats, first: int, last: int, value: Floats) -> None:
    """``value[i] = min over a <= i of max over b >= i of the mean of a..b``: nobody is above the one before."""
    for i in range(first, last + 1):
        least = math.inf
        for a in range(first, i + 1):
            most = -math.inf
            for b in range(i, last + 1):
                heavy, m, lows, highs = False, 0.0, 0.0, 0.0
                for j in range(a, b + 1):
                    if mass[j] == math.inf:
                        heavy = True
                    else:
                        m += mass[j]
                        lows += mass[j] * low[j]
                        highs += mass[j] * high[j]
                mean = 0.0 if heavy else _nearest_to_rest(lows / m, highs / m)
                most = max(most, mean)
            least = min(least, most)
        value[i] = least


@numba.njit(cache=False)
def run(  # noqa: C901
    gap: Floats, speed: Floats, force: Floats, command: Floats, latency: Floats, mass: Floats, limit: Floats,
    brake_rate: Floats, release_rate: Floats, restitution: float, start_s: float, until_s: float, step_s: float,
    first_harm: Floats, total_harm: Floats,
) -> None:  # fmt: skip
    """One world of N vehicles from ``start_s`` to ``until_s`` in place; mass is infinite for an obstacle in front."""
    N = speed.shape[0]
    low, high, value = np.zeros(N), np.zeros(N), np.zeros(N)
    steps = round((until_s - start_s) / step_s)
    for n in range(steps):
        time = start_s + n * step_s
        for i in range(N):
            wanted = command[i] if latency[i] <= time + 0.5 * step_s else 0.0
            before = force[i]
            if wanted < before:
                force[i] = max(before - brake_rate[i] * step_s, wanted)
            elif wanted > before:
                force[i] = min(before + release_rate[i] * step_s, wanted)
            f, v = 0.5 * (before + force[i]), speed[i]
            if math.isinf(brake_rate[i]) or math.isinf(release_rate[i]):
                f = force[i]
            low[i] = high[i] = 0.0
            if f < 0.0:
                low[i] = -f if v < 0.0 else f
                high[i] = f if v > 0.0 else -f
            elif f > 0.0 and v < limit[i]:
                low[i] = high[i] = f
            elif f > 0.0 and v == limit[i]:
                high[i] = f
        first = 0
        while first < N:
            last = first
            while last < N - 1 and gap[last] <= 0.0 and speed[last] == speed[last + 1]:
                last += 1
            _regression(low, high, mass, first, last, value)
            first = last + 1
        for p in range(N - 1):
            rear, front = speed[p + 1] + 0.5 * value[p + 1] * step_s, speed[p] + 0.5 * value[p] * step_s
            if not (gap[p] <= 0.0 and speed[p] == speed[p + 1] and value[p] == value[p + 1]):
                gap[p] -= (rear - front) * step_s
        for i in range(N):
            after = speed[i] + value[i] * step_s
            if (speed[i] > 0.0 > after) or (speed[i] < 0.0 < after):
                after = 0.0
            if force[i] > 0.0 and (speed[i] < limit[i] < after or speed[i] > limit[i] > after):
                after = limit[i]
            speed[i] = after
        for p in range(N - 1):  # a body keeps one speed
            if gap[p] <= 0.0 and value[p] == value[p + 1] and abs(speed[p] - speed[p + 1]) < 1e-9:
                speed[p + 1] = speed[p]
        _impacts(gap, speed, mass, restitution, value, first_harm, total_harm)


@numba.njit(cache=False)
def _impacts(
    gap: Floats, speed: Floats, mass: Floats, restitution: float, value: Floats, first_harm: Floats, total_harm: Floats
) -> None:
    N = speed.shape[0]
    for _ in range(1000):
        again = False
        first = 0
        while first < N - 1:
            last, largest = first, 0.0
            while last < N - 1 and gap[last] <= 0.0:
                closing = speed[last + 1] - speed[last]
                largest = max(largest, closing)
                if closing > TOUCH_MPS:
                    total_harm[last] += closing * closing
                    if first_harm[last] < 0.0:
                        first_harm[last] = closing * closing
                gap[last] = 0.0
                last += 1
            if largest > 0.0:
                again = True
                bounce = restitution if largest >= PLASTIC_MPS else 0.0
                _regression(speed, speed, mass, first, last, value)
                for i in range(first, last + 1):
                    speed[i] = value[i] + bounce * (value[i] - speed[i])
                if bounce == 0.0:
                    for i in range(first + 1, last + 1):
                        speed[i] = min(speed[i], speed[i - 1])
            first = last + 1
        if not again:
            return
