"""A segment of constant command as pieces of constant acceleration: what a picture needs to be exact between events."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.errors import InvalidInput
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


def segment_pieces(world: Worlds, command_mps2: Floats, until_s: float) -> Floats:
    """The motion of one world until a time, under one command: a row per piece of constant acceleration.

    Args:
        world: n = 1, of N vehicles; it stays as it is.
        command_mps2: signed acceleration wanted, [N] m/s2.
        until_s: where the segment ends, s.

    Returns [k, 1 + N + 2 N]: the absolute time at which the piece begins (s), how far Vehicle 1 has come since the
    segment began, the gaps (m), the speeds (m/s) and the accelerations (m/s2). Raises ``InvalidInput`` for more than
    one world.

    """
    if world.n != 1:
        raise InvalidInput(f"segment_pieces: {world.n} worlds given; exactly 1 is needed")
    start = float(world.time_s[0])
    duration = float(until_s) - start
    front_gap = float(with_post_ahead(world, np.array([duration])).obstacle_gap_m[0])  # says where Vehicle 1 is
    v, N = world.vehicles, world.N
    table = np.zeros((TABLE_ROWS, N + 1))
    place_obstacle(table, front_gap, 0.0)
    table[COMMAND, 1:], table[SPEED, 1:] = command_mps2, world.speeds_mps[0]
    table[MASS, 1:], table[LIMIT, 1:] = v.mass_t[0], v.speed_limit_mps[0]
    table[ONSET, 0] = onset_s(0.0, start)
    table[ONSET, 1:] = [onset_s(float(latency), start) for latency in v.latency_s[0]]
    table[GAP, 1:N] = world.gaps_m[0]
    capacity = _CAPACITY
    while True:
        rows = np.zeros((capacity, 3 * (N + 1)))
        count = abs(_pieces(table.copy(), float(v.restitution[0]), duration, rows))
        if count <= capacity:
            break
        capacity = count
    seen = [*range(N + 1), *range(N + 2, 2 * N + 2), *range(2 * N + 3, 3 * N + 3)]  # all but the post's own
    rows = rows[:count, seen]
    rows[:, 0] += start
    rows[:, 1] = front_gap - rows[:, 1]
    return rows
