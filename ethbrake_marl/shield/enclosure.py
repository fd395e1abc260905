"""Motion of a whole box of worlds through one piece of time: each vehicle on its own, and pairs that stay in contact.

A *cell* is a box of worlds whose uncertain numbers are affine forms. A *path* is one way in which
impacts may follow each other in it: speeds and gaps of all worlds of the cell that go this way, as forms. Time runs in
*pieces*, between two neighbouring decisions or onsets, in which every command is constant.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.engine import Script
from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.physics import BOUND, Bools, Floats, Ints, Worlds, compiled
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.search import ProfileProblem

# Affine forms: numbers that depend on where in a box a world lies, with a bound on what is not linear in it.
#
# A form [W] of a box with K uncertain numbers, W = K + 2, stands for ``c + g_1 e_1 + ... + g_K e_K + r e``: the centre,
# one slope for each uncertain number, and a remainder. ``e_k`` in [-1, 1] says where in the box the world lies, the
# same in every form; ``e`` in [-1, 1] is any, another one in every form. What two forms share in ``e_k`` cancels when
# they are subtracted, which plain intervals cannot do.
#
# Each operation encloses: for every world of the box there are values of ``e`` for which the result stands for what the
# operation makes of the operands. Rounding is not part of an operation; ``shield.enclosure`` adds it (``ROUNDING``).


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
        difference(_since(cell, i, cell.times[piece + 1]), _since(cell, i, cell.times[piece])),
        0.0,
        cell.times[piece + 1] - cell.times[piece],
    )
    add(motion.onward[i], 1.0, product(pull, acting))
    add(motion.reach[i], 0.5, product(pull, square(acting)))
    least, most = min(low(pull), 0.0), max(high(pull), 0.0)
    motion.vague[i] = 0.5 * (most - least)
    pull[:] = between(0.5 * (least + most), 0.5 * (least + most), pull.shape[0])


@compiled(apart=True)
def _since(cell: Cell, i: int, time: float) -> Floats:
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


# Pairs of a box of worlds that stay in contact: they bounce a little, then move as one, then part.
#
# A pair in contact is told by the motion of its centre of mass, as forms, and by bounds on how far the two are from it.
# While both of them move forward, their commands are the only forces on the pair, so its centre of mass moves by the
# commands alone, however often the two collide. A world *creeps* once one of the two stands or moves backwards: its
# brakes then hold instead of pulling, and nothing but bounds on its speeds is known of it.

SHARP = 0.1  # m/s: a pair that opens moves alone once its speeds are known to this
UNEVEN = 3.0  # times its separating speed: more than a flight may close with is not bounded by flights, if forces move


@compiled(apart=True)
def common(cell: Cell, p: int, front: Floats, rear: Floats) -> Floats:
    """Of two quantities of a pair, that of its centre of mass."""
    out = product(cell.share[p, 1], front)
    add(out, 1.0, product(cell.share[p, 0], rear))
    return out


@compiled(apart=True)
def pressing_together(motion: Motion, p: int) -> tuple[float, float]:
    """Least and largest closing acceleration of a pair whose commands act on both."""
    vague = motion.vague[p] + motion.vague[p + 1]
    least = low(motion.pull[p + 1]) - high(motion.pull[p]) - vague
    return least, high(motion.pull[p + 1]) - low(motion.pull[p]) + vague


@compiled(apart=True)
def apart(touch: Floats) -> float:
    """Largest difference of speeds of a pair in contact."""
    return float(max(touch[OPENING], touch[CLOSING], 0.0))


@compiled(apart=True)
def faster(cell: Cell, p: int) -> float:
    """How many times the rear one's speed its impacts may give the front one, at least 1."""
    return float(max(1.0, (1.0 + cell.restitution) * high(cell.share[p, 0])))


@compiled(apart=True)
def backwards(cell: Cell, p: int) -> float:
    """How many times its speed the rear one may have backwards after an impact, at least 0."""
    return float(max(0.0, (1.0 + cell.restitution) * high(cell.share[p, 1]) - 1.0))


@compiled(apart=True)
def stray(cell: Cell, touch: Floats, p: int) -> float:
    """Largest difference between the speed of a pair's centre of mass and its form.

    In a world that creeps the form's speed is between 0 and ``CREEP``, the rear one's between minus ``backwards`` and 1
    times that, the front one's between 0 and ``faster`` times that: no impact makes a rear one faster.
    """
    return float(max(faster(cell, p), 1.0 + backwards(cell, p)) * touch[CREEP])


@compiled(apart=True)
def blur(cell: Cell, path: Path, p: int, side: int) -> float:
    """By how much the speed of one of a pair may differ from the form at any time in the present piece."""
    return float(high(cell.share[p, side]) * path.touch[p, SPREAD] + stray(cell, path.touch[p], p))


@compiled(apart=True)
def begin_touch(touch: Floats) -> None:
    """Forget what a pair did when it was in contact before."""
    spread, reach = touch[SPREAD], touch[REACH]  # of the present piece
    touch[:] = 0.0
    touch[SPREAD], touch[REACH], touch[SOFTEST] = spread, reach, math.inf


@compiled(apart=True)
def move_together(cell: Cell, path: Path, motion: Motion, p: int, length: float) -> None:
    """A pair in contact through one piece of time; ``motion`` holds both as if alone, and then as one."""
    touch, front, rear = path.touch[p], p, p + 1
    touch[SPREAD], touch[REACH] = apart(touch), touch[WIDE]
    if motion.rest[front] == STANDS and motion.rest[rear] == STANDS:
        come_to_rest(cell, path, motion, p, length)
        return
    least, most = pressing_together(motion, p)
    opens = most < 0.0 and touch[CLOSING] <= 0.0 and touch[OPENING] + touch[CLOSING] <= SHARP
    if opens and (touch[CREEP] <= 0.0 or backwards(cell, p) <= 0.0):
        part(cell, path, motion, p, length)
        return
    vague = max(motion.vague[front], motion.vague[rear])
    weakest, hardest = own_pulls(motion, p)
    for rows in (motion.pull, motion.onward, motion.reach):
        rows[front] = common(cell, p, rows[front], rows[rear])
    slowest = min(low(path.forms[front]), low(motion.onward[front])) - dip_of(cell, vague, length)
    bounce(cell, touch, p, least, most, length, vague)
    creep(cell, touch, p, slowest, weakest, hardest, length)
    settle(touch, cell.restitution, length)
    motion.rest[front], motion.vague[front] = MOVES, vague
    if cell.moving:
        hold(path.forms[front], front, length, motion)
    motion.speed[front], motion.way[front] = motion.onward[front], motion.reach[front]
    if low(motion.onward[front]) < 0.0 and weakest < 0.0:
        stop(cell.moving, path.forms[front], front, length, motion)
    motion.way[front, -1] += stray(cell, touch, p) * length
    for rows in (motion.pull, motion.onward, motion.reach, motion.speed, motion.way):
        rows[rear] = rows[front]
    motion.rest[rear], motion.vague[rear] = motion.rest[front], vague


