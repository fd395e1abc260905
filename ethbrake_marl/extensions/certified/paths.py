"""Simulate all worlds of a box along paths: if a pair has an impact in only some of the worlds, the worlds with the
impact form a new path.

A *path* is a set of worlds with the same sequence of impacts (``affine.Path``). Arrays without a stated shape are
affine forms [W] (module ``affine``). Arguments that several functions share:

- ``stack``: the paths that still have to be simulated; the functions may add paths.
- ``motion``: the motion of each vehicle in the present piece: as if alone on the road (``move_alone``), or as one body
  with the other vehicle of a pair in contact (``move_together``).
- ``p``: index of a pair; vehicle ``p`` is in front, vehicle ``p + 1`` behind.
- ``how``: closing speed and time of the contact of pair ``p``, from ``approach``.
- ``speed``: closing speed at the impact of pair ``p``, m/s.
- ``length``: duration of the piece, s.
- ``worst``: largest harm recorded before the call, m2/s2. A function with this argument returns the largest harm
  recorded so far. If it records a new largest harm, it writes the affine form of this harm into ``out``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.extensions.certified.affine import (
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
    between,
    cut,
    difference,
    high,
    low,
    move_alone,
    negative,
    product,
    square,
    square_root,
)
from ethbrake_marl.extensions.certified.approach import NEVER, Approach, approach, may_meet, noise, pressing
from ethbrake_marl.extensions.certified.bounce import spring_apart, stay
from ethbrake_marl.extensions.certified.rough import driven, rough_harm
from ethbrake_marl.extensions.certified.touching import (
    UNEVEN,
    apart,
    begin_touch,
    common,
    dip_of,
    is_blurred,
    move_together,
    pressing_together,
)
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.motion import BOUND
from ethbrake_marl.physics.state import Floats, Ints

STACK = 256  # largest number of waiting paths


class Stack(NamedTuple):
    """Paths that still have to be simulated."""

    forms: Floats  # [STACK, N + P + 1, W] ``Path.forms`` of each path
    touch: Floats  # [STACK, P, TOUCH_WIDTH] ``Path.touch`` of each path
    marks: Ints  # [STACK, 2 P + 1] ``Path.marks`` of each path
    size: Ints  # [1] number of paths on the stack


@compiled(apart=True)
def new_stack(N: int, width: int) -> Stack:
    """Return an empty stack of paths for ``N`` vehicles and affine forms of length ``width``."""
    P = N - 1
    return Stack(
        np.zeros((STACK, N + P + 1, width)),
        np.zeros((STACK, P, TOUCH_WIDTH)),
        np.zeros((STACK, 2 * P + 1), np.int64),
        np.zeros(1, np.int64),
    )


@compiled(apart=True)
def keep_worst(harm: Floats, worst: float, out: Floats) -> float:
    """Record ``harm`` (m2/s2) if its largest value is above ``worst``."""
    if not high(harm) <= worst:
        out[:] = harm
        return high(harm)
    return worst


@compiled(apart=True)
def keep_rough(cell: Cell, path: Path, worst: float, out: Floats) -> float:
    """Record a rough bound (``rough_harm``) on the harm of a path that is no longer simulated."""
    return keep_with(np.zeros(cell.speed.shape[1]), rough_harm(cell, path, -1), worst, out)


@compiled(apart=True)
def branch(
    cell: Cell, path: Path, stack: Stack, motion: Motion, p: int, how: Approach, worst: float, out: Floats
) -> float:
    """For the worlds in which pair ``p`` has an impact in this piece, record the harm or put a new path on the stack.

    If no other impact can follow, the harm in the worlds with the impact is final and is recorded. Otherwise, these
    worlds become a new path on the stack. If this new path cannot be simulated, the function records a rough bound on
    its harm (``rough_harm``) instead.
    """
    P = cell.gap.shape[0]
    harm = path.forms[-1].copy()
    if path.marks[p] == 0:
        add(harm, 1.0, how.squared)
    other = 1 - p
    final = P == 1 or path.marks[other] == 1
    touches = path.marks[p] == 0 and pressing(motion, p)[1] >= 0.0 and may_only_touch(cell, path, motion, p, how)
    touches = touches and (P == 1 or may_turn(cell, motion, p, path.marks[2 * P]))  # the first impact is still to come
    if final:
        worst = keep_worst(harm, worst, out)
        if not touches:
            return worst
    rough = rough_harm(cell, path, -1 if touches else p) - high(path.forms[-1])
    if P == 2 and path.marks[P + other] != FREE:
        return keep_with(harm, rough, worst, out)
    speed = cut(square_root(how.squared), 0.0, math.inf)
    length = cell.times[path.marks[2 * P] + 1] - cell.times[path.marks[2 * P]]
    closing = np.zeros_like(speed) if final else closing_after(cell, path, motion, p, speed, how.time, length)
    if high(closing) > 0.0:
        if touches:
            return keep_with(harm, rough, worst, out)
        both = harm.copy()
        add(both, 1.0, square(cut(closing, 0.0, math.inf)))
        worst = keep_worst(both, worst, out)
    if not strike(cell, path, stack, motion, p, how, speed, harm):
        worst = keep_with(harm, rough, worst, out)
    return worst


@compiled(apart=True)
def keep_with(harm: Floats, rest: float, worst: float, out: Floats) -> float:
    """Record the sum of ``harm`` and ``rest``, an upper bound on the harm of later impacts (m2/s2)."""
    whole = harm.copy()
    whole[0] += rest
    return keep_worst(whole, worst, out)


@compiled(apart=True)
def closing_after(cell: Cell, path: Path, motion: Motion, p: int, speed: Floats, time: Floats, length: float) -> Floats:
    """Return the closing speed (m/s) of an impact of the other pair that may follow the impact of pair ``p`` in the
    same piece.

    The function is for a line of three vehicles, which has two pairs. The result is 0 if the other pair cannot have
    contact. ``time`` is the time of the impact of pair ``p``, s after the start of the piece.
    """
    N, other = cell.speed.shape[0], 1 - p
    push = product(cell.share[p, other], speed)  # change of the middle vehicle's speed, towards the other pair
    push *= 1.0 + cell.restitution
    softest, hardest = pressing(motion, other)
    hold = max(pressing(motion, p)[1], 0.0) * length  # further change while pair p presses on
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


@compiled(apart=True)
def strike(
    cell: Cell, path: Path, stack: Stack, motion: Motion, p: int, how: Approach, speed: Floats, harm: Floats
) -> bool:
    """Put the worlds in which pair ``p`` has an impact in the present piece on the stack as a new path.

    Returns False if some of these worlds could not be put on the stack, because the stack is full or the rear vehicle
    may move backwards (``thrown_back``). ``harm`` is the harm up to and including this impact, m2/s2.
    """
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
    bounces = cell.restitution if high(speed) >= BOUND.PLASTIC_SPEED_MPS else 0.0
    returns = cell.restitution if low(speed) >= BOUND.PLASTIC_SPEED_MPS else 0.0
    _, most = pressing(motion, p)
    # driving acceleration that a front vehicle loses if the impact pushes it beyond its speed limit; else 0
    drive = high(motion.pull[p]) + motion.vague[p]
    pushed = (1.0 + cell.restitution) * high(speed) + 2.0 * max(pressing(motion, p)[1], 0.0) * length
    fastest = high(motion.onward[p])
    if cell.moving:
        fastest = max(fastest, high(path.forms[p]) + max(drive, 0.0) * length)
    unlimited = drive if drive > 0.0 and fastest + pushed > cell.limit[p] else 0.0
    if most < 0.0 or -returns * low(speed) + max(most, 0.0) * high(left) < 0.0:
        jump = speed * (1.0 + bounces)
        jump[-1] = abs(jump[-1]) + (bounces - returns) * BOUND.PLASTIC_SPEED_MPS
        spring_apart(cell, motion, p, how, jump, left, after, way)
    else:
        most_apart, touch = bounces * high(speed), after.touch[p]  # largest opening speed after the impact
        least, hardest = pressing_together(motion, p)
        begin_touch(touch)
        touch[CLOSING] = max(hardest, 0.0) * length
        touch[OPENING] = max(most_apart, cell.restitution * touch[CLOSING]) - min(least, 0.0) * length
        touch[WIDE] = touch[OPENING] * length
        ratio = math.sqrt(hardest / least) if least > 0.0 else math.inf
        steady = motion.vague[p] + motion.vague[p + 1] == 0.0
        regular = cell.restitution * ratio < 1.0 and (ratio < UNEVEN or not cell.moving)
        if least > 0.0 and (steady or (cell.moving and regular)):
            touch[OPENING], touch[CLOSING] = most_apart, most_apart
            touch[WIDE] = min(0.5 * most_apart * most_apart / least, most_apart * length)
            if regular:
                touch[OPENING], touch[CLOSING] = most_apart * ratio, most_apart * ratio
                touch[SOFTEST], touch[HARDEST], touch[SINCE] = least, hardest, 0.0
        touch[SPREAD], touch[REACH] = apart(touch), 0.0
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
    if after.marks[P + p] == TOUCHES and path.marks[p] == 0 and may_only_touch(cell, path, motion, p, how):
        return touch_only(cell, path, stack, motion, p, length)
    return True


@compiled(apart=True)
def may_only_touch(cell: Cell, path: Path, motion: Motion, p: int, how: Approach) -> bool:
    """Return whether pair ``p`` may reach gap 0 at closing speed 0, exactly when its vehicles begin to press on each
    other.

    A contact at closing speed 0 is possible only if a command changes or an acceleration builds up gradually.
    """
    N, P = cell.speed.shape[0], cell.gap.shape[0]
    softest, hardest = pressing(motion, p)
    piece = path.marks[2 * P]
    harder = may_turn(cell, motion, p, piece)
    if harder and softest <= 0.0 <= hardest and low(how.squared) <= 1e-8:
        return True
    vague = harder if cell.moving else motion.vague[p] + motion.vague[p + 1] > 0.0
    changed = piece == 0 or vague or (P == 2 and path.marks[1 - p] == 1)
    for i in range(p, p + 2):
        if i != cell.vehicle:
            changed = changed or high(cell.onset[i]) == cell.times[piece]
        elif piece > 0:
            changed = changed or cell.action[piece] != cell.action[piece - 1]
    closing = difference(path.forms[p + 1], path.forms[p])
    return changed and low(closing) <= 1e-4 and high(closing) >= -1e-4 and low(path.forms[N + p]) <= 1e-6


@compiled(apart=True)
def may_turn(cell: Cell, motion: Motion, p: int, piece: int) -> bool:
    """Return whether accelerations that build up gradually may press the vehicles of pair ``p`` together harder within
    a piece.
    """
    return may_move(cell, motion, p, piece, 0) or may_move(cell, motion, p + 1, piece, 1)


@compiled(apart=True)
def may_move(cell: Cell, motion: Motion, i: int, piece: int, which: int) -> bool:
    """Return whether brake build-up may lower (``which=0``) or raise (``which=1``) the acceleration of vehicle ``i``
    within a piece.
    """
    if not cell.forces.build[i] or motion.vague[i] > cell.forces.swing[i, piece + 1].max():
        return cell.moving and motion.vague[i] > 0.0
    return bool(cell.forces.swing[i, piece + 1, which] > 0.0)


@compiled(apart=True)
def touch_only(cell: Cell, path: Path, stack: Stack, motion: Motion, p: int, length: float) -> bool:
    """Put a second path on the stack: the worlds in which pair ``p`` came into contact without an impact and stayed in
    contact.

    With brake build-up the pair may separate after the contact, and then have its first impact within the same piece.
    These worlds belong to the path that lies directly below the second path on the stack. Returns False if the stack
    has no room for the second path.
    """
    size = stack.size[0]
    if size >= STACK:
        return False
    stack.forms[size], stack.touch[size], stack.marks[size] = (
        stack.forms[size - 1], stack.touch[size - 1], stack.marks[size - 1],
    )  # fmt: skip
    stack.forms[size, -1] = path.forms[-1]
    stack.marks[size, p] = 0
    begin_touch(stack.touch[size, p])
    if cell.moving:
        touch, (softest, hardest) = stack.touch[size, p], pressing(motion, p)
        touch[OPENING], touch[CLOSING] = max(-softest, 0.0) * length, max(hardest, 0.0) * length
        touch[WIDE] = touch[OPENING] * length
        stack.forms[size - 1, -1, 0] += touch[CLOSING] * touch[CLOSING]
    stack.size[0] = size + 1
    return True


@compiled(apart=True)
def thrown_back(cell: Cell, path: Path, motion: Motion, p: int, how: Approach, speed: Floats) -> bool:
    """Return whether the rear vehicle of pair ``p`` may move backwards after the impact of the pair and be hit again.

    The result is False for the last vehicle of the line if it never drives: no vehicle is behind it, so its backward
    motion cannot lead to an impact.
    """
    P, share = cell.gap.shape[0], (1.0 + cell.restitution) * high(cell.share[p, 1]) - 1.0
    slowest = 0.0
    if not how.front_stands:
        dip = dip_of(cell, motion.vague[p], cell.times[path.marks[2 * P] + 1] - cell.times[path.marks[2 * P]])
        slowest = max(min(low(path.forms[p]), low(motion.speed[p])) - dip, 0.0)
    last = p == P - 1 and driven(cell, p + 1, 0.0, cell.times[path.marks[2 * P]]) <= 0.0
    return share * high(speed) > slowest and not last


MOST_PATHS = 4000  # largest number of paths to simulate in one cell


@compiled(apart=True)
def most_harm(cell: Cell, stack: Stack, motion: Motion, out: Floats, most: float) -> float:
    """Return an upper bound on the harm in all worlds of the cell's box, m2/s2, and write its affine form into ``out``.

    A result above ``most`` is no bound: the search stops as soon as the harm of some world may exceed ``most``. The
    bound is the largest value of ``out``. The function overwrites ``stack`` and ``motion``.
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
            for k in range(stack.size[0]):
                worst = keep_rough(cell, Path(stack.forms[k], stack.touch[k], stack.marks[k]), worst, out)
            return worst
    return worst if worst >= 0.0 else math.inf  # every world is on some path; without a path there is no bound


