"""The motion of a line in small steps: a simulator that shares no formula with the package, to test ``motion``.

Every step solves one convex problem (Moreau's time stepping). Bodies of mass m and speed v, free forces included, get
the speeds x that minimise ``sum m (x - v)^2 / 2 + sum phi(x)`` where no body may be faster than a touching one in
front. The potential phi of a brake of force b is ``h m b |x|`` (dry friction), of an engine of force f with the limit L
it is ``-h m f min(x, L)``. The minimum is an isotonic regression, whose blocks minimise their own sum. A step in which
a gap would close, or a speed reaches or leaves 0 or its limit, is cut at that moment: the error is of order ``h^2``.
"""

from __future__ import annotations

from itertools import pairwise
from math import ceil, inf
from typing import Any, NamedTuple

import numba
import numpy as np

from ethbrake_marl.motion.compiling import _Cache

TOUCH_MPS, PLASTIC_MPS = 1e-5, 0.05
SAME_MPS = 1e-9  # closing speeds below this are rounding
LEAST_S = 1e-9  # a speed that leaves 0 or its limit does so in a step of this length
ALIKE_MPS = 1e-12  # touching bodies whose speeds differ by less move as one: rounding does not part them


class Line(NamedTuple):
    """One world; index 0 of vehicles is the front one, gap 0 that to the obstacle (infinite: none)."""

    gaps: Any  # [N] m
    speeds: Any  # [N] m/s
    forces: Any  # [N] m/s2
    mass: Any  # [N] t
    limit: Any  # [N] m/s
    latency: Any  # [N] s
    brake_rate: Any  # [N] m/s3
    release_rate: Any  # [N] m/s3
    restitution: float


def compiled(function: Any) -> Any:
    """Compile a function, and store it by content, so that every clone of the repository uses it."""
    kernel = numba.njit(no_cfunc_wrapper=True)(function)
    kernel._cache = _Cache(function)
    return kernel


@compiled
def rest_of_block(mass, speeds, forces, limit, h, i, j):
    """The speed that minimises the sum of the bodies i to j."""
    momentum, weight = 0.0, 0.0
    for k in range(i, j + 1):
        momentum += mass[k] * speeds[k]
        weight += mass[k]
    for k in range(i, j + 1):  # is the minimum at a kink?
        kink = 0.0 if forces[k] < 0.0 else limit[k]
        below, above = weight * kink - momentum, weight * kink - momentum
        for q in range(i, j + 1):
            at = 0.0 if forces[q] < 0.0 else limit[q]
            size = h * mass[q] * abs(forces[q])
            falls = -size
            rises = size if forces[q] < 0.0 else 0.0
            below += falls if kink <= at else rises
            above += rises if kink >= at else falls
        if below <= 0.0 <= above:
            return kink
    best, least = 0.0, np.inf
    for k in range(i - 1, j + 1):  # between two kinks: the slopes are those just above kink k
        at = -np.inf if k < i else (0.0 if forces[k] < 0.0 else limit[k])
        push = 0.0
        for q in range(i, j + 1):
            kink = 0.0 if forces[q] < 0.0 else limit[q]
            size = h * mass[q] * abs(forces[q])
            push += (size if forces[q] < 0.0 else 0.0) if at >= kink else -size
        x = (momentum - push) / weight
        wrong = 0.0
        for q in range(i, j + 1):
            kink = 0.0 if forces[q] < 0.0 else limit[q]
            wrong = max(wrong, kink - x if at >= kink else x - kink)
        if wrong < least:
            best, least = x, wrong
    return best


@compiled
def regression(gaps, mass, speeds, forces, limit, h, out):
    """Speeds after a step of ``h`` (0: the speeds of a plastic impact): pools of touching bodies, front to rear."""
    n = len(speeds)
    heads, values = np.zeros(n + 1, np.int64), np.zeros(n + 1)
    count = 0
    for k in range(n):
        heads[count], values[count] = k, rest_of_block(mass, speeds, forces, limit, h, k, k)
        if gaps[k] <= 0.0 and k == 0 and values[count] > 0.0:
            values[count] = 0.0
        while count > 0 and gaps[heads[count]] <= 0.0 and values[count] > values[count - 1] - ALIKE_MPS:
            count -= 1
            values[count] = rest_of_block(mass, speeds, forces, limit, h, heads[count], k)
            if heads[count] == 0 and gaps[0] <= 0.0 and values[count] > 0.0:
                values[count] = 0.0
        count += 1
    for block in range(count):
        for k in range(heads[block], heads[block + 1] if block + 1 < count else n):
            out[k] = values[block]