@compiled(apart=True)
def dip_of(cell: Cell, vague: float, length: float) -> float:
    """By how much a speed may be below its values at both ends of a piece in which a force passes 0."""
    return 0.5 * vague * length if cell.moving else 0.0


@compiled(apart=True)
def own_pulls(motion: Motion, p: int) -> tuple[float, float]:
    """Least and largest acceleration that a command of a pair gives."""
    weakest = min(low(motion.pull[p]) - motion.vague[p], low(motion.pull[p + 1]) - motion.vague[p + 1])
    return weakest, max(high(motion.pull[p]) + motion.vague[p], high(motion.pull[p + 1]) + motion.vague[p + 1])


@compiled(apart=True)
def creep(cell: Cell, touch: Floats, p: int, slowest: float, weakest: float, hardest: float, length: float) -> None:
    """Note that worlds may creep by now, the pair's centre of mass being as slow as ``slowest`` in this piece."""
    largest = max(high(cell.share[p, 0]), high(cell.share[p, 1]))  # share of one against their centre of mass
    if weakest < 0.0 and touch[SPREAD] > 0.0 and slowest <= largest * touch[SPREAD]:
        touch[CREEP] = max(touch[CREEP], touch[SPREAD])
    if touch[CREEP] > 0.0:
        touch[CREEP] += max(hardest, 0.0) * length
        touch[CLOSING] = max(touch[CLOSING], 0.0)
        if backwards(cell, p) > 0.0:
            most = (faster(cell, p) + backwards(cell, p)) * touch[CREEP]
            touch[OPENING] = max(touch[OPENING], most)
            touch[CLOSING], touch[SPREAD] = max(touch[CLOSING], touch[CREEP]), max(touch[SPREAD], most)
            touch[WIDE] = max(touch[WIDE], touch[REACH] + most * length)
            touch[SOFTEST] = math.inf
    touch[REACH] = max(touch[REACH], touch[WIDE])


@compiled(apart=True)
def come_to_rest(cell: Cell, path: Path, motion: Motion, p: int, length: float) -> None:
    """A pair whose form stands: each of its worlds stands, or creeps and is braked.

    The rear one's speed falls by the brakes b, the front one's is at most ``faster`` times what the rear one's was.
    """
    touch = path.touch[p]
    touch[CREEP] = max(touch[CREEP], touch[SPREAD])
    for i in range(p, p + 2):
        motion.way[i, -1] += stray(cell, touch, p) * length
    touch[WIDE] += max(touch[OPENING], 0.0) * length
    touch[REACH], touch[SOFTEST] = touch[WIDE], math.inf
    brakes = max(-own_pulls(motion, p)[1], 0.0)
    touch[CREEP] = max(touch[CREEP] - brakes * length / faster(cell, p), 0.0)
    touch[OPENING] = min(touch[OPENING], (faster(cell, p) + backwards(cell, p)) * touch[CREEP])
    touch[CLOSING] = min(max(touch[CLOSING], 0.0), touch[CREEP])


@compiled(apart=True)
def part(cell: Cell, path: Path, motion: Motion, p: int, length: float) -> None:
    """A pair that was in contact opens in this piece: from now on each moves alone."""
    N, P = cell.speed.shape[0], cell.gap.shape[0]
    touch, width = path.touch[p], cell.speed.shape[1]
    opening, wide, astray = max(touch[OPENING], 0.0), touch[WIDE], stray(cell, touch, p)
    path.marks[P + p] = PARTS
    touch[REACH] = wide + opening * length
    path.forms[N + p] = between(0.0, touch[REACH], width)  # by its speeds alone; commands act on top
    for side in range(2):
        share = (2.0 * side - 1.0) * high(cell.share[p, side])
        speed = between(min(-share * opening, 0.0) - astray, max(-share * opening, 0.0) + astray, width)
        for rows in (motion.onward, motion.speed):
            add(rows[p + side], 1.0, speed)
        for rows in (motion.reach, motion.way):
            rows[p + side, -1] += (abs(share) * opening + astray) * length
        neighbour = p - 1 + 2 * side
        if 0 <= neighbour < P:
            add(path.forms[N + neighbour], 1.0, between(-abs(share) * wide, 0.0, width))


@compiled(apart=True)
def bounce(cell: Cell, touch: Floats, p: int, least: float, most: float, length: float, vague: float) -> None:
    """What becomes of the difference of speeds and of the gap of a pair in contact within one piece.

    Its closing acceleration is between ``least`` and ``most``. No impact makes the difference larger, so it grows by
    what the commands give. While the pair is pressed together by b between b- and b+, it does not grow: from gap g and
    difference w a flight is never higher than h = g + w^2 / (2 b-), and closes with at most sqrt(2 b+ h), which leaves
    the share e of it: less than before, if e sqrt(b+ / b-) < 1. (Where a vehicle creeps, its brakes that hold make a
    flight lower and slower.)
    """
    e, fastest, wide = cell.restitution, apart(touch), touch[WIDE]
    if fastest == 0.0 and wide == 0.0 and least >= 0.0:
        touch[CLOSING], touch[OPENING] = 0.0, 0.0
        return
    certain = most < UNEVEN * UNEVEN * least if cell.moving else vague == 0.0
    if least > 0.0 and certain and (touch[CREEP] <= 0.0 or backwards(cell, p) <= 0.0):
        if least < touch[SOFTEST] or most > touch[HARDEST]:
            begin_run(touch, e, min(least, touch[SOFTEST]), max(most, touch[HARDEST]), least, most)
        if touch[SOFTEST] < math.inf:
            fastest = apart(touch)
            height = 0.5 * fastest * fastest / touch[HARDEST]
            touch[SPREAD] = fastest
            touch[WIDE] = max(wide, min(height, wide + fastest * length))
            touch[SINCE] += length
            return
    closing = max(touch[CLOSING] + most * length, 0.0) if most > 0.0 else touch[CLOSING]
    struck = max(touch[CLOSING], closing, 0.0)
    opening = max(touch[OPENING], e * struck) - min(least, 0.0) * length
    touch[CLOSING] = closing if most > 0.0 else touch[CLOSING] + most * length
    touch[OPENING], touch[SOFTEST], touch[HARDEST] = opening, math.inf, 0.0
    touch[SPREAD] = max(touch[SPREAD], struck, opening)
    touch[WIDE] += max(opening, 0.0) * length


