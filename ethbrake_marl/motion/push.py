"""The push: the closing speed that forces build up and a contact takes up, in further impacts or as long as it lasts.

An impact after the pair's first one changes the closing speed by c, from w before it. Of w the forces have built up
``g = w - (row THROWN)``. Where g > 0, the push is ``c min(g / w, 1)``; ``motion.impact`` adds it. So ever smaller and
more frequent impacts push as much as a contact that lasts, and one that is struck from behind and thrown forward does
not push.

Pair p, whose bodies touch and move as one, takes up the closing acceleration ``u_rear - u_front >= 0`` (m/s2): u_rear
is what body p + 1 would do if no body were in front of it, u_front what body p would do if no body were behind it.
Their integral over time is the push (m/s). Harm does not count it.

By itself a part of the line obeys the law of resting contact (``motion.impact``). By the min-max formula of isotonic
regression, u_rear is the largest of the mean accelerations of the bodies p + 1 to j, u_front the smallest of those of
the bodies i to p, both over the bodies that move as one, weighted by mass. For two moving vehicles the push is the
integral of ``u_{p+1} - u_p``. A part that its brakes hold, and the obstacle with what leans on it, has the
acceleration 0.

Between two events each mean is a linear function of time, and so the largest is a convex one: the integral is exact.
"""

from __future__ import annotations

import math

from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.impact import SAME_MPS2
from ethbrake_marl.motion.layout import ACCELERATION, HIGH, JERK, JOINED, LOW, LOW_JERK, MASS, PART, PART_RATE, PUSHED


@kernel
def integral_of_largest(value, rate, count, duration):
    """Integral from 0 to ``duration`` of the largest of the ``count`` lines ``value[k] + rate[k] t``.

    From one crossing to the next the largest line becomes steeper, so it changes at most ``count - 1`` times.
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
    """Acceleration (m/s2) of ``body`` if only the bodies from it to ``last`` were there.

    ``toward`` is 1 for the bodies behind a contact, where the largest mean counts, and -1 for those in front, where the
    smallest does. ``side`` is the row of their own accelerations. ``held``: the block does not speed up or slow down,
    so the brakes may hold any part of it.
    """
    most, mass, i = toward * scratch[side, body], car[MASS, body], body
    force = mass * most
    while i != last and car[MASS, i + toward] < math.inf:  # a range with a variable step divides
        i += toward
        mass += car[MASS, i]
        force += toward * car[MASS, i] * scratch[side, i]
        most = max(most, force / mass)
    return toward * (max(most, 0.0) if held else most)


@large
def gain(car, scratch, body, last, toward, side, side_jerk, held, duration):
    """Speed (m/s) that ``group_acceleration`` gives ``body`` where brakes build up; ``side_jerk``: row of the rates."""
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


@kernel
def add_push(line, car, scratch, duration, ahead, builds):
    """Add what the contacts take up in ``duration`` (s), in which no event happens, to the row PUSHED of ``line``."""
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
