"""Motion of a whole box of worlds through one piece of time: each vehicle on its own, and pairs that stay in contact.

A *cell* is a box of worlds whose uncertain numbers are affine forms (``shield.forms``). A *path* is one way in which
impacts may follow each other in it: speeds and gaps of all worlds of the cell that go this way, as forms. Time runs in
*pieces*, between two neighbouring decisions or onsets, in which every command is constant.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.physics import Floats, Ints
from ethbrake_marl.physics.compiled import compiled_apart
from ethbrake_marl.shield.forms import (
    add,
    between,
    cut,
    difference,
    high,
    low,
    negative,
    positive_part,
    product,
    radius,
    reciprocal,
    square,
)

MOVES, MAY_STOP, STANDS = 0, 1, 2  # in this piece of time
FREE, TOUCHES, PARTS = 0, 1, 2  # what a pair does; the last: it was in contact when this piece of time began
ROUNDING = 1e-12  # of a number and of 1: added to the remainders in each piece of time, far above the engine's own
# columns of Path.touch, of a pair in contact: by how much it opens and closes at most (m/s), its largest gap (m), least
# and largest pressing acceleration (m/s2) since it is pressed together, and the time since then (s); the largest speed
# of the rear one in the worlds that creep (m/s, 0: none do); in this piece the largest difference of speeds, and gap
OPENING, CLOSING, WIDE, SOFTEST, HARDEST, SINCE, CREEP, SPREAD, REACH = range(9)
TOUCH_WIDTH = 9


class Cell(NamedTuple):
    """A box of worlds of one line, what is commanded in it, and the pieces of time."""

    speed: Floats  # [N, W] at the first piece
    gap: Floats  # [P, W]
    brake: Floats  # [N, W] capacities
    drive: Floats  # [W] of the shielded vehicle
    share: Floats  # [P, 2, W] of a pair's change of relative speed that is the front's, and the rear's; together 1
    onset: Floats  # [N, W] of the other vehicles' commands, s after the first decision
    constant: Floats  # [N] command of each other vehicle; NaN: full braking
    limit: Floats  # [N] speed limits
    vehicle: int
    restitution: float
    times: Floats  # [J + 1] s after the first decision
    action: Floats  # [J] of the shielded vehicle


class Path(NamedTuple):
    """Worlds of a cell that have gone one way so far."""

    forms: Floats  # [N + P + 1, W] speeds, gaps, harm so far
    # [P, TOUCH_WIDTH] of pairs in contact, else meaningless. Their two speeds are that of their common centre of mass,
    # from which their neighbours' gaps are counted
    touch: Floats
    marks: Ints  # [2 P + 1] 1 where the pair had an impact; FREE, TOUCHES or PARTS; number of the piece of time


class Motion(NamedTuple):
    """Each vehicle on its own through one piece of time: filled by ``move_alone``."""

    pull: Floats  # [N, W] acceleration of its command
    onward: Floats  # [N, W] speed at the end if nothing but the command acted, not even standstill
    reach: Floats  # [N, W] way likewise
    speed: Floats  # [N, W] speed at the end
    way: Floats  # [N, W]
    rest: Ints  # [N] MOVES, MAY_STOP or STANDS
    vague: Floats  # [N] by how much its acceleration may differ from ``pull`` within the piece


@compiled_apart
def new_motion(N: int, width: int) -> Motion:
    """Room for ``move_alone``."""
    return Motion(
        np.zeros((N, width)), np.zeros((N, width)), np.zeros((N, width)), np.zeros((N, width)), np.zeros((N, width)),
        np.zeros(N, np.int64), np.zeros(N),
    )  # fmt: skip


@compiled_apart
def move_alone(cell: Cell, path: Path, piece: int, motion: Motion) -> None:
    """Every vehicle through one piece of time under its command, as if it were alone."""
    for i in range(cell.speed.shape[0]):
        command(cell, i, piece, motion)
    for i in range(cell.speed.shape[0]):
        speed, length = path.forms[i], cell.times[piece + 1] - cell.times[piece]
        drift(cell, speed, i, piece, motion)
        if high(motion.pull[i]) + motion.vague[i] > 0.0:
            fastest = high(speed) + length * high(motion.pull[i]) + beside(cell, path, motion, i, length)
            if fastest > cell.limit[i]:
                stop_driving(i, length, motion)
        motion.onward[i, -1] += ROUNDING * (1.0 + abs(motion.onward[i, 0]))
        motion.reach[i, -1] += ROUNDING * (1.0 + abs(motion.reach[i, 0]))
        motion.speed[i], motion.way[i] = motion.onward[i], motion.reach[i]
        if _stands(speed) and high(motion.pull[i]) + motion.vague[i] <= 0.0:
            motion.rest[i] = STANDS
            motion.speed[i], motion.way[i] = 0.0, 0.0
        elif low(motion.onward[i]) < 0.0 and low(motion.pull[i]) - motion.vague[i] < 0.0:
            stop(speed, i, length, motion)


@compiled_apart
def beside(cell: Cell, path: Path, motion: Motion, i: int, length: float) -> float:
    """By how much a vehicle in contact with another one may be faster than its form within the piece."""
    P, most = cell.gap.shape[0], 0.0
    for p in range(max(i - 1, 0), min(i + 1, P)):
        if path.marks[P + p] == TOUCHES:
            touch = path.touch[p]
            most += max(touch[OPENING], touch[CLOSING], 0.0) + 5.0 * touch[CREEP]
            for k in range(p, p + 2):
                most += length * (abs(motion.pull[k, 0]) + radius(motion.pull[k]) + motion.vague[k])
    return most


@compiled_apart
def stop_driving(i: int, length: float, motion: Motion) -> None:
    """The speed limit may end a vehicle's drive anywhere within the piece: it gives any part of it then."""
    drive = high(motion.pull[i]) + motion.vague[i]
    motion.onward[i] = between_shifted(motion.onward[i], -length * drive)
    motion.reach[i] = between_shifted(motion.reach[i], -0.5 * length * length * drive)
    motion.vague[i] = 0.5 * drive
    motion.pull[i] = between(0.5 * drive, 0.5 * drive, motion.pull.shape[1])


