"""The push: closing speed that forces build up and a contact absorbs, in a further impact or while the contact lasts.

An impact after the pair's first one reduces the closing speed w by c. Of w, forces have built up ``g = w - (row
THROWN)``. If g > 0, the push is ``c min(g / w, 1)``; ``motion.impact`` adds it. So ever smaller and more frequent
impacts push as much as a lasting contact, and a vehicle that is struck from behind and thrown forward does not push.

A pair p that touches and moves as one absorbs the closing acceleration ``u_rear - u_front >= 0`` (m/s2): u_rear is the
acceleration that body p + 1 would have if no body were in front of it, u_front the acceleration that body p would have
if no body were behind it. The integral of this difference over time is the push (m/s). Impact harm does not contain it.

A part of the line alone obeys the law of resting contact (``motion.impact``). By the min-max formula of isotonic
regression, u_rear is therefore the largest of the mean accelerations of the bodies p + 1 to j (for every j), and
u_front the smallest of the mean accelerations of the bodies i to p (for every i), weighted by mass; only bodies that
move as one with the pair count. For two moving vehicles the push is the integral of ``u_{p+1} - u_p``. A part that its
brakes hold at rest has the acceleration 0, and so has the obstacle with the vehicles that touch it.

Who answers for the push: the rear vehicle of the pair for what its own force adds, ``max(u_own - u_front, 0)``, where
u_own is its acceleration by its own force. Those behind it whose force presses on it answer for the rest: the bodies j
with u_j above both u_own and u_front, up to the one with which the mean is u_rear, in proportion to mass times excess
at the middle of the time between two events. A body that brakes with all it has answers for nothing; what
nobody answers for belongs to all that move as one, alike. A block that a speed limit or forces that cancel keep at its
speed is not at rest: no brakes hold it. For an impact, ``motion.impact.note_answer`` says who answers.

Between two events each mean is a linear function of time, so the largest of them is piecewise linear and convex, and
the integral is exact.
"""

from __future__ import annotations

import math

from ethbrake_marl.motion.compiling import kernel, part
from ethbrake_marl.motion.forces import brakes_fully
from ethbrake_marl.motion.impact import SAME_MPS2, note_nobodys
from ethbrake_marl.motion.layout import (
    ACCELERATION,
    ANSWERED,
    HIGH,
    JERK,
    JOINED,
    LOW,
    LOW_JERK,
    MASS,
    PART,
    PART_RATE,
    PUSHED,
    SPEED,
)


@kernel
def integral_of_largest(value, rate, count, duration):
    """Integral over t from 0 to ``duration`` of the largest of ``count`` linear functions, ``value[k] + rate[k] t``.

    At every crossing the largest function becomes steeper, so it changes at most ``count - 1`` times.
    """
    best, area, start = 0, 0.0, 0.0
    for k in range(1, count):
        if value[k] > value[best]:
            best = k
    while start < duration:
        end, following = duration, best
        for k in range(count):
            if rate[k] > rate[best]:
                crossing = max((value[best] - value[k]) / (rate[k] - rate[best]), start)
                if crossing < end:
                    end, following = crossing, k
        area += (value[best] + 0.5 * rate[best] * (start + end)) * (end - start)
        start, best = end, following
    return area


@kernel
def group_acceleration(car, scratch, body, last, toward, side, held):
    """Acceleration (m/s2) of ``body`` if only the bodies from ``body`` to ``last`` existed.

    The mean accelerations of the bodies from ``body`` to j are compared, for every j up to ``last``. ``toward`` is 1
    for the bodies behind a contact: the largest mean counts. It is -1 for the bodies in front: the smallest mean
    counts. ``side`` is the row of ``scratch`` with the accelerations by the bodies' own forces. ``held``: the block
    keeps its speed, so brakes may hold any part of it.
    """
    most, mass, i = toward * scratch[side, body], car[MASS, body], body
    force = mass * most
    while i != last and car[MASS, i + toward] < math.inf:  # a range with a variable step divides
        i += toward
        mass += car[MASS, i]
        force += toward * car[MASS, i] * scratch[side, i]
        most = max(most, force / mass)
    return toward * (max(most, 0.0) if held else most)


@part
def gain(car, scratch, body, last, toward, side, side_jerk, held, duration):
    """Change of speed (m/s) from ``group_acceleration`` over ``duration`` (s), while brakes build up.

    ``side_jerk``: row of ``scratch`` with the rates (m/s3) at which the accelerations in row ``side`` change. Other
    arguments: as for ``group_acceleration``.
    """
    count, mass, force, rate = 0, 0.0, 0.0, 0.0
    for i in range(body, last + toward, toward):
        if car[MASS, i] == math.inf:
            break
        mass += car[MASS, i]
        force += car[MASS, i] * scratch[side, i]
        rate += car[MASS, i] * scratch[side_jerk, i]
        scratch[PART, count], scratch[PART_RATE, count] = toward * force / mass, toward * rate / mass
        count += 1
    if held:
        scratch[PART, count], scratch[PART_RATE, count] = 0.0, 0.0
        count += 1
    return toward * integral_of_largest(scratch[PART], scratch[PART_RATE], count, duration)


