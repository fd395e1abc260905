"""Lower bounds on the harm with the second neighbour after a first contact with the first neighbour.

The time and the closing speed of the first contact determine the state of all three vehicles. After this contact the
extreme command (full drive or full braking) is best for the centre of mass of the two vehicles in contact. The
controlled vehicle moves faster or slower than this centre only until it meets the first neighbour again;
``flights.largest_lead`` bounds the difference.

Each function computes one bound for all first contacts between the times ``early`` and ``late``, from the state at
``early``. From ``late`` to ``end`` the command of the earlier decision still applies.

Proofs: docs/proofs/harm.md. Arguments: ``proofs/__init__.py``.
"""

from __future__ import annotations

import math

from ethbrake_marl.extensions.proofs.flights import largest_lead, widest_flight
from ethbrake_marl.extensions.proofs.line import (
    A_F,
    A_L,
    A_R,
    BOUNCE,
    FRONT_FIRST,
    FRONT_SHARE,
    GAP_L,
    GAP_R,
    LIMIT_F,
    ONSET_R,
    REAR_SHARE,
    U_F,
    follower,
    leader,
)
from ethbrake_marl.extensions.proofs.plans import braking, drive_then_brake, walk, with_window
from ethbrake_marl.motion.compiling import kernel, large

HELD_M = 1e-6  # largest rounding error of the gap to the leader

# times before the latest contact (s); the bound treats the times before and after each of them separately
LEADS = (0.02, 0.05, 0.1, 0.2, 0.4)


@kernel
def value_at(line, time):
    """Value at ``time`` of a piecewise linear function with two bends.

    ``line`` is (start, slope, turn 1, bend 1, turn 2, bend 2). The function is a straight line to which each bend adds
    ``bend * max(time - turn, 0)``.
    """
    start, slope, turn, bend, other_turn, other_bend = line
    return start + slope * time + bend * max(time - turn, 0.0) + other_bend * max(time - other_turn, 0.0)


@kernel
def least_of_line(line, since, until):
    """Smallest value of a piecewise linear function (``line``: see ``value_at``) from ``since`` to ``until``."""
    first, second = min(max(line[2], since), until), min(max(line[4], since), until)
    return min(value_at(line, since), value_at(line, until), value_at(line, first), value_at(line, second))


@large
def least_closing(line, pair, opening, lost, late, end, until):
    """Lower bound (m/s) on the closing speed of the controlled vehicle's contact with its second neighbour.

    It is a difference v - d. v is the closing speed between the second neighbour and the centre of mass of the pair,
    which ``line`` describes as a function of time (``value_at``). d, from ``largest_lead``, bounds the difference in
    speed between the controlled vehicle and this centre. ``until`` is the latest time of the contact. Times are in s
    after the first contact. Other arguments: file ``flights``.
    """
    best = least_of_line(line, 0.0, until) - largest_lead(pair, opening, lost, late, end, 0.0, until)
    for k in range(len(LEADS)):
        since = until - LEADS[k]
        if since <= 0.0:
            break
        near = least_of_line(line, since, until) - largest_lead(pair, opening, lost, late, end, since, until)
        far = least_of_line(line, 0.0, since) - largest_lead(pair, opening, 0.0, late, late, 0.0, since)
        best = max(best, min(near, far))
    return max(best, 0.0)


@kernel
def rear_after(at, early):
    """Rear vehicle at ``early`` (s): its distance to the leader (m), its speed (m/s) and its onset (s).

    The *onset* is the time from ``early`` until the rear vehicle begins to brake. The distance leaves out the length of
    the controlled vehicle. ``at``: one world (columns: ``proofs/line.py``).
    """
    speed, way = follower(at, early)
    return max(at[GAP_L] + at[GAP_R] + leader(at, early)[1] - way, 0.0), speed, max(at[ONSET_R] - early, 0.0)


