"""Motion of a pair from an impact until it separates, in a box of worlds: after small bounces it moves as one body.

The state of a pair in contact is the motion of its centre of mass, as affine forms, and limits on how far the two
vehicles deviate from this motion. While both vehicles move forward, only their commands act on the pair. The centre of
mass then follows the commands alone, no matter how often the two vehicles collide.

A world *creeps* as soon as one of the two vehicles of the pair stands or moves backwards. The brakes of this vehicle
then hold the vehicle itself, instead of slowing the pair. For a world that creeps, the state of the pair contains only
limits on the speeds.

Arguments that several functions share: ``p`` is the index of the pair (vehicle ``p`` in front, vehicle ``p + 1``
behind), ``touch`` [TOUCH_WIDTH] the state of the pair (a row of ``Path.touch``), and ``length`` the duration of the
piece, s. Functions that return nothing change ``path``, ``motion`` and ``touch`` in place.
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

SHARP = 0.1  # m/s; the vehicles of an opening pair move alone if their relative speed is this certain

UNEVEN = 3.0  # largest ratio of closing to separating speed in a flight, for bounds by flights with brake build-up


@compiled(apart=True)
def common(cell: Cell, p: int, front: Floats, rear: Floats) -> Floats:
    """Return one quantity (speed, acceleration or distance) of the centre of mass of pair ``p``, as an affine form [W].

    ``front`` and ``rear`` are the same quantity for the front and the rear vehicle, as affine forms.
    """
    out = product(cell.share[p, 1], front)
    add(out, 1.0, product(cell.share[p, 0], rear))
    return out


@compiled(apart=True)
def pressing_together(motion: Motion, p: int) -> tuple[float, float]:
    """Return the smallest and the largest closing acceleration (m/s2) of pair ``p`` in a piece if both vehicles
    accelerate as commanded.
    """
    vague = motion.vague[p] + motion.vague[p + 1]
    least = low(motion.pull[p + 1]) - high(motion.pull[p]) - vague
    return least, high(motion.pull[p + 1]) - low(motion.pull[p]) + vague


@compiled(apart=True)
def apart(touch: Floats) -> float:
    """Return the largest possible difference between the speeds of the two vehicles of a pair in contact, m/s."""
    return float(max(touch[OPENING], touch[CLOSING], 0.0))


@compiled(apart=True)
def faster(cell: Cell, p: int) -> float:
    """Return the largest possible ratio v / u, at least 1, for an impact of pair ``p``: v is the front vehicle's speed
    after the impact, and u is the rear vehicle's speed before the impact.
    """
    return float(max(1.0, (1.0 + cell.restitution) * high(cell.share[p, 0])))


@compiled(apart=True)
def backwards(cell: Cell, p: int) -> float:
    """Return the largest backward speed of the rear vehicle of pair ``p`` after an impact, as a multiple (at least 0)
    of its speed before the impact.
    """
    return float(max(0.0, (1.0 + cell.restitution) * high(cell.share[p, 1]) - 1.0))


@compiled(apart=True)
def stray(cell: Cell, touch: Floats, p: int) -> float:
    """Return the largest difference (m/s) between the true speed of a pair's centre of mass and the speed in its affine
    form.

    The result is above 0 only if one of the two vehicles may stand or move backwards. Let c be ``touch[CREEP]``, the
    largest speed of the rear vehicle in worlds that creep. The speed of the centre of mass in its affine form lies
    between 0 and c. The rear vehicle's speed lies between ``-backwards(cell, p) * c`` and c. The front vehicle's speed
    lies between 0 and ``faster(cell, p) * c``. An impact never makes the rear vehicle faster.
    """
    return float(max(faster(cell, p), 1.0 + backwards(cell, p)) * touch[CREEP])


@compiled(apart=True)
def blur(cell: Cell, path: Path, p: int, side: int) -> float:
    """Return the largest difference (m/s) between the speed of a vehicle in contact and the speed of its pair's centre
    of mass.

    ``side`` is 0 for the front vehicle of the pair, 1 for the rear vehicle.
    """
    return float(high(cell.share[p, side]) * path.touch[p, SPREAD] + stray(cell, path.touch[p], p))


@compiled(apart=True)
def begin_touch(touch: Floats) -> None:
    """Reset the state of a pair in contact, except for SPREAD and REACH, which describe the present piece."""
    spread, reach = touch[SPREAD], touch[REACH]  # columns of the present piece
    touch[:] = 0.0
    touch[SPREAD], touch[REACH], touch[SOFTEST] = spread, reach, math.inf


@compiled(apart=True)
def move_together(cell: Cell, path: Path, motion: Motion, p: int, length: float) -> None:
    """Move pair ``p``, which is in contact, through the present piece.

    Before the call, ``motion`` describes each vehicle as if alone on the road. After the call, it describes the two
    vehicles as one body, or as two single vehicles if they separate.
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
    settle(touch, cell.restitution)
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
    """Return by how much (m/s) a vehicle's speed within a piece may fall below the smaller one of its speeds at the
    start and at the end of the piece.

    The speed can fall below both only if the acceleration changes its sign within the piece. ``vague`` is the largest
    deviation of the acceleration from its mean in the piece, m/s2.
    """
    return 0.5 * vague * length if cell.moving else 0.0