@part
def own_push(car, scratch, p, head, side, front, held, rests, duration):
    """Push (m/s) of pair p that the force of its rear body adds in ``duration`` (s).

    ``side`` and ``front`` are the rows of ``scratch`` with the accelerations by own forces of the bodies behind and in
    front of the contact. ``head`` is the front body of those that move as one; ``rests``: whether these are held at
    rest. Other arguments as for ``gain``.
    """
    jerks = LOW_JERK - LOW
    own, rate = scratch[side, p + 1], scratch[side + jerks, p + 1]
    if rests:  # u_own is at least 0, u_front at most
        scratch[PART, 0], scratch[PART_RATE, 0], scratch[PART, 1], scratch[PART_RATE, 1] = own, rate, 0.0, 0.0
        pressing = integral_of_largest(scratch[PART], scratch[PART_RATE], 2, duration)
        return pressing - gain(car, scratch, p, head, -1, front, front + jerks, True, duration)
    gain(car, scratch, p, head, -1, front, front + jerks, held, duration)  # PART: minus the means of the bodies i to p
    count = p - head + (2 if held else 1)
    for k in range(count):
        scratch[PART, k] += own
        scratch[PART_RATE, k] += rate
    scratch[PART, count], scratch[PART_RATE, count] = 0.0, 0.0
    return integral_of_largest(scratch[PART], scratch[PART_RATE], count + 1, duration)


@kernel
def largest_mean(car, scratch, body, last, toward, side, time):
    """Largest mean acceleration (m/s2) of the bodies from ``body`` to j after ``time`` (s), and this j.

    Arguments: as for ``group_acceleration``; where ``toward`` is -1, the result is minus the smallest mean.
    """
    most, mass, force, best = -math.inf, 0.0, 0.0, body
    for i in range(body, last + toward, toward):
        if car[MASS, i] == math.inf:
            break
        mass += car[MASS, i]
        force += toward * car[MASS, i] * (scratch[side, i] + scratch[side + LOW_JERK - LOW, i] * time)
        if force / mass > most:
            most, best = force / mass, i
    return most, best


@kernel
def excess(car, scratch, j, side, time, level):
    """Mass times acceleration by own force above ``level`` (m/s2) of body j after ``time`` (s)."""
    own = scratch[side, j] + scratch[side + LOW_JERK - LOW, j] * time
    return car[MASS, j] * max(own - level, 0.0)


@part
def note_answers(line, car, scratch, p, head, tail, side, front, held, duration, push):
    """Add the parts of pair p's ``push`` (m/s) to the rows of ``line`` with the parts that vehicles bear.

    ``tail`` is the last body of those that move as one. Other arguments: as for ``own_push``.
    """
    rear, rests = p + 1, held and line[SPEED, p] == 0.0
    part_of_rear = min(own_push(car, scratch, p, head, side, front, held, rests, duration), push)
    rest, pressing, time, level, last = push - part_of_rear, 0.0, 0.0, 0.0, rear
    nobodys = push
    if not brakes_fully(line, car, scratch, rear):
        line[ANSWERED, p] += part_of_rear
        nobodys -= part_of_rear
    for attempt in range(3):  # at the middle; if nobody else presses then, at the end, or at the beginning
        if pressing == 0.0 and rest > 0.0:
            time = duration * (0.5, 1.0, 0.0)[attempt]
            level = scratch[side, rear] + scratch[side + LOW_JERK - LOW, rear] * time
            ahead = 0.0 if rests else -largest_mean(car, scratch, p, head, -1, front, time)[0]
            level = max(level, min(ahead, 0.0) if held else ahead)
            last = largest_mean(car, scratch, rear, tail, 1, side, time)[1]
            for j in range(rear + 1, last + 1):
                pressing += excess(car, scratch, j, side, time, level)
    for j in range(rear + 1, last + 1):
        if pressing > 0.0 and not brakes_fully(line, car, scratch, j):
            part_of_j = rest * (excess(car, scratch, j, side, time, level) / pressing)
            line[ANSWERED, j - 1] += part_of_j
            nobodys -= part_of_j
    note_nobodys(line, car, scratch, head, tail, max(nobodys, 0.0), line[SPEED, p] < 0.0)


@kernel
def add_push(line, car, scratch, duration, ahead, builds):
    """Add the push of every pair in ``duration`` (s) to the row PUSHED of ``line``, and who bears it to other rows.

    No event happens in this time.
    """
    pairs, head = line.shape[1] - 1, ahead
    for p in range(ahead, pairs):
        if scratch[JOINED, p] == 0.0:
            head = p + 1
            continue
        tail = p + 1
        while scratch[JOINED, tail] == 1.0:
            tail += 1
        value, jerk = scratch[ACCELERATION, p], scratch[JERK, p] if builds else 0.0
        held = value == 0.0 and jerk == 0.0
        forward = value > 0.0 or (value == 0.0 and jerk > 0.0)
        behind, front = LOW if held or forward else HIGH, LOW if forward else HIGH
        if builds:
            push = gain(car, scratch, p + 1, tail, 1, behind, behind + LOW_JERK - LOW, held, duration)
            push -= gain(car, scratch, p, head, -1, front, front + LOW_JERK - LOW, held, duration)
        else:
            push = group_acceleration(car, scratch, p + 1, tail, 1, behind, held)
            push -= group_acceleration(car, scratch, p, head, -1, front, held)
            push *= duration
        if push > SAME_MPS2 * duration:  # less is rounding
            line[PUSHED, p] += push
            note_answers(line, car, scratch, p, head, tail, behind, front, held, duration, push)
