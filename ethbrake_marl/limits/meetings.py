"""Compiled: the gentlest first meeting of the controlled vehicle with a neighbour at a given time.

Times count from the moment at which the controlled vehicle may act; the front vehicle (leader, l) brakes by then, f is
the controlled one, the rear vehicle (r) coasts to its onset and then brakes. All speeds and gaps are >= 0.
docs/avoidability.md has the proofs.
"""

from __future__ import annotations

import math

from ethbrake_marl.limits.avoidability import (
    fill_brake_then_drive,
    fill_braking,
    fill_drive_then_brake,
    fill_plan,
    fill_window,
    time_to_limit,
    walk,
)
from ethbrake_marl.physics.compiled import compiled, compiled_apart
from ethbrake_marl.physics.kernel import solo_motion
from ethbrake_marl.physics.worlds import Floats

# one world when the controlled vehicle may act
GAP_L, V_L, A_L = 0, 1, 2
V_F, A_F, U_F, LIMIT_F = 3, 4, 5, 6
GAP_R, V_R, A_R, ONSET_R = 7, 8, 9, 10
FRONT_SHARE = 11  # m_l / (m_l + m_f)
REAR_SHARE = 12  # m_r / (m_f + m_r)
RESTITUTION = 13
TIME_STEP = 14  # between two decisions (s), the first one now; 0 where commands may change at any time
OBSTACLE = 15  # gap from the leader to an obstacle ahead of it (m), which it does not reach by itself; inf without
WIDTH = 16
FRONT_FIRST, REAR_FIRST = 0, 1
_HALVINGS = 60
_GUARD = 2.0**-46  # of the positions: a way that rounding shortens must not make a meeting look harder
AHEAD_M = 1e-9  # an overlap up to this is no meeting with the other vehicle


@compiled
def leader(at: Floats, time: float) -> tuple[float, float]:
    """Speed and way of the front vehicle, left alone until ``time``."""
    speed, way, _ = solo_motion(at[V_L], -at[A_L], 0.0, math.inf, time)
    return speed, way


@compiled
def follower(at: Floats, time: float) -> tuple[float, float]:
    """Speed and way of the rear vehicle, left alone until ``time``."""
    speed, way, _ = solo_motion(at[V_R], -at[A_R], at[ONSET_R], math.inf, time)
    return speed, way


@compiled_apart
def gentlest_front(at: Floats, time: float) -> tuple[float, float]:
    """Least closing speed of a meeting with the leader at ``time``, and how long it must be driven before braking.

    The slowest way to be there then: drive, then brake.
    """
    v_l, way = leader(at, time)
    place, v, u, a = at[GAP_L] + way, at[V_F], at[U_F], at[A_F]
    cap = time_to_limit(v, u, at[LIMIT_F])
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
    v, u, a = at[V_F], at[U_F], at[A_F]
    braking = min(brake, v / a)
    slow = max(v - a * brake, 0.0)
    cap = time_to_limit(slow, u, at[LIMIT_F])
    drive = u if cap > 0.0 else 0.0
    left = time - brake
    beyond = max(left - cap, 0.0)
    way = (v - 0.5 * a * braking) * braking + (slow + 0.5 * drive * left) * left - 0.5 * drive * beyond * beyond
    return way, slow + drive * (left - beyond)


@compiled_apart
def braking_to_rear(at: Floats, time: float) -> float:
    """How long it must be braked to be met by the rear vehicle at ``time``, if it is driven from then on."""
    place = follower(at, time)[1] - at[GAP_R]
    low, high = 0.0, time
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if braked_then_driven(at, middle, time)[0] >= place:
            low = middle
        else:
            high = middle
    return low


@compiled_apart
def gentlest_rear(at: Floats, time: float) -> tuple[float, float]:
    """Least closing speed of a meeting with the rear vehicle at ``time``, and how long it must be braked before.

    The fastest way to be there then: brake, then drive. The braking is infinite where that is at its speed limit.
    """
    brake = braking_to_rear(at, time)
    speed = braked_then_driven(at, brake, time)[1]
    return max(follower(at, time)[0] - speed, 0.0), brake if speed < at[LIMIT_F] else math.inf