@compiled(apart=True)
def begin_run(touch: Floats, e: float, softest: float, hardest: float, least: float, most: float) -> None:
    """A pair is pressed together in another way than before: between both ways, or if need be in the new one alone."""
    if not e * math.sqrt(hardest / softest) < 1.0:
        softest, hardest = least, most
    fastest = apart(touch)
    if not e * math.sqrt(hardest / softest) < 1.0:
        touch[SOFTEST], touch[HARDEST] = math.inf, 0.0
        return
    height = touch[WIDE] + 0.5 * fastest * fastest / softest
    touch[SOFTEST], touch[HARDEST], touch[SINCE] = softest, hardest, 0.0
    touch[OPENING] = math.sqrt(2.0 * hardest * height)
    touch[CLOSING] = touch[OPENING]


@compiled(apart=True)
def settle(touch: Floats, e: float, length: float) -> None:
    """Whether a pair moves as one by the end of the piece.

    A flight that begins with separating speed s ends after at most 2 s / b-, with a closing speed of at most
    s sqrt(b+ / b-). So after 2 s / (b- (1 - e sqrt(b+ / b-))) the two move as one, if none of them creeps.
    """
    if touch[SOFTEST] == math.inf or touch[CREEP] > 0.0:
        touch[SINCE] = 0.0
        return
    fastest = touch[OPENING]
    ratio = 0.0 if fastest < BOUND.PLASTIC_SPEED_MPS else e * math.sqrt(touch[HARDEST] / touch[SOFTEST])
    if touch[SINCE] * touch[SOFTEST] * (1.0 - ratio) > 2.0 * fastest * (1.0 + 1e-9) + 1e-9:
        begin_touch(touch)


@compiled(apart=True)
def is_blurred(path: Path, motion: Motion, N: int, p: int, length: float) -> bool:
    """Whether a moving pair may meet again at so many different times that they are better taken together."""
    if motion.rest[p] != MOVES or motion.rest[p + 1] != MOVES:
        return False
    closing = difference(path.forms[p + 1], path.forms[p])
    return radius(path.forms[N + p]) > max(high(closing), 0.0) * length


# A bound on harm that needs no path: by the speeds that the vehicles of a line may still have.
#
# Where a path cannot be followed, this is what is said of the worlds that go it, so that no bound is ever infinite.
#
# A vehicle on its own is at most as fast as it is, or as it drives up to its limit. In an impact of a pair whose
# closing speed is w each one's speed changes by its share of (1 + e) w. Let u be the largest of all own speeds, e
# restitution, and nobody move backwards yet. A rear vehicle is slowed by an impact, and left with at least -e times its
# speed; a front one that was at rest has at most (1 + e) times the rear one's. So the middle one of three is between -e
# u and (1 + e) u until its second pair meets. (Three that touch are one cluster, in which each ends with P + e (P - v)
# for a mean P of their speeds v: between the same bounds.)


@compiled(apart=True)
def driven(cell: Cell, i: int, speed: float, since: float) -> float:
    """Largest speed of a vehicle that is at most as fast as this at a time, by its own drive from then on."""
    drive, rest = 0.0, cell.times[-1] - since
    if i == cell.vehicle:
        for j in range(cell.action.shape[0]):
            if cell.times[j + 1] > since:
                drive = max(drive, cell.action[j] * high(cell.drive))
                if cell.forces.build[i]:  # what it had before may still be released
                    drive = max(drive, high(cell.forces.mean[i, j + 1]) + cell.forces.swing[i, j + 1].max())
    elif cell.constant[i] > 0.0:
        drive = cell.constant[i]
    return float(max(speed, min(cell.limit[i], speed + drive * rest)) if drive > 0.0 else speed)


@compiled(apart=True)
def rough_harm(cell: Cell, path: Path, hit: int) -> float:
    """Upper bound on the harm of all worlds of a path, from the present piece on, if pair ``hit`` was hit by now.

    ``hit`` -1: by the marks of the path.
    """
    N, P = cell.speed.shape[0], cell.gap.shape[0]
    since = cell.times[path.marks[2 * P]]
    own, backwards = np.zeros(N), 0.0
    for i in range(N):
        around = 0.0
        for p in range(max(i - 1, 0), min(i + 1, P)):
            if path.marks[P + p] != FREE:
                around += blur(cell, path, p, i - p)
        own[i] = driven(cell, i, max(high(path.forms[i]) + around, 0.0), since)
        backwards = max(backwards, around - low(path.forms[i]))
    return high(path.forms[-1]) + rough_rest(cell, own, backwards, since, path, hit)


@compiled(apart=True)
def rough_rest(cell: Cell, own: Floats, backwards: float, since: float, path: Path, hit: int) -> float:
    """Largest sum of the squared closing speeds of first impacts that are still to come."""
    P, e = cell.gap.shape[0], cell.restitution
    first = path.marks[0] == 1 or hit == 0
    if P == 1:
        return float(0.0 if first else own[1] * own[1])
    second = path.marks[1] == 1 or hit == 1
    fastest = max(own[1], own[2])
    ahead = driven(cell, 1, (1.0 + e) * fastest, since)  # closing speed of the front pair, its rear one pushed
    back: float = own[2] + max(
        e * driven(cell, 1, fastest, since), backwards
    )  # of the rear pair, its front one thrown back
    if first and second:
        return 0.0
    if first:
        return back * back
    if second:
        return ahead * ahead
    return float(max(fastest * fastest + back * back, own[2] * own[2] + ahead * ahead))


