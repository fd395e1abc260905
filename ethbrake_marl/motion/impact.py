"""Impacts, and bodies that push each other: one law for all bodies that touch.

If pairs were resolved one after the other, the result would depend on their order. A *cluster* (bodies that touch) is
therefore resolved as a whole, by the mass-weighted isotonic regression P from front to rear (pool adjacent violators):

* impact with speeds v- before, v+ after, and restitution e: ``v+ = (1 + e) P(v-) - e v-``; for two vehicles this is the
  paper's eq. (14);
* resting contact: the accelerations are ``P`` of the accelerations u that the bodies' own forces would cause. A *block*
  (bodies that move as one) with masses m has the acceleration ``sum(m u) / sum(m)``. Brakes at rest resist with any
  force up to a limit, so a block at rest moves only if the push exceeds this limit.

``first`` and ``last`` are the front and rear body of a cluster.
"""

from __future__ import annotations

import math

from ethbrake_marl.motion.compiling import kernel, part
from ethbrake_marl.motion.forces import brakes_fully, settle
from ethbrake_marl.motion.layout import (
    ANSWERED,
    BEFORE,
    BLOCK_HEAD,
    BLOCK_HIGH,
    BLOCK_HIGH_JERK,
    BLOCK_LOW,
    BLOCK_LOW_JERK,
    BLOCK_MASS,
    CLOSING,
    CONTACT_SPEED,
    EASED,
    FOREIGN,
    FRONT_CHANGE,
    GAP,
    HIT,
    JERK,
    LAST_TIME,
    MASS,
    NEW_FIRST,
    NEW_IMPACTS,
    NEW_TOTAL,
    NEXT_CLOSING,
    NEXT_TIME,
    PASSED,
    POOLED,
    PUSHED,
    REAR_CHANGE,
    RESTITUTION,
    SHARED,
    SPEED,
    THROWN,
    ZERO,
)

TOUCH_MPS = 1e-5  # a contact at this closing speed or less is a touch: no impact, no harm
PLASTIC_MPS = 0.05  # a cluster whose largest closing speed is below this does not bounce
SAME_MPS2 = 5e-13  # touching bodies with accelerations closer than this move alike


@part
def pool(mass, low, high, low_jerk, high_jerk, scratch, first, last, value, jerk):
    """Write the isotonic regression of bodies ``first..last`` to ``value`` and ``jerk``; return the number of blocks.

    Each body has a range of values from ``low`` to ``high``: accelerations, or speeds, for which both ends are equal.
    ``low_jerk`` and ``high_jerk`` are the rates at which the two ends change. All are rows [N + 1].

    A body whose value is above the value of the body in front forms a *block* with it. The ranges of a block's bodies
    are averaged, weighted by mass, and ``settle`` turns the mean range into the one value of the block. A block with a
    body of infinite mass gets the value 0. The blocks are written to the rows BLOCK of ``scratch``.
    """
    count = 0
    for i in range(first, last + 1):
        heavy = mass[i] == math.inf
        scratch[BLOCK_MASS, count], scratch[BLOCK_HEAD, count] = mass[i], i
        scratch[BLOCK_LOW, count] = 0.0 if heavy else mass[i] * low[i]
        scratch[BLOCK_HIGH, count] = 0.0 if heavy else mass[i] * high[i]
        scratch[BLOCK_LOW_JERK, count] = 0.0 if heavy else mass[i] * low_jerk[i]
        scratch[BLOCK_HIGH_JERK, count] = 0.0 if heavy else mass[i] * high_jerk[i]
        top = count + first
        value[top], jerk[top] = settle(low[i], high[i], low_jerk[i], high_jerk[i])
        while count > 0 and (
            value[top] > value[top - 1]
            or ((jerk[top] != 0.0 or jerk[top - 1] != 0.0) and value[top] >= value[top - 1] - SAME_MPS2)
        ):
            count -= 1
            top -= 1
            for row in (BLOCK_MASS, BLOCK_LOW, BLOCK_HIGH, BLOCK_LOW_JERK, BLOCK_HIGH_JERK):
                scratch[row, count] += scratch[row, count + 1]
            block_mass = scratch[BLOCK_MASS, count]
            value[top], jerk[top] = settle(
                scratch[BLOCK_LOW, count] / block_mass,
                scratch[BLOCK_HIGH, count] / block_mass,
                scratch[BLOCK_LOW_JERK, count] / block_mass,
                scratch[BLOCK_HIGH_JERK, count] / block_mass,
            )
        count += 1
    member = last
    for block in range(count - 1, -1, -1):
        block_value, rate = value[block + first], jerk[block + first]
        while member >= scratch[BLOCK_HEAD, block]:
            value[member], jerk[member] = block_value, rate
            member -= 1
    return count