@compiled_apart
def gentlest(kind: int, at: Floats, time: float) -> tuple[float, float]:
    """``gentlest_front`` or ``gentlest_rear``."""
    return gentlest_front(at, time) if kind == FRONT_FIRST else gentlest_rear(at, time)


@compiled_apart
def meet_front(at: Floats, drive: float, plan: Floats, other: Floats) -> float:
    """When one that drives for ``drive``, then brakes, meets the leader."""
    fill_drive_then_brake(plan, at[V_F], at[U_F], at[LIMIT_F], drive, at[A_F])
    fill_braking(other, 0.0, at[A_L])
    return walk(at[GAP_L], at[V_L], other, at[V_F], plan, math.inf)[1]


@compiled_apart
def meet_rear(at: Floats, brake: float, plan: Floats, other: Floats) -> float:
    """When the rear vehicle meets one that brakes for ``brake``, then drives."""
    fill_brake_then_drive(plan, at[V_F], at[U_F], at[LIMIT_F], brake, at[A_F])
    fill_braking(other, at[ONSET_R], at[A_R])
    return walk(at[GAP_R], at[V_F], plan, at[V_R], other, at[ONSET_R] + at[V_R] / at[A_R])[1]


@compiled_apart
def stays_ahead(at: Floats, drive: float, until: float, plan: Floats, other: Floats) -> bool:
    """Whether one that drives for ``drive``, then brakes, is not met from behind until then."""
    fill_drive_then_brake(plan, at[V_F], at[U_F], at[LIMIT_F], drive, at[A_F])
    fill_braking(other, at[ONSET_R], at[A_R])
    return walk(at[GAP_R], at[V_F], plan, at[V_R], other, until)[0] >= -AHEAD_M


@compiled_apart
def stays_behind(at: Floats, brake: float, until: float, plan: Floats, other: Floats) -> bool:
    """Whether one that brakes for ``brake``, then drives, does not meet the leader until then."""
    fill_brake_then_drive(plan, at[V_F], at[U_F], at[LIMIT_F], brake, at[A_F])
    fill_braking(other, 0.0, at[A_L])
    return walk(at[GAP_L], at[V_L], other, at[V_F], plan, until)[0] >= -AHEAD_M


# Compiled: how much faster than the common speed of two touching vehicles one of them can be, and what that costs.
#
# ``share`` is the partner's share of both masses; ``press`` the acceleration with which they close under the best
# command
# (m/s2), ``reach`` how much of it a command can hold back. docs/avoidability.md has the proofs.


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


@compiled_apart
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


@compiled_apart
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
# the
# two moves on a path that no command improves but the extreme one, and the controlled vehicle is faster (slower) than
# the
# centre only while it comes back to its partner. ``lead`` bounds that. docs/avoidability.md has the proofs.
#
# A cell of meetings lies between ``early`` and ``late``; its state is taken at ``early``. From ``late`` to ``end`` the
# command of the decision before is still in force, which lacks at least ``lack`` of the extreme one (m/s2).

TOUCHING_M = 1e-6  # nearer than this a leader counts as touching the obstacle
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


@compiled_apart
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


