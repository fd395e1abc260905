"""The least honest cost over all chains of a world, by branch and bound.

The search halves the box (file ``chains``) with the smallest bound until it is small, or the memory is full; the bound
is valid whenever the search ends.

Theorem and proof: docs/proofs/harm.md. Arguments: ``proofs/__init__.py``.
"""

from __future__ import annotations

import math

from ethbrake_marl.extensions.proofs.branch_and_bound import gentlest_between
from ethbrake_marl.extensions.proofs.chains import (
    BOX_ROWS,
    COST,
    EARLY,
    HARD,
    HARD_2,
    LATE,
    MOST_PUSH,
    PUSH,
    SINCE,
    SOFT,
    SOFT_2,
    UNTIL,
    bounce_of,
    chain_cost,
    most_push,
)
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
    REAR_FIRST,
    REAR_SHARE,
    TIME_STEP,
    TOUCH_HARM,
    V_F,
    V_R,
)
from ethbrake_marl.extensions.proofs.meetings import gentlest_front, meet_front, rest_of_rear, stays_ahead
from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.impact import TOUCH_MPS

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
