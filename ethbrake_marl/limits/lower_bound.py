"""Contacts that nobody could have avoided: exact, world by world, with a witness or the reason.

One vehicle is controlled, its neighbours brake with their whole capacity from their latencies on. Let z be the
pointwise largest trajectory behind the vehicle in front: coast to the own latency, drive as long as possible, brake at
capacity so as to just touch the front vehicle (or stop behind it), then follow it. Contact is avoidable if and only if
full braking avoids the front vehicle and z stays ahead of the rear one. docs/avoidability.md has the proof, says what a
touch is, and what the claim does not cover.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from numbers import Real
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.harm import HarmCount, check_harm_count, empty_ledger
from ethbrake_marl.physics import (
    BOUND,
    CLOCK,
    Bools,
    Floats,
    Ints,
    Vehicles,
    Worlds,
    advance,
    by_parts,
    compiled,
    contact,
    contact_within,
    first_return,
    follow_whole,
    gap_after,
    solo_motion,
    stopping_distances,
)
from ethbrake_marl.search import (
    MOST_PHASES,
    ProfileProblem,
    Profiles,
    SearchWorld,
    allowed,
    copy_profile,
    copy_rows,
    largest,
    make_search_world,
)

# Two vehicles on plans of piecewise constant acceleration: how close they come, and where they first meet.
#
# A plan is an array [2, PIECES]: row ENDS holds the end of each piece (seconds from now, the last one infinite), row
# ACCELERATIONS its acceleration (m/s2). Braking ends at rest and then holds. No time step: each piece is closed form.

ENDS, ACCELERATIONS = 0, 1
PIECES = 4


@compiled
def empty_plan() -> Floats:
    """Memory of a plan."""
    return np.empty((2, PIECES))


@compiled
def fill_plan(
    plan: Floats, end_0: float, u_0: float, end_1: float, u_1: float, end_2: float, u_2: float, u_3: float
) -> None:
    """Acceleration ``u_0`` until ``end_0``, then ``u_1`` until ``end_1``, ``u_2`` until ``end_2``, ``u_3`` for ever."""
    plan[ENDS, 0], plan[ENDS, 1], plan[ENDS, 2], plan[ENDS, 3] = end_0, end_1, end_2, math.inf
    plan[ACCELERATIONS, 0], plan[ACCELERATIONS, 1] = u_0, u_1
    plan[ACCELERATIONS, 2], plan[ACCELERATIONS, 3] = u_2, u_3


@compiled
def fill_braking(plan: Floats, onset: float, braking: float) -> None:
    """Coast until ``onset``, then brake to rest."""
    fill_plan(plan, onset, 0.0, onset, 0.0, onset, 0.0, -braking)


@compiled
def fill_window(plan: Floats, u: float, late: float, end: float, change: float, turn: float, step: float) -> None:
    """Acceleration ``u``, from ``turn`` on ``step`` more, and from ``late`` to ``end`` also ``change`` more."""
    first, second, third = min(turn, late), min(max(turn, late), end), max(turn, end)
    u_1 = u + step if turn < late else u + change
    u_2 = u + step + change if turn < end else u
    fill_plan(plan, first, u, second, u_1, third, u_2, u + step)


@compiled
def time_to_limit(v: float, u: float, limit: float) -> float:
    """How long ``u`` accelerates from ``v`` to the speed limit; 0 at or beyond it, or without drive. [s]"""
    return (limit - v) / u if u > 0.0 and v < limit else 0.0


@compiled
def fill_drive_then_brake(plan: Floats, v: float, u: float, limit: float, drive: float, braking: float) -> None:
    """Drive for ``drive`` (at most to the speed limit), then brake to rest."""
    cap = min(time_to_limit(v, u, limit), drive)
    fill_plan(plan, cap, u, drive, 0.0, drive, 0.0, -braking)


@compiled
def fill_brake_then_drive(plan: Floats, v: float, u: float, limit: float, brake: float, braking: float) -> None:
    """Brake for ``brake`` (at most to rest), then drive to the speed limit and stay there."""
    cap = brake + time_to_limit(max(v - braking * brake, 0.0), u, limit)
    fill_plan(plan, brake, -braking, cap, u, cap, 0.0, 0.0)


@compiled
def piece_at(plan: Floats, now: float, v: float) -> tuple[float, float, bool]:
    """Acceleration in force at ``now`` and speed ``v``, until when, and whether it ends at rest."""
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
    """Follow a pair to ``until``: smallest gap [m]; time [s] and squared closing speed of the first meeting, or inf, 0.

    The two pass through each other, so a negative smallest gap is the depth of the overlap. A graze, after which they
    part again, is no meeting; a touch that would turn into an overlap is one, with closing speed 0. Speeds >= 0.
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


# Two vehicles whose forces change at finite rates: where they first meet, and how gently at least. Compiled.
#
# A plan is an array [3, LEGS]: row ENDS holds the end of each leg (s from now, the last one infinite), row FORCES the
# acceleration in force at its start (m/s2), row JERKS how fast that changes (m/s3). A vehicle at rest holds until its
# force is above 0, one at its speed limit until it is below. No time step: a gap is one cubic after the other.
# docs/proofs/lower-bound-cases.md has the proof, under "Brakes that build up".

FORCES, JERKS = 1, 2
LEGS = 5
_MEETING_HALVINGS = 30


@compiled
def empty_legs() -> Floats:
    """Memory of a plan."""
    return np.empty((3, LEGS))


@compiled
def put_leg(plan: Floats, k: int, end: float, force: float, jerk: float) -> None:
    """Leg ``k``, the last one so far: all later ones never begin."""
    plan[ENDS, k], plan[FORCES, k], plan[JERKS, k] = end, force, jerk


@compiled
def fill_build_up(plan: Floats, since: float, force: float, wanted: float, rate: float) -> None:
    """``force`` until ``since``, from then on towards ``wanted`` at this rate, which may be infinite."""
    rise = abs(wanted - force) / rate
    put_leg(plan, 0, since, force, 0.0)
    put_leg(plan, 1, since + rise, force, (wanted - force) / rise if rise > 0.0 else 0.0)
    put_leg(plan, 2, math.inf, wanted, 0.0)


@compiled
def fill_switch(
    plan: Floats, sign: float, force: float, high: float, rise: float, low: float, fall: float, switch: float,
    time: float, final: float,
) -> None:  # fmt: skip
    """From ``force`` up to ``high`` until ``switch``, then down to ``-low``, but so as to be at ``final`` at ``time``.

    Rates are ``rise`` and ``fall``. All forces are given, and come out, times ``sign``. A ``switch`` from -1 to 0, for
    an infinite ``rise``, is one at once from a part of the way up.
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
    """Acceleration and jerk at ``now`` and speed ``v``, until when, and the speed that is reached then, else NaN."""
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
        u = 0.0  # it is free just now, but for rounding
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
    """Speed at the end of a leg, or of the part of it that is ``step`` long (``reached`` is NaN then)."""
    return max(v + (u + 0.5 * jerk * step) * step, 0.0) if math.isnan(reached) else reached


@compiled(apart=True)
def travel(plan: Floats, v: float, limit: float, until: float) -> tuple[float, float]:
    """Speed and way at ``until`` of one that starts at 0 with ``v``."""
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
    """Force of a plan, at rest as well."""
    return leg_at(plan, now, 1.0, math.inf)[0]


@compiled(apart=True)
def least_on_cubic(constant: float, pressing: float, jerk: float, since: float, until: float) -> float:
    """Least value of ``constant / t + pressing t / 2 + jerk t^2 / 3`` from ``since`` to ``until``; -inf at 0, if so."""
    if since <= 0.0 and constant <= 0.0:
        return -math.inf
    least = constant / until + (0.5 * pressing + jerk * until / 3.0) * until
    turn = -0.5 * pressing / jerk if jerk != 0.0 else since
    turn = min(max(turn, since), until)
    for low, high in ((since, turn), (turn, until)):  # on each the sign of the slope changes once at most
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
    """When two first meet after ``since``, with which closing speed w, and the least forced one; inf, 0, 0: never.

    That is the least of ``w + (gap - slack) / t`` until then, t counted from ``since``: of a run that is never behind
    these extremes, ``slack`` nearer than they at ``since``, and ever faster by more.
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


# Compiled decision of one world: the largest trajectory behind the front vehicle, and whether the rear one meets it.
#
# Symbols: l the front vehicle (leader), f the controlled one (follower), r the rear one; gap [m], speed v [m/s],
# braking capacity a > 0, driving capacity u >= 0 [m/s2]. Times count from the moment at which the controlled vehicle
# may act; by then the leader brakes. docs/avoidability.md derives every formula. Only + - * / and sqrt.

ROUNDING_M = 1e-12  # an overlap up to this is the rounding of a touch, not an impact
SQUEEZE_M = 1e-9  # with less room than this between both neighbours, contact counts as unavoidable
TOUCHING_M = 1e-5  # the same where the front vehicle cannot but be touched: a touch may cost that much of the way
AVOIDABLE, EARLY, FRONT, REAR = 0, 1, 2, 3
REASON, MARGIN, SPARE, DRIVE, TOUCH, FOLLOW, RESULT_WIDTH = range(7)  # columns of a decision


@compiled
def spare_gap(gap: float, v_l: float, a_l: float, v_f: float, a_f: float) -> float:
    """Gap beyond what full braking from now needs to stay behind a leader that brakes from now; negative: they meet.

    If the follower stops last, its stopping distance counts, else the moment of equal speeds. [m]
    """
    if v_f * a_l >= v_l * a_f:
        return gap - max(0.0, v_f * v_f / (2.0 * a_f) - v_l * v_l / (2.0 * a_l))
    if v_f > v_l:
        return gap - (v_f - v_l) * (v_f - v_l) / (2.0 * (a_f - a_l))
    return gap


@compiled
def drive_before_braking(
    gap: float, v_l: float, a_l: float, v_f: float, a_f: float, u: float
) -> tuple[float, float, bool]:
    """Longest drive with constant ``u >= 0`` after which full braking still stays behind the braking leader.

    Returns its duration, the time of the touch, and whether both move there (then ``a_f > a_l``, equal speeds; else the
    follower comes to rest at the standing leader). Infinite where the follower never moves. Assumes ``spare_gap >= 0``.
    """
    w, closing, relief = v_f - v_l, u + a_l, a_f - a_l
    if relief > 0.0 and v_l > 0.0:
        both = u + a_f
        root = math.sqrt(both * relief * (w * w + 2.0 * closing * gap))
        if w > 0.0:
            drive = max(2.0 * relief * gap - w * w, 0.0) / (w * both + root)
        else:
            drive = (root - w * both) / (closing * both)
        touch = drive + (w + closing * drive) / relief
        if touch * a_l <= v_l:
            return drive, touch, True
    ratio = 1.0 + u / a_f
    room = max(v_l * v_l / (2.0 * a_l) + gap - v_f * v_f / (2.0 * a_f), 0.0)
    pace = ratio * v_f + math.sqrt(ratio * ratio * v_f * v_f + 2.0 * u * ratio * room)
    if v_f == 0.0 and u == 0.0:
        return math.inf, math.inf, False
    drive = 2.0 * room / pace if room > 0.0 else 0.0
    return drive, drive + (v_f + u * drive) / a_f, False


@compiled
def largest_behind(
    gap: float, v_l: float, a_l: float, v_f: float, a_f: float, u: float, limit: float
) -> tuple[float, float, bool]:
    """As ``drive_before_braking``, for a drive that ends at the speed limit."""
    cap = time_to_limit(v_f, u, limit)
    if cap > 0.0:
        found = drive_before_braking(gap, v_l, a_l, v_f, a_f, u)
        if found[0] <= cap:
            return found
        after_l, way_l, _ = solo_motion(v_l, -a_l, 0.0, math.inf, cap)
        gap = gap + (way_l - 0.5 * (v_f + limit) * cap)
        v_l, v_f = after_l, limit
    drive, touch, moving = drive_before_braking(gap, v_l, a_l, v_f, a_f, 0.0)
    return cap + drive, cap + touch, moving


@compiled
def lowest_while_coasting(gap: float, v_f: float, v_r: float, a_r: float, onset_r: float, until: float) -> float:
    """Smallest gap behind a vehicle that coasts until then. The gap is convex: at equal speeds or at an end. [m]"""
    w = v_r - v_f
    if w <= 0.0:
        return gap
    if onset_r + w / a_r < until:
        return gap - w * onset_r - w * w / (2.0 * a_r)
    return gap + v_f * until - solo_motion(v_r, -a_r, onset_r, math.inf, until)[1]


@compiled
def met(gap: float, closing: float) -> bool:
    """Whether a pair with this gap and closing speed has met, or meets at this very moment, with an impact."""
    return gap < -ROUNDING_M or (gap <= 0.0 and closing > BOUND.TOUCH_SPEED_MPS)


@compiled
def leader_at_onset(
    gap: float, v_l: float, a_l: float, onset_l: float, v_f: float, start: float
) -> tuple[float, float]:
    """Gap to the leader and its speed when the follower, coasting until then, may act; the leader brakes by then.

    The gap is concave until then: if it is not negative at the end, it never was.
    """
    after, way, _ = solo_motion(v_l, -a_l, onset_l, math.inf, start)
    return gap + (way - v_f * start), after


@compiled
def decide_front(gap: Floats, speed: Floats, onset: Floats, braking: Floats, i: int, out: Floats) -> bool:
    """The front pair of vehicle ``i``: False if it surely meets. REASON, MARGIN and SPARE in ``out``; no drive yet."""
    a_l, v_f, a_f = braking[i - 1], speed[i], braking[i]
    ahead, v_l = leader_at_onset(gap[i - 1], speed[i - 1], a_l, onset[i - 1], v_f, onset[i])
    out[REASON], out[MARGIN] = EARLY, ahead
    if met(ahead, v_f - v_l):
        return False
    spare = spare_gap(max(ahead, 0.0), v_l, a_l, v_f, a_f)
    out[REASON], out[MARGIN], out[SPARE], out[DRIVE] = FRONT, spare, max(spare, 0.0), 0.0
    if spare < -ROUNDING_M:
        return False
    out[REASON] = AVOIDABLE
    return True


@compiled
def plan_behind(
    gap: Floats, speed: Floats, onset: Floats, braking: Floats, driving: Floats, limit: Floats, i: int, keep: float,
    plan: Floats, out: Floats,
) -> None:  # fmt: skip
    """The largest trajectory that keeps ``keep`` metres to the leader, if there is one, into ``plan`` and ``out``."""
    a_f, u = braking[i], driving[i]
    if i > 0:
        a_l = braking[i - 1]
        ahead, v_l = leader_at_onset(gap[i - 1], speed[i - 1], a_l, onset[i - 1], speed[i], onset[i])
        ahead = max(ahead - keep, 0.0)
        out[DRIVE], out[TOUCH], moving = largest_behind(ahead, v_l, a_l, speed[i], a_f, u, limit[i])
        out[FOLLOW] = -a_l if moving else -a_f
    cap = min(time_to_limit(speed[i], u, limit[i]), out[DRIVE])
    fill_plan(plan, cap, u, out[DRIVE], 0.0, out[TOUCH], -a_f, out[FOLLOW])


@compiled
def meets_rear_early(gap: Floats, speed: Floats, onset: Floats, braking: Floats, i: int, out: Floats) -> bool:
    """Whether the rear pair of vehicle ``i`` meets before the vehicle may act; then the reason is in ``out``."""
    v_f, v_r, a_r, start = speed[i], speed[i + 1], braking[i + 1], onset[i]
    lowest = lowest_while_coasting(gap[i], v_f, v_r, a_r, onset[i + 1], start)
    after, way, _ = solo_motion(v_r, -a_r, onset[i + 1], math.inf, start)
    if met(lowest, 0.0) or met(gap[i] + (v_f * start - way), after - v_f):
        out[REASON], out[MARGIN] = EARLY, lowest
        return True
    return False


@compiled
def decide_world(
    gap: Floats, speed: Floats, onset: Floats, braking: Floats, driving: Floats, limit: Floats, i: int, plan: Floats,
    rear: Floats, out: Floats,
) -> None:  # fmt: skip
    """Decide one world into ``out`` [RESULT_WIDTH]; plan and rear are scratch. Times count from the onset of ``i``."""
    out[REASON], out[MARGIN], out[SPARE] = AVOIDABLE, math.inf, math.inf
    out[DRIVE], out[TOUCH], out[FOLLOW] = math.inf, math.inf, -braking[i]
    has_rear = i < gap.shape[0]
    if i > 0 and not decide_front(gap, speed, onset, braking, i, out) and out[REASON] == EARLY:
        return
    if has_rear and meets_rear_early(gap, speed, onset, braking, i, out):
        return
    if has_rear and out[REASON] == AVOIDABLE:
        # whether the rear vehicle stays behind the largest trajectory of vehicle i
        v_f, a_r, start = speed[i], braking[i + 1], onset[i]
        v_r, way, _ = solo_motion(speed[i + 1], -a_r, onset[i + 1], math.inf, start)
        behind = max(gap[i] + (v_f * start - way), 0.0)
        onset_r = max(onset[i + 1] - start, 0.0)
        fill_braking(rear, onset_r, a_r)
        plan_behind(gap, speed, onset, braking, driving, limit, i, 0.0, plan, out)
        margin = walk(behind, v_f, plan, v_r, rear, onset_r + v_r / a_r)[0]
        out[MARGIN] = margin
        if margin < -ROUNDING_M:
            out[REASON] = REAR
        elif i > 0:
            if behind > SQUEEZE_M and margin < (SQUEEZE_M if out[SPARE] >= SQUEEZE_M else TOUCHING_M):
                out[REASON] = REAR
            keep = 0.5 * min(SQUEEZE_M, out[SPARE], max(margin, 0.0))
            plan_behind(gap, speed, onset, braking, driving, limit, i, keep, plan, out)