# An upper bound on the first-impact harm of a plan over a whole box of worlds.
#
# Every way in which impacts may follow each other in the box is a path. In each piece of time a path goes on without an
# impact, and another one branches off for each pair that may have one then. The harm of a path that has ended is a
# form; the bound is the largest value of any. Lines of at most three vehicles: once two pairs were hit, harm is final.

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


# Impacts of a box of worlds: how the two vehicles of an impact move on until the piece of time ends.


@compiled(apart=True)
def spring_apart(
    cell: Cell, path: Path, motion: Motion, p: int, how: Approach, jump: Floats, left: Floats, after: Path, way: Floats
) -> None:
    """Speeds and ways of a pair whose impact changes its relative speed by ``jump``, ``left`` before the piece ends."""
    front, rear = product(cell.share[p, 0], jump), product(cell.share[p, 1], jump)
    after.forms[p + 1] = difference(motion.onward[p + 1], rear)
    way[p + 1] = difference(motion.reach[p + 1], product(rear, left))
    if how.front_stands:
        after.forms[p] = front  # it stood when it was given that speed; then it brakes
        add(after.forms[p], 1.0, product(motion.pull[p], left))
        add(way[p], 1.0, product(front, left))
        add(way[p], 0.5, product(motion.pull[p], square(left)))
        vague, most = motion.vague[p], high(left)
        after.forms[p, -1] += vague * most
        way[p, -1] += 0.5 * vague * most * most
    else:
        after.forms[p], way[p] = motion.onward[p], motion.reach[p]
        add(after.forms[p], 1.0, front)
        add(way[p], 1.0, product(front, left))
    for i in range(p, p + 2):
        stand_still(cell, motion.pull[i], motion.vague[i], high(left), after.forms[i], way[i])


@compiled(apart=True)
def stand_still(cell: Cell, pull: Floats, vague: float, left: float, speed: Floats, way: Floats) -> None:
    """Where a braking vehicle's speed would have become negative, it stood before."""
    least = low(speed)
    if cell.moving and low(pull) - vague < 0.0 < high(pull) + vague:  # and as in ``hold``, it may drive since
        least -= (high(pull) + vague) * left
        speed[:] = between_shifted(speed, max(-least, 0.0))
    if least < 0.0:
        most = -least * left
        if high(pull) + vague < 0.0:
            most = min(most, 0.5 * least * least / -(high(pull) + vague))
        add(way, 1.0, between(0.0, most, way.shape[0]))
        speed[:] = positive_part(speed)


@compiled(apart=True)
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
    slowest = min(low(start), low(after.forms[p])) - dip_of(cell, vague, high(left))
    creep(cell, touch, p, slowest, weakest, hardest, high(left))
    stand_still(cell, pull, vague, high(left), after.forms[p], way[p])
    way[p, -1] += stray(cell, touch, p) * high(left)
    after.forms[p + 1], way[p + 1] = after.forms[p], way[p]
    add(way[p + 1], 1.0, gap)


# Impacts of a box of worlds: a path branches off, in which a pair has its impact in this piece of time.

STACK = 256  # most paths that wait to be followed


class Stack(NamedTuple):
    """Paths that are still to be followed."""

    forms: Floats  # [STACK, N + P + 1, W]
    touch: Floats  # [STACK, P, TOUCH_WIDTH]
    marks: Ints  # [STACK, 2 P + 1]
    size: Ints  # [1]


@compiled(apart=True)
def new_stack(N: int, width: int) -> Stack:
    """An empty one."""
    P = N - 1
    return Stack(
        np.zeros((STACK, N + P + 1, width)),
        np.zeros((STACK, P, TOUCH_WIDTH)),
        np.zeros((STACK, 2 * P + 1), np.int64),
        np.zeros(1, np.int64),
    )


@compiled(apart=True)
def keep_worst(harm: Floats, worst: float, out: Floats) -> float:
    """The larger harm; its form goes to ``out``."""
    if not high(harm) <= worst:
        out[:] = harm
        return high(harm)
    return worst


@compiled(apart=True)
def keep_rough(cell: Cell, path: Path, worst: float, out: Floats) -> float:
    """``keep_worst`` of a path that is not followed any further."""
    return keep_with(np.zeros(cell.speed.shape[1]), rough_harm(cell, path, -1), worst, out)


@compiled(apart=True)
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
    final = P == 1 or path.marks[other] == 1
    touches = path.marks[p] == 0 and pressing(motion, p)[1] >= 0.0 and may_only_touch(cell, path, motion, p, how)
    touches = touches and (P == 1 or may_turn(cell, motion, p, path.marks[2 * P]))  # its first impact is then to come
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
    """``keep_worst`` of a harm to which at most ``rest`` is added."""
    whole = harm.copy()
    whole[0] += rest
    return keep_worst(whole, worst, out)


@compiled(apart=True)
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