@compiled(apart=True)
def own_pulls(motion: Motion, p: int) -> tuple[float, float]:
    """Return the smallest and the largest acceleration (m/s2) that either vehicle of pair ``p`` commands in a piece."""
    weakest = min(low(motion.pull[p]) - motion.vague[p], low(motion.pull[p + 1]) - motion.vague[p + 1])
    return weakest, max(high(motion.pull[p]) + motion.vague[p], high(motion.pull[p + 1]) + motion.vague[p + 1])


@compiled(apart=True)
def creep(cell: Cell, touch: Floats, p: int, slowest: float, weakest: float, hardest: float, length: float) -> None:
    """Update the state of a pair in contact for worlds in which one of its vehicles may stand or move backwards.

    ``slowest`` is the smallest speed of the pair's centre of mass in the piece, m/s. ``weakest`` and ``hardest`` are
    the results of ``own_pulls``.
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
    """Update the state of pair ``p``, which is in contact, over a piece in which the pair's speed, as an affine form,
    is 0.

    In each world, either both vehicles stand, or the world creeps and the brakes slow the other vehicle. The brakes
    reduce the rear vehicle's speed. The front vehicle's speed is at most ``faster(cell, p)`` times the rear vehicle's
    speed.
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
    """Separate the vehicles of pair ``p``, which was in contact and whose gap opens in the present piece.

    After the separation, each vehicle moves under its own command.
    """
    N, P = cell.speed.shape[0], cell.gap.shape[0]
    touch, width = path.touch[p], cell.speed.shape[1]
    opening, wide, astray = max(touch[OPENING], 0.0), touch[WIDE], stray(cell, touch, p)
    path.marks[P + p] = PARTS
    touch[REACH] = wide + opening * length
    path.forms[N + p] = between(
        0.0, touch[REACH], width
    )  # effect of the relative speed; the effect of the commands is added later
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

    An impact never increases the relative speed. The relative speed therefore grows at most at the rate of the closing
    acceleration that the commands cause. While the closing acceleration lies between b- (``least``) and b+ (``most``),
    and b- > 0, the relative speed does not grow. Consider a flight with gap g and relative speed w at some moment. The
    gap in this flight is at most ``h = g + w^2 / (2 b-)``, and the flight ends with a closing speed of at most
    ``sqrt(2 b+ h)``. The next flight starts with a relative speed of e times this closing speed, where e is the
    restitution. So the relative speed decreases from flight to flight if ``e sqrt(b+ / b-) < 1``. If one vehicle stands
    or moves backwards, its own brakes hold it, so that flights are shorter and the relative speeds in them are smaller.

    ``least`` and ``most`` are in m/s2. ``vague`` is the largest deviation of a vehicle's acceleration from its mean in
    the piece, m/s2.
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
    """Start a new phase of a contact, because the closing acceleration of the pair has changed.

    The recorded range of closing accelerations covers both the old and the new phase of the contact, if with this range
    the relative speed still decreases from impact to impact. Otherwise, the recorded range covers only the new phase.

    Args:
        touch: state of the pair.
        e: coefficient of restitution.
        softest: smallest closing acceleration in both phases, m/s2.
        hardest: largest closing acceleration in both phases, m/s2.
        least: smallest closing acceleration of the new phase, m/s2.
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
def settle(touch: Floats, e: float) -> None:
    """Reset the state of a pair in contact if the pair certainly moves as one body by the end of the present piece.

    Let the closing acceleration of the pair lie between ``b-`` and ``b+``, and let e be the restitution. A flight that
    begins with separating speed s lasts at most ``2 s / b-``. This flight ends with a closing speed of at most
    ``s sqrt(b+ / b-)``, and the next flight begins with e times this closing speed. So all flights of the pair together
    last at most ``2 s / (b- (1 - e sqrt(b+ / b-)))``. After the last flight, the two vehicles move as one body, unless
    one stands or moves backwards.
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
    """Return whether the gap of pair ``p`` is too uncertain to simulate a further impact of the pair in this piece.

    The gap is too uncertain if its uncertainty exceeds the largest distance by which the gap can shrink within the
    piece. Such a pair is treated as in contact from the start of the piece. ``N`` is the number of vehicles.
    """
    if motion.rest[p] != MOVES or motion.rest[p + 1] != MOVES:
        return False
    closing = difference(path.forms[p + 1], path.forms[p])
    return radius(path.forms[N + p]) > max(high(closing), 0.0) * length
