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
from ethbrake_marl.physics.kernel import PLASTIC_SPEED_MPS

# Affine forms: numbers that depend on where in a box a world lies, with a bound on what is not linear in it.
#
# A form [W] of a box with K uncertain numbers, W = K + 2, stands for ``c + g_1 e_1 + ... + g_K e_K + r e``: the centre,
# one slope for each uncertain number, and a remainder. ``e_k`` in [-1, 1] says where in the box the world lies, the
# same
# in every form; ``e`` in [-1, 1] is any, another one in every form. What two forms share in ``e_k`` cancels when they
# are
# subtracted, which plain intervals cannot do.
#
# Each operation encloses: for every world of the box there are values of ``e`` for which the result stands for what the
# operation makes of the operands. Rounding is not part of an operation; ``shield.enclosure`` adds it (``ROUNDING``).


@compiled_apart
def radius(x: Floats) -> float:
    """Largest distance from the centre."""
    whole: float = x[-1]
    for k in range(1, x.shape[0] - 1):
        whole += abs(x[k])
    return whole


@compiled_apart
def low(x: Floats) -> float:
    """Least value."""
    least: float = x[0] - radius(x)
    return least


@compiled_apart
def high(x: Floats) -> float:
    """Largest value."""
    most: float = x[0] + radius(x)
    return most


@compiled_apart
def add(out: Floats, share: float, x: Floats) -> None:
    """``out += share * x``; exact but for rounding."""
    for k in range(x.shape[0] - 1):
        out[k] += share * x[k]
    out[-1] += abs(share) * x[-1]


@compiled_apart
def difference(x: Floats, y: Floats) -> Floats:
    """``x - y``."""
    out = x.copy()
    add(out, -1.0, y)
    return out


@compiled_apart
def negative(x: Floats) -> Floats:
    """``-x``."""
    return linear(x, -1.0, 0.0, 0.0)


@compiled_apart
def between(least: float, most: float, width: int) -> Floats:
    """The form [width] of any number in an interval."""
    out = np.zeros(width)
    out[0], out[-1] = 0.5 * (least + most), 0.5 * (most - least)
    return out


@compiled_apart
def product(x: Floats, y: Floats) -> Floats:
    """``x * y``: what is of second order goes to the remainder."""
    out = np.empty_like(x)
    for k in range(x.shape[0] - 1):
        out[k] = x[0] * y[k] + y[0] * x[k]
    out[0] = x[0] * y[0]
    out[-1] = abs(x[0]) * y[-1] + abs(y[0]) * x[-1] + radius(x) * radius(y)
    return out


@compiled_apart
def square(x: Floats) -> Floats:
    """``x * x``: its part of second order is at least 0, which halves the remainder."""
    out = np.empty_like(x)
    for k in range(x.shape[0] - 1):
        out[k] = 2.0 * x[0] * x[k]
    half = 0.5 * radius(x) * radius(x)
    out[0] = x[0] * x[0] + half
    out[-1] = 2.0 * abs(x[0]) * x[-1] + half
    return out


@compiled_apart
def linear(x: Floats, slope: float, start: float, error: float) -> Floats:
    """``start + slope * x``, and an error of at most ``error`` on either side."""
    out = np.empty_like(x)
    for k in range(x.shape[0] - 1):
        out[k] = slope * x[k]
    out[0] += start
    out[-1] = abs(slope) * x[-1] + error
    return out


@compiled_apart
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


@compiled_apart
def reciprocal(x: Floats) -> Floats:
    """``1 / x`` for ``low(x) > 0``: between the chord, of slope -1 / (a b), and the parallel tangent."""
    least, most = low(x), high(x)
    slope = -1.0 / (least * most)
    chord = 1.0 / least + 1.0 / most
    error = 0.5 * (chord - 2.0 / math.sqrt(least * most))
    return linear(x, slope, chord - error, error)


@compiled_apart
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


@compiled_apart
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


# Pairs of a box of worlds that stay in contact: they bounce a little, then move as one, then part.
#
# A pair in contact is told by the motion of its centre of mass, as forms, and by bounds on how far the two are from it.
# While both of them move forward, their commands are the only forces on the pair, so its centre of mass moves by the
# commands alone, however often the two collide. A world *creeps* once one of the two stands or moves backwards: its
# brakes then hold instead of pulling, and nothing but bounds on its speeds is known of it.

SHARP = 0.1  # m/s: a pair that opens moves alone once its speeds are known to this


