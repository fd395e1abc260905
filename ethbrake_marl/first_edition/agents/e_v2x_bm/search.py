"""The coupled search for the best constant deceleration in one world, in five steps. Compiled.

The search simulates evenly spaced decelerations (the *grid*), then more decelerations where the harm may be least. Then
the search simulates decelerations around local minima and around *borders*, at which the number of impacts changes. If
the result lies close to a jump of the harm, the search finally moves the result away from the jump. docs/evaluate.md
says how good the results are.

Each function that simulates returns a status code: ``FLAG.DONE`` or, if a simulation failed, the code of the failed
check of the physics. ``capacity`` is the braking capacity of the controlled vehicle (m/s2).
"""

from __future__ import annotations

import math
from typing import NamedTuple, cast

import numpy as np

from ethbrake_marl.first_edition.agents.e_v2x_bm.constants import Line, share_start, simulate
from ethbrake_marl.first_edition.agents.e_v2x_bm.pairwise import CANDIDATES
from ethbrake_marl.first_edition.agents.e_v2x_bm.samples import (
    NARROWEST_MPS2,
    Samples,
    bound_cells,
    choose,
    copy_sample,
    find_minima,
    find_smallest,
    least_harm,
    make_samples,
    merge,
    put_in_order,
)
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.rows import FLAG
from ethbrake_marl.first_edition.physics.state import Floats, Ints

GRID = 161  # number of evenly spaced decelerations from 0 to the capacity in the first step

CELLS = 24  # largest number of grid cells that are refined

INSIDE = 16  # number of samples inside a refined cell

BORDERS = 6  # largest number of borders that are located

MINIMA = 6  # number of local minima that are refined

_JUMP = 1e-6  # a change of harm (m2/s2) above this within 1e-9 m/s2 is a jump

_LOOKED = GRID + CANDIDATES + CELLS * INSIDE

_NARROWED = _LOOKED + 2 * BORDERS

_MOST = _NARROWED + MINIMA

_FEW = 6

# Loop bounds, not as literals: numba would compile all physics again for each literal.
_ZERO, _ONE, _FIVE, _GRID_END, _CANDIDATES_END = (cast(int, np.int64(k)) for k in (0, 1, 5, GRID, CANDIDATES))

_SHARES = np.linspace(0.0, 1.0, GRID)

_SHARES_INSIDE = np.arange(1, INSIDE + 1) / (INSIDE + 1)

_FIFTHS = np.arange(1, 5) / 5  # new samples between the two sides of a border


class Room(NamedTuple):
    """Arrays for intermediate results of a search, reused for every world of a batch.

    A *grid cell* is the interval between two neighbouring decelerations of the grid.
    """

    one: Samples  # samples of the grid; after step 2 all samples
    two: Samples  # all samples after step 1; after step 4 all samples with borders and minima
    new: Samples  # samples that a step adds
    few: Samples  # few samples around one deceleration
    values: Floats  # one number per sample: bound of the harm, or harm at a local minimum (m2/s2)
    cells: Ints  # [CELLS] index of the sample at the lower end of each refined cell
    borders: Ints  # [BORDERS] index of the sample before each border
    minima: Ints  # [MINIMA] index of the sample at each local minimum


@compiled
def make_room() -> Room:
    """Return arrays for the intermediate results of searches. The values of the arrays are not yet set."""
    return Room(
        make_samples(_MOST), make_samples(_MOST), make_samples(_MOST), make_samples(_FEW), np.empty(_MOST),
        np.empty(CELLS, np.int64), np.empty(BORDERS, np.int64), np.empty(MINIMA, np.int64),
    )  # fmt: skip


@compiled(apart=True, bare=True)
def search_line(line: Line, room: Room, breakpoints: Floats, capacity: float, out: Floats) -> int:
    """Find the best constant deceleration of the controlled vehicle in one world.

    ``breakpoints`` [CANDIDATES] (m/s2) are decelerations that are simulated in addition to the grid. ``out`` [3]
    receives the best deceleration (m/s2), its harm, and its harm under the other harm count (m2/s2).
    """
    status = share_start(line)
    if status == FLAG.DONE:
        status = look_evenly(line, room, breakpoints, capacity)
    if status == FLAG.DONE:
        status = look_inside(line, room)
    if status == FLAG.DONE:
        status = locate_borders(line, room)
    if status == FLAG.DONE:
        status = narrow_minima(line, room)
    if status == FLAG.DONE:
        status = step_back(line, room.few, choose(room.two, _MOST, room.values), capacity, out)
    return status


