"""Compute lower bounds on the harm that must follow a first contact if an obstacle is ahead of the front vehicle.

``beyond`` is the squared speed (m2/s2) at which the leader hits the obstacle. The leader's speed at the obstacle limits
how far ahead the leader can be at any time. Position 0 is the place of the controlled vehicle at the moment at which it
may act. Masses are in units of the controlled vehicle's mass. ``proofs/__init__.py`` explains the other arguments that
functions share. docs/internals/proofs/lower-bound-obstacle.md has the proofs.
"""

from __future__ import annotations

import math

from ethbrake_marl.extensions.proofs.followers import (
    after_front,
    braking_after,
    obstacle_harm,
    pushed_by_rear,
    slowed_by_rear,
)
from ethbrake_marl.extensions.proofs.line import AHEAD_M, FRONT_FIRST, LARGE, LINE, RAMPED_FRONT, follower, leader
from ethbrake_marl.extensions.proofs.plans import fill_braking, fill_plan, walk
from ethbrake_marl.extensions.proofs.ramped_meetings import after_ramped
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.state import Floats

CELL = 1e-3  # relative and absolute (m2/s2) precision of a minimum

ZONE_M = 1.0  # a vehicle that was stopped at the obstacle is assumed to stay within this distance of it

_BEYOND_PARTS, _BEYOND_FINEST = 4, 4  # number of parts of the range of ``beyond``, and largest number of their parts

_MOST = 400.0  # m2/s2; a larger bound of the rear pair's harm is cut to this value

_FLIGHTS = 6  # number of lengths that are tried for the last drive

_SHORTEST_S = 1e-3  # smallest time in a denominator


@compiled
def all_three(at: Floats) -> tuple[float, float, float, float]:
    """Return the masses of front and rear vehicle, and two decelerations of the centre of mass of all three vehicles
    (m/s2).

    The third result is the largest deceleration of the centre of mass before the rear vehicle brakes. The fourth result
    is the additional deceleration that the rear vehicle's brakes cause.
    """
    front, rear = at[LINE.FRONT_SHARE] / (1.0 - at[LINE.FRONT_SHARE]), at[LINE.REAR_SHARE] / (1.0 - at[LINE.REAR_SHARE])
    whole = front + 1.0 + rear
    return front, rear, (front * at[LINE.A_L] + max(at[LINE.A_F], at[LINE.A_R])) / whole, rear * at[LINE.A_R] / whole


@compiled
def leader_pushed(at: Floats, early: float, beyond: float) -> tuple[float, float]:
    """Return the speed (m/s) of the front vehicle after a push at ``early``, and the time (s) at which the front
    vehicle hits the obstacle after this push.

    The push is just strong enough that the front vehicle hits the obstacle with the speed ``sqrt(beyond)``.
    """
    v = math.sqrt(max(beyond + 2.0 * at[LINE.A_L] * (at[LINE.WALL] - leader(at, early)[1]), 0.0))
    return v, early + (v - math.sqrt(beyond)) / at[LINE.A_L]