@compiled
def decide_worlds(
    gaps: Floats, speeds: Floats, onset: Floats, braking: Floats, driving: Floats, limit: Floats, i: int, out: Floats
) -> None:
    """Decide every world into ``out`` [n, RESULT_WIDTH]."""
    plan, rear = empty_plan(), empty_plan()
    for k in range(gaps.shape[0]):
        decide_world(gaps[k], speeds[k], onset[k], braking[k], driving[k], limit[k], i, plan, rear, out[k])


REASONS = ("", "early", "front", "rear")  # the name of each code; "" where contact is avoidable


@dataclass(frozen=True, slots=True)
class Avoidability:
    """The verdict on each world [n].

    ``reason``: 0 avoidable; 1 early, a pair meets before the controlled vehicle may act; 2 front, even full braking
    meets the front vehicle; 3 rear, the rear vehicle meets the largest trajectory that spares the front one.

    ``margin_m``: the smallest gap between that trajectory and the rear vehicle (of two vehicles with the rear one
    controlled: what full braking leaves of the gap). Where contact is unavoidable it is negative and says by how much:
    for *front* the gap that full braking lacks, for *early* the overlap before the vehicle may act.

    ``switch_s``, ``command_mps2``: the witness, a profile of the controlled vehicle: each command from its absolute
    time to the next (infinite: never). Played in the physics it has no impact. NaN where contact is unavoidable.
    """

    reason: Ints
    margin_m: Floats
    switch_s: Floats  # [n, 3]
    command_mps2: Floats  # [n, 3]

    @property
    def avoidable(self) -> Bools:
        """Whether some profile avoids all contact, hence every impact, [n]."""
        return np.asarray(self.reason == 0, np.bool_)

    @property
    def reason_name(self) -> NDArray[np.str_]:
        """The reason in words, [n]: one of ``REASONS``."""
        return np.array(REASONS)[self.reason]


def avoidability(worlds: Worlds, vehicle: int = 1, *, scripts: Mapping[int, str] | None = None) -> Avoidability:
    """Decide in every world whether ``vehicle`` (index from 0) could have avoided all contact from now on.

    Elsewhere every profile leads to contact, but not always to an impact: see ``LowerBound.impact_proven``.
    Three vehicles with the middle one controlled, or two with either. The others brake with their whole capacity from
    their latencies on. ``scripts`` (index -> name, as ``Scenario.roles``) is only checked to say the same. An overlap
    of the deciding trajectories of up to 1e-12 m counts as a touch, hence as avoided.

    Raises ``InvalidInput`` for another line, another script than full_brake, a front vehicle that may brake only after
    the controlled one acts, a vehicle that moves backward, or an obstacle (``obstacle_gap_m``) that vehicle_1 could
    reach before any contact.
    """
    worlds.refuse_build_up("avoidability")
    _check_covered(worlds, vehicle, scripts)
    v = worlds.vehicles
    onset = np.maximum(v.latency_s - worlds.time_s[:, None], 0.0)
    out = np.empty((worlds.n, RESULT_WIDTH))
    decide_worlds(
        worlds.gaps_m, worlds.speeds_mps, onset, v.braking_capacity_mps2, v.driving_capacity_mps2, v.speed_limit_mps,
        vehicle, out,
    )  # fmt: skip
    reason = out[:, REASON].astype(np.int64)
    start = worlds.time_s + onset[:, vehicle]
    switch = np.column_stack([worlds.time_s, start + out[:, DRIVE], start + out[:, TOUCH]])
    braking = -v.braking_capacity_mps2[:, vehicle]
    command = np.column_stack([v.driving_capacity_mps2[:, vehicle], braking, out[:, FOLLOW]])
    switch[reason > 0] = np.nan
    command[reason > 0] = np.nan
    return Avoidability(reason, out[:, MARGIN].copy(), switch, command)


def _check_covered(worlds: Worlds, vehicle: int, scripts: Mapping[int, str] | None) -> None:
    """Raise ``InvalidInput`` for what ``avoidability`` does not cover, but for brakes that build up."""
    # An obstacle that Vehicle 1 cannot reach by braking fully changes nothing: only a push could bring it there, and
    # that is an impact already.
    check_whole_number("avoidability: vehicle", vehicle, 0, worlds.N - 1)
    own = np.maximum(worlds.vehicles.latency_s[:, 0] - worlds.time_s, 0.0)
    v = worlds.vehicles
    way = stopping_distances(worlds.speeds_mps[:, 0], own, v.braking_capacity_mps2[:, 0], v.brake_rate_mps3[:, 0])
    _refuse(
        ~(way < worlds.obstacle_gap_m),
        worlds.obstacle_gap_m,
        "obstacle_gap_m",
        None,
        "beyond full braking of vehicle_1",
    )
    if vehicle == 0 and np.isfinite(worlds.obstacle_gap_m).any():
        raise InvalidInput("avoidability: vehicle_1 controlled, with an obstacle ahead (obstacle_gap_m): not decided")
    if (worlds.N, vehicle) not in ((3, 1), (2, 0), (2, 1)):
        raise InvalidInput(
            f"avoidability: vehicle_{vehicle + 1} of {worlds.N} vehicles; it is decided for vehicle_2 of 3 and for"
            " either vehicle of 2"
        )
    for index, script in (scripts or {}).items():
        if index != vehicle and script != "full_brake":
            raise InvalidInput(f"avoidability: vehicle_{index + 1} follows {script!r}; must be 'full_brake'")
    if vehicle == 1:
        latency = np.maximum(worlds.vehicles.latency_s, worlds.time_s[:, None])
        _refuse(latency[:, 0] > latency[:, 1], worlds.vehicles.latency_s[:, 0], "latency_s", 0, "not above vehicle_2's")
    for i in range(worlds.N):
        _refuse(~(worlds.speeds_mps[:, i] >= 0.0), worlds.speeds_mps[:, i], "speeds_mps", i, ">= 0")


def _refuse(bad: Bools, values: Floats, name: str, i: int | None, right: str) -> None:
    if bad.any():
        k = int(np.argmax(bad))
        place = f"{k}" if i is None else f"{k}, {i}"
        raise InvalidInput(f"avoidability: {name}[{place}] = {values[k]:g}: must be {right}")


# Compiled: the gentlest first meeting of the controlled vehicle with a neighbour at a given time.
#
# Times count from the moment at which the controlled vehicle may act; the front vehicle (leader, l) brakes by then, f
# is the controlled one, the rear vehicle (r) coasts to its onset and then brakes. All speeds and gaps are >= 0.
# docs/avoidability.md has the proofs.


class _Line(NamedTuple):
    """Entries of one world when the controlled vehicle, the follower, may act."""

    GAP_L: int = 0
    V_L: int = 1
    A_L: int = 2
    V_F: int = 3
    A_F: int = 4
    U_F: int = 5
    LIMIT_F: int = 6
    GAP_R: int = 7
    V_R: int = 8
    A_R: int = 9
    ONSET_R: int = 10
    FRONT_SHARE: int = 11  # m_l / (m_l + m_f)
    REAR_SHARE: int = 12  # m_r / (m_f + m_r)
    RESTITUTION: int = 13
    TIME_STEP: int = 14  # between two decisions (s), the first one now; 0 where commands may change at any time
    OBSTACLE: int = (
        15  # gap from the leader to an obstacle ahead of it (m), which it does not reach by itself; inf without
    )
    # only where brakes build up: accelerations in force (m/s2); rates of falling, of rising (m/s3)
    FORCE_L: int = 16
    FALL_L: int = 17
    FORCE_F: int = 18
    FALL_F: int = 19
    RISE_F: int = 20
    FORCE_R: int = 21
    FALL_R: int = 22
    UNTIL: int = 23  # the horizon (s); 0 where it was not told
    WALL: int = 24  # OBSTACLE where an impact with it counts and the rear vehicle brakes fully; else 0
    WIDTH: int = 25


LINE = _Line()


FRONT_FIRST, REAR_FIRST = 0, 1
RAMPED_FRONT, RAMPED_REAR = 2, 3  # the same where brakes build up
_HALVINGS = 60
_GUARD = 2.0**-46  # of the positions: a way that rounding shortens must not make a meeting look harder
AHEAD_M = 1e-9  # an overlap up to this is no meeting with the other vehicle


@compiled
def leader(at: Floats, time: float) -> tuple[float, float]:
    """Speed and way of the front vehicle, left alone until ``time``."""
    speed, way, _ = solo_motion(at[LINE.V_L], -at[LINE.A_L], 0.0, math.inf, time)
    return speed, way


@compiled
def follower(at: Floats, time: float) -> tuple[float, float]:
    """Speed and way of the rear vehicle, left alone until ``time``."""
    speed, way, _ = solo_motion(at[LINE.V_R], -at[LINE.A_R], at[LINE.ONSET_R], math.inf, time)
    return speed, way


@compiled(apart=True)
def gentlest_front(at: Floats, time: float) -> tuple[float, float]:
    """Least closing speed of a meeting with the leader at ``time``, and how long it must be driven before braking.

    The slowest way to be there then: drive, then brake.
    """
    v_l, way = leader(at, time)
    place, v, u, a = at[LINE.GAP_L] + way, at[LINE.V_F], at[LINE.U_F], at[LINE.A_F]
    cap = time_to_limit(v, u, at[LINE.LIMIT_F])
    drive = u if cap > 0.0 else 0.0
    driven = (v + 0.5 * drive * time) * time
    beyond = 0.5 * drive * max(time - cap, 0.0) * max(time - cap, 0.0)
    guard = _GUARD * (driven + place)
    brake = math.sqrt(2.0 * max(driven - beyond - place + guard, 0.0) / a)
    top = v + drive * cap
    if time - brake < cap:
        brake = math.sqrt(2.0 * max(driven - place + guard, 0.0) / (drive + a))
        top = v + drive * (time - brake)
    if brake > time:
        brake, top = time, v
    return max(top - a * brake - v_l, 0.0), time - brake


@compiled
def braked_then_driven(at: Floats, brake: float, time: float) -> tuple[float, float]:
    """Way and speed at ``time`` of one that brakes for ``brake`` (at most to rest), then drives."""
    v, u, a = at[LINE.V_F], at[LINE.U_F], at[LINE.A_F]
    braking = min(brake, v / a)
    slow = max(v - a * brake, 0.0)
    cap = time_to_limit(slow, u, at[LINE.LIMIT_F])
    drive = u if cap > 0.0 else 0.0
    left = time - brake
    beyond = max(left - cap, 0.0)
    way = (v - 0.5 * a * braking) * braking + (slow + 0.5 * drive * left) * left - 0.5 * drive * beyond * beyond
    return way, slow + drive * (left - beyond)


@compiled(apart=True)
def braking_to_rear(at: Floats, time: float, further: float) -> float:
    """How long it must be braked to be met by the rear vehicle at ``time``, if it is driven from then on.

    Or by one that has come ``further`` than the rear vehicle by full braking (m).
    """
    place = follower(at, time)[1] - at[LINE.GAP_R] + further
    low, high = 0.0, time
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if braked_then_driven(at, middle, time)[0] >= place:
            low = middle
        else:
            high = middle
    return low


@compiled(apart=True)
def gentlest_rear(at: Floats, time: float) -> tuple[float, float]:
    """Least closing speed of a meeting with the rear vehicle at ``time``, and how long it must be braked before.

    The fastest way to be there then: brake, then drive. The braking is infinite where that is at its speed limit.
    """
    brake = braking_to_rear(at, time, 0.0)
    speed = braked_then_driven(at, brake, time)[1]
    return max(follower(at, time)[0] - speed, 0.0), brake if speed < at[LINE.LIMIT_F] else math.inf


@compiled(apart=True)
def gentlest(kind: int, at: Floats, time: float) -> tuple[float, float]:
    """``gentlest_front`` or ``gentlest_rear``, or ``gentlest_ramped``."""
    if kind >= RAMPED_FRONT:
        return gentlest_ramped(kind, at, time), 0.0
    return gentlest_front(at, time) if kind == FRONT_FIRST else gentlest_rear(at, time)


@compiled(apart=True)
def meet_front(at: Floats, drive: float, plan: Floats, other: Floats) -> float:
    """When one that drives for ``drive``, then brakes, meets the leader."""
    fill_drive_then_brake(plan, at[LINE.V_F], at[LINE.U_F], at[LINE.LIMIT_F], drive, at[LINE.A_F])
    fill_braking(other, 0.0, at[LINE.A_L])
    return walk(at[LINE.GAP_L], at[LINE.V_L], other, at[LINE.V_F], plan, math.inf)[1]


@compiled(apart=True)
def meet_rear(at: Floats, brake: float, plan: Floats, other: Floats) -> float:
    """When the rear vehicle meets one that brakes for ``brake``, then drives."""
    fill_brake_then_drive(plan, at[LINE.V_F], at[LINE.U_F], at[LINE.LIMIT_F], brake, at[LINE.A_F])
    fill_braking(other, at[LINE.ONSET_R], at[LINE.A_R])
    return walk(
        at[LINE.GAP_R], at[LINE.V_F], plan, at[LINE.V_R], other, at[LINE.ONSET_R] + at[LINE.V_R] / at[LINE.A_R]
    )[1]


@compiled(apart=True)
def stays_ahead(at: Floats, drive: float, until: float, plan: Floats, other: Floats) -> bool:
    """Whether one that drives for ``drive``, then brakes, is not met from behind until then."""
    fill_drive_then_brake(plan, at[LINE.V_F], at[LINE.U_F], at[LINE.LIMIT_F], drive, at[LINE.A_F])
    fill_braking(other, at[LINE.ONSET_R], at[LINE.A_R])
    return walk(at[LINE.GAP_R], at[LINE.V_F], plan, at[LINE.V_R], other, until)[0] >= -AHEAD_M


@compiled(apart=True)
def stays_behind(at: Floats, brake: float, until: float, plan: Floats, other: Floats) -> bool:
    """Whether one that brakes for ``brake``, then drives, does not meet the leader until then."""
    fill_brake_then_drive(plan, at[LINE.V_F], at[LINE.U_F], at[LINE.LIMIT_F], brake, at[LINE.A_F])
    fill_braking(other, 0.0, at[LINE.A_L])
    return walk(at[LINE.GAP_L], at[LINE.V_L], other, at[LINE.V_F], plan, until)[0] >= -AHEAD_M


# Compiled: how much faster than the common speed of two touching vehicles one of them can be, and what that costs.
#
# ``share`` is the partner's share of both masses; ``press`` the acceleration with which they close under the best
# command (m/s2), ``reach`` how much of it a command can hold back. docs/avoidability.md has the proofs.


@compiled
def flight_lead(share: float, press: float, reach: float, opening: float, flight: float) -> float:
    """How far ahead of the common speed a flight of this length can bring the controlled vehicle, less what it costs.

    ``share (press L - o) - G``, where G is the least loss of command, at most ``reach`` a second, that keeps the two
    apart for L: ``G L - G^2 / 2 reach >= press L^2 / 2 - o L``. -inf where nothing keeps them apart. [m/s]
    """
    relative = share * (press * flight - opening)
    if press * flight <= 2.0 * opening:
        return relative
    if reach == math.inf:
        return relative - (0.5 * press * flight - opening)
    inside = reach * (reach - press) * flight * flight + 2.0 * reach * opening * flight
    if inside < 0.0:
        return -math.inf
    return relative - reach * flight + math.sqrt(inside)


@compiled
def best_flight(share: float, press: float, reach: float, opening: float) -> float:
    """The length of the flight of the largest ``flight_lead``; inf if it rises for ever."""
    if press <= 0.0:
        return math.inf
    if share <= 0.5:
        return 2.0 * opening / press
    if reach == math.inf:
        return math.inf
    slope = reach - share * press
    left = slope * slope - reach * (reach - press)
    if left <= 0.0:
        return math.inf
    root = math.sqrt(left)
    return max(reach * opening / (root * (slope + root)), 2.0 * opening / press)


@compiled(apart=True)
def lead(
    share: float, press: float, reach: float, opening: float, shortest: float, longest: float, lost: float
) -> float:
    """Largest ``flight_lead`` of lengths from ``shortest`` to ``longest``, of which ``lost`` is lost in any case.

    Of all openings up to ``opening``: where flights are cut short, a smaller one may lead further.
    """
    if press > 0.0:
        opening = min(opening, 0.5 * press * longest)
    flight = best_flight(share, press, reach, opening)
    if lost > 0.0 and press > 0.0:
        both = opening + lost
        flight = max(flight, (both + math.sqrt(max(both * both - press * lost * lost / reach, 0.0))) / press)
    flight = min(max(flight, shortest), longest)
    most = share * press * flight - lost if press > 0.0 else -lost
    if flight < longest and press > 0.0:
        most -= share * opening
    return min(flight_lead(share, press, reach, opening, flight), most) if press > 0.0 else most


@compiled
def decays(share: float, press: float, reach: float, bounce: float) -> bool:
    """Whether no loss of command pays that makes a later bounce larger; ``reach`` then bounds what flights gain."""
    if share <= 0.5:
        return True
    if reach == math.inf or press <= 0.0:
        return False
    if reach > press:
        return bounce * (math.sqrt(reach / (reach - press)) - share) <= 1.0 - share
    return bounce * flight_lead(share, press, reach, 1.0, best_flight(share, press, reach, 1.0)) <= 1.0 - share


@compiled(apart=True)
def largest_lead(
    share: float, press: float, reach: float, bounce: float, opening: float, lost: float, late: float, end: float,
    since: float, until: float,
) -> float:  # fmt: skip
    """How much faster than the common speed, without loss, it can be between ``since`` and ``until``. [m/s]

    The last flight before the rear meeting began with the first impact, after the window from ``late`` to ``end`` in
    which ``lost`` is lost, or within it. ``reach`` is inf where ``press`` is not constant.
    """
    if since < end:
        lost, end = 0.0, late
    if not decays(share, press, reach, bounce):
        return lead(share, press, math.inf, opening, 0.0, until, lost)
    shortest = 0.0 if reach == math.inf else max(since - late, 0.0)
    longest = math.inf if share > 0.5 and reach <= press else until
    first = lead(share, press, reach, opening, shortest, longest, lost)
    again = bounce * (opening + lost)
    result = max(first, lead(share, press, reach, again, 0.0, longest, 0.0) - (1.0 - share) * lost)
    if lost > 0.0:
        gain = max((1.0 + bounce) * share - 1.0, 2.0 * share - 1.0)
        within = lead(share, press, reach, bounce * opening, 0.0, longest, 0.0) + gain * lost
        shortest = 0.0 if reach == math.inf else since - end
        within = min(within, lead(share, press, reach, again, shortest, longest, 0.0))
        result = max(result, min(within, share * press * until - (1.0 - share) * lost))
    return result


