"""Touching vehicles whose speeds differ by a few last digits: what plastic impacts leave, and where rounding rules."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ethbrake_marl.physics import Worlds, make_worlds
from tests.physics.random_worlds import CAPACITY_MPS2, Batch, Draws

MOST_ULPS = 3.0


def nearly_joined(key: int, n: int, N: int, *, obstacle: bool = False) -> Worlds:
    """Lines that touch throughout, at one speed but for a few units in the last place, masses from 0.05 to 100 t.

    With an ``obstacle`` they touch that too, and only these units are left of their speeds.
    """
    draws = Draws(key)
    speed = 2.0 ** draws.uniform(-10.0, 5.0, (n, 1))
    ulps = np.rint(draws.uniform(-MOST_ULPS, MOST_ULPS, (n, N))) * np.spacing(speed)
    worlds = make_worlds(
        np.zeros((n, N - 1)),
        speed + ulps,
        braking_capacity_mps2=CAPACITY_MPS2,
        driving_capacity_mps2=CAPACITY_MPS2,
        latency_s=0.0,
        mass_t=10.0 ** draws.uniform(-1.3, 2.0, (n, N)),
        restitution=draws.choice([0.0, 0.1, 0.3, 1.0], (n,)),
    )
    return replace(worlds, speeds_mps=ulps, obstacle_gap_m=np.zeros(n)) if obstacle else worlds


def thrown_lines(key: int, n: int, N: int) -> Batch:
    """Lines of any masses and restitution, late leaders among them, against an obstacle 10 to 40 m ahead."""
    draws = Draws(key)
    capacity = draws.uniform(4.0, 9.0, (n, N))
    worlds = make_worlds(
        draws.uniform(1.0, 5.0, (n, N - 1)) * draws.choice([1.0] * 9 + [0.0], (n, N - 1)),
        draws.uniform(15.0, 30.0, (n, N)),
        braking_capacity_mps2=capacity,
        driving_capacity_mps2=4.0,
        latency_s=draws.uniform(0.0, 1.5, (n, N)),
        mass_t=10.0 ** draws.uniform(-1.3, 2.0, (n, N)),
        restitution=draws.choice([0.0, 0.1, 0.3, 0.6], (n,)),
        obstacle_gap_m=draws.uniform(10.0, 40.0, (n,)),
    )
    command = np.maximum(draws.uniform(-12.0, 4.0, (n, N)), -capacity)
    return Batch(worlds, command)
