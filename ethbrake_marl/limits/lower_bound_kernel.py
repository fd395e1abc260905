"""Compiled proven lower bounds on the harm of one world; docs/avoidability.md has the proofs."""

from __future__ import annotations

import math

import numpy as np

from ethbrake_marl.limits.aftermath import after_front, after_rear
from ethbrake_marl.limits.avoidability_kernel import largest_behind, spare_gap
from ethbrake_marl.limits.first_meeting import CELL_WIDTH, CELLS, least_harm
from ethbrake_marl.limits.meetings import (
    A_F,
    A_L,
    A_R,
    FRONT_FIRST,
    GAP_L,
    GAP_R,
    LIMIT_F,
    ONSET_R,
    REAR_FIRST,
    TIME_STEP,
    U_F,
    V_F,
    V_L,
    V_R,
    braking_to_rear,
    gentlest_front,
    meet_front,
    meet_rear,
    stays_ahead,
    stays_behind,
)
from ethbrake_marl.limits.walk import empty_plan, fill_braking, fill_drive_then_brake, walk
from ethbrake_marl.physics.compiled import compiled, compiled_apart
from ethbrake_marl.physics.events import TOUCH_SPEED_MPS, solo_motion
from ethbrake_marl.physics.worlds import Bools, Floats

FRONT_BOUND, REAR_BOUND, COMBINED_BOUND, BOUNDS = range(4)
LARGE = 1e6  # m2/s2: more harm than any impact of vehicles does
_TOUCH_HARM = 2.0 * TOUCH_SPEED_MPS * TOUCH_SPEED_MPS  # what two touches may hide
_TOUCHING_M = 1e-9  # more than rounding leaves between two that touch
_HALVINGS = 60
_GRAZE_S = 1e-3  # more than rounding can move a graze
_PARTS = 8  # into which the times of soft meetings are divided


@compiled
def front_bound(at: Floats, plan: Floats, other: Floats) -> tuple[float, float]:
    """Least squared closing speed at the front pair's first contact, whoever pushes; and its latest time."""
    fill_braking(plan, 0.0, at[A_L])
    fill_braking(other, 0.0, at[A_F])
    _, time, squared = walk(at[GAP_L], at[V_L], plan, at[V_F], other, at[V_F] / at[A_F])
    if at[A_F] < at[A_L] and at[V_F] < at[V_L]:
        squared = min(squared, 2.0 * (at[A_L] - at[A_F]) * at[GAP_L])
    return squared, time


@compiled
def rear_bound(at: Floats, plan: Floats, other: Floats) -> tuple[float, float]:
    """Least squared closing speed at the rear pair's first contact, that under full drive; and its latest time."""
    fill_drive_then_brake(plan, at[V_F], at[U_F], at[LIMIT_F], math.inf, at[A_F])
    fill_braking(other, at[ONSET_R], at[A_R])
    _, time, squared = walk(at[GAP_R], at[V_F], plan, at[V_R], other, at[ONSET_R] + at[V_R] / at[A_R])
    return squared, time


@compiled_apart
def last_ahead(at: Floats, first: float, last: float, plan: Floats, other: Floats) -> float:
    """The latest time, at most ``last``, of a meeting with the leader before which the rear vehicle has not come.

    At ``first`` there is room. The later the meeting, the shorter the drive before it and the less room behind.
    """
    if stays_ahead(at, gentlest_front(at, last)[1], last, plan, other):
        return last
    for _ in range(_HALVINGS):
        middle = 0.5 * (first + last)
        if stays_ahead(at, gentlest_front(at, middle)[1], middle, plan, other):
            first = middle
        else:
            last = middle
    return last


@compiled_apart
def last_behind(at: Floats, first: float, last: float, plan: Floats, other: Floats) -> float:
    """The latest time, at most ``last``, of a meeting with the rear vehicle before which the leader is not met.

    At ``first`` there is room. The later the meeting, the shorter the braking before it and the less room ahead.
    """
    if stays_behind(at, braking_to_rear(at, last), last, plan, other):
        return last
    for _ in range(_HALVINGS):
        middle = 0.5 * (first + last)
        if stays_behind(at, braking_to_rear(at, middle), middle, plan, other):
            first = middle
        else:
            last = middle
    return last


