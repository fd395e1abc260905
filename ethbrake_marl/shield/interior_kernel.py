"""Branch and bound: an upper bound on the harm of a plan over a box, refined where it is largest."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.physics import Floats, Ints
from ethbrake_marl.physics.compiled import compiled_apart
from ethbrake_marl.shield.enclosure import most_harm
from ethbrake_marl.shield.enclosure_impact import Stack, new_stack
from ethbrake_marl.shield.enclosure_motion import Cell, Motion, new_motion
from ethbrake_marl.shield.enclosure_rough import rough_at_alert
from ethbrake_marl.shield.forms import (
    add,
    difference,
    high,
    low,
    negative,
    positive_part,
    product,
    reciprocal,
    square,
)

# groups of the numbers of a box, N of each but P gaps
BRAKING, DRIVING, LATENCY, MASS, SPEED, GAP = range(6)
LONGEST_PIECE_S = 0.25  # before the first decision


class Known(NamedTuple):
    """What is certain about the worlds of a box."""

    vehicle: int
    constant: Floats  # [N] command of each other vehicle; NaN: full braking
    limit: Floats  # [N]
    restitution: float
    begin_s: float  # of the worlds
    time_step_s: float
    horizon_s: float


@compiled_apart
def form_of(low_: Floats, high_: Floats, which: int, free: Ints) -> Floats:
    """The form of number ``which`` of a box whose uncertain ones are ``free`` [K]."""
    out = np.zeros(free.shape[0] + 2)
    out[0] = 0.5 * (low_[which] + high_[which])
    half = 0.5 * (high_[which] - low_[which])
    for k in range(free.shape[0]):
        if free[k] == which:
            out[1 + k] = half
            half = 0.0
    out[-1] = half + 1e-15 * abs(out[0])
    return out


@compiled_apart
def cell_of(low_: Floats, high_: Floats, free: Ints, known: Known, plan: Floats) -> tuple[Cell, Floats]:
    """The cell of a box [Q], its worlds at the alert, and how long after it the first piece of time begins (s).

    The first decision falls at another time in each world where the shielded vehicle's latency is uncertain: time is
    counted from it, and the first piece begins as long before it as the earliest one comes after the alert.
    """
    N, W = known.limit.shape[0], free.shape[0] + 2
    P, v = N - 1, known.vehicle
    speed, gap, brake, onset = np.empty((N, W)), np.empty((P, W)), np.empty((N, W)), np.empty((N, W))
    share = np.empty((P, 2, W))
    first = form_of(low_, high_, LATENCY * N + v, free)
    first[0] -= known.begin_s
    first = positive_part(first)
    earliest = known.begin_s + max(low(first), 0.0)
    first[0] += known.begin_s
    for i in range(N):
        speed[i] = form_of(low_, high_, SPEED * N + i, free)
        brake[i] = form_of(low_, high_, BRAKING * N + i, free)
        onset[i] = difference(form_of(low_, high_, LATENCY * N + i, free), first)
    for p in range(P):
        gap[p] = form_of(low_, high_, GAP * N + p, free)
        front, rear = form_of(low_, high_, MASS * N + p, free), form_of(low_, high_, MASS * N + p + 1, free)
        whole = front.copy()
        add(whole, 1.0, rear)
        share[p, 0] = product(rear, reciprocal(whole))
        share[p, 1] = -share[p, 0]
        share[p, 1, 0] += 1.0
        share[p, 1, -1] = share[p, 0, -1]
    drive = form_of(low_, high_, DRIVING * N + v, free)
    times, action = pieces(known, onset, earliest, plan)
    cell = Cell(
        speed, gap, brake, drive, share, onset, known.constant, known.limit, v, known.restitution, times, action
    )  # fmt: skip
    first[0] -= earliest
    return cell, first


@compiled_apart
def wait(cell: Cell, late: Floats) -> bool:
    """Move a cell's worlds on by ``late`` (s), each by its own; False where that may not be all that happens."""
    if high(late) <= 1e-12:
        return True
    if low(late) < -1e-12:
        return False
    N = cell.speed.shape[0]
    slowest, way = np.empty(N), np.empty_like(cell.speed)
    for i in range(N):
        pull, certain = early_pull(cell, i, late)
        begin = cell.speed[i].copy()
        way[i] = product(begin, late)
        add(way[i], 0.5, product(pull, square(late)))
        add(cell.speed[i], 1.0, product(pull, late))
        slowest[i], fastest = min(low(begin), low(cell.speed[i])), max(high(begin), high(cell.speed[i]))
        limited = high(pull) > 0.0 and fastest >= cell.limit[i]
        if not certain or limited or slowest[i] < 0.0:
            return False
        if i > 0 and low(cell.gap[i - 1]) <= max(fastest - slowest[i - 1], 0.0) * high(late) + 1e-9:
            return False
    for p in range(N - 1):
        add(cell.gap[p], 1.0, way[p])
        add(cell.gap[p], -1.0, way[p + 1])
    return True