@compiled(apart=True)
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
    bounces = cell.restitution if high(speed) >= BOUND.PLASTIC_SPEED_MPS else 0.0
    returns = cell.restitution if low(speed) >= BOUND.PLASTIC_SPEED_MPS else 0.0
    _, most = pressing(motion, p)
    # drive of a front vehicle that ceases because an impact pushes it beyond its speed limit; 0: it does not
    drive = high(motion.pull[p]) + motion.vague[p]
    pushed = (1.0 + cell.restitution) * high(speed) + 2.0 * max(pressing(motion, p)[1], 0.0) * length
    fastest = high(motion.onward[p])
    if cell.moving:
        fastest = max(fastest, high(path.forms[p]) + max(drive, 0.0) * length)
    unlimited = drive if drive > 0.0 and fastest + pushed > cell.limit[p] else 0.0
    if most < 0.0 or -returns * low(speed) + max(most, 0.0) * high(left) < 0.0:
        jump = speed * (1.0 + bounces)
        jump[-1] = abs(jump[-1]) + (bounces - returns) * BOUND.PLASTIC_SPEED_MPS
        spring_apart(cell, path, motion, p, how, jump, left, after, way)
    else:
        most_apart, touch = bounces * high(speed), after.touch[p]  # by so much its impact opens the pair at most
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
    """Whether a pair may have come to gap 0 at closing speed 0 just when it begins to be pressed together.

    Before, it was not: so a command changed, or a force moves.
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
    """Whether forces that move may press a pair together harder and harder: its front's falls, or its rear's rises."""
    return may_move(cell, motion, p, piece, 0) or may_move(cell, motion, p + 1, piece, 1)


@compiled(apart=True)
def may_move(cell: Cell, motion: Motion, i: int, piece: int, which: int) -> bool:
    """Whether an acceleration may fall (0), or rise (1), in the piece, in a cell in which some force moves."""
    if not cell.forces.build[i] or motion.vague[i] > cell.forces.swing[i, piece + 1].max():
        return cell.moving and motion.vague[i] > 0.0
    return bool(cell.forces.swing[i, piece + 1, which] > 0.0)


@compiled(apart=True)
def touch_only(cell: Cell, path: Path, stack: Stack, motion: Motion, p: int, length: float) -> bool:
    """Beside the path on top that of the worlds in which pair ``p`` met, stayed in contact, and had no impact.

    Where forces move it may open and have its first impact within the piece: that is on the path on top.
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
    """Whether the striking vehicle may move backwards after the impact, and be met again.

    The last one of a line, if it never drives, meets nobody then: it may as well stand.
    """
    P, share = cell.gap.shape[0], (1.0 + cell.restitution) * high(cell.share[p, 1]) - 1.0
    slowest = 0.0
    if not how.front_stands:
        dip = dip_of(cell, motion.vague[p], cell.times[path.marks[2 * P] + 1] - cell.times[path.marks[2 * P]])
        slowest = max(min(low(path.forms[p]), low(motion.speed[p])) - dip, 0.0)
    last = p == P - 1 and driven(cell, p + 1, 0.0, cell.times[path.marks[2 * P]]) <= 0.0
    return share * high(speed) > slowest and not last


MOST_PATHS = 4000  # of one cell


@compiled(apart=True)
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
            for k in range(stack.size[0]):
                worst = keep_rough(cell, Path(stack.forms[k], stack.touch[k], stack.marks[k]), worst, out)
            return worst
    return worst if worst >= 0.0 else math.inf  # each world goes some way


@compiled(apart=True)
def follow(cell: Cell, path: Path, stack: Stack, motion: Motion, worst: float, out: Floats) -> float:
    """Follow a path to its end; the larger one of ``worst`` and its harm and that of the paths that end with it."""
    N, P = cell.speed.shape[0], cell.gap.shape[0]
    quiet = 0  # the piece of time from which on nobody drives
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
    """Whether a pair that touched without an impact may open in this piece and meet again, which would be its first."""
    P = cell.gap.shape[0]
    for p in range(P):
        if path.marks[P + p] == TOUCHES and path.marks[p] == 0:
            least, most = pressing_together(motion, p)
            if least < 0.0 <= most and not (motion.rest[p : p + 2] == STANDS).all():
                return True
    return False


@compiled(apart=True)
def meet(cell: Cell, path: Path, stack: Stack, motion: Motion, worst: float, out: Floats) -> float:
    """Pairs in contact, and those that may come into contact, in one piece of time; ``worst`` as ``follow``."""
    N, P = cell.speed.shape[0], cell.gap.shape[0]
    length = cell.times[path.marks[2 * P] + 1] - cell.times[path.marks[2 * P]]
    for p in range(P):
        again = path.marks[P + p] == FREE and path.marks[p] == 1 and (P == 1 or path.marks[2 * P - 1 - p] == FREE)
        if again and may_meet(cell, path, motion, p, length) and is_blurred(path, motion, N, p, length):
            # what may or may not be in contact is taken as a pair that is
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
            # its impacts in this piece of time, its front moving then or standing
            for i in range(p, p + 2):
                motion.way[i, -1] += BOUND.TOUCH_SPEED_MPS * length  # by a touch, which is no impact
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


# Robust mode for every world of the box of intervals: which boxes, and an upper bound on the harm of plans over them.
#
# What is certified is a whole plan, from the alert on: nothing that is seen later narrows a box. So the proof is short.
# The plan that is held has a bound over all worlds of the box; it is replaced by another one, with the same past, only
# if that one's bound is at most the budget. What was applied at the end is the plan that is held then.

# Branch and bound: an upper bound on the harm of a plan over a box, refined where it is largest.

# groups of the numbers of a box, N of each but P gaps
BRAKING, DRIVING, LATENCY, MASS, BRAKE_RATE, RELEASE_RATE, SPEED, GAP = range(8)
LONGEST_PIECE_S = 0.25  # before the first decision


class Known(NamedTuple):
    """What is certain about the worlds of a box."""

    vehicle: int
    constant: Floats  # [N] command of each other vehicle; NaN: full braking
    limit: Floats  # [N]
    restitution: float
    begin_s: float  # of the worlds
    time_step_s: float
    horizon_s: float


@compiled(apart=True)
def form_of(low_: Floats, high_: Floats, which: int, free: Ints) -> Floats:
    """The form of number ``which`` of a box whose uncertain ones are ``free`` [K]."""
    out = np.zeros(free.shape[0] + 2)
    out[0] = 0.5 * (low_[which] + high_[which])
    half = 0.5 * (high_[which] - low_[which])
    for k in range(free.shape[0]):
        if free[k] == which:
            out[1 + k] = half
            half = 0.0
    out[-1] = half + 1e-15 * abs(out[0])
    return out