@compiled_apart
def common(cell: Cell, p: int, front: Floats, rear: Floats) -> Floats:
    """Of two quantities of a pair, that of its centre of mass."""
    out = product(cell.share[p, 1], front)
    add(out, 1.0, product(cell.share[p, 0], rear))
    return out


@compiled_apart
def pressing_together(motion: Motion, p: int) -> tuple[float, float]:
    """Least and largest closing acceleration of a pair whose commands act on both."""
    vague = motion.vague[p] + motion.vague[p + 1]
    least = low(motion.pull[p + 1]) - high(motion.pull[p]) - vague
    return least, high(motion.pull[p + 1]) - low(motion.pull[p]) + vague


@compiled_apart
def apart(touch: Floats) -> float:
    """Largest difference of speeds of a pair in contact."""
    most: float = max(touch[OPENING], touch[CLOSING], 0.0)
    return most


@compiled_apart
def largest_share(cell: Cell, p: int) -> float:
    """Of a difference of speeds, the most that one of a pair has against their centre of mass."""
    share: float = max(high(cell.share[p, 0]), high(cell.share[p, 1]))
    return share


@compiled_apart
def faster(cell: Cell, p: int) -> float:
    """How many times the rear one's speed its impacts may give the front one, at least 1."""
    times: float = max(1.0, (1.0 + cell.restitution) * high(cell.share[p, 0]))
    return times


@compiled_apart
def backwards(cell: Cell, p: int) -> float:
    """How many times its speed the rear one may have backwards after an impact, at least 0."""
    times: float = max(0.0, (1.0 + cell.restitution) * high(cell.share[p, 1]) - 1.0)
    return times


@compiled_apart
def stray(cell: Cell, touch: Floats, p: int) -> float:
    """Largest difference between the speed of a pair's centre of mass and its form.

    In a world that creeps the form's speed is between 0 and ``CREEP``, the rear one's between minus ``backwards`` and 1
    times that, the front one's between 0 and ``faster`` times that: no impact makes a rear one faster.
    """
    most: float = max(faster(cell, p), 1.0 + backwards(cell, p)) * touch[CREEP]
    return most


@compiled_apart
def blur(cell: Cell, path: Path, p: int, side: int) -> float:
    """By how much the speed of one of a pair may differ from the form at any time in the present piece."""
    most: float = high(cell.share[p, side]) * path.touch[p, SPREAD] + stray(cell, path.touch[p], p)
    return most


@compiled_apart
def begin_touch(touch: Floats) -> None:
    """Forget what a pair did when it was in contact before."""
    spread, reach = touch[SPREAD], touch[REACH]  # of the present piece
    touch[:] = 0.0
    touch[SPREAD], touch[REACH], touch[SOFTEST] = spread, reach, math.inf


@compiled_apart
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
    slowest = min(low(path.forms[front]), low(motion.onward[front]))
    bounce(cell, touch, p, least, most, length, vague)
    creep(cell, touch, p, slowest, weakest, hardest, length)
    settle(touch, cell.restitution, length)
    motion.rest[front], motion.vague[front] = MOVES, vague
    motion.speed[front], motion.way[front] = motion.onward[front], motion.reach[front]
    if low(motion.onward[front]) < 0.0 and weakest < 0.0:
        stop(path.forms[front], front, length, motion)
    motion.way[front, -1] += stray(cell, touch, p) * length
    for rows in (motion.pull, motion.onward, motion.reach, motion.speed, motion.way):
        rows[rear] = rows[front]
    motion.rest[rear], motion.vague[rear] = motion.rest[front], vague


@compiled_apart
def own_pulls(motion: Motion, p: int) -> tuple[float, float]:
    """Least and largest acceleration that a command of a pair gives."""
    weakest = min(low(motion.pull[p]) - motion.vague[p], low(motion.pull[p + 1]) - motion.vague[p + 1])
    return weakest, max(high(motion.pull[p]) + motion.vague[p], high(motion.pull[p + 1]) + motion.vague[p + 1])


@compiled_apart
def creep(cell: Cell, touch: Floats, p: int, slowest: float, weakest: float, hardest: float, length: float) -> None:
    """Note that worlds may creep by now, the pair's centre of mass being as slow as ``slowest`` in this piece."""
    if weakest < 0.0 and touch[SPREAD] > 0.0 and slowest <= largest_share(cell, p) * touch[SPREAD]:
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


