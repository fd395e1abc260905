"""The smallest harm over all first contacts with one neighbour, by branch and bound.

A first contact has a time and a closing speed. Its harm is its squared closing speed plus the harm that must follow
(``followers.after``). A *cell* is a set of first contacts: a range of times and a range of closing speeds. The search
halves the cell with the smallest bound until this bound is close to the smallest harm that it has reached.

Proof: docs/proofs/harm.md. Arguments: ``proofs/__init__.py``.
"""

from __future__ import annotations

import math

from ethbrake_marl.extensions.proofs.followers import after
from ethbrake_marl.extensions.proofs.line import A_F, A_L, FRONT_FIRST, LIMIT_F, TIME_STEP, U_F, V_L, follower, leader
from ethbrake_marl.extensions.proofs.meetings import gentlest
from ethbrake_marl.motion.compiling import kernel, large

PRECISION = 1e-3  # relative and absolute (m2/s2) precision of a minimum
CELLS = 600  # size of the memory for cells, which limits the number of divisions
_SPLITS = 64  # largest number of cells at the start of the search, one for each decision step
_FIRST_SAMPLES = 8  # number of first contacts evaluated before the search

# columns of a cell: bound (m2/s2); range of times (s); range of closing speeds (m/s)
HARM, EARLY, LATE, SOFT, HARD = range(5)
CELL_COLUMNS = 5


@large
def gentlest_between(kind, at, early, late):
    """Lower bound (m/s) on the closing speed of first contacts between ``early`` and ``late`` (s).

    The later the contact, the smaller its smallest closing speed, with one exception: if the leader brakes harder than
    the controlled vehicle, the smallest closing speed rises, in each second by at most the difference of the braking
    capacities. Arguments: package ``proofs``.
    """
    least = gentlest(kind, at, late)[0]
    if kind == FRONT_FIRST and at[A_L] > at[A_F] and early * at[A_L] < at[V_L]:
        least -= (at[A_L] - at[A_F]) * (late - early)
    return max(least, 0.0)


@kernel
def decision_around(at, early, late):
    """Start and end (s) of the decision step that contains both times, ``early`` and ``late`` (s).

    Both results are ``late`` if no step contains both, or if commands may change at any time. ``at``: one world
    (columns: ``proofs/line.py``).
    """
    step = at[TIME_STEP]
    if step <= 0.0:
        return late, late
    begin = math.floor(0.5 * (early + late) / step) * step
    if early < begin - 1e-9 or late > begin + step + 1e-9:
        return late, late
    return begin, begin + step


@large
def command_deviation(kind, at, early, late, softest, hard, begin):
    """Least difference (m/s2) between the command at a first contact and the best command after it.

    Braking makes a contact with the front vehicle gentle, but driving softens the impact from behind that follows; at
    the rear it is the other way round. A command lasts for the whole decision step, which starts at ``begin`` (s), so
    the same command cannot be best both before and after the contact. ``softest`` is the smallest closing speed (m/s)
    of a first contact between ``early`` and ``late`` under any command. Other arguments: package ``proofs``.
    """
    command_range = at[U_F] + at[A_F]
    turn = gentlest(kind, at, early)[1]
    # A speed limit or a standstill may hide which command is in force.
    hidden = leader(at, early)[0] + hard >= at[LIMIT_F] if kind == FRONT_FIRST else follower(at, late)[0] <= hard
    if early <= begin or hidden:
        return 0.0
    softer = max(hard - softest, 0.0) / (early - begin)
    if turn >= begin:
        share = (turn - begin) / (early - begin)
        return max(command_range - 2.0 * softer - command_range * share * share, 0.0)
    steep = (late - begin) / (begin - turn)
    return max(command_range - softer * (1.0 + steep) / (1.0 + 0.5 * steep), 0.0)


@large
def harm_of(kind, at, early, late, soft, hard, floor):
    """Lower bound (m2/s2) on the harm of all first contacts in a *cell*: a range of times and of closing speeds.

    The times are ``early`` to ``late`` (s), the closing speeds ``soft`` to ``hard`` (m/s). Other arguments: package
    ``proofs``.
    """
    begin, end = decision_around(at, early, late)
    lack = 0.0
    if end > late:
        lack = command_deviation(kind, at, early, late, gentlest_between(kind, at, early, late), hard, begin)
    follows = after(kind, at, early, late, hard, max(end, late), lack)
    return soft * soft + max(follows, floor)