@compiled_apart
def pushed_by_leader(
    at: Floats, early: float, late: float, closing: float, end: float, lack: float, plan: Floats, other: Floats
) -> float:
    """Least closing speed at the rear, from the centre of mass of leader and controlled vehicle; 0: not proven.

    A leader that stands keeps its place, so a later meeting is the same one later: only what holds for all counts.
    """
    share, rest, press = at[FRONT_SHARE], 1.0 - at[FRONT_SHARE], at[U_F] + at[A_L]
    v_l, way_l = leader(at, early)
    v_r, way_r = follower(at, early)
    bounce = at[RESTITUTION]
    speed, push = v_l + rest * closing, rest * at[U_F] - share * at[A_L]
    stand = (speed + rest * bounce * closing) / at[A_L]
    late, end, lost = late - early, end - early, lack * (end - late)
    if v_l <= 0.0:
        late, end, lack, lost = 0.0, 0.0, 0.0, 0.0
    fill_window(plan, push, late, end, -rest * lack, stand, share * at[A_L])
    onset = max(at[ONSET_R] - early, 0.0)
    fill_braking(other, onset, at[A_R])
    behind = max(at[GAP_L] + at[GAP_R] + way_l - way_r, 0.0)
    until = walk(behind, speed, plan, v_r, other, onset + v_r / at[A_R])[1]
    if until == math.inf:
        return 0.0
    reach = at[U_F] + at[A_F] if until * at[A_L] <= v_l else math.inf  # the leader moves, however soft the impact
    if v_l <= 0.0:
        slowest = max(v_r - at[A_R] * max(until - onset, 0.0), 0.0)
        least = least_of_line(slowest - speed, -push, 0.0, 0.0, stand, -share * at[A_L], 0.0, until)
        return max(least - largest_lead(share, press, reach, bounce, bounce * closing, 0.0, 0.0, 0.0, 0.0, until), 0.0)
    return least_closing(
        v_r - speed, -push, onset, -at[A_R], stand, -share * at[A_L],
        share, press, reach, bounce, bounce * closing, lost, late, end, until,
    )  # fmt: skip


@compiled_apart
def held_by_leader(at: Floats, early: float, late: float, closing: float, plan: Floats, other: Floats) -> float:
    """Least closing speed at the rear of one that cannot fall far behind a leader of harder brakes; 0: not proven."""
    share, rest, bounce = at[FRONT_SHARE], 1.0 - at[FRONT_SHARE], at[RESTITUTION]
    v_l, way_l = leader(at, early)
    v_r, way_r = follower(at, early)
    back = max((share * bounce - rest) * closing - leader(at, late)[0], 0.0)
    thrown = share * (1.0 + bounce) > 1.0
    drive = max(at[U_F], at[A_F]) if thrown else at[U_F]
    press, push, speed = drive + at[A_L], rest * drive - share * at[A_L], v_l + rest * closing
    behind = max(at[GAP_L] + at[GAP_R] + way_l - way_r, 0.0)
    onset = max(at[ONSET_R] - early, 0.0)
    until, most, start = onset + v_r / at[A_R], 0.0, speed
    fill_braking(other, onset, at[A_R])
    for _ in range(2):
        most = widest_flight(share, at[A_L] - at[A_F], press, drive, bounce, closing, back, until)
        if most == math.inf:
            return 0.0
        start = max(speed, rest * most)
        turn = (start - rest * most) / -push if push < 0.0 else math.inf
        fill_plan(plan, turn, push, turn, 0.0, turn, 0.0, 0.0)
        until = walk(behind, start, plan, v_r, other, math.inf)[1]
        if until == math.inf:
            return 0.0
    final = max(start + push * until, rest * most)
    slowest = max(v_r - at[A_R] * max(until - onset, 0.0), 0.0)
    if v_l <= 0.0:
        return float(max(slowest - max(start, final) - share * most, 0.0))
    room = 0.5 * most * most / (drive if thrown else press) + HELD_M if press > 0.0 else math.inf
    since = 0.0
    if behind > room:
        fill_braking(plan, 0.0, at[A_L])
        since = min(walk(behind - room, v_l, plan, v_r, other, math.inf)[1], until)
    fast = max(v_r - at[A_R] * max(since - onset, 0.0), 0.0) - max(start + push * since, rest * most)
    return float(max(min(fast, slowest - final) - share * most, 0.0))