@compiled_apart
def front_first(
    at: Floats, floor: float, best: float, enough: float, plan: Floats, other: Floats, heap: Floats
) -> float:
    """Least harm, if below ``best``, where the leader is met first or all three meet at once.

    At once: the outer two close with W, of which the front pair has at least the least at that time. Only if the leader
    can be met as late as that.
    """
    first = meet_front(at, math.inf, plan, other)
    if first == math.inf and at[GAP_L] <= _TOUCHING_M:  # it stands at the leader, and stays: both are struck at once
        return min(best, rear_bound(at, plan, other)[0])
    if first == math.inf or not stays_ahead(at, first, first, plan, other):
        return best
    touches = spare_gap(at[GAP_L], at[V_L], at[A_L], at[V_F], at[A_F]) >= 0.0
    last = meet_front(at, 0.0, plan, other)
    if touches:
        last = largest_behind(at[GAP_L], at[V_L], at[A_L], at[V_F], at[A_F], at[U_F], at[LIMIT_F])[1]
    end = last_ahead(at, first, last, plan, other)
    best = least_harm(FRONT_FIRST, at, first, end, floor, best, enough, plan, other, heap)
    leans = touches and end == last
    if leans:
        best = leaning_harm(at, last, floor, best, plan, other)
        stand = at[V_L] / at[A_L]
        if last < stand:
            best = leaning_harm(at, stand, floor, best, plan, other)
    fill_braking(plan, 0.0, at[A_L])
    fill_braking(other, at[ONSET_R], at[A_R])
    _, time, squared = walk(at[GAP_L] + at[GAP_R], at[V_L], plan, at[V_R], other, math.inf)
    if time == math.inf or (time > end + _GRAZE_S and not leans):
        return best
    least = gentlest_front(at, min(time, last))[0] if time > first else 0.0
    front = max(least, 0.5 * math.sqrt(squared))
    rear = max(math.sqrt(squared) - front, 0.0)
    return min(best, front * front + rear * rear)


@compiled_apart
def leaning_harm(at: Floats, time: float, floor: float, best: float, plan: Floats, other: Floats) -> float:
    """Least harm, if below ``best``, of the meetings with the leader from ``time`` on, however soft."""
    soft = 0.0
    while soft * soft < best:
        hard = soft + 0.02 * (1.0 + soft)
        follows = after_front(at, time, time, hard, time, 0.0, plan, other)
        best = min(best, soft * soft + max(follows, floor))
        soft = hard
    return best


@compiled_apart
def rear_first(
    at: Floats, floor: float, best: float, enough: float, plan: Floats, other: Floats, heap: Floats
) -> float:
    """Least harm, if below ``best``, where the rear vehicle is met first."""
    high = max(at[V_F] / at[A_F], at[ONSET_R] + at[V_R] / at[A_R])
    first = meet_rear(at, high, plan, other)
    if first == math.inf or not stays_behind(at, first, first, plan, other):
        return best
    last = meet_rear(at, 0.0, plan, other)
    if last < math.inf:
        end = last_behind(at, first, last, plan, other)
        return least_harm(REAR_FIRST, at, first, end, floor, best, enough, plan, other, heap)
    low, top = 0.0, high
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + top)
        if meet_rear(at, middle, plan, other) < math.inf:
            top = middle
        else:
            low = middle
    last = meet_rear(at, top, plan, other)
    end = last_behind(at, first, last, plan, other)
    best = least_harm(REAR_FIRST, at, first, end, floor, best, enough, plan, other, heap)
    if end < last:
        return best
    late = max(last_soft(at, high, plan, other), last) + _GRAZE_S
    part = (late - last) / _PARTS
    for k in range(_PARTS):
        best = leaned_on_harm(at, last + k * part, last + (k + 1) * part, floor, best, plan, other)
    return best


