"""Pairs that stay in contact in a box of worlds: they bounce a little, then move as one, then separate.

A pair in contact is described by the motion of its centre of mass, as affine forms, and by bounds on the distance of
both vehicles from it. While both vehicles move forward, only their commands act on the pair, so its centre of mass
follows the commands alone, however often the two collide. A world *creeps* once one of the two stands or moves
backwards: its brakes then hold it instead of decelerating it, and only bounds on the speeds are known. A *flight* is
the time between two impacts of the pair.
"""

from __future__ import annotations

import math

from ethbrake_marl.extensions.certified.affine import (
    CLOSING,
    CREEP,
    HARDEST,
    MOVES,
    OPENING,
    PARTS,
    REACH,
    SINCE,
    SOFTEST,
    SPREAD,
    STANDS,
    WIDE,
    Cell,
    Motion,
    Path,
    add,
    between,
    difference,
    high,
    hold,
    low,
    product,
    radius,
    stop,
)
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.motion import BOUND
from ethbrake_marl.physics.state import Floats

SHARP = 0.1  # m/s; vehicles of an opening pair move alone once their relative speed is known to this

UNEVEN = 3.0  # largest ratio of closing to separating speed of a flight for the bound by flights, with brake build-up


@compiled(apart=True)
def common(cell: Cell, p: int, front: Floats, rear: Floats) -> Floats:
    """Return the value of the centre of mass of pair ``p`` (speed, acceleration or distance) as an affine form [W]
    (centre, slopes, remainder).

    ``front`` and ``rear`` are the values of the two vehicles; ``cell`` holds their shares of the mass.
    """
    out = product(cell.share[p, 1], front)
    add(out, 1.0, product(cell.share[p, 0], rear))
    return out


@compiled(apart=True)
def pressing_together(motion: Motion, p: int) -> tuple[float, float]:
    """Return the least and the largest closing acceleration of pair ``p`` if both commands act, m/s2.

    ``motion`` is the motion of all vehicles in the present piece (time interval of constant command).
    """
    vague = motion.vague[p] + motion.vague[p + 1]
    least = low(motion.pull[p + 1]) - high(motion.pull[p]) - vague
    return least, high(motion.pull[p + 1]) - low(motion.pull[p]) + vague


@compiled(apart=True)
def apart(touch: Floats) -> float:
    """Return the largest difference of speeds of a pair in contact, m/s.

    ``touch`` [TOUCH_WIDTH] is its state, a row of ``Path.touch``.
    """
    return float(max(touch[OPENING], touch[CLOSING], 0.0))


@compiled(apart=True)
def faster(cell: Cell, p: int) -> float:
    """Return by which factor, at least 1, an impact may make the front vehicle of pair ``p`` faster than the rear one
    was.

    ``cell`` holds the coefficient of restitution and the shares of mass.
    """
    return float(max(1.0, (1.0 + cell.restitution) * high(cell.share[p, 0])))


@compiled(apart=True)
def backwards(cell: Cell, p: int) -> float:
    """Return the largest backward speed of the rear vehicle of pair ``p`` after an impact, as a multiple of its speed
    before.

    It is at least 0. ``cell`` holds the coefficient of restitution and the shares of mass.
    """
    return float(max(0.0, (1.0 + cell.restitution) * high(cell.share[p, 1]) - 1.0))


@compiled(apart=True)
def stray(cell: Cell, touch: Floats, p: int) -> float:
    """Return the largest difference between the speed of a pair's centre of mass and the speed in its affine form, m/s.

    It is above 0 only if one of the two vehicles may stand or move backwards. The form's speed then lies between 0 and
    ``CREEP``, the rear vehicle's between minus ``backwards`` and 1 times ``CREEP``, and the front vehicle's between 0
    and ``faster`` times ``CREEP``: no impact makes a rear vehicle faster.

    Args:
        cell: the box of worlds (a range for each quantity), with its commands and its pieces (time intervals of
            constant command).
        touch: [TOUCH_WIDTH] state of the pair in contact, a row of ``Path.touch``.
        p: index of the pair: vehicle ``p`` is in front, vehicle ``p + 1`` behind.

    """
    return float(max(faster(cell, p), 1.0 + backwards(cell, p)) * touch[CREEP])


