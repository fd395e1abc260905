"""Two vehicles with piecewise constant acceleration: their smallest gap and their first contact, in closed form.

A *plan* is the motion of one vehicle: four accelerations (m/s2), each with the time until which it lasts (s from now),
as a tuple ``(u_0, end_0, u_1, end_1, u_2, end_2, u_3, inf)``. A vehicle that brakes to rest stays at rest until its
acceleration is above 0.
"""

from __future__ import annotations

import math

from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.contact import contact


@kernel
def braking(onset, deceleration):
    """Plan (top of this file): coast until ``onset`` (s), then brake to rest with ``deceleration`` (m/s2)."""
    return 0.0, onset, 0.0, onset, 0.0, onset, -deceleration, math.inf


@kernel
def with_window(u, late, end, change, turn, step):
    """Plan (top of this file): accelerate with ``u``, plus ``step`` from ``turn`` on, plus ``change`` in a window.

    The window lasts from ``late`` to ``end``. Accelerations in m/s2, times in s.
    """
    second = u + step if turn < late else u + change
    third = u + step + change if turn < end else u
    return u, min(turn, late), second, min(max(turn, late), end), third, max(turn, end), u + step, math.inf


@kernel
def time_to_limit(v, u, limit):
    """Time (s) in which the acceleration ``u`` (m/s2) raises the speed ``v`` to ``limit`` (m/s).

    0 if ``v`` is not below ``limit``, or if ``u`` is not positive.
    """
    return (limit - v) / u if u > 0.0 and v < limit else 0.0


@kernel
def drive_then_brake(v, u, limit, drive, deceleration):
    """Plan (top of this file): drive for ``drive`` seconds, then brake to rest.

    The vehicle drives with ``u`` (m/s2) from the speed ``v`` up to ``limit`` (m/s), and brakes with ``deceleration``
    (m/s2).
    """
    return u, min(time_to_limit(v, u, limit), drive), 0.0, drive, 0.0, drive, -deceleration, math.inf


@kernel
def brake_then_drive(v, u, limit, brake, deceleration):
    """Plan (top of this file): brake for ``brake`` seconds, at most to rest, then drive.

    The vehicle brakes with ``deceleration`` (m/s2) from the speed ``v`` (m/s), and drives with ``u`` (m/s2) up to
    ``limit`` (m/s).
    """
    cap = brake + time_to_limit(max(v - deceleration * brake, 0.0), u, limit)
    return -deceleration, brake, u, cap, 0.0, cap, 0.0, math.inf


@kernel
def piece_at(plan, now, v):
    """Acceleration of a plan at ``now`` (m/s2), the time (s) until which it lasts, and whether the vehicle stops then.

    ``plan``: top of this file. ``now``: s. ``v``: the vehicle's present speed (m/s).
    """
    k = 0
    while now >= plan[k + 1]:
        k += 2
    u, end = plan[k], plan[k + 1]
    if u < 0.0:
        if v <= 0.0:
            return 0.0, end, False
        if now + v / -u < end:
            return u, now + v / -u, True
    return u, end, False


@large
def walk(gap, v_front, front, v_rear, rear, until):
    """Smallest gap of two vehicles (m), time (s) of their first contact, and its squared closing speed (m2/s2).

    The vehicles begin with the gap ``gap`` (m) and the speeds ``v_front`` and ``v_rear`` (m/s, at least 0), and follow
    the plans ``front`` and ``rear`` until ``until`` (s). They move as if they could pass through each other: a negative
    smallest gap is the depth of their overlap. Without contact the time is infinite and the square 0. A gap that
    reaches 0 and opens again is no contact. A gap that reaches 0 and would become negative is a contact, even at
    closing speed 0.
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
