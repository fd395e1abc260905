"""Affine arithmetic over a box of worlds, and the motion of single vehicles in the box.

An *affine form* represents a number that differs from world to world. An affine form is an array of W = K + 2 numbers
for ``c + g_1 e_1 + ... + g_K e_K + r e``: a centre c, one slope g_k for each of the K uncertain numbers of the box, and
a remainder r. ``e_k`` in [-1, 1] is the position of a world in the interval of uncertain number k; all affine forms use
the same ``e_k``. ``e`` in [-1, 1] is unknown, and each affine form has its own ``e``. In the difference of two affine
forms, parts that depend on the same ``e_k`` cancel. The difference of two plain intervals would be wider.

The result of every operation on affine forms encloses the exact result: for each world of the box, some value of ``e``
makes the form equal to the exact result. The operations ignore floating-point rounding; instead, the speeds and
distances are widened by ``ROUNDING`` once in each piece.

Letters for shapes: ``N`` vehicles, ``P = N - 1`` pairs, ``J`` pieces. An array without a stated shape is an affine form
[W]. Arguments that several functions share: ``i`` is the index of a vehicle, ``piece`` the index of a piece, from 0 to
J - 1, and ``length`` the duration of the piece, s.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.state import Bools, Floats, Ints


@compiled(apart=True)
def radius(x: Floats) -> float:
    """Return the largest distance of the values of ``x`` from its centre: the sum of the absolute slopes and the
    remainder.
    """
    whole: float = x[-1]
    for k in range(1, x.shape[0] - 1):
        whole += abs(x[k])
    return whole


@compiled(apart=True)
def low(x: Floats) -> float:
    """Return the smallest value of ``x`` in the box."""
    return float(x[0] - radius(x))


@compiled(apart=True)
def high(x: Floats) -> float:
    """Return the largest value of ``x`` in the box."""
    return float(x[0] + radius(x))


@compiled(apart=True)
def add(out: Floats, share: float, x: Floats) -> None:
    """Add ``share * x`` to ``out`` in place."""
    for k in range(x.shape[0] - 1):
        out[k] += share * x[k]
    out[-1] += abs(share) * x[-1]


@compiled(apart=True)
def difference(x: Floats, y: Floats) -> Floats:
    """Return ``x - y``."""
    out = x.copy()
    add(out, -1.0, y)
    return out


@compiled(apart=True)
def negative(x: Floats) -> Floats:
    """Return ``-x``."""
    return linear(x, -1.0, 0.0, 0.0)


@compiled(apart=True)
def between(least: float, most: float, width: int) -> Floats:
    """Return an affine form of ``width`` entries that encloses every number between ``least`` and ``most``."""
    out = np.zeros(width)
    out[0], out[-1] = 0.5 * (least + most), 0.5 * (most - least)
    return out


@compiled(apart=True)
def product(x: Floats, y: Floats) -> Floats:
    """Return an affine form that encloses ``x * y``. The remainder covers the second-order terms."""
    out = np.empty_like(x)
    for k in range(x.shape[0] - 1):
        out[k] = x[0] * y[k] + y[0] * x[k]
    out[0] = x[0] * y[0]
    out[-1] = abs(x[0]) * y[-1] + abs(y[0]) * x[-1] + radius(x) * radius(y)
    return out


@compiled(apart=True)
def square(x: Floats) -> Floats:
    """Return an affine form that encloses ``x * x``.

    The remainder is smaller than the remainder of ``product(x, x)``, because a square is never negative.
    """
    out = np.empty_like(x)
    for k in range(x.shape[0] - 1):
        out[k] = 2.0 * x[0] * x[k]
    half = 0.5 * radius(x) * radius(x)
    out[0] = x[0] * x[0] + half
    out[-1] = 2.0 * abs(x[0]) * x[-1] + half
    return out


@compiled(apart=True)
def linear(x: Floats, slope: float, start: float, error: float) -> Floats:
    """Return ``start + slope * x``, widened by ``error`` on both sides."""
    out = np.empty_like(x)
    for k in range(x.shape[0] - 1):
        out[k] = slope * x[k]
    out[0] += start
    out[-1] = abs(slope) * x[-1] + error
    return out


@compiled(apart=True)
def square_root(x: Floats) -> Floats:
    """Return an affine form that encloses the square root of ``x`` where ``x >= 0``. ``high(x)`` must be at least 0.

    In worlds with negative ``x`` the result has no meaning. On an interval [a, b] the square root lies between two
    parallel lines: its chord, with slope 1 / (sqrt(a) + sqrt(b)), and the tangent with this slope.
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
    """Return an affine form that encloses ``1 / x``. ``low(x)`` must be above 0.

    On an interval [a, b] the reciprocal lies between two parallel lines: its chord, with slope -1 / (a b), and the
    tangent with this slope.
    """
    least, most = low(x), high(x)
    slope = -1.0 / (least * most)
    chord = 1.0 / least + 1.0 / most
    error = 0.5 * (chord - 2.0 / math.sqrt(least * most))
    return linear(x, slope, chord - error, error)


