"""Gates on the end of every instant: simultaneous impacts of long lines, of any masses, with and without obstacle."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.errors import PhysicsError
from ethbrake_marl.physics import Floats, Worlds, advance
from tests.physics.programme.gates import Figure, gate
from tests.physics.random_worlds import HORIZON_S, nearly_joined, thrown_lines

NEARLY_JOINED = {2: 200_000, 3: 300_000, 5: 200_000, 10: 200_000, 20: 80_000, 50: 20_000}  # by vehicles
THROWN = {2: 250_000, 3: 250_000, 5: 200_000, 10: 250_000, 20: 40_000, 50: 10_000}
CHUNK = 10_000


def unfinished(worlds: Worlds, command: Floats, until_s: float) -> int:
    """How many of these worlds cannot be advanced."""
    try:
        advance(worlds, command, until_s=until_s)
    except PhysicsError as error:
        return len(error.worlds)
    return 0


@gate("instants that do not end: clusters a few ulps apart")
def clusters() -> Figure:
    """Touching lines at one speed but for the last digits, half of them against an obstacle."""
    failed = 0
    for N, n in NEARLY_JOINED.items():
        for chunk in range(n // CHUNK):
            worlds = nearly_joined(1_000 * N + chunk, CHUNK, N, obstacle=chunk % 2 == 1)
            failed += unfinished(worlds, np.zeros((CHUNK, N)), 0.0)
    return Figure(failed, 0, f"{sum(NEARLY_JOINED.values()):,} clusters of 2 to 50 vehicles")


@gate("instants that do not end: lines thrown against an obstacle")
def thrown() -> Figure:
    """Whole runs of 6 s."""
    failed = 0
    for N, n in THROWN.items():
        for chunk in range(n // CHUNK):
            worlds, command = thrown_lines(100_000 + 1_000 * N + chunk, CHUNK, N)
            failed += unfinished(worlds, command, HORIZON_S)
    return Figure(failed, 0, f"{sum(THROWN.values()):,} worlds of 2 to 50 vehicles, masses 0.05 to 100 t")