@compiled_apart
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


@compiled_apart
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


@compiled_apart
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
    if least > 0.0 and vague == 0.0 and (touch[CREEP] <= 0.0 or backwards(cell, p) <= 0.0):
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


@compiled_apart
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


@compiled_apart
def settle(touch: Floats, e: float, length: float) -> None:
    """Whether a pair moves as one by the end of the piece.

    A flight that begins with separating speed s ends after at most 2 s / b-, with a closing speed of at most
    s sqrt(b+ / b-). So after 2 s / (b- (1 - e sqrt(b+ / b-))) the two move as one, if none of them creeps.
    """
    if touch[SOFTEST] == math.inf or touch[CREEP] > 0.0:
        touch[SINCE] = 0.0
        return
    fastest = touch[OPENING]
    ratio = 0.0 if fastest < PLASTIC_SPEED_MPS else e * math.sqrt(touch[HARDEST] / touch[SOFTEST])
    if touch[SINCE] * touch[SOFTEST] * (1.0 - ratio) > 2.0 * fastest * (1.0 + 1e-9) + 1e-9:
        begin_touch(touch)


@compiled_apart
def is_blurred(path: Path, motion: Motion, N: int, p: int, length: float) -> bool:
    """Whether a moving pair may meet again at so many different times that they are better taken together."""
    if motion.rest[p] != MOVES or motion.rest[p + 1] != MOVES:
        return False
    closing = difference(path.forms[p + 1], path.forms[p])
    return radius(path.forms[N + p]) > max(high(closing), 0.0) * length


@compiled_apart
def embrace(cell: Cell, path: Path, p: int) -> None:
    """Take a pair that may or may not be in contact as one that is."""
    N, P = cell.speed.shape[0], cell.gap.shape[0]
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


# A bound on harm that needs no path: by the speeds that the vehicles of a line may still have.
#
# Where a path cannot be followed, this is what is said of the worlds that go it, so that no bound is ever infinite.
#
# A vehicle on its own is at most as fast as it is, or as it drives up to its limit. In an impact of a pair whose
# closing
# speed is w each one's speed changes by its share of (1 + e) w. Let u be the largest of all own speeds, e restitution,
# and nobody move backwards yet. A rear vehicle is slowed by an impact, and left with at least -e times its speed; a
# front
# one that was at rest has at most (1 + e) times the rear one's. So the middle one of three is between -e u and (1 + e)
# u
# until its second pair meets. (Three that touch are one cluster, in which each ends with P + e (P - v) for a mean P of
# their speeds v: between the same bounds.)


@compiled_apart
def driven(cell: Cell, i: int, speed: float, since: float) -> float:
    """Largest speed of a vehicle that is at most as fast as this at a time, by its own drive from then on."""
    drive, rest = 0.0, cell.times[-1] - since
    if i == cell.vehicle:
        for j in range(cell.action.shape[0]):
            if cell.times[j + 1] > since:
                drive = max(drive, cell.action[j] * high(cell.drive))
    elif cell.constant[i] > 0.0:
        drive = cell.constant[i]
    most: float = max(speed, min(cell.limit[i], speed + drive * rest)) if drive > 0.0 else speed
    return most


@compiled_apart
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


@compiled_apart
def rough_at_alert(cell: Cell, late: Floats) -> float:
    """Upper bound on the harm of all worlds of a cell whose first piece of time begins ``late`` after the alert."""
    N, P, width = cell.speed.shape[0], cell.gap.shape[0], cell.speed.shape[1]
    path = Path(np.zeros((N + P + 1, width)), np.zeros((P, TOUCH_WIDTH)), np.zeros(2 * P + 1, np.int64))
    for i in range(N):
        path.forms[i] = cell.speed[i]
        if i != cell.vehicle and cell.constant[i] > 0.0:
            path.forms[i, -1] += cell.constant[i] * high(late)
    return rough_harm(cell, path, -1)


@compiled_apart
def rough_rest(cell: Cell, own: Floats, backwards: float, since: float, path: Path, hit: int) -> float:
    """Largest sum of the squared closing speeds of first impacts that are still to come."""
    P, e = cell.gap.shape[0], cell.restitution
    first = path.marks[0] == 1 or hit == 0
    if P == 1:
        alone: float = 0.0 if first else own[1] * own[1]
        return alone
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
    most: float = max(fastest * fastest + back * back, own[2] * own[2] + ahead * ahead)
    return most
