"""The forecast of constant commands: the physics of ``advance``, for many candidate commands of one vehicle.

Nothing of the motion is kept, only the harm, so a candidate costs little more than its events.
"""

from __future__ import annotations

import math

import numpy as np

from ethbrake_marl.errors import InvalidInput, PhysicsError, renumbered
from ethbrake_marl.physics.compiled import compiled, compiled_apart
from ethbrake_marl.physics.episode import onset_s
from ethbrake_marl.physics.kernel import (
    CLOSING,
    COMMAND,
    COUNT,
    DONE,
    FIRST_HARM,
    GAP,
    HIT,
    IMPACT,
    LIMIT,
    MASS,
    MOST_EVENTS,
    ONSET,
    ROW_WIDTH,
    SPEED,
    STRUCK,
    STUCK,
    TABLE_ROWS,
    TOTAL_HARM,
    advance_table,
    ahead,
    move_apart,
    obstacle_ahead,
    record_impacts,
    start_events,
    to_next_impact,
    with_obstacle,
)
from ethbrake_marl.physics.worlds import Bools, Floats, Worlds


def forecast(
    worlds: Worlds, command_mps2: Floats, vehicle: int, candidates_mps2: Floats, until_s: float
) -> tuple[Floats, Floats]:
    """First-impact and total harm from now to ``until_s`` if ``vehicle`` held each candidate command, [n, K] each.

    Harm is that of all pairs and of the obstacle ahead, if there is one.
    ``command_mps2`` [n, N] are the other vehicles' commands (the vehicle's own column is ignored);
    ``candidates_mps2`` [n, K]. Worlds at or beyond ``until_s`` have no harm left. Pairs hit before do not count
    again in first-impact harm. Raises ``InvalidInput`` for shapes that do not fit or a candidate beyond capacity,
    ``PhysicsError`` naming the worlds in which a check of the kernel failed.
    """
    n, N = worlds.speeds_mps.shape
    if command_mps2.shape != (n, N) or candidates_mps2.ndim != 2 or candidates_mps2.shape[0] != n:
        raise InvalidInput(
            f"forecast: commands {command_mps2.shape} and candidates {candidates_mps2.shape}; ({n}, {N}) and ({n}, K)"
            " are needed"
        )
    if not 0 <= vehicle < N:
        raise InvalidInput(f"forecast: vehicle index {vehicle}; must be in 0..{N - 1}")
    v = worlds.vehicles
    low, high = -v.braking_capacity_mps2[:, [vehicle]], v.driving_capacity_mps2[:, [vehicle]]
    good = (candidates_mps2 >= low) & (candidates_mps2 <= high)
    if not good.all():
        raise InvalidInput(
            f"forecast: candidate {candidates_mps2[~good][0]:g} m/s2 is beyond vehicle_{vehicle + 1}'s capacity"
        )
    obstacle = obstacle_ahead(worlds)
    if not obstacle.any():
        return _forecast(worlds, command_mps2, vehicle, candidates_mps2, until_s)
    first, total = np.empty(candidates_mps2.shape), np.empty(candidates_mps2.shape)
    with_one, without = np.flatnonzero(obstacle), np.flatnonzero(~obstacle)
    lines, command = with_obstacle(worlds.take(with_one)), ahead(0.0, command_mps2[with_one])
    with renumbered(with_one):
        first[with_one], total[with_one] = _forecast(lines, command, vehicle + 1, candidates_mps2[with_one], until_s)
    with renumbered(without):
        first[without], total[without] = _forecast(
            worlds.take(without), command_mps2[without], vehicle, candidates_mps2[without], until_s
        )
    return first, total