@compiled_apart
def last_soft(at: Floats, rest: float, plan: Floats, other: Floats) -> float:
    """A time after which no first meeting with the rear vehicle comes, however soft; all stand at ``rest``.

    It has then passed neither the leader nor the controlled vehicle; where it brakes harder than this one, by b, it was
    faster by ``b t`` a time t before the meeting, from its onset on.
    """
    fill_braking(plan, 0.0, at[A_L])
    fill_braking(other, at[ONSET_R], at[A_R])
    last = min(max(rest, at[V_L] / at[A_L]), walk(at[GAP_L] + at[GAP_R], at[V_L], plan, at[V_R], other, math.inf)[1])
    if at[A_F] >= at[A_R]:
        return float(last)
    harder, onset, closing = at[A_R] - at[A_F], at[ONSET_R], at[V_R] - at[V_F]
    gap = max(at[GAP_R] + (0.5 * at[U_F] * onset - closing) * onset, 0.0)
    ahead = max(closing + at[A_F] * onset, 0.0)
    return float(min(last, onset + min(ahead / harder, math.sqrt(2.0 * gap / harder))))


@compiled_apart
def leaned_on_harm(
    at: Floats, early: float, late: float, floor: float, best: float, plan: Floats, other: Floats
) -> float:
    """Least harm, if below ``best``, of the meetings with the rear vehicle from ``early`` to ``late``, however soft."""
    soft = 0.0
    while soft * soft < best:
        hard = soft + 0.02 * (1.0 + soft)
        follows = after_rear(at, early, late, hard, late, 0.0, plan, other)
        best = min(best, soft * soft + max(follows, floor))
        soft = hard
    return best


@compiled_apart
def combined_bound(
    at: Floats, until: float, front: float, rear: float, plan: Floats, other: Floats, heap: Floats
) -> float:
    """Least harm of a world in which contact is unavoidable, whoever is met first; 0 if that may be after ``until``.

    ``front`` and ``rear`` are the pairs' own bounds.
    """
    stand = at[ONSET_R] + at[V_R] / at[A_R]
    way = solo_motion(at[V_R], -at[A_R], at[ONSET_R], math.inf, stand)[1]
    room = at[GAP_L] + at[V_L] * at[V_L] / (2.0 * at[A_L]) + at[GAP_R] - way
    rest = at[ONSET_R] + at[V_R] / min(at[A_R], at[A_F])
    if not max(rest, stand + math.sqrt(2.0 * max(room, 0.0) / at[A_F])) < until:
        return 0.0
    step, least = at[TIME_STEP], 0.0
    for time_step in (0.0, step):  # what holds for any command holds for one that changes at decisions only
        at[TIME_STEP] = time_step
        best = front_first(at, rear, LARGE, front + rear, plan, other, heap)
        best = rear_first(at, front, best, front + rear, plan, other, heap)
        least = max(least, best - _TOUCH_HARM if best < LARGE else 0.0)
        if step <= 0.0:
            break
    return least


@compiled
def bound_worlds(
    states: Floats, until: Floats, has_front: Bools, has_rear: Bools, unavoidable: Bools, out: Floats
) -> None:
    """Bounds of worlds ``states`` [n, WIDTH] into ``out`` [n, BOUNDS].

    Each pair's where it exists, both together where contact is unavoidable.
    """
    plan, other, heap = empty_plan(), empty_plan(), np.empty((CELLS, CELL_WIDTH))
    for k in range(states.shape[0]):
        front, rear = 0.0, 0.0
        if has_front[k]:
            squared, time = front_bound(states[k], plan, other)
            front = squared if time < until[k] and squared > _TOUCH_HARM else 0.0
        if has_rear[k]:
            squared, time = rear_bound(states[k], plan, other)
            rear = squared if time < until[k] and squared > _TOUCH_HARM else 0.0
        out[k, FRONT_BOUND], out[k, REAR_BOUND], out[k, COMBINED_BOUND] = front, rear, 0.0
        if unavoidable[k]:
            out[k, COMBINED_BOUND] = combined_bound(states[k], until[k], front, rear, plan, other, heap)
