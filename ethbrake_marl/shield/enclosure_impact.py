"""Impacts of a box of worlds: a path branches off, in which a pair has its impact in this piece of time."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.physics import Floats, Ints
from ethbrake_marl.physics.compiled import compiled_apart
from ethbrake_marl.physics.events import PLASTIC_SPEED_MPS
from ethbrake_marl.shield.enclosure_contact import NEVER, Approach, pressing
from ethbrake_marl.shield.enclosure_motion import FREE, PARTS, TOUCH_WIDTH, TOUCHES, Cell, Motion, Path
from ethbrake_marl.shield.enclosure_rebound import ceasing_drive, settle_down, spring_apart, stay
from ethbrake_marl.shield.enclosure_rough import driven, rough_harm
from ethbrake_marl.shield.enclosure_touch import begin_touch
from ethbrake_marl.shield.forms import add, between, cut, difference, high, low, negative, product, square, square_root

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