def _forecast(
    worlds: Worlds, command_mps2: Floats, vehicle: int, candidates_mps2: Floats, until_s: float
) -> tuple[Floats, Floats]:
    """``forecast`` of worlds without an obstacle, or with one that is written out as a vehicle."""
    v = worlds.vehicles
    first, total = np.zeros(candidates_mps2.shape), np.zeros(candidates_mps2.shape)
    failed = np.zeros(worlds.n, np.bool_)
    forecast_worlds(
        worlds.gaps_m, worlds.speeds_mps, worlds.time_s, worlds.pair_hit, np.ascontiguousarray(command_mps2), vehicle,
        np.ascontiguousarray(candidates_mps2), until_s, v.latency_s, v.mass_t, v.speed_limit_mps, v.restitution, first,
        total, failed,
    )  # fmt: skip
    if failed.any():
        raise PhysicsError({k: f"a forecast could not reach {until_s:g} s" for k in np.flatnonzero(failed).tolist()})
    return first, total


@compiled
def forecast_worlds(
    gaps: Floats, speeds: Floats, time: Floats, hit: Bools, command: Floats, vehicle: int, candidates: Floats,
    until_s: float, latency: Floats, mass: Floats, limit: Floats, restitution: Floats, first: Floats, total: Floats,
    failed: Bools,
) -> None:  # fmt: skip
    """Fill ``first`` and ``total`` [n, K], and ``failed`` [n] where a check failed."""
    n, vehicles = speeds.shape
    table = np.zeros((TABLE_ROWS, vehicles))
    no_rows = np.empty((0, ROW_WIDTH))
    for k in range(n):
        duration = until_s - time[k]
        if not duration > 0.0:
            continue
        for c in range(candidates.shape[1]):
            for i in range(vehicles):
                table[SPEED, i] = speeds[k, i]
                table[COMMAND, i] = candidates[k, c] if i == vehicle else command[k, i]
                table[MASS, i] = mass[k, i]
                table[LIMIT, i] = limit[k, i]
                table[ONSET, i] = onset_s(latency[k, i], time[k])
            for p in range(vehicles - 1):
                table[GAP, p] = gaps[k, p]
                table[HIT, p] = 1.0 if hit[k, p] else 0.0
            if advance_table(table, restitution[k], duration, 0.0, k, no_rows, 0)[1] != DONE:
                failed[k] = True
                break
            for p in range(vehicles - 1):
                first[k, c] += table[FIRST_HARM, p]
                total[k, c] += table[TOTAL_HARM, p]


# The forecast of contacts: when the pairs of a line first meet under commands held constant, and how hard.
#
# The physics of ``advance``, on a table that somebody has filled; nothing of the motion is kept.

# rows of what is found, per pair
CONTACT_TIME = 0  # from now to the first impact from now on (s); infinite: none
CONTACT_CLOSING = 1  # its closing speed (m/s); 0: none
CONTACT_ROWS = 2


@compiled_apart
def forecast_contacts(table: Floats, restitution: float, duration: float, found: Floats) -> int:
    """Take one world ``duration`` (s) on; its status. Fills ``found`` [CONTACT_ROWS, N], and the harm of the table.

    A pair that has had an impact before may have another first one from now on; in first-impact harm it counts no more.
    """
    for p in range(table.shape[1] - 1):
        found[CONTACT_TIME, p], found[CONTACT_CLOSING, p] = math.inf, 0.0
        table[FIRST_HARM, p] = 0.0
        table[TOTAL_HARM, p] = 0.0
        table[COUNT, p] = 0.0
    if move_apart(table, duration):
        return DONE
    start_events(table)
    no_rows, now = table[:0], 0.0
    for _ in range(MOST_EVENTS):
        status, now = to_next_impact(table, restitution, now, duration)
        if status != IMPACT:
            return status
        for p in range(table.shape[1] - 1):
            if table[STRUCK, p] == 1.0 and found[CONTACT_TIME, p] == math.inf:
                found[CONTACT_TIME, p], found[CONTACT_CLOSING, p] = now, table[CLOSING, p]
        record_impacts(table, now, 0, no_rows, 0)
    return STUCK