@compiled(apart=True, bare=True)
def look_evenly(line: Line, room: Room, breakpoints: Floats, capacity: float) -> int:
    """Step 1: simulate the grid, which ends at ``capacity``, and the ``breakpoints`` [CANDIDATES] (m/s2).

    The samples of the grid are written to ``room.one``. The samples of grid and breakpoints together are written to
    ``room.two``, sorted by deceleration.
    """
    grid, new = room.one, room.few
    for k in range(GRID):
        grid.at[k] = capacity * _SHARES[k]
    for k in range(CANDIDATES):
        new.at[k] = breakpoints[k]
    put_in_order(new, CANDIDATES)
    status = simulate(line, grid, _ZERO, _GRID_END, math.inf)
    if status == FLAG.DONE:
        status = simulate(line, new, _ZERO, _CANDIDATES_END, math.inf)
    merge(grid, GRID, new, CANDIDATES, room.two)
    return status


@compiled(apart=True, bare=True)
def look_inside(line: Line, room: Room) -> int:
    """Step 2: simulate more decelerations in some grid cells.

    These are the cells in which the number of impacts changes, or whose estimated least harm is below the harm of all
    samples so far. All samples, old and new, are written to ``room.one``; the last sample is repeated until there are
    ``_LOOKED`` samples.
    """
    grid, looked, new, cells, bounds = room.one, room.two, room.new, room.cells, room.values
    best = least_harm(looked, GRID + CANDIDATES)
    bound_cells(grid, GRID, bounds)
    for k in range(GRID - 1):
        if not (bounds[k] < best or grid.course[k] != grid.course[k + 1]):
            bounds[k] = math.inf
    find_smallest(bounds, GRID - 1, cells)
    count = 0
    while count < CELLS and bounds[cells[count]] < math.inf:
        count += 1
    _put_in_order(cells, count)
    for c in range(count):
        low = grid.at[cells[c]]
        width = grid.at[cells[c] + 1] - low
        for k in range(INSIDE):
            new.at[INSIDE * c + k] = low + width * _SHARES_INSIDE[k]
    status = simulate(line, new, _ZERO, INSIDE * count, math.inf)
    number = GRID + CANDIDATES + INSIDE * count
    merge(looked, GRID + CANDIDATES, new, INSIDE * count, grid)
    for k in range(number, _LOOKED):
        copy_sample(grid, number - 1, grid, k)
    return status


@compiled(bare=True)
def _put_in_order(places: Ints, n: int) -> None:
    """Sort the first ``n`` entries of ``places`` in increasing order, in place."""
    for k in range(1, n):
        place, to = places[k], k
        while to > 0 and places[to - 1] > place:
            places[to] = places[to - 1]
            to -= 1
        places[to] = place


@compiled(apart=True, bare=True)
def locate_borders(line: Line, room: Room) -> int:
    """Step 3: locate the borders near which the harm may be least.

    Between two borders the harm has no jumps. Therefore, if the harm falls towards a border, the harm is least directly
    at this border. For each located border, the search finds two samples that are at most 1e-9 m/s2 apart, one on each
    side of the border. All samples, old and new, are written to ``room.two``.
    """
    looked, new, few, places, bounds = room.one, room.new, room.few, room.borders, room.values
    best = least_harm(looked, _LOOKED)
    bound_cells(looked, _LOOKED, bounds)
    for k in range(_LOOKED - 1):
        if not (bounds[k] < best and looked.course[k] != looked.course[k + 1]):
            bounds[k] = math.inf
    find_smallest(bounds, _LOOKED - 1, places)
    for b in range(BORDERS):
        copy_sample(looked, places[b], few, 0)
        copy_sample(looked, places[b] + 1, few, 5)
        if bounds[places[b]] < math.inf:
            status = _cut(line, few)
            if status != FLAG.DONE:
                return status
        copy_sample(few, 0, new, 2 * b)
        copy_sample(few, 5, new, 2 * b + 1)
    put_in_order(new, 2 * BORDERS)
    merge(looked, _LOOKED, new, 2 * BORDERS, room.two)
    return FLAG.DONE


