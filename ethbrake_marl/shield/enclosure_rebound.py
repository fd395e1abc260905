"""Impacts of a box of worlds: how the two vehicles of an impact move on until the piece of time ends."""

from __future__ import annotations

import math

from ethbrake_marl.physics import Floats
from ethbrake_marl.physics.compiled import compiled_apart
from ethbrake_marl.shield.enclosure_contact import Approach, pressing
from ethbrake_marl.shield.enclosure_motion import (
    CLOSING,
    HARDEST,
    OPENING,
    REACH,
    SINCE,
    SOFTEST,
    SPREAD,
    WIDE,
    Cell,
    Motion,
    Path,
)
from ethbrake_marl.shield.enclosure_touch import (
    apart,
    begin_touch,
    common,
    creep,
    own_pulls,
    pressing_together,
    stray,
)
from ethbrake_marl.shield.forms import add, between, difference, high, low, positive_part, product, square


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
