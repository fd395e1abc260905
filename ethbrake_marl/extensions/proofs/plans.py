"""Simulate two vehicles with piecewise constant acceleration: their smallest gap and their first contact.

A *plan* is the motion of one vehicle, an array [2, PIECES]. A *piece* is a time interval of constant acceleration. Row
ENDS has the end of each piece (in s from now; the last piece never ends). Row ACCELERATIONS has the acceleration in
each piece (m/s2). A vehicle that brakes to rest stays at rest until its acceleration is above 0. The simulation needs
no time steps, because the motion in each piece has a closed form. A function whose name begins with ``fill`` overwrites
``plan``.
"""

from __future__ import annotations

import math

import numpy as np

from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.motion import contact
from ethbrake_marl.first_edition.physics.state import Floats

ENDS, ACCELERATIONS = 0, 1

PIECES = 4


@compiled
def empty_plan() -> Floats:
    """Return an uninitialised plan, [2, PIECES]."""
    return np.empty((2, PIECES))


@compiled
def fill_plan(
    plan: Floats, end_0: float, u_0: float, end_1: float, u_1: float, end_2: float, u_2: float, u_3: float
) -> None:
    """Write a plan with four constant accelerations (m/s2), one after the other.

    The acceleration is ``u_0`` until ``end_0``, ``u_1`` until ``end_1``, ``u_2`` until ``end_2``, and ``u_3`` after
    ``end_2``.
    """
    plan[ENDS, 0], plan[ENDS, 1], plan[ENDS, 2], plan[ENDS, 3] = end_0, end_1, end_2, math.inf
    plan[ACCELERATIONS, 0], plan[ACCELERATIONS, 1] = u_0, u_1
    plan[ACCELERATIONS, 2], plan[ACCELERATIONS, 3] = u_2, u_3


@compiled
def fill_braking(plan: Floats, onset: float, braking: float) -> None:
    """Write a plan: coast until ``onset`` (s), then brake to rest with ``braking`` (m/s2, positive)."""
    fill_plan(plan, onset, 0.0, onset, 0.0, onset, 0.0, -braking)


@compiled
def fill_window(plan: Floats, u: float, late: float, end: float, change: float, turn: float, step: float) -> None:
    """Write a plan: the acceleration is ``u``, increased by ``step`` from the time ``turn`` on, and increased by
    ``change`` from the time ``late`` to the time ``end``.

    ``u``, ``step`` and ``change`` are in m/s2, the times in s.
    """
    first, second, third = min(turn, late), min(max(turn, late), end), max(turn, end)
    u_1 = u + step if turn < late else u + change
    u_2 = u + step + change if turn < end else u
    fill_plan(plan, first, u, second, u_1, third, u_2, u + step)


@compiled
def time_to_limit(v: float, u: float, limit: float) -> float:
    """Return the time (s) in which the acceleration ``u`` (m/s2) raises the speed from ``v`` to ``limit`` (m/s).

    The result is 0 if ``v`` is at or above the limit, or ``u <= 0``.
    """
    return (limit - v) / u if u > 0.0 and v < limit else 0.0


@compiled
def fill_drive_then_brake(plan: Floats, v: float, u: float, limit: float, drive: float, braking: float) -> None:
    """Write a plan: drive with ``u`` (m/s2) for ``drive`` seconds, then brake to rest with ``braking`` (m/s2,
    positive).

    ``v`` is the present speed (m/s). At the speed ``limit`` (m/s) the vehicle keeps its speed.
    """
    cap = min(time_to_limit(v, u, limit), drive)
    fill_plan(plan, cap, u, drive, 0.0, drive, 0.0, -braking)


@compiled
def fill_brake_then_drive(plan: Floats, v: float, u: float, limit: float, brake: float, braking: float) -> None:
    """Write a plan: brake for ``brake`` seconds, at most to rest, then drive up to the speed limit and keep that speed.

    The arguments are as in ``fill_drive_then_brake``.
    """
    cap = brake + time_to_limit(max(v - braking * brake, 0.0), u, limit)
    fill_plan(plan, brake, -braking, cap, u, cap, 0.0, 0.0)


@compiled
def piece_at(plan: Floats, now: float, v: float) -> tuple[float, float, bool]:
    """Return the acceleration at ``now`` (m/s2), the time until which this acceleration lasts (s), and whether the
    vehicle stops at that time.

    ``v`` is the speed at ``now``, m/s.
    """
    k = 0
    while now >= plan[ENDS, k]:
        k += 1
    u, end = plan[ACCELERATIONS, k], plan[ENDS, k]
    if u < 0.0:
        if v <= 0.0:
            return 0.0, end, False
        rest = now + v / -u
        if rest < end:
            return u, rest, True
    return u, end, False


@compiled
def walk(
    gap: float, v_front: float, front: Floats, v_rear: float, rear: Floats, until: float
) -> tuple[float, float, float]:
    """Return the smallest gap of two vehicles (m), the time (s) of their first contact, and the squared closing speed
    (m2/s2) of this contact.

    The vehicles start with the gap ``gap`` (m) and the speeds ``v_front`` and ``v_rear`` (m/s, at least 0), and follow
    the plans ``front`` and ``rear`` until ``until`` (s). If there is no contact, the time is infinite and the closing
    speed 0. The motion is computed as if the vehicles could pass through each other, so a negative smallest gap is the
    depth of their overlap. A gap that reaches 0 and opens again does not count as contact. A gap that reaches 0 and
    would become negative counts as contact, even at closing speed 0.
    """
    lowest, now, met_at, squared = gap, 0.0, math.inf, 0.0
    while now < until:
        u_f, end_f, stops_f = piece_at(front, now, v_front)
        u_r, end_r, stops_r = piece_at(rear, now, v_rear)
        end = min(end_f, end_r, until)
        w, b, step = v_rear - v_front, u_r - u_f, end - now
        if met_at == math.inf:
            after, speed = contact(max(gap, 0.0), w, b)
            if after <= step and (speed > 0.0 or b > 0.0):
                met_at, squared = now + after, speed * speed
        if b < 0.0 and 0.0 < w < -b * step:
            lowest = min(lowest, gap - w * w / (-2.0 * b))
        if step == math.inf:
            break
        gap -= (w + 0.5 * b * step) * step
        lowest = min(lowest, gap)
        v_front = 0.0 if stops_f and end == end_f else max(v_front + u_f * step, 0.0)
        v_rear = 0.0 if stops_r and end == end_r else max(v_rear + u_r * step, 0.0)
        now = end
    return lowest, met_at, squared
