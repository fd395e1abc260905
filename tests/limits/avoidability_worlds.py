"""Worlds far beyond the paper's ranges, and random profiles of the controlled vehicle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.physics import Worlds, make_worlds

Array = NDArray[np.float64]


def wide_worlds(n: int, vehicles: int, seed: int, *, zeros: float = 0.03, strong: bool = False) -> Worlds:
    """Lines with any capacities, low speed limits, standing vehicles, exact zeros; Vehicle 1 brakes at 0.

    ``strong``: Vehicle 2 brakes at least as hard as the others.
    """
    rng = np.random.default_rng(seed)
    gaps = rng.uniform(0, 40, (n, vehicles - 1)) * rng.choice([0.1, 0.4, 1.0], (n, vehicles - 1))
    speeds = rng.uniform(0, 35, (n, 1)) + rng.normal(0, 1, (n, vehicles)) * rng.choice([0.5, 3, 10], (n, 1))
    speeds = np.clip(speeds, 0, 35)
    braking = rng.uniform(1, 10, (n, vehicles))
    braking[:, 1] = np.where(rng.random(n) < 0.1, braking[:, 0], braking[:, 1])
    if strong:
        braking[:, 1] = braking.max(axis=1) * rng.choice([1.0, 1.05, 1.3], n)
    driving = rng.uniform(0, 8, (n, vehicles))
    latency = rng.uniform(0, 1.5, (n, vehicles))
    latency[:, 0] = 0
    above = rng.exponential(5, (n, vehicles)) * rng.choice([0, 1], (n, vehicles), p=[0.2, 0.8])
    for part in (gaps, speeds, driving, latency):
        part[rng.random(part.shape) < zeros] = 0
    return make_worlds(
        gaps,
        speeds,
        braking_capacity_mps2=braking,
        driving_capacity_mps2=driving,
        latency_s=latency,
        mass_t=rng.uniform(1, 20, (n, vehicles)),
        restitution=rng.uniform(0, 0.5, n),
        speed_limit_mps=np.maximum(speeds + above, 1e-3),
    )


def with_gap(worlds: Worlds, pair: int, gap: Array) -> Worlds:
    """The same worlds with another gap."""
    gaps = worlds.gaps_m.copy()
    gaps[:, pair] = gap
    return replace(worlds, gaps_m=gaps)


def random_profiles(worlds: Worlds, vehicle: int, rng: np.random.Generator, pieces: int = 5) -> tuple[Array, Array]:
    """Switch times and commands [n, pieces]: most commands extreme, most switches soon after the latency."""
    v, n = worlds.vehicles, worlds.n
    low, high = -v.braking_capacity_mps2[:, [vehicle]], v.driving_capacity_mps2[:, [vehicle]]
    span = np.max(v.latency_s + worlds.speeds_mps / v.braking_capacity_mps2, axis=1, keepdims=True)
    part = np.sort(rng.uniform(0, 1, (n, pieces - 1)) ** rng.choice([1, 2, 4], (n, 1)), axis=1)
    switch = np.column_stack([worlds.time_s, v.latency_s[:, [vehicle]] + part * span])
    share = rng.uniform(0, 1, (n, pieces))
    share = np.where(rng.random((n, pieces)) < 0.6, np.round(share), share)
    return in_order(worlds, switch), np.clip(low + (high - low) * share, low, high)


def moved_profiles(
    worlds: Worlds, vehicle: int, switch: Array, command: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """The profiles, each changed a little or a lot in some of its numbers."""
    v, n = worlds.vehicles, worlds.n
    low, high = -v.braking_capacity_mps2[:, [vehicle]], v.driving_capacity_mps2[:, [vehicle]]
    scale = 10.0 ** rng.uniform(-5, 0, (n, 1))
    switch = switch + 3 * scale * rng.normal(size=switch.shape) * (rng.random(switch.shape) < 0.5)
    command = command + 7 * scale * rng.normal(size=command.shape) * (rng.random(command.shape) < 0.3)
    return in_order(worlds, switch), np.clip(command, low, high)


def in_order(worlds: Worlds, switch: Array) -> Array:
    """Switch times from the worlds' own time on that never fall."""
    switch = np.maximum.accumulate(np.maximum(switch, worlds.time_s[:, None]), axis=1)
    switch[:, 0] = worlds.time_s
    return switch
