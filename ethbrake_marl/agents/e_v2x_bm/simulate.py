"""Many constant decelerations of one vehicle, each simulated in a world of a batch: what the coupled search asks for.

As ``physics.advance`` under a constant command, to the same bits, but without a copy of the world for each of them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ethbrake_marl.physics import Floats, Ints, Worlds
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.episode import onset_s
from ethbrake_marl.physics.failed import failure
from ethbrake_marl.physics.impact import GAP, MASS, SPEED
from ethbrake_marl.physics.segment import (
    COMMAND,
    COUNT,
    DONE,
    FIRST_HARM,
    HIT,
    LIMIT,
    ONSET,
    ROW_WIDTH,
    TABLE_ROWS,
    TOTAL_HARM,
    advance_table,
)
from ethbrake_marl.physics.worlds import Bools


class Simulated(NamedTuple):
    """What k simulations did."""

    first_harm: Floats  # [k, P] m2/s2
    total_harm: Floats  # [k, P] m2/s2
    impacts: Ints  # [k, P]


def simulate_constant(
    worlds: Worlds, command_mps2: Floats, vehicle: int, rows: Ints, deceleration_mps2: Floats, horizon_s: float
) -> Simulated:
    """Simulate world ``rows[k]`` to the horizon with ``deceleration_mps2[k]``; the worlds have no obstacle.

    Args:
        worlds: n worlds of N vehicles.
        command_mps2: [n, N] commands that ``advance`` has accepted; those of the other vehicles are used.
        vehicle: the one that decelerates (0 = front).
        rows: [k] worlds, each as often as it is simulated.
        deceleration_mps2: [k] from 0 to the vehicle's capacity.
        horizon_s: end of every simulation (s).

    Raises ``PhysicsError`` by the place in ``rows`` of what cannot be simulated.

    """
    v = worlds.vehicles
    shape = rows.size, worlds.N - 1
    found = Simulated(np.empty(shape), np.empty(shape), np.empty(shape, np.int64))
    status = np.empty(rows.size, np.int64)
    _simulate(
        worlds.gaps_m, worlds.speeds_mps, worlds.time_s, worlds.pair_hit, command_mps2, vehicle, rows,
        np.ascontiguousarray(deceleration_mps2), horizon_s, v.latency_s, v.mass_t, v.speed_limit_mps, v.restitution,
        *found, status,
    )  # fmt: skip
    if (status != DONE).any():
        raise failure(status, worlds.time_s[rows], np.full(rows.size, horizon_s))
    return found


@compiled
def _simulate(
    gaps: Floats, speeds: Floats, time: Floats, hit: Bools, command: Floats, vehicle: int, rows: Ints,
    deceleration: Floats, horizon: float, latency: Floats, mass: Floats, limit: Floats, restitution: Floats,
    first: Floats, total: Floats, count: Ints, status: Ints,
) -> None:  # fmt: skip
    """Fill the last four arrays, one row for each simulation."""
    vehicles = speeds.shape[1]
    table = np.zeros((TABLE_ROWS, vehicles))
    no_rows = np.empty((0, ROW_WIDTH))
    for s in range(rows.shape[0]):
        k = rows[s]
        for i in range(vehicles):
            table[COMMAND, i] = -deceleration[s] if i == vehicle else command[k, i]
            table[SPEED, i] = speeds[k, i]
            table[MASS, i] = mass[k, i]
            table[LIMIT, i] = limit[k, i]
            table[ONSET, i] = onset_s(latency[k, i], time[k])
        for p in range(vehicles - 1):
            table[GAP, p] = gaps[k, p]
            table[HIT, p] = 1.0 if hit[k, p] else 0.0
        status[s] = advance_table(table, restitution[k], horizon - time[k], time[k], k, no_rows, 0)[1]
        for p in range(vehicles - 1):
            first[s, p] = table[FIRST_HARM, p]
            total[s, p] = table[TOTAL_HARM, p]
            count[s, p] = int(table[COUNT, p])