@compiled_apart
def after_front(
    at: Floats, early: float, late: float, closing: float, end: float, lack: float, plan: Floats, other: Floats
) -> float:
    """Least squared closing speed at the rear after the leader was met from ``early`` on with at most ``closing``.

    What is known of the centre of mass does not hold where an obstacle may throw both back.
    """
    share, rest = at[FRONT_SHARE], 1.0 - at[FRONT_SHARE]
    v_l, way_l = leader(at, early)
    v_r, way_r = follower(at, early)
    speed = v_l + rest * closing
    if share * (1.0 + at[RESTITUTION]) <= 1.0:
        speed -= share * at[RESTITUTION] * closing
    onset = max(at[ONSET_R] - early, 0.0)
    fill_drive_then_brake(plan, speed, at[U_F], at[LIMIT_F], math.inf, at[A_F])
    fill_braking(other, onset, at[A_R])
    behind = max(at[GAP_L] + at[GAP_R] + way_l - way_r, 0.0)
    squared = walk(behind, speed, plan, v_r, other, onset + v_r / at[A_R])[2]
    if at[OBSTACLE] < math.inf:
        return squared
    held = held_by_leader(at, early, late, closing, plan, other)
    squared = max(squared, held * held)
    if rest < at[RESTITUTION] * share:
        return squared
    pushed = pushed_by_leader(at, early, late, closing, end, lack, plan, other)
    return max(squared, pushed * pushed)


@compiled
def obstacle_harm(at: Floats, early: float, late: float, closing: float) -> float:
    """Least squared speed at which the leader then meets the obstacle ahead: only its own brakes slow it down.

    None is certain where it stands at the obstacle already: all three are one cluster then.
    """
    if not TOUCHING_M < at[OBSTACLE] - at[V_L] * at[V_L] / (2.0 * at[A_L]) < math.inf:
        return 0.0
    free = at[OBSTACLE] - leader(at, early)[1]
    speed = leader(at, late)[0] + (1.0 - at[FRONT_SHARE]) * (1.0 + at[RESTITUTION]) * closing
    harm: float = max(speed * speed - 2.0 * at[A_L] * free, 0.0)
    return harm


@compiled_apart
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


@compiled_apart
def pushed_by_rear(
    at: Floats, early: float, late: float, closing: float, end: float, lack: float, gap: float, plan: Floats,
    other: Floats,
) -> float:  # fmt: skip
    """Least closing speed at the front, from the centre of mass of both other vehicles; for ``a_f >= a_r``."""
    share, rest = at[REAR_SHARE], 1.0 - at[REAR_SHARE]
    v_l = leader(at, early)[0]
    bounce = at[RESTITUTION]
    speed = max(follower(at, early)[0] - rest * closing, 0.0)
    onset = max(at[ONSET_R] - early, 0.0)
    late, end, lost = late - early, end - early, lack * (end - late)
    fill_braking(plan, 0.0, at[A_L])
    fill_window(other, -rest * at[A_F], late, end, rest * lack, onset, -share * at[A_R])
    until = walk(gap, v_l, plan, speed, other, math.inf)[1]
    if until == math.inf:
        return 0.0
    press, reach = at[A_F] - at[A_R], at[U_F] + at[A_F]
    if onset > 0.0:
        press, reach = at[A_F], math.inf
    return least_closing(
        speed - v_l, at[A_L] - rest * at[A_F], onset, -share * at[A_R], v_l / at[A_L], -at[A_L],
        share, press, reach, bounce, bounce * closing, lost, late, end, until,
    )  # fmt: skip


@compiled_apart
def slowed_by_rear(at: Floats, early: float, closing: float, gap: float, plan: Floats, other: Floats) -> float:
    """Least closing speed at the front of one that stays ahead of both; for ``a_f >= a_r``. 0 where it may rise."""
    share, v_l = at[REAR_SHARE], leader(at, early)[0]
    pooled = (1.0 - share) * at[A_F] + share * at[A_R]
    mean = 0.5 * (at[A_F] + pooled)
    speed = follower(at, early)[0] - (1.0 - share) * closing
    if not (mean >= at[A_L] and speed > 0.0):
        return 0.0
    fill_braking(plan, 0.0, at[A_L])
    fill_braking(other, 0.0, pooled)
    until = walk(gap, v_l, plan, speed, other, speed / pooled)[1]
    return max(speed - mean * until - max(v_l - at[A_L] * until, 0.0), 0.0) if until < math.inf else 0.0