@compiled(bare=True)
def _cut(line: Line, few: Samples) -> int:
    """Move samples 0 and 5 of ``few`` towards the border between them until these samples are at most 1e-9 m/s2 apart.

    Each round divides the distance between the two samples by five.
    """
    while few.at[5] - few.at[0] > NARROWEST_MPS2:
        low, width = few.at[0], few.at[5] - few.at[0]
        for k in range(4):
            few.at[1 + k] = low + width * _FIFTHS[k]
        status = simulate(line, few, _ONE, _FIVE, math.inf)
        if status != FLAG.DONE:
            return status
        border, least = 0, math.inf
        for k in range(5):
            lower = min(few.harm[k], few.harm[k + 1])
            if few.course[k] != few.course[k + 1] and lower < least:
                border, least = k, lower
        copy_sample(few, border + 1, few, 5)  # before sample 0 is overwritten
        copy_sample(few, border, few, 0)
    return FLAG.DONE


@compiled(apart=True, bare=True)
def narrow_minima(line: Line, room: Room) -> int:
    """Step 4: locate the lowest local minima of the harm to 1e-9 m/s2, and append them to ``room.two``."""
    inner, minima, last = room.two, room.minima, _NARROWED - 1
    find_minima(inner, _NARROWED, room.values, minima)
    for m in range(MINIMA):
        middle, to = minima[m], _NARROWED + m
        copy_sample(inner, middle, inner, to)
        if room.values[middle] < math.inf:
            low, high = inner.at[max(middle - 1, 0)], inner.at[min(middle + 1, last)]
            status = _narrow(line, room.few, low, high, inner, to)
            if status != FLAG.DONE:
                return status
    return FLAG.DONE


@compiled(bare=True)
def _narrow(line: Line, few: Samples, low: float, high: float, found: Samples, to: int) -> int:
    """Narrow the interval from ``low`` to ``high`` (m/s2) around a local minimum of the harm to at most 1e-9 m/s2.

    Each round divides the interval on each side of the best deceleration so far into three parts. Sample ``to`` of
    ``found`` is the best deceleration so far, and is replaced by a better one. ``few`` is overwritten with intermediate
    results.
    """
    while high - low > NARROWEST_MPS2:
        middle = found.at[to]
        left, right = (middle - low) / 3, (high - middle) / 3
        few.at[0], few.at[1], few.at[2], few.at[3] = low + left, middle - left, middle + right, high - right
        first, end = 0 if left > 0.0 else 2, 4 if right > 0.0 else 2  # the middle itself is known
        status = simulate(line, few, first, end, found.harm[to])
        if status != FLAG.DONE:
            return status
        pick, least = -1, found.harm[to]
        for k in range(first, end):
            if few.harm[k] < least:
                pick, least = k, few.harm[k]
        if pick < 0:
            low, high = few.at[1], few.at[2]
            continue
        low, high = (
            low if pick == 0 else few.at[0] if pick == 1 else middle if pick == 2 else few.at[2],
            few.at[1] if pick == 0 else middle if pick == 1 else few.at[3] if pick == 2 else high,
        )
        copy_sample(few, pick, found, to)
    return FLAG.DONE


@compiled(apart=True, bare=True)
def step_back(line: Line, around: Samples, best: float, capacity: float, out: Floats) -> int:
    """Step 5: if ``best`` lies within 1e-9 m/s2 of a jump of the harm, move ``best`` to the side with less harm.

    When the agent drives, the engine simulates the same motion step by step, with other rounding errors than this
    search. If the agent braked with a deceleration directly at a jump, the engine's rounding errors would decide on
    which side of the jump the harm lies. ``best`` is the best deceleration of the earlier steps (m/s2). ``out``
    receives the same three numbers as in ``search_line``. ``around`` is overwritten with intermediate results.
    """
    for k in range(5):
        around.at[k] = min(max(best + NARROWEST_MPS2 * (k - 2.0), 0.0), capacity)
    status = simulate(line, around, _ZERO, _FIVE, math.inf)
    pick, least, middle = 1, math.inf, 0.0
    for k in range(3):
        worst = max(max(around.harm[k], around.harm[k + 1]), around.harm[k + 2])
        if worst < least:
            pick, least = k, worst
        if k == 1:
            middle = worst
    if middle - least < _JUMP:
        pick = 1
    out[0], out[1], out[2] = around.at[pick + 1], around.harm[pick + 1], around.other[pick + 1]
    return status
