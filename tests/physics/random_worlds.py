"""Random worlds from raw counter-based bits: the same doubles on any machine and with any version of numpy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ethbrake_marl.physics import Floats, Worlds, make_worlds

CAPACITY_MPS2 = 8.0


class Batch(NamedTuple):
    """Worlds at t = 0 and their commands [n, N]."""

    worlds: Worlds
    command: Floats


class Draws:
    """Uniform doubles made from the raw 64-bit words of a Philox counter."""

    def __init__(self, key: int) -> None:
        self._words = np.random.Philox(key=key)

    def uniform(self, low: float, high: float, shape: tuple[int, ...]) -> Floats:
        """Multiples of 2^-53 in [0, 1), scaled."""
        words = np.asarray(self._words.random_raw(int(np.prod(shape))), np.uint64).reshape(shape)
        unit: Floats = (words >> np.uint64(11)).astype(np.float64) * 2.0**-53
        return low + (high - low) * unit

    def choice(self, values: list[float], shape: tuple[int, ...]) -> Floats:
        """One of ``values`` each."""
        index = (self.uniform(0.0, len(values), shape)).astype(np.int64)
        return np.asarray(values)[index]


def driving_lines(key: int, n: int, N: int, *, drive: bool = True) -> Batch:
    """Lines that brake, coast and (with ``drive``) accelerate, some of them from touching or from rest."""
    draws = Draws(key)
    gaps = draws.uniform(0.2, 10.0, (n, N - 1)) * draws.choice([1.0] * 9 + [0.0], (n, N - 1))
    speeds = draws.uniform(5.0, 25.0, (n, N)) * draws.choice([1.0] * 19 + [0.0], (n, N))
    worlds = make_worlds(
        gaps,
        speeds,
        braking_capacity_mps2=CAPACITY_MPS2,
        driving_capacity_mps2=CAPACITY_MPS2,
        latency_s=draws.uniform(0.0, 1.0, (n, N)),
        mass_t=draws.uniform(1.0, 8.0, (n, N)),
        speed_limit_mps=draws.uniform(25.0, 30.0, (n, N)),
        restitution=draws.choice([0.0, 0.1, 0.3, 0.7], (n,)),
    )
    command = draws.uniform(-CAPACITY_MPS2, 4.0 if drive else 0.0, (n, N)) * draws.choice([1.0] * 7 + [0.0], (n, N))
    return Batch(worlds, command)


def touching_lines(key: int, n: int, N: int, *, heaviest_ratio: float = 1.0) -> Batch:
    """Lines in which most pairs touch, at speeds of their own: many simultaneous impacts at t = 0."""
    draws = Draws(key)
    gaps = draws.choice([0.0, 0.0, 0.0, 1.0], (n, N - 1)) if N > 2 else np.zeros((n, 1))
    mass = draws.uniform(0.5, 8.0, (n, N)) * draws.choice([1.0] * 9 + [heaviest_ratio], (n, N))
    worlds = make_worlds(
        gaps,
        draws.uniform(0.0, 30.0, (n, N)),
        braking_capacity_mps2=CAPACITY_MPS2,
        driving_capacity_mps2=CAPACITY_MPS2,
        latency_s=0.0,
        mass_t=mass,
        restitution=draws.choice([0.0, 0.1, 0.5, 0.9, 1.0], (n,)),
    )
    return Batch(worlds, np.zeros((n, N)))
