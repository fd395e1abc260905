"""Find the smallest harm over all first contacts with one neighbour, by branch and bound.

A first contact has a time and a closing speed. The harm of a first contact is its squared closing speed plus the harm
that must follow (``followers.after``). A *cell* is a set of first contacts: a range of times and a range of closing
speeds. The search halves cells until the smallest bound of any cell is close to the smallest harm that the search has
reached. docs/internals/proofs/lower-bound.md has the proof.

``proofs/__init__.py`` explains the arguments that functions share. A function with the argument ``count`` changes a
binary heap in place: the first ``count`` rows of ``heap`` are cells, and row 0 is the cell with the smallest bound.
"""

from __future__ import annotations

import math

from ethbrake_marl.extensions.proofs.followers import after
from ethbrake_marl.extensions.proofs.line import FRONT_FIRST, LINE, follower, leader
from ethbrake_marl.extensions.proofs.meetings import gentlest
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.state import Floats

CELL = 1e-3  # relative and absolute (m2/s2) precision of a minimum

CELLS = 600  # size of the heap, which limits the number of divisions

# columns of a cell on the heap: bound (m2/s2); range of times (s); range of closing speeds (m/s)
HARM, EARLY, LATE, SOFT, HARD, HEAP_WIDTH = range(6)

_SPLITS = 64  # largest number of cells at the start of the search, one for each decision step

_TRIED = 8  # number of first contacts evaluated before the search


@compiled(apart=True)
def gentlest_between(kind: int, at: Floats, early: float, late: float) -> float:
    """Return the smallest closing speed (m/s) of first contacts between the times ``early`` and ``late``.

    The later the contact, the smaller (or equal) is the smallest closing speed, with one exception. If the leader
    brakes harder than the controlled vehicle, the smallest closing speed may rise by at most the difference of the two
    braking capacities in each second.
    """
    least = gentlest(kind, at, late)[0]
    if kind == FRONT_FIRST and at[LINE.A_L] > at[LINE.A_F] and early * at[LINE.A_L] < at[LINE.V_L]:
        least -= (at[LINE.A_L] - at[LINE.A_F]) * (late - early)
    return max(least, 0.0)


@compiled
def decision_around(at: Floats, early: float, late: float) -> tuple[float, float]:
    """Return start and end (s) of the decision step that contains both ``early`` and ``late``.

    The function returns ``late`` as start and as end if there are no decision steps, or if ``early`` and ``late`` lie
    in different decision steps.
    """
    step = at[LINE.TIME_STEP]
    if step <= 0.0:
        return late, late
    begin = math.floor(0.5 * (early + late) / step) * step
    if early < begin - 1e-9 or late > begin + step + 1e-9:
        return late, late
    return begin, begin + step


@compiled(apart=True)
def lacking(kind: int, at: Floats, early: float, late: float, softest: float, hard: float, begin: float) -> float:
    """Return a lower bound (m/s2) on the amount by which the controlled vehicle's command at a first contact differs
    from the command that leads to the least harm after this contact.

    If the first contact is with the front vehicle, braking before this contact makes it gentle, and driving after this
    contact softens a later impact from behind. If the first contact is with the rear vehicle, driving is best before
    the contact and braking after it. The command is the same in the whole decision step, which starts at ``begin`` (s),
    so this command cannot be the best command both before and after the contact. ``softest`` is the smallest closing
    speed (m/s) that a first contact between ``early`` and ``late`` can have under any command.
    """
    whole = at[LINE.U_F] + at[LINE.A_F]
    turn = gentlest(kind, at, early)[1]
    if early <= begin:
        return 0.0
    if kind == FRONT_FIRST:
        if leader(at, early)[0] + hard >= at[LINE.LIMIT_F]:
            return 0.0
    elif follower(at, late)[0] <= hard:
        return 0.0
    softer = max(hard - softest, 0.0) / (early - begin)
    if turn >= begin:
        share = (turn - begin) / (early - begin)
        return float(max(whole - 2.0 * softer - whole * share * share, 0.0))
    steep = (late - begin) / (begin - turn)
    return float(max(whole - softer * (1.0 + steep) / (1.0 + 0.5 * steep), 0.0))