@compiled
def widest_flight(
    share: float, slack: float, press: float, drive: float, bounce: float, closing: float, back: float, time: float
) -> float:
    """Most of ``sqrt(p^2 + 2 press s)`` in every flight from a partner that brakes harder by ``slack``; inf if unknown.

    p is the speed with which the two part, s their gap. The first impact had ``closing`` and left the vehicle with
    speed ``-back``. All within ``time``; ``drive`` is the most that a command accelerates. [m/s]
    """
    if not slack > 0.0 or not bounce * bounce * press < slack:
        return math.inf
    grow = bounce * bounce * press / slack
    roll = max(share * (1.0 + bounce) - 1.0, 0.0)
    return max(
        math.sqrt(grow * closing * closing + 2.0 * drive * back * time), 2.0 * drive * roll * time / (1.0 - grow)
    )


# Compiled: the harm at the other pair that must follow a first meeting, whatever the controlled vehicle does then.
#
# A first meeting at ``time`` with ``closing`` leaves a state that is known exactly. From it on, the centre of mass of
# the two moves on a path that no command improves but the extreme one, and the controlled vehicle is faster (slower)
# than the centre only while it comes back to its partner. ``lead`` bounds that. docs/avoidability.md has the proofs.
#
# A cell of meetings lies between ``early`` and ``late``; its state is taken at ``early``. From ``late`` to ``end`` the
# command of the decision before is still in force, which lacks at least ``lack`` of the extreme one (m/s2).

LARGE = 1e6  # m2/s2: more harm than any impact of vehicles does
STRUCK_M = 1e-6  # nearer than this a leader counts as touching the obstacle
HELD_M = 1e-6  # more room than rounding can make of the gap to the leader
LEADS = (0.02, 0.05, 0.1, 0.2, 0.4)  # s before the latest meeting at which the time is divided, to bound both parts


@compiled
def least_of_line(
    start: float, slope: float, turn: float, bend: float, other_turn: float, other_bend: float, since: float,
    until: float,
) -> float:  # fmt: skip
    """Least value of ``start + slope t + bend (t - turn)+ + other_bend (t - other_turn)+`` from since to until."""
    least = math.inf
    for time in (since, until, min(max(turn, since), until), min(max(other_turn, since), until)):
        value = start + slope * time + bend * max(time - turn, 0.0) + other_bend * max(time - other_turn, 0.0)
        least = min(least, value)
    return least


@compiled(apart=True)
def least_closing(
    start: float, slope: float, turn: float, bend: float, other_turn: float, other_bend: float, share: float,
    press: float, reach: float, bounce: float, opening: float, lost: float, late: float, end: float, until: float,
) -> float:  # fmt: skip
    """Least closing speed of a second meeting at most ``until``: that of the common speed, less the lead.

    The time is divided at one of a few moments: what was lost in the window counts only after it.
    """
    best = least_of_line(start, slope, turn, bend, other_turn, other_bend, 0.0, until)
    best -= largest_lead(share, press, reach, bounce, opening, lost, late, end, 0.0, until)
    for k in range(len(LEADS)):
        since = until - LEADS[k]
        if since <= 0.0:
            break
        near = least_of_line(start, slope, turn, bend, other_turn, other_bend, since, until)
        near -= largest_lead(share, press, reach, bounce, opening, lost, late, end, since, until)
        far = least_of_line(start, slope, turn, bend, other_turn, other_bend, 0.0, since)
        far -= largest_lead(share, press, reach, bounce, opening, 0.0, late, late, 0.0, since)
        best = max(best, min(near, far))
    return max(best, 0.0)


@compiled(apart=True)
def pushed_by_leader(
    at: Floats, early: float, late: float, closing: float, end: float, lack: float, plan: Floats, other: Floats
) -> float:
    """Least closing speed at the rear, from the centre of mass of leader and controlled vehicle; 0: not proven.

    A leader that stands keeps its place, so a later meeting is the same one later: only what holds for all counts.
    """
    share, rest, press = at[LINE.FRONT_SHARE], 1.0 - at[LINE.FRONT_SHARE], at[LINE.U_F] + at[LINE.A_L]
    v_l, way_l = leader(at, early)
    v_r, way_r = follower(at, early)
    bounce = at[LINE.RESTITUTION]
    speed, push = v_l + rest * closing, rest * at[LINE.U_F] - share * at[LINE.A_L]
    stand = (speed + rest * bounce * closing) / at[LINE.A_L]
    late, end, lost = late - early, end - early, lack * (end - late)
    if v_l <= 0.0:
        late, end, lack, lost = 0.0, 0.0, 0.0, 0.0
    fill_window(plan, push, late, end, -rest * lack, stand, share * at[LINE.A_L])
    onset = max(at[LINE.ONSET_R] - early, 0.0)
    fill_braking(other, onset, at[LINE.A_R])
    behind = max(at[LINE.GAP_L] + at[LINE.GAP_R] + way_l - way_r, 0.0)
    until = walk(behind, speed, plan, v_r, other, onset + v_r / at[LINE.A_R])[1]
    if until == math.inf:
        return 0.0
    reach = (
        at[LINE.U_F] + at[LINE.A_F] if until * at[LINE.A_L] <= v_l else math.inf
    )  # the leader moves, however soft the impact
    if v_l <= 0.0:
        slowest = max(v_r - at[LINE.A_R] * max(until - onset, 0.0), 0.0)
        least = least_of_line(slowest - speed, -push, 0.0, 0.0, stand, -share * at[LINE.A_L], 0.0, until)
        return max(least - largest_lead(share, press, reach, bounce, bounce * closing, 0.0, 0.0, 0.0, 0.0, until), 0.0)
    return least_closing(
        v_r - speed, -push, onset, -at[LINE.A_R], stand, -share * at[LINE.A_L],
        share, press, reach, bounce, bounce * closing, lost, late, end, until,
    )  # fmt: skip


@compiled(apart=True)
def held_by_leader(at: Floats, early: float, late: float, closing: float, plan: Floats, other: Floats) -> float:
    """Least closing speed at the rear of one that cannot fall far behind a leader of harder brakes; 0: not proven."""
    share, rest, bounce = at[LINE.FRONT_SHARE], 1.0 - at[LINE.FRONT_SHARE], at[LINE.RESTITUTION]
    v_l, way_l = leader(at, early)
    v_r, way_r = follower(at, early)
    back = max((share * bounce - rest) * closing - leader(at, late)[0], 0.0)
    thrown = share * (1.0 + bounce) > 1.0
    drive = max(at[LINE.U_F], at[LINE.A_F]) if thrown else at[LINE.U_F]
    press, push, speed = drive + at[LINE.A_L], rest * drive - share * at[LINE.A_L], v_l + rest * closing
    behind = max(at[LINE.GAP_L] + at[LINE.GAP_R] + way_l - way_r, 0.0)
    onset = max(at[LINE.ONSET_R] - early, 0.0)
    until, most, start = onset + v_r / at[LINE.A_R], 0.0, speed
    fill_braking(other, onset, at[LINE.A_R])
    for _ in range(2):
        most = widest_flight(share, at[LINE.A_L] - at[LINE.A_F], press, drive, bounce, closing, back, until)
        if most == math.inf:
            return 0.0
        start = max(speed, rest * most)
        turn = (start - rest * most) / -push if push < 0.0 else math.inf
        fill_plan(plan, turn, push, turn, 0.0, turn, 0.0, 0.0)
        until = walk(behind, start, plan, v_r, other, math.inf)[1]
        if until == math.inf:
            return 0.0
    final = max(start + push * until, rest * most)
    slowest = max(v_r - at[LINE.A_R] * max(until - onset, 0.0), 0.0)
    if v_l <= 0.0:
        return float(max(slowest - max(start, final) - share * most, 0.0))
    room = 0.5 * most * most / (drive if thrown else press) + HELD_M if press > 0.0 else math.inf
    since = 0.0
    if behind > room:
        fill_braking(plan, 0.0, at[LINE.A_L])
        since = min(walk(behind - room, v_l, plan, v_r, other, math.inf)[1], until)
    fast = max(v_r - at[LINE.A_R] * max(since - onset, 0.0), 0.0) - max(start + push * since, rest * most)
    return float(max(min(fast, slowest - final) - share * most, 0.0))


@compiled(apart=True)
def after_front(
    at: Floats, early: float, late: float, closing: float, end: float, lack: float, plan: Floats, other: Floats
) -> float:
    """Least squared closing speed at the rear after the leader was met from ``early`` on with at most ``closing``.

    What is known of the centre of mass does not hold where an obstacle may throw both back.
    """
    share, rest = at[LINE.FRONT_SHARE], 1.0 - at[LINE.FRONT_SHARE]
    v_l, way_l = leader(at, early)
    v_r, way_r = follower(at, early)
    speed = v_l + rest * closing
    if share * (1.0 + at[LINE.RESTITUTION]) <= 1.0:
        speed -= share * at[LINE.RESTITUTION] * closing
    onset = max(at[LINE.ONSET_R] - early, 0.0)
    fill_drive_then_brake(plan, speed, at[LINE.U_F], at[LINE.LIMIT_F], math.inf, at[LINE.A_F])
    fill_braking(other, onset, at[LINE.A_R])
    behind = max(at[LINE.GAP_L] + at[LINE.GAP_R] + way_l - way_r, 0.0)
    squared = walk(behind, speed, plan, v_r, other, onset + v_r / at[LINE.A_R])[2]
    if at[LINE.OBSTACLE] < math.inf:
        return squared
    held = held_by_leader(at, early, late, closing, plan, other)
    squared = max(squared, held * held)
    if rest < at[LINE.RESTITUTION] * share:
        return squared
    pushed = pushed_by_leader(at, early, late, closing, end, lack, plan, other)
    return max(squared, pushed * pushed)


@compiled
def obstacle_harm(at: Floats, late: float, closing: float) -> float:
    """Least squared speed at which the leader, met by ``late``, meets the obstacle ahead: only its own brakes slow it.

    None is certain where it stands at the obstacle already: all three are one cluster then.
    """
    if not STRUCK_M < at[LINE.OBSTACLE] - at[LINE.V_L] * at[LINE.V_L] / (2.0 * at[LINE.A_L]) < math.inf:
        return 0.0
    push = (1.0 - at[LINE.FRONT_SHARE]) * (1.0 + at[LINE.RESTITUTION]) * closing
    lacks = 2.0 * at[LINE.A_L] * at[LINE.OBSTACLE] - at[LINE.V_L] * at[LINE.V_L]
    v = leader(at, late)[0] + push
    squared = max((2.0 * v - push) * push - lacks, 0.0)
    if 0.0 < at[LINE.UNTIL] <= late + (v - math.sqrt(squared)) / at[LINE.A_L]:
        return 0.0
    return float(squared)


@compiled(apart=True)
def braking_after(
    gap: float, least_gap: float, v_l: float, a_l: float, v_f: float, a_f: float, plan: Floats, other: Floats
) -> float:
    """Least squared closing speed with the leader of one that brakes at most with ``a_f``; 0 if none is certain.

    Its gap is at most ``gap``, and at least ``least_gap`` where it matters: behind a leader that brakes harder.
    """
    fill_braking(plan, 0.0, a_l)
    fill_braking(other, 0.0, a_f)
    squared = walk(gap, v_l, plan, v_f, other, v_f / a_f)[2]
    if a_f < a_l:
        w = max(v_f - v_l, 0.0)
        squared = min(squared, w * w + 2.0 * (a_l - a_f) * max(least_gap, 0.0))
    return squared


@compiled(apart=True)
def pushed_by_rear(
    at: Floats, early: float, late: float, closing: float, end: float, lack: float, gap: float, plan: Floats,
    other: Floats,
) -> float:  # fmt: skip
    """Least closing speed at the front, from the centre of mass of both other vehicles; for ``a_f >= a_r``."""
    share, rest = at[LINE.REAR_SHARE], 1.0 - at[LINE.REAR_SHARE]
    v_l = leader(at, early)[0]
    bounce = at[LINE.RESTITUTION]
    speed = max(follower(at, early)[0] - rest * closing, 0.0)
    onset = max(at[LINE.ONSET_R] - early, 0.0)
    late, end, lost = late - early, end - early, lack * (end - late)
    fill_braking(plan, 0.0, at[LINE.A_L])
    fill_window(other, -rest * at[LINE.A_F], late, end, rest * lack, onset, -share * at[LINE.A_R])
    until = walk(gap, v_l, plan, speed, other, math.inf)[1]
    if until == math.inf:
        return 0.0
    press, reach = at[LINE.A_F] - at[LINE.A_R], at[LINE.U_F] + at[LINE.A_F]
    if onset > 0.0:
        press, reach = at[LINE.A_F], math.inf
    return least_closing(
        speed - v_l, at[LINE.A_L] - rest * at[LINE.A_F], onset, -share * at[LINE.A_R], v_l / at[LINE.A_L],
        -at[LINE.A_L], share, press, reach, bounce, bounce * closing, lost, late, end, until,
    )  # fmt: skip


@compiled(apart=True)
def slowed_by_rear(at: Floats, early: float, closing: float, gap: float, plan: Floats, other: Floats) -> float:
    """Least closing speed at the front of one that stays ahead of both; for ``a_f >= a_r``. 0 where it may rise."""
    share, v_l = at[LINE.REAR_SHARE], leader(at, early)[0]
    pooled = (1.0 - share) * at[LINE.A_F] + share * at[LINE.A_R]
    mean = 0.5 * (at[LINE.A_F] + pooled)
    speed = follower(at, early)[0] - (1.0 - share) * closing
    if not (mean >= at[LINE.A_L] and speed > 0.0):
        return 0.0
    fill_braking(plan, 0.0, at[LINE.A_L])
    fill_braking(other, 0.0, pooled)
    until = walk(gap, v_l, plan, speed, other, speed / pooled)[1]
    return max(speed - mean * until - max(v_l - at[LINE.A_L] * until, 0.0), 0.0) if until < math.inf else 0.0


# Compiled: what follows where an obstacle stands ahead. docs/proofs/lower-bound-obstacle.md has the proofs.
#
# ``beyond`` is the squared speed with which the leader meets the obstacle; it bounds how far ahead the leader is.
# Places count from that of the controlled vehicle at its onset, masses in its own.

CELL = 1e-3  # a minimum is bounded this closely, relative to 1 m2/s2 and to itself
ZONE_M = 1.0  # of the obstacle: where the controlled vehicle is taken to be once it was stopped there, if it can be
_BEYOND_PARTS, _BEYOND_FINEST = 4, 4  # into which the values of ``beyond`` are divided, and those that matter again
_MOST = 400.0  # m2/s2 at the rear that count
_FLIGHTS = 6  # lengths of a last drive that are tried
_SHORTEST_S = 1e-3  # of them


@compiled
def all_three(at: Floats) -> tuple[float, float, float, float]:
    """Masses of leader and rear vehicle; how fast the centre of all slows at most, and what is the rear one's of it."""
    front, rear = at[LINE.FRONT_SHARE] / (1.0 - at[LINE.FRONT_SHARE]), at[LINE.REAR_SHARE] / (1.0 - at[LINE.REAR_SHARE])
    whole = front + 1.0 + rear
    return front, rear, (front * at[LINE.A_L] + max(at[LINE.A_F], at[LINE.A_R])) / whole, rear * at[LINE.A_R] / whole


@compiled
def leader_pushed(at: Floats, early: float, beyond: float) -> tuple[float, float]:
    """Speed of a leader pushed at ``early`` so as to meet the obstacle with ``sqrt(beyond)``; and when it does."""
    v = math.sqrt(max(beyond + 2.0 * at[LINE.A_L] * (at[LINE.WALL] - leader(at, early)[1]), 0.0))
    return v, early + (v - math.sqrt(beyond)) / at[LINE.A_L]