@compiled
def impacts(gaps, mass, speeds, limit, restitution, book):
    """Resolve impacts, round after round; ``book`` [6, N]: hit, first harm, total, count, push, closing by forces."""
    n = len(speeds)
    closing, pooled, nothing = np.zeros(n), np.zeros(n), np.zeros(n)
    for _ in range(100_000):
        largest = 0.0
        for p in range(n):
            closing[p] = speeds[p] - (speeds[p - 1] if p > 0 else 0.0) if gaps[p] <= 0.0 else 0.0
            if gaps[p] <= 0.0 and closing[p] <= SAME_MPS:
                book[5, p] = closing[p]
            largest = max(largest, closing[p])
        if largest <= SAME_MPS:
            return
        regression(gaps, mass, speeds, nothing, limit, 0.0, pooled)
        head = 0
        for k in range(n):
            if k + 1 == n or gaps[k + 1] > 0.0:
                largest = 0.0
                for p in range(head, k + 1):
                    if p > head or (p == 0 and gaps[0] <= 0.0):
                        largest = max(largest, closing[p])
                e = restitution if largest >= PLASTIC_MPS else 0.0
                for i in range(head, k + 1):
                    if largest > 0.0:
                        speeds[i] = (1.0 + e) * pooled[i] - e * speeds[i]
                head = k + 1
        for p in range(n):
            if closing[p] > TOUCH_MPS:
                harm = closing[p] * closing[p]
                if book[0, p] == 1.0 and book[5, p] > 0.0:
                    apart = (speeds[p - 1] if p > 0 else 0.0) - speeds[p]
                    book[4, p] += min(book[5, p] / closing[p], 1.0) * (closing[p] + apart)
                book[1, p] += harm if book[0, p] == 0.0 else 0.0
                book[0, p] = 1.0
                book[2, p] += harm
                book[3, p] += 1.0


MASS, LIMIT, BRAKE_RATE, RELEASE_RATE = range(4)  # rows of `car`
GAP, SPEED, FORCE, MEAN = range(4)  # rows of `now` and of what comes next; mean force of the step


@compiled
def build_up(now, wanted, car, h, new):
    """The forces after a step of ``h``, and their means."""
    for k in range(len(wanted)):
        rate = car[BRAKE_RATE, k] if wanted[k] < now[FORCE, k] else car[RELEASE_RATE, k]
        way = wanted[k] - now[FORCE, k]
        if rate == np.inf or way == 0.0:
            new[FORCE, k] = new[MEAN, k] = wanted[k]
        elif abs(way) <= rate * h:
            new[FORCE, k] = wanted[k]
            new[MEAN, k] = wanted[k] - 0.5 * way * abs(way) / (rate * h)
        else:
            new[FORCE, k] = now[FORCE, k] + (rate if way > 0.0 else -rate) * h
            new[MEAN, k] = 0.5 * (now[FORCE, k] + new[FORCE, k])


@compiled
def trial(now, wanted, car, h, new):
    """One step of ``h``; return the smallest new gap."""
    build_up(now, wanted, car, h, new)
    regression(now[GAP], car[MASS], now[SPEED], new[MEAN], car[LIMIT], h, new[SPEED])
    least = np.inf
    for k in range(len(wanted)):
        way = 0.5 * (now[SPEED, k] + new[SPEED, k]) * h
        ahead = 0.5 * (now[SPEED, k - 1] + new[SPEED, k - 1]) * h if k > 0 else 0.0
        new[GAP, k] = now[GAP, k] + (ahead - way)
        if now[GAP, k] <= 0.0 and new[SPEED, k] == (new[SPEED, k - 1] if k > 0 else 0.0):
            new[GAP, k] = 0.0
        least = min(least, new[GAP, k])
    return least


@compiled
def too_far(now, wanted, car, h, new):
    """Whether a gap closes, or a speed reaches, passes or leaves 0 or its limit, in a step of ``h``."""
    far = trial(now, wanted, car, h, new) < 0.0
    for k in range(len(wanted)):
        for kink in (0.0, car[LIMIT, k]):
            before, after = now[SPEED, k] - kink, new[SPEED, k] - kink
            far = far or (before != 0.0 and before * after <= 0.0)
            far = far or (before == 0.0 and after != 0.0 and h > LEAST_S)
    return far


