"""First contacts in a box of worlds: when, and at which closing speed, a pair of vehicles may come into contact.

Each function considers one piece. A *path* is a set of worlds with the same impacts so far (``affine.Path``). The
affine forms of a path may also enclose states of worlds with other impacts. The results of the functions are correct
for the worlds that really have the impacts of the path.

Arguments that several functions share: ``p`` is the index of the pair (vehicle ``p`` in front, vehicle ``p + 1``
behind), ``motion`` the motion of all vehicles in the piece (``affine.Motion``), and ``length`` the duration of the
piece, s.
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

NEVER = 1e-9  # no contact is possible above this gap (m), or below minus this squared closing speed (m2/s2)

SLOWEST = 0.05  # below this mean closing speed (m/s) an impact is assumed possible at any time of the piece


class Approach(NamedTuple):
    """Time and closing speed at which a pair may come into contact within one piece, as affine forms [W] (module
    ``affine``).
    """

    closing: Floats  # [W] closing speed at the start of the piece, m/s
    squared: Floats  # [W] squared closing speed at contact, m2/s2
    time: Floats  # [W] time of contact, s after the start of the piece
    front_stands: bool  # True if the front vehicle stands at contact


@compiled(apart=True)
def noise(cell: Cell, path: Path, p: int, of_gap: bool) -> float:
    """Return the largest change that bounces of the neighbouring pairs can cause in pair ``p``: the change of its gap
    (m) if ``of_gap`` is True, otherwise the change of its relative speed (m/s).
    """
    P, most = cell.gap.shape[0], 0.0
    if p > 0 and path.marks[P + p - 1] != FREE:
        most += high(cell.share[p - 1, 1]) * path.touch[p - 1, REACH] if of_gap else blur(cell, path, p - 1, 1)
    if p < P - 1 and path.marks[P + p + 1] != FREE:
        most += high(cell.share[p + 1, 0]) * path.touch[p + 1, REACH] if of_gap else blur(cell, path, p + 1, 0)
    return most


@compiled(apart=True)
def pressing(motion: Motion, p: int) -> tuple[float, float]:
    """Return the smallest and the largest closing acceleration of pair ``p`` in a piece, m/s2.

    Both accelerations are also correct if a vehicle stops within the piece.
    """
    front_low, front_high = low(motion.pull[p]) - motion.vague[p], high(motion.pull[p]) + motion.vague[p]
    rear_low, rear_high = low(motion.pull[p + 1]) - motion.vague[p + 1], high(motion.pull[p + 1]) + motion.vague[p + 1]
    if motion.rest[p] != MOVES:
        front_low, front_high = min(front_low, 0.0), max(front_high, 0.0)
    if motion.rest[p + 1] != MOVES:
        rear_low, rear_high = min(rear_low, 0.0), max(rear_high, 0.0)
    return rear_low - front_high, rear_high - front_low


@compiled(apart=True)
def may_meet(cell: Cell, path: Path, motion: Motion, p: int, length: float) -> bool:
    """Return whether pair ``p`` may come into contact within this piece at a time when its gap is closing."""
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
    """Return the closing speed and the time of a contact of pair ``p`` in this piece, and whether such a contact is
    possible.

    Let w be the present closing speed, b the closing acceleration and g the gap. The square of the closing speed w' at
    the contact is then ``w^2 + 2 b g``, and the contact comes after the time ``2 g / (w + w')``. If the front vehicle
    stops before the contact, g includes the stopping distance of the front vehicle.

    If ``front_stands`` is True, the result is for the worlds in which the front vehicle is at rest at the contact;
    otherwise for the worlds in which it moves.
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
    if vague > 0.0:  # the gap may first open, then close again
        opening = max(-low(closing), 0.0) + length * (vague + radius(press) + abs(press[0]))
        if cell.moving:
            opening = max(length * max(vague - low(press), 0.0) - low(closing), 0.0)
        squared[-1] += 2.0 * vague * (max(high(gap), 0.0) + 2.0 * length * opening)
    squared[-1] += NEVER
    there = high(squared) > BOUND.TOUCH_SPEED_MPS * BOUND.TOUCH_SPEED_MPS
    if slack > 0.0:  # bounces of neighbouring pairs may change the closing speed at contact
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
    if cell.moving:  # twice the deviation of the mean closing speed from the mean of both ends
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
    """Return the stopping distance (m) of a vehicle that stops within a piece, as an affine form [W].

    ``moving`` is ``Cell.moving``. ``speed`` [W] is the speed at the start of the piece (m/s), ``pull`` [W] the mean
    acceleration in the piece, and ``vague`` the largest deviation from ``pull`` (m/s2).
    """
    if not high(pull) + vague < 0.0 or (vague > 0.0 and not moving):
        fastest = max(high(speed), 0.0) + max(high(pull) + vague, 0.0) * length
        return between(0.0, fastest * length, speed.shape[0])
    way = product(square(speed), reciprocal(deceleration(pull, vague)))
    way *= 0.5
    return way