@compiled_apart
def early_pull(cell: Cell, i: int, late: Floats) -> tuple[Floats, bool]:
    """Acceleration of a vehicle until ``late`` after the alert; False where it may begin within that time."""
    pull = np.zeros_like(late)
    if i == cell.vehicle:
        return pull, True
    acts = cell.onset[i].copy()  # after the alert
    add(acts, 1.0, late)
    acts[0] -= cell.times[0]
    if high(acts) > 1e-12:
        return pull, low(acts) >= high(late)
    if math.isnan(cell.constant[i]):
        return negative(cell.brake[i]), True
    pull[0] = cell.constant[i]
    return pull, True


@compiled_apart
def pieces(known: Known, onset: Floats, earliest: float, plan: Floats) -> tuple[Floats, Floats]:
    """Where commands may change, s after the first decision, and the shielded vehicle's action between."""
    N = onset.shape[0]
    before = earliest - known.begin_s
    first = math.ceil(before / LONGEST_PIECE_S) if before > 0.0 else 0
    last = math.ceil((known.horizon_s - earliest) / known.time_step_s - 1e-9)
    points = np.empty(first + last + 1 + 2 * N)
    count = 0
    for k in range(first):
        points[count] = -before + before * k / first
        count += 1
    for k in range(last + 1):
        points[count] = k * known.time_step_s
        count += 1
    for i in range(N):
        if i != known.vehicle:
            for at in (low(onset[i]), high(onset[i])):
                if -before < at < last * known.time_step_s:
                    points[count] = at
                    count += 1
    times = np.unique(points[:count])
    action = np.zeros(times.shape[0] - 1)
    for j in range(action.shape[0]):
        middle = 0.5 * (times[j] + times[j + 1])
        if middle > 0.0:
            action[j] = plan[min(int(middle / known.time_step_s), plan.shape[0] - 1)]
    return times, action


@compiled_apart
def bound_of(
    low_: Floats, high_: Floats, free: Ints, known: Known, plan: Floats, stack: Stack, motion: Motion, out: Floats,
    most: float,
) -> float:  # fmt: skip
    """Upper bound on the harm of a plan over one box, unless it is above ``most``."""
    cell, late = cell_of(low_, high_, free, known, plan)
    rough = rough_at_alert(cell, late)
    if wait(cell, late):
        harm = most_harm(cell, stack, motion, out, most)
        if harm <= rough:
            return harm
    out[:] = 0.0
    out[0] = rough
    return rough


@compiled_apart
def bound_box(
    low_: Floats, high_: Floats, free: Ints, known: Known, plan: Floats, enough: float, cells: int, only_enough: bool
) -> tuple[float, int]:
    """Upper bound on the harm of a plan [L] over a box [Q], and the cells looked at.

    The box is halved where the bound is largest, until that is at most ``enough`` or ``cells`` were looked at. With
    ``only_enough`` a part is given up once its harm is above ``enough``: a larger result is then no bound.
    """
    N, K, Q = known.limit.shape[0], free.shape[0], low_.shape[0]
    stack, motion = new_stack(N, K + 2), new_motion(N, K + 2)
    lows, highs = np.empty((cells + 1, Q)), np.empty((cells + 1, Q))
    bounds, slopes = np.full(cells + 1, -math.inf), np.zeros((cells + 1, K + 2))
    lows[0], highs[0] = low_, high_
    most, size, looked = enough if only_enough else math.inf, 1, 1
    bounds[0] = bound_of(low_, high_, free, known, plan, stack, motion, slopes[0], most)
    while looked + 2 <= cells and K > 0:
        at = int(np.argmax(bounds[:size]))
        if bounds[at] <= enough:
            break
        share = (highs[at] - lows[at])[free] / (high_ - low_)[free]
        weight = np.abs(slopes[at, 1:-1])
        which = free[int(np.argmax(weight if weight.max() > 0.0 else share))]
        middle = 0.5 * (lows[at, which] + highs[at, which])
        lows[size], highs[size] = lows[at], highs[at]
        highs[at, which], lows[size, which] = middle, middle
        bounds[at] = bound_of(lows[at], highs[at], free, known, plan, stack, motion, slopes[at], most)
        bounds[size] = bound_of(lows[size], highs[size], free, known, plan, stack, motion, slopes[size], most)
        size += 1
        looked += 2
    return bounds[:size].max(), looked