@compiled_apart
def between_shifted(x: Floats, shift: float) -> Floats:
    """A number between what ``x`` stands for and that plus ``shift``."""
    out = x.copy()
    add(out, 1.0, between(min(shift, 0.0), max(shift, 0.0), x.shape[0]))
    return out


@compiled_apart
def _stands(speed: Floats) -> bool:
    return speed[0] == 0.0 and radius(speed) == 0.0


@compiled_apart
def command(cell: Cell, i: int, piece: int, motion: Motion) -> None:
    """``pull`` of vehicle ``i``, 0 before its latency has elapsed."""
    pull = motion.pull[i]
    pull[:] = 0.0
    motion.rest[i], motion.vague[i] = MOVES, 0.0
    if i == cell.vehicle:
        action = cell.action[piece]
        if action < 0.0:
            add(pull, action, cell.brake[i])
        elif action > 0.0:
            add(pull, action, cell.drive)
    elif high(cell.onset[i]) <= cell.times[piece] or low(cell.onset[i]) < cell.times[piece + 1]:
        if math.isnan(cell.constant[i]):
            add(pull, -1.0, cell.brake[i])
        else:
            pull[0] = cell.constant[i]


@compiled_apart
def drift(cell: Cell, speed: Floats, i: int, piece: int, motion: Motion) -> None:
    """``onward`` and ``reach`` of vehicle ``i``."""
    onward, reach, pull = motion.onward[i], motion.reach[i], motion.pull[i]
    length = cell.times[piece + 1] - cell.times[piece]
    onward[:], reach[:] = speed, 0.0
    add(reach, length, speed)
    if i != cell.vehicle and high(cell.onset[i]) > cell.times[piece]:
        begin_later(cell, i, piece, motion)
    else:
        add(onward, length, pull)
        add(reach, 0.5 * length * length, pull)


@compiled_apart
def begin_later(cell: Cell, i: int, piece: int, motion: Motion) -> None:
    """``onward`` and ``reach`` of a vehicle whose command begins somewhere within this piece, or after it."""
    pull = motion.pull[i]
    if pull[0] == 0.0 and radius(pull) == 0.0:
        return
    acting = cut(
        difference(_since(cell, i, cell.times[piece + 1]), _since(cell, i, cell.times[piece])),
        0.0,
        cell.times[piece + 1] - cell.times[piece],
    )
    add(motion.onward[i], 1.0, product(pull, acting))
    add(motion.reach[i], 0.5, product(pull, square(acting)))
    least, most = min(low(pull), 0.0), max(high(pull), 0.0)
    motion.vague[i] = 0.5 * (most - least)
    pull[:] = between(0.5 * (least + most), 0.5 * (least + most), pull.shape[0])


@compiled_apart
def _since(cell: Cell, i: int, time: float) -> Floats:
    """How long a command has acted at a time, s."""
    since = negative(cell.onset[i])
    since[0] += time
    return positive_part(since)


@compiled_apart
def stop(speed: Floats, i: int, length: float, motion: Motion) -> None:
    """A braking vehicle that stops in this piece, or may: it stands from then on."""
    pull, vague, width = motion.pull[i], motion.vague[i], speed.shape[0]
    beyond = negative(motion.onward[i])
    least, most = max(low(beyond), 0.0), max(high(beyond), 0.0)
    motion.rest[i] = MAY_STOP
    motion.speed[i] = positive_part(motion.onward[i])
    if vague > 0.0 or not high(pull) < 0.0:
        fastest = max(high(speed), 0.0) + max(high(pull) + vague, 0.0) * length
        motion.way[i] = between(0.0, fastest * length, width)
    elif least > 0.0:
        add(motion.way[i], 0.5, product(square(beyond), reciprocal(negative(pull))))
    else:
        add(motion.way[i], 1.0, between(0.0, 0.5 * most * most / -high(pull), width))