@kernel
def restitution(car, closing):
    """Coefficient of restitution, 0 to 1, of an impact whose largest closing speed is ``closing`` (m/s).

    If ``closing`` is below ``PLASTIC_MPS``, the impact is plastic: 0.
    """
    return car[RESTITUTION, 0] if closing >= PLASTIC_MPS else 0.0


@kernel
def resolve_cluster(line, car, scratch, first, last):
    """Replace the speeds of the touching bodies ``first..last`` by their speeds after the impact.

    The impact is plastic (e = 0) if the largest closing speed is below ``PLASTIC_MPS``. The common speed of each block
    is corrected by its mean rounding error, so momentum is conserved to 4 eps of ``sum(m |v|)`` for any masses. After a
    plastic impact, a body that is faster by rounding than the body in front gets the speed of the body in front:
    otherwise two blocks could exchange a rounding error forever. A body that is not struck keeps its speed bit for bit.
    """
    largest = 0.0
    for p in range(first, last):
        largest = max(largest, scratch[CLOSING, p])
    bounce, end = restitution(car, largest), last + 1
    blocks = pool(
        car[MASS], line[SPEED], line[SPEED], scratch[ZERO], scratch[ZERO], scratch, first, last, scratch[POOLED],
        scratch[JERK],
    )  # fmt: skip
    for block in range(blocks - 1, -1, -1):
        head = int(scratch[BLOCK_HEAD, block])
        pooled = scratch[POOLED, head]
        if scratch[BLOCK_MASS, block] < math.inf:
            rest = 0.0
            for i in range(head, end):
                rest += car[MASS, i] * (line[SPEED, i] - pooled)
            pooled += rest / scratch[BLOCK_MASS, block]
        for i in range(head, end):
            line[SPEED, i] = pooled + bounce * (pooled - line[SPEED, i])
        end = head
    if bounce == 0.0:
        for i in range(first + 1, last + 1):
            line[SPEED, i] = min(line[SPEED, i], line[SPEED, i - 1])


@kernel
def note_foreign(line, i, change, speed):
    """Update the row FOREIGN of body i: contacts have changed its speed by ``change``, to ``speed`` (m/s)."""
    line[FOREIGN, i] = min(max(line[FOREIGN, i] + change, 0.0), max(speed, 0.0))


@part
def note_changes(line, scratch, ahead):
    """Update the row FOREIGN of all bodies after impacts; their speeds before are in the row BEFORE of ``scratch``."""
    for i in range(ahead, line.shape[1]):
        note_foreign(line, i, line[SPEED, i] - scratch[BEFORE, i], line[SPEED, i])


@part
def note_thrown(line, car, scratch, p):
    """Add the change of pair p's closing speed in an impact to the row THROWN; the pair has had an impact before.

    If pair p itself closes in this impact, a part of the change takes up closing speed that forces had built up. This
    part is a push, to which its authors are noted.
    """
    change = (line[SPEED, p + 1] - scratch[BEFORE, p + 1]) - (line[SPEED, p] - scratch[BEFORE, p])
    closing = scratch[CLOSING, p]
    if closing > max(TOUCH_MPS, line[THROWN, p]):
        push = -change * min((closing - line[THROWN, p]) / closing, 1.0)
        line[PUSHED, p] += push
        note_authors(line, car, scratch, p, push)
    line[THROWN, p] += change


