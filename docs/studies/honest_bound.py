"""Proven and best known honest cost of the shipped lists: the second table of docs/least-harm.md.

    python docs/studies/honest_bound.py

A *chain* is a first contact of the controlled vehicle, the pushing of that pair after it, the contact with the second
neighbour, and the next contact with the first neighbour. A *box* is a set of chains: a column of ``boxes``
[BOX_ROWS, BOXES], with the smallest and the largest value of five quantities. The search halves the box with the
smallest bound until it is small, or the memory is full; the bound is valid whenever the search ends.

Theorem and proof: docs/proofs/harm.md. Arguments: ``ethbrake_marl/extensions/proofs/__init__.py``.
"""

from __future__ import annotations

import argparse
import math
import time

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import hold_commands
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.proofs.avoidability import FRONT, avoidability
from ethbrake_marl.extensions.proofs.branch_and_bound import gentlest_between
from ethbrake_marl.extensions.proofs.first_contacts import GRAZE_S, last_meeting, outer_contact, rear_times
from ethbrake_marl.extensions.proofs.line import (
    A_F,
    A_L,
    A_R,
    BOUNCE,
    FRONT_FIRST,
    FRONT_SHARE,
    GAP_L,
    GAP_R,
    LARGE,
    LIMIT_F,
    ONSET_F,
    ONSET_R,
    REAR_FIRST,
    REAR_SHARE,
    TIME_STEP,
    TOUCH_HARM,
    U_F,
    V_F,
    V_L,
    V_R,
    follower,
    leader,
    rows_of,
)
from ethbrake_marl.extensions.proofs.lower_bound import last_rest, lower_bound, rounding
from ethbrake_marl.extensions.proofs.meetings import gentlest_front, meet_front, rest_of_rear, stays_ahead
from ethbrake_marl.extensions.proofs.plans import braking, drive_then_brake, walk
from ethbrake_marl.extensions.search.tables import BestHarmTable, shipped_tables
from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.contact import contact
from ethbrake_marl.motion.impact import PLASTIC_MPS, TOUCH_MPS
from ethbrake_marl.motion.interval import solo
from ethbrake_marl.motion.layout import Floats

# rows of a box: bound on the honest cost (m2/s2); time (s) and closing speed (m/s) of the first contact; push of its
# pair before the second neighbour's contact (m/s); time (s) of this contact, infinite: there is none; its closing speed
COST, EARLY, LATE, SOFT, HARD, PUSH, MOST_PUSH, SINCE, UNTIL, SOFT_2, HARD_2 = range(11)
BOX_ROWS = 11

