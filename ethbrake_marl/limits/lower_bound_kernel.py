"""Compiled proven lower bounds on the harm of one world; docs/avoidability.md has the proofs."""

from __future__ import annotations

import math

import numpy as np

from ethbrake_marl.limits.avoidability_kernel import largest_behind, spare_gap
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
    REAR_SHARE,
    U_F,
    V_F,
    V_L,
    V_R,
    after,
    meet,
    meet_front,
    meet_rear,
)
from ethbrake_marl.limits.walk import empty_plan, fill_braking, fill_drive_then_brake, walk
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.events import TOUCH_SPEED_MPS, solo_motion
from ethbrake_marl.physics.worlds import Bools, Floats

FRONT_BOUND, REAR_BOUND, COMBINED_BOUND, BOUNDS = range(4)
CELL = 1e-3  # a minimum over meetings is bounded this closely, relative to 1 m2/s2 and to itself
_TOUCH_HARM = 2.0 * TOUCH_SPEED_MPS * TOUCH_SPEED_MPS  # what two touches may hide
_HALVINGS = 60
_STACK = 128


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


@compiled
def least_harm(
    kind: int, at: Floats, low: float, least: float, high: float, floor: float, plan: Floats, other: Floats,
    stack: Floats,
) -> float:  # fmt: skip
    """Lower bound of ``closing^2 + max(after, floor)`` over all meetings of this kind with a parameter >= ``low``.

    With the parameter (how long to drive, or to brake) the closing speed rises from ``least`` and the meeting comes
    earlier; ``after`` falls with the closing speed and rises with the time. So a cell is bounded by the closing speed
    of its low end and what follows its high end. Cells are halved until they come close to the best. Meetings harder
    than that of ``high``, the earliest one, are bounded in the same way in cells of the closing speed.
    """
    time, closing = meet(kind, at, high, plan, other)
    if time == math.inf:
        return 0.0
    best = closing * closing + max(after(kind, at, time, closing, plan, other), floor)
    bound, slow, step = math.inf, closing, 0.02 * (1.0 + closing)
    while slow * slow < min(best, bound):
        bound = min(bound, slow * slow + max(after(kind, at, time, slow + step, plan, other), floor))
        slow += step
    push(stack, 0, low, least, high, time, closing)
    depth = 1
    while depth > 0:
        depth -= 1
        low, least, high, time, closing = stack[depth]
        cell = least * least + max(after(kind, at, time, closing, plan, other), floor)
        middle = 0.5 * (low + high)
        if cell >= min(best, bound) - CELL * (1.0 + best) or depth + 2 > stack.shape[0] or not low < middle < high:
            bound = min(bound, cell)
            continue
        then, pace = meet(kind, at, middle, plan, other)
        best = min(best, pace * pace + max(after(kind, at, then, pace, plan, other), floor))
        push(stack, depth, low, least, middle, then, pace)
        push(stack, depth + 1, middle, pace, high, time, closing)
        depth += 2
    return bound


@compiled
def push(stack: Floats, row: int, low: float, least: float, high: float, time: float, closing: float) -> None:
    """Put one cell into its row of the stack."""
    stack[row, 0], stack[row, 1], stack[row, 2], stack[row, 3], stack[row, 4] = low, least, high, time, closing


@compiled
def stays_ahead(at: Floats, drive: float, until: float, plan: Floats, other: Floats) -> bool:
    """Whether one that drives for ``drive``, then brakes, is not met from behind until then (1e-9 m are forgiven)."""
    fill_drive_then_brake(plan, at[V_F], at[U_F], at[LIMIT_F], drive, at[A_F])
    fill_braking(other, at[ONSET_R], at[A_R])
    return walk(at[GAP_R], at[V_F], plan, at[V_R], other, until)[0] >= -1e-9


@compiled
def gentlest_front_meeting(at: Floats, high: float, plan: Floats, other: Floats) -> tuple[float, float]:
    """The shortest drive (low side) after which braking meets the leader, but not before the rear vehicle comes.

    And the closing speed there. The longer the drive, the earlier the meeting and the more room behind; at ``high``
    there is room.
    """
    low, touch = 0.0, math.inf
    if spare_gap(at[GAP_L], at[V_L], at[A_L], at[V_F], at[A_F]) >= 0.0:
        low, touch, _ = largest_behind(at[GAP_L], at[V_L], at[A_L], at[V_F], at[A_F], at[U_F], at[LIMIT_F])
    time, least = meet_front(at, low, plan, other)
    if stays_ahead(at, low, min(time, touch), plan, other):
        return low, least
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        time, closing = meet_front(at, middle, plan, other)
        if stays_ahead(at, middle, time, plan, other):
            high = middle
        else:
            low, least = middle, closing
    return low, least