@compiled(apart=True)
def positive_part(x: Floats) -> Floats:
    """Return an affine form that encloses ``max(x, 0)``.

    If ``x`` may have both signs, ``max(x, 0)`` lies between two parallel lines: the chord of this function and the line
    through the origin.
    """
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
    """Return an affine form that encloses ``x``, whose values are known to lie between ``least`` and ``most``.

    If less than half of the interval of ``x`` lies between ``least`` and ``most``, the result encloses every number of
    this interval that lies between the two limits. Otherwise the result is ``x`` itself.
    """
    inside_low, inside_high = max(low(x), least), min(high(x), most)
    if inside_high - inside_low < radius(x):
        return between(min(inside_low, inside_high), max(inside_low, inside_high), x.shape[0])
    return x


MOVES, MAY_STOP, STANDS = 0, 1, 2  # state of a vehicle in a piece

FREE, TOUCHES, PARTS = 0, 1, 2  # state of a pair; PARTS: in contact at the start of the piece, then separates

ROUNDING = 1e-12  # relative and absolute allowance for rounding in each piece, far above the engine's own rounding

# Columns of Path.touch, the state of a pair in contact.
# OPENING, CLOSING: largest speed at which the pair opens and closes (m/s). WIDE: largest gap (m).
# SOFTEST, HARDEST: smallest and largest closing acceleration (m/s2) since the commands press the pair together.
# SINCE: time since the commands press the pair together (s).
# CREEP: largest speed of the rear vehicle in worlds that creep (m/s); 0: no world creeps.
# SPREAD, REACH: largest difference of the two speeds (m/s) and largest gap (m) in the present piece.
OPENING, CLOSING, WIDE, SOFTEST, HARDEST, SINCE, CREEP, SPREAD, REACH = range(9)

TOUCH_WIDTH = 9


class Forces(NamedTuple):
    """Accelerations of every vehicle while brakes or engines build up gradually.

    On the second axis of an array, index 0 belongs to the time from the alert to the start of the first piece, and
    index j + 1 belongs to piece j. Impacts do not change the accelerations, so the arrays are the same for every
    sequence of impacts.
    """

    mean: Floats  # [N, J + 1, W] mean acceleration of the piece, m/s2
    rise: Floats  # [N, J + 1, W] change of speed in the piece, m/s
    gain: Floats  # [N, J + 1, W] distance in the piece beyond initial speed times length, m
    # [N, J + 1, 2] largest deviation from the mean (m/s2); index 0: the acceleration falls, index 1: it rises
    swing: Floats
    build: Bools  # [N] True where the vehicle's command builds up; the other arrays are 0 for all other vehicles


class Cell(NamedTuple):
    """A box as affine forms [W], and the vehicles' commands in each piece."""

    speed: Floats  # [N, W] speeds at the start of the first piece, m/s
    gap: Floats  # [P, W] gaps at the start of the first piece, m
    brake: Floats  # [N, W] braking capacities, m/s2
    drive: Floats  # [W] driving capacity of the shielded vehicle, m/s2
    # [P, 2, W] share of an impact's change of relative speed for the front (0) and rear (1) vehicle; their sum is 1
    share: Floats
    onset: Floats  # [N, W] time after the first decision at which a vehicle's command takes effect, s
    constant: Floats  # [N] command of each other vehicle, m/s2; NaN: full braking
    limit: Floats  # [N] speed limits, m/s
    vehicle: int  # index of the shielded vehicle
    restitution: float  # coefficient of restitution, 0 to 1
    times: Floats  # [J + 1] start of each piece and end of the last one, s after the first decision
    action: Floats  # [J] action of the shielded vehicle in each piece, -1 (full braking) to 1
    forces: Forces  # accelerations of vehicles whose command builds up
    moving: bool  # True if the command of any vehicle builds up


class Path(NamedTuple):
    """Those worlds of a box that had the same impacts and contacts so far, with their state at the start of the present
    piece.
    """

    forms: Floats  # [N + P + 1, W] affine forms of the speeds (m/s), the gaps (m) and the harm so far (m2/s2)
    # [P, TOUCH_WIDTH] state of each pair in contact (columns ``OPENING`` to ``REACH``); no meaning for other pairs.
    # For a pair in contact ``forms`` has the speed of its centre of mass twice; the gaps to its neighbours are measured
    # from this centre.
    touch: Floats
    # [2 P + 1] first P entries: 1 if the pair had an impact, else 0. Next P entries: FREE (not in contact), TOUCHES (in
    # contact) or PARTS (separates in the present piece). Last entry: index of the present piece
    marks: Ints


