"""An upper bound on the first-impact harm of a plan over a whole box of worlds.

Every way in which impacts may follow each other in the box is a path. In each piece of time a path goes on without an
impact, and another one branches off for each pair that may have one then. The harm of a path that has ended is a form;
the bound is the largest value of any. Lines of at most three vehicles: once two pairs were hit, harm is final.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.physics import Floats, Ints
from ethbrake_marl.physics.compiled import compiled_apart
from ethbrake_marl.physics.kernel import PLASTIC_SPEED_MPS, TOUCH_SPEED_MPS
from ethbrake_marl.shield.enclosure_motion import (
    CLOSING,
    FREE,
    HARDEST,
    MAY_STOP,
    MOVES,
    OPENING,
    PARTS,
    REACH,
    ROUNDING,
    SINCE,
    SOFTEST,
    SPREAD,
    STANDS,
    TOUCH_WIDTH,
    TOUCHES,
    WIDE,
    Cell,
    Motion,
    Path,
    add,
    apart,
    begin_touch,
    between,
    blur,
    common,
    creep,
    cut,
    difference,
    driven,
    embrace,
    high,
    is_blurred,
    low,
    move_alone,
    move_together,
    negative,
    own_pulls,
    positive_part,
    pressing_together,
    product,
    radius,
    reciprocal,
    rough_harm,
    square,
    square_root,
    stray,
)

# Impacts of a box of worlds within one piece of time, and pairs that stay in contact.
#
# What is said here of "the worlds" of a path holds for all that really go that way; others may be among them.

NEVER = 1e-9  # a gap (m) above this, or a squared closing speed (m2/s2) below minus this: certainly no contact
SLOWEST = 0.05  # mean closing speed (m/s) below which the time of an impact is any within the piece


class Approach(NamedTuple):
    """How a pair may meet within a piece of time."""

    closing: Floats  # [W] at its start
    squared: Floats  # [W] closing speed at contact, squared
    time: Floats  # [W] of contact, s after the start of the piece
    front_stands: bool  # at contact


@compiled_apart
def noise(cell: Cell, path: Path, p: int, of_gap: bool) -> float:
    """By how much speeds (or gap) of a pair may differ in this piece because a neighbouring pair is in contact."""
    P, most = cell.gap.shape[0], 0.0
    if p > 0 and path.marks[P + p - 1] != FREE:
        most += high(cell.share[p - 1, 1]) * path.touch[p - 1, REACH] if of_gap else blur(cell, path, p - 1, 1)
    if p < P - 1 and path.marks[P + p + 1] != FREE:
        most += high(cell.share[p + 1, 0]) * path.touch[p + 1, REACH] if of_gap else blur(cell, path, p + 1, 0)
    return most


@compiled_apart
def pressing(motion: Motion, p: int) -> tuple[float, float]:
    """Least and largest closing acceleration of a pair within the piece, whether or not one of them stops."""
    front_low, front_high = low(motion.pull[p]) - motion.vague[p], high(motion.pull[p]) + motion.vague[p]
    rear_low, rear_high = low(motion.pull[p + 1]) - motion.vague[p + 1], high(motion.pull[p + 1]) + motion.vague[p + 1]
    if motion.rest[p] != MOVES:
        front_low, front_high = min(front_low, 0.0), max(front_high, 0.0)
    if motion.rest[p + 1] != MOVES:
        rear_low, rear_high = min(rear_low, 0.0), max(rear_high, 0.0)
    return rear_low - front_high, rear_high - front_low


@compiled_apart
def may_meet(cell: Cell, path: Path, motion: Motion, p: int, length: float) -> bool:
    """Whether a pair may have a contact in this piece in which it closes."""
    N = cell.speed.shape[0]
    gap = path.forms[N + p]
    softest, hardest = pressing(motion, p)
    slack, wide = noise(cell, path, p, False), noise(cell, path, p, True)
    begin, end = difference(path.forms[p + 1], path.forms[p]), difference(motion.speed[p + 1], motion.speed[p])
    fastest = max(high(begin), high(end)) + slack
    if motion.rest[p] == MAY_STOP or motion.rest[p + 1] == MAY_STOP or motion.vague[p] + motion.vague[p + 1] > 0.0:
        fastest = high(begin) + max(hardest, 0.0) * length + slack
    if fastest <= 0.0 or max(low(gap), 0.0) - wide - fastest * length > NEVER:
        return False
    after = gap.copy()
    add(after, 1.0, motion.way[p])
    add(after, -1.0, motion.way[p + 1])
    dip = 0.125 * length * length * max(-softest, 0.0) + wide + slack * length
    return min(low(gap), low(after)) - dip <= NEVER


@compiled_apart
def approach(
    cell: Cell, path: Path, motion: Motion, p: int, length: float, front_stands: bool
) -> tuple[Approach, bool]:
    """How a pair meets, its front standing at contact or not; and whether it may do so at all in this piece.

    ``w^2 + 2 b g`` is the squared closing speed at contact for closing speed w, closing acceleration b and gap g, and
    ``2 g / (w + w')`` the time until then, w' being the speed at contact. A front that stops first adds its way to g.
    """
    N, width = cell.speed.shape[0], cell.speed.shape[1]
    slack, vague = noise(cell, path, p, False), motion.vague[p] + motion.vague[p + 1]
    gap, closing = cut(path.forms[N + p], 0.0, math.inf).copy(), path.forms[p + 1].copy()
    gap[-1] += noise(cell, path, p, True) + slack * length
    press = motion.pull[p + 1].copy()
    if front_stands:
        if motion.rest[p] == MAY_STOP:
            way = _stopping_way(path.forms[p], motion.pull[p], motion.vague[p], length)
            add(gap, 1.0, cut(way, 0.0, math.inf))
    else:
        add(closing, -1.0, path.forms[p])
        if motion.rest[p] != STANDS:
            add(press, -1.0, motion.pull[p])
    squared = square(closing)
    add(squared, 2.0, product(press, gap))
    if vague > 0.0:  # the way there and back
        opening = max(-low(closing), 0.0) + length * (vague + radius(press) + abs(press[0]))
        squared[-1] += 2.0 * vague * (max(high(gap), 0.0) + 2.0 * length * opening)
    squared[-1] += NEVER
    there = high(squared) > TOUCH_SPEED_MPS * TOUCH_SPEED_MPS
    if slack > 0.0:  # at contact
        least = math.sqrt(max(low(squared), 0.0)) - slack
        rough = square_root(cut(squared, 0.0, math.inf))
        rough[-1] += slack
        squared = square(cut(rough, max(least, 0.0), math.inf))
        closing[-1] += slack
    fastest = max(high(closing), 0.0) + (max(high(press), 0.0) + vague) * length
    squared = cut(squared, 0.0, fastest * fastest + NEVER)
    if not there or fastest <= TOUCH_SPEED_MPS:
        return Approach(closing, squared, gap, front_stands), False
    speed = square_root(squared)
    time, whole = between(0.0, length, width), closing.copy()
    add(whole, 1.0, speed)
    if low(whole) > SLOWEST and vague == 0.0 and slack == 0.0:
        time = product(gap, reciprocal(whole))
        time *= 2.0
        if low(time) > length + NEVER or high(time) < -NEVER:
            return Approach(closing, squared, time, front_stands), False
        time = cut(time, 0.0, length)
    return Approach(closing, squared, time, front_stands), True


@compiled_apart
def _stopping_way(speed: Floats, pull: Floats, vague: float, length: float) -> Floats:
    """Way of a braking vehicle until it stands, which it does within the piece."""
    if vague > 0.0 or not high(pull) < 0.0:
        fastest = max(high(speed), 0.0) + max(high(pull) + vague, 0.0) * length
        return between(0.0, fastest * length, speed.shape[0])
    way = product(square(speed), reciprocal(negative(pull)))
    way *= 0.5
    return way


# Impacts of a box of worlds: how the two vehicles of an impact move on until the piece of time ends.


@compiled_apart
def ceasing_drive(cell: Cell, motion: Motion, p: int, speed: Floats, length: float) -> float:
    """Drive of a front vehicle that ceases because an impact pushes it beyond its speed limit; 0: it does not."""
    drive = high(motion.pull[p]) + motion.vague[p]
    pushed = (1.0 + cell.restitution) * high(speed) + 2.0 * max(pressing(motion, p)[1], 0.0) * length
    return drive if drive > 0.0 and high(motion.onward[p]) + pushed > cell.limit[p] else 0.0


@compiled_apart
def spring_apart(
    cell: Cell, path: Path, motion: Motion, p: int, how: Approach, jump: Floats, left: Floats, after: Path, way: Floats
) -> None:
    """Speeds and ways of a pair whose impact changes its relative speed by ``jump``, ``left`` before the piece ends."""
    front, rear = product(cell.share[p, 0], jump), product(cell.share[p, 1], jump)
    after.forms[p + 1] = difference(motion.onward[p + 1], rear)
    way[p + 1] = difference(motion.reach[p + 1], product(rear, left))
    if how.front_stands:
        from_standstill(path, motion, p, front, left, after.forms[p], way[p])
    else:
        after.forms[p], way[p] = motion.onward[p], motion.reach[p]
        add(after.forms[p], 1.0, front)
        add(way[p], 1.0, product(front, left))
    for i in range(p, p + 2):
        stand_still(motion.pull[i], motion.vague[i], high(left), after.forms[i], way[i])


@compiled_apart
def from_standstill(
    path: Path, motion: Motion, i: int, start: Floats, left: Floats, speed: Floats, way: Floats
) -> None:
    """``speed`` at the end and ``way`` of a vehicle that stood when it was given ``start`` (m/s); then it brakes."""
    speed[:] = start
    add(speed, 1.0, product(motion.pull[i], left))
    add(way, 1.0, product(start, left))
    add(way, 0.5, product(motion.pull[i], square(left)))
    vague, most = motion.vague[i], high(left)
    speed[-1] += vague * most
    way[-1] += 0.5 * vague * most * most


@compiled_apart
def stand_still(pull: Floats, vague: float, left: float, speed: Floats, way: Floats) -> None:
    """Where a braking vehicle's speed would have become negative, it stood before."""
    least = low(speed)
    if least < 0.0:
        most = -least * left
        if high(pull) + vague < 0.0:
            most = min(most, 0.5 * least * least / -(high(pull) + vague))
        add(way, 1.0, between(0.0, most, way.shape[0]))
        speed[:] = positive_part(speed)


@compiled_apart
def stay(
    cell: Cell, path: Path, motion: Motion, p: int, how: Approach, speed: Floats, left: Floats, after: Path, way: Floats
) -> None:
    """Speeds and ways of a pair that stays in contact after its impact: those of its centre of mass."""
    N, touch = cell.speed.shape[0], after.touch[p]
    pull, vague = common(cell, p, motion.pull[p], motion.pull[p + 1]), max(motion.vague[p], motion.vague[p + 1])
    gap = path.forms[N + p]
    if how.front_stands:
        start = product(cell.share[p, 0], speed)
        after.forms[p] = start
        add(after.forms[p], 1.0, product(pull, left))
        add(way[p], 1.0, product(start, left))
        add(way[p], 0.5, product(pull, square(left)))
        after.forms[p, -1] += vague * high(left)
        way[p, -1] += 0.5 * vague * high(left) * high(left)
    else:
        start = common(cell, p, path.forms[p], path.forms[p + 1])
        after.forms[p] = common(cell, p, motion.onward[p], motion.onward[p + 1])
        way[p] = common(cell, p, motion.reach[p], motion.reach[p + 1])
        add(way[p], -1.0, product(cell.share[p, 0], gap))
    weakest, hardest = own_pulls(motion, p)
    creep(cell, touch, p, min(low(start), low(after.forms[p])), weakest, hardest, high(left))
    stand_still(pull, vague, high(left), after.forms[p], way[p])
    way[p, -1] += stray(cell, touch, p) * high(left)
    after.forms[p + 1], way[p + 1] = after.forms[p], way[p]
    add(way[p + 1], 1.0, gap)


@compiled_apart
def settle_down(cell: Cell, motion: Motion, p: int, most_apart: float, length: float, touch: Floats) -> None:
    """Largest difference of speeds and gap of a pair in contact; its impact opens it by ``most_apart`` at most."""
    least, most = pressing_together(motion, p)
    begin_touch(touch)
    touch[CLOSING] = max(most, 0.0) * length
    touch[OPENING] = max(most_apart, cell.restitution * touch[CLOSING]) - min(least, 0.0) * length
    touch[WIDE] = touch[OPENING] * length
    if least > 0.0 and motion.vague[p] + motion.vague[p + 1] == 0.0:
        ratio = math.sqrt(most / least)
        touch[OPENING], touch[CLOSING] = most_apart, most_apart
        touch[WIDE] = min(0.5 * most_apart * most_apart / least, most_apart * length)
        if cell.restitution * ratio < 1.0:
            touch[OPENING], touch[CLOSING] = most_apart * ratio, most_apart * ratio
            touch[SOFTEST], touch[HARDEST], touch[SINCE] = least, most, 0.0
    touch[SPREAD], touch[REACH] = apart(touch), 0.0


# Impacts of a box of worlds: a path branches off, in which a pair has its impact in this piece of time.

STACK = 256  # most paths that wait to be followed


class Stack(NamedTuple):
    """Paths that are still to be followed."""

    forms: Floats  # [STACK, N + P + 1, W]
    touch: Floats  # [STACK, P, TOUCH_WIDTH]
    marks: Ints  # [STACK, 2 P + 1]
    size: Ints  # [1]


@compiled_apart
def new_stack(N: int, width: int) -> Stack:
    """An empty one."""
    P = N - 1
    return Stack(
        np.zeros((STACK, N + P + 1, width)),
        np.zeros((STACK, P, TOUCH_WIDTH)),
        np.zeros((STACK, 2 * P + 1), np.int64),
        np.zeros(1, np.int64),
    )


@compiled_apart
def keep_worst(harm: Floats, worst: float, out: Floats) -> float:
    """The larger harm; its form goes to ``out``."""
    if not high(harm) <= worst:
        out[:] = harm
        return high(harm)
    return worst


@compiled_apart
def keep_rough(cell: Cell, path: Path, hit: int, worst: float, out: Floats) -> float:
    """``keep_worst`` of a path that is not followed any further."""
    harm = np.zeros(cell.speed.shape[1])
    harm[0] = rough_harm(cell, path, hit)
    return keep_worst(harm, worst, out)


@compiled_apart
def branch(
    cell: Cell, path: Path, stack: Stack, motion: Motion, p: int, how: Approach, worst: float, out: Floats
) -> float:
    """The worlds in which pair ``p`` has an impact in this piece: their harm where it is final, else a path of its own.

    Where such a path cannot be followed, what is certain without it.
    """
    P = cell.gap.shape[0]
    harm = path.forms[-1].copy()
    if path.marks[p] == 0:
        add(harm, 1.0, how.squared)
    other = 1 - p
    if P == 1 or path.marks[other] == 1:
        return keep_worst(harm, worst, out)
    if path.marks[P + other] != FREE:
        return keep_with(harm, rough_harm(cell, path, p) - high(path.forms[-1]), worst, out)
    speed = cut(square_root(how.squared), 0.0, math.inf)
    length = cell.times[path.marks[2 * P] + 1] - cell.times[path.marks[2 * P]]
    closing = closing_after(cell, path, motion, p, speed, how.time, length)
    if high(closing) > 0.0:
        both = harm.copy()
        add(both, 1.0, square(cut(closing, 0.0, math.inf)))
        worst = keep_worst(both, worst, out)
    if not strike(cell, path, stack, motion, p, how, speed, harm):
        worst = keep_with(harm, rough_harm(cell, path, p) - high(path.forms[-1]), worst, out)
    return worst


@compiled_apart
def keep_with(harm: Floats, rest: float, worst: float, out: Floats) -> float:
    """``keep_worst`` of a harm to which at most ``rest`` is added."""
    whole = harm.copy()
    whole[0] += rest
    return keep_worst(whole, worst, out)


@compiled_apart
def closing_after(cell: Cell, path: Path, motion: Motion, p: int, speed: Floats, time: Floats, length: float) -> Floats:
    """Closing speed of the other one of two pairs that meets in the same piece, after pair ``p``; 0: it does not."""
    N, other = cell.speed.shape[0], 1 - p
    push = product(cell.share[p, other], speed)  # of the middle vehicle, towards the other pair's second one
    push *= 1.0 + cell.restitution
    softest, hardest = pressing(motion, other)
    hold = max(pressing(motion, p)[1], 0.0) * length  # what pair p, pressing on, adds to the push
    hold *= max(1.0, (1.0 + cell.restitution) * high(cell.share[p, other]))
    begin, after = path.forms[N + other], path.forms[N + other].copy()
    add(after, 1.0, motion.way[other])
    add(after, -1.0, motion.way[other + 1])
    dip = 0.125 * length * length * max(-softest, 0.0) + high(push) * (length - low(time)) + hold * length
    if min(low(begin), low(after)) - dip > NEVER:
        return np.zeros_like(speed)
    closing = difference(path.forms[other + 1], path.forms[other])
    add(closing, 1.0, push)
    add(closing, 1.0, between(min(softest, 0.0) * length, max(hardest, 0.0) * length + hold, speed.shape[0]))
    return closing


@compiled_apart
def strike(
    cell: Cell, path: Path, stack: Stack, motion: Motion, p: int, how: Approach, speed: Floats, harm: Floats
) -> bool:
    """Put the path of the worlds in which pair ``p`` has its impact in this piece on the stack; False if it cannot."""
    N, P, width = cell.speed.shape[0], cell.gap.shape[0], cell.speed.shape[1]
    size = stack.size[0]
    if size >= STACK or thrown_back(cell, path, motion, p, how, speed):
        return False
    piece = path.marks[2 * P]
    length = cell.times[piece + 1] - cell.times[piece]
    after = Path(stack.forms[size], stack.touch[size], stack.marks[size])
    after.forms[:], after.touch[:], after.marks[:] = path.forms, path.touch, path.marks
    after.forms[N + P] = harm
    after.marks[p], after.marks[2 * P] = 1, piece + 1
    left = negative(how.time)
    left[0] += length
    way = np.empty((N, width))
    for i in range(N):
        after.forms[i], way[i] = motion.speed[i], motion.way[i]
    bounces = cell.restitution if high(speed) >= PLASTIC_SPEED_MPS else 0.0
    returns = cell.restitution if low(speed) >= PLASTIC_SPEED_MPS else 0.0
    _, most = pressing(motion, p)
    unlimited = ceasing_drive(cell, motion, p, speed, length)
    if most < 0.0 or -returns * low(speed) + max(most, 0.0) * high(left) < 0.0:
        jump = speed * (1.0 + bounces)
        jump[-1] = abs(jump[-1]) + (bounces - returns) * PLASTIC_SPEED_MPS
        spring_apart(cell, path, motion, p, how, jump, left, after, way)
    else:
        settle_down(cell, motion, p, bounces * high(speed), length, after.touch[p])
        stay(cell, path, motion, p, how, speed, left, after, way)
        after.marks[P + p] = TOUCHES
    for i in range(p, p + 2):
        if unlimited > 0.0 and (i == p or after.marks[P + p] == TOUCHES):
            add(after.forms[i], 1.0, between(-unlimited * high(left), 0.0, width))
            add(way[i], 1.0, between(-0.5 * unlimited * high(left) * high(left), 0.0, width))
    for q in range(P):
        add(after.forms[N + q], 1.0, way[q])
        add(after.forms[N + q], -1.0, way[q + 1])
        if after.marks[P + q] == PARTS:
            after.marks[P + q] = FREE
    stack.size[0] = size + 1
    if after.marks[P + p] == TOUCHES and path.marks[p] == 0 and may_only_touch(cell, path, motion, p):
        return touch_only(path, stack, p)
    return True


@compiled_apart
def may_only_touch(cell: Cell, path: Path, motion: Motion, p: int) -> bool:
    """Whether a pair may have come to gap 0 at closing speed 0 just when it begins to be pressed together.

    Before, it was not: so a command changed.
    """
    N, P = cell.speed.shape[0], cell.gap.shape[0]
    piece = path.marks[2 * P]
    changed = piece == 0 or motion.vague[p] + motion.vague[p + 1] > 0.0 or (P == 2 and path.marks[1 - p] == 1)
    for i in range(p, p + 2):
        if i != cell.vehicle:
            changed = changed or high(cell.onset[i]) == cell.times[piece]
        elif piece > 0:
            changed = changed or cell.action[piece] != cell.action[piece - 1]
    closing = difference(path.forms[p + 1], path.forms[p])
    return changed and low(closing) <= 1e-4 and high(closing) >= -1e-4 and low(path.forms[N + p]) <= 1e-6


@compiled_apart
def touch_only(path: Path, stack: Stack, p: int) -> bool:
    """Beside the path on top that of the worlds in which pair ``p`` met, stayed in contact, and had no impact."""
    size = stack.size[0]
    if size >= STACK:
        return False
    stack.forms[size], stack.touch[size], stack.marks[size] = (
        stack.forms[size - 1], stack.touch[size - 1], stack.marks[size - 1],
    )  # fmt: skip
    stack.forms[size, -1] = path.forms[-1]
    stack.marks[size, p] = 0
    begin_touch(stack.touch[size, p])
    stack.size[0] = size + 1
    return True


@compiled_apart
def thrown_back(cell: Cell, path: Path, motion: Motion, p: int, how: Approach, speed: Floats) -> bool:
    """Whether the striking vehicle may move backwards after the impact, and be met again.

    The last one of a line, if it never drives, meets nobody then: it may as well stand.
    """
    P, share = cell.gap.shape[0], (1.0 + cell.restitution) * high(cell.share[p, 1]) - 1.0
    slowest = 0.0 if how.front_stands else max(min(low(path.forms[p]), low(motion.speed[p])), 0.0)
    last = p == P - 1 and driven(cell, p + 1, 0.0, cell.times[path.marks[2 * P]]) <= 0.0
    return share * high(speed) > slowest and not last


MOST_PATHS = 4000  # of one cell


@compiled_apart
def most_harm(cell: Cell, stack: Stack, motion: Motion, out: Floats, most: float) -> float:
    """Upper bound on the harm of every world of the cell (m2/s2), unless it is above ``most``.

    ``out`` [W] becomes the form that reaches it.
    """
    N, P = cell.speed.shape[0], cell.gap.shape[0]
    worst, paths = -math.inf, 0
    first = Path(stack.forms[0], stack.touch[0], stack.marks[0])
    first.forms[:N], first.forms[N : N + P], first.forms[N + P] = cell.speed, cell.gap, 0.0
    first.touch[:], first.marks[:] = 0.0, 0
    stack.size[0] = 1
    here = Path(np.empty_like(first.forms), np.empty_like(first.touch), np.empty_like(first.marks))
    while stack.size[0] > 0:
        stack.size[0] -= 1
        paths += 1
        top = stack.size[0]
        here.forms[:], here.touch[:], here.marks[:] = stack.forms[top], stack.touch[top], stack.marks[top]
        worst = follow(cell, here, stack, motion, worst, out)
        if worst > most:
            return worst
        if paths > MOST_PATHS:
            return give_up(cell, stack, worst, out)
    return worst if worst >= 0.0 else math.inf  # each world goes some way


@compiled_apart
def give_up(cell: Cell, stack: Stack, worst: float, out: Floats) -> float:
    """The larger one of ``worst`` and of what is certain of all paths that wait."""
    for k in range(stack.size[0]):
        worst = keep_rough(cell, Path(stack.forms[k], stack.touch[k], stack.marks[k]), -1, worst, out)
    return worst


@compiled_apart
def follow(cell: Cell, path: Path, stack: Stack, motion: Motion, worst: float, out: Floats) -> float:
    """Follow a path to its end; the larger one of ``worst`` and its harm and that of the paths that end with it."""
    N, P = cell.speed.shape[0], cell.gap.shape[0]
    quiet = quiet_from(cell)
    while path.marks[2 * P] < cell.action.shape[0]:
        piece = path.marks[2 * P]
        move_alone(cell, path, piece, motion)
        if may_meet_unseen(cell, path, motion):
            return keep_rough(cell, path, -1, worst, out)
        worst = meet(cell, path, stack, motion, worst, out)
        if not go_on(cell, path, motion):
            return worst
        path.marks[2 * P] += 1
        if piece >= quiet and (motion.rest == STANDS).all() and path.touch[:, :WIDE].max() <= 0.0:
            break
    return keep_worst(path.forms[N + P], worst, out)


@compiled_apart
def quiet_from(cell: Cell) -> int:
    """The piece of time from which on nobody drives."""
    quiet = 0
    for j in range(cell.action.shape[0]):
        if cell.action[j] > 0.0:
            quiet = j + 1
    for i in range(cell.constant.shape[0]):
        if i != cell.vehicle and cell.constant[i] > 0.0:
            quiet = cell.action.shape[0]
    return quiet


@compiled_apart
def may_meet_unseen(cell: Cell, path: Path, motion: Motion) -> bool:
    """Whether a pair that touched without an impact may open in this piece and meet again, which would be its first."""
    P = cell.gap.shape[0]
    for p in range(P):
        if path.marks[P + p] == TOUCHES and path.marks[p] == 0:
            least, most = pressing_together(motion, p)
            if least < 0.0 <= most and not (motion.rest[p : p + 2] == STANDS).all():
                return True
    return False


@compiled_apart
def meet(cell: Cell, path: Path, stack: Stack, motion: Motion, worst: float, out: Floats) -> float:
    """Pairs in contact, and those that may come into contact, in one piece of time; ``worst`` as ``follow``."""
    N, P = cell.speed.shape[0], cell.gap.shape[0]
    length = cell.times[path.marks[2 * P] + 1] - cell.times[path.marks[2 * P]]
    for p in range(P):
        again = path.marks[P + p] == FREE and path.marks[p] == 1 and (P == 1 or path.marks[2 * P - 1 - p] == FREE)
        if again and may_meet(cell, path, motion, p, length) and is_blurred(path, motion, N, p, length):
            embrace(cell, path, p)
        if path.marks[P + p] == TOUCHES:
            move_together(cell, path, motion, p, length)
    for p in range(P):
        if path.marks[P + p] == FREE and may_meet(cell, path, motion, p, length):
            worst = impacts(cell, path, stack, motion, p, worst, out)
    return worst


@compiled_apart
def impacts(cell: Cell, path: Path, stack: Stack, motion: Motion, p: int, worst: float, out: Floats) -> float:
    """The impacts that a pair may have in one piece of time, its front moving then or standing."""
    P = cell.gap.shape[0]
    length = cell.times[path.marks[2 * P] + 1] - cell.times[path.marks[2 * P]]
    for i in range(p, p + 2):
        motion.way[i, -1] += TOUCH_SPEED_MPS * length  # by a touch, which is no impact
        if motion.rest[i] == MOVES or high(motion.speed[i]) > 0.0 or high(motion.pull[i]) + motion.vague[i] >= 0.0:
            motion.speed[i, -1] += TOUCH_SPEED_MPS
    for stands in range(2):
        if (motion.rest[p] == STANDS) == (stands == 1) or motion.rest[p] == MAY_STOP:
            how, there = approach(cell, path, motion, p, length, stands == 1)
            if there:
                worst = branch(cell, path, stack, motion, p, how, worst, out)
    return worst


@compiled_apart
def go_on(cell: Cell, path: Path, motion: Motion) -> bool:
    """Move on without an impact in this piece; False if no world can."""
    N, P = cell.speed.shape[0], cell.gap.shape[0]
    for p in range(P):
        if path.marks[P + p] == TOUCHES:
            continue
        gap = path.forms[N + p]
        add(gap, 1.0, motion.way[p])
        add(gap, -1.0, motion.way[p + 1])
        gap[-1] += ROUNDING * (1.0 + abs(gap[0]))
        if high(gap) + noise(cell, path, p, True) < -1e-9:
            return False
        path.marks[P + p] = FREE
    for i in range(N):
        path.forms[i] = motion.speed[i]
    return True
