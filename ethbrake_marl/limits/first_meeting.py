"""Compiled: the least harm over all first meetings with one neighbour, by branch and bound.

A meeting is a time and a closing speed. What it costs is its own closing speed squared and what must follow
(``aftermath``). Cells of time and closing speed are halved until their bounds come close to the best meeting seen.
docs/avoidability.md has the proof.
"""

from __future__ import annotations

import math

from ethbrake_marl.limits.aftermath import after
from ethbrake_marl.limits.meetings import (
    A_F,
    A_L,
    FRONT_FIRST,
    LIMIT_F,
    TIME_STEP,
    U_F,
    V_L,
    follower,
    gentlest,
    leader,
)
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.worlds import Floats

CELL = 5e-4  # a minimum over meetings is bounded this closely, relative to 1 m2/s2 and to itself
STACK = 512
MOST_CELLS = 20_000  # after which a minimum stays as loose as it is
EARLY, LATE, SOFT, HARD, CELL_WIDTH = range(5)  # columns of the stack: times (s) and closing speeds (m/s) of a cell
_SPLITS = 64  # parts at most into which decisions divide the times
_TRIED = 8  # meetings tried before the search, to have something to compare with


@compiled
def gentlest_between(kind: int, at: Floats, early: float, late: float) -> float:
    """Least closing speed of the meetings between two times.

    It falls with the time, but for a leader that brakes harder than the controlled vehicle: it may then rise by the
    difference.
    """
    least = gentlest(kind, at, late)[0]
    if kind == FRONT_FIRST and at[A_L] > at[A_F] and early * at[A_L] < at[V_L]:
        least -= (at[A_L] - at[A_F]) * (late - early)
    return max(least, 0.0)


@compiled
def decision_around(at: Floats, early: float, late: float) -> tuple[float, float]:
    """Start and end of the step that holds these times; without decisions, or over more than one step, both ``late``."""
    step = at[TIME_STEP]
    if step <= 0.0:
        return late, late
    begin = math.floor(0.5 * (early + late) / step) * step
    if early < begin - 1e-9 or late > begin + step + 1e-9:
        return late, late
    return begin, begin + step


@compiled
def lacking(kind: int, at: Floats, early: float, late: float, softest: float, hard: float, begin: float) -> float:
    """How much the command in force at the meetings of a cell lacks, at least, of the extreme one that follows best.

    To meet gently the vehicle brakes (drives) before a meeting, and to soften what follows it drives (brakes) after it;
    the command is one and the same in the whole step. Meetings of at most ``hard``, where ``softest`` is the least.
    """
    whole = at[U_F] + at[A_F]
    turn = gentlest(kind, at, early)[1]
    if early <= begin:
        return 0.0
    if kind == FRONT_FIRST:
        if leader(at, early)[0] + hard >= at[LIMIT_F]:
            return 0.0
    elif follower(at, late)[0] <= hard:
        return 0.0
    softer = max(hard - softest, 0.0) / (early - begin)
    if turn >= begin:
        share = (turn - begin) / (early - begin)
        return max(whole - 2.0 * softer - whole * share * share, 0.0)
    steep = (late - begin) / (begin - turn)
    return max(whole - softer * (1.0 + steep) / (1.0 + 0.5 * steep), 0.0)


@compiled
def harm_of(
    kind: int, at: Floats, early: float, late: float, soft: float, hard: float, floor: float, plan: Floats,
    other: Floats,
) -> float:  # fmt: skip
    """Lower bound of the harm of the meetings of a cell."""
    begin, end = decision_around(at, early, late)
    lack = 0.0
    if end > late:
        lack = lacking(kind, at, early, late, gentlest_between(kind, at, early, late), hard, begin)
    follows = after(kind, at, early, late, hard, max(end, late), lack, plan, other)
    return soft * soft + max(follows, floor)


@compiled
def push(stack: Floats, depth: int, early: float, late: float, soft: float, hard: float) -> int:
    """Put a cell on the stack; its new depth."""
    stack[depth, EARLY], stack[depth, LATE], stack[depth, SOFT], stack[depth, HARD] = early, late, soft, hard
    return depth + 1


@compiled
def least_harm(
    kind: int, at: Floats, first: float, last: float, floor: float, best: float, plan: Floats, other: Floats,
    stack: Floats,
) -> float:  # fmt: skip
    """Lower bound of the harm of all meetings between two times; ``best`` if none does less than that."""
    for k in range(_TRIED):
        time = first + (last - first) * k / (_TRIED - 1)
        closing = gentlest(kind, at, time)[0]
        best = min(best, harm_of(kind, at, time, time, closing, closing, floor, plan, other))
    hard = math.sqrt(best)
    depth, time = 0, first
    while time < last:
        until = next_split(kind, at, time, last)
        if depth + 3 > _SPLITS:
            until = last
        depth = push(stack, depth, time, until, gentlest_between(kind, at, time, until), hard)
        time = until
    bound = best
    cells = 0
    while depth > 0:
        depth -= 1
        cells += 1
        early, late, soft, hard = stack[depth, EARLY], stack[depth, LATE], stack[depth, SOFT], stack[depth, HARD]
        if soft >= hard:
            continue
        harm = harm_of(kind, at, early, late, soft, hard, floor, plan, other)
        if harm >= best - CELL * (1.0 + best) or depth + 2 > stack.shape[0] or cells > MOST_CELLS:
            bound = min(bound, harm)
            continue
        middle = 0.5 * (early + late)
        if (late - early) * (at[U_F] + at[A_F] + at[A_L]) > hard - soft and early < middle < late:
            closing = max(soft, gentlest(kind, at, middle)[0])
            best = min(best, harm_of(kind, at, middle, middle, closing, closing, floor, plan, other))
            depth = push(stack, depth, middle, late, soft, hard)
            depth = push(stack, depth, early, middle, max(soft, gentlest_between(kind, at, early, middle)), hard)
            continue
        middle = 0.5 * (soft + hard)
        best = min(best, harm_of(kind, at, late, late, middle, middle, floor, plan, other))
        depth = push(stack, depth, early, late, middle, hard)
        depth = push(stack, depth, early, late, soft, middle)
    return bound


@compiled
def next_split(kind: int, at: Floats, time: float, last: float) -> float:
    """The next time at which a decision falls or the leader comes to rest, at most ``last``."""
    until = last
    if at[TIME_STEP] > 0.0:
        until = min(until, (math.floor(time / at[TIME_STEP] + 1e-6) + 1.0) * at[TIME_STEP])
    stand = at[V_L] / at[A_L]
    if kind == FRONT_FIRST and time < stand:
        until = min(until, stand)
    return until