@large
def put_cell(kind, at, floor, cells, count, least, early, late, soft, hard):
    """Write a cell (a set of first contacts) to row ``count`` of ``cells``; return the new number of cells.

    The stored bound of the cell is at least ``least`` (m2/s2). Other arguments: as for ``harm_of``.
    """
    cell = cells[count]
    cell[HARM] = max(harm_of(kind, at, early, late, soft, hard, floor), least)
    cell[EARLY], cell[LATE], cell[SOFT], cell[HARD] = early, late, soft, hard
    return count + 1


@kernel
def lowest(cells, count):
    """Row of the cell with the smallest bound among the first ``count`` cells, and this bound (m2/s2)."""
    row = 0
    for k in range(1, count):
        if cells[k, HARM] < cells[row, HARM]:
            row = k
    return row, cells[row, HARM] if count > 0 else math.inf


@large
def halve_cell(kind, at, floor, count, row, cells):
    """Split the cell in ``row`` of ``cells`` into two halves; ``count`` cells are in use.

    Returns the new number of cells, and the bound (m2/s2) of one first contact in the cell; the smallest bound of all
    first contacts is at most this one. Other arguments: package ``proofs``.
    """
    cell = cells[row]
    harm, early, late, soft, hard = cell[HARM], cell[EARLY], cell[LATE], cell[SOFT], cell[HARD]
    count -= 1
    for column in range(CELL_COLUMNS):
        cell[column] = cells[count, column]
    middle = 0.5 * (early + late)
    if (late - early) * (at[U_F] + at[A_F] + at[A_L]) > hard - soft and early < middle < late:
        closing = max(soft, gentlest(kind, at, middle)[0])
        reached = harm_of(kind, at, middle, middle, closing, closing, floor)
        if soft < hard:
            count = put_cell(kind, at, floor, cells, count, harm, middle, late, soft, hard)
        soft, late = max(soft, gentlest_between(kind, at, early, middle)), middle
    else:
        middle = 0.5 * (soft + hard)
        reached = harm_of(kind, at, late, late, middle, middle, floor)
        count = put_cell(kind, at, floor, cells, count, harm, early, late, middle, hard)
        hard = middle
    if soft < hard:
        count = put_cell(kind, at, floor, cells, count, harm, early, late, soft, hard)
    return count, reached


@large
def least_contact_harm(kind, at, first, last, floor, best, enough, cells):
    """Lower bound (m2/s2), at most ``best``, on the harm of all first contacts from ``first`` to ``last`` (s).

    Found by branch and bound, as described at the top of this file. Arguments: package ``proofs``.
    """
    for k in range(_FIRST_SAMPLES):
        time = first + (last - first) * k / (_FIRST_SAMPLES - 1)
        closing = gentlest(kind, at, time)[0]
        best = min(best, harm_of(kind, at, time, time, closing, closing, floor))
    # the contacts between both times with closing speeds up to `hard`: one cell for each decision step
    hard = math.sqrt(best)
    count, begin = 0, first
    while begin < last:
        until = next_split(kind, at, begin, last) if count < _SPLITS else last
        soft = gentlest_between(kind, at, begin, until)
        if soft < hard:
            count = put_cell(kind, at, floor, cells, count, 0.0, begin, until, soft, hard)
        begin = until
    row, least = lowest(cells, count)
    for _ in range(len(cells) - _SPLITS - 2):
        if best <= enough or least >= best - PRECISION * (1.0 + best):
            break
        count, reached = halve_cell(kind, at, floor, count, row, cells)
        best = min(best, reached)
        row, least = lowest(cells, count)
    return min(best, least) if best > enough else 0.0


@kernel
def next_split(kind, at, time, last):
    """Next time (s) after ``time`` at which a decision is made or the front vehicle comes to rest; at most ``last``.

    The front vehicle's rest counts only if the first contact is with it (``kind``). ``at``: one world (columns: file
    ``line``).
    """
    until = last
    if at[TIME_STEP] > 0.0:
        until = min(until, (math.floor(time / at[TIME_STEP] + 1e-6) + 1.0) * at[TIME_STEP])
    stand = at[V_L] / at[A_L]
    if kind == FRONT_FIRST and time < stand:
        until = min(until, stand)
    return until