@compiled(apart=True)
def least_beyond(
    at: Floats, early: float, late: float, place: float, speed: float, least: float, plan: Floats, other: Floats
) -> float:
    """``least`` or more: the centre of all three must not be at the obstacle before the leader, pushed at ``early``.

    It is at ``late`` at least at ``place``, with ``speed``.
    """
    if not speed > 0.0:
        return least
    _, _, pull, rear_pull = all_three(at)
    onset = max(at[LINE.ONSET_R] - late, 0.0)
    fill_plan(plan, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    fill_plan(other, onset, -pull, onset, 0.0, onset, 0.0, -pull - rear_pull)
    wall = at[LINE.GAP_L] + at[LINE.WALL]
    time = late - early + walk(max(wall - place, 0.0), 0.0, plan, speed, other, math.inf)[1]
    if not _SHORTEST_S < time < at[LINE.UNTIL] - early:
        return least
    v = (at[LINE.WALL] - leader(at, early)[1]) / time - 0.5 * at[LINE.A_L] * time
    return float(max(least, v * v)) if v > 0.0 else least


@compiled(apart=True)
def slowest(at: Floats, early: float, late: float, faster: float) -> tuple[float, float, float]:
    """Place and speed at ``late``, at least, of one that left a meeting this much faster than the leader; its brakes.

    They are the hardest of all three, so that nothing falls further behind.
    """
    v_l, way = leader(at, late)
    brakes = max(at[LINE.A_F], at[LINE.A_L], at[LINE.A_R])
    slack = brakes - at[LINE.A_L] if late * at[LINE.A_L] <= at[LINE.V_L] else brakes
    span = late - early
    return at[LINE.GAP_L] + way - 0.5 * slack * span * span, max(v_l + faster - slack * span, 0.0), brakes


@compiled
def last_drive(room: float, speed: float, brakes: float, drive: float, time: float) -> float:
    """How long one must drive at the end to be ``room`` further after ``time``, if it brakes before; inf: it cannot."""
    stand = speed / brakes
    if time > stand:
        flight = math.sqrt(2.0 * max(room - 0.5 * speed * stand, 0.0) / drive) if drive > 0.0 else math.inf
        if time - flight > stand:
            return flight
    return math.sqrt(2.0 * max(room - (speed - 0.5 * brakes * time) * time, 0.0) / (brakes + drive))


@compiled(apart=True)
def stopped_there(
    at: Floats, early: float, late: float, hard: float, beyond: float, struck: float, until: float, place: float,
    speed: float, brakes: float,
) -> tuple[float, float, float]:  # fmt: skip
    """How far from the obstacle, how fast backward and for how long one can be that the leader stopped there.

    The zone is infinite where that is not known.
    """
    bounce, drive, wall = at[LINE.RESTITUTION], at[LINE.U_F], at[LINE.GAP_L] + at[LINE.WALL]
    v_l, way = leader(at, early)
    most, top = at[LINE.WALL] - way, v_l + hard
    fastest = math.sqrt(top * top + 2.0 * drive * most)
    soonest = early + 2.0 * most / max(top + fastest, _SHORTEST_S)
    wait = max(until - max(soonest, struck, late), 0.0)
    back = bounce * max((1.0 - at[LINE.FRONT_SHARE]) * (1.0 + bounce), 1.0)
    # what it arrives with falls with the time, until it can stop on the way
    time, stand, room = max(struck, late) - late, speed / brakes, wall - place
    flight = last_drive(room, speed, brakes, drive, time)
    if time < stand and flight <= time and room > (speed - 0.5 * brakes * time) * time:
        quick = speed - brakes * (time - flight) + drive * flight
        quick = max(quick * quick, 2.0 * drive * (room - 0.5 * speed * stand)) + 2.0 * drive * ZONE_M
        quick = back * math.sqrt(max(quick, beyond))
        near = 0.5 * quick * quick / at[LINE.A_L]
        if near + quick * wait < ZONE_M:
            return near, quick, wait
    back *= fastest
    near = 0.5 * back * back / at[LINE.A_L]
    return near if near + back * wait < most else math.inf, back, wait


@compiled(apart=True)
def behind_leader(
    at: Floats, early: float, late: float, soft: float, hard: float, beyond: float, place: float, speed: float,
    plan: Floats, other: Floats,
) -> float:  # fmt: skip
    """Least squared closing speed at the rear after such a meeting with the leader, which nobody passes; LARGE: none.

    The leader meets the obstacle with at most ``sqrt(beyond)``. The centre of all three is at ``late`` at least at
    ``place``, with ``speed``.
    """
    wall, drive, onset = at[LINE.GAP_L] + at[LINE.WALL], at[LINE.U_F], at[LINE.ONSET_R]
    kept = 1.0 - at[LINE.FRONT_SHARE] * (1.0 + at[LINE.RESTITUTION])
    # until when the rear vehicle must have come: at the leader, or at the obstacle
    v_l, way_l = leader(at, early)
    v_r, way_r = follower(at, early)
    v, struck = leader_pushed(at, early, beyond)
    gap = max(at[LINE.GAP_L] + at[LINE.GAP_R] + way_l - way_r, 0.0)
    fill_braking(plan, 0.0, at[LINE.A_L])
    fill_braking(other, max(onset - early, 0.0), at[LINE.A_R])
    until = early + walk(gap, v, plan, v_r, other, struck - early)[1]
    at_wall = until > struck
    if at_wall:
        until = early + walk(gap + at[LINE.WALL] - way_l, 0.0, plan, v_r, other, math.inf)[1]
    least, low, brakes = slowest(at, early, late, kept * soft)
    time, stand = until - late, low / brakes
    if not _SHORTEST_S < time < math.inf:
        return 0.0
    # how fast the controlled one can be then: it was never further back than by braking, or than it was stopped
    v_r, goal = follower(at, until)
    goal -= at[LINE.GAP_R]
    longest = last_drive(goal - least, low, brakes, drive, time)
    near, back, wait = 0.0, 0.0, 0.0
    if at_wall:
        near, back, wait = stopped_there(at, early, late, hard, beyond, struck, until, least, low, brakes)
        if near == math.inf:
            return 0.0
        room = goal - near - back * wait - least
        left = low * low - 2.0 * brakes * room
        if left >= 0.0:
            longest = max(longest, time - 2.0 * room / (low + math.sqrt(left)))
    elif goal < least + (low - 0.5 * brakes * min(time, stand)) * min(time, stand) - AHEAD_M:
        return LARGE
    fastest = v_l + kept * hard + drive * (until - early)
    for k in range(_FLIGHTS if at_wall else 1):
        flight = min(max(longest * (1.0 - k / _FLIGHTS), _SHORTEST_S), time)
        braked = min(time - flight, stand)
        behind = least + (low - 0.5 * brakes * braked) * braked
        if at_wall:
            behind = min(behind, wall - near - back * max(wait - flight, 0.0))
        fastest = min(fastest, (goal - behind) / flight + 0.5 * drive * flight)
    closing = max(v_r - fastest, 0.0)
    if not at_wall:
        # what it drove to be met so softly brings all three nearer to the obstacle
        fill_braking(plan, 0.0, brakes)
        fill_braking(other, max(onset - late, 0.0), at[LINE.A_R])
        v_r, way_r = follower(at, late)
        since = min(walk(max(least - way_r + at[LINE.GAP_R], 0.0), low, plan, v_r, other, time)[1], time)
        v_r, way_r = follower(at, late + since)
        v_l, way_l = leader(at, late)
        v_f, weak = v_l + kept * hard, max(at[LINE.A_F], at[LINE.A_R])
        further = way_r - at[LINE.GAP_R] - at[LINE.GAP_L] - way_l - kept * hard * (late - early)
        further -= (v_f - 0.5 * weak * since) * since
        front, rear, pull, rear_pull = all_three(at)
        left = struck - late
        braked = max(left - max(onset - late, 0.0), 0.0)
        room = wall - place - (speed - 0.5 * pull * left) * left + 0.5 * rear_pull * braked * braked
        if left - since > _SHORTEST_S:
            faster, span = (v_r - v_f + weak * since) * (left - since), late - early if since <= 0.0 else 0.0
            faster += further - (front + 1.0 + rear) * room - span * weak * (left + span)
            closing = max(closing, faster / (left - since + span))
    return float(closing * closing)


@compiled(apart=True)
def after_at_obstacle(
    at: Floats, early: float, late: float, soft: float, hard: float, follows: float, plan: Floats, other: Floats
) -> float:
    """Least harm at rear and obstacle after such a meeting with the leader; at the rear it is at least ``follows``."""
    share = at[LINE.FRONT_SHARE]
    least = obstacle_harm(at, late, soft)
    if not at[LINE.WALL] > 0.0 or share * (1.0 + at[LINE.RESTITUTION]) > 1.0:
        return follows + least
    front, rear = all_three(at)[:2]
    v_r, way_r = follower(at, late)
    place, speed, _ = slowest(at, early, late, (1.0 - share) * soft)
    place = ((front + 1.0) * place + rear * (way_r - at[LINE.GAP_R])) / (front + 1.0 + rear)
    speed = ((front + 1.0) * speed + rear * v_r) / (front + 1.0 + rear)
    least = least_beyond(at, early, late, place, speed, least, plan, other)
    # the harder the leader meets the obstacle, the softer the rear vehicle can
    first = min(max(behind_leader(at, early, late, soft, hard, least, place, speed, plan, other), follows), _MOST)
    step, begin, known = (first - follows) / _BEYOND_PARTS, least, least + first
    size, proven = step, known
    while begin + follows < proven:
        squared = max(behind_leader(at, early, late, soft, hard, begin + size, place, speed, plan, other), follows)
        known = min(known, begin + size + squared)
        if begin + squared < known - 10.0 * CELL * (1.0 + known) and size > step / _BEYOND_FINEST:
            size *= 0.5
            continue
        proven = min(proven, begin + squared)
        begin, size = begin + size, step
    return proven


@compiled(apart=True)
def beyond_rear(
    at: Floats, early: float, late: float, closing: float, least: float, plan: Floats, other: Floats
) -> float:
    """``least_beyond`` after the rear vehicle was met with at most ``closing``."""
    v_l, way_l = leader(at, late)
    v_r, way_r = follower(at, late)
    front, rear = all_three(at)[:2]
    lost, slack = closing / (1.0 + rear), max(at[LINE.A_F], at[LINE.A_R]) * (late - early)
    place = way_r - at[LINE.GAP_R] - (lost + 0.5 * slack) * (late - early)
    place = (front * (at[LINE.GAP_L] + way_l) + (1.0 + rear) * place) / (front + 1.0 + rear)
    speed = (front * v_l + (1.0 + rear) * (v_r - lost - slack)) / (front + 1.0 + rear)
    return least_beyond(at, early, late, place, speed, least, plan, other)


@compiled(apart=True)
def after_rear(
    at: Floats, early: float, late: float, closing: float, end: float, lack: float, plan: Floats, other: Floats
) -> float:
    """Least squared closing speed at the front after the rear vehicle was met from ``early`` on with ``closing``."""
    share, rest = at[LINE.REAR_SHARE], 1.0 - at[LINE.REAR_SHARE]
    v_l, way_l = leader(at, early)
    v_r, way_r = follower(at, early)
    speed = v_r - rest * closing
    if share * (1.0 + at[LINE.RESTITUTION]) <= 1.0:
        speed += share * at[LINE.RESTITUTION] * closing
    speed = max(speed - max(at[LINE.A_R] - at[LINE.A_F], 0.0) * (late - early), 0.0)
    gap = max(at[LINE.GAP_L] + at[LINE.GAP_R] + way_l - way_r, 0.0)
    least = gap - max(follower(at, late)[1] - way_r - (leader(at, late)[1] - way_l), 0.0)
    squared = braking_after(gap, least, v_l, at[LINE.A_L], speed, at[LINE.A_F], plan, other)
    if at[LINE.A_F] >= at[LINE.A_R]:
        pushed = pushed_by_rear(at, early, late, closing, end, lack, gap, plan, other)
        pushed = max(pushed, slowed_by_rear(at, early, closing, gap, plan, other))
        squared = max(squared, pushed * pushed)
    if at[LINE.WALL] > 0.0:
        fill_braking(plan, 0.0, at[LINE.A_L])
        fill_braking(other, 0.0, at[LINE.A_F])
        met_by = early + walk(gap, v_l, plan, speed, other, math.inf)[1]
        beyond = obstacle_harm(at, met_by, math.sqrt(squared))
        squared += beyond_rear(at, early, late, closing, beyond, plan, other)
    return squared


@compiled(apart=True)
def after(
    kind: int, at: Floats, early: float, late: float, closing: float, end: float, lack: float, plan: Floats,
    other: Floats,
) -> float:  # fmt: skip
    """``after_front`` or ``after_rear``, or ``after_ramped``."""
    if kind >= RAMPED_FRONT:
        return after_ramped(kind, at, early, late, closing, plan, other)
    if kind == FRONT_FIRST:
        return after_front(at, early, late, closing, end, lack, plan, other)
    return after_rear(at, early, late, closing, end, lack, plan, other)


# Compiled: the least harm over all first meetings with one neighbour, by branch and bound.
#
# A meeting is a time and a closing speed. What it costs is its own closing speed squared and what must follow
# (``aftermath``). Cells of time and closing speed are halved until their bounds come close to the best meeting seen.
# docs/avoidability.md has the proof.

CELLS = 600  # room on the heap: after that many divisions a minimum stays as loose as it is


# columns of a heap, of a cell of meetings: bound; times (s); closing speeds (m/s); of meetings behind also how much
# further the rear vehicle has come (m)
_HARM, _EARLY, _LATE, _SOFT, _HARD, _NEAR, _FAR, HEAP_WIDTH = range(8)
_SPLITS = 64  # parts at most into which decisions divide the times
_PART_S = 0.05  # of the times where brakes build up
_TRIED = 8  # meetings tried before the search, to have something to compare with


@compiled(apart=True)
def gentlest_between(kind: int, at: Floats, early: float, late: float) -> float:
    """Least closing speed of the meetings between two times.

    It falls with the time, but for a leader that brakes harder than the controlled vehicle: it may then rise by the
    difference.
    """
    if kind >= RAMPED_FRONT:
        return gentlest_ramped_between(kind, at, early, late)
    least = gentlest(kind, at, late)[0]
    if kind == FRONT_FIRST and at[LINE.A_L] > at[LINE.A_F] and early * at[LINE.A_L] < at[LINE.V_L]:
        least -= (at[LINE.A_L] - at[LINE.A_F]) * (late - early)
    return max(least, 0.0)


@compiled
def decision_around(at: Floats, early: float, late: float) -> tuple[float, float]:
    """Start and end of the step that holds these times; both ``late`` without decisions or over more than one."""
    step = at[LINE.TIME_STEP]
    if step <= 0.0:
        return late, late
    begin = math.floor(0.5 * (early + late) / step) * step
    if early < begin - 1e-9 or late > begin + step + 1e-9:
        return late, late
    return begin, begin + step


@compiled(apart=True)
def lacking(kind: int, at: Floats, early: float, late: float, softest: float, hard: float, begin: float) -> float:
    """How much the command in force at the meetings of a cell lacks, at least, of the extreme one that follows best.

    To meet gently the vehicle brakes (drives) before a meeting, and to soften what follows it drives (brakes) after it;
    the command is one and the same in the whole step. Meetings of at most ``hard``, where ``softest`` is the least.
    """
    whole = at[LINE.U_F] + at[LINE.A_F]
    turn = gentlest(kind, at, early)[1]
    if early <= begin:
        return 0.0
    if kind == FRONT_FIRST:
        if leader(at, early)[0] + hard >= at[LINE.LIMIT_F]:
            return 0.0
    elif follower(at, late)[0] <= hard:
        return 0.0
    softer = max(hard - softest, 0.0) / (early - begin)
    if turn >= begin:
        share = (turn - begin) / (early - begin)
        return float(max(whole - 2.0 * softer - whole * share * share, 0.0))
    steep = (late - begin) / (begin - turn)
    return float(max(whole - softer * (1.0 + steep) / (1.0 + 0.5 * steep), 0.0))


@compiled(apart=True)
def harm_of(
    kind: int, at: Floats, early: float, late: float, soft: float, hard: float, floor: float, plan: Floats,
    other: Floats,
) -> float:  # fmt: skip
    """Lower bound of the harm of the meetings of a cell."""
    begin, end = decision_around(at, early, late)
    lack = 0.0
    if end > late:
        lack = lacking(kind, at, early, late, gentlest_between(kind, at, early, late), hard, begin)
    follows = after(kind, at, early, late, hard, max(end, late), lack, plan, other)
    follows = max(follows, floor)
    if kind == FRONT_FIRST:
        follows = after_at_obstacle(at, early, late, soft, hard, follows, plan, other)
    return soft * soft + follows


@compiled
def room_for(heap: Floats, count: int, harm: float) -> int:
    """Make room on the heap, whose first cell is the one of least harm, for a cell of this one; its place."""
    at = count
    while at > 0 and heap[(at - 1) // 2, _HARM] > harm:
        for c in range(heap.shape[1]):  # numba compiles the copy of a row with the text of an error, for 3 CPU-s
            heap[at, c] = heap[(at - 1) // 2, c]
        at = (at - 1) // 2
    heap[at, _HARM] = harm
    return at


@compiled(apart=True)
def put(heap: Floats, count: int, harm: float, early: float, late: float, soft: float, hard: float) -> int:
    """Put a cell on the heap; the new number of cells."""
    at = room_for(heap, count, harm)
    heap[at, _EARLY], heap[at, _LATE], heap[at, _SOFT], heap[at, _HARD] = early, late, soft, hard
    return count + 1


@compiled(apart=True)
def drop_first(heap: Floats, count: int) -> int:
    """Take the first cell off the heap; the new number of cells."""
    count -= 1
    at, below = 0, 1
    while below < count:
        if below + 1 < count and heap[below + 1, _HARM] < heap[below, _HARM]:
            below += 1
        if heap[below, _HARM] >= heap[count, _HARM]:
            break
        for c in range(heap.shape[1]):
            heap[at, c] = heap[below, c]
        at, below = below, 2 * below + 1
    for c in range(heap.shape[1]):
        heap[at, c] = heap[count, c]
    return count


@compiled(apart=True)
def divide(
    kind: int, at: Floats, floor: float, count: int, plan: Floats, other: Floats, heap: Floats
) -> tuple[int, float]:
    """Replace the first cell of the heap by its halves; their number, and the harm of a meeting within."""
    harm, early, late, soft, hard = (heap[0, _HARM], heap[0, _EARLY], heap[0, _LATE], heap[0, _SOFT], heap[0, _HARD])
    count = drop_first(heap, count)
    middle = 0.5 * (early + late)
    if (late - early) * (at[LINE.U_F] + at[LINE.A_F] + at[LINE.A_L]) > hard - soft and early < middle < late:
        closing = max(soft, gentlest(kind, at, middle)[0])
        met = harm_of(kind, at, middle, middle, closing, closing, floor, plan, other)
        later = max(soft, gentlest_between(kind, at, middle, late)) if kind >= RAMPED_FRONT else soft
        if later < hard:
            least = harm_of(kind, at, middle, late, later, hard, floor, plan, other)
            count = put(heap, count, max(least, harm), middle, late, later, hard)
        soft, late = max(soft, gentlest_between(kind, at, early, middle)), middle
    else:
        middle = 0.5 * (soft + hard)
        met = harm_of(kind, at, late, late, middle, middle, floor, plan, other)
        least = harm_of(kind, at, early, late, middle, hard, floor, plan, other)
        count = put(heap, count, max(least, harm), early, late, middle, hard)
        hard = middle
    if soft < hard:
        least = harm_of(kind, at, early, late, soft, hard, floor, plan, other)
        count = put(heap, count, max(least, harm), early, late, soft, hard)
    return count, met


@compiled(apart=True)
def least_harm(
    kind: int, at: Floats, first: float, last: float, floor: float, best: float, enough: float, plan: Floats,
    other: Floats, heap: Floats,
) -> float:  # fmt: skip
    """Lower bound of the harm of all meetings between two times; ``best`` if none does less than that.

    ``enough`` is proven without it: where some meeting does no more, 0 is returned at once.
    """
    for k in range(_TRIED):
        time = first + (last - first) * k / (_TRIED - 1)
        closing = gentlest(kind, at, time)[0]
        best = min(best, harm_of(kind, at, time, time, closing, closing, floor, plan, other))
    # the meetings between both times, at most ``hard``, on the heap: one cell for each step
    hard = math.sqrt(best)
    count, begin = 0, first
    while begin < last:
        until = next_split(kind, at, begin, last) if count < _SPLITS else last
        soft = gentlest_between(kind, at, begin, until)
        if soft < hard:
            harm = harm_of(kind, at, begin, until, soft, hard, floor, plan, other)
            count = put(heap, count, harm, begin, until, soft, hard)
        begin = until
    for _ in range(heap.shape[0] - _SPLITS - 2):
        if best <= enough or count == 0 or heap[0, _HARM] >= best - CELL * (1.0 + best):
            break
        count, met = divide(kind, at, floor, count, plan, other, heap)
        best = min(best, met)
    if best <= enough:
        return 0.0
    return min(best, heap[0, _HARM]) if count > 0 else best


@compiled
def next_split(kind: int, at: Floats, time: float, last: float) -> float:
    """The next time at which a decision falls or the leader comes to rest, at most ``last``."""
    until = last if kind < RAMPED_FRONT else min(last, time + _PART_S)
    if at[LINE.TIME_STEP] > 0.0:
        until = min(until, (math.floor(time / at[LINE.TIME_STEP] + 1e-6) + 1.0) * at[LINE.TIME_STEP])
    stand = at[LINE.V_L] / at[LINE.A_L]
    if kind == FRONT_FIRST and time < stand:
        until = min(until, stand)
    return until


# A proven lower bound on the harm of every world, whatever the controlled vehicle does.
#
# Three bounds, each proven in docs/avoidability.md, under both counting rules and with velocity exchange, bounces and
# pushing as the physics has them:
#
# * front pair alone: the closing speed of full braking, since a push from behind only makes it worse;
# * rear pair alone: the closing speed of full drive;
# * both together, where contact is unavoidable: whichever neighbour is met first, whenever and however softly, what
#   follows at the other one is bounded by the motion of the centre of mass.
#
# To these comes what has happened, for certain, before the vehicle may act.
#
# The proofs are about exact arithmetic; the bound and the harm that it is compared with are made of doubles. So every
# part is rounded outward: lowered by ``rounding``, more than both can be off together.

# Compiled proven lower bounds on the harm of one world; docs/avoidability.md has the proofs.

FRONT_BOUND, REAR_BOUND, COMBINED_BOUND, BOUNDS = range(4)
_TOUCH_HARM = 2.0 * BOUND.TOUCH_SPEED_MPS * BOUND.TOUCH_SPEED_MPS  # what two touches may hide
_TOUCHING_M = 1e-9  # more than rounding leaves between two that touch
_GRAZE_S = 1e-3  # more than rounding can move a graze
_FORCES, _ROUGHLY = 12, 20  # halvings of a force and of a time that need not be exact
_PARTS = 8  # into which the times of soft meetings are divided


@compiled
def rear_bound(at: Floats, plan: Floats, other: Floats) -> tuple[float, float]:
    """Least squared closing speed at the rear pair's first contact, that under full drive; and its latest time."""
    fill_drive_then_brake(plan, at[LINE.V_F], at[LINE.U_F], at[LINE.LIMIT_F], math.inf, at[LINE.A_F])
    fill_braking(other, at[LINE.ONSET_R], at[LINE.A_R])
    _, time, squared = walk(
        at[LINE.GAP_R], at[LINE.V_F], plan, at[LINE.V_R], other, at[LINE.ONSET_R] + at[LINE.V_R] / at[LINE.A_R]
    )
    return squared, time


@compiled(apart=True)
def is_first(kind: int, at: Floats, time: float, plan: Floats, other: Floats) -> bool:
    """Whether the other neighbour has not come before the gentlest meeting at ``time``."""
    if kind == FRONT_FIRST:
        return stays_ahead(at, gentlest_front(at, time)[1], time, plan, other)
    return stays_behind(at, braking_to_rear(at, time, 0.0), time, plan, other)


@compiled(apart=True)
def last_first(kind: int, at: Floats, first: float, last: float, plan: Floats, other: Floats) -> float:
    """The latest time, at most ``last``, of a meeting with one neighbour before which the other one has not come.

    At ``first`` there is room. The later the meeting, the shorter the drive (the braking) before it, and the less room
    behind (ahead).
    """
    if is_first(kind, at, last, plan, other):
        return last
    for _ in range(_HALVINGS):
        middle = 0.5 * (first + last)
        if is_first(kind, at, middle, plan, other):
            first = middle
        else:
            last = middle
    return last


@compiled(apart=True)
def last_meeting(at: Floats, first: float, plan: Floats, other: Floats) -> tuple[float, float, bool]:
    """When the leader, met at ``first`` at the earliest, is met at the latest; when it is met first at the latest.

    And whether it may be met first however late and softly.
    """
    touches = spare_gap(at[LINE.GAP_L], at[LINE.V_L], at[LINE.A_L], at[LINE.V_F], at[LINE.A_F]) >= 0.0
    last = meet_front(at, 0.0, plan, other)
    if touches:
        last = largest_behind(
            at[LINE.GAP_L], at[LINE.V_L], at[LINE.A_L], at[LINE.V_F], at[LINE.A_F], at[LINE.U_F], at[LINE.LIMIT_F]
        )[1]
    end = last_first(FRONT_FIRST, at, first, last, plan, other)
    return last, end, touches and end == last


@compiled(apart=True)
def front_first(
    at: Floats, floor: float, best: float, enough: float, plan: Floats, other: Floats, heap: Floats
) -> float:
    """Least harm, if below ``best``, where the leader is met first or all three meet at once.

    At once: the outer two close with W, of which the front pair has at least the least at that time. Only if the leader
    can be met as late as that.
    """
    first = meet_front(at, math.inf, plan, other)
    if (
        first == math.inf and at[LINE.GAP_L] <= _TOUCHING_M
    ):  # it stands at the leader, and stays: both are struck at once
        return min(best, rear_bound(at, plan, other)[0])
    if first == math.inf or not stays_ahead(at, first, first, plan, other):
        return best
    last, end, leans = last_meeting(at, first, plan, other)
    best = least_harm(FRONT_FIRST, at, first, end, floor, best, enough, plan, other, heap)
    if leans:
        best = soft_harm(FRONT_FIRST, at, last, last, floor, best, plan, other)
        stand = at[LINE.V_L] / at[LINE.A_L]
        if last < stand:
            best = soft_harm(FRONT_FIRST, at, stand, stand, floor, best, plan, other)
    fill_braking(plan, 0.0, at[LINE.A_L])
    fill_braking(other, at[LINE.ONSET_R], at[LINE.A_R])
    _, time, squared = walk(at[LINE.GAP_L] + at[LINE.GAP_R], at[LINE.V_L], plan, at[LINE.V_R], other, math.inf)
    if time == math.inf or (time > end + _GRAZE_S and not leans):
        return best
    least = gentlest_front(at, min(time, last))[0] if time > first else 0.0
    front = max(least, 0.5 * math.sqrt(squared))
    rear = max(math.sqrt(squared) - front, 0.0)
    beyond = 0.0
    if at[LINE.WALL] > 0.0:
        beyond = beyond_rear(at, time, time, rear, obstacle_harm(at, time, least), plan, other)
    return min(best, front * front + rear * rear + beyond)


@compiled(apart=True)
def soft_harm(
    kind: int, at: Floats, early: float, late: float, floor: float, best: float, plan: Floats, other: Floats
) -> float:
    """Least harm, if below ``best``, of the meetings with one neighbour from ``early`` to ``late``, however soft."""
    soft = 0.0
    while soft * soft < best:
        hard = soft + 0.02 * (1.0 + soft)
        follows = max(after(kind, at, early, late, hard, late, 0.0, plan, other), floor)
        if kind == FRONT_FIRST:
            follows = after_at_obstacle(at, early, late, soft, hard, follows, plan, other)
        best = min(best, soft * soft + follows)
        soft = hard
    return best


@compiled(apart=True)
def rear_first(
    at: Floats, floor: float, best: float, enough: float, plan: Floats, other: Floats, heap: Floats
) -> float:
    """Least harm, if below ``best``, where the rear vehicle is met first."""
    high = max(at[LINE.V_F] / at[LINE.A_F], at[LINE.ONSET_R] + at[LINE.V_R] / at[LINE.A_R])
    first = meet_rear(at, high, plan, other)
    if first == math.inf or not stays_behind(at, first, first, plan, other):
        return best
    last = meet_rear(at, 0.0, plan, other)
    if last < math.inf:
        end = last_first(REAR_FIRST, at, first, last, plan, other)
        return least_harm(REAR_FIRST, at, first, end, floor, best, enough, plan, other, heap)
    low, top = 0.0, high
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + top)
        if meet_rear(at, middle, plan, other) < math.inf:
            top = middle
        else:
            low = middle
    last = meet_rear(at, top, plan, other)
    end = last_first(REAR_FIRST, at, first, last, plan, other)
    best = least_harm(REAR_FIRST, at, first, end, floor, best, enough, plan, other, heap)
    if end < last:
        return best
    late = max(last_soft(at, high, plan, other), last) + _GRAZE_S
    part = (late - last) / _PARTS
    for k in range(_PARTS):
        best = soft_harm(REAR_FIRST, at, last + k * part, last + (k + 1) * part, floor, best, plan, other)
    return best


@compiled(apart=True)
def last_soft(at: Floats, rest: float, plan: Floats, other: Floats) -> float:
    """A time after which no first meeting with the rear vehicle comes, however soft; all stand at ``rest``.

    It has then passed neither the leader nor the controlled vehicle; where it brakes harder than this one, by b, it was
    faster by ``b t`` a time t before the meeting, from its onset on.
    """
    fill_braking(plan, 0.0, at[LINE.A_L])
    fill_braking(other, at[LINE.ONSET_R], at[LINE.A_R])
    last = min(
        max(rest, at[LINE.V_L] / at[LINE.A_L]),
        walk(at[LINE.GAP_L] + at[LINE.GAP_R], at[LINE.V_L], plan, at[LINE.V_R], other, math.inf)[1],
    )
    if at[LINE.A_F] >= at[LINE.A_R]:
        return float(last)
    harder, onset, closing = at[LINE.A_R] - at[LINE.A_F], at[LINE.ONSET_R], at[LINE.V_R] - at[LINE.V_F]
    gap = max(at[LINE.GAP_R] + (0.5 * at[LINE.U_F] * onset - closing) * onset, 0.0)
    ahead = max(closing + at[LINE.A_F] * onset, 0.0)
    return float(min(last, onset + min(ahead / harder, math.sqrt(2.0 * gap / harder))))


@compiled(apart=True)
def last_rest(at: Floats) -> tuple[float, float]:
    """By when what follows from braking is over, whoever is met; and when the rear vehicle stands by full braking."""
    stand = at[LINE.ONSET_R] + at[LINE.V_R] / at[LINE.A_R]
    way = solo_motion(at[LINE.V_R], -at[LINE.A_R], at[LINE.ONSET_R], math.inf, stand)[1]
    room = at[LINE.GAP_L] + at[LINE.V_L] * at[LINE.V_L] / (2.0 * at[LINE.A_L]) + at[LINE.GAP_R] - way
    rest = at[LINE.ONSET_R] + at[LINE.V_R] / min(at[LINE.A_R], at[LINE.A_F])
    return max(rest, stand + math.sqrt(2.0 * max(room, 0.0) / at[LINE.A_F])), stand


@compiled(apart=True)
def combined_bound(
    at: Floats, until: float, front: float, rear: float, plan: Floats, other: Floats, heap: Floats
) -> float:
    """Least harm of a world in which contact is unavoidable, whoever is met first; 0 if that may be after ``until``.

    ``front`` and ``rear`` are the pairs' own bounds.
    """
    if not last_rest(at)[0] < until:
        return 0.0
    step, least = at[LINE.TIME_STEP], 0.0
    for time_step in (0.0, step):  # what holds for any command holds for one that changes at decisions only
        at[LINE.TIME_STEP] = time_step
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
    plan, other, heap = empty_plan(), empty_plan(), np.empty((CELLS, _NEAR))
    for k in range(states.shape[0]):
        front, rear = 0.0, 0.0
        if has_front[k]:
            # least squared closing speed at the front pair's first contact, whoever pushes; and its latest time
            at = states[k]
            fill_braking(plan, 0.0, at[LINE.A_L])
            fill_braking(other, 0.0, at[LINE.A_F])
            _, time, squared = walk(
                at[LINE.GAP_L], at[LINE.V_L], plan, at[LINE.V_F], other, at[LINE.V_F] / at[LINE.A_F]
            )
            if at[LINE.A_F] < at[LINE.A_L] and at[LINE.V_F] < at[LINE.V_L]:
                squared = min(squared, 2.0 * (at[LINE.A_L] - at[LINE.A_F]) * at[LINE.GAP_L])
            front = squared if time < until[k] and squared > _TOUCH_HARM else 0.0
            if front > 0.0 and at[LINE.WALL] > 0.0:
                front += obstacle_harm(at, time, math.sqrt(squared))
        if has_rear[k]:
            squared, time = rear_bound(states[k], plan, other)
            rear = squared if time < until[k] and squared > _TOUCH_HARM else 0.0
        out[k, FRONT_BOUND], out[k, REAR_BOUND], out[k, COMBINED_BOUND] = front, rear, 0.0
        if unavoidable[k]:
            out[k, COMBINED_BOUND] = combined_bound(states[k], until[k], front, rear, plan, other, heap)


# Compiled: meetings where brakes build up, and what follows them. docs/proofs/lower-bound-cases.md has the proofs.
#
# ``sign`` is 1 for meetings with the leader and -1 for those with the rear vehicle, whose mirror image they are: forces
# times ``sign`` then rise first (drive, or brake) and fall later.


@compiled
def fill_leader(at: Floats, plan: Floats) -> None:
    """The front vehicle, left alone."""
    fill_build_up(plan, 0.0, at[LINE.FORCE_L], -at[LINE.A_L], at[LINE.FALL_L])


@compiled
def fill_follower(at: Floats, plan: Floats) -> None:
    """The rear vehicle, left alone."""
    fill_build_up(plan, at[LINE.ONSET_R], at[LINE.FORCE_R], -at[LINE.A_R], at[LINE.FALL_R])


@compiled
def range_of(sign: float, at: Floats) -> tuple[float, float, float, float]:
    """Largest force and how fast it is reached, least force and how fast it is reached, times ``sign``."""
    if sign > 0.0:
        return at[LINE.U_F], at[LINE.RISE_F], at[LINE.A_F], at[LINE.FALL_F]
    return at[LINE.A_F], at[LINE.FALL_F], at[LINE.U_F], at[LINE.RISE_F]


@compiled
def fill_controlled(at: Floats, sign: float, switch: float, time: float, final: float, plan: Floats) -> None:
    """``fill_switch`` of the controlled vehicle."""
    high, rise, low, fall = range_of(sign, at)
    fill_switch(plan, sign, sign * at[LINE.FORCE_F], high, rise, low, fall, switch, time, final)


@compiled(apart=True)
def switch_for(
    at: Floats, sign: float, time: float, place: float, final: float, halvings: int, plan: Floats
) -> tuple[float, float, float]:
    """Switches just before and after which it is at ``place`` at ``time``, and the speed after the earlier one.

    ``place`` is times ``sign``, and the way to it has that force at least (at most) at ``time``.
    """
    low, high = (-1.0 if range_of(sign, at)[1] == math.inf else 0.0), time
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        fill_controlled(at, sign, middle, time, final, plan)
        if sign * travel(plan, at[LINE.V_F], at[LINE.LIMIT_F], time)[1] < place:
            low = middle
        else:
            high = middle
    fill_controlled(at, sign, low, time, final, plan)
    return low, high, travel(plan, at[LINE.V_F], at[LINE.LIMIT_F], time)[0]


@compiled
def met_at(kind: int, at: Floats, time: float, plan: Floats) -> tuple[float, float, float]:
    """Sign, speed and place (times the sign) of the vehicle that is met, left alone until ``time``."""
    if kind == RAMPED_FRONT:
        fill_leader(at, plan)
        v, way = travel(plan, at[LINE.V_L], math.inf, time)
        return 1.0, v, at[LINE.GAP_L] + way
    fill_follower(at, plan)
    v, way = travel(plan, at[LINE.V_R], math.inf, time)
    return -1.0, v, at[LINE.GAP_R] - way


@compiled(apart=True)
def gentlest_ramped(kind: int, at: Floats, time: float) -> float:
    """Least closing speed of a meeting at ``time``."""
    plan = empty_legs()
    sign, v, place = met_at(kind, at, time, plan)
    return max(sign * (switch_for(at, sign, time, place, -math.inf, _HALVINGS, plan)[2] - v), 0.0)


@compiled
def slack_of(
    kind: int, at: Floats, early: float, late: float, v: float, hard: float, plan: Floats
) -> tuple[float, float]:
    """How far from its place, and by which speed, a vehicle that meets in a cell may be at ``early``, at most."""
    span = late - early
    if kind == RAMPED_FRONT:
        return (hard + at[LINE.A_F] * span) * span, at[LINE.A_F] * span
    slower = v - met_at(kind, at, late, plan)[1]
    return (hard + at[LINE.U_F] * span + slower) * span, at[LINE.U_F] * span + slower


@compiled(apart=True)
def gentlest_ramped_between(kind: int, at: Floats, early: float, late: float) -> float:
    """Least closing speed of the meetings between two times."""
    plan = empty_legs()
    hard = gentlest_ramped(kind, at, early)
    sign, v, place = met_at(kind, at, early, plan)
    far, faster = slack_of(kind, at, early, late, v, hard, plan)
    closing = sign * (switch_for(at, sign, early, place - far, -math.inf, _HALVINGS, plan)[2] - v)
    if kind == RAMPED_FRONT:
        fill_leader(at, plan)
        if travel(plan, at[LINE.V_L], math.inf, late)[0] > 0.0:
            faster = max(at[LINE.A_F] + force_of(plan, early), 0.0) * (late - early)
    return max(min(closing - faster, hard), 0.0)


@compiled(apart=True)
def force_of_meeting(kind: int, at: Floats, early: float, late: float, hard: float) -> float:
    """Largest force, times the sign, with which a meeting of a cell can be as soft as ``hard``."""
    plan = empty_legs()
    sign, v, place = met_at(kind, at, early, plan)
    far, faster = slack_of(kind, at, early, late, v, hard, plan)
    high, rise, low, _ = range_of(sign, at)
    if rise == math.inf:
        return high
    least, most = -low, high
    for k in range(_FORCES):
        tried = most if k == 0 else 0.5 * (least + most)
        final = tried - rise * (late - early)
        if sign * (switch_for(at, sign, early, place - far, final, _ROUGHLY, plan)[2] - v) <= hard + faster:
            least = tried
        else:
            most = tried
    return most


@compiled(apart=True)
def after_ramped(
    kind: int, at: Floats, early: float, late: float, hard: float, plan: Floats, other: Floats
) -> float:  # fmt: skip
    """Least squared closing speed at the other neighbour after a meeting of a cell: of the controlled one alone."""
    sign = 1.0 if kind == RAMPED_FRONT else -1.0
    share = at[LINE.FRONT_SHARE] if kind == RAMPED_FRONT else at[LINE.REAR_SHARE]
    kept = 1.0 - share * (1.0 + at[LINE.RESTITUTION])
    if kind == RAMPED_FRONT and (kept < 0.0 or at[LINE.OBSTACLE] < math.inf):
        return 0.0  # it may be thrown back
    kept, span = max(kept, 0.0), late - early
    high, rise, _, _ = range_of(sign, at)
    force = high
    if rise < math.inf:
        force = min(force_of_meeting(kind, at, early, late, hard) + rise * span, high)
    fill_leader(at, plan)
    v_l, way_l = travel(plan, at[LINE.V_L], math.inf, early)
    fill_follower(at, other)
    v_r, way_r = travel(other, at[LINE.V_R], math.inf, early)
    gap = max(at[LINE.GAP_L] + at[LINE.GAP_R] + way_l - way_r, 0.0)
    if kind == RAMPED_FRONT:
        # until ``late`` it does not fall behind the leader
        least = force_of(plan, early) if travel(plan, at[LINE.V_L], math.inf, late)[0] > 0.0 else 0.0
        fill_build_up(plan, late, force, high, rise)
        plan[FORCES, 0] = max(force, least)
        found = meeting(
            gap, kept * hard * span, v_l + kept * hard, plan, math.inf, v_r, other, math.inf, early, at[LINE.UNTIL]
        )
    else:
        v = v_r - kept * hard
        if v <= 0.0:
            return 0.0
        most = force_of(other, late)
        since, begins = late, -force
        fastest = (1.0 + at[LINE.RESTITUTION]) * v_r + at[LINE.U_F] * at[LINE.U_F] / rise
        if begins > 0.0 and fastest >= at[LINE.LIMIT_F]:  # beyond its speed limit a vehicle that drives coasts
            since, begins = late + begins / rise, 0.0
        fill_build_up(other, since, begins, -high, rise)
        other[FORCES, 0] = min(begins, most)
        found = meeting(gap, kept * hard * span, v_l, plan, math.inf, v, other, math.inf, early, at[LINE.UNTIL])
    return found[2] * found[2]


@compiled(apart=True)
def is_first_ramped(kind: int, at: Floats, time: float, plan: Floats, other: Floats) -> bool:
    """Whether the other neighbour has not come before every meeting at ``time`` and later."""
    sign, _, place = met_at(kind, at, time, plan)
    switch = switch_for(at, sign, time, place, -math.inf, _HALVINGS, plan)[1]
    fill_controlled(at, sign, switch, time, -math.inf, plan)
    if kind == RAMPED_FRONT:
        fill_follower(at, other)
        gap = at[LINE.GAP_R] + AHEAD_M
        return meeting(
            gap, 0.0, at[LINE.V_F], plan, at[LINE.LIMIT_F], at[LINE.V_R], other, math.inf, 0.0, time
        )[0] == math.inf  # fmt: skip
    fill_leader(at, other)
    gap = at[LINE.GAP_L] + AHEAD_M
    return (
        meeting(gap, 0.0, at[LINE.V_L], other, math.inf, at[LINE.V_F], plan, at[LINE.LIMIT_F], 0.0, time)[0] == math.inf
    )


@compiled(apart=True)
def meet_ramped(kind: int, at: Floats, sign: float, plan: Floats, other: Floats) -> tuple[float, float, float]:
    """``meeting`` with this neighbour of one that drives (``sign`` 1) or brakes (-1) as hard as it can."""
    fill_controlled(at, sign, math.inf, math.inf, -math.inf, plan)
    if kind == RAMPED_FRONT:
        fill_leader(at, other)
        return meeting(
            at[LINE.GAP_L], 0.0, at[LINE.V_L], other, math.inf, at[LINE.V_F], plan, at[LINE.LIMIT_F], 0.0, math.inf
        )
    fill_follower(at, other)
    return meeting(
        at[LINE.GAP_R], 0.0, at[LINE.V_F], plan, at[LINE.LIMIT_F], at[LINE.V_R], other, math.inf, 0.0, math.inf
    )


@compiled(apart=True)
def combined_ramped(
    at: Floats, until: float, front: float, rear: float, contact_s: float, plan: Floats, other: Floats, heap: Floats
) -> float:
    """Least harm, whoever is met first, where both extremes show contact by ``contact_s``, or the outer two do."""
    if min(at[LINE.GAP_L], at[LINE.GAP_R]) <= _TOUCHING_M:
        return 0.0
    fill_leader(at, plan)
    fill_follower(at, other)
    squeezed, closing, _ = meeting(
        at[LINE.GAP_L] + at[LINE.GAP_R], 0.0, at[LINE.V_L], plan, math.inf, at[LINE.V_R], other, math.inf, 0.0, math.inf
    )
    last, best = min(contact_s, squeezed), LARGE
    if not last < until:
        return 0.0
    for kind, sign, floor in ((RAMPED_FRONT, 1.0, rear), (RAMPED_REAR, -1.0, front)):
        first = meet_ramped(kind, at, sign, plan, other)[0]
        if first > last or not is_first_ramped(kind, at, first, plan, other):
            continue
        early, late = first, last
        if not is_first_ramped(kind, at, last, plan, other):
            for _ in range(_ROUGHLY):
                middle = 0.5 * (early + late)
                if is_first_ramped(kind, at, middle, plan, other):
                    early = middle
                else:
                    late = middle
        best = least_harm(kind, at, first, late, floor, best, front + rear, plan, other, heap)
    if squeezed <= last:
        most = max(min(gentlest_ramped(RAMPED_FRONT, at, squeezed), closing), 0.5 * closing)
        best = min(best, most * most + (closing - most) * (closing - most))
    return best - _TOUCH_HARM if best < LARGE else 0.0


@compiled
def bound_ramped(states: Floats, has_front: Bools, has_rear: Bools, both: Bools, out: Floats) -> None:
    """``bound_worlds`` where brakes build up; ``both``: whether the pairs are to be bounded together too, [n]."""
    plan, other, heap = empty_legs(), empty_legs(), np.empty((CELLS, _NEAR))
    for k in range(states.shape[0]):
        at, contact_s = states[k], math.inf
        for kind, sign, there in ((RAMPED_FRONT, -1.0, has_front[k]), (RAMPED_REAR, 1.0, has_rear[k])):
            out[k, kind - RAMPED_FRONT] = 0.0
            if there:
                time, closing, least = meet_ramped(kind, at, sign, plan, other)
                found = least * least if kind == RAMPED_FRONT else closing * closing
                contact_s = min(contact_s, time)
                if time < at[LINE.UNTIL] and found > _TOUCH_HARM:
                    out[k, kind - RAMPED_FRONT] = found
        out[k, COMBINED_BOUND] = 0.0
        if both[k]:
            front, rear = out[k, FRONT_BOUND], out[k, REAR_BOUND]
            out[k, COMBINED_BOUND] = combined_ramped(at, at[LINE.UNTIL], front, rear, contact_s, plan, other, heap)


EPS = 2.0**-52  # the spacing of doubles at 1
# Bounds are lowered by so many eps of the squared speeds that a world can hold: a segment or a round of impacts moves a
# squared closing speed by at most 8 eps of these, and an episode has up to 500 of them.
BOUND_EPS = 2.0**12

LEAST_TIME_STEP_S = 1e-3  # between decisions: work grows as they come closer
_LEAST_PART = 100  # worlds of a thread: fewer are done before another one has begun


@dataclass(frozen=True, slots=True)
class LowerBound:
    """What is proven about each world [n], in m2/s2."""

    harm: Floats  # no profile does less harm than this
    early: Floats  # done before the controlled vehicle may act
    front_pair: Floats  # of the front pair alone, from then on
    rear_pair: Floats  # of the rear pair alone
    combined: Floats  # of both together; 0 where nothing is proven
    # the verdict on contact that the bound of both together rests on; None where brakes of some world build up
    contact: Avoidability | None

    @property
    def impact_proven(self) -> Bools:
        """Whether every profile has an impact, [n]; elsewhere none is proven, which need not mean that one can."""
        return np.asarray(self.harm > 0.0, np.bool_)


def lower_bound(
    worlds: Worlds,
    vehicle: int = 1,
    *,
    harm_count: HarmCount = "first",
    horizon_s: float = 8.0,
    scripts: Mapping[int, str] | None = None,
    time_step_s: float | None = None,
) -> LowerBound:
    """Proven lower bound on the harm from now to ``horizon_s`` (absolute), over all commands of ``vehicle``.

    ``harm = early + max(front_pair + rear_pair, combined)``, each part rounded outward (``rounding``). The combined
    bound is 0 where contact can be avoided. What may come only after the horizon counts as 0, and so does the next
    impact of a pair that was hit before where ``harm_count`` is "first".

    With ``time_step_s`` it is proven only for commands that change at decisions, the first one when the vehicle may
    act, one every ``time_step_s`` after it: what every agent drives. That is sharper, and takes ten times as long.

    Where brakes build up it holds for any command at any time, is looser, and says nothing of contact: ``contact`` is
    None if that is so in any of the worlds.

    Covers the same lines as ``avoidability``, and raises ``InvalidInput`` for others, for an unknown ``harm_count``, a
    time step below ``LEAST_TIME_STEP_S``, and a horizon that is not finite or lies before the vehicle may act.
    """
    check_asked("lower_bound", harm_count, horizon_s, time_step_s)
    slow = worlds.vehicles.build_up
    if worlds.vehicles.in_pieces.any():
        worlds.refuse_build_up("lower_bound")
    if slow.any() and not slow.all():
        asked = partial(
            lower_bound, vehicle=vehicle, harm_count=harm_count, horizon_s=horizon_s, scripts=scripts,
            time_step_s=time_step_s,
        )  # fmt: skip
        order = np.argsort(np.concatenate([np.flatnonzero(slow), np.flatnonzero(~slow)]))
        halves = asked(worlds.take(slow)), asked(worlds.take(~slow))
        each = ((part.harm, part.early, part.front_pair, part.rear_pair, part.combined) for part in halves)
        harm, early, front, rear, combined = (np.concatenate(columns)[order] for columns in zip(*each, strict=True))
        return LowerBound(harm, early, front, rear, combined, None)
    if slow.any():
        _check_covered(worlds, vehicle, scripts)
        verdict, reason = None, np.full(worlds.n, 2)  # it may be: the bound itself finds out
    else:
        verdict = avoidability(worlds, vehicle, scripts=scripts)
        reason = verdict.reason
    at_onset, start, early, counts = _at_onset("lower_bound", worlds, np.array([vehicle]), harm_count, horizon_s)
    none = np.zeros(worlds.n, dtype=np.bool_)
    has_front = counts[:, vehicle - 1] if vehicle > 0 else none
    has_rear = counts[:, vehicle] if vehicle < worlds.N - 1 else none
    struck = at_onset.obstacle_hit & (harm_count == "first")  # whoever is pushed there is not charged for it again
    unavoidable = has_front & has_rear & (reason >= 2) & ~struck
    out = np.empty((worlds.n, BOUNDS))
    given: tuple[Any, ...] = (has_front, has_rear, unavoidable, out)
    kernel: Callable[..., None] = bound_worlds
    if slow.any():
        # a neighbour that still drives, told otherwise before, is not yet left alone
        left_alone = np.delete(at_onset.command_mps2, vehicle, axis=1).max(axis=1) <= 0.0
        given = (has_front, has_rear & left_alone, unavoidable & left_alone, out)
        given, kernel = (_ramped_states(at_onset, vehicle, horizon_s - start), *given), bound_ramped
    else:
        states = onset_states(at_onset, vehicle, time_step_s)
        ahead = states[:, LINE.OBSTACLE]
        states[:, LINE.WALL] = np.where(np.isfinite(ahead) & ~struck, ahead, 0.0)
        states[:, LINE.UNTIL] = horizon_s - start
        given = (states, horizon_s - start, *given)
    threads = min(os.cpu_count() or 1, worlds.n // _LEAST_PART + 1)
    by_parts(lambda part: kernel(*(array[part] for array in given)), worlds.n, threads)
    parts = (early, *(out[:, column] for column in (FRONT_BOUND, REAR_BOUND, COMBINED_BOUND)))
    early, front, rear, combined = (np.maximum(part - rounding(worlds, vehicle), 0.0) for part in parts)
    return LowerBound(early + np.maximum(front + rear, combined), early, front, rear, combined, verdict)


def _at_onset(
    where: str, worlds: Worlds, vehicles: Ints, harm_count: HarmCount, horizon_s: float
) -> tuple[Worlds, Floats, Floats, Bools]:
    """The worlds when the first of these vehicles may act, when that is (s), and the harm that was done before, [n].

    And the pairs whose next impact counts, and which move forward, [n, P].
    """
    start = np.maximum(worlds.vehicles.latency_s[:, vehicles].min(axis=1), worlds.time_s)
    if not (np.all(start <= horizon_s) and horizon_s < np.inf):
        raise InvalidInput(f"{where}: horizon_s {horizon_s!r}: must be finite and at least {start.max():g} s")
    now, impacts = advance(worlds, -worlds.vehicles.braking_capacity_mps2, until_s=start)
    early = empty_ledger(worlds).add(impacts).world_harm(harm_count)
    forward = now.speeds_mps >= 0.0
    counts = (~now.pair_hit if harm_count == "first" else True) & forward[:, 1:] & forward[:, :-1]
    return now, start, early, counts


def check_asked(where: str, harm_count: str, horizon_s: object, time_step_s: object) -> None:
    """Raise ``InvalidInput`` for an unknown count, a horizon that is no number, or a time step that cannot be."""
    check_harm_count(harm_count)
    if not _is_number(horizon_s):
        raise InvalidInput(f"{where}: horizon_s {horizon_s!r}: must be a number of seconds")
    if time_step_s is not None and not (_is_number(time_step_s) and LEAST_TIME_STEP_S <= time_step_s < np.inf):  # type: ignore[operator]  # a number
        raise InvalidInput(
            f"{where}: time_step_s {time_step_s!r}: must be a number of seconds from {LEAST_TIME_STEP_S:g} on, or None"
        )


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def rounding(worlds: Worlds, vehicle: int | Ints, way_m: Floats | float = 0.0) -> Floats:
    """How far arithmetic can move a bound and a realised harm apart, at most; [n] m2/s2.

    A squared closing speed is ``D = w^2 + 2 b g``. With ``V`` the largest speed in the line, ``G`` its gaps (and
    ``way_m`` [n] beyond them), ``A`` the largest closing acceleration and ``a`` the weakest brakes, every ``w^2`` is at
    most ``V^2`` and no gap grows beyond ``G + V^2 / 2a`` (and ``V a / r`` where brakes build up at a rate r), so all
    terms of D stay below ``S = V^2 (1 + A / a) + 2 A G``.
    A segment of motion rounds each speed twice and each gap five times, a round of impacts each speed by
    ``CLUSTER_EPS``: either moves D by at most 8 eps S. These add up and are not multiplied, for the proofs compare a
    run with itself, not with another one. ``BOUND_EPS`` grants 500 of them; the steps of an episode of 8 s are 80, and
    the bound's own arithmetic, a few hundred roundings, is among them too. Of several vehicles (a team) the largest
    speed is a speed limit where any of them may drive, the largest closing acceleration that of the strongest drive.
    """
    v, chosen = worlds.vehicles, np.atleast_1d(vehicle)
    driving = v.driving_capacity_mps2[:, chosen]
    limits = np.where(driving > 0.0, v.speed_limit_mps[:, chosen], 0.0)
    fastest = np.maximum(worlds.speeds_mps.max(axis=1), limits.max(axis=1))
    closing = v.braking_capacity_mps2.max(axis=1) + driving.max(axis=1)
    weakest = v.braking_capacity_mps2.min(axis=1)
    longest = worlds.gaps_m.sum(axis=1) + way_m + fastest * (v.braking_capacity_mps2 / v.brake_rate_mps3).max(axis=1)
    scale = fastest * fastest * (1.0 + closing / weakest) + 2.0 * closing * longest
    return np.asarray(BOUND_EPS * EPS * scale, np.float64)


def onset_states(worlds: Worlds, i: int, time_step_s: float | Floats | None) -> Floats:
    """The worlds, in which vehicle ``i`` may act, as the compiled bounds take them [n, WIDTH] (``limits.lower_bound``).

    Columns of a neighbour that is not there stay 0, as does the time step where there is none.
    """
    v = worlds.vehicles
    at = np.zeros((worlds.n, LINE.WIDTH))
    columns = {
        LINE.V_F: worlds.speeds_mps[:, i],
        LINE.A_F: v.braking_capacity_mps2[:, i],
        LINE.U_F: v.driving_capacity_mps2[:, i],
        LINE.LIMIT_F: v.speed_limit_mps[:, i],
        LINE.RESTITUTION: v.restitution,
        LINE.OBSTACLE: worlds.obstacle_gap_m if i == 1 else np.inf,
        LINE.TIME_STEP: 0.0 if time_step_s is None else time_step_s,
    }
    if i > 0:
        columns |= {
            LINE.GAP_L: worlds.gaps_m[:, i - 1],
            LINE.V_L: worlds.speeds_mps[:, i - 1],
            LINE.A_L: v.braking_capacity_mps2[:, i - 1],
            LINE.FRONT_SHARE: v.mass_t[:, i - 1] / (v.mass_t[:, i - 1] + v.mass_t[:, i]),
        }
    if i < worlds.N - 1:
        columns |= {
            LINE.GAP_R: worlds.gaps_m[:, i],
            LINE.V_R: worlds.speeds_mps[:, i + 1],
            LINE.A_R: v.braking_capacity_mps2[:, i + 1],
            LINE.ONSET_R: np.maximum(v.latency_s[:, i + 1] - worlds.time_s, 0.0),
            LINE.REAR_SHARE: v.mass_t[:, i + 1] / (v.mass_t[:, i + 1] + v.mass_t[:, i]),
        }
    for column, values in columns.items():
        at[:, column] = values
    return at


def _ramped_states(worlds: Worlds, i: int, until: Floats) -> Floats:
    """``onset_states`` of worlds in which brakes build up; what they prove must happen within ``until`` [n] s.

    A controlled vehicle that brakes or drives already is taken to have no rates.
    """
    v, at = worlds.vehicles, onset_states(worlds, i, None)
    moved = worlds.command_mps2[:, i] != 0.0
    at[:, LINE.FALL_F] = np.where(moved, np.inf, v.brake_rate_mps3[:, i])
    at[:, LINE.RISE_F] = np.where(moved, np.inf, v.release_rate_mps3[:, i])
    at[:, LINE.UNTIL] = until
    for j, force, fall in ((i - 1, LINE.FORCE_L, LINE.FALL_L), (i + 1, LINE.FORCE_R, LINE.FALL_R)):
        if 0 <= j < worlds.N:
            at[:, force], at[:, fall] = worlds.command_mps2[:, j], v.brake_rate_mps3[:, j]
    return at


# A proven lower bound on the harm of every world, whatever several controlled vehicles do together.
#
# docs/avoidability.md, "Teams", has the proofs, under both counting rules:
#
# * each pair alone: its front vehicle as far ahead as it can be (full drive where it is controlled, else full braking),
#   its rear vehicle as far behind (full braking); pushes from outside the pair only make it worse;
# * the front three together, where Vehicle 1 brakes fully, Vehicle 2 is controlled, and contact is unavoidable; where
#   Vehicle 1 is controlled, the obstacle ahead is the first of the three.
#
# Bounds of different pairs add up, as each holds for every joint command. All parts are rounded outward.

# Compiled: the least closing speed of a pair's first contact, whatever its vehicles and those around it do.
#
# The leader goes as far ahead as it can (full drive where it is controlled, else full braking), the follower stays as
# far behind as it can (full braking). Where these extremes meet, every run of the pair meets no later.
# docs/avoidability.md, "Teams", has the proof.

# one pair: its gap; speed, onset and brakes of both; the leader's drive and speed limit where it is controlled
PAIR_GAP, LEADER_V, LEADER_ONSET, LEADER_A, LEADER_FREE, LEADER_U, LEADER_LIMIT = range(7)
FOLLOWER_V, FOLLOWER_ONSET, FOLLOWER_A, PAIR_WIDTH = range(7, 11)


@compiled(apart=True)
def least_on_piece(constant: float, pressing: float, since: float, until: float) -> float:
    """Least value of ``constant / t + pressing t / 2`` from ``since`` to ``until``."""
    least = constant / until + 0.5 * pressing * until
    if since > 0.0:
        least = min(least, constant / since + 0.5 * pressing * since)
    elif constant <= 0.0:
        least = min(least, 0.0) if constant == 0.0 else -math.inf
    if constant > 0.0 and pressing > 0.0:
        turn = math.sqrt(2.0 * constant / pressing)
        if since < turn < until:
            least = min(least, math.sqrt(2.0 * constant * pressing))
    return least


@compiled(apart=True)
def least_before(at: Floats, met: float, squared: float) -> float:
    """Least closing speed of a pair's first contact up to ``met``, where both extremes meet; a scripted leader.

    ``c(t) + g(t) / t``: the extremes' closing speed, and what must be added to it to be through their gap by then.
    """
    if met <= 0.0:
        return math.sqrt(squared)
    least, now = math.sqrt(squared), 0.0
    gap, v_l, v_f = at[PAIR_GAP], at[LEADER_V], at[FOLLOWER_V]
    rest = at[LEADER_ONSET] + at[LEADER_V] / at[LEADER_A]
    for _ in range(4):
        end = met
        for turn in (at[LEADER_ONSET], at[FOLLOWER_ONSET], rest):
            if now < turn < end:
                end = turn
        u_l = -at[LEADER_A] if at[LEADER_ONSET] <= now < rest else 0.0
        u_f = -at[FOLLOWER_A] if now >= at[FOLLOWER_ONSET] else 0.0
        w, b, step = v_f - v_l, u_f - u_l, end - now
        least = min(least, least_on_piece(gap + (w - 0.5 * b * now) * now, b, now, end))
        gap -= (w + 0.5 * b * step) * step
        v_l = 0.0 if end >= rest else v_l + u_l * step
        v_f += u_f * step
        now = end
        if now >= met:
            break
    return max(least, 0.0)


@compiled(apart=True)
def least_closing_of_pair(at: Floats, until: float, plan: Floats, other: Floats) -> tuple[float, float]:
    """Least closing speed at a pair's first contact, and its latest time; 0, inf where none is forced by ``until``."""
    onset = at[LEADER_ONSET]
    if at[LEADER_FREE] > 0.0:
        full = onset + time_to_limit(at[LEADER_V], at[LEADER_U], at[LEADER_LIMIT])
        fill_plan(plan, onset, 0.0, full, at[LEADER_U], full, 0.0, 0.0)
    else:
        fill_braking(plan, onset, at[LEADER_A])
    fill_braking(other, at[FOLLOWER_ONSET], at[FOLLOWER_A])
    _, met, squared = walk(at[PAIR_GAP], at[LEADER_V], plan, at[FOLLOWER_V], other, until)
    if not met < until:
        return 0.0, math.inf
    return math.sqrt(squared) if at[LEADER_FREE] > 0.0 else least_before(at, met, squared), met


@compiled
def bound_pairs(pairs: Floats, until: Floats, out: Floats) -> None:
    """Bounds of pairs ``pairs`` [n, PAIR_WIDTH] into ``out`` [n]; a touch counts as 0."""
    plan, other = empty_plan(), empty_plan()
    for k in range(pairs.shape[0]):
        closing = least_closing_of_pair(pairs[k], until[k], plan, other)[0]
        out[k] = closing * closing if closing * closing > _TOUCH_HARM else 0.0


# Compiled: the least harm over all first meetings with a rear vehicle that may do as it likes.
#
# It is never behind, nor slower than, its full braking, but it may come earlier. So a meeting is a time, how much
# *further* it has come than by full braking, and a closing speed. Cells of these are halved until their bounds come
# close to the least meeting tried. docs/avoidability.md, "Teams", has the proof.

SINCE, POWER, FLOOR, BEST, SEARCH = range(5)  # of a search: see gained; the front pair's own bound; the least meeting
SEARCHED = 400  # divisions after which the least meeting stays as loosely bounded as it is
_SHORT_S = 1e-3


@compiled
def gained(near: float, time: float, since: float, power: float) -> float:
    """How much faster than by full braking the rear vehicle is, at least, if it has come ``near`` further by ``time``.

    It holds back from ``since`` on, at most ``power`` a second (infinite where others push it).
    """
    if near <= 0.0 or time <= since:
        return 0.0
    span = time - since
    if power == math.inf:
        return near / span
    return float(power * (span - math.sqrt(max(span * span - 2.0 * near / power, 0.0))))


@compiled
def behind_full_braking(at: Floats, early: float, late: float) -> float:
    """Gap behind, at least, where both brake fully: the controlled one until ``early``, the rear one until ``late``."""
    return float(
        at[LINE.GAP_R] + solo_motion(at[LINE.V_F], -at[LINE.A_F], 0.0, math.inf, early)[1] - follower(at, late)[1]
    )


@compiled
def soft_behind(at: Floats, early: float, late: float, near: float, far: float, since: float, power: float) -> float:
    """Least closing speed of the meetings behind in a cell."""
    faster = gained(near, late, since, power)
    # of one that comes as much further, by the fastest way to be there: brake, then drive; negative where it is faster
    brake = braking_to_rear(at, late, far + faster * (late - early))
    closing = follower(at, late)[0] - braked_then_driven(at, brake, late)[1]
    return max(closing + faster, 0.0)


@compiled(apart=True)
def after_behind(
    at: Floats, early: float, late: float, near: float, far: float, hard: float, faster: float, moved: Floats,
    plan: Floats, other: Floats,
) -> float:  # fmt: skip
    """Least squared closing speed at the front after the meetings behind of a cell, of at most ``hard``.

    The state is one at ``early`` that is, at every later time of the cell, no further and no faster than that of any
    meeting there: ``near`` to ``far`` further than by full braking, and ``faster``.
    """
    further = near - faster * (late - early)
    v_l, way_l = leader(at, early)
    v_r, way_r = follower(at, early)
    gap = max(at[LINE.GAP_L] + at[LINE.GAP_R] + way_l - way_r - further, 0.0)
    passed = max(follower(at, late)[1] - way_r - (leader(at, late)[1] - way_l), 0.0)
    for column in range(LINE.WIDTH):
        moved[column] = at[column]
    moved[LINE.V_L], moved[LINE.GAP_L], moved[LINE.GAP_R] = v_l, gap, 0.0
    moved[LINE.V_R], moved[LINE.ONSET_R] = v_r + faster, max(at[LINE.ONSET_R] - early, 0.0)
    share, rest = at[LINE.REAR_SHARE], 1.0 - at[LINE.REAR_SHARE]
    speed = moved[LINE.V_R] - rest * hard
    if share * (1.0 + at[LINE.RESTITUTION]) <= 1.0:
        speed += share * at[LINE.RESTITUTION] * hard
    speed = max(speed - max(at[LINE.A_R] - at[LINE.A_F], 0.0) * (late - early), 0.0)
    least = gap - passed - (far - further)
    squared = braking_after(gap, least, v_l, at[LINE.A_L], speed, at[LINE.A_F], plan, other)
    if at[LINE.A_F] < at[LINE.A_R]:
        return squared
    pushed = pushed_by_rear(moved, 0.0, late - early, hard, late - early, 0.0, gap, plan, other)
    return max(squared, pushed * pushed)


@compiled(apart=True)
def put_behind(
    at: Floats, early: float, late: float, near: float, far: float, soft: float, hard: float, search: Floats,
    count: int, moved: Floats, plan: Floats, other: Floats, heap: Floats,
) -> int:  # fmt: skip
    """Put a cell of meetings behind on the heap if it may hold less harm than the best; the new number of cells."""
    since, power, floor = search[SINCE], search[POWER], search[FLOOR]
    room = at[LINE.GAP_L] + at[LINE.GAP_R] + leader(at, late)[1] - follower(at, early)[1]
    span = max(late - since, 0.0)
    if near > room or behind_full_braking(at, early, late) > far or 2.0 * near > power * span * span:
        return count
    soft = max(soft, soft_behind(at, early, late, near, far, since, power))
    if soft >= hard:
        return count
    follows = after_behind(at, early, late, near, far, hard, gained(near, late, since, power), moved, plan, other)
    harm = soft * soft + max(follows, floor)
    if harm >= search[BEST]:
        return count
    k = room_for(heap, count, harm)
    heap[k, _EARLY], heap[k, _LATE], heap[k, _SOFT], heap[k, _HARD] = early, late, soft, hard
    heap[k, _NEAR], heap[k, _FAR] = near, far
    return count + 1


@compiled(apart=True)
def try_behind(
    at: Floats, time: float, near: float, far: float, search: Floats, moved: Floats, plan: Floats, other: Floats
) -> None:
    """Lower the best to the bound of the gentlest meeting behind at ``time`` that is about ``near`` further."""
    near = max(near, behind_full_braking(at, time, time))
    if near > far or near > at[LINE.GAP_L] + at[LINE.GAP_R] + leader(at, time)[1] - follower(at, time)[1]:
        return
    since, power = search[SINCE], search[POWER]
    soft = soft_behind(at, time, time, near, near, since, power)
    follows = after_behind(at, time, time, near, near, soft, gained(near, time, since, power), moved, plan, other)
    search[BEST] = min(search[BEST], soft * soft + max(follows, search[FLOOR]))


@compiled(apart=True)
def divide_behind(
    at: Floats, search: Floats, count: int, moved: Floats, plan: Floats, other: Floats, heap: Floats
) -> int:
    """Replace the first cell of the heap by its halves; the new number of cells."""
    early, late, near, far = heap[0, _EARLY], heap[0, _LATE], heap[0, _NEAR], heap[0, _FAR]
    soft, hard = heap[0, _SOFT], min(heap[0, _HARD], math.sqrt(search[BEST]))
    count = drop_first(heap, count)
    try_behind(at, early, near, far, search, moved, plan, other)
    by_time = (late - early) * (at[LINE.U_F] + at[LINE.A_F] + at[LINE.A_R])
    by_place = (far - near) / max(late - search[SINCE], _SHORT_S)
    for half in range(2):
        times, places, speeds = (early, late), (near, far), (soft, hard)
        if by_time >= max(by_place, hard - soft):
            middle = 0.5 * (early + late)
            times = (early, middle) if half == 0 else (middle, late)
        elif by_place >= hard - soft:
            middle = 0.5 * (near + far)
            places = (near, middle) if half == 0 else (middle, far)
        else:
            middle = 0.5 * (soft + hard)
            speeds = (soft, middle) if half == 0 else (middle, hard)
        count = put_behind(
            at, times[0], times[1], places[0], places[1], speeds[0], speeds[1], search, count, moved, plan, other, heap
        )
    return count


@compiled(apart=True)
def meetings_behind(
    at: Floats, last: float, search: Floats, moved: Floats, plan: Floats, other: Floats, heap: Floats
) -> float:
    """Lower bound of the harm, if below the best, of all meetings behind that come first, until ``last``."""
    since, hard, count = min(search[SINCE], last), math.sqrt(search[BEST]), 0
    if since > 0.0:
        count = put_behind(at, 0.0, since, 0.0, 0.0, 0.0, hard, search, count, moved, plan, other, heap)
    if last > since:
        far = at[LINE.GAP_L] + at[LINE.GAP_R] + leader(at, last)[1] if search[POWER] > 0.0 else 0.0
        count = put_behind(at, since, last, 0.0, far, 0.0, hard, search, count, moved, plan, other, heap)
    for _ in range(SEARCHED):
        if count == 0 or heap[0, _HARM] >= search[BEST] - CELL * (1.0 + search[BEST]):
            break
        count = divide_behind(at, search, count, moved, plan, other, heap)
    return float(min(search[BEST], heap[0, _HARM]) if count > 0 else search[BEST])


# Compiled: the least harm of the front three, Vehicle 1 scripted, Vehicle 2 controlled, the one behind it anything.
#
# The meetings with the leader are those of one controlled vehicle (``lower_bound_kernel``): a rear vehicle that comes
# earlier only makes what follows worse. Those behind have a search of their own (``meetings_behind``).
# docs/avoidability.md, "Teams", has the proofs.


@compiled(apart=True)
def all_at_once(at: Floats, first: float, last: float, pair: Floats, plan: Floats, other: Floats) -> float:
    """Least harm where leader and rear vehicle meet, with the controlled one between them; inf where they do not.

    The front pair has at least the least closing speed of its meetings, the other one what is left.
    """
    pair[PAIR_GAP], pair[LEADER_ONSET], pair[LEADER_FREE] = at[LINE.GAP_L] + at[LINE.GAP_R], 0.0, 0.0
    pair[LEADER_V], pair[LEADER_A] = at[LINE.V_L], at[LINE.A_L]
    pair[FOLLOWER_V], pair[FOLLOWER_ONSET], pair[FOLLOWER_A] = at[LINE.V_R], at[LINE.ONSET_R], at[LINE.A_R]
    both, met = least_closing_of_pair(pair, math.inf, plan, other)
    if met == math.inf:
        return math.inf
    until = min(met, last)
    least = gentlest_between(FRONT_FIRST, at, first, until) if until > first else 0.0
    front = max(least, 0.5 * both)
    rear = max(both - front, 0.0)
    return float(front * front + rear * rear)


@compiled(apart=True)
def late_meetings(at: Floats, first: float, stand: float, plan: Floats, other: Floats) -> int:
    """Whether the rear vehicle may first meet the controlled one only after it would stand by full braking.

    0: no. 1: yes, and then no harm is less than where the leader is met first. 2: yes, and nothing is proven.
    """
    if first == math.inf or not stays_ahead(at, first, first, plan, other):
        return 0
    _, end, leans = last_meeting(at, first, plan, other)  # first of the leader, the rear one braking fully
    if end <= stand and not leans:
        return 0
    leader_moves = at[LINE.A_F] < at[LINE.A_L] and at[LINE.V_L] > at[LINE.A_L] * stand
    thrown_back = (
        1.0 - at[LINE.FRONT_SHARE] < at[LINE.RESTITUTION] * at[LINE.FRONT_SHARE] or at[LINE.OBSTACLE] < math.inf
    )
    return 2 if leader_moves or thrown_back else 1


@compiled(apart=True)
def combined_bound_of_team(
    at: Floats, until: float, front: float, rear: float, since: float, power: float, pair: Floats, moved: Floats,
    plan: Floats, other: Floats, heap: Floats, heap_behind: Floats,
) -> float:  # fmt: skip
    """Least harm of the front three where contact is unavoidable, whoever is met first; 0 if that may be after until.

    ``front`` and ``rear`` are the pairs' own bounds. The rear vehicle may hold back from ``since`` on, by ``power``.
    """
    rest, stand = last_rest(at)
    if not rest < until:
        return 0.0
    first = meet_front(at, math.inf, plan, other)
    late = late_meetings(at, first, stand, plan, other)
    if late == 2:
        return 0.0
    step, least, any_time = at[LINE.TIME_STEP], 0.0, 0.0
    once = all_at_once(at, first, meet_front(at, 0.0, plan, other), pair, plan, other)
    search = np.empty(SEARCH)
    search[SINCE], search[POWER], search[FLOOR] = since, power, front
    for time_step in (0.0, step):  # what holds for any command holds for one that changes at decisions only
        at[LINE.TIME_STEP] = time_step
        best = min(front_first(at, rear, LARGE, front + rear, plan, other, heap), once)
        if time_step <= 0.0:
            any_time = best
        elif late == 1:
            best = min(best, any_time)
        search[BEST] = best
        if best > front + rear:
            best = meetings_behind(at, stand, search, moved, plan, other, heap_behind)
        least = max(least, best - _TOUCH_HARM if best < LARGE else 0.0)
        if step <= 0.0:
            break
    return least


@compiled
def bound_threes(states: Floats, until: Floats, pairs: Floats, since: Floats, power: Floats, out: Floats) -> None:
    """Combined bounds of the front three of worlds ``states`` [n, WIDTH] into ``out`` [n]; contact is unavoidable.

    ``pairs`` [n, 2] are the bounds of their two pairs.
    """
    plan, other, pair, moved = empty_plan(), empty_plan(), np.empty(PAIR_WIDTH), np.empty(LINE.WIDTH)
    heap, heap_behind = np.empty((CELLS, _NEAR)), np.empty((SEARCHED + 4, HEAP_WIDTH))
    for k in range(states.shape[0]):
        out[k] = combined_bound_of_team(
            states[k], until[k], pairs[k, 0], pairs[k, 1], since[k], power[k], pair, moved, plan, other, heap,
            heap_behind,
        )  # fmt: skip


# The front three vehicles of a line whose second one is controlled, bounded together: rows of the compiled bound.
#
# An obstacle ahead of a controlled Vehicle 1 is a first vehicle that nothing moves. docs/avoidability.md, "Teams".

_MIDDLE, _REAR = 1, 2
_UNMOVED_T = 1e30  # an obstacle: its share of any two masses is 1


def _combined_bound_of_line(
    now: Worlds, onset: Floats, counts: Bools, chosen: Ints, until: Floats, pairs: Floats, time_step_s: float | None
) -> Floats:
    """The bound of the front two pairs together, [n] m2/s2, ``until`` [n] s from now; 0 where nothing is proven.

    ``onset`` [n, N] is counted from now; ``counts`` [n, P] says of which pairs the next impact counts, and which move
    forward. It asks that the first vehicle brakes by now; the second one, which is among the ``chosen``, is taken to
    act from now on. ``pairs`` [n, 2] are the bounds of both pairs alone.
    """
    v = now.vehicles
    stops = (
        stopping_distances(now.speeds_mps[:, 0], onset[:, 0], v.braking_capacity_mps2[:, 0], v.brake_rate_mps3[:, 0])
        < now.obstacle_gap_m
    )
    rows = np.flatnonzero((onset[:, 0] <= 0.0) & counts[:, 0] & counts[:, 1] & stops & ~now.obstacle_hit)
    # The first three vehicles of these worlds, Vehicle 2 free to act at once.
    some = now.take(rows)
    given = some.vehicles
    braking, driving, latency, mass, limit = (
        np.ascontiguousarray(each[:, :3])
        for each in (
            given.braking_capacity_mps2,
            given.driving_capacity_mps2,
            given.latency_s,
            given.mass_t,
            given.speed_limit_mps,
        )
    )
    latency[:, _MIDDLE] = np.minimum(latency[:, _MIDDLE], some.time_s)
    three = replace(
        some,
        vehicles=Vehicles.at_once(braking, driving, latency, mass, limit, given.restitution),
        gaps_m=some.gaps_m[:, :2].copy(),
        speeds_mps=some.speeds_mps[:, :3].copy(),
        pair_hit=some.pair_hit[:, :2].copy(),
        command_mps2=some.command_mps2[:, :3].copy(),
        messages=np.zeros((some.n, 0)),
    )
    if not len(rows):
        return np.zeros(now.n)
    unavoidable = avoidability(three, _MIDDLE).reason >= 2
    rows, three = rows[unavoidable], three.take(np.flatnonzero(unavoidable))
    steps = np.where(onset[rows, _MIDDLE] <= 0.0, 0.0 if time_step_s is None else time_step_s, 0.0)
    since, power = np.zeros(len(rows)), np.full(len(rows), np.inf)
    if now.N == 3:  # nobody pushes the last one
        full = v.braking_capacity_mps2[rows, _REAR] + v.driving_capacity_mps2[rows, _REAR]
        since, power = onset[rows, _REAR], full if _REAR in chosen else np.zeros(len(rows))
    found, out = np.zeros(now.n), np.empty(len(rows))
    bound_threes(onset_states(three, _MIDDLE, steps), until[rows], pairs[rows], since, power, out)
    found[rows] = out
    return found


@dataclass(frozen=True, slots=True)
class TeamBound:
    """What is proven about each world [n], in m2/s2."""

    harm: Floats  # no joint command does less harm than this
    early: Floats  # done before any controlled vehicle may act
    obstacle: Floats  # Vehicle 1 and the obstacle ahead
    pairs: Floats  # [n, P] of each pair alone, from then on
    combined: Floats  # of the front two pairs together (see ``team_bound``); 0 where nothing is proven

    @property
    def impact_proven(self) -> Bools:
        """Whether every joint command has an impact, [n]; elsewhere none is proven."""
        return np.asarray(self.harm > 0.0, np.bool_)


def team_bound(
    worlds: Worlds,
    vehicles: Iterable[int],
    *,
    harm_count: HarmCount = "first",
    horizon_s: float = 8.0,
    scripts: Mapping[int, str] | None = None,
    time_step_s: float | None = None,
) -> TeamBound:
    """Proven lower bound on the harm from now to ``horizon_s`` (absolute), over all joint commands of ``vehicles``.

    ``harm = early + obstacle + max(pairs[:, 0] + pairs[:, 1], combined) + pairs[:, 2:]``, each part rounded outward;
    where Vehicle 1 is controlled, ``combined`` is that of the obstacle and Vehicles 1 and 2: ``early + max(obstacle +
    pairs[:, 0], combined) + pairs[:, 1:]``.
    All other vehicles brake with their whole capacity from their latencies on; ``scripts`` (index -> name) is only
    checked to say the same. What may come only after the horizon counts as 0, and so does the next impact of a pair
    that was hit before where ``harm_count`` is "first". One controlled vehicle is allowed; ``lower_bound`` is sharper
    where it covers the line.

    With ``time_step_s`` it is proven only for commands that change at decisions, the first one when the first of the
    vehicles may act, one every ``time_step_s`` after it. That is sharper where Vehicle 2 is the first.

    Raises ``InvalidInput`` for vehicles that are none, not there or given twice, another script, an unknown count, a
    time step below ``LEAST_TIME_STEP_S``, and a horizon that is not finite or lies before any of them may act.
    """
    check_asked("team_bound", harm_count, horizon_s, time_step_s)
    # The controlled vehicles in order; refuse what the bound does not cover.
    if not isinstance(vehicles, Iterable):
        raise InvalidInput(f"team_bound: vehicles {vehicles!r}: must be a list of vehicles, for instance (1, 2)")
    given = tuple(vehicles)
    for vehicle in given:
        check_whole_number("team_bound: a vehicle", vehicle, 0, worlds.N - 1)
    if not given or len(set(given)) != len(given):
        raise InvalidInput(f"team_bound: vehicles {given}: at least one is needed, each once")
    for index, script in (scripts or {}).items():
        check_whole_number("team_bound: a vehicle of scripts", index, 0, worlds.N - 1)
        if index not in given and script != "full_brake":
            raise InvalidInput(f"team_bound: vehicle_{index + 1} follows {script!r}; must be 'full_brake'")
    chosen = np.array(sorted(given), np.int64)
    worlds.refuse_build_up("team_bound")
    now, start, early, counts = _at_onset("team_bound", worlds, chosen, harm_count, horizon_s)
    onset = np.maximum(worlds.vehicles.latency_s - start[:, np.newaxis], 0.0)
    until, v = horizon_s - start, now.vehicles
    each: list[dict[int, Floats | float]] = [
        {
            PAIR_GAP: now.gaps_m[:, p],
            LEADER_V: now.speeds_mps[:, p],
            LEADER_ONSET: onset[:, p],
            LEADER_A: v.braking_capacity_mps2[:, p],
            LEADER_FREE: float(p in chosen),
            LEADER_U: v.driving_capacity_mps2[:, p],
            LEADER_LIMIT: v.speed_limit_mps[:, p],
            FOLLOWER_V: now.speeds_mps[:, p + 1],
            FOLLOWER_ONSET: onset[:, p + 1],
            FOLLOWER_A: v.braking_capacity_mps2[:, p + 1],
        }
        for p in range(worlds.N - 1)
    ]
    pairs = np.stack([_pair_bound(columns, until, counts[:, p]) for p, columns in enumerate(each)], axis=1)
    ahead = np.isfinite(now.obstacle_gap_m) & ~(now.obstacle_hit & (harm_count == "first"))
    ahead &= now.speeds_mps[:, 0] >= 0.0
    standing: dict[int, Floats | float] = {  # the obstacle, as the front vehicle of a pair
        PAIR_GAP: np.where(ahead, now.obstacle_gap_m, 0.0),
        LEADER_A: 1.0,
        FOLLOWER_V: now.speeds_mps[:, 0],
        FOLLOWER_ONSET: onset[:, 0],
        FOLLOWER_A: v.braking_capacity_mps2[:, 0],
    }
    obstacle = _pair_bound(standing, until, ahead)
    combined, walled = np.zeros(worlds.n), bool(chosen[0] == 0)
    if walled and ahead.any():
        # the line with its obstacle as a first vehicle that stands and that nothing moves
        line = now.with_obstacle()
        braking, mass = line.vehicles.braking_capacity_mps2.copy(), line.vehicles.mass_t.copy()
        braking[:, 0], mass[:, 0] = 1.0, _UNMOVED_T
        behind = replace(line.vehicles, braking_capacity_mps2=braking, mass_t=mass)
        line = replace(line, vehicles=behind, obstacle_gap_m=np.ones(line.n))  # thrown back: no centre of mass
        onsets, counted = np.column_stack([np.zeros(line.n), onset]), np.column_stack([ahead, counts])
        both = np.stack([obstacle, pairs[:, 0]], axis=1)
        combined = _combined_bound_of_line(line, onsets, counted, chosen + 1, until, both, time_step_s)
    elif worlds.N >= 3 and chosen[0] == 1:
        combined = _combined_bound_of_line(now, onset, counts, chosen, until, pairs[:, :2], time_step_s)
    outward = rounding(worlds, chosen, np.where(np.isfinite(worlds.obstacle_gap_m), worlds.obstacle_gap_m, 0.0))
    early, obstacle, combined = (np.maximum(part - outward, 0.0) for part in (early, obstacle, combined))
    pairs = np.maximum(pairs - outward[:, np.newaxis], 0.0)
    alone = np.column_stack([obstacle, pairs])
    together = alone[:, :2] if walled else alone[:, 1:3]
    harm = early + alone.sum(axis=1) + np.maximum(combined - together.sum(axis=1), 0.0)
    return TeamBound(harm, early, obstacle, pairs, combined)


def _pair_bound(columns: Mapping[int, Floats | float], until: Floats, counts: Bools) -> Floats:
    """The bound of one pair alone, [n], of which these columns are not 0; 0 where its next impact does not count."""
    at, found, out = np.zeros((len(until), PAIR_WIDTH)), np.zeros(len(until)), np.empty(int(counts.sum()))
    for column, values in columns.items():
        at[:, column] = values
    bound_pairs(at[counts], until[counts], out)
    found[counts] = out
    return found


# Profiles of full drive and full braking from which a search starts: drive, brake to the leader, drive; or the mirror.
#
# The proof of the lower bound says what the least harm looks like: the vehicle drives as hard as it can for a while,
# then brakes as hard as it can until it meets the leader; or it brakes, then drives until the rear one meets it. After
# that it goes the other way (docs/avoidability.md). A random search seldom finds such a narrow optimum.

KEPT = 12  # profiles of each world
_LATEST_S = 2.0  # of the first change of command, at first
_TIMES = 24  # of it that are tried in each round
_ROUNDS = 3  # each closer around the best one
_PHASES = 5  # before the first change, its step, up to the second one, its step, after it


def extreme_profiles(problem: ProfileProblem, states: Floats, has_front: Bools, has_rear: Bools) -> Profiles:
    """The ``KEPT`` best such profiles of each world [n * KEPT], world by world, of the one controlled vehicle.

    ``states`` [n, WIDTH] is each world at the first decision (as of the bound). It tells only when the two would
    meet, so a neighbour that does not brake fully makes the profiles less good, not wrong. A neighbour that is not
    there [n] is not met.
    """
    n, last = problem.n, problem.last_step
    ends = np.repeat(last, KEPT * MOST_PHASES).reshape(n, KEPT, MOST_PHASES)
    commands = np.zeros((n, KEPT, MOST_PHASES, 1))
    _fill_extremes(problem, states, has_front, has_rear, ends, commands)
    return Profiles(ends.reshape(-1, MOST_PHASES), commands.reshape(-1, MOST_PHASES, 1))


@compiled
def _fill_extremes(
    problem: ProfileProblem, states: Floats, has_front: Bools, has_rear: Bools, ends: Ints, commands: Floats
) -> None:
    """Fill ``ends`` [n, KEPT, K] and ``commands`` [n, KEPT, K, 1]."""
    no_random = np.zeros(states.shape[0], np.uint64)
    for k in range(states.shape[0]):
        world = make_search_world(problem, k, no_random)
        values = np.full(KEPT, math.inf)
        for kind, there in ((FRONT_FIRST, has_front[k]), (REAR_FIRST, has_rear[k])):
            low, high = 0.0, _LATEST_S
            for _ in range(_ROUNDS if there else 0):
                best = try_changes(world, kind, states[k], problem.start[k], low, high, ends[k], commands[k], values)
                around = 1.5 * (high - low) / (_TIMES - 1)
                low, high = max(best - around, 0.0), best + around


@compiled(apart=True)
def try_changes(
    world: SearchWorld, kind: int, at: Floats, start: Floats, low: float, high: float, ends: Ints, commands: Floats,
    values: Floats,
) -> float:  # fmt: skip
    """Try first changes of command from ``low`` to ``high`` (s) and keep the best profiles; the best change."""
    plan, other = empty_plan(), empty_plan()
    states = np.zeros((_PHASES + 1, start.shape[0]))
    copy_rows(start.reshape(1, -1), states, 1)
    tried_ends, tried = np.zeros(_PHASES, np.int64), np.zeros((_PHASES, 1))
    least, best = math.inf, low
    for k in range(_TIMES):
        change = low + (high - low) * k / (_TIMES - 1)
        meeting = meet_front(at, change, plan, other) if kind == FRONT_FIRST else meet_rear(at, change, plan, other)
        for early, share in ((0, 0.0), (0, 0.5), (0, 1.0), (1, 0.5)):
            fill_extreme(world, kind, change, meeting, early, share, tried_ends, tried)
            value, reached = follow_whole(world.episode, tried_ends, tried, states, math.inf)
            if reached < 0:
                continue
            if value < least:
                least, best = value, change
            worst = largest(values)
            if value < values[worst]:
                values[worst] = value
                copy_profile(tried_ends, tried, ends[worst], commands[worst])
                for phase in range(_PHASES, commands.shape[1]):
                    commands[worst, phase, 0] = tried[_PHASES - 1, 0]
    return best


@compiled
def fill_extreme(
    world: SearchWorld, kind: int, change: float, meeting: float, early: int, share: float, ends: Ints, commands: Floats
) -> None:
    """One profile: from ``change`` to ``meeting`` (s) the other command; ``share`` of the first one in the step of it.

    In the step of the change the command leads to the speed that the change would. ``early``: so many steps earlier.
    """
    low, high, step = world.bounds[0, 0], world.bounds[0, 1], world.episode.clock[CLOCK.TIME_STEP]
    last = int(world.episode.clock[CLOCK.LAST_STEP])
    first, second = (high, low) if kind == FRONT_FIRST else (low, high)
    turn = min(int(change / step), last)
    back = max(int(min(meeting / step, last)) - early, turn + 1)
    commands[0, 0], commands[2, 0], commands[4, 0] = first, second, first
    commands[1, 0] = second + (change / step - turn) * (first - second)
    commands[3, 0] = second + share * (first - second)
    ends[0], ends[1], ends[2], ends[3], ends[4] = turn, turn + 1, back, back + 1, last
    for k in range(_PHASES):
        ends[k] = min(ends[k], last)
        commands[k, 0] = allowed(commands[k, 0], low, high)