@compiled(apart=True)
def harm_of(
    kind: int, at: Floats, early: float, late: float, soft: float, hard: float, floor: float, plan: Floats,
    other: Floats,
) -> float:  # fmt: skip
    """Return a lower bound (m2/s2) on the harm of the first contacts in a range of times and closing speeds."""
    begin, end = decision_around(at, early, late)
    lack = 0.0
    if end > late:
        lack = lacking(kind, at, early, late, gentlest_between(kind, at, early, late), hard, begin)
    follows = after(kind, at, early, late, hard, max(end, late), lack, plan, other)
    return soft * soft + max(follows, floor)


@compiled
def room_for(heap: Floats, count: int, harm: float) -> int:
    """Insert a row for a new cell, whose bound is ``harm`` (m2/s2), into the heap, and return the index of the row.

    The function fills in only the column ``HARM`` of this row. ``count`` does not include the new cell.
    """
    at = count
    while at > 0 and heap[(at - 1) // 2, HARM] > harm:
        for c in range(heap.shape[1]):  # a copy of the whole row would take numba 3 s longer to compile
            heap[at, c] = heap[(at - 1) // 2, c]
        at = (at - 1) // 2
    heap[at, HARM] = harm
    return at


@compiled(apart=True)
def put(heap: Floats, count: int, harm: float, early: float, late: float, soft: float, hard: float) -> int:
    """Add a cell, whose bound is ``harm`` (m2/s2), to the heap, and return the new number of cells."""
    at = room_for(heap, count, harm)
    heap[at, EARLY], heap[at, LATE], heap[at, SOFT], heap[at, HARD] = early, late, soft, hard
    return count + 1


@compiled(apart=True)
def drop_first(heap: Floats, count: int) -> int:
    """Remove row 0 (the cell that has the smallest bound) from the heap, and return the new number of cells."""
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


@compiled(apart=True)
def divide(
    kind: int, at: Floats, floor: float, count: int, plan: Floats, other: Floats, heap: Floats
) -> tuple[int, float]:
    """Split the cell that has the smallest bound into two halves.

    Returns the new number of cells on the heap, and the bound (m2/s2) for one single first contact in the split cell.
    The smallest bound of all first contacts is at most the bound for this one contact.
    """
    harm, early, late, soft, hard = (heap[0, HARM], heap[0, EARLY], heap[0, LATE], heap[0, SOFT], heap[0, HARD])
    count = drop_first(heap, count)
    middle = 0.5 * (early + late)
    if (late - early) * (at[LINE.U_F] + at[LINE.A_F] + at[LINE.A_L]) > hard - soft and early < middle < late:
        closing = max(soft, gentlest(kind, at, middle)[0])
        met = harm_of(kind, at, middle, middle, closing, closing, floor, plan, other)
        if soft < hard:
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


@compiled(apart=True)
def least_harm(
    kind: int, at: Floats, first: float, last: float, floor: float, best: float, enough: float, plan: Floats,
    other: Floats, heap: Floats,
) -> float:  # fmt: skip
    """Return a lower bound (m2/s2) on the harm of every first contact between the times ``first`` and ``last`` (s), or
    ``best`` if ``best`` is smaller.
    """
    for k in range(_TRIED):
        time = first + (last - first) * k / (_TRIED - 1)
        closing = gentlest(kind, at, time)[0]
        best = min(best, harm_of(kind, at, time, time, closing, closing, floor, plan, other))
    # put the contacts between both times, with closing speeds up to ``hard``, on the heap: one cell for each step
    hard = math.sqrt(best)
    count, begin = 0, first
    while begin < last:
        until = next_split(kind, at, begin, last) if count < _SPLITS else last
        soft = gentlest_between(kind, at, begin, until)
        if soft < hard:
            harm = harm_of(kind, at, begin, until, soft, hard, floor, plan, other)
            count = put(heap, count, harm, begin, until, soft, hard)
        begin = until
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
    """Return the next time (s) after ``time`` at which a decision is due or the front vehicle comes to rest; at most
    ``last``.
    """
    until = last
    if at[LINE.TIME_STEP] > 0.0:
        until = min(until, (math.floor(time / at[LINE.TIME_STEP] + 1e-6) + 1.0) * at[LINE.TIME_STEP])
    stand = at[LINE.V_L] / at[LINE.A_L]
    if kind == FRONT_FIRST and time < stand:
        until = min(until, stand)
    return until