@compiled(apart=True)
def cell_of(low_: Floats, high_: Floats, free: Ints, known: Known, plan: Floats) -> tuple[Cell, Floats]:
    """The cell of a box [Q], its worlds at the alert, and how long after it the first piece of time begins (s).

    The first decision falls at another time in each world where the shielded vehicle's latency is uncertain: time is
    counted from it, and the first piece begins as long before it as the earliest one comes after the alert.
    """
    N, W = known.limit.shape[0], free.shape[0] + 2
    P, v = N - 1, known.vehicle
    speed, gap, brake, onset = np.empty((N, W)), np.empty((P, W)), np.empty((N, W)), np.empty((N, W))
    share = np.empty((P, 2, W))
    first = form_of(low_, high_, LATENCY * N + v, free)
    first[0] -= known.begin_s
    first = positive_part(first)
    earliest = known.begin_s + max(low(first), 0.0)
    first[0] += known.begin_s
    for i in range(N):
        speed[i] = form_of(low_, high_, SPEED * N + i, free)
        brake[i] = form_of(low_, high_, BRAKING * N + i, free)
        onset[i] = difference(form_of(low_, high_, LATENCY * N + i, free), first)
    for p in range(P):
        gap[p] = form_of(low_, high_, GAP * N + p, free)
        front, rear = form_of(low_, high_, MASS * N + p, free), form_of(low_, high_, MASS * N + p + 1, free)
        whole = front.copy()
        add(whole, 1.0, rear)
        share[p, 0] = product(rear, reciprocal(whole))
        share[p, 1] = -share[p, 0]
        share[p, 1, 0] += 1.0
        share[p, 1, -1] = share[p, 0, -1]
    drive = form_of(low_, high_, DRIVING * N + v, free)
    times, action = pieces(known, onset, earliest, plan)
    first[0] -= earliest
    build = np.zeros(N, np.bool_)
    for i in range(N):  # others only brake, or only drive
        down, up = low_[BRAKE_RATE * N + i] < math.inf, low_[RELEASE_RATE * N + i] < math.inf
        build[i] = (up and (i == v or known.constant[i] > 0.0)) or (down and not known.constant[i] >= 0.0)
    J, moving = times.shape[0] if build.any() else 0, bool(build.any())
    forces = Forces(np.zeros((N, J, W)), np.zeros((N, J, W)), np.zeros((N, J, W)), np.zeros((N, J, 2)), build)
    cell = Cell(
        speed, gap, brake, drive, share, onset, known.constant, known.limit, v, known.restitution, times, action,
        forces, moving,
    )  # fmt: skip
    for i in range(N):
        if build[i]:
            rates = np.full((2, W), math.inf)
            for k in range(2):
                if low_[(BRAKE_RATE + k) * N + i] < math.inf:
                    rates[k] = form_of(low_, high_, (BRAKE_RATE + k) * N + i, free)
            build_up(cell, i, first, rates)
    return cell, first


@compiled(apart=True)
def build_up(cell: Cell, i: int, late: Floats, rates: Floats) -> None:
    """The forces of a vehicle in ``late`` and in every piece; 0 at the alert. ``rates`` [2, W] of braking, release."""
    forces, own, force, wanted = cell.forces, i == cell.vehicle, np.zeros_like(late), np.zeros_like(late)
    last, there = 0.0, True  # action, and whether the force is that of it
    for j in range(cell.times.shape[0]):
        begin, end = cell.times[j - 1], cell.times[j]
        duration = between(end - begin, end - begin, late.shape[0])
        if j == 0:
            duration, begin, end = late, 0.0, high(late)
            early, acts = early_pull(cell, i, late)
            action = 1.0 if acts and radius(early) + abs(early[0]) > 0.0 else 0.0
        elif own:
            action = cell.action[j - 1]
        else:
            action = 1.0 if low(cell.onset[i]) < end else 0.0
            if action == 1.0 and high(cell.onset[i]) > begin:
                duration = cut(difference(_since(cell, i, end), _since(cell, i, begin)), 0.0, end - begin)
        if action != last:
            there = False
            wanted = np.zeros_like(late)
            if not own and not math.isnan(cell.constant[i]):
                wanted[0] = cell.constant[i]
            else:
                add(wanted, action if own else -1.0, cell.drive if own and action > 0.0 else cell.brake[i])
        last = action
        rise, gain = forces.rise[i, j], forces.gain[i, j]
        if there and radius(duration) == 0.0:
            add(rise, duration[0], wanted)
            add(gain, 0.5 * duration[0] * duration[0], wanted)
        else:
            add(rise, 1.0, product(wanted, duration))
            add(gain, 0.5, product(wanted, square(duration)))
        if not there:
            there = ramp(force, wanted, duration, end - begin, rates, rise, gain, forces.swing[i, j])
            there &= low(duration) >= end - begin
        if end > begin:
            add(forces.mean[i, j], 1.0 / (end - begin), rise)


@compiled(apart=True)
def ramp(
    force: Floats, wanted: Floats, duration: Floats, longest: float, rates: Floats, rise: Floats, gain: Floats,
    swing: Floats,
) -> bool:  # fmt: skip
    """A force that moves towards another one for a while: ``force`` becomes that at its end.

    With a difference d at the start and e at the end, and the time m for which it moves, it adds ``m (d + e) / 2`` to
    the speed that ``wanted`` gives after t, and ``m t (d + e) / 2 - m^2 (d + 2 e) / 6`` to the way. ``swing`` [2]
    becomes by how much it may differ from its mean. Returns whether it is there at the end in every world.
    """
    start, there = difference(force, wanted), True
    force[:] = wanted
    for k in range(2):
        sign, rate = 1.0 - 2.0 * k, rates[k]
        more = positive_part(linear(start, sign, 0.0, 0.0))
        if math.isinf(rate[0]) or high(more) <= 0.0:
            continue
        moving, rest = duration.copy(), difference(more, product(rate, duration))
        if low(rest) < 0.0:
            rest = positive_part(rest)
            moving = cut(product(difference(more, rest), reciprocal(rate)), 0.0, high(duration))
        both = more.copy()
        add(both, 1.0, rest)
        speed = product(moving, both)
        speed *= 0.5
        speed = cut(speed, 0.0, high(more) * high(duration))
        add(both, 1.0, rest)
        way = product(speed, duration)
        add(way, -1.0 / 6.0, product(square(moving), both))
        add(rise, sign, speed)
        add(gain, sign, cut(way, 0.0, 0.5 * high(more) * high(duration) * high(duration)))
        add(force, sign, rest)
        there &= high(rest) <= 0.0
        swing[k] = min(0.5 * high(rate) * longest, high(more))
    return there