@kernel
def eases(line, car, scratch, i):
    """Whether body i brakes with less than full force, or has done so since its last impact in front (row EASED)."""
    return line[EASED, i] == 1.0 or not brakes_fully(line, car, scratch, i)


@part
def divide_push(line, car, scratch, first, last, push, row):
    """Divide a ``push`` (m/s) equally between the vehicles ``first..last``; return whether there are any.

    ``row`` is SHARED, for all of them, or ANSWERED, for those that ease.
    """
    first, count = max(first, 1), 0
    for i in range(first, last + 1):
        count += 1 if row == SHARED or eases(line, car, scratch, i) else 0
    for i in range(first, last + 1):
        if row == SHARED or eases(line, car, scratch, i):
            line[row, i - 1] += push / count
    return count > 0


@part
def note_nobodys(line, car, scratch, first, last, push, backward):
    """Note a ``push`` (m/s) for which nobody behind answers; the vehicles ``first..last`` touch.

    If they move ``backward``, brakes press forward: those that ease answer. Otherwise all share the push.
    """
    if not (backward and divide_push(line, car, scratch, first, last, push, ANSWERED)):
        divide_push(line, car, scratch, first, last, push, SHARED)


@part
def note_authors(line, car, scratch, p, push):
    """Note who bears the ``push`` (m/s) of an impact of pair p (rows ANSWERED and SHARED).

    The rear body answers if it eases; otherwise those that touch it from behind and ease; otherwise nobody.
    """
    first, last = p, p + 1
    while first > 0 and line[GAP, first - 1] <= 0.0:
        first -= 1
    while line[GAP, last] <= 0.0:
        last += 1
    if not (
        divide_push(line, car, scratch, p + 1, p + 1, push, ANSWERED)
        or divide_push(line, car, scratch, p + 2, last, push, ANSWERED)
    ):
        note_nobodys(line, car, scratch, first, last, push, scratch[BEFORE, p] < 0.0)


@part
def after_impact_of(car, scratch, first, last, body):
    """Speed (m/s) of ``body`` after the impact if only the bodies ``first..last`` existed."""
    largest = 0.0
    for p in range(first, last):
        largest = max(largest, scratch[CLOSING, p])
    before = scratch[BEFORE, body]
    if largest == 0.0:
        return before
    pool(
        car[MASS], scratch[BEFORE], scratch[BEFORE], scratch[ZERO], scratch[ZERO], scratch, first, last,
        scratch[POOLED], scratch[JERK],
    )  # fmt: skip
    bounce = restitution(car, largest)
    return scratch[POOLED, body] + bounce * (scratch[POOLED, body] - before)


@part
def note_passed(line, car, scratch, first, last):
    """Add the harm that the contacts of a cluster pass on in an impact to the row PASSED. Two bodies pass nothing on.

    A contact takes up the closing speed ``v_rear - v_front``: v_rear is the speed after the impact that the body behind
    the contact would have if no body were in front of it; v_front is the speed that the body in front of the contact
    would have if no body were behind it. The harm passed on is ``(v_rear - v_front)^2`` minus the harm of the pair's
    own closing speed. So vehicles that touch when one of them is struck are not spared the harm that they would bear a
    millimetre apart.
    """
    for p in range(first, last if last - first > 1 else first):  # two bodies pass nothing on
        front = after_impact_of(car, scratch, first, p, p)
        rear = after_impact_of(car, scratch, p + 1, last, p + 1)
        closing = max(scratch[CLOSING, p], 0.0)
        if rear - front > max(closing, TOUCH_MPS):
            line[PASSED, p] += (rear - front) * (rear - front) - closing * closing


