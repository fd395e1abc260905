"""Impacts of a box of worlds within one piece of time, and pairs that stay in contact.

What is said here of "the worlds" of a path holds for all that really go that way; others may be among them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from ethbrake_marl.extensions.certified.affine import (
    FREE,
    MAY_STOP,
    MOVES,
    REACH,
    STANDS,
    Cell,
    Motion,
    Path,
    add,
    between,
    cut,
    deceleration,
    difference,
    high,
    low,
    product,
    radius,
    reciprocal,
    square,
    square_root,
)
from ethbrake_marl.extensions.certified.touching import blur
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.motion import BOUND
from ethbrake_marl.physics.state import Floats

NEVER = 1e-9  # a gap (m) above this, or a squared closing speed (m2/s2) below minus this: certainly no contact

SLOWEST = 0.05  # mean closing speed (m/s) below which the time of an impact is any within the piece


class Approach(NamedTuple):
    """How a pair may meet within a piece of time."""

    closing: Floats  # [W] at its start
    squared: Floats  # [W] closing speed at contact, squared
    time: Floats  # [W] of contact, s after the start of the piece
    front_stands: bool  # at contact


@compiled(apart=True)
def noise(cell: Cell, path: Path, p: int, of_gap: bool) -> float:
    """By how much speeds (or gap) of a pair may differ in this piece because a neighbouring pair is in contact."""
    P, most = cell.gap.shape[0], 0.0
    if p > 0 and path.marks[P + p - 1] != FREE:
        most += high(cell.share[p - 1, 1]) * path.touch[p - 1, REACH] if of_gap else blur(cell, path, p - 1, 1)
    if p < P - 1 and path.marks[P + p + 1] != FREE:
        most += high(cell.share[p + 1, 0]) * path.touch[p + 1, REACH] if of_gap else blur(cell, path, p + 1, 0)
    return most


@compiled(apart=True)
def pressing(motion: Motion, p: int) -> tuple[float, float]:
    """Least and largest closing acceleration of a pair within the piece, whether or not one of them stops."""
    front_low, front_high = low(motion.pull[p]) - motion.vague[p], high(motion.pull[p]) + motion.vague[p]
    rear_low, rear_high = low(motion.pull[p + 1]) - motion.vague[p + 1], high(motion.pull[p + 1]) + motion.vague[p + 1]
    if motion.rest[p] != MOVES:
        front_low, front_high = min(front_low, 0.0), max(front_high, 0.0)
    if motion.rest[p + 1] != MOVES:
        rear_low, rear_high = min(rear_low, 0.0), max(rear_high, 0.0)
    return rear_low - front_high, rear_high - front_low


@compiled(apart=True)
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


@compiled(apart=True)
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
            way = _stopping_way(cell.moving, path.forms[p], motion.pull[p], motion.vague[p], length)
            add(gap, 1.0, cut(way, 0.0, math.inf))
    else:
        add(closing, -1.0, path.forms[p])
        if motion.rest[p] != STANDS:
            add(press, -1.0, motion.pull[p])
    squared = square(closing)
    add(squared, 2.0, product(press, gap))
    if vague > 0.0:  # the way there and back
        opening = max(-low(closing), 0.0) + length * (vague + radius(press) + abs(press[0]))
        if cell.moving:
            opening = max(length * max(vague - low(press), 0.0) - low(closing), 0.0)
        squared[-1] += 2.0 * vague * (max(high(gap), 0.0) + 2.0 * length * opening)
    squared[-1] += NEVER
    there = high(squared) > BOUND.TOUCH_SPEED_MPS * BOUND.TOUCH_SPEED_MPS
    if slack > 0.0:  # at contact
        least = math.sqrt(max(low(squared), 0.0)) - slack
        rough = square_root(cut(squared, 0.0, math.inf))
        rough[-1] += slack
        squared = square(cut(rough, max(least, 0.0), math.inf))
        closing[-1] += slack
    fastest = max(high(closing), 0.0) + (max(high(press), 0.0) + vague) * length
    squared = cut(squared, 0.0, fastest * fastest + NEVER)
    if not there or fastest <= BOUND.TOUCH_SPEED_MPS:
        return Approach(closing, squared, gap, front_stands), False
    speed = square_root(squared)
    time, whole = between(0.0, length, width), closing.copy()
    add(whole, 1.0, speed)
    if cell.moving:  # twice by how much its mean differs from that of both ends
        whole[-1] += 0.5 * vague * length
    if low(whole) > SLOWEST and (vague == 0.0 or cell.moving) and slack == 0.0:
        time = product(gap, reciprocal(whole))
        time *= 2.0
        if low(time) > length + NEVER or high(time) < -NEVER:
            return Approach(closing, squared, time, front_stands), False
        time = cut(time, 0.0, length)
    return Approach(closing, squared, time, front_stands), True


@compiled(apart=True)
def _stopping_way(moving: bool, speed: Floats, pull: Floats, vague: float, length: float) -> Floats:
    """Way of a braking vehicle until it stands, which it does within the piece."""
    if not high(pull) + vague < 0.0 or (vague > 0.0 and not moving):
        fastest = max(high(speed), 0.0) + max(high(pull) + vague, 0.0) * length
        return between(0.0, fastest * length, speed.shape[0])
    way = product(square(speed), reciprocal(deceleration(pull, vague)))
    way *= 0.5
    return way