@compiled(apart=True)
def wait(cell: Cell, late: Floats) -> bool:
    """Move a cell's worlds on by ``late`` (s), each by its own; False where that may not be all that happens."""
    if high(late) <= 1e-12:
        return True
    if low(late) < -1e-12:
        return False
    N = cell.speed.shape[0]
    slowest, way = np.empty(N), np.empty_like(cell.speed)
    for i in range(N):
        pull, certain = early_pull(cell, i, late)
        begin = cell.speed[i].copy()
        way[i] = product(begin, late)
        if cell.forces.build[i]:
            add(way[i], 1.0, cell.forces.gain[i, 0])
            add(cell.speed[i], 1.0, cell.forces.rise[i, 0])
        else:
            add(way[i], 0.5, product(pull, square(late)))
            add(cell.speed[i], 1.0, product(pull, late))
        slowest[i], fastest = min(low(begin), low(cell.speed[i])), max(high(begin), high(cell.speed[i]))
        limited = high(pull) > 0.0 and fastest >= cell.limit[i]
        if not certain or limited or slowest[i] < 0.0:
            return False
        if i > 0 and low(cell.gap[i - 1]) <= max(fastest - slowest[i - 1], 0.0) * high(late) + 1e-9:
            return False
    for p in range(N - 1):
        add(cell.gap[p], 1.0, way[p])
        add(cell.gap[p], -1.0, way[p + 1])
    return True


@compiled(apart=True)
def early_pull(cell: Cell, i: int, late: Floats) -> tuple[Floats, bool]:
    """Acceleration of a vehicle until ``late`` after the alert; False where it may begin within that time."""
    pull = np.zeros_like(late)
    if i == cell.vehicle:
        return pull, True
    acts = cell.onset[i].copy()  # after the alert
    add(acts, 1.0, late)
    acts[0] -= cell.times[0]
    if high(acts) > 1e-12:
        return pull, low(acts) >= high(late)
    if math.isnan(cell.constant[i]):
        return negative(cell.brake[i]), True
    pull[0] = cell.constant[i]
    return pull, True


@compiled(apart=True)
def pieces(known: Known, onset: Floats, earliest: float, plan: Floats) -> tuple[Floats, Floats]:
    """Where commands may change, s after the first decision, and the shielded vehicle's action between."""
    N = onset.shape[0]
    before = earliest - known.begin_s
    first = math.ceil(before / LONGEST_PIECE_S) if before > 0.0 else 0
    last = math.ceil((known.horizon_s - earliest) / known.time_step_s - 1e-9)
    points = np.empty(first + last + 1 + 2 * N)
    count = 0
    for k in range(first):
        points[count] = -before + before * k / first
        count += 1
    for k in range(last + 1):
        points[count] = k * known.time_step_s
        count += 1
    for i in range(N):
        if i != known.vehicle:
            for at in (low(onset[i]), high(onset[i])):
                if -before < at < last * known.time_step_s:
                    points[count] = at
                    count += 1
    times = np.unique(points[:count])
    action = np.zeros(times.shape[0] - 1)
    for j in range(action.shape[0]):
        middle = 0.5 * (times[j] + times[j + 1])
        if middle > 0.0:
            action[j] = plan[min(int(middle / known.time_step_s), plan.shape[0] - 1)]
    return times, action


@compiled(apart=True)
def bound_of(
    low_: Floats, high_: Floats, free: Ints, known: Known, plan: Floats, stack: Stack, motion: Motion, out: Floats,
    most: float,
) -> float:  # fmt: skip
    """Upper bound on the harm of a plan over one box, unless it is above ``most``."""
    cell, late = cell_of(low_, high_, free, known, plan)
    # of all worlds whose first piece of time begins ``late`` after the alert
    N, P, width = cell.speed.shape[0], cell.gap.shape[0], cell.speed.shape[1]
    path = Path(np.zeros((N + P + 1, width)), np.zeros((P, TOUCH_WIDTH)), np.zeros(2 * P + 1, np.int64))
    for i in range(N):
        path.forms[i] = cell.speed[i]
        if i != cell.vehicle and cell.constant[i] > 0.0:
            path.forms[i, -1] += cell.constant[i] * high(late)
    rough = rough_harm(cell, path, -1)
    if wait(cell, late):
        harm = most_harm(cell, stack, motion, out, most)
        if harm <= rough:
            return harm
    out[:] = 0.0
    out[0] = rough
    return rough


@compiled(apart=True)
def bound_box(
    low_: Floats, high_: Floats, free: Ints, known: Known, plan: Floats, enough: float, cells: int, only_enough: bool
) -> tuple[float, int]:
    """Upper bound on the harm of a plan [L] over a box [Q], and the cells looked at.

    The box is halved where the bound is largest, until that is at most ``enough`` or ``cells`` were looked at. With
    ``only_enough`` a part is given up once its harm is above ``enough``: a larger result is then no bound.
    """
    N, K, Q = known.limit.shape[0], free.shape[0], low_.shape[0]
    stack, motion = new_stack(N, K + 2), new_motion(N, K + 2)
    lows, highs = np.empty((cells + 1, Q)), np.empty((cells + 1, Q))
    bounds, slopes = np.full(cells + 1, -math.inf), np.zeros((cells + 1, K + 2))
    lows[0], highs[0] = low_, high_
    most, size, looked = enough if only_enough else math.inf, 1, 1
    bounds[0] = bound_of(low_, high_, free, known, plan, stack, motion, slopes[0], most)
    while looked + 2 <= cells and K > 0:
        at = int(np.argmax(bounds[:size]))
        if bounds[at] <= enough:
            break
        share = (highs[at] - lows[at])[free] / (high_ - low_)[free]
        weight = np.abs(slopes[at, 1:-1])
        which = free[int(np.argmax(weight if weight.max() > 0.0 else share))]
        middle = 0.5 * (lows[at, which] + highs[at, which])
        lows[size], highs[size] = lows[at], highs[at]
        highs[at, which], lows[size, which] = middle, middle
        bounds[at] = bound_of(lows[at], highs[at], free, known, plan, stack, motion, slopes[at], most)
        bounds[size] = bound_of(lows[size], highs[size], free, known, plan, stack, motion, slopes[size], most)
        size += 1
        looked += 2
    return bounds[:size].max(), looked


MOST_VEHICLES = 3
CELLS_AT_ALERT, CELLS = 200, 40  # looked at for the bound at the alert, and for one later certificate
NEAR = 1.02  # times the largest harm in a corner: a bound this good is not refined any further
NEARLY_NOTHING = 0.1  # m2/s2, likewise
CORNERS, INTERIOR = "corners", "interior"  # which worlds of a box robust mode certifies
CERTAINTIES = (CORNERS, INTERIOR)
SCRIPTS = ("full_brake", "coast", "constant")