@compiled(apart=True)
def blur(cell: Cell, path: Path, p: int, side: int) -> float:
    """Return the largest deviation of a vehicle's speed from the affine form of its pair in contact, m/s.

    Args:
        cell: the box of worlds (a range for each quantity), with its commands and its pieces (time intervals of
            constant command).
        path: worlds of the box that had the same impacts so far; its forms describe the start of the piece.
        p: index of the pair: vehicle ``p`` is in front, vehicle ``p + 1`` behind.
        side: 0 for the front vehicle of the pair, 1 for the rear one.

    """
    return float(high(cell.share[p, side]) * path.touch[p, SPREAD] + stray(cell, path.touch[p], p))


@compiled(apart=True)
def begin_touch(touch: Floats) -> None:
    """Reset the state of a pair in contact, in place; the columns of the present piece (SPREAD, REACH) stay.

    ``touch`` [TOUCH_WIDTH] is the state, a row of ``Path.touch``.
    """
    spread, reach = touch[SPREAD], touch[REACH]  # columns of the present piece
    touch[:] = 0.0
    touch[SPREAD], touch[REACH], touch[SOFTEST] = spread, reach, math.inf


@compiled(apart=True)
def move_together(cell: Cell, path: Path, motion: Motion, p: int, length: float) -> None:
    """Move pair ``p``, which is in contact, through the present piece (time interval of constant command).

    On entry ``motion`` holds both vehicles as if alone. On return it holds them moving as one, or apart if they
    separate.

    Args:
        cell: the box of worlds (a range for each quantity), with its commands and its pieces (time intervals of
            constant command).
        path: worlds of the box that had the same impacts so far; changed in place.
        motion: motion of each vehicle in the present piece, as if alone (``move_alone``); changed in place.
        p: index of the pair: vehicle ``p`` is in front, vehicle ``p + 1`` behind.
        length: length of the piece, s.

    """
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
    """Return by how much (m/s) a speed may fall below its values at both ends of a piece.

    This can happen if the vehicle's force changes sign in it. ``vague`` is the largest deviation of the acceleration
    from its mean (m/s2), ``length`` the length of the piece (s).

    A piece is a time interval of constant command; ``cell`` is the box of worlds.
    """
    return 0.5 * vague * length if cell.moving else 0.0


@compiled(apart=True)
def own_pulls(motion: Motion, p: int) -> tuple[float, float]:
    """Return the least and the largest acceleration (m/s2) by the commands of either vehicle of pair ``p`` in a
    piece.

    ``motion`` is the motion of all vehicles in the piece (time interval of constant command).
    """
    weakest = min(low(motion.pull[p]) - motion.vague[p], low(motion.pull[p + 1]) - motion.vague[p + 1])
    return weakest, max(high(motion.pull[p]) + motion.vague[p], high(motion.pull[p + 1]) + motion.vague[p + 1])


