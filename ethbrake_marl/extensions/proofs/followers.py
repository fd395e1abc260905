"""Compute lower bounds on the harm with the second neighbour after a first contact with the other neighbour.

The time and the closing speed of the first contact determine the state of all three vehicles at that time. After the
first contact, the extreme command (full drive or full braking) is best for the centre of mass of the two vehicles in
contact. The controlled vehicle moves faster or slower than this centre of mass only until it meets the first neighbour
again; ``flights.largest_lead`` bounds the difference. docs/internals/proofs/lower-bound.md has the proofs.

Each function computes one bound for all first contacts between the times ``early`` and ``late``, from the state at
``early``. From ``late`` to ``end`` the command of the earlier decision still applies. ``proofs/__init__.py`` explains
the arguments that functions share.
"""

from __future__ import annotations

import math

from ethbrake_marl.extensions.proofs.flights import largest_lead, widest_flight
from ethbrake_marl.extensions.proofs.line import FRONT_FIRST, LINE, follower, leader
from ethbrake_marl.extensions.proofs.plans import fill_braking, fill_drive_then_brake, fill_plan, fill_window, walk
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.state import Floats

HELD_M = 1e-6  # largest rounding error of the gap to the leader

# times before the latest contact, s; the bound treats the times before and after each of them separately
LEADS = (0.02, 0.05, 0.1, 0.2, 0.4)


@compiled
def least_of_line(
    start: float, slope: float, turn: float, bend: float, other_turn: float, other_bend: float, since: float,
    until: float,
) -> float:  # fmt: skip
    """Return the smallest value of a piecewise linear function of time from ``since`` to ``until``.

    The function of the time t is ``start + slope t + bend max(t - turn, 0) + other_bend max(t - other_turn, 0)``.
    """
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
    """Return the smallest closing speed (m/s) of the controlled vehicle's contact with its second neighbour.

    The bound is a difference of two speeds, v - d. Here v is the closing speed of the second neighbour relative to the
    centre of mass of the controlled vehicle and the neighbour of its first contact, and d is the largest difference
    between the speeds of the controlled vehicle and this centre of mass. The arguments ``start`` to ``other_bend``
    describe v as a function of time (``least_of_line``); each bend may be negative. ``share`` to ``end`` are the
    arguments of ``largest_lead``, which bounds d. ``until`` is the latest time of the contact with the second
    neighbour. All times are in s after the first contact.
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
    """Return the smallest closing speed (m/s) of the rear pair after a first contact with the leader.

    The bound uses the centre of mass of the leader and the controlled vehicle. The result is 0 if nothing is proven. If
    the leader is at rest at ``early``, a later first contact leads to the same motion at a later time, so the function
    ignores ``late``, ``end`` and ``lack``.
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
    )  # finite if the leader still moves until then, however soft the impact
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
    """Return the smallest closing speed (m/s) of the rear pair after a first contact with a leader that brakes harder
    than the controlled vehicle.

    The controlled vehicle stays near the leader, because the leader brakes harder. The result is 0 if nothing is
    proven.
    """
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
    """Return the smallest squared closing speed (m2/s2) of the rear pair after a first contact with the front vehicle.

    The result is the largest of several lower bounds.
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
    held = held_by_leader(at, early, late, closing, plan, other)
    squared = max(squared, held * held)
    if rest < at[LINE.RESTITUTION] * share:
        return squared
    pushed = pushed_by_leader(at, early, late, closing, end, lack, plan, other)
    return max(squared, pushed * pushed)


@compiled(apart=True)
def braking_after(
    gap: float, least_gap: float, v_l: float, a_l: float, v_f: float, a_f: float, plan: Floats, other: Floats
) -> float:
    """Return the smallest squared closing speed (m2/s2) at which a braking vehicle (f) reaches the vehicle in front
    (l).

    The vehicle brakes with at most ``a_f``; the vehicle in front brakes fully. ``gap`` and ``least_gap`` are the
    largest and the smallest possible gap (m); ``least_gap`` is used only if the vehicle in front brakes harder. The
    result is 0 if contact is not certain.
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
    """Return the smallest closing speed (m/s) of the front pair after the rear vehicle has hit the controlled vehicle.

    The bound uses the centre of mass of the controlled vehicle and the rear vehicle. The braking capacity of the
    controlled vehicle must be at least the braking capacity of the rear vehicle. ``gap`` is the gap to the front
    vehicle at ``early``, m.
    """
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
    """Return the smallest closing speed (m/s) of the front pair after the rear vehicle has hit the controlled vehicle.

    The bound follows from the fact that the controlled vehicle stays ahead of the rear vehicle. The braking capacity of
    the controlled vehicle must be at least the braking capacity of the rear vehicle. The result is 0 if the closing
    speed of the front pair may rise with time. ``gap`` is the gap to the front vehicle at ``early``, m.
    """
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


@compiled(apart=True)
def after_rear(
    at: Floats, early: float, late: float, closing: float, end: float, lack: float, plan: Floats, other: Floats
) -> float:
    """Return the smallest squared closing speed (m2/s2) of the front pair after the rear vehicle's first contact."""
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
    return squared


@compiled(apart=True)
def after(
    kind: int, at: Floats, early: float, late: float, closing: float, end: float, lack: float, plan: Floats,
    other: Floats,
) -> float:  # fmt: skip
    """Return the smallest harm (m2/s2) of the contact with the second neighbour that must follow a first contact."""
    if kind == FRONT_FIRST:
        return after_front(at, early, late, closing, end, lack, plan, other)
    return after_rear(at, early, late, closing, end, lack, plan, other)