class Motion(NamedTuple):
    """Motion of each vehicle through one piece, as if the vehicle were alone on the road."""

    pull: Floats  # [N, W] acceleration by the command, m/s2
    onward: Floats  # [N, W] speed at the end under the command alone, m/s, as if the vehicle never stopped
    reach: Floats  # [N, W] distance under the command alone, m, as if the vehicle never stopped
    speed: Floats  # [N, W] speed at the end, m/s
    way: Floats  # [N, W] distance travelled, m
    rest: Ints  # [N] MOVES, MAY_STOP or STANDS
    vague: Floats  # [N] largest deviation of the acceleration from ``pull`` within the piece, m/s2


@compiled(apart=True)
def new_motion(N: int, width: int) -> Motion:
    """Return a ``Motion`` with all values 0, for affine forms of length ``width``."""
    return Motion(
        np.zeros((N, width)), np.zeros((N, width)), np.zeros((N, width)), np.zeros((N, width)), np.zeros((N, width)),
        np.zeros(N, np.int64), np.zeros(N),
    )  # fmt: skip


@compiled(apart=True)
def move_alone(cell: Cell, path: Path, piece: int, motion: Motion) -> None:
    """Write into ``motion`` how every vehicle moves through a piece under its own command, as if alone on the road."""
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
            # largest excess of a vehicle's speed over its affine form within the piece, for a vehicle in contact
            P, most = cell.gap.shape[0], 0.0
            for p in range(max(i - 1, 0), min(i + 1, P)):
                if path.marks[P + p] == TOUCHES:
                    touch = path.touch[p]
                    most += max(touch[OPENING], touch[CLOSING], 0.0) + 5.0 * touch[CREEP]
                    for k in range(p, p + 2):
                        most += length * (abs(motion.pull[k, 0]) + radius(motion.pull[k]) + motion.vague[k])
            fastest = high(speed) + length * (high(motion.pull[i]) + motion.vague[i]) + most
            if fastest > cell.limit[i]:
                # the speed limit may end the driving at any time: any acceleration from none to full is possible
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
    """Widen ``onward`` and ``reach`` of vehicle ``i`` in ``motion``, because brakes that release gradually may still
    hold the vehicle at rest.

    A vehicle that is held by gradually releasing brakes may stand until its acceleration is above 0. While the vehicle
    stands, the formulas give a negative speed -u. The true speed is larger than the computed speed by at most u. The
    true distance is larger than the computed distance by at most u times the duration of the piece. ``speed`` is the
    speed at the start of the piece, m/s.
    """
    least, most = low(motion.pull[i]) - motion.vague[i], high(motion.pull[i]) + motion.vague[i]
    slowest = low(speed) + least * length
    if least < 0.0 < most and slowest < 0.0:
        add(motion.onward[i], 1.0, between(0.0, -slowest, speed.shape[0]))
        add(motion.reach[i], length, between(0.0, -slowest, speed.shape[0]))


@compiled(apart=True)
def between_shifted(x: Floats, shift: float) -> Floats:
    """Return an affine form that encloses every number between ``x`` and ``x + shift``."""
    out = x.copy()
    add(out, 1.0, between(min(shift, 0.0), max(shift, 0.0), x.shape[0]))
    return out


@compiled(apart=True)
def command(cell: Cell, i: int, piece: int, motion: Motion) -> None:
    """Set ``motion.pull`` of vehicle ``i`` to the acceleration that it commands, or to 0 before its latency has
    elapsed.

    The function also sets ``motion.rest`` and ``motion.vague`` of vehicle ``i``.
    """
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
    """Set ``onward``, ``reach``, ``pull`` and ``vague`` of vehicle ``i`` in ``motion`` if its command may take effect
    after the start of the piece.
    """
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
    """Return the time (s, at least 0) for which the command of vehicle ``i`` has been in effect at ``time`` (s after
    the first decision).
    """
    since = negative(cell.onset[i])
    since[0] += time
    return positive_part(since)


@compiled(apart=True)
def stop(moving: bool, speed: Floats, i: int, length: float, motion: Motion) -> None:
    """Set ``rest``, ``speed`` and ``way`` in ``motion`` for a braking vehicle ``i`` that stops, or may stop, within a
    piece and then stays at rest.

    ``moving`` is ``Cell.moving``; ``speed`` is the speed at the start of the piece, m/s.
    """
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
    """Return the mean deceleration (m/s2) of a vehicle over any part of a piece.

    ``pull`` is the mean acceleration in the piece and ``vague`` the largest deviation from ``pull``, m/s2.
    """
    out = negative(pull)
    out[-1] += vague
    return out