@compiled_apart
def after_rear(
    at: Floats, early: float, late: float, closing: float, end: float, lack: float, plan: Floats, other: Floats
) -> float:
    """Least squared closing speed at the front after the rear vehicle was met from ``early`` on with ``closing``."""
    share, rest = at[REAR_SHARE], 1.0 - at[REAR_SHARE]
    v_l, way_l = leader(at, early)
    v_r, way_r = follower(at, early)
    speed = v_r - rest * closing
    if share * (1.0 + at[RESTITUTION]) <= 1.0:
        speed += share * at[RESTITUTION] * closing
    speed = max(speed - max(at[A_R] - at[A_F], 0.0) * (late - early), 0.0)
    gap = max(at[GAP_L] + at[GAP_R] + way_l - way_r, 0.0)
    least = gap - max(follower(at, late)[1] - way_r - (leader(at, late)[1] - way_l), 0.0)
    squared = braking_after(gap, least, v_l, at[A_L], speed, at[A_F], plan, other)
    if at[A_F] < at[A_R]:
        return squared
    pushed = pushed_by_rear(at, early, late, closing, end, lack, gap, plan, other)
    pushed = max(pushed, slowed_by_rear(at, early, closing, gap, plan, other))
    return max(squared, pushed * pushed)


@compiled_apart
def after(
    kind: int, at: Floats, early: float, late: float, closing: float, end: float, lack: float, plan: Floats,
    other: Floats,
) -> float:  # fmt: skip
    """``after_front`` or ``after_rear``."""
    if kind == FRONT_FIRST:
        return after_front(at, early, late, closing, end, lack, plan, other)
    return after_rear(at, early, late, closing, end, lack, plan, other)


# Compiled: the least harm over all first meetings with one neighbour, by branch and bound.
#
# A meeting is a time and a closing speed. What it costs is its own closing speed squared and what must follow
# (``aftermath``). Cells of time and closing speed are halved until their bounds come close to the best meeting seen.
# docs/avoidability.md has the proof.

CELL = 1e-3  # a minimum over meetings is bounded this closely, relative to 1 m2/s2 and to itself
CELLS = 600  # room on the heap: after that many divisions a minimum stays as loose as it is
HARM, EARLY, LATE, SOFT, HARD, CELL_WIDTH = range(6)  # columns of the heap: bound, times (s), closing speeds (m/s)
_SPLITS = 64  # parts at most into which decisions divide the times
_TRIED = 8  # meetings tried before the search, to have something to compare with


@compiled_apart
def gentlest_between(kind: int, at: Floats, early: float, late: float) -> float:
    """Least closing speed of the meetings between two times.

    It falls with the time, but for a leader that brakes harder than the controlled vehicle: it may then rise by the
    difference.
    """
    least = gentlest(kind, at, late)[0]
    if kind == FRONT_FIRST and at[A_L] > at[A_F] and early * at[A_L] < at[V_L]:
        least -= (at[A_L] - at[A_F]) * (late - early)
    return max(least, 0.0)


@compiled
def decision_around(at: Floats, early: float, late: float) -> tuple[float, float]:
    """Start and end of the step that holds these times; both ``late`` without decisions or over more than one."""
    step = at[TIME_STEP]
    if step <= 0.0:
        return late, late
    begin = math.floor(0.5 * (early + late) / step) * step
    if early < begin - 1e-9 or late > begin + step + 1e-9:
        return late, late
    return begin, begin + step


@compiled_apart
def lacking(kind: int, at: Floats, early: float, late: float, softest: float, hard: float, begin: float) -> float:
    """How much the command in force at the meetings of a cell lacks, at least, of the extreme one that follows best.

    To meet gently the vehicle brakes (drives) before a meeting, and to soften what follows it drives (brakes) after it;
    the command is one and the same in the whole step. Meetings of at most ``hard``, where ``softest`` is the least.
    """
    whole = at[U_F] + at[A_F]
    turn = gentlest(kind, at, early)[1]
    if early <= begin:
        return 0.0
    if kind == FRONT_FIRST:
        if leader(at, early)[0] + hard >= at[LIMIT_F]:
            return 0.0
    elif follower(at, late)[0] <= hard:
        return 0.0
    softer = max(hard - softest, 0.0) / (early - begin)
    if turn >= begin:
        share = (turn - begin) / (early - begin)
        lack: float = max(whole - 2.0 * softer - whole * share * share, 0.0)
        return lack
    steep = (late - begin) / (begin - turn)
    lack = max(whole - softer * (1.0 + steep) / (1.0 + 0.5 * steep), 0.0)
    return lack