@compiled(apart=True)
def follow(cell: Cell, path: Path, stack: Stack, motion: Motion, worst: float, out: Floats) -> float:
    """Simulate a path to its end, and record its harm.

    The function also records the harm in worlds that leave the path because of an impact, if these worlds need no
    further simulation. It updates ``path`` in place and overwrites ``motion``.
    """
    N, P = cell.speed.shape[0], cell.gap.shape[0]
    quiet = 0  # first piece from which on no vehicle drives
    for j in range(cell.action.shape[0]):
        if cell.action[j] > 0.0:
            quiet = j + 1
    for i in range(cell.constant.shape[0]):
        if i != cell.vehicle and cell.constant[i] > 0.0:
            quiet = cell.action.shape[0]
    while path.marks[2 * P] < cell.action.shape[0]:
        piece = path.marks[2 * P]
        move_alone(cell, path, piece, motion)
        if may_meet_unseen(cell, path, motion):
            return keep_rough(cell, path, worst, out)
        worst = meet(cell, path, stack, motion, worst, out)
        if not go_on(cell, path, motion):
            return worst
        path.marks[2 * P] += 1
        if piece >= quiet and (motion.rest == STANDS).all() and path.touch[:, :WIDE].max() <= 0.0:
            break
    return keep_worst(path.forms[N + P], worst, out)


