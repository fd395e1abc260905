"""Simulate two vehicles whose accelerations change at finite rates: their first contact and its closing speed.

Here *force* means force per mass, which is an acceleration (m/s2). A *plan* is the motion of one vehicle, an array [3,
LEGS]. A *leg* is a time interval of constant jerk. Row ENDS of the plan has the time at which each leg ends, in s from
now (infinite for the last leg). Row FORCES has the force at the start of each leg (m/s2). Row JERKS has the rate at
which the force changes in each leg (m/s3). A vehicle at rest stays there until its force is above 0. A vehicle at its
speed limit keeps that speed until its force is below 0. The simulation needs no time steps, because the gap is
piecewise a cubic polynomial of time.
docs/internals/proofs/lower-bound-cases.md has the proof, under "Brakes that build up".
"""

from __future__ import annotations

import math

import numpy as np

from ethbrake_marl.extensions.proofs.plans import ENDS
from ethbrake_marl.physics.build_up import contact_within, first_return, gap_after
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.state import Floats

FORCES, JERKS = 1, 2

LEGS = 5

_MEETING_HALVINGS = 30


@compiled
def empty_legs() -> Floats:
    """Return an uninitialised plan, [3, LEGS]."""
    return np.empty((3, LEGS))


@compiled
def put_leg(plan: Floats, k: int, end: float, force: float, jerk: float) -> None:
    """Write leg ``k`` of a plan in place: its end (s), its initial force (m/s2) and its jerk (m/s3)."""
    plan[ENDS, k], plan[FORCES, k], plan[JERKS, k] = end, force, jerk


@compiled
def fill_build_up(plan: Floats, since: float, force: float, wanted: float, rate: float) -> None:
    """Write a plan: the force is ``force`` until ``since`` (s), and then changes to ``wanted`` at ``rate`` (m/s3),
    which may be infinite.
    """
    rise = abs(wanted - force) / rate
    put_leg(plan, 0, since, force, 0.0)
    put_leg(plan, 1, since + rise, force, (wanted - force) / rise if rise > 0.0 else 0.0)
    put_leg(plan, 2, math.inf, wanted, 0.0)


@compiled
def fill_switch(
    plan: Floats, sign: float, force: float, high: float, rise: float, low: float, fall: float, switch: float,
    time: float, final: float,
) -> None:  # fmt: skip
    """Write a plan: the force rises from ``force`` to at most ``high`` until ``switch``, then falls to ``-low``.

    Before ``time`` the force rises again, and reaches ``final`` at ``time``. All forces in the arguments are already
    multiplied by ``sign`` (1 or -1). ``low`` is the smallest force, which is negative, without its minus sign. The
    rates ``rise`` and ``fall`` are in m/s3; ``rise`` may be infinite. In this case ``switch`` may be from -1 to 0: the
    force jumps to ``force + (1 + switch) (high - force)`` and falls at once. ``final`` is -inf if no force is required
    at ``time``.
    """
    full = (high - force) / rise
    top = high if switch >= full else force + rise * switch
    if switch < 0.0:
        top, switch = force + (high - force) * (1.0 + switch), 0.0
    put_leg(plan, 0, min(full, switch), sign * force, sign * rise if full > 0.0 else 0.0)
    put_leg(plan, 1, switch, sign * top, 0.0)
    down, tail = switch + (top + low) / fall, math.inf
    if final > -low and rise < math.inf:
        tail = time - (final + low) / rise
        if tail < down:
            tail = switch + max(top - final + rise * (time - switch), 0.0) / (rise + fall)
    put_leg(plan, 2, min(down, tail), sign * top, -sign * fall if down > switch else 0.0)
    put_leg(plan, 3, tail, -sign * low, 0.0)
    put_leg(plan, 4, math.inf, sign * (final - rise * (time - tail)) if tail < math.inf else 0.0, 0.0)
    if tail < math.inf:
        plan[JERKS, 4] = sign * rise


@compiled
def leg_at(plan: Floats, now: float, v: float, limit: float) -> tuple[float, float, float, float]:
    """Return acceleration (m/s2) and jerk (m/s3) at ``now``, the time at which this jerk ends (s), and the speed at the
    end of this jerk (m/s).

    The speed is NaN unless the vehicle is at rest or at the speed limit when the jerk ends. ``v`` is the speed at
    ``now``, and ``limit`` the speed limit (m/s).
    """
    k = 0
    while now >= plan[ENDS, k]:
        k += 1
    jerk, end = plan[JERKS, k], plan[ENDS, k]
    u = plan[FORCES, k] + jerk * (now - (plan[ENDS, k - 1] if k > 0 else 0.0))
    if (v <= 0.0 and (u < 0.0 or (u == 0.0 and jerk <= 0.0))) or (
        v >= limit and (u > 0.0 or (u == 0.0 and jerk > 0.0))
    ):
        free = now - u / jerk if u * jerk < 0.0 else math.inf
        if free > now:
            return 0.0, 0.0, min(end, free), v
        u = 0.0  # the vehicle becomes free at this moment, up to rounding
    reached = math.nan
    stands = now + first_return(v, u, jerk)
    if v <= 0.0 and stands <= now:
        return 0.0, 0.0, end, v
    if stands <= end:
        end, reached = stands, 0.0
    if v < limit < math.inf:
        capped = now + first_return(v - limit, u, jerk)
        if capped < end:
            end, reached = capped, limit
    return u, jerk, end, reached