BRAKING_NEIGHBOURS = {"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "full_brake"}
PRICE = 10.0  # of a push, m/s (``episode.counts``)
TOUCHES = 4.0  # at least the number of touches of a pair in one interval of constant commands
OUTWARD = 1e-9  # margin of places (m) and speeds (m/s) against rounding
NEAR_M = 1e-8  # the same margin where a vehicle must be at a place
DRIVES = 8  # number of parts into which the driving before a third contact is divided
APART_M = 1e-6  # vehicles with a smaller gap touch
BOXES = 400_000  # size of the memory for boxes
HALVINGS_OF_BOXES = 500_000  # largest number of halvings, for each neighbour of the first contact
_SLICES = 8  # number of parts into which the times of the first contacts are divided at first
_PARTS = 64  # number of parts into which the closing speeds of a contact of all three are divided
_STEP = 0.01  # relative and absolute (m2/s2) step from one level of the search to the next
_NARROW_MPS = 0.01  # a box whose ranges are smaller is not halved
# The widest range of a box is halved; these weights, one for each row, make its times (s) and speeds (m/s) comparable.
_WEIGHTS = (0.0, 4.0, 0.0, 1.0, 0.0, 1.5, 0.0, 8.0, 0.0, 1.0, 0.0)


@kernel
def price_of(at, push, closing):
    """Least price (m2/s2) of a ``push`` (m/s) after a first contact with the speed ``closing`` (m/s).

    After a touch, one impact of closing speed w does a part of the push, ``(1 + e) w``, for its harm ``w^2``.
    """
    if closing > TOUCH_MPS:
        return PRICE * push
    best = 0.5 * PRICE * (1.0 + at[BOUNCE])
    impact = min(push / (1.0 + at[BOUNCE]), best)
    return impact * impact + PRICE * (push - (1.0 + at[BOUNCE]) * impact)


@kernel
def most_push(at, touch, cost):
    """Largest push (m/s) after a first contact, or after a ``touch``, whose price is at most ``cost`` (m2/s2)."""
    if not touch:
        return cost / PRICE
    best = 0.5 * PRICE * (1.0 + at[BOUNCE])
    impact = min(math.sqrt(cost), best)
    return (1.0 + at[BOUNCE]) * impact + (cost - impact * impact) / PRICE


@kernel
def bounce_of(at, closing):
    """Restitution of an impact of at least ``closing`` (m/s). ``at``: one world (columns: ``proofs/line.py``)."""
    return at[BOUNCE] if closing >= PLASTIC_MPS else 0.0


@kernel
def slowing(share, bounce, soft, hard):
    """Largest ``(1 - share (1 + e)) w`` (m/s) for closing speeds w from ``soft`` to ``hard``; e is 0 if w is small."""
    rest = 1.0 - share * (1.0 + bounce)
    return max(rest * (hard if rest > 0.0 else soft), (1.0 - share) * min(hard, PLASTIC_MPS))


@kernel
def third_cost(at, closing, thrown):
    """Cost (m2/s2) of a third contact with this ``closing`` speed of which the second one caused ``thrown`` (m/s).

    A touch pushes for nothing.
    """
    if closing <= TOUCH_MPS:
        return 0.0
    return closing * closing + PRICE * (1.0 + bounce_of(at, closing)) * max(closing - thrown - TOUCH_MPS, 0.0)


@kernel
def cruise(start, end, duration, first, second, room):
    """Largest speed c (m/s) in a motion that slows to c, keeps it, and gains speed, over a way of at most ``room`` (m).

    The motion takes ``duration`` (s). It begins with at least the speed ``start`` and ends with at least ``end`` (m/s);
    it slows with ``first`` and gains with ``second`` (m/s2). Its way is ``c duration + (start - c)^2 / (2 first) +
    (end - c)^2 / (2 second)``. -inf: every such motion has a longer way.
    """
    end = max(end, start - first * duration)
    start = max(start, end - second * duration)
    slow = min(start, end)
    way = slow * duration
    if start > slow:
        way += 0.5 * (start - slow) * (start - slow) / first
    if end > slow:
        way += 0.5 * (end - slow) * (end - slow) / second
    if way <= room:
        return slow
    if first == 0.0 or second == 0.0:
        return -math.inf
    half = 0.5 * (duration - start / first - end / second)
    both = 0.5 / first + 0.5 / second
    squared = half * half - both * (0.5 * start * start / first + 0.5 * end * end / second - room)
    return (math.sqrt(squared) - half) / both if squared >= 0.0 else -math.inf


@kernel
def drive_to_rear(at, start, most, end, duration, room):
    """Least speed (m/s) that the controlled vehicle gains by driving on a way of at most ``room`` (m).

    It begins with a speed from ``start`` to ``most``. A larger one makes the way longer, but less speed is gained where
    the way is long enough. Other arguments: as for ``cruise``. Infinite: the way is longer. ``at``: one world (columns:
    ``proofs/line.py``).
    """
    slow = cruise(max(start, 0.0), max(end, 0.0), duration, at[A_F], at[U_F], room)
    if slow >= min(start, end):
        slow = max(slow, most)
    return max(end - slow, 0.0) if slow >= 0.0 else math.inf


@kernel
def drive_to_front(at, start, end, duration, room):
    """Least speed (m/s) that the controlled vehicle gains by driving on a way of at least ``room`` (m).

    It begins with at most the speed ``start`` and ends with at most ``end``: with the signs of all speeds reversed,
    this is the motion of ``cruise``. Infinite: the way is shorter. Other arguments: as for ``drive_to_rear``.
    """
    peak = -cruise(-start, -end, duration, at[U_F], at[A_F], -room)
    return peak - start if peak > max(start, end) else 0.0


@large
def front_chains(at, box, until_end):
    """Lower bound (m2/s2) on the honest cost of the chains of a box that begin at the front vehicle.

    Infinite if there are none. Raises the row SOFT_2 of ``box`` where smaller values are impossible. Cost after
    ``until_end`` (s) does not count. ``at``: package ``proofs``.
    """
    early, late, soft, hard = box[EARLY], box[LATE], box[SOFT], box[HARD]
    since, until = max(box[SINCE], early), box[UNTIL]
    nu, bounce, a_l, a_f, u = at[FRONT_SHARE], at[BOUNCE], at[A_L], at[A_F], at[U_F]
    v_l, way = leader(at, early)
    kick = (1.0 - nu) * (1.0 + bounce) * hard
    v_late, way_late = leader(at, late)
    driven = drive_to_front(at, at[V_F], v_late + hard + OUTWARD, late, at[GAP_L] + way_late - NEAR_M)
    cost = soft * soft + price_of(at, box[PUSH], hard) + PRICE * driven
    ending = min(until, rest_of_rear(at))
    push = box[MOST_PUSH] + TOUCHES * TOUCH_MPS * ((ending - early) / at[TIME_STEP] + 2.0)
    gain = (1.0 - nu) * push
    if u > 0.0 and v_l + kick + gain >= at[LIMIT_F]:
        gain = push
    top = v_l + kick + gain + OUTWARD  # the front vehicle never gets ahead of one with this speed at ``early``
    place = at[GAP_L] + way + OUTWARD
    if until == math.inf:
        rear = braking(max(at[ONSET_R] - early, 0.0), at[A_R])
        v_r, way_r = follower(at, early)
        met = walk(max(place + at[GAP_R] - way_r, 0.0), top, braking(0.0, a_l), v_r, rear, math.inf)[1]
        return cost if met == math.inf else math.inf
    if until < early:
        return math.inf
    # the controlled vehicle is where the rear vehicle is, with a speed that it can have there
    v_r, way_r = follower(at, until)
    duration = until - early
    start = v_l + (1.0 - nu * (1.0 + bounce)) * soft - nu * push - OUTWARD
    room = way_r - at[GAP_R] - place + NEAR_M
    room += (late - early) * max((1.0 - nu) * hard - nu * box[PUSH], 0.0)
    most = v_l + slowing(nu, bounce, soft, hard) - nu * box[PUSH] + OUTWARD
    driven = drive_to_rear(at, start, most, v_r - box[HARD_2], duration, room)
    if driven == math.inf:
        return math.inf
    cost += PRICE * driven
    cost += box[SOFT_2] * box[SOFT_2]
    # it cannot be ahead of the front vehicle
    front_speed, front_way, _ = solo(top, -a_l, 0.0, math.inf, since - early)
    gap = place + front_way - (follower(at, since)[1] - at[GAP_R])
    gap += (until - since) * max(front_speed - v_r, 0.0)
    if gap < 0.0:
        return math.inf
    # the third contact, if it brakes from now on
    speed = v_r - slowing(at[REAR_SHARE], bounce, box[SOFT_2], box[HARD_2]) - OUTWARD
    w = speed - front_speed
    if a_f < a_l or speed <= 0.0:
        return cost
    met = contact(gap, w, a_l - a_f)[0] if w > 0.0 else math.inf
    if met * a_l > front_speed:
        left = speed * speed - 2.0 * a_f * (gap + 0.5 * front_speed * front_speed / a_l)
        met = (speed - math.sqrt(left)) / a_f if left >= 0.0 else math.inf
    if until + met >= until_end:
        return cost
    slow = max(at[V_L], a_l * late) + kick - a_l * (since + met)
    third = speed - a_f * met - max(slow, 0.0) - gain - OUTWARD
    if third <= 0.0:
        return cost
    thrown = at[REAR_SHARE] * (1.0 + bounce) * box[HARD_2] if hard > TOUCH_MPS else math.inf
    return cost + third_cost(at, third, thrown)


@large
def reached_by_rear(at, gap, speed, u, rear_speed, onset, duration):
    """Closing speed (m/s) at which the braking rear vehicle reaches the driving controlled vehicle; 0: never.

    The gap is ``gap`` (m) and the speeds are ``rear_speed`` and ``speed`` (m/s). The controlled vehicle drives with
    ``u`` (m/s2), the rear vehicle brakes from ``onset`` (s) on. A contact after ``duration`` (s) does not count.
    ``at``: one world (columns: ``proofs/line.py``).
    """
    drive = drive_then_brake(speed, u, at[LIMIT_F], math.inf, at[A_F])
    rest = onset + rear_speed / at[A_R]
    _, met, squared = walk(gap, speed, drive, rear_speed, braking(onset, at[A_R]), rest)
    return math.sqrt(squared) if met < duration else 0.0


@large
def third_at_rear(at, gap, speed, rear_speed, onset, duration, thrown):
    """Least cost (m2/s2) of a third contact with the rear vehicle and of the driving before it.

    ``thrown``: as for ``third_cost``. Other arguments: as for ``reached_by_rear``.
    """
    free = third_cost(at, reached_by_rear(at, gap, speed, at[U_F], rear_speed, onset, duration), thrown)
    least = held = third_cost(at, reached_by_rear(at, gap, speed, 0.0, rear_speed, onset, duration), thrown)
    part = (held - free) / (PRICE * DRIVES)
    for k in range(DRIVES if held > free else 0):  # it drives so many parts, or a part of one more
        closing = reached_by_rear(at, gap, speed + (k + 1) * part, 0.0, rear_speed, onset, duration)
        least = min(least, PRICE * k * part + max(third_cost(at, closing, thrown), free))
    return least


@large
def rear_chains(at, box, until_end):
    """Lower bound (m2/s2) on the honest cost of the chains of a box that begin at the rear vehicle.

    Arguments: as for ``front_chains``.
    """
    early, late, soft, hard = box[EARLY], box[LATE], box[SOFT], box[HARD]
    since, until = max(box[SINCE], early), box[UNTIL]
    mu, nu, bounce, a_f = at[REAR_SHARE], at[FRONT_SHARE], at[BOUNCE], at[A_F]
    v_r, way = follower(at, early)
    place = way - at[GAP_R] - OUTWARD
    kick = (1.0 - mu) * (1.0 + bounce) * hard
    v_late, way_late = follower(at, late)
    driven = drive_to_rear(at, at[V_F], at[V_F], v_late - hard - OUTWARD, late, way_late - at[GAP_R] + NEAR_M)
    cost = soft * soft + price_of(at, box[PUSH], hard) + PRICE * driven
    ending = min(until, rest_of_rear(at))
    push = box[MOST_PUSH] + TOUCHES * TOUCH_MPS * ((ending - early) / at[TIME_STEP] + 2.0)
    # the rear vehicle never falls behind one with this speed at ``early``
    slow, onset = max(v_r - kick - (1.0 - mu) * push - OUTWARD, 0.0), max(at[ONSET_R] - early, 0.0)
    v_l, way_l = leader(at, early)
    ahead = at[GAP_L] + way_l - place
    alone = max(min(v_r, v_r - slowing(mu, bounce, soft, hard)) - OUTWARD, 0.0)
    if until == math.inf:
        rear = braking(onset, at[A_R])
        met = walk(ahead, v_l, braking(0.0, at[A_L]), slow, rear, math.inf)[1]
        if met == math.inf:
            met = walk(ahead, v_l, braking(0.0, at[A_L]), alone, braking(0.0, a_f), math.inf)[1]
        return cost if met == math.inf else math.inf
    if until < early:
        return math.inf
    # the controlled vehicle is where the front vehicle is, with a speed that it can have there
    v_l, way_l = leader(at, until)
    duration = until - early
    start = v_r - (1.0 - mu * (1.0 + bounce)) * soft + mu * push + OUTWARD
    rest = 1.0 - mu * (1.0 + bounce)
    if rest < 0.0:
        start = v_r - rest * hard + mu * push + OUTWARD
    room = at[GAP_L] + way_l - place - NEAR_M
    room -= (late - early) * max((1.0 - mu) * hard - mu * box[PUSH], 0.0)
    driven = drive_to_front(at, start, v_l + box[HARD_2], duration, room)
    if driven == math.inf:
        return math.inf
    cost += PRICE * driven
    cost += box[SOFT_2] * box[SOFT_2]
    # it stays ahead of the rear vehicle, and of itself if it braked
    first_v, first_way = leader(at, since)
    at_since = at[GAP_L] + first_way
    slow_end, _, _ = solo(slow, -at[A_R], onset, math.inf, until - early)
    gap = at_since - place - solo(slow, -at[A_R], onset, math.inf, since - early)[1]
    gap += (until - since) * max(first_v - slow_end, 0.0)
    braked_end, _, _ = solo(alone, -a_f, 0.0, math.inf, until - early)
    ahead = at_since - place - solo(alone, -a_f, 0.0, math.inf, since - early)[1]
    ahead += (until - since) * max(first_v - braked_end, 0.0)
    if gap < 0.0 or ahead < 0.0:
        return math.inf
    # the third contact
    speed = first_v + slowing(nu, bounce, box[SOFT_2], box[HARD_2]) + OUTWARD
    thrown = nu * (1.0 + bounce) * box[HARD_2] if hard > TOUCH_MPS else math.inf
    return cost + third_at_rear(at, gap, speed, slow_end, max(at[ONSET_R] - until, 0.0), until_end - until, thrown)


@large
def chain_cost(kind, at, box, until_end):
    """Lower bound (m2/s2) on the honest cost of the chains of a box that begin at the neighbour ``kind``.

    Arguments: as for ``front_chains``.
    """
    if kind == FRONT_FIRST:
        return front_chains(at, box, until_end)
    return rear_chains(at, box, until_end)


@kernel
def widest(box):
    """Row with the lower end of the widest range of ``box``, and the width of this range times ``_WEIGHTS``."""
    row, width = EARLY, 0.0
    for low in (EARLY, SOFT, PUSH, SINCE, SOFT_2):
        size = (box[low + 1] - box[low]) * _WEIGHTS[low]
        if size > width and (low < SINCE or box[UNTIL] < math.inf):
            row, width = low, size
    return row, width


@large
def put_box(kind, at, until_end, box, boxes, count):
    """Append ``box`` to the ``count`` columns of ``boxes`` if it has chains; return the new number of boxes.

    Its bound is not below the one that it has already. Arguments: as for ``least_chain_cost``.
    """
    if box[SOFT] > box[HARD]:
        return count
    box[COST] = max(chain_cost(kind, at, box, until_end), box[COST])
    if box[COST] == math.inf:
        return count
    for row in range(BOX_ROWS):
        boxes[row, count] = box[row]
    return count + 1


@large
def first_boxes(kind, at, first, last, gentle, best, until_end, boxes, box):
    """Write the boxes with which the search begins, and return their number. Arguments: as for ``least_chain_cost``.

    First contacts that are touches are in boxes of their own, and so are chains without a second contact.
    """
    count, fastest, part = 0, math.sqrt(best), (last - first) / _SLICES
    for k in range(4 * _SLICES):
        early = first + (k // 4) * part
        box[COST], box[EARLY], box[LATE], box[SOFT], box[HARD] = 0.0, early, early + part, 0.0, fastest
        if not gentle:
            box[SOFT] = gentlest_between(kind, at, early, early + part)
        if k % 2 == 0:
            box[HARD] = TOUCH_MPS
        else:
            box[SOFT] = max(box[SOFT], TOUCH_MPS)
        box[PUSH], box[MOST_PUSH], box[SOFT_2], box[HARD_2] = 0.0, most_push(at, k % 2 == 0, best), 0.0, fastest
        box[SINCE], box[UNTIL] = (first, rest_of_rear(at)) if k % 4 < 2 else (math.inf, math.inf)
        count = put_box(kind, at, until_end, box, boxes, count)
    return count


@large
def halve_box(kind, at, gentle, until_end, boxes, count, k, whole, box):
    """Replace box ``k`` by two halves; return the new number of boxes, or -1 if box ``k`` is too narrow.

    ``whole``, ``box``: memory, [BOX_ROWS]. Other arguments: as for ``least_chain_cost``.
    """
    for row in range(BOX_ROWS):
        whole[row] = boxes[row, k]
    low, width = widest(whole)
    if width < _NARROW_MPS:
        return -1
    count -= 1
    for row in range(BOX_ROWS):
        boxes[row, k] = boxes[row, count]
    for half in range(2):
        for row in range(BOX_ROWS):
            box[row] = whole[row]
        box[low + 1 - half] = 0.5 * (whole[low] + whole[low + 1])
        if low == EARLY and not gentle:
            box[SOFT] = max(box[SOFT], gentlest_between(kind, at, box[EARLY], box[LATE]))
        count = put_box(kind, at, until_end, box, boxes, count)
    return count


@large
def least_chain_cost(kind, at, first, last, gentle, best, until_end, boxes, memory):
    """Lower bound (m2/s2), at most ``best``, on the honest cost of all chains with first contacts at a neighbour.

    The first contacts are with ``kind``, from ``first`` to ``last`` (s). ``gentle``: their closing speeds may be as
    small as 0; otherwise ``meetings.gentlest`` bounds them. Cost after ``until_end`` (s) does not count. ``boxes``
    [BOX_ROWS, BOXES], ``memory`` [2, BOX_ROWS]: overwritten. ``at``: one world (columns: ``proofs/line.py``).
    """
    count, k, level = first_boxes(kind, at, first, last, gentle, best, until_end, boxes, memory[1]), 0, 0.0
    for _ in range(HALVINGS_OF_BOXES):
        while level < best and k < count and boxes[COST, k] >= level:
            k += 1
            if k == count:  # all boxes have reached this level
                k, level = 0, level + _STEP * (1.0 + level)
        if level >= best or count in (0, boxes.shape[1]):
            break
        halved = halve_box(kind, at, gentle, until_end, boxes, count, k, memory[0], memory[1])
        if halved < 0:
            break
        count, k = halved, min(k, max(halved - 1, 0))
    for k in range(count):
        best = min(best, boxes[COST, k])
    return best


@large
def triple_contact(at, least, closing):
    """Lower bound (m2/s2) on the honest cost if all three vehicles meet at once.

    ``closing``: closing speed of the rear vehicle to the front vehicle (m/s), the sum of both pairs'. ``least``:
    smallest closing speed of the front pair (m/s). ``at``: one world (columns: ``proofs/line.py``).
    """
    cost, part = LARGE, (closing - least) / _PARTS
    for k in range(_PARTS):
        front, rear = least + k * part, max(closing - least - (k + 1) * part, 0.0)
        passed_front = at[REAR_SHARE] * (1.0 + bounce_of(at, rear)) * rear
        passed_rear = at[FRONT_SHARE] * (1.0 + bounce_of(at, front)) * front
        cost = min(cost, (front + passed_front) * (front + passed_front) + (rear + passed_rear) * (rear + passed_rear))
    return cost


@large
def chains_at_front(at, best, until_end, boxes, memory):
    """Lower bound (m2/s2), at most ``best``, on the honest cost if the first contact is in front, or all meet at once.

    Arguments: as for ``least_chain_cost``.
    """
    first = meet_front(at, math.inf)
    if first == math.inf or not stays_ahead(at, first, first):
        return best
    last, end, leans = last_meeting(at, first)
    best = least_chain_cost(FRONT_FIRST, at, first, end, False, best, until_end, boxes, memory)
    time, squared = outer_contact(at)
    if leans and time == math.inf:
        return 0.0
    if leans and time > last:
        best = least_chain_cost(FRONT_FIRST, at, last, time + GRAZE_S, True, best, until_end, boxes, memory)
    if time == math.inf or (time > end + GRAZE_S and not leans):
        return best
    least = gentlest_front(at, min(time, last))[0] if time > first else 0.0
    return min(best, triple_contact(at, min(least, math.sqrt(squared)), math.sqrt(squared)))


@large
def chains_at_rear(at, best, until_end, boxes, memory):
    """Lower bound (m2/s2), at most ``best``, on the honest cost if the first contact is with the rear vehicle.

    Arguments: as for ``least_chain_cost``.
    """
    first, last, end, late = rear_times(at)
    if first == math.inf:
        return best
    best = least_chain_cost(REAR_FIRST, at, first, end, False, best, until_end, boxes, memory)
    if late > last:
        best = least_chain_cost(REAR_FIRST, at, last, late, True, best, until_end, boxes, memory)
    return best


@large
def chain_bound(at, until_end, boxes, memory):
    """Lower bound (m2/s2) on the honest cost of a world with unavoidable contact, from all its chains.

    0 where the theorem does not apply: the controlled vehicle brakes less than a neighbour, an impact may throw it or
    the rear vehicle back, it touches a neighbour now, or commands may change at any time. Arguments: as for
    ``least_chain_cost``.
    """
    nu, mu, bounce = at[FRONT_SHARE], at[REAR_SHARE], 1.0 + at[BOUNCE]
    thrown_back = nu * bounce > 1.0 or (1.0 - mu) * bounce > 1.0
    touching = min(at[GAP_L], at[GAP_R]) < APART_M
    if thrown_back or touching or at[A_F] < max(at[A_L], at[A_R]) or at[TIME_STEP] <= 0.0:
        return 0.0
    fastest = max(at[V_F], at[V_R])
    best = chains_at_front(at, fastest * fastest, until_end, boxes, memory)
    return max(chains_at_rear(at, best, until_end, boxes, memory) - TOUCH_HARM, 0.0)


@large
def chain_bounds(rows, until, unavoidable, boxes, memory, out):
    """Write ``chain_bound`` of n worlds, ``rows`` [n, LINE_COLUMNS], to ``out`` [n]; 0 where it proves nothing.

    Cost after ``until`` [n] (s) does not count. ``unavoidable`` [n]: whether contact is certain. ``boxes``,
    ``memory``: as for ``least_chain_cost``.
    """
    for k in range(len(out)):
        proves = unavoidable[k] and last_rest(rows[k]) < until[k]
        out[k] = chain_bound(rows[k], until[k], boxes, memory) if proves else 0.0


def honest_bound(state: State, horizon_s: float, time_step_s: float) -> Floats:
    """Proven lower bound on the honest cost of every episode, over all decisions of Vehicle 2 of three, [n] m2/s2.

    Vehicles 1 and 3 brake fully. Raises the errors of ``lower_bound``.
    """
    harm = lower_bound(state, harm_count="total", horizon_s=horizon_s, time_step_s=time_step_s)
    start = state.time_s + rows_of(state, 2)[:, ONSET_F]
    full = np.pad(-state.braking_capacity_mps2, ((0, 0), (1, 0)))
    now, chains = hold_commands(state._replace(wanted=full), start), np.empty(state.n)  # until then all brake fully
    unavoidable = (avoidability(state).reason >= FRONT) & (now.speeds_mps >= 0.0).all(axis=1)
    boxes, memory = np.empty((BOX_ROWS, BOXES)), np.empty((2, BOX_ROWS))
    chain_bounds(rows_of(now, 2, time_step_s), horizon_s - start, unavoidable, boxes, memory, chains)
    return np.maximum(harm.harm, harm.early + np.maximum(chains - rounding(state, 2), 0.0))


def cost_row(scenario: eb.Scenario, table: BestHarmTable) -> str:
    """Row with the proven and best known honest cost of a shipped table, and their ratio with its 95 % interval."""
    alert, best = scenario.sample(int(table.header["episodes"]), int(table.header["list_seed"])), table.harm["honest"]
    name, start = f"{scenario.name} ({alert.n:,} worlds)", time.process_time()
    try:
        bound = honest_bound(alert, scenario.horizon_s, scenario.time_step_s)
    except InvalidInput as error:
        return f"| {name} | – | {best.mean():.3f} | – | {error}"
    ratio, seconds = bound.mean() / best.mean(), time.process_time() - start
    half = 1.96 * float(np.std(bound - ratio * best)) / best.mean() / alert.n**0.5
    interval = f"{100.0 * ratio:.1f} % ({100.0 * (ratio - half):.1f} to {100.0 * (ratio + half):.1f})"
    return f"| {name} | {bound.mean():.3f} | {best.mean():.3f} | {interval} | {seconds / alert.n:.3f} s a world"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="SCENARIO", help="the list of this scenario alone")
    given = parser.parse_args()
    for table in shipped_tables():
        scenario = eb.load_scenario(table.header["scenario"])
        only_vehicle_2_learns = dict(scenario.roles) == BRAKING_NEIGHBOURS
        if only_vehicle_2_learns and "honest" in table.harm and given.only in (None, scenario.name):
            print(cost_row(scenario, table), flush=True)