@compiled(apart=True)
def may_meet_unseen(cell: Cell, path: Path, motion: Motion) -> bool:
    """Return whether a pair that is in contact, but has had no impact yet, may have its first impact in the present
    piece.

    The vehicles of a pair in contact must separate before they can have an impact.
    """
    P = cell.gap.shape[0]
    for p in range(P):
        if path.marks[P + p] == TOUCHES and path.marks[p] == 0:
            least, most = pressing_together(motion, p)
            if least < 0.0 <= most and not (motion.rest[p : p + 2] == STANDS).all():
                return True
    return False


@compiled(apart=True)
def meet(cell: Cell, path: Path, stack: Stack, motion: Motion, worst: float, out: Floats) -> float:
    """Move the pairs in contact through the present piece, and pass the worlds in which a pair has an impact to
    ``branch``.

    The vehicles of a pair in contact either move as one body or separate. The function changes ``path`` and ``motion``
    in place.
    """
    N, P = cell.speed.shape[0], cell.gap.shape[0]
    length = cell.times[path.marks[2 * P] + 1] - cell.times[path.marks[2 * P]]
    for p in range(P):
        again = path.marks[P + p] == FREE and path.marks[p] == 1 and (P == 1 or path.marks[2 * P - 1 - p] == FREE)
        if again and may_meet(cell, path, motion, p, length) and is_blurred(path, motion, N, p, length):
            # treat a pair that may or may not be in contact as a pair in contact
            front, rear, gap = path.forms[p].copy(), path.forms[p + 1].copy(), path.forms[N + p]
            closing = difference(rear, front)
            touch = path.touch[p]
            begin_touch(touch)
            touch[OPENING], touch[CLOSING], touch[WIDE] = max(-low(closing), 0.0), high(closing), max(high(gap), 0.0)
            path.forms[p] = common(cell, p, front, rear)
            path.forms[p + 1] = path.forms[p]
            inside = cut(gap, 0.0, math.inf)
            if p > 0:
                add(path.forms[N + p - 1], 1.0, product(cell.share[p, 0], inside))
            if p < P - 1:
                add(path.forms[N + p + 1], 1.0, product(cell.share[p, 1], inside))
            path.marks[P + p] = TOUCHES
        if path.marks[P + p] == TOUCHES:
            move_together(cell, path, motion, p, length)
    for p in range(P):
        if path.marks[P + p] == FREE and may_meet(cell, path, motion, p, length):
            # impacts of the pair in this piece, with a moving or a standing front vehicle
            for i in range(p, p + 2):
                motion.way[i, -1] += (
                    BOUND.TOUCH_SPEED_MPS * length
                )  # a contact below the impact speed may change the speed by this
                if (
                    motion.rest[i] == MOVES
                    or high(motion.speed[i]) > 0.0
                    or high(motion.pull[i]) + motion.vague[i] >= 0.0
                ):
                    motion.speed[i, -1] += BOUND.TOUCH_SPEED_MPS
            for stands in range(2):
                if (motion.rest[p] == STANDS) == (stands == 1) or motion.rest[p] == MAY_STOP:
                    how, there = approach(cell, path, motion, p, length, stands == 1)
                    if there:
                        worst = branch(cell, path, stack, motion, p, how, worst, out)
    return worst


@compiled(apart=True)
def go_on(cell: Cell, path: Path, motion: Motion) -> bool:
    """Advance ``path`` in place to the end of the present piece, for the worlds without an impact in this piece.

    Returns False if every world of the path has an impact in this piece.
    """
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