@compiled(apart=True)
def creep(cell: Cell, touch: Floats, p: int, slowest: float, weakest: float, hardest: float, length: float) -> None:
    """Update the state of a pair in contact for worlds that may creep: one of its vehicles stands or moves backwards.

    Args:
        cell: the box of worlds (a range for each quantity), with its commands and its pieces (time intervals of
            constant command).
        touch: [TOUCH_WIDTH] state of the pair in contact, a row of ``Path.touch``; changed in place.
        p: index of the pair: vehicle ``p`` is in front, vehicle ``p + 1`` behind.
        slowest: least speed of the centre of mass in the piece, m/s.
        weakest: least acceleration by either command, m/s2.
        hardest: largest acceleration by either command, m/s2.
        length: length of the piece, s.

    """
    largest = max(
        high(cell.share[p, 0]), high(cell.share[p, 1])
    )  # share of one vehicle, relative to the centre of mass
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
    """Update pair ``p``, which is in contact, over a piece in which the affine form of its speed stands at 0.

    In each world either both vehicles stand, or the world *creeps* and the brakes slow it. A world creeps if one
    vehicle of the pair stands or moves backwards.

    The brakes b reduce the rear vehicle's speed. The front vehicle's speed is at most ``faster`` times the rear one's.

    The motion of the pair in ``path`` and ``motion`` is changed in place.

    Args:
        cell: the box of worlds (a range for each quantity), with its commands and its pieces (time intervals of
            constant command).
        path: worlds of the box that had the same impacts so far; changed in place.
        motion: motion of each vehicle in the present piece; changed in place.
        p: index of the pair: vehicle ``p`` is in front, vehicle ``p + 1`` behind.
        length: length of the piece, s.

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
    """Separate pair ``p``, which was in contact and opens in the present piece: both vehicles move alone from then on.

    Args:
        cell: the box of worlds (a range for each quantity), with its commands and its pieces (time intervals of
            constant command).
        path: worlds of the box that had the same impacts so far; changed in place.
        motion: motion of each vehicle in the present piece; changed in place.
        p: index of the pair: vehicle ``p`` is in front, vehicle ``p + 1`` behind.
        length: length of the piece, s.

    """
    N, P = cell.speed.shape[0], cell.gap.shape[0]
    touch, width = path.touch[p], cell.speed.shape[1]
    opening, wide, astray = max(touch[OPENING], 0.0), touch[WIDE], stray(cell, touch, p)
    path.marks[P + p] = PARTS
    touch[REACH] = wide + opening * length
    path.forms[N + p] = between(
        0.0, touch[REACH], width
    )  # from the relative speed alone; the effect of the commands is added later
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
    """Update the relative speed and the gap of pair ``p``, which is in contact, over the present piece.

    An impact never increases the relative speed, so it grows at most by what the commands add. While the pair is
    pressed together by b between b- (``least``) and b+ (``most``), it does not grow: from gap g and relative speed w, a
    *flight* (the time between two impacts) never exceeds the gap h = g + w^2 / (2 b-) and closes with at most sqrt(2 b+
    h); the impact leaves the share e (restitution) of that. This is less than before if e sqrt(b+ / b-) < 1. (Where one
    vehicle stands or moves backwards, its holding brakes make a flight lower and slower.)

    Args:
        cell: the box of worlds (a range for each quantity), with its commands and its pieces (time intervals of
            constant command).
        touch: [TOUCH_WIDTH] state of the pair in contact, a row of ``Path.touch``; changed in place.
        p: index of the pair: vehicle ``p`` is in front, vehicle ``p + 1`` behind.
        least: least closing acceleration, m/s2.
        most: largest closing acceleration, m/s2.
        length: length of the piece, s.
        vague: largest deviation of an acceleration from its mean, m/s2.

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
    """Start a new phase of a contact: the pair is now pressed together harder or less hard than in the phase before.

    The new phase covers the accelerations of both if the relative speed then still decays from impact to impact, else
    its own accelerations alone.

    Args:
        touch: state of the pair in contact, a row of ``Path.touch``; changed in place.
        e: coefficient of restitution.
        softest: least closing acceleration of both phases, m/s2.
        hardest: largest closing acceleration of both phases, m/s2.
        least: least closing acceleration of the new phase, m/s2.
        most: largest closing acceleration of the new phase, m/s2.

    """
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
    """Reset the state of a contact if the pair certainly moves as one by the end of the present piece.

    Suppose that the closing acceleration lies between ``b-`` and ``b+``. A *flight* (the time between two impacts) that
    begins with separating speed s lasts at most ``2 s / b-`` and ends with a closing speed of at most
    ``s sqrt(b+ / b-)``. The next flight begins with e times that speed, so the durations add up to at most
    ``2 s / (b- (1 - e sqrt(b+ / b-)))``. After that time the two move as one, unless one stands or moves backwards.

    Args:
        touch: state of the pair in contact, a row of ``Path.touch``; changed in place.
        e: coefficient of restitution.
        length: length of the piece (time interval of constant command), s.

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
    """Return whether the gap of pair ``p`` is too uncertain for a further impact to be followed in this piece.

    The gap is too uncertain if its uncertainty exceeds the largest distance by which it can shrink during this time
    interval. The pair is then treated as in contact from the start of the interval.

    Args:
        path: worlds of the box that had the same impacts so far.
        motion: motion of each vehicle in the present piece (time interval of constant command).
        N: number of vehicles.
        p: index of the pair: vehicle ``p`` is in front, vehicle ``p + 1`` behind.
        length: length of the piece, s.

    """
    if motion.rest[p] != MOVES or motion.rest[p + 1] != MOVES:
        return False
    closing = difference(path.forms[p + 1], path.forms[p])
    return radius(path.forms[N + p]) > max(high(closing), 0.0) * length