@compiled_apart
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
    harm = soft * soft + max(follows, floor)
    return harm + obstacle_harm(at, early, late, soft) if kind == FRONT_FIRST else harm


@compiled_apart
def put(heap: Floats, count: int, harm: float, early: float, late: float, soft: float, hard: float) -> int:
    """Put a cell on the heap, whose first cell is the one of least harm; the new number of cells."""
    at = count
    while at > 0 and heap[(at - 1) // 2, HARM] > harm:
        for c in range(heap.shape[1]):  # numba compiles the copy of a row with the text of an error, for 3 CPU-s
            heap[at, c] = heap[(at - 1) // 2, c]
        at = (at - 1) // 2
    heap[at, HARM], heap[at, EARLY], heap[at, LATE], heap[at, SOFT], heap[at, HARD] = harm, early, late, soft, hard
    return count + 1


@compiled_apart
def drop_first(heap: Floats, count: int) -> int:
    """Take the first cell off the heap; the new number of cells."""
    count -= 1
    at, below = 0, 1
    while below < count:
        if below + 1 < count and heap[below + 1, HARM] < heap[below, HARM]:
            below += 1
        if heap[below, HARM] >= heap[count, HARM]:
            break
        for c in range(heap.shape[1]):
            heap[at, c] = heap[below, c]
        at, below = below, 2 * below + 1
    for c in range(heap.shape[1]):
        heap[at, c] = heap[count, c]
    return count


@compiled_apart
def first_cells(
    kind: int, at: Floats, first: float, last: float, hard: float, floor: float, plan: Floats, other: Floats,
    heap: Floats,
) -> int:  # fmt: skip
    """Put the meetings between two times, at most ``hard``, on the heap: one cell for each step; their number."""
    count, time = 0, first
    while time < last:
        until = next_split(kind, at, time, last) if count < _SPLITS else last
        soft = gentlest_between(kind, at, time, until)
        if soft < hard:
            harm = harm_of(kind, at, time, until, soft, hard, floor, plan, other)
            count = put(heap, count, harm, time, until, soft, hard)
        time = until
    return count


@compiled_apart
def divide(
    kind: int, at: Floats, floor: float, count: int, plan: Floats, other: Floats, heap: Floats
) -> tuple[int, float]:
    """Replace the first cell of the heap by its halves; their number, and the harm of a meeting within."""
    harm, early, late, soft, hard = heap[0, HARM], heap[0, EARLY], heap[0, LATE], heap[0, SOFT], heap[0, HARD]
    count = drop_first(heap, count)
    middle = 0.5 * (early + late)
    if (late - early) * (at[U_F] + at[A_F] + at[A_L]) > hard - soft and early < middle < late:
        closing = max(soft, gentlest(kind, at, middle)[0])
        met = harm_of(kind, at, middle, middle, closing, closing, floor, plan, other)
        least = harm_of(kind, at, middle, late, soft, hard, floor, plan, other)
        count = put(heap, count, max(least, harm), middle, late, soft, hard)
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


@compiled_apart
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
    count = first_cells(kind, at, first, last, math.sqrt(best), floor, plan, other, heap)
    for _ in range(heap.shape[0] - _SPLITS - 2):
        if best <= enough or count == 0 or heap[0, HARM] >= best - CELL * (1.0 + best):
            break
        count, met = divide(kind, at, floor, count, plan, other, heap)
        best = min(best, met)
    if best <= enough:
        return 0.0
    return min(best, heap[0, HARM]) if count > 0 else best


@compiled
def next_split(kind: int, at: Floats, time: float, last: float) -> float:
    """The next time at which a decision falls or the leader comes to rest, at most ``last``."""
    until = last
    if at[TIME_STEP] > 0.0:
        until = min(until, (math.floor(time / at[TIME_STEP] + 1e-6) + 1.0) * at[TIME_STEP])
    stand = at[V_L] / at[A_L]
    if kind == FRONT_FIRST and time < stand:
        until = min(until, stand)
    return until
