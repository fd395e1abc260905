"""Pairs of a box of worlds that stay in contact: they bounce a little, then move as one, then part."""

from __future__ import annotations

import math

from ethbrake_marl.physics import Floats
from ethbrake_marl.physics.compiled import compiled_apart
from ethbrake_marl.physics.events import PLASTIC_SPEED_MPS
from ethbrake_marl.shield.enclosure_motion import (
    CLOSING,
    HARDEST,
    MOVES,
    OPENING,
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
def move_together(cell: Cell, path: Path, motion: Motion, p: int, length: float) -> None:
    """A pair in contact through one piece of time; ``motion`` holds both as if alone, and then as one.

    Its speeds are those of its centre of mass, from which they may differ by what ``path.touch`` says.
    """
    touch, front, rear = path.touch[p], p, p + 1
    least, most = pressing_together(motion, p)
    if motion.rest[front] == STANDS and motion.rest[rear] == STANDS:
        brakes = -max(high(motion.pull[front]), high(motion.pull[rear]))
        motion.way[front, -1] += apart(touch) * length
        motion.way[rear, -1] += apart(touch) * length
        for column in (OPENING, CLOSING):
            touch[column] = max(touch[column] - max(brakes, 0.0) * length, 0.0)
        return
    if most < 0.0 and touch[CLOSING] <= 0.0 and touch[OPENING] + touch[CLOSING] <= SHARP:
        part(cell, path, motion, p, length)
        return
    vague = max(motion.vague[front], motion.vague[rear])
    brakes = -max(high(motion.pull[front]), high(motion.pull[rear])) - vague
    for rows in (motion.pull, motion.onward, motion.reach):
        rows[front] = common(cell, p, rows[front], rows[rear])
    motion.rest[front], motion.vague[front] = MOVES, vague
    motion.speed[front], motion.way[front] = motion.onward[front], motion.reach[front]
    if low(motion.onward[front]) < 0.0 and high(motion.pull[front]) - vague < 0.0:
        stop(path.forms[front], front, length, motion)
        motion.way[front, -1] += apart(touch) * length  # one of them may stand before the other
    for rows in (motion.pull, motion.onward, motion.reach, motion.speed, motion.way):
        rows[rear] = rows[front]
    motion.rest[rear], motion.vague[rear] = motion.rest[front], vague
    fastest = max(high(path.forms[front]), 0.0) + apart(touch)
    bounce(touch, least, most, length, cell.restitution)
    share = max(high(cell.share[p, 0]), high(cell.share[p, 1]))
    if brakes > 0.0 and share * (1.0 + cell.restitution) <= 1.0:  # no impact makes the faster one faster
        for column in (OPENING, CLOSING):
            touch[column] = min(touch[column], max(fastest - brakes * length, 0.0))


@compiled_apart
def apart(touch: Floats) -> float:
    """Largest difference of speeds of a pair in contact."""
    most: float = max(touch[OPENING], touch[CLOSING], 0.0)
    return most


@compiled_apart
def part_of(cell: Cell, path: Path, p: int, side: int) -> float:
    """Share of the difference of speeds of a pair in contact that one of them has against their common speed.

    All of it, where one may stand while the other one still moves: then it is not their commands that act on both.
    """
    return 1.0 if low(path.forms[p]) <= apart(path.touch[p]) else high(cell.share[p, side])


@compiled_apart
def part(cell: Cell, path: Path, motion: Motion, p: int, length: float) -> None:
    """A pair that was in contact opens in this piece: from now on each moves alone."""
    N, P = cell.speed.shape[0], cell.gap.shape[0]
    touch, width = path.touch[p], cell.speed.shape[1]
    opening, wide = touch[OPENING], touch[WIDE]
    path.marks[P + p] = PARTS
    path.forms[N + p] = between(0.0, wide + opening * length, width)  # by its speeds alone; commands act on top
    for side in range(2):
        share = (2.0 * side - 1.0) * part_of(cell, path, p, side)
        speed = between(min(-share * opening, 0.0), max(-share * opening, 0.0), width)
        for rows in (motion.onward, motion.speed):
            add(rows[p + side], 1.0, speed)
        for rows in (motion.reach, motion.way):
            rows[p + side, -1] += abs(share) * opening * length
        neighbour = p - 1 + 2 * side
        if 0 <= neighbour < P:
            add(path.forms[N + neighbour], 1.0, between(-abs(share) * wide, 0.0, width))


@compiled_apart
def bounce(touch: Floats, least: float, most: float, length: float, restitution: float) -> None:
    """What becomes of the difference of speeds and of the gap of a pair in contact within one piece.

    While it is pressed together by b between b- and b+, a flight that begins with separating speed s ends after at most
    2 s / b-, with a closing speed of at most s sqrt(b+ / b-); an impact leaves the share e of it, none below the
    plastic speed. So after 2 s / (b- (1 - e sqrt(b+ / b-))) the two move as one.
    """
    if touch[OPENING] == 0.0 and touch[CLOSING] <= 0.0 and touch[WIDE] == 0.0 and least >= 0.0:
        touch[CLOSING] = 0.0
        return
    if not least > 0.0:
        struck = restitution * max(touch[CLOSING] + max(most, 0.0) * length, 0.0)
        touch[OPENING] = max(touch[OPENING], struck) - least * length
        touch[CLOSING] += most * length
        touch[WIDE] += max(touch[OPENING], 0.0) * length
        touch[SOFTEST], touch[HARDEST], touch[SINCE] = math.inf, 0.0, 0.0
        return
    wide, fastest = touch[WIDE], apart(touch)
    if least < touch[SOFTEST] or most > touch[HARDEST]:
        touch[SOFTEST], touch[HARDEST] = min(least, touch[SOFTEST]), max(most, touch[HARDEST])
        height = wide + 0.5 * fastest * fastest / touch[SOFTEST]
        fastest = math.sqrt(fastest * fastest + 2.0 * touch[HARDEST] * height)
        touch[WIDE], touch[SINCE] = min(height, wide + fastest * length), 0.0
    touch[OPENING], touch[CLOSING] = fastest, fastest
    touch[SINCE] += length
    ratio = restitution * math.sqrt(touch[HARDEST] / touch[SOFTEST])
    if fastest < PLASTIC_SPEED_MPS:
        ratio = 0.0
    if ratio < 1.0 and touch[SINCE] * touch[SOFTEST] * (1.0 - ratio) > 2.0 * fastest * (1.0 + 1e-9) + 1e-9:
        touch[OPENING], touch[CLOSING], touch[WIDE] = 0.0, 0.0, 0.0


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
    touch[OPENING], touch[CLOSING], touch[WIDE] = max(-low(closing), 0.0), high(closing), max(high(gap), 0.0)
    touch[SOFTEST], touch[HARDEST], touch[SINCE] = math.inf, 0.0, 0.0
    path.forms[p] = common(cell, p, front, rear)
    path.forms[p + 1] = path.forms[p]
    inside = cut(gap, 0.0, math.inf)
    if p > 0:
        add(path.forms[N + p - 1], 1.0, product(cell.share[p, 0], inside))
    if p < P - 1:
        add(path.forms[N + p + 1], 1.0, product(cell.share[p, 1], inside))
    path.marks[P + p] = TOUCHES