@compiled(apart=True)
def least_beyond(
    at: Floats, early: float, late: float, place: float, speed: float, least: float, plan: Floats, other: Floats
) -> float:
    """Return the smallest squared speed (m2/s2) at which the front vehicle, pushed at ``early``, hits the obstacle.

    The bound uses the centre of mass of all three vehicles, which cannot reach the obstacle before the front vehicle
    does. At ``late``, ``place`` is the smallest possible position (m) and ``speed`` the speed (m/s) of this centre of
    mass. The result is at least ``least``, a lower bound that is known already.
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
    """Return the smallest possible position (m) and the smallest possible speed (m/s), at ``late``, of the controlled
    vehicle after a first contact with the front vehicle, or of the centre of mass of these two vehicles.

    The third result is the assumed deceleration (m/s2): the largest braking capacity of all three vehicles, so that no
    command and no push leads to a smaller position. ``faster`` is the speed right after the first contact minus the
    speed of the front vehicle right before it, m/s.
    """
    v_l, way = leader(at, late)
    brakes = max(at[LINE.A_F], at[LINE.A_L], at[LINE.A_R])
    slack = brakes - at[LINE.A_L] if late * at[LINE.A_L] <= at[LINE.V_L] else brakes
    span = late - early
    return at[LINE.GAP_L] + way - 0.5 * slack * span * span, max(v_l + faster - slack * span, 0.0), brakes


@compiled
def last_drive(room: float, speed: float, brakes: float, drive: float, time: float) -> float:
    """Return how long (s) a vehicle must drive, after braking first, to travel ``room`` metres in ``time`` seconds in
    all.

    The result is above ``time`` if the vehicle cannot travel so far. ``speed`` is the present speed (m/s), ``brakes``
    the deceleration and ``drive`` the acceleration (m/s2).
    """
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
    """Return three limits for the controlled vehicle if the front vehicle stops it at the obstacle: distance, backward
    speed and time.

    The distance (m) is the vehicle's largest distance from the obstacle; it is infinite if no limit is known. The speed
    (m/s) is the vehicle's largest backward speed. The time (s) is the longest time that the vehicle can spend near the
    obstacle before the rear vehicle arrives.

    The front vehicle hits the obstacle at the time ``struck``, and the rear vehicle arrives by the time ``until`` (s).
    ``place`` and ``speed`` are the smallest possible position (m) and speed (m/s) of the vehicle at ``late``,
    ``brakes`` is its deceleration (m/s2).
    """
    bounce, drive, wall = at[LINE.RESTITUTION], at[LINE.U_F], at[LINE.GAP_L] + at[LINE.WALL]
    v_l, way = leader(at, early)
    most, top = at[LINE.WALL] - way, v_l + hard
    fastest = math.sqrt(top * top + 2.0 * drive * most)
    soonest = early + 2.0 * most / max(top + fastest, _SHORTEST_S)
    wait = max(until - max(soonest, struck, late), 0.0)
    back = bounce * max((1.0 - at[LINE.FRONT_SHARE]) * (1.0 + bounce), 1.0)
    # the speed of its arrival falls with the time, until it can stop on the way
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
    """Return the smallest squared closing speed (m2/s2) of the rear pair after a first contact with the front vehicle.

    The function assumes that the front vehicle hits the obstacle with at most ``sqrt(beyond)`` m/s, and that no vehicle
    passes the front vehicle or the obstacle. The result is LARGE (a huge number) if these assumptions contradict each
    other. ``place`` and ``speed`` are as in ``least_beyond``.
    """
    wall, drive, onset = at[LINE.GAP_L] + at[LINE.WALL], at[LINE.U_F], at[LINE.ONSET_R]
    rest = 1.0 - at[LINE.FRONT_SHARE] * (1.0 + at[LINE.RESTITUTION])
    # latest time at which the rear vehicle arrives at the leader, or at the obstacle
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
    least, low, brakes = slowest(at, early, late, rest * soft)
    time, stand = until - late, low / brakes
    if not _SHORTEST_S < time < math.inf:
        return 0.0
    # largest speed of the controlled vehicle at that time, from the smallest position that it had before
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
    fastest = v_l + rest * hard + drive * (until - early)
    for k in range(_FLIGHTS if at_wall else 1):
        flight = min(max(longest * (1.0 - k / _FLIGHTS), _SHORTEST_S), time)
        braked = min(time - flight, stand)
        behind = least + (low - 0.5 * brakes * braked) * braked
        if at_wall:
            behind = min(behind, wall - near - back * max(wait - flight, 0.0))
        fastest = min(fastest, (goal - behind) / flight + 0.5 * drive * flight)
    closing = max(v_r - fastest, 0.0)
    if not at_wall:
        # the drive that makes this contact so soft brings all three vehicles nearer to the obstacle
        fill_braking(plan, 0.0, brakes)
        fill_braking(other, max(onset - late, 0.0), at[LINE.A_R])
        v_r, way_r = follower(at, late)
        since = min(walk(max(least - way_r + at[LINE.GAP_R], 0.0), low, plan, v_r, other, time)[1], time)
        v_r, way_r = follower(at, late + since)
        v_l, way_l = leader(at, late)
        v_f, weak = v_l + rest * hard, max(at[LINE.A_F], at[LINE.A_R])
        further = way_r - at[LINE.GAP_R] - at[LINE.GAP_L] - way_l - rest * hard * (late - early)
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
    """Return the smallest sum (m2/s2) of the harm of the rear pair and the harm at the obstacle, after a first contact
    with the front vehicle.

    ``follows`` is a known lower bound on the harm of the rear pair, m2/s2.
    """
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
    # the harder the leader hits the obstacle, the softer the contact with the rear vehicle can be
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
    """Return the smallest squared speed (m2/s2) of the front vehicle at the obstacle if the first contact is with the
    rear vehicle.

    The result is at least ``least``, a lower bound that is known already.
    """
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
    """Return the smallest sum (m2/s2) of the harm of the front pair and the harm at the obstacle, after a first contact
    with the rear vehicle.
    """
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
    """Return the smallest harm (m2/s2) that must follow a first contact: the harm of the contact with the second
    neighbour.

    After a first contact with the rear vehicle, the result includes the harm at an obstacle. After a first contact with
    the front vehicle it does not; ``after_at_obstacle`` adds this harm.
    """
    if kind >= RAMPED_FRONT:
        return after_ramped(kind, at, early, late, closing, plan, other)
    if kind == FRONT_FIRST:
        return after_front(at, early, late, closing, end, lack, plan, other)
    return after_rear(at, early, late, closing, end, lack, plan, other)