@large
def pushed_by_leader(at, early, late, closing, end, lack):
    """Lower bound (m/s) on the rear pair's closing speed after a first contact with the leader.

    1. The *block*, leader and controlled vehicle together, moves like its centre of mass: at first with ``speed`` and
       the acceleration ``push``, until the leader stands at ``stand``.
    2. The rear vehicle has reached the block by the time ``until``. The result is 0 if it need not reach the block.
    3. The bound is the speed at which the rear vehicle closes in on the block, minus the largest lead in speed that the
       controlled vehicle can have over the block at that time.

    Arguments: package ``proofs``.
    """
    # press: acceleration with which the controlled vehicle gains on the leader under full drive
    leader_share, own_share, press, bounce = at[FRONT_SHARE], 1.0 - at[FRONT_SHARE], at[U_F] + at[A_L], at[BOUNCE]
    v_l = leader(at, early)[0]
    behind, v_r, onset = rear_after(at, early)
    if v_l <= 0.0:  # a later contact with a leader at rest leads to the same motion, only later
        late, end, lack = early, early, 0.0
    late, end, lost = late - early, end - early, lack * (end - late)
    # 1. the block
    speed, push = v_l + own_share * closing, own_share * at[U_F] - leader_share * at[A_L]
    stand = (speed + own_share * bounce * closing) / at[A_L]
    block = with_window(push, late, end, -own_share * lack, stand, leader_share * at[A_L])
    # 2. the rear vehicle reaches it
    until = walk(behind, speed, block, v_r, braking(onset, at[A_R]), onset + v_r / at[A_R])[1]
    if until == math.inf:
        return 0.0
    # 3. the bound; ``reach`` is finite if the leader still moves until then, however soft the impact
    pair = leader_share, press, (at[U_F] + at[A_F] if until * at[A_L] <= v_l else math.inf), bounce
    if v_l <= 0.0:
        slowest = max(v_r - at[A_R] * max(until - onset, 0.0), 0.0)
        least = least_of_line((slowest - speed, -push, 0.0, 0.0, stand, -leader_share * at[A_L]), 0.0, until)
        return max(least - largest_lead(pair, bounce * closing, 0.0, 0.0, 0.0, 0.0, until), 0.0)
    line = v_r - speed, -push, onset, -at[A_R], stand, -leader_share * at[A_L]
    return least_closing(line, pair, bounce * closing, lost, late, end, until)


@large
def held_by_leader(at, early, late, closing):
    """Lower bound (m/s) on the rear pair's closing speed after a first contact with a leader that brakes harder.

    It holds because the controlled vehicle then stays near the leader. 0: no bound is proven. Arguments: package
    ``proofs``.
    """
    share, rest, bounce = at[FRONT_SHARE], 1.0 - at[FRONT_SHARE], at[BOUNCE]
    v_l = leader(at, early)[0]
    behind, v_r, onset = rear_after(at, early)
    back = max((share * bounce - rest) * closing - leader(at, late)[0], 0.0)
    thrown = share * (1.0 + bounce) > 1.0
    drive = max(at[U_F], at[A_F]) if thrown else at[U_F]
    press, push, speed = drive + at[A_L], rest * drive - share * at[A_L], v_l + rest * closing
    rear = braking(onset, at[A_R])
    until, most, start = onset + v_r / at[A_R], 0.0, speed
    for _ in range(2):
        most = widest_flight(share, at[A_L] - at[A_F], press, drive, bounce, closing, back, until)
        if most == math.inf:
            return 0.0
        start = max(speed, rest * most)
        turn = (start - rest * most) / -push if push < 0.0 else math.inf
        until = walk(behind, start, (push, turn, 0.0, turn, 0.0, turn, 0.0, math.inf), v_r, rear, math.inf)[1]
        if until == math.inf:
            return 0.0
    final = max(start + push * until, rest * most)
    slowest = max(v_r - at[A_R] * max(until - onset, 0.0), 0.0)
    if v_l <= 0.0:
        return max(slowest - max(start, final) - share * most, 0.0)
    room = 0.5 * most * most / (drive if thrown else press) + HELD_M if press > 0.0 else math.inf
    since = 0.0
    if behind > room:
        since = min(walk(behind - room, v_l, braking(0.0, at[A_L]), v_r, rear, math.inf)[1], until)
    fast = max(v_r - at[A_R] * max(since - onset, 0.0), 0.0) - max(start + push * since, rest * most)
    return max(min(fast, slowest - final) - share * most, 0.0)


@large
def after_front(at, early, late, closing, end, lack):
    """Lower bound (m2/s2) on the rear pair's squared closing speed after a first contact with the leader.

    It is the largest of several lower bounds, which hold under different conditions. Arguments: package ``proofs``.
    """
    share, rest, bounce = at[FRONT_SHARE], 1.0 - at[FRONT_SHARE], at[BOUNCE]
    behind, v_r, onset = rear_after(at, early)
    speed = leader(at, early)[0] + rest * closing
    if share * (1.0 + bounce) <= 1.0:
        speed -= share * bounce * closing
    alone = drive_then_brake(speed, at[U_F], at[LIMIT_F], math.inf, at[A_F])
    squared = walk(behind, speed, alone, v_r, braking(onset, at[A_R]), onset + v_r / at[A_R])[2]
    held = held_by_leader(at, early, late, closing)
    squared = max(squared, held * held)
    if rest < bounce * share:
        return squared
    pushed = pushed_by_leader(at, early, late, closing, end, lack)
    return max(squared, pushed * pushed)


