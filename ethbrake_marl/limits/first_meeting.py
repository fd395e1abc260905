"""Compiled: the least harm over all first meetings with one neighbour, by branch and bound.

A meeting is a time and a closing speed. What it costs is its own closing speed squared and what must follow
(``aftermath``). Cells of time and closing speed are halved until their bounds come close to the best meeting seen.
docs/avoidability.md has the proof.
"""

from __future__ import annotations

import math

from ethbrake_marl.limits.aftermath import after, obstacle_harm
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
from ethbrake_marl.physics.compiled import compiled, compiled_apart
from ethbrake_marl.physics.worlds import Floats

CELL = 1e-3  # a minimum over meetings is bounded this closely, relative to 1 m2/s2 and to itself
CELLS = 600  # room on the heap: after that many divisions a minimum stays as loose as it is
HARM, EARLY, LATE, SOFT, HARD, CELL_WIDTH = range(6)  # columns of the heap: bound, times (s), closing speeds (m/s)
_SPLITS = 64  # parts at most into which decisions divide the times
_TRIED = 8  # meetings tried before the search, to have something to compare with


@compiled_apart
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
    """Start and end of the step that holds these times; both ``late`` without decisions or over more than one."""
    step = at[TIME_STEP]
    if step <= 0.0:
        return late, late
    begin = math.floor(0.5 * (early + late) / step) * step
    if early < begin - 1e-9 or late > begin + step + 1e-9:
        return late, late
    return begin, begin + step


@compiled_apart
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
        lack: float = max(whole - 2.0 * softer - whole * share * share, 0.0)
        return lack
    steep = (late - begin) / (begin - turn)
    lack = max(whole - softer * (1.0 + steep) / (1.0 + 0.5 * steep), 0.0)
    return lack


@compiled_apart
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
    harm = soft * soft + max(follows, floor)
    return harm + obstacle_harm(at, early, late, soft) if kind == FRONT_FIRST else harm


@compiled_apart
def put(heap: Floats, count: int, harm: float, early: float, late: float, soft: float, hard: float) -> int:
    """Put a cell on the heap, whose first cell is the one of least harm; the new number of cells."""
    at = count
    while at > 0 and heap[(at - 1) // 2, HARM] > harm:
        for c in range(heap.shape[1]):  # numba compiles the copy of a row with the text of an error, for 3 CPU-s
            heap[at, c] = heap[(at - 1) // 2, c]
        at = (at - 1) // 2
    heap[at, HARM], heap[at, EARLY], heap[at, LATE], heap[at, SOFT], heap[at, HARD] = harm, early, late, soft, hard
    return count + 1


@compiled_apart
def drop_first(heap: Floats, count: int) -> int:
    """Take the first cell off the heap; the new number of cells."""
    count -= 1
    at, below = 0, 1
    while below < count:
        if below + 1 < count and heap[below + 1, HARM] < heap[below, HARM]:
            below += 1
        if heap[below, HARM] >= heap[count, HARM]:
            break
        for c in range(heap.shape[1]):
            heap[at, c] = heap[below, c]
        at, below = below, 2 * below + 1
    for c in range(heap.shape[1]):
        heap[at, c] = heap[count, c]
    return count


@compiled_apart
def first_cells(
    kind: int, at: Floats, first: float, last: float, hard: float, floor: float, plan: Floats, other: Floats,
    heap: Floats,
) -> int:  # fmt: skip
    """Put the meetings between two times, at most ``hard``, on the heap: one cell for each step; their number."""
    count, time = 0, first
    while time < last:
        until = next_split(kind, at, time, last) if count < _SPLITS else last
        soft = gentlest_between(kind, at, time, until)
        if soft < hard:
            harm = harm_of(kind, at, time, until, soft, hard, floor, plan, other)
            count = put(heap, count, harm, time, until, soft, hard)
        time = until
    return count


@compiled_apart
def divide(
    kind: int, at: Floats, floor: float, count: int, plan: Floats, other: Floats, heap: Floats
) -> tuple[int, float]:
    """Replace the first cell of the heap by its halves; their number, and the harm of a meeting within."""
    harm, early, late, soft, hard = heap[0, HARM], heap[0, EARLY], heap[0, LATE], heap[0, SOFT], heap[0, HARD]
    count = drop_first(heap, count)
    middle = 0.5 * (early + late)
    if (late - early) * (at[U_F] + at[A_F] + at[A_L]) > hard - soft and early < middle < late:
        closing = max(soft, gentlest(kind, at, middle)[0])
        met = harm_of(kind, at, middle, middle, closing, closing, floor, plan, other)
        least = harm_of(kind, at, middle, late, soft, hard, floor, plan, other)
        count = put(heap, count, max(least, harm), middle, late, soft, hard)
        soft, late = max(soft, gentlest_between(kind, at, early, middle)), middle
    else:
        middle = 0.5 * (soft + hard)
        met = harm_of(kind, at, late, late, middle, middle, floor, plan, other)
        least = harm_of(kind, at, early, late, middle, hard, floor, plan, other)
        count = put(heap, count, max(least, harm), early, late, middle, hard)
        hard = middle
    if soft < hard:
        least = harm_of(kind, at, early, late, soft, hard, floor, plan, other)
        count = put(heap, count, max(least, harm), early, late, soft, hard)
    return count, met


@compiled_apart
def least_harm(
    kind: int, at: Floats, first: float, last: float, floor: float, best: float, enough: float, plan: Floats,
    other: Floats, heap: Floats,
) -> float:  # fmt: skip
    """Lower bound of the harm of all meetings between two times; ``best`` if none does less than that.

    ``enough`` is proven without it: where some meeting does no more, 0 is returned at once.
    """
    for k in range(_TRIED):
        time = first + (last - first) * k / (_TRIED - 1)
        closing = gentlest(kind, at, time)[0]
        best = min(best, harm_of(kind, at, time, time, closing, closing, floor, plan, other))
    count = first_cells(kind, at, first, last, math.sqrt(best), floor, plan, other, heap)
    for _ in range(heap.shape[0] - _SPLITS - 2):
        if best <= enough or count == 0 or heap[0, HARM] >= best - CELL * (1.0 + best):
            break
        count, met = divide(kind, at, floor, count, plan, other, heap)
        best = min(best, met)
    if best <= enough:
        return 0.0
    return min(best, heap[0, HARM]) if count > 0 else best


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
