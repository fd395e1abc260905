"""The obstacle ahead of Vehicle 1, for the kernels: one more vehicle in front, which stands and which nothing moves.

Its mass is infinite. In the regression P of a cluster that touches it, and of touching vehicles that press against it,
it therefore stays at 0, and P is the regression of the vehicles alone bounded above by 0: ``min(P, 0)``. Contact,
touch, plastic impacts and first impacts follow the rules of any pair, to the same bits. The added vehicle exists inside
the physics only; everybody else keeps the numbers of the vehicles, and the obstacle has columns of its own.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.impact import GAP, MASS
from ethbrake_marl.physics.segment import HIT
from ethbrake_marl.physics.worlds import Bools, Floats, Vehicles, Worlds, sum_rows, vehicles_at_once

UNMOVABLE_T = math.inf
FAR_AWAY_M = 1e300  # stands for no obstacle where others of a batch have one: nothing comes near, no bit changes


def obstacle_ahead(worlds: Worlds) -> Bools:
    """Which worlds have an obstacle ahead of Vehicle 1, [n]."""
    return np.isfinite(worlds.obstacle_gap_m)


def with_obstacle(worlds: Worlds) -> Worlds:
    """These worlds, all with an obstacle ahead, with that obstacle as vehicle 0 and every other vehicle one later."""
    vehicles = worlds.vehicles
    written_out = vehicles_at_once(  # inside the physics nobody observes
        ahead(0.0, vehicles.braking_capacity_mps2),
        ahead(0.0, vehicles.driving_capacity_mps2),
        ahead(0.0, vehicles.latency_s),
        ahead(UNMOVABLE_T, vehicles.mass_t),
        ahead(0.0, vehicles.speed_limit_mps),
        vehicles.restitution,
    )
    return Worlds(
        written_out,
        np.concatenate([worlds.obstacle_gap_m[:, np.newaxis], worlds.gaps_m], axis=1),
        ahead(0.0, worlds.speeds_mps),
        worlds.time_s,
        np.concatenate([worlds.obstacle_hit[:, np.newaxis], worlds.pair_hit], axis=1),
        ahead(0.0, worlds.command_mps2),
        np.full(worlds.n, np.inf),
        np.zeros(worlds.n, np.bool_),
        worlds.messages,
    )


def without_obstacle(written_out: Worlds, vehicles: Vehicles) -> Worlds:
    """Back from ``with_obstacle``: the obstacle's columns beside those of the pairs; ``vehicles`` are the real ones."""
    return replace(
        written_out,
        vehicles=vehicles,
        gaps_m=written_out.gaps_m[:, 1:].copy(),
        speeds_mps=written_out.speeds_mps[:, 1:].copy(),
        pair_hit=written_out.pair_hit[:, 1:].copy(),
        command_mps2=written_out.command_mps2[:, 1:].copy(),
        obstacle_gap_m=written_out.gaps_m[:, 0].copy(),
        obstacle_hit=written_out.pair_hit[:, 0].copy(),
    )


def with_post_ahead(worlds: Worlds, duration_s: Floats) -> Worlds:
    """These worlds, each with an obstacle ahead: its own, or one that Vehicle 1 cannot reach in ``duration_s`` [n].

    Worlds know gaps and speeds, no places. Such a post makes the way of Vehicle 1 the change of one more gap, and
    changes no motion.
    """
    out_of_reach = _farthest(worlds, duration_s) + 1.0
    return replace(worlds, obstacle_gap_m=np.where(obstacle_ahead(worlds), worlds.obstacle_gap_m, out_of_reach))


def _farthest(worlds: Worlds, duration_s: Floats) -> Floats:
    """More than Vehicle 1 can travel, [n] m: ``T sqrt(2 E / m_1)``, had it all the energy E the line can ever have.

    Impacts and brakes only take energy; driving adds at most ``m a v`` per second, and never above the speed limit.
    """
    vehicles = worlds.vehicles
    driving = vehicles.driving_capacity_mps2 * vehicles.speed_limit_mps * duration_s[:, np.newaxis]
    energy = sum_rows(vehicles.mass_t * (worlds.speeds_mps * worlds.speeds_mps / 2.0 + driving))
    farthest: Floats = 1.01 * duration_s * np.sqrt(2.0 * energy / vehicles.mass_t[:, 0])
    return farthest


def ahead(value: float, columns: Floats) -> Floats:
    """The columns of the vehicles [n, N] with one more in front, [n, N + 1]."""
    added: NDArray[np.float64] = np.concatenate([np.full((len(columns), 1), value), columns], axis=1)
    return added


@compiled
def place_obstacle(table: Floats, gap: float, hit: float) -> None:
    """Write the obstacle into column 0 of a world's table; its speed and command are the zeros of a new table."""
    table[MASS, 0] = UNMOVABLE_T
    table[GAP, 0] = gap
    table[HIT, 0] = hit