@kernel
def braking_after(gap, least_gap, v_l, a_l, v_f, a_f):
    """Smallest squared closing speed (m2/s2) at which a braking vehicle (f) reaches the braking leader (l).

    v is a speed (m/s), a a braking capacity (m/s2). The vehicle f may also brake less than ``a_f``. ``gap`` and
    ``least_gap`` are the largest and smallest possible gap (m); ``least_gap`` is used only if the leader brakes harder.
    The result is 0 if contact is not certain.
    """
    squared = walk(gap, v_l, braking(0.0, a_l), v_f, braking(0.0, a_f), v_f / a_f)[2]
    if a_f < a_l:
        w = max(v_f - v_l, 0.0)
        squared = min(squared, w * w + 2.0 * (a_l - a_f) * max(least_gap, 0.0))
    return squared


@large
def pushed_by_rear(at, early, late, closing, end, lack, gap):
    """Lower bound (m/s) on the front pair's closing speed after a first contact with the rear vehicle.

    The bound follows from the motion of the centre of mass of the rear pair. It holds only if the controlled vehicle
    has at least the braking capacity of the rear vehicle. ``gap``: gap to the front vehicle at ``early`` (m). Other
    arguments: package ``proofs``.
    """
    share, rest, bounce = at[REAR_SHARE], 1.0 - at[REAR_SHARE], at[BOUNCE]
    v_l = leader(at, early)[0]
    speed = max(follower(at, early)[0] - rest * closing, 0.0)
    onset = max(at[ONSET_R] - early, 0.0)
    late, end, lost = late - early, end - early, lack * (end - late)
    block = with_window(-rest * at[A_F], late, end, rest * lack, onset, -share * at[A_R])
    until = walk(gap, v_l, braking(0.0, at[A_L]), speed, block, math.inf)[1]
    if until == math.inf:
        return 0.0
    pair = share, at[A_F] - at[A_R], at[U_F] + at[A_F], bounce
    if onset > 0.0:
        pair = share, at[A_F], math.inf, bounce
    line = speed - v_l, at[A_L] - rest * at[A_F], onset, -share * at[A_R], v_l / at[A_L], -at[A_L]
    return least_closing(line, pair, bounce * closing, lost, late, end, until)


@large
def after_rear(at, early, late, closing, end, lack):
    """Lower bound (m2/s2) on the front pair's squared closing speed after a first contact with the rear vehicle.

    The larger of two bounds: one considers braking alone, the other the push from behind. Arguments: package
    ``proofs``.
    """
    rear_share, own_share, bounce = at[REAR_SHARE], 1.0 - at[REAR_SHARE], at[BOUNCE]
    v_l, way_l = leader(at, early)
    v_r, way_r = follower(at, early)
    speed = v_r - own_share * closing
    if rear_share * (1.0 + bounce) <= 1.0:  # then the hardest impact leaves the vehicle slowest
        speed += rear_share * bounce * closing
    speed = max(speed - max(at[A_R] - at[A_F], 0.0) * (late - early), 0.0)
    gap = max(at[GAP_L] + at[GAP_R] + way_l - way_r, 0.0)
    least_gap = gap - max(follower(at, late)[1] - way_r - (leader(at, late)[1] - way_l), 0.0)
    squared = braking_after(gap, least_gap, v_l, at[A_L], speed, at[A_F])
    if at[A_F] >= at[A_R]:  # otherwise the rear vehicle falls behind and need not push
        pushed = pushed_by_rear(at, early, late, closing, end, lack, gap)
        squared = max(squared, pushed * pushed)
    return squared


@large
def after(kind, at, early, late, closing, end, lack):
    """Lower bound (m2/s2) on the harm with the second neighbour that must follow a first contact.

    The first contact is with the neighbour ``kind``, between ``early`` and ``late`` (s), with a closing speed of at
    most ``closing`` (m/s). Other arguments: package ``proofs``.
    """
    if kind == FRONT_FIRST:
        return after_front(at, early, late, closing, end, lack)
    return after_rear(at, early, late, closing, end, lack)
