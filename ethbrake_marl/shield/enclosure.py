"""An upper bound on the first-impact harm of a plan over a whole box of worlds.

Every way in which impacts may follow each other in the box is a path. In each piece of time a path goes on without an
impact, and another one branches off for each pair that may have one then. The harm of a path that has ended is a form;
the bound is the largest value of any. Lines of at most three vehicles: once two pairs were hit, harm is final.
"""

from __future__ import annotations

import math

import numpy as np

from ethbrake_marl.physics import Floats
from ethbrake_marl.physics.compiled import compiled_apart
from ethbrake_marl.physics.events import TOUCH_SPEED_MPS
from ethbrake_marl.shield.enclosure_contact import approach, may_meet, noise
from ethbrake_marl.shield.enclosure_impact import Stack, branch, keep_rough, keep_worst
from ethbrake_marl.shield.enclosure_motion import (
    FREE,
    MAY_STOP,
    MOVES,
    ROUNDING,
    STANDS,
    TOUCHES,
    WIDE,
    Cell,
    Motion,
    Path,
    move_alone,
)
from ethbrake_marl.shield.enclosure_touch import embrace, is_blurred, move_together, pressing_together
from ethbrake_marl.shield.forms import (
    add,
    high,
)

MOST_PATHS = 4000  # of one cell


@compiled_apart
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
            return give_up(cell, stack, worst, out)
    return worst if worst >= 0.0 else math.inf  # each world goes some way


@compiled_apart
def give_up(cell: Cell, stack: Stack, worst: float, out: Floats) -> float:
    """The larger one of ``worst`` and of what is certain of all paths that wait."""
    for k in range(stack.size[0]):
        worst = keep_rough(cell, Path(stack.forms[k], stack.touch[k], stack.marks[k]), -1, worst, out)
    return worst


@compiled_apart
def follow(cell: Cell, path: Path, stack: Stack, motion: Motion, worst: float, out: Floats) -> float:
    """Follow a path to its end; the larger one of ``worst`` and its harm and that of the paths that end with it."""
    N, P = cell.speed.shape[0], cell.gap.shape[0]
    quiet = quiet_from(cell)
    while path.marks[2 * P] < cell.action.shape[0]:
        piece = path.marks[2 * P]
        move_alone(cell, path, piece, motion)
        if may_meet_unseen(cell, path, motion):
            return keep_rough(cell, path, -1, worst, out)
        worst = meet(cell, path, stack, motion, worst, out)
        if not go_on(cell, path, motion):
            return worst
        path.marks[2 * P] += 1
        if piece >= quiet and (motion.rest == STANDS).all() and path.touch[:, :WIDE].max() <= 0.0:
            break
    return keep_worst(path.forms[N + P], worst, out)


@compiled_apart
def quiet_from(cell: Cell) -> int:
    """The piece of time from which on nobody drives."""
    quiet = 0
    for j in range(cell.action.shape[0]):
        if cell.action[j] > 0.0:
            quiet = j + 1
    for i in range(cell.constant.shape[0]):
        if i != cell.vehicle and cell.constant[i] > 0.0:
            quiet = cell.action.shape[0]
    return quiet


@compiled_apart
def may_meet_unseen(cell: Cell, path: Path, motion: Motion) -> bool:
    """Whether a pair that touched without an impact may open in this piece and meet again, which would be its first."""
    P = cell.gap.shape[0]
    for p in range(P):
        if path.marks[P + p] == TOUCHES and path.marks[p] == 0:
            least, most = pressing_together(motion, p)
            if least < 0.0 <= most and not (motion.rest[p : p + 2] == STANDS).all():
                return True
    return False


@compiled_apart
def meet(cell: Cell, path: Path, stack: Stack, motion: Motion, worst: float, out: Floats) -> float:
    """Pairs in contact, and those that may come into contact, in one piece of time; ``worst`` as ``follow``."""
    N, P = cell.speed.shape[0], cell.gap.shape[0]
    length = cell.times[path.marks[2 * P] + 1] - cell.times[path.marks[2 * P]]
    for p in range(P):
        again = path.marks[P + p] == FREE and path.marks[p] == 1 and (P == 1 or path.marks[2 * P - 1 - p] == FREE)
        if again and may_meet(cell, path, motion, p, length) and is_blurred(path, motion, N, p, length):
            embrace(cell, path, p)
        if path.marks[P + p] == TOUCHES:
            move_together(cell, path, motion, p, length)
    for p in range(P):
        if path.marks[P + p] == FREE and may_meet(cell, path, motion, p, length):
            worst = impacts(cell, path, stack, motion, p, worst, out)
    return worst


@compiled_apart
def impacts(cell: Cell, path: Path, stack: Stack, motion: Motion, p: int, worst: float, out: Floats) -> float:
    """The impacts that a pair may have in one piece of time, its front moving then or standing."""
    P = cell.gap.shape[0]
    length = cell.times[path.marks[2 * P] + 1] - cell.times[path.marks[2 * P]]
    for i in range(p, p + 2):
        motion.way[i, -1] += TOUCH_SPEED_MPS * length  # by a touch, which is no impact
        if motion.rest[i] == MOVES or high(motion.speed[i]) > 0.0 or high(motion.pull[i]) + motion.vague[i] >= 0.0:
            motion.speed[i, -1] += TOUCH_SPEED_MPS
    for stands in range(2):
        if (motion.rest[p] == STANDS) == (stands == 1) or motion.rest[p] == MAY_STOP:
            how, there = approach(cell, path, motion, p, length, stands == 1)
            if there:
                worst = branch(cell, path, stack, motion, p, how, worst, out)
    return worst


@compiled_apart
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
