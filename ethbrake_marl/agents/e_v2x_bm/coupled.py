"""E-V2X-BM coupled: the best constant deceleration of one vehicle in the engine's own physics.

The closed form of ``pairwise`` treats the pairs as independent. Here every candidate is simulated to the horizon with
velocity exchange, second impacts and resting contact, so the harm found is the harm realised: the only one of the
three baselines that may bound a shield. docs/baselines.md says how close to the true minimum the search comes.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ethbrake_marl.agents.e_v2x_bm.pairwise import optimise_pairwise, pairwise_breakpoints
from ethbrake_marl.agents.e_v2x_bm.simulate import simulate_constant
from ethbrake_marl.errors import renumbered
from ethbrake_marl.harm import HarmCount, check_harm_count
from ethbrake_marl.physics import Floats, Ints, Worlds, advance
from ethbrake_marl.physics.obstacle import obstacle_ahead

GRID = 161  # first look: evenly spaced decelerations from 0 to the capacity
CELLS = 24  # cells of the grid that are looked into, at most
STEEPER = 2.0  # the harm inside a cell may fall this much faster than in the cell beside it
INSIDE = 16  # samples inside such a cell
BORDERS = 6  # borders between two courses of impacts that are located, at most
MINIMA = 6  # local minima of all samples that are followed
BRACKET_MPS2 = 1e-9  # a minimum is followed until its bracket is narrower
_SIMULATIONS_AT_ONCE = 65_536  # bounds memory: about 0.4 kB each for three vehicles
_DIGIT = 1_000  # impacts of a pair that are told apart
_TIE = 1e-9  # harms (m2/s2) closer than this are one harm
_JUMP = 1e-6  # a change of harm (m2/s2) between decelerations 1e-9 m/s2 apart that only a jump explains
_THIRDS = np.array([1, 2, 4, 5])  # new points of a bracket (low, ., ., middle, ., ., high)
_CENTRE = np.array([3, 1, 2, 4, 5])  # place of the old middle and of the new points
_FIFTHS = np.arange(1, 5) / 5  # new points between the ends of a border


class CoupledOptimum(NamedTuple):
    """The best constant deceleration found in each world [n]."""

    deceleration_mps2: Floats  # a*, in [0, braking capacity]
    harm: Floats  # realised, under the count that was minimised (m2/s2)
    first_impact_harm: Floats  # realised with a*
    total_harm: Floats  # realised with a*


class Samples(NamedTuple):
    """Simulated decelerations of m worlds, k of each; all [m, k]."""

    at: Floats  # decelerations (m/s2)
    harm: Floats  # under the count that is minimised (m2/s2)
    other: Floats  # under the other count
    course: Floats  # differs where the numbers of impacts differ: there the harm may jump

    def sorted(self) -> Samples:
        """In rising order of the deceleration."""
        order = np.argsort(self.at, axis=1, kind="stable")
        order += np.arange(0, self.at.size, self.at.shape[1])[:, None]  # places in the whole: taken faster than by row
        return Samples(*(part.take(order) for part in self))

    def join(self, more: Samples) -> Samples:
        """These samples and more of the same worlds."""
        return Samples(*(np.concatenate(parts, axis=1) for parts in zip(self, more, strict=True)))


def optimise_coupled(
    worlds: Worlds,
    vehicle: int,
    *,
    harm_count: HarmCount = "first",
    horizon_s: float = 8.0,
    others_mps2: Floats | None = None,
) -> CoupledOptimum:
    """Constant deceleration of ``vehicle`` (index from 0) with the least realised harm until ``horizon_s``.

    The other vehicles follow ``others_mps2`` [n, N], signed accelerations (default: full braking of all; the
    controlled vehicle's column is ignored). If braking in the middle of the pairwise collision-free interval
    proves harmless, it is taken. Otherwise an even grid and the pairwise breakpoints are simulated; where the number of
    impacts changes, one smooth piece of the harm ends, and that border is located to 1e-9 m/s2; so are the best local
    minima, on the safe side where the harm jumps. Equal harms are decided by the other count, then by the middle one of
    the equal decelerations. A world's result does not depend on the batch it is in.

    Raises ``InvalidInput`` for an unknown ``vehicle`` or ``harm_count`` or others beyond their capacities,
    ``PhysicsError`` naming the worlds in which some candidate could not be simulated.
    """
    check_harm_count(harm_count)
    search = _Search(worlds, vehicle, harm_count, horizon_s, others_mps2)
    best = optimise_pairwise(search.paired, vehicle).deceleration_mps2
    rows = np.arange(worlds.n)
    first, total, _ = search.simulate(rows, best, checked=False)
    hit = np.flatnonzero(total > 0.0)
    step = max(1, _SIMULATIONS_AT_ONCE // GRID)
    for start in range(0, hit.size, step):
        part = hit[start : start + step]
        best[part], first[part], total[part] = search.minimise(part)
    return CoupledOptimum(best, first if harm_count == "first" else total, first, total)


class _Search:
    """Simulates constant decelerations of one vehicle in given worlds."""

    def __init__(
        self, worlds: Worlds, vehicle: int, harm_count: HarmCount, horizon_s: float, others_mps2: Floats | None
    ) -> None:
        capacity = worlds.vehicles.braking_capacity_mps2
        self._worlds = worlds
        self._vehicle = vehicle
        self._harm_count = harm_count
        self._horizon_s = horizon_s
        self._command = -capacity if others_mps2 is None else np.array(others_mps2, dtype=np.float64)
        self._obstacle = bool(obstacle_ahead(worlds).any())
        self._digits = _DIGIT ** np.arange(float(worlds.N))
        self.paired = _braking_as_told(worlds, vehicle, self._command)

    def simulate(self, rows: Ints, deceleration: Floats, *, checked: bool = True) -> tuple[Floats, Floats, Floats]:
        """First-impact and total harm and course [k] of world ``rows[k]`` under ``deceleration[k]``.

        ``checked``: the worlds' commands have been simulated before, so that only the controlled vehicle's is new.
        """
        first, total, course = np.empty(rows.size), np.empty(rows.size), np.empty(rows.size)
        run = self._run if checked and not self._obstacle else self._advance
        for start in range(0, rows.size, _SIMULATIONS_AT_ONCE):
            part = slice(start, start + _SIMULATIONS_AT_ONCE)
            with renumbered(rows[part]):
                first[part], total[part], course[part] = run(rows[part], deceleration[part])
        return first, total, course

    def _run(self, rows: Ints, deceleration: Floats) -> tuple[Floats, Floats, Floats]:
        """The same of worlds without an obstacle, without a copy of any."""
        command, vehicle = self._command, self._vehicle
        first, total, count = simulate_constant(self._worlds, command, vehicle, rows, deceleration, self._horizon_s)
        return first.sum(axis=1), total.sum(axis=1), count @ self._digits[:-1]

    def _advance(self, rows: Ints, deceleration: Floats) -> tuple[Floats, Floats, Floats]:
        """The same of any worlds; refuses commands that are beyond a vehicle's capacity."""
        command = self._command[rows]
        command[:, self._vehicle] = -deceleration
        _, impacts = advance(self._worlds.take(rows), command, until_s=self._horizon_s)
        first = impacts.first_impact_harm.sum(axis=1) + impacts.obstacle_first_harm
        total = impacts.total_harm.sum(axis=1) + impacts.obstacle_total_harm
        return first, total, impacts.count @ self._digits[:-1] + impacts.obstacle_count * self._digits[-1]

    def evaluate(self, rows: Ints, deceleration: Floats) -> Samples:
        """Samples at every deceleration [m, k] in worlds ``rows`` [m]."""
        found = self.simulate(np.repeat(rows, deceleration.shape[1]), deceleration.ravel())
        first, total, course = (part.reshape(deceleration.shape) for part in found)
        harms = (first, total) if self._harm_count == "first" else (total, first)
        return Samples(deceleration, *harms, course)

    def minimise(self, rows: Ints) -> tuple[Floats, Floats, Floats]:
        """Best deceleration of worlds ``rows`` [m] with its first-impact and total harm."""
        worlds = self._worlds.take(rows)
        capacity = worlds.vehicles.braking_capacity_mps2[:, self._vehicle]
        grid = self.evaluate(rows, capacity[:, None] * np.linspace(0.0, 1.0, GRID))
        looked = grid.join(self.evaluate(rows, pairwise_breakpoints(self.paired.take(rows), self._vehicle)))
        looked = looked.join(self.look_inside(rows, grid, looked.harm.min(axis=1))).sorted()
        looked = looked.join(self.locate_borders(rows, looked)).sorted()
        best = self.step_back(rows, choose(looked.join(self.narrow(rows, looked))), capacity)
        first, total, _ = self.simulate(rows, best)
        return best, first, total

    def look_inside(self, rows: Ints, grid: Samples, best: Floats) -> Samples:
        """Samples inside the cells of the grid that hold a border, or may hide less harm than ``best`` [m]."""
        bound = cell_bounds(grid.at, grid.harm)
        bound = np.where((bound < best[:, None]) | (np.diff(grid.course, axis=1) != 0), bound, np.inf)
        cell = np.argsort(bound, axis=1, kind="stable")[:, :CELLS]
        promising = np.isfinite(np.take_along_axis(bound, cell, axis=1))
        low = np.take_along_axis(grid.at, cell, axis=1)
        width = np.take_along_axis(grid.at, cell + 1, axis=1) - low
        inside = low[..., None] + width[..., None] * (np.arange(1, INSIDE + 1) / (INSIDE + 1))
        m, c = np.nonzero(promising)
        new = self.evaluate(rows[m], inside[m, c])
        filled = [np.repeat(part[:, -1:, None], CELLS * INSIDE).reshape(inside.shape) for part in grid]
        for part, values in zip(filled, new, strict=True):
            part[m, c] = values
        return Samples(*(part.reshape(rows.size, -1) for part in filled))

    def locate_borders(self, rows: Ints, looked: Samples) -> Samples:
        """Both sides of the borders between courses of impacts that may hide less harm, 1e-9 m/s2 apart.

        In between, harm is smooth, and what falls toward a border is least there.
        """
        bound = cell_bounds(looked.at, looked.harm)
        bound = np.where(
            (np.diff(looked.course, axis=1) != 0) & (bound < looked.harm.min(axis=1)[:, None]), bound, np.inf
        )
        cell = np.argsort(bound, axis=1, kind="stable")[:, :BORDERS]
        active = np.isfinite(np.take_along_axis(bound, cell, axis=1)).ravel()
        world, shape = np.repeat(rows, BORDERS), (rows.size, 2 * BORDERS)
        ends = Samples(
            *(np.stack([np.take_along_axis(p, cell + k, axis=1) for k in (0, 1)], -1).reshape(-1, 2) for p in looked)
        )
        while True:
            active &= ends.at[:, 1] - ends.at[:, 0] > BRACKET_MPS2
            j = np.flatnonzero(active)
            if j.size == 0:
                return Samples(*(part.reshape(shape) for part in ends))
            low, high = ends.at[j, :1], ends.at[j, 1:]
            old = Samples(*(part[j] for part in ends))
            inside = old.join(self.evaluate(world[j], low + (high - low) * _FIFTHS)).sorted()
            lower = np.minimum(inside.harm[:, :-1], inside.harm[:, 1:])
            k = np.argmin(np.where(np.diff(inside.course, axis=1) != 0, lower, np.inf), axis=1)[:, None]
            for part, new in zip(ends, inside, strict=True):
                part[j] = np.take_along_axis(new, np.hstack([k, k + 1]), axis=1)

    def narrow(self, rows: Ints, looked: Samples) -> Samples:
        """Follow the lowest local minima of the samples down to brackets of 1e-9 m/s2; returns where they end."""
        bracket, harm, other = lowest_minima(looked)
        world = np.repeat(rows, MINIMA)
        while True:
            active = np.flatnonzero(bracket[:, 2] - bracket[:, 0] > BRACKET_MPS2)
            if active.size == 0:
                shape = (rows.size, MINIMA)
                return Samples(*(part.reshape(shape) for part in (bracket[:, 1], harm, other, np.zeros_like(harm))))
            low, mid, high = bracket[active].T
            left, right = (mid - low) / 3, (high - mid) / 3
            points = np.stack([low, low + left, mid - left, mid, mid + right, high - right, high], axis=1)
            new = self.evaluate(world[active], points[:, _THIRDS])
            # The old middle stands first: where nothing is lower, it stays.
            each_harm = np.column_stack([harm[active], new.harm])
            pick = np.argmin(each_harm, axis=1)
            k = np.arange(active.size)
            bracket[active] = points[k[:, None], _CENTRE[pick][:, None] + np.array([-1, 0, 1])]
            harm[active] = each_harm[k, pick]
            other[active] = np.column_stack([other[active], new.other])[k, pick]

    def step_back(self, rows: Ints, best: Floats, capacity: Floats) -> Floats:
        """Move a minimum that lies on the very edge of a jump 1e-9 m/s2 to its safe side.

        Otherwise the last bits, which differ when the same motion is advanced step by step, would decide the harm.
        """
        around = np.clip(best[:, None] + BRACKET_MPS2 * np.arange(-2, 3), 0.0, capacity[:, None])
        harm = self.evaluate(rows, around).harm
        worst = np.maximum(np.maximum(harm[:, :-2], harm[:, 1:-1]), harm[:, 2:])  # around each of the inner three
        k = np.argmin(worst, axis=1)
        m = np.arange(rows.size)
        k[worst[m, 1] - worst[m, k] < _JUMP] = 1
        steady: Floats = around[m, k + 1]
        return steady


def _braking_as_told(worlds: Worlds, vehicle: int, command: Floats) -> Worlds:
    """The worlds for the closed form, which lets the others brake with all their capacity: it is what they are told.

    Who is told to coast or to drive keeps the capacity: the closed form cannot say what that one does.
    """
    capacity = np.where(command < 0.0, -command, worlds.vehicles.braking_capacity_mps2)
    capacity[:, vehicle] = worlds.vehicles.braking_capacity_mps2[:, vehicle]
    return replace(worlds, vehicles=replace(worlds.vehicles, braking_capacity_mps2=capacity))


def cell_bounds(at: Floats, harm: Floats) -> Floats:
    """Least harm expected between rising samples [m, k] -> [m, k - 1]: the sides that fall into a cell run on."""
    width = np.diff(at, axis=1)
    slope = np.diff(harm, axis=1) / np.maximum(width, BRACKET_MPS2)
    none = np.zeros((len(harm), 1))
    from_left = harm[:, :-1] + STEEPER * width * np.minimum(np.hstack([none, slope[:, :-1]]), 0.0)
    from_right = harm[:, 1:] - STEEPER * width * np.maximum(np.hstack([slope[:, 1:], none]), 0.0)
    return np.minimum(from_left, from_right)


def lowest_minima(looked: Samples) -> tuple[Floats, Floats, Floats]:
    """Brackets [m * K, 3] of the lowest local minima of the samples, with both harms of their middles [m * K]."""
    at, harm, other, _ = looked.sorted()
    wall = np.full((len(harm), 1), np.inf)
    minimum = (harm < np.hstack([wall, harm[:, :-1]])) & (harm <= np.hstack([harm[:, 1:], wall]))
    middle = np.argsort(np.where(minimum, harm, np.inf), axis=1, kind="stable")[:, :MINIMA]
    reach = np.take_along_axis(minimum, middle, axis=1).astype(np.int64)  # 0: fewer than K minima, nothing to follow
    left, right = np.maximum(middle - reach, 0), np.minimum(middle + reach, at.shape[1] - 1)
    bracket = np.stack([np.take_along_axis(at, k, axis=1) for k in (left, middle, right)], axis=-1)
    return (
        bracket.reshape(-1, 3),
        np.take_along_axis(harm, middle, axis=1).ravel(),
        np.take_along_axis(other, middle, axis=1).ravel(),
    )


def choose(samples: Samples) -> Floats:
    """Deceleration [m] of least harm; ties by the other count, then the middle one of those that are left."""
    good = samples.harm <= samples.harm.min(axis=1, keepdims=True) + _TIE
    rest = np.where(good, samples.other, np.inf)
    good &= rest <= rest.min(axis=1, keepdims=True) + _TIE
    order = np.sort(np.where(good, samples.at, np.inf), axis=1)
    best: Floats = order[np.arange(len(order)), (good.sum(axis=1) - 1) // 2]
    return best