@compiled
def through(now, wanted, car, restitution, duration, step_s, book):
    """Through an interval without an onset, in place; return False if there are too many steps."""
    new, time, steps = now.copy(), 0.0, 0
    impacts(now[GAP], car[MASS], now[SPEED], car[LIMIT], restitution, book)
    while time < duration:
        steps += 1
        if steps > 50.0 * (duration / step_s + 1000.0):
            return False
        h = min(step_s, duration - time)
        if too_far(now, wanted, car, h, new):
            low, high = 0.0, h
            for _ in range(1100):  # to the last bit
                middle = 0.5 * (low + high)
                if middle in (low, high):
                    break
                if too_far(now, wanted, car, middle, new):
                    high = middle
                else:
                    low = middle
            h = high
            trial(now, wanted, car, h, new)
        pushes(now, new, car, h, book)
        for k in range(len(wanted)):
            ahead = new[SPEED, k - 1] - now[SPEED, k - 1] if k > 0 else 0.0
            book[5, k] += new[SPEED, k] - now[SPEED, k] - ahead
        now[:] = new
        for k in range(len(wanted)):
            now[GAP, k] = max(now[GAP, k], 0.0)
        time += h
        impacts(now[GAP], car[MASS], now[SPEED], car[LIMIT], restitution, book)
    return True


@compiled
def part_alone(mass, speeds, forces, limit, i, j):
    """The acceleration nearest to 0 that friction and engines of the bodies i to j allow at their speeds."""
    weight, low, high = 0.0, 0.0, 0.0
    for k in range(i, j + 1):
        weight += mass[k]
        size = mass[k] * abs(forces[k])
        if forces[k] < 0.0:
            low -= size if speeds[k] >= 0.0 else -size
            high -= size if speeds[k] > 0.0 else -size
        else:
            low += size if speeds[k] < limit[k] else 0.0
            high += size if speeds[k] <= limit[k] else 0.0
    return max(low, 0.0) / weight + min(high, 0.0) / weight


@compiled
def pushes(now, new, car, h, book):
    """Add to ``book`` the closing speed that every contact which lasts takes up: what its two parts would do alone."""
    n = new.shape[1]
    middle, lasts = 0.5 * (now[SPEED] + new[SPEED]), np.zeros(n + 1, np.bool_)  # each vehicle and what is ahead of it
    for k in range(n):
        before, after = (now[SPEED, k - 1], new[SPEED, k - 1]) if k > 0 else (0.0, 0.0)
        lasts[k] = now[GAP, k] <= 0.0 and new[GAP, k] <= 0.0 and new[SPEED, k] == after
        lasts[k] = lasts[k] and abs(now[SPEED, k] - before) <= SAME_MPS
    for k in range(n):
        if lasts[k]:
            behind, end = -np.inf, k
            while end == k or lasts[end]:
                behind = max(behind, part_alone(car[MASS], middle, new[MEAN], car[LIMIT], k, end))
                end += 1
            ahead, start = 0.0 if k == 0 else np.inf, k - 1
            while start >= 0:
                ahead = min(ahead, part_alone(car[MASS], middle, new[MEAN], car[LIMIT], start, k - 1))
                if not lasts[start]:
                    break
                if start == 0:
                    ahead = min(ahead, 0.0)
                start -= 1
            book[4, k] += max(behind - ahead, 0.0) * h


class Outcome(NamedTuple):
    """A world at the end of its run."""

    gaps: Any
    speeds: Any
    forces: Any
    book: Any  # [6, N] hit, first harm, total, count, push, closing speed by forces, of each vehicle and what is ahead
    finished: bool


def simulate(line: Line, times: Any, commands: Any, step_s: float) -> Outcome:
    """Run a line through the intervals between ``times`` [T + 1] under ``commands`` [T, N] in steps of ``step_s``.

    A command acts once the latency has elapsed; what is chosen for an interval that ends at the latency never acts.
    """
    latency = np.array(line.latency)
    now = np.array([line.gaps, line.speeds, line.forces, line.forces], np.float64)
    car = np.array([line.mass, line.limit, line.brake_rate, line.release_rate], np.float64)
    book, finished = np.zeros((6, len(latency))), True
    for (start, end), command in zip(pairwise(times), commands, strict=True):
        for one, other in pairwise(sorted({start, end, *(float(x) for x in latency if start < x < end - 1e-9)})):
            wanted, length = np.where(latency <= one, command, 0.0), other - one
            step = length / max(1, ceil(length / step_s)) * (1.0 + 1e-12)
            finished &= through(now, wanted, car, float(line.restitution), length, step, book)
        now[FORCE] = np.where((latency <= 0.0) | (latency < end - 1e-9), now[FORCE], 0.0)
    return Outcome(now[GAP], now[SPEED], now[FORCE], book, finished)


def infinite_where_far(gap: float) -> float:
    """The gap to an obstacle; infinite where there is none."""
    return gap if gap < 1e299 else inf