@part
def next_of_series(car, scratch, now, first, last):
    """Pair that is struck next in a cluster's endless series of impacts; -1: no series, the whole cluster is struck.

    In a series, all other pairs of the cluster count as not closing.

    If impacts are plastic, a light vehicle may rattle between two others: each gap is about the square of the gap
    before, until the gap is 0 in floating-point numbers and the pairs touch. The rest of the series then happens at
    this moment, one pair after the other, the hardest impact first. A series is recognised by a pair that has already
    had an impact at this moment while a pair still closes: after a plastic impact of a whole cluster no pair closes.
    """
    if car[RESTITUTION, 0] > 0.0 or last - first < 2:
        return -1
    hardest, again = first, False
    for p in range(first, last):
        again = again or scratch[LAST_TIME, p] == now
        if scratch[CLOSING, p] > scratch[CLOSING, hardest]:
            hardest = p
    if not again or scratch[CLOSING, hardest] <= TOUCH_MPS:
        return -1
    for p in range(first, last):
        if p != hardest:
            scratch[CLOSING, p] = 0.0  # its turn comes later
    return hardest


@kernel
def resolve_impacts(line, car, scratch, now, ahead):
    """Resolve every cluster in which a pair closes, and count the harm; return False if no pair closes.

    The harm of an impact is its squared closing speed (m2/s2), added to the rows NEW of ``scratch``. A touch
    (``TOUCH_MPS``) does no harm. In an impact after the pair's first, the part of the closing speed that forces have
    built up since the pair last touched is a push (``motion.push``). ``now`` (s from the start of the interval) is
    stored as the time of the pairs' impacts.
    """
    pairs, closes, first = line.shape[1] - 1, False, ahead
    for p in range(ahead, pairs):
        closing = 0.0
        if line[GAP, p] <= 0.0:
            closing = scratch[CONTACT_SPEED, p]
            if closing == 0.0:
                closing = line[SPEED, p + 1] - line[SPEED, p]
            if closing <= 0.0:
                line[THROWN, p] = 0.0
        scratch[CLOSING, p] = closing
        closes = closes or closing > 0.0
    if not closes:
        return False
    for i in range(ahead, pairs + 1):
        scratch[BEFORE, i] = line[SPEED, i]
    while first < pairs:
        last, closes = first, False
        while last < pairs and line[GAP, last] <= 0.0:
            closes = closes or scratch[CLOSING, last] > 0.0
            last += 1
        if closes:
            struck = next_of_series(car, scratch, now, first, last)
            resolve_cluster(line, car, scratch, first if struck < 0 else struck, last if struck < 0 else struck + 1)
            note_passed(line, car, scratch, first, last if struck < 0 else first)
        first = last + 1
    note_changes(line, scratch, ahead)
    for p in range(ahead, pairs):
        scratch[CONTACT_SPEED, p] = 0.0
        if line[HIT, p] == 1.0:
            note_thrown(line, car, scratch, p)
        if scratch[CLOSING, p] > TOUCH_MPS:
            harm = scratch[CLOSING, p] * scratch[CLOSING, p]
            scratch[NEW_TOTAL, p] += harm
            scratch[NEW_IMPACTS, p] += 1.0
            line[EASED, p + 1] = 0.0
            scratch[LAST_TIME, p] = now
            if scratch[NEXT_TIME, p] == math.inf:
                scratch[NEXT_TIME, p], scratch[NEXT_CLOSING, p] = now, scratch[CLOSING, p]
            front, rear = abs(line[SPEED, p] - scratch[BEFORE, p]), abs(line[SPEED, p + 1] - scratch[BEFORE, p + 1])
            scratch[REAR_CHANGE, p] = max(scratch[REAR_CHANGE, p], front)
            scratch[FRONT_CHANGE, p + 1] = max(scratch[FRONT_CHANGE, p + 1], rear)
            if line[HIT, p] == 0.0:
                line[HIT, p] = 1.0
                scratch[NEW_FIRST, p] += harm
    return True