@compiled
def front_first(at: Floats, floor: float, plan: Floats, other: Floats, stack: Floats) -> float:
    """Least harm if the leader is met first or all three meet at once; inf if the rear vehicle always comes before.

    At once: the outer two close with W, of which the front pair has at least ``least``. Needs ``a_f >= a_l``.
    """
    high, _ = meet_front(at, math.inf, plan, other)
    if high == math.inf or not stays_ahead(at, high, high, plan, other):
        return math.inf
    low, least = gentlest_front_meeting(at, high, plan, other)
    bound = least_harm(FRONT_FIRST, at, low, least, high, floor, plan, other, stack)
    fill_braking(plan, 0.0, at[A_L])
    fill_braking(other, at[ONSET_R], at[A_R])
    _, time, squared = walk(at[GAP_L] + at[GAP_R], at[V_L], plan, at[V_R], other, math.inf)
    if time == math.inf:
        return bound
    front = max(least, 0.5 * math.sqrt(squared))
    rear = max(math.sqrt(squared) - front, 0.0)
    return min(bound, front * front + rear * rear)


@compiled
def rear_first(at: Floats, floor: float, plan: Floats, other: Floats, stack: Floats) -> float:
    """Least harm if the rear vehicle is met first; inf if full braking is not met from behind. Needs ``a_f >= a_r``."""
    high = max(at[V_F] / at[A_F], at[ONSET_R] + at[V_R] / at[A_R])
    if meet_rear(at, high, plan, other)[0] == math.inf:
        return math.inf
    low, least, top = 0.0, 0.0, high
    time, closing = meet_rear(at, 0.0, plan, other)
    if time < math.inf:
        least = closing
    else:
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + top)
            if meet_rear(at, middle, plan, other)[0] < math.inf:
                top = middle
            else:
                low = middle
    return least_harm(REAR_FIRST, at, low, least, high, floor, plan, other, stack)


@compiled
def combined_bound(
    at: Floats, until: float, front: float, rear: float, plan: Floats, other: Floats, stack: Floats
) -> float:
    """Least harm of a world in which contact is unavoidable, whoever is met first; 0 where nothing is proven.

    ``front`` and ``rear`` are the pairs' own bounds. Proven for ``a_f >= a_l``, ``a_f >= a_r``,
    ``(a_f + p) / 2 >= a_l``, and when everything ends before ``until``.
    """
    pooled = (1.0 - at[REAR_SHARE]) * at[A_F] + at[REAR_SHARE] * at[A_R]
    if not (at[A_F] >= at[A_L] and at[A_F] >= at[A_R] and 0.5 * (at[A_F] + pooled) >= at[A_L]):
        return 0.0
    stand = at[ONSET_R] + at[V_R] / at[A_R]
    way = solo_motion(at[V_R], -at[A_R], at[ONSET_R], math.inf, stand)[1]
    room = at[GAP_L] + at[V_L] * at[V_L] / (2.0 * at[A_L]) + at[GAP_R] - way
    if not stand + math.sqrt(2.0 * max(room, 0.0) / at[A_F]) < until:
        return 0.0
    bound = min(front_first(at, rear, plan, other, stack), rear_first(at, front, plan, other, stack))
    return max(bound - _TOUCH_HARM, 0.0)


@compiled
def bound_worlds(
    states: Floats, until: Floats, has_front: Bools, has_rear: Bools, unavoidable: Bools, out: Floats
) -> None:
    """Bounds of worlds ``states`` [n, WIDTH] into ``out`` [n, BOUNDS].

    Each pair's where it exists, both together where contact is unavoidable.
    """
    plan, other, stack = empty_plan(), empty_plan(), np.empty((_STACK, 5))
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
            out[k, COMBINED_BOUND] = combined_bound(states[k], until[k], front, rear, plan, other, stack)
