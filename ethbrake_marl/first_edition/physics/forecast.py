"""Forecast of harm under constant commands, for many candidate commands of one vehicle.

The forecast uses the physics of ``advance``. It is fast because it returns only the harm, not the motion.
"""

from __future__ import annotations

import numpy as np

from ethbrake_marl.errors import InvalidInput, PhysicsError
from ethbrake_marl.first_edition.physics.episode import onset_s
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.motion import BOUND
from ethbrake_marl.first_edition.physics.rows import FLAG, LISTED, ROW, place_forces, place_obstacle, rows_for
from ethbrake_marl.first_edition.physics.segment import advance_table
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Worlds


def forecast(
    worlds: Worlds, command_mps2: Floats, vehicle: int, candidates_mps2: Floats, until_s: float
) -> tuple[Floats, Floats]:
    """Return the first-impact harm and the total harm up to ``until_s`` for each candidate command of ``vehicle``.

    Both harms are [n, K] in m2/s2. The harm is summed over all pairs, including impacts with an obstacle ahead. If the
    present time of a world is ``until_s`` or later, the harm of this world is 0. A pair that has already had an impact
    adds no first-impact harm.

    Args:
        worlds: n worlds of N vehicles.
        command_mps2: commands of all vehicles, [n, N] m/s2; the column of ``vehicle`` is ignored.
        vehicle: index of the vehicle that tries the candidate commands, from 0.
        candidates_mps2: K candidate commands for the vehicle in each world, [n, K] m/s2.
        until_s: end of the forecast, s since the alert.

    Raises ``InvalidInput`` for arrays of wrong shape or a candidate command beyond the vehicle's capacity. Raises
    ``PhysicsError``, which lists the failed worlds, if a check of the physics fails.

    """
    n, N = worlds.speeds_mps.shape
    if command_mps2.shape != (n, N) or candidates_mps2.ndim != 2 or candidates_mps2.shape[0] != n:
        raise InvalidInput(
            f"forecast: command_mps2 has the shape {command_mps2.shape} and candidates_mps2 {candidates_mps2.shape};"
            f" the shapes must be ({n}, {N}) and ({n}, K)"
        )
    if not 0 <= vehicle < N:
        raise InvalidInput(f"forecast: vehicle = {vehicle}: must be an index in 0..{N - 1}")
    v = worlds.vehicles
    low, high = -v.braking_capacity_mps2[:, [vehicle]], v.driving_capacity_mps2[:, [vehicle]]
    good = (candidates_mps2 >= low) & (candidates_mps2 <= high)
    if not good.all():
        raise InvalidInput(
            f"forecast: the candidate command {candidates_mps2[~good][0]:g} m/s2 is beyond the capacity of"
            f" vehicle_{vehicle + 1}"
        )
    first, total = np.zeros(candidates_mps2.shape), np.zeros(candidates_mps2.shape)
    ahead = np.minimum(worlds.obstacle_gap_m, BOUND.FAR_AWAY_M) if worlds.obstacle_ahead.any() else np.empty(0)
    failed = np.zeros(n, np.bool_)
    forecast_worlds(
        worlds.gaps_m, worlds.speeds_mps, worlds.time_s, worlds.pair_hit, ahead, worlds.obstacle_hit,
        np.ascontiguousarray(command_mps2), vehicle, np.ascontiguousarray(candidates_mps2), until_s, v.latency_s,
        v.mass_t, v.speed_limit_mps, v.restitution, worlds.command_mps2, v.brake_rate_mps3, v.release_rate_mps3,
        v.pieces, first, total, failed,
    )  # fmt: skip
    if failed.any():
        raise PhysicsError({k: f"the forecast to {until_s:g} s failed" for k in np.flatnonzero(failed).tolist()})
    return first, total


@compiled
def forecast_worlds(
    gaps: Floats, speeds: Floats, time: Floats, hit: Bools, ahead: Floats, ahead_hit: Bools, command: Floats,
    vehicle: int, candidates: Floats, until_s: float, latency: Floats, mass: Floats, limit: Floats, restitution: Floats,
    in_force: Floats, brake_rate: Floats, release_rate: Floats, pieces: Floats, first: Floats, total: Floats,
    failed: Bools,
) -> None:  # fmt: skip
    """Simulate every world with each candidate command; add the harm (m2/s2) to ``first`` and ``total`` [n, K].

    ``first`` is first-impact harm and ``total`` total harm; all entries must be 0 when the function is called.
    ``vehicle``, ``command``, ``candidates`` and ``until_s`` are as in ``forecast``. Arguments that are not listed are
    fields of ``Worlds`` and ``Vehicles`` under short names, for example ``gaps`` for ``gaps_m``.

    - ``ahead``: gap to an obstacle, [n] m, ``FAR_AWAY_M`` in a world without one; empty if no world has one.
    - ``in_force``: accelerations in force at the start, [n, N] m/s2.
    - ``failed``: result, [n]; set to True for a world in which a check of the physics failed.
    """
    n, vehicles = speeds.shape
    at = min(ahead.shape[0], 1)  # vehicle i is column at + i; an obstacle is column 0
    table = np.zeros((rows_for(pieces.shape[2]), at + vehicles))
    no_rows = np.empty((0, LISTED.WIDTH))
    for k in range(n):
        duration = until_s - time[k]
        if not duration > 0.0:
            continue
        for c in range(candidates.shape[1]):
            if at == 1:
                place_obstacle(table, ahead[k], 1.0 if ahead_hit[k] else 0.0)
                table[ROW.SPEED, 0] = 0.0
            for i in range(vehicles):
                table[ROW.SPEED, at + i] = speeds[k, i]
                table[ROW.COMMAND, at + i] = candidates[k, c] if i == vehicle else command[k, i]
                table[ROW.MASS, at + i] = mass[k, i]
                table[ROW.LIMIT, at + i] = limit[k, i]
                table[ROW.ONSET, at + i] = onset_s(latency[k, i], time[k])
            for p in range(vehicles - 1):
                table[ROW.GAP, at + p] = gaps[k, p]
                table[ROW.HIT, at + p] = 1.0 if hit[k, p] else 0.0
            place_forces(table, in_force[k], brake_rate[k], release_rate[k], pieces[k])
            if advance_table(table, restitution[k], duration, 0.0, k, no_rows, 0)[1] != FLAG.DONE:
                failed[k] = True
                break
            for p in range(at + vehicles - 1):
                first[k, c] += table[ROW.FIRST_HARM, p]
                total[k, c] += table[ROW.TOTAL_HARM, p]