class Boxes(NamedTuple):
    """The boxes of n worlds: each uncertain number from ``low`` to ``high``."""

    low: Floats  # [n, Q] braking, driving, latency, mass, rates, speed of each vehicle, then the gaps
    high: Floats  # [n, Q]
    limit: Floats  # [n, N] m/s
    restitution: Floats  # [n]
    begin_s: Floats  # [n]
    constant: Floats  # [n, N] m/s2; NaN: full braking
    vehicle: int
    time_step_s: float
    horizon_s: float

    @staticmethod
    def check_possible(robust: str, scenario: Scenario, harm_count: HarmCount, others: Mapping[int, Script]) -> None:
        """Raise ``InvalidInput`` for a setting that interior mode cannot certify, whatever its worlds.

        That is: total harm, more than three vehicles, an obstacle ahead, or others that do anything else than brake
        fully, coast, or hold one deceleration.
        """
        if robust != INTERIOR:
            return
        for what, there in (
            ("total harm", harm_count == "total"),
            (f"{scenario.vehicles} vehicles", scenario.vehicles > MOST_VEHICLES),
            ("an obstacle ahead", scenario.has_obstacle),
        ):
            if there:
                raise _refusal(what)
        for i, script in sorted(others.items()):
            name = getattr(script, "name", type(script).__name__)
            if name.split(":")[0] not in SCRIPTS:
                raise InvalidInput(
                    f"shield: robust interior: vehicle_{i + 1} is driven by {name!r}, which it cannot enclose;"
                    " full_brake, coast and constant:A are possible; robust corners takes every script"
                )

    @classmethod
    def of(
        cls, possible: Worlds, problem: ProfileProblem, n: int, scenario: Scenario, others: Mapping[int, Script]
    ) -> Boxes:
        """The boxes of n worlds at the alert, their members being ``possible`` [n * M], as in the ``problem``.

        Raises ``InvalidInput`` for worlds that interior mode cannot certify: with an obstacle ahead, or in which
        another vehicle's command is not the same in the whole box. ``check_possible`` says what no world of a scenario
        changes.
        """
        v, N, vehicle, members = possible.vehicles, possible.N, int(problem.vehicles[0]), possible.n // n
        if possible.obstacle_ahead.any():
            raise _refusal("an obstacle ahead")
        if v.in_pieces.any():
            raise _refusal("a vehicle that brakes in pieces (profile)")
        if v.build_up.any() and possible.command_mps2.any():
            raise _refusal("brakes that began to build up before the alert")
        command, constant = problem.command.reshape(n, members, N), np.full((n, N), np.nan)
        for i, script in others.items():
            name = getattr(script, "name", type(script).__name__)
            if i == vehicle or name.split(":")[0] == "full_brake":
                continue
            if not (command[:, :, i] == command[:, :1, i]).all():
                raise InvalidInput(
                    f"shield: robust interior: vehicle_{i + 1} is driven by {name!r}, whose command is another one in"
                    " each world of the box; full_brake, coast and constant:A are possible, A being at most every"
                    " capacity of the box"
                )
            constant[:, i] = command[:, 0, i]
        numbers = np.concatenate(
            [
                v.braking_capacity_mps2, v.driving_capacity_mps2, v.latency_s, v.mass_t, v.brake_rate_mps3,
                v.release_rate_mps3, possible.speeds_mps, possible.gaps_m,
            ],
            axis=1,
        ).reshape(n, members, 8 * N - 1)  # fmt: skip
        return cls(
            numbers.min(axis=1), numbers.max(axis=1), v.speed_limit_mps[::members], v.restitution[::members],
            possible.time_s[::members], constant, vehicle, scenario.time_step_s, scenario.horizon_s,
        )  # fmt: skip

    def take(self, rows: Ints) -> Boxes:
        """The boxes of some worlds."""
        arrays: dict[str, Any] = {name: getattr(self, name)[rows] for name in self._fields[:6]}
        return self._replace(**arrays)

    def placed(self, old: Boxes | None, rows: Ints) -> Boxes:
        """The boxes of a batch in which these ones begin in these rows: all of them, or some of the ``old`` ones."""
        if old is None or len(rows) >= len(old.low):
            return self.take(np.argsort(rows))
        arrays: dict[str, Any] = {name: getattr(old, name).copy() for name in self._fields[:6]}
        for name, array in arrays.items():
            array[rows] = getattr(self, name)
        return self._replace(**arrays)

    def at_alert(self, plans: Floats, harm: Floats) -> Floats:
        """Upper bound on the harm of each plan [n, L], ``harm`` being its largest in a corner, [n] m2/s2."""
        return self.bound(np.arange(len(plans)), plans, NEAR * harm + NEARLY_NOTHING, CELLS_AT_ALERT)

    def bound(
        self, rows: Ints, plans: Floats, enough: Floats, cells: int = CELLS, *, only_enough: bool = False
    ) -> Floats:
        """Upper bound on the harm of each plan [m, L], from the alert on, over all worlds of a box [m], m2/s2.

        A bound at most ``enough`` [m] is not refined any further, and no more than ``cells`` parts of a box are looked
        at. With ``only_enough`` what is above ``enough`` is no bound: it says that none at most that was found.
        """
        bounds = np.empty(len(rows))
        for j, k in enumerate(rows.tolist()):
            low, high = self.low[k], self.high[k]
            known = Known(
                self.vehicle, self.constant[k], self.limit[k], float(self.restitution[k]), float(self.begin_s[k]),
                self.time_step_s, self.horizon_s,
            )  # fmt: skip
            free, plan = np.flatnonzero(high > low), np.ascontiguousarray(plans[j], np.float64)
            bounds[j], _ = bound_box(low, high, free, known, plan, float(enough[j]), cells, only_enough)
        return bounds


def _refusal(what: str) -> InvalidInput:
    return InvalidInput(
        f"shield: robust interior: {what}: it certifies first-impact harm of at most {MOST_VEHICLES} vehicles without"
        " an obstacle; robust corners takes every scenario"
    )


def checked_robust(robust: object, where: str) -> str:
    """``corners`` or ``interior``; raises ``UnknownName`` for anything else."""
    if robust not in CERTAINTIES:
        raise unknown_name(f"{where}: robust", robust, CERTAINTIES)
    return str(robust)
