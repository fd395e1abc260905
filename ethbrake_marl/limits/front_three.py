"""The front three vehicles of a line whose second one is controlled, bounded together: rows of the compiled bound.

An obstacle ahead of a controlled Vehicle 1 is a first vehicle that nothing moves. docs/avoidability.md, "Teams".
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ethbrake_marl.limits.avoidability import avoidability
from ethbrake_marl.limits.lower_bound import onset_states
from ethbrake_marl.limits.team_kernel import bound_threes
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.physics.events import stopping_distances
from ethbrake_marl.physics.obstacle import with_obstacle
from ethbrake_marl.physics.worlds import vehicles_at_once

_MIDDLE, _REAR = 1, 2
_UNMOVED_T = 1e30  # an obstacle: its share of any two masses is 1


@dataclass(frozen=True, slots=True)
class Line:
    """A line when the first controlled vehicle may act."""

    now: Worlds
    onset_s: Floats  # [n, N] from now
    counts: Bools  # [n, P] pairs whose next impact counts, and which move forward


def behind_wall(line: Line, free: Bools) -> Line:
    """The line with its obstacle as a first vehicle that stands and that nothing moves.

    ``free`` [n]: the next impact with it counts, and Vehicle 1 moves forward.
    """
    onset, counts = _with_column(0.0, line.onset_s), _with_column(free, line.counts)
    return Line(_with_wall(line.now), onset, counts)


def _with_column(first: Floats | Bools | float, rest: Floats | Bools) -> Any:
    """One column more in front."""
    return np.column_stack([np.broadcast_to(first, len(rest)), rest])


def _with_wall(now: Worlds) -> Worlds:
    """The line with its obstacle as a first vehicle that stands and that nothing moves."""
    line = with_obstacle(now)
    braking, mass = line.vehicles.braking_capacity_mps2.copy(), line.vehicles.mass_t.copy()
    braking[:, 0], mass[:, 0] = 1.0, _UNMOVED_T
    vehicles = replace(line.vehicles, braking_capacity_mps2=braking, mass_t=mass)
    return replace(line, vehicles=vehicles, obstacle_gap_m=np.ones(line.n))  # what is thrown back has no centre of mass


def combined_bound(line: Line, chosen: Ints, until: Floats, pairs: Floats, time_step_s: float | None) -> Floats:
    """The bound of the front two pairs together, [n] m2/s2, ``until`` [n] s from now; 0 where nothing is proven.

    It asks that the first vehicle brakes by now; the second one, which is among the ``chosen``, is taken to act from
    now on. ``pairs`` [n, 2] are the bounds of both pairs alone.
    """
    now, onset, counts = line.now, line.onset_s, line.counts
    v = now.vehicles
    stops = stopping_distances(now.speeds_mps[:, 0], onset[:, 0], v.braking_capacity_mps2[:, 0]) < now.obstacle_gap_m
    rows = np.flatnonzero((onset[:, 0] <= 0.0) & counts[:, 0] & counts[:, 1] & stops & ~now.obstacle_hit)
    three = _front_three(now, rows)
    if not len(rows):
        return np.zeros(now.n)
    unavoidable = avoidability(three, _MIDDLE).reason >= 2
    rows, three = rows[unavoidable], three.take(np.flatnonzero(unavoidable))
    steps = np.where(onset[rows, _MIDDLE] <= 0.0, 0.0 if time_step_s is None else time_step_s, 0.0)
    since, power = np.zeros(len(rows)), np.full(len(rows), np.inf)
    if now.N == 3:  # nobody pushes the last one
        full = v.braking_capacity_mps2[rows, _REAR] + v.driving_capacity_mps2[rows, _REAR]
        since, power = onset[rows, _REAR], full if _REAR in chosen else np.zeros(len(rows))
    found, out = np.zeros(now.n), np.empty(len(rows))
    bound_threes(onset_states(three, _MIDDLE, steps), until[rows], pairs[rows], since, power, out)
    found[rows] = out
    return found


def _front_three(now: Worlds, rows: Ints) -> Worlds:
    """The first three vehicles of these worlds, Vehicle 2 free to act at once."""
    some = now.take(rows)
    v = some.vehicles
    braking, driving, latency, mass, limit = (
        np.ascontiguousarray(each[:, :3])
        for each in (
            v.braking_capacity_mps2,
            v.driving_capacity_mps2,
            v.latency_s,
            v.mass_t,
            v.speed_limit_mps,
        )
    )
    latency[:, _MIDDLE] = np.minimum(latency[:, _MIDDLE], some.time_s)
    return replace(
        some,
        vehicles=vehicles_at_once(braking, driving, latency, mass, limit, v.restitution),
        gaps_m=some.gaps_m[:, :2].copy(),
        speeds_mps=some.speeds_mps[:, :3].copy(),
        pair_hit=some.pair_hit[:, :2].copy(),
        command_mps2=some.command_mps2[:, :3].copy(),
        messages=np.zeros((some.n, 0)),
    )
