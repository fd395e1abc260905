"""A segment of constant command as pieces of constant acceleration: what a picture needs to be exact between events."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.episode import onset_s
from ethbrake_marl.physics.impact import GAP, MASS, SPEED, resolve_impacts
from ethbrake_marl.physics.obstacle import place_obstacle, with_post_ahead
from ethbrake_marl.physics.segment import (
    ACCELERATION,
    ACTIVE,
    COMMAND,
    LIMIT,
    MOST_EVENTS,
    ONSET,
    TABLE_ROWS,
    accelerate,
    move,
    next_event,
    start_events,
)
from ethbrake_marl.physics.worlds import Floats, Worlds

_CAPACITY = 64


@compiled
def _pieces(table: Floats, restitution: float, duration: float, rows: Floats) -> int:
    """Write down time from the start, gaps, speeds and accelerations at the beginning of each piece; their number.

    Those that do not fit into ``rows`` [capacity, 1 + P + 2 N] are only counted; minus their number where a contact
    was missed.
    """
    vehicles = table.shape[1]
    start_events(table)
    now, count = 0.0, 0
    for _ in range(MOST_EVENTS):
        if resolve_impacts(table, restitution):
            continue
        if now >= duration:
            break
        accelerate(table)
        if count < rows.shape[0]:
            rows[count, 0] = now
            for p in range(vehicles - 1):
                rows[count, 1 + p] = table[GAP, p]
            for i in range(vehicles):
                rows[count, vehicles + i] = table[SPEED, i]
                rows[count, 2 * vehicles + i] = table[ACCELERATION, i]
        count += 1
        passed = next_event(table, now, duration)
        if not move(table, passed):
            return -count
        for i in range(vehicles):
            if table[ONSET, i] - now <= passed:
                table[ACTIVE, i] = 1.0
        now = duration if passed >= duration - now else now + passed
    return count


def segment_pieces(worlds: Worlds, command_mps2: Floats, until_s: Floats) -> list[Floats]:
    """The motion of each world until a time, under one command: a row per piece of constant acceleration.

    Args:
        worlds: n, of N vehicles; they stay as they are.
        command_mps2: signed accelerations wanted, [n, N] m/s2.
        until_s: where the segments end, [n] s.

    Returns for each world [k, 1 + N + 2 N]: the absolute time at which the piece begins (s), how far Vehicle 1 has come
    since the segment began, the gaps (m), the speeds (m/s) and the accelerations (m/s2).

    """
    v, N, durations = worlds.vehicles, worlds.N, until_s - worlds.time_s
    front_gaps = with_post_ahead(worlds, durations).obstacle_gap_m  # says where Vehicle 1 is
    latencies, restitutions = v.latency_s, v.restitution
    wanted = [*range(N + 1), *range(N + 2, 2 * N + 2), *range(2 * N + 3, 3 * N + 3)]  # all but the post's own
    found = []
    for k in range(worlds.n):
        start = float(worlds.time_s[k])
        table = np.zeros((TABLE_ROWS, N + 1))
        place_obstacle(table, float(front_gaps[k]), 0.0)
        table[COMMAND, 1:], table[SPEED, 1:] = command_mps2[k], worlds.speeds_mps[k]
        table[MASS, 1:], table[LIMIT, 1:] = v.mass_t[k], v.speed_limit_mps[k]
        table[ONSET, 0], table[ONSET, 1:] = onset_s(0.0, start), latencies[k] - start
        table[GAP, 1:N] = worlds.gaps_m[k]
        capacity = _CAPACITY
        while True:
            rows = np.empty((capacity, 3 * (N + 1)))
            count = abs(_pieces(table.copy(), float(restitutions[k]), float(durations[k]), rows))
            if count <= capacity:
                break
            capacity = count
        pieces = rows[:count, wanted]
        pieces[:, 0] += start
        pieces[:, 1] = front_gaps[k] - pieces[:, 1]
        found.append(pieces)
    return found
