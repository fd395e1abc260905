"""Lines of vehicles in the layout of the physics, and their motion, for tests."""

from __future__ import annotations

from typing import Any

import numpy as np

from ethbrake_marl.motion import layout as at
from ethbrake_marl.motion.interval import move_line
from ethbrake_marl.motion.layout import Floats, scratch_for

ROWS = {
    "mass_t": at.MASS, "speed_limit_mps": at.LIMIT, "latency_s": at.LATENCY, "braking_capacity_mps2": at.BRAKING,
    "driving_capacity_mps2": at.DRIVING, "brake_rate_mps3": at.BRAKE_RATE, "release_rate_mps3": at.RELEASE_RATE,
}  # fmt: skip
USUAL = {
    "mass_t": 1.0, "speed_limit_mps": 64.0, "latency_s": 0.0, "braking_capacity_mps2": 16.0,
    "driving_capacity_mps2": 16.0, "brake_rate_mps3": np.inf, "release_rate_mps3": np.inf,
}  # fmt: skip


def lines(
    gaps_m: Any,
    speeds_mps: Any,
    *,
    restitution: Any = 0.0,
    obstacle_gap_m: Any = at.FAR_M,
    force_mps2: Any = 0.0,
    **settings: Any,
) -> tuple[Floats, Floats]:
    """``line`` and ``car`` of n worlds of N vehicles; a setting is a number, [N] or [n, N]."""
    speeds = np.atleast_2d(np.asarray(speeds_mps, np.float64))
    n, N = speeds.shape
    line, car = np.zeros((n, at.LINE_ROWS, N + 1)), np.zeros((n, at.CAR_ROWS, N + 1))
    line[:, at.SPEED, 1:], line[:, at.FORCE, 1:] = speeds, force_mps2
    line[:, at.GAP, 1:N], line[:, at.GAP, 0], line[:, at.GAP, N] = gaps_m, obstacle_gap_m, np.inf
    for name, value in {**USUAL, **settings}.items():
        car[:, ROWS[name], 1:] = value
    car[:, at.RESTITUTION] = np.reshape(restitution, (-1, 1))
    car[:, at.MASS, 0] = car[:, at.BRAKE_RATE, 0] = car[:, at.RELEASE_RATE, 0] = np.inf
    return line, car


def driven(line: Floats, car: Floats, command: Any, start: Any, until: Any) -> tuple[Floats, Floats, Floats]:
    """Lines after an interval, what ``move_line`` met, and its scratch memory [n, SCRATCH_ROWS, N + 1]."""
    n, bodies = len(line), line.shape[2]
    wanted, after, met, scratch = np.zeros((n, bodies)), line.copy(), np.zeros(n, np.int64), scratch_for(bodies)
    wanted[:, 1:] = command
    rows = np.zeros((n, at.SCRATCH_ROWS, bodies))
    times = np.broadcast_to(np.float64(start), n).tolist(), np.broadcast_to(np.float64(until), n).tolist()
    for k in range(n):
        met[k] = move_line(after[k], car[k], wanted[k], scratch, times[0][k], times[1][k])
        rows[k] = scratch
    return after, met, rows
