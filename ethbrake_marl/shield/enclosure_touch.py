"""Pairs of a box of worlds that stay in contact: they bounce a little, then move as one, then part."""

from __future__ import annotations

import math

from ethbrake_marl.physics import Floats
from ethbrake_marl.physics.compiled import compiled_apart
from ethbrake_marl.physics.events import PLASTIC_SPEED_MPS
from ethbrake_marl.shield.enclosure_motion import (
    APART,
    HARDEST,
    MOVES,
    PARTS,
    SINCE,
    SOFTEST,
    STANDS,
    TOUCHES,
    WIDE,
    Cell,
    Motion,
    Path,
    stop,
)
from ethbrake_marl.shield.forms import add, between, cut, difference, high, low, product, radius


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
def move_together(cell: Cell, path: Path, motion: Motion, p: int, length: float) -> None:
    """A pair in contact through one piece of time. Its speeds are those of its centre of mass, from which it may differ

    by ``path.touch``; ``motion`` holds both as if alone.
    """
    touch, front, rear = path.touch[p], p, p + 1
    least, most = pressing_together(motion, p)
    if motion.rest[front] == STANDS and motion.rest[rear] == STANDS:
        brakes = -max(high(motion.pull[front]), high(motion.pull[rear]))
        motion.way[front, -1] += touch[APART] * length
        motion.way[rear, -1] += touch[APART] * length
        touch[APART] = max(touch[APART] - max(brakes, 0.0) * length, 0.0)
        return
    if touch[APART] + most * length < 0.0:
        part(cell, path, motion, p, length)
        return
    vague = max(motion.vague[front], motion.vague[rear])
    for rows in (motion.pull, motion.onward, motion.reach):
        rows[front] = common(cell, p, rows[front], rows[rear])
    motion.rest[front], motion.vague[front] = MOVES, vague
    motion.speed[front], motion.way[front] = motion.onward[front], motion.reach[front]
    if low(motion.onward[front]) < 0.0 and high(motion.pull[front]) - vague < 0.0:
        stop(path.forms[front], front, length, motion)
        motion.way[front, -1] += touch[APART] * length  # one of them may stand before the other
    for rows in (motion.pull, motion.onward, motion.reach, motion.speed, motion.way):
        rows[rear] = rows[front]
    motion.rest[rear], motion.vague[rear] = motion.rest[front], vague
    bounce(touch, least, most, length, cell.restitution)


@compiled_apart
def part_of(cell: Cell, path: Path, p: int, side: int) -> float:
    """Share of the difference of speeds of a pair in contact that one of them has against their common speed.

    All of it, where one may stand while the other one still moves: then it is not their commands that act on both.
    """
    return 1.0 if low(path.forms[p]) <= path.touch[p, APART] else high(cell.share[p, side])


@compiled_apart
def part(cell: Cell, path: Path, motion: Motion, p: int, length: float) -> None:
    """A pair that was in contact opens in this piece: from now on each moves alone."""
    N, P = cell.speed.shape[0], cell.gap.shape[0]
    apart, wide, width = path.touch[p, APART], path.touch[p, WIDE], cell.speed.shape[1]
    path.marks[P + p] = PARTS
    path.forms[N + p] = between(-apart * length, wide + apart * length, width)
    for side in range(2):
        share = part_of(cell, path, p, side)
        for rows in (motion.onward, motion.speed):
            rows[p + side, -1] += share * apart
        for rows in (motion.reach, motion.way):
            rows[p + side, -1] += share * apart * length
        neighbour = p - 1 + 2 * side
        if 0 <= neighbour < P:
            add(path.forms[N + neighbour], 1.0, between(-share * wide, 0.0, width))


@compiled_apart
def bounce(touch: Floats, least: float, most: float, length: float, restitution: float) -> None:
    """What becomes of the difference of speeds and of the gap of a pair in contact within one piece.

    While it is pressed together by b between b- and b+, a flight that begins with separating speed s ends after at most
    2 s / b-, with a closing speed of at most s sqrt(b+ / b-); an impact leaves the share e of it, none below the plastic
    speed. So after 2 s / (b- (1 - e sqrt(b+ / b-))) the two move as one.
    """
    apart, wide = touch[APART], touch[WIDE]
    if apart == 0.0 and wide == 0.0 and least >= 0.0:
        return
    if not least > 0.0:
        largest = max(abs(least), abs(most))
        touch[APART] = apart + largest * length
        touch[WIDE] = wide + (apart + largest * length) * length
        touch[SOFTEST], touch[HARDEST], touch[SINCE] = math.inf, 0.0, 0.0
        return
    if least < touch[SOFTEST] or most > touch[HARDEST]:
        touch[SOFTEST], touch[HARDEST] = min(least, touch[SOFTEST]), max(most, touch[HARDEST])
        height = wide + 0.5 * apart * apart / touch[SOFTEST]
        fastest = math.sqrt(apart * apart + 2.0 * touch[HARDEST] * height)
        touch[WIDE] = min(height, wide + fastest * length)
        touch[APART], touch[SINCE] = fastest, 0.0
    touch[SINCE] += length
    ratio = restitution * math.sqrt(touch[HARDEST] / touch[SOFTEST])
    if touch[APART] < PLASTIC_SPEED_MPS:
        ratio = 0.0
    if ratio < 1.0 and touch[SINCE] * touch[SOFTEST] * (1.0 - ratio) > 2.0 * touch[APART] * (1.0 + 1e-9) + 1e-9:
        touch[APART], touch[WIDE] = 0.0, 0.0


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
    touch[APART], touch[WIDE] = max(abs(low(closing)), abs(high(closing))), max(high(gap), 0.0)
    touch[SOFTEST], touch[HARDEST], touch[SINCE] = math.inf, 0.0, 0.0
    path.forms[p] = common(cell, p, front, rear)
    path.forms[p + 1] = path.forms[p]
    inside = cut(gap, 0.0, math.inf)
    if p > 0:
        add(path.forms[N + p - 1], 1.0, product(cell.share[p, 0], inside))
    if p < P - 1:
        add(path.forms[N + p + 1], 1.0, product(cell.share[p, 1], inside))
    path.marks[P + p] = TOUCHES