@compiled
def speed_after(v: float, u: float, jerk: float, step: float, reached: float) -> float:
    """Return the speed (m/s) after ``step`` seconds of constant ``jerk`` (m/s3), from the speed ``v`` (m/s) and the
    initial acceleration ``u`` (m/s2).

    ``reached`` is the speed (m/s) after ``step`` seconds if this speed is already known, and NaN if it is not known.
    """
    return max(v + (u + 0.5 * jerk * step) * step, 0.0) if math.isnan(reached) else reached


@compiled(apart=True)
def travel(plan: Floats, v: float, limit: float, until: float) -> tuple[float, float]:
    """Return speed (m/s) and travelled distance (m), at ``until`` (s), of a vehicle that follows ``plan``.

    ``v`` is the speed at the start of ``plan``, and ``limit`` the speed limit (m/s).
    """
    now, way = 0.0, 0.0
    while now < until:
        u, jerk, end, reached = leg_at(plan, now, v, limit)
        if end > until:
            end, reached = until, math.nan
        step = end - now
        way -= gap_after(0.0, v, u, jerk, step)
        v, now = speed_after(v, u, jerk, step, reached), end
    return v, way


@compiled
def force_of(plan: Floats, now: float) -> float:
    """Return the force (m/s2) of a plan at ``now`` (s), even if the vehicle stands still."""
    return leg_at(plan, now, 1.0, math.inf)[0]


@compiled(apart=True)
def least_on_cubic(constant: float, pressing: float, jerk: float, since: float, until: float) -> float:
    """Return the smallest value of ``(constant / t) + (pressing * t / 2) + (jerk * t^2 / 3)`` for t from ``since`` to
    ``until``.

    The result is -inf if this expression falls without bound as t approaches 0.
    """
    if since <= 0.0 and constant <= 0.0:
        return -math.inf
    least = constant / until + (0.5 * pressing + jerk * until / 3.0) * until
    turn = -0.5 * pressing / jerk if jerk != 0.0 else since
    turn = min(max(turn, since), until)
    for low, high in ((since, turn), (turn, until)):  # the sign of the slope changes at most once on each part
        if low > 0.0:
            least = min(least, constant / low + (0.5 * pressing + jerk * low / 3.0) * low)
        if (0.5 * pressing + 2.0 / 3.0 * jerk * high) * high * high <= constant or low >= high:
            continue
        for _ in range(_MEETING_HALVINGS):
            middle = 0.5 * (low + high)
            if (0.5 * pressing + 2.0 / 3.0 * jerk * middle) * middle * middle < constant:
                low = middle
            else:
                high = middle
        least = min(least, constant / high + (0.5 * pressing + jerk * high / 3.0) * high)
    return least


@compiled(apart=True)
def meeting(
    gap: float, slack: float, v_front: float, front: Floats, front_limit: float, v_rear: float, rear: Floats,
    rear_limit: float, since: float, until: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Return the time (s) of two vehicles' first contact, its closing speed (m/s), and the *forced closing speed*
    (m/s).

    The results are inf, 0, 0 if there is no contact. The forced closing speed is the smallest value of ``w + (gap -
    slack) / t`` until the contact. Here w is the closing speed (m/s) and gap is the gap (m) in the given motion, t
    seconds after ``since``. The forced closing speed is also a lower bound on the closing speed of another motion of
    the pair if two conditions hold. First, at ``since`` the gap in the other motion is smaller than the gap in the
    given motion by at most ``slack`` (m). Second, the closing speed in the other motion minus the closing speed in the
    given motion never decreases.

    The motion lasts from ``since`` to ``until`` (s). ``gap`` (m), ``v_front`` and ``v_rear`` (m/s) are the gap and the
    speeds at ``since``. ``front`` and ``rear`` are the plans, ``front_limit`` and ``rear_limit`` the speed limits
    (m/s).
    """
    now, least = since, math.inf
    while now < until:
        u_f, jerk_f, end_f, reached_f = leg_at(front, now, v_front, front_limit)
        u_r, jerk_r, end_r, reached_r = leg_at(rear, now, v_rear, rear_limit)
        end = min(end_f, end_r, until)
        w, b, jerk, step = v_rear - v_front, u_r - u_f, jerk_r - jerk_f, end - now
        after, speed = contact_within(max(gap, 0.0), w, b, jerk, step)
        met, t = after <= step, now - since
        if met:
            end = now + after
        if end - since > t and end < math.inf:
            c = b - jerk * t
            constant = gap - slack + (w - (0.5 * c + jerk * t / 3.0) * t) * t
            least = min(least, least_on_cubic(constant, c, jerk, t, end - since))
        if met:
            return end, speed, max(min(least, speed), 0.0)
        if end == math.inf:
            break
        gap = gap_after(gap, w, b, jerk, step)
        v_front = speed_after(v_front, u_f, jerk_f, step, reached_f if end == end_f else math.nan)
        v_rear = speed_after(v_rear, u_r, jerk_r, step, reached_r if end == end_r else math.nan)
        now = end
    return math.inf, 0.0, 0.0
