"""Affine forms: numbers that depend on where in a box a world lies, with a bound on what is not linear in it.

A form [W] of a box with K uncertain numbers, W = K + 2, stands for ``c + g_1 e_1 + ... + g_K e_K + r e``: the centre,
one slope for each uncertain number, and a remainder. ``e_k`` in [-1, 1] says where in the box the world lies, the
same in every form; ``e`` in [-1, 1] is any, another one in every form. What two forms share in ``e_k`` cancels when
they are subtracted, which plain intervals cannot do.

Each operation encloses: for every world of the box there are values of ``e`` for which the result stands for what the
operation makes of the operands. Rounding is not part of an operation; ``shield.enclosure`` adds it (``ROUNDING``).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.state import Bools, Floats, Ints


@compiled(apart=True)
def radius(x: Floats) -> float:
    """Largest distance from the centre."""
    whole: float = x[-1]
    for k in range(1, x.shape[0] - 1):
        whole += abs(x[k])
    return whole


@compiled(apart=True)
def low(x: Floats) -> float:
    """Least value."""
    return float(x[0] - radius(x))


@compiled(apart=True)
def high(x: Floats) -> float:
    """Largest value."""
    return float(x[0] + radius(x))


@compiled(apart=True)
def add(out: Floats, share: float, x: Floats) -> None:
    """``out += share * x``; exact but for rounding."""
    for k in range(x.shape[0] - 1):
        out[k] += share * x[k]
    out[-1] += abs(share) * x[-1]


@compiled(apart=True)
def difference(x: Floats, y: Floats) -> Floats:
    """``x - y``."""
    out = x.copy()
    add(out, -1.0, y)
    return out


@compiled(apart=True)
def negative(x: Floats) -> Floats:
    """``-x``."""
    return linear(x, -1.0, 0.0, 0.0)


@compiled(apart=True)
def between(least: float, most: float, width: int) -> Floats:
    """The form [width] of any number in an interval."""
    out = np.zeros(width)
    out[0], out[-1] = 0.5 * (least + most), 0.5 * (most - least)
    return out


@compiled(apart=True)
def product(x: Floats, y: Floats) -> Floats:
    """``x * y``: what is of second order goes to the remainder."""
    out = np.empty_like(x)
    for k in range(x.shape[0] - 1):
        out[k] = x[0] * y[k] + y[0] * x[k]
    out[0] = x[0] * y[0]
    out[-1] = abs(x[0]) * y[-1] + abs(y[0]) * x[-1] + radius(x) * radius(y)
    return out


@compiled(apart=True)
def square(x: Floats) -> Floats:
    """``x * x``: its part of second order is at least 0, which halves the remainder."""
    out = np.empty_like(x)
    for k in range(x.shape[0] - 1):
        out[k] = 2.0 * x[0] * x[k]
    half = 0.5 * radius(x) * radius(x)
    out[0] = x[0] * x[0] + half
    out[-1] = 2.0 * abs(x[0]) * x[-1] + half
    return out


@compiled(apart=True)
def linear(x: Floats, slope: float, start: float, error: float) -> Floats:
    """``start + slope * x``, and an error of at most ``error`` on either side."""
    out = np.empty_like(x)
    for k in range(x.shape[0] - 1):
        out[k] = slope * x[k]
    out[0] += start
    out[-1] = abs(slope) * x[-1] + error
    return out


@compiled(apart=True)
def square_root(x: Floats) -> Floats:
    """Square root wherever ``x >= 0``; nothing is said where it is below. ``high(x) >= 0``.

    On [a, b] the root lies between its chord, of slope 1 / (sqrt a + sqrt b), and the parallel tangent.
    """
    least, most = math.sqrt(max(low(x), 0.0)), math.sqrt(high(x))
    if most <= 0.0:
        return np.zeros_like(x)
    slope = 1.0 / (least + most)
    start = least - slope * least * least
    error = 0.5 * (0.25 / slope - start)
    return linear(x, slope, start + error, error)


@compiled(apart=True)
def reciprocal(x: Floats) -> Floats:
    """``1 / x`` for ``low(x) > 0``: between the chord, of slope -1 / (a b), and the parallel tangent."""
    least, most = low(x), high(x)
    slope = -1.0 / (least * most)
    chord = 1.0 / least + 1.0 / most
    error = 0.5 * (chord - 2.0 / math.sqrt(least * most))
    return linear(x, slope, chord - error, error)


@compiled(apart=True)
def positive_part(x: Floats) -> Floats:
    """``max(x, 0)``: between its chord and the parallel line through 0."""
    least, most = low(x), high(x)
    if least >= 0.0:
        return x.copy()
    if most <= 0.0:
        return np.zeros_like(x)
    slope = most / (most - least)
    error = -0.5 * slope * least
    return linear(x, slope, error, error)


@compiled(apart=True)
def cut(x: Floats, least: float, most: float) -> Floats:
    """A form of the same number, known to lie in an interval: that interval where it says more than the form."""
    inside_low, inside_high = max(low(x), least), min(high(x), most)
    if inside_high - inside_low < radius(x):
        return between(min(inside_low, inside_high), max(inside_low, inside_high), x.shape[0])
    return x


MOVES, MAY_STOP, STANDS = 0, 1, 2  # in this piece of time

FREE, TOUCHES, PARTS = 0, 1, 2  # what a pair does; the last: it was in contact when this piece of time began

ROUNDING = 1e-12  # of a number and of 1: added to the remainders in each piece of time, far above the engine's own

# columns of Path.touch, of a pair in contact: by how much it opens and closes at most (m/s), its largest gap (m), least
# and largest pressing acceleration (m/s2) since it is pressed together, and the time since then (s); the largest speed
# of the rear one in the worlds that creep (m/s, 0: none do); in this piece the largest difference of speeds, and gap
OPENING, CLOSING, WIDE, SOFTEST, HARDEST, SINCE, CREEP, SPREAD, REACH = range(9)

TOUCH_WIDTH = 9


class Forces(NamedTuple):
    """Accelerations that brakes and engines call for where these build up: in ``late``, and then in piece after piece.

    Impacts do not change them, so they are the same on every path.
    """

    mean: Floats  # [N, J + 1, W] over the piece
    rise: Floats  # [N, J + 1, W] of the speed in the piece
    gain: Floats  # [N, J + 1, W] of the way, beyond what the speed at its start gives
    swing: Floats  # [N, J + 1, 2] by how much it may differ from the mean within the piece as it falls, and as it rises
    build: Bools  # [N] whether the vehicle's command builds up; of the other vehicles nothing is said here


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
    forces: Forces
    moving: bool  # whether some vehicle's command builds up


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


@compiled(apart=True)
def new_motion(N: int, width: int) -> Motion:
    """Room for ``move_alone``."""
    return Motion(
        np.zeros((N, width)), np.zeros((N, width)), np.zeros((N, width)), np.zeros((N, width)), np.zeros((N, width)),
        np.zeros(N, np.int64), np.zeros(N),
    )  # fmt: skip


@compiled(apart=True)
def move_alone(cell: Cell, path: Path, piece: int, motion: Motion) -> None:
    """Every vehicle through one piece of time under its command, as if it were alone."""
    for i in range(cell.speed.shape[0]):
        command(cell, i, piece, motion)
    for i in range(cell.speed.shape[0]):
        speed, length = path.forms[i], cell.times[piece + 1] - cell.times[piece]
        onward, reach, pull = motion.onward[i], motion.reach[i], motion.pull[i]
        onward[:], reach[:] = speed, 0.0
        add(reach, length, speed)
        if i != cell.vehicle and high(cell.onset[i]) > cell.times[piece] and not cell.forces.build[i]:
            begin_later(cell, i, piece, motion)
        elif cell.forces.build[i]:
            add(onward, 1.0, cell.forces.rise[i, piece + 1])
            add(reach, 1.0, cell.forces.gain[i, piece + 1])
        else:
            add(onward, length, pull)
            add(reach, 0.5 * length * length, pull)
        if high(motion.pull[i]) + motion.vague[i] > 0.0:
            # by how much a vehicle in contact with another one may be faster than its form within the piece
            P, most = cell.gap.shape[0], 0.0
            for p in range(max(i - 1, 0), min(i + 1, P)):
                if path.marks[P + p] == TOUCHES:
                    touch = path.touch[p]
                    most += max(touch[OPENING], touch[CLOSING], 0.0) + 5.0 * touch[CREEP]
                    for k in range(p, p + 2):
                        most += length * (abs(motion.pull[k, 0]) + radius(motion.pull[k]) + motion.vague[k])
            fastest = high(speed) + length * (high(motion.pull[i]) + motion.vague[i]) + most
            if fastest > cell.limit[i]:
                # the speed limit may end its drive anywhere within the piece: it gives any part of it then
                drive, least = high(motion.pull[i]) + motion.vague[i], min(low(motion.pull[i]) - motion.vague[i], 0.0)
                motion.onward[i] = between_shifted(motion.onward[i], -length * drive)
                motion.reach[i] = between_shifted(motion.reach[i], -0.5 * length * length * drive)
                motion.vague[i] = 0.5 * (drive - least)
                motion.pull[i] = between(0.5 * (drive + least), 0.5 * (drive + least), motion.pull.shape[1])
        if cell.moving:
            hold(speed, i, length, motion)
        motion.onward[i, -1] += ROUNDING * (1.0 + abs(motion.onward[i, 0]))
        motion.reach[i, -1] += ROUNDING * (1.0 + abs(motion.reach[i, 0]))
        motion.speed[i], motion.way[i] = motion.onward[i], motion.reach[i]
        if speed[0] == 0.0 and radius(speed) == 0.0 and high(motion.pull[i]) + motion.vague[i] <= 0.0:
            motion.rest[i] = STANDS
            motion.speed[i], motion.way[i] = 0.0, 0.0
        elif low(motion.onward[i]) < 0.0 and low(motion.pull[i]) - motion.vague[i] < 0.0:
            stop(cell.moving, speed, i, length, motion)


@compiled(apart=True)
def hold(speed: Floats, i: int, length: float, motion: Motion) -> None:
    """A vehicle that may stand while its brakes are released in this piece: they hold it until its force is above 0.

    By as much as it would have been below 0 it is then faster, and further on.
    """
    least, most = low(motion.pull[i]) - motion.vague[i], high(motion.pull[i]) + motion.vague[i]
    slowest = low(speed) + least * length
    if least < 0.0 < most and slowest < 0.0:
        add(motion.onward[i], 1.0, between(0.0, -slowest, speed.shape[0]))
        add(motion.reach[i], length, between(0.0, -slowest, speed.shape[0]))


@compiled(apart=True)
def between_shifted(x: Floats, shift: float) -> Floats:
    """A number between what ``x`` stands for and that plus ``shift``."""
    out = x.copy()
    add(out, 1.0, between(min(shift, 0.0), max(shift, 0.0), x.shape[0]))
    return out


@compiled(apart=True)
def command(cell: Cell, i: int, piece: int, motion: Motion) -> None:
    """``pull`` of vehicle ``i``, 0 before its latency has elapsed."""
    pull = motion.pull[i]
    pull[:] = 0.0
    motion.rest[i], motion.vague[i] = MOVES, 0.0
    if cell.forces.build[i]:
        pull[:], motion.vague[i] = cell.forces.mean[i, piece + 1], cell.forces.swing[i, piece + 1].max()
    elif i == cell.vehicle:
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


@compiled(apart=True)
def begin_later(cell: Cell, i: int, piece: int, motion: Motion) -> None:
    """``onward`` and ``reach`` of a vehicle whose command begins somewhere within this piece, or after it."""
    pull = motion.pull[i]
    if pull[0] == 0.0 and radius(pull) == 0.0:
        return
    acting = cut(
        difference(since(cell, i, cell.times[piece + 1]), since(cell, i, cell.times[piece])),
        0.0,
        cell.times[piece + 1] - cell.times[piece],
    )
    add(motion.onward[i], 1.0, product(pull, acting))
    add(motion.reach[i], 0.5, product(pull, square(acting)))
    least, most = min(low(pull), 0.0), max(high(pull), 0.0)
    motion.vague[i] = 0.5 * (most - least)
    pull[:] = between(0.5 * (least + most), 0.5 * (least + most), pull.shape[0])


@compiled(apart=True)
def since(cell: Cell, i: int, time: float) -> Floats:
    """How long a command has acted at a time, s."""
    since = negative(cell.onset[i])
    since[0] += time
    return positive_part(since)


@compiled(apart=True)
def stop(moving: bool, speed: Floats, i: int, length: float, motion: Motion) -> None:
    """A braking vehicle that stops in this piece, or may: it stands from then on."""
    pull, vague, width = motion.pull[i], motion.vague[i], speed.shape[0]
    beyond = negative(motion.onward[i])
    least, most = max(low(beyond), 0.0), max(high(beyond), 0.0)
    motion.rest[i] = MAY_STOP
    motion.speed[i] = positive_part(motion.onward[i])
    if not high(pull) + vague < 0.0 or (vague > 0.0 and not moving):
        fastest = max(high(speed), 0.0) + max(high(pull) + vague, 0.0) * length
        motion.way[i] = between(0.0, fastest * length, width)
    elif least > 0.0:
        add(motion.way[i], 0.5, product(square(beyond), reciprocal(deceleration(pull, vague))))
    else:
        add(motion.way[i], 1.0, between(0.0, 0.5 * most * most / -(high(pull) + vague), width))


@compiled(apart=True)
def deceleration(pull: Floats, vague: float) -> Floats:
    """Mean deceleration along any part of a way, of a vehicle whose acceleration differs from ``pull`` by ``vague``."""
    out = negative(pull)
    out[-1] += vague
    return out
