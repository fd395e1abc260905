"""Digest of the physics: it depends on what the physics computes, not on how its code is written."""

from __future__ import annotations

import hashlib
import math
from functools import cache

import numpy as np

from ethbrake_marl.motion.interval import move_lines
from ethbrake_marl.motion.layout import (
    BRAKE_RATE,
    BRAKING,
    CAR_ROWS,
    DRIVING,
    DROVE,
    FAR_M,
    FIRST,
    FORCE,
    GAP,
    HIT,
    IMPACTS,
    LATENCY,
    LIMIT,
    LINE_ROWS,
    MASS,
    MOVING,
    PASSED,
    PUSHED,
    RELEASE_RATE,
    RESTITUTION,
    SPEED,
    THROWN,
    TOTAL,
    Floats,
    scratch_for,
)

DIGEST_WORLDS = 400  # of each number of vehicles
INTERVALS_S = (0.1, 0.2, 0.4, 0.8, 1.6, 3.2)  # each with new commands
# The results of the physics, in the order in which they are hashed. Where they stand in `line` does not matter, and
# neither do other rows; a new result joins them at the end. Who bears PUSHED and why are not among them.
RESULTS = [SPEED, FORCE, GAP, HIT, FIRST, TOTAL, IMPACTS, PUSHED, DROVE, MOVING, THROWN, PASSED]


@cache
def physics_digest() -> str:
    """16 hexadecimal digits, a hash of 2,000 random worlds of 2 to 6 vehicles after each of six intervals.

    In each interval all vehicles hold random commands. Every kernel of this folder takes part: obstacles, brakes that
    build up, touching vehicles, plastic impacts, speed limits. The digest changes only if one of ``RESULTS`` changes.
    """
    digest = hashlib.sha256()
    for vehicles in range(2, 7):
        for line in play_random_worlds(vehicles):
            digest.update(np.ascontiguousarray(line[:, RESULTS], "<f8").data)
    return digest.hexdigest()[:16]


def play_random_worlds(vehicles: int) -> list[Floats]:
    """Arrays ``line`` of random worlds, one after each interval, [DIGEST_WORLDS, LINE_ROWS, vehicles + 1] each."""
    numbers = np.random.PCG64(vehicles)  # its raw numbers are the same in every version of numpy

    def draw(least: float, most: float, columns: int = vehicles) -> Floats:
        raw = numbers.random_raw(DIGEST_WORLDS * columns).reshape(DIGEST_WORLDS, columns) >> np.uint64(11)
        return least + (most - least) * (raw.astype(np.float64) / 2.0**53)

    def choose(*values: float, columns: int = 1) -> Floats:
        return np.array(values)[draw(0.0, len(values), columns).astype(np.int64)]

    line, car = np.zeros((DIGEST_WORLDS, LINE_ROWS, vehicles + 1)), np.zeros((DIGEST_WORLDS, CAR_ROWS, vehicles + 1))
    line[:, SPEED, 1:], line[:, GAP, -1] = draw(0.0, 25.0), math.inf
    line[:, GAP, 1:-1] = draw(0.0, 10.0, vehicles - 1) * choose(0.0, 0.001, 1.0, 1.0, columns=vehicles - 1)
    line[:, GAP, :1] = np.where(choose(0.0, 1.0) == 0.0, draw(0.0, 60.0, 1), FAR_M)
    car[:, RESTITUTION] = choose(0.0, 0.1, 0.5, 1.0)
    car[:, MASS, 1:], car[:, LIMIT, 1:], car[:, LATENCY, 1:] = draw(1.0, 40.0), draw(10.0, 40.0), draw(0.0, 1.0)
    car[:, BRAKING, 1:], car[:, DRIVING, 1:] = draw(2.0, 9.0), draw(1.0, 7.0)
    builds = choose(1.0, 0.0)
    for row in (BRAKE_RATE, RELEASE_RATE):
        car[:, row, 1:] = np.where(builds == 1.0, draw(5.0, 50.0), math.inf)
    car[:, [MASS, BRAKE_RATE, RELEASE_RATE], 0] = math.inf
    lines, time, wanted, scratch = (
        [],
        np.zeros(DIGEST_WORLDS),
        np.zeros((DIGEST_WORLDS, vehicles + 1)),
        scratch_for(vehicles + 1),
    )
    for length_s in INTERVALS_S:
        share = draw(-1.5, 1.0)
        wanted[:, 1:] = np.where(
            share < 0.0, np.maximum(share, -1.0) * car[:, BRAKING, 1:], share * car[:, DRIVING, 1:]
        )
        move_lines(line, car, time, time + length_s, wanted, scratch)
        time = time + length_s
        lines.append(line.copy())
    return lines
