"""Motion of two vehicles from their impact to the end of the piece, in all worlds of a box.

Arrays without a stated shape are affine forms [W] (module ``affine``). Arguments that several functions share: ``p`` is
the index of the pair (vehicle ``p`` in front, vehicle ``p + 1`` behind), and ``left`` the time from the impact to the
end of the piece, s. ``motion`` is the motion of all vehicles without the impact, and ``how`` the result of ``approach``
for pair ``p``. ``after`` is the path after the impact; the functions write the speeds of both vehicles at the end of
the piece into it. They write the distances (m) that both vehicles travel in the piece into ``way`` [N, W].
"""

from __future__ import annotations

from ethbrake_marl.extensions.certified.affine import (
    Cell,
    Motion,
    Path,
    add,
    between,
    between_shifted,
    difference,
    high,
    low,
    positive_part,
    product,
    square,
)
from ethbrake_marl.extensions.certified.approach import Approach
from ethbrake_marl.extensions.certified.touching import common, creep, dip_of, own_pulls, stray
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.state import Floats


@compiled(apart=True)
def spring_apart(
    cell: Cell, motion: Motion, p: int, how: Approach, jump: Floats, left: Floats, after: Path, way: Floats
) -> None:
    """Compute the motion of both vehicles of a pair that separates after an impact, up to the end of the piece.

    ``jump`` is the change of the pair's relative speed by the impact, m/s.
    """
    front, rear = product(cell.share[p, 0], jump), product(cell.share[p, 1], jump)
    after.forms[p + 1] = difference(motion.onward[p + 1], rear)
    way[p + 1] = difference(motion.reach[p + 1], product(rear, left))
    if how.front_stands:
        after.forms[p] = front  # the front vehicle stood before the impact; after it, it brakes
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
    """Correct ``speed`` and ``way`` of a braking vehicle in place: the vehicle stands from the time at which its speed
    would become negative.

    Args:
        cell: only ``moving`` is read.
        pull: mean acceleration after the impact, m/s2.
        vague: largest deviation of the acceleration from ``pull``, m/s2.
        left: longest time from the impact to the end of the piece, s (a number).
        speed: speed at the end of the piece, m/s.
        way: distance travelled in the piece, m.

    """
    least = low(speed)
    if cell.moving and low(pull) - vague < 0.0 < high(pull) + vague:  # the vehicle may drive off again, as in ``hold``
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
    """Compute the motion of both vehicles of a pair that stays in contact after an impact, up to the end of the piece.

    Both vehicles get the speed of the pair's centre of mass. ``speed`` is the closing speed at the impact, m/s. The
    function also updates the state of the pair in contact, ``after.touch[p]``.
    """
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
