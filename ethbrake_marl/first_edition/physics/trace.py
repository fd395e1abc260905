"""The exact motion within a segment (an interval of constant commands) for drawings, as intervals of constant jerk."""

from __future__ import annotations

import math

import numpy as np

from ethbrake_marl.first_edition.physics.build_up import accelerate_moving, move_on_cubics, next_moving_event
from ethbrake_marl.first_edition.physics.constant_motion import accelerate, move, next_event
from ethbrake_marl.first_edition.physics.episode import onset_s
from ethbrake_marl.first_edition.physics.impact import resolve_impacts
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.motion import BOUND
from ethbrake_marl.first_edition.physics.rows import ROW, builds_up, place_forces, place_obstacle, rows_for
from ethbrake_marl.first_edition.physics.segment import begin_commands, start_events
from ethbrake_marl.first_edition.physics.state import Floats, Worlds

_CAPACITY = 64


@compiled
def _pieces(table: Floats, restitution: float, duration: float, rows: Floats) -> int:
    """Write the state at the start of each interval of constant jerk into ``rows``; return the number of intervals.

    If ``rows`` is full, further intervals are counted but not written. If a contact was missed, the returned number of
    intervals is negative. ``table`` is one world in the layout of ``physics.rows``, updated. ``duration`` is the length
    of the segment, s. A row [1 + P + 3 N] has time (s), gaps (m), speeds (m/s), accelerations (m/s2) and jerks (m/s3).
    """
    vehicles, building = table.shape[1], builds_up(table)
    start_events(table, building)
    now, count = 0.0, 0
    for _ in range(BOUND.MOST_EVENTS):
        if resolve_impacts(table, restitution):
            continue
        if now >= duration:
            break
        parting = accelerate_moving(table) if building else math.inf
        if not building:
            accelerate(table)
        if count < rows.shape[0]:
            rows[count, 0] = now
            for p in range(vehicles - 1):
                rows[count, 1 + p] = table[ROW.GAP, p]
            for i in range(vehicles):
                rows[count, vehicles + i] = table[ROW.SPEED, i]
                rows[count, 2 * vehicles + i] = table[ROW.ACCELERATION, i]
                rows[count, 3 * vehicles + i] = table[ROW.JERK, i] if building else 0.0
        count += 1
        passed = next_moving_event(table, now, duration, parting) if building else next_event(table, now, duration)
        if not (move_on_cubics(table, passed) if building else move(table, passed)):
            return -count
        begin_commands(table, now, passed, building)
        now = duration if passed >= duration - now else now + passed
    return count


def segment_pieces(worlds: Worlds, command_mps2: Floats, until_s: Floats) -> list[Floats]:
    """Return the motion of each world until ``until_s`` [n] (s) under the commands ``command_mps2`` [n, N].

    The result is one array [k, 1 + N + 3 N] per world, with one row per interval of constant jerk. The columns are:
    absolute time at which the interval begins (s), distance that Vehicle 1 has travelled since the segment began (m),
    N - 1 gaps (m), N speeds (m/s), N accelerations (m/s2) and N jerks (m/s3).
    """
    v, N, durations = worlds.vehicles, worlds.N, until_s - worlds.time_s
    front_gaps = worlds.with_post_ahead(durations).obstacle_gap_m  # its change is the distance that Vehicle 1 travels
    latencies, restitutions = v.latency_s, v.restitution
    # columns of the vehicles, without the dummy obstacle
    wanted = [*range(N + 1), *(part * (N + 1) + i for part in (1, 2, 3) for i in range(1, N + 1))]
    parts = []
    for k in range(worlds.n):
        start = float(worlds.time_s[k])
        table = np.zeros((rows_for(v.pieces.shape[2]), N + 1))
        place_obstacle(table, float(front_gaps[k]), 0.0)
        table[ROW.COMMAND, 1:], table[ROW.SPEED, 1:] = command_mps2[k], worlds.speeds_mps[k]
        table[ROW.MASS, 1:], table[ROW.LIMIT, 1:] = v.mass_t[k], v.speed_limit_mps[k]
        table[ROW.ONSET, 0], table[ROW.ONSET, 1:] = onset_s(0.0, start), latencies[k] - start
        place_forces(table, worlds.command_mps2[k], v.brake_rate_mps3[k], v.release_rate_mps3[k], v.pieces[k])
        table[ROW.GAP, 1:N] = worlds.gaps_m[k]
        capacity = _CAPACITY
        while True:
            rows = np.empty((capacity, 4 * (N + 1)))
            count = abs(_pieces(table.copy(), float(restitutions[k]), float(durations[k]), rows))
            if count <= capacity:
                break
            capacity = count
        pieces = rows[:count, wanted]
        pieces[:, 0] += start
        pieces[:, 1] = front_gaps[k] - pieces[:, 1]
        parts.append(pieces)
    return parts
