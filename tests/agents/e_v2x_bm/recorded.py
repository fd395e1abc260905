"""What the coupled search found before it was made faster: of many kinds of worlds, as hashes.

``python -m tests.agents.e_v2x_bm.recorded`` prints those of the code as it is.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ethbrake_marl.agents.e_v2x_bm import CoupledOptimum, optimise_coupled
from ethbrake_marl.physics import Worlds, advance, make_worlds
from ethbrake_marl.scenario import load_scenario

SCENARIOS = {"paper-random": 1, "stress-wide": 1, "cooperation-2-five": 1, "paper-random-obstacle": 1}


def line_worlds(n: int, vehicles: int, seed: int) -> Worlds:
    """Worlds of very different vehicles, some of them so early that nobody may brake yet."""
    rng = np.random.default_rng(seed)
    shape = n, vehicles
    return make_worlds(
        rng.uniform(0.5, 12, (n, vehicles - 1)),
        rng.uniform(10, 30, shape),
        braking_capacity_mps2=rng.uniform(3, 9, shape),
        driving_capacity_mps2=3,
        latency_s=rng.uniform(0, 1.2, shape),
        mass_t=rng.uniform(1, 20, shape),
        restitution=rng.uniform(0, 1, n),
    )


def kinds(vehicles: int) -> Iterator[tuple[str, Worlds, dict[str, object]]]:
    """Name, worlds and options: at the alert, with gentle, coasting and driving others, later, and with an obstacle."""
    n = 24
    rng, worlds = np.random.default_rng(vehicles), line_worlds(n, vehicles, seed=vehicles)
    braking = worlds.vehicles.braking_capacity_mps2
    others = np.clip(rng.uniform(-1, 0.3, braking.shape) * braking, -braking, 3)
    later, _ = advance(worlds, -braking * rng.uniform(0, 1, braking.shape), until_s=rng.uniform(0, 2, n))
    forward = np.flatnonzero((later.speeds_mps >= 0).all(axis=1))
    obstacle = np.where(rng.random(n) < 0.5, rng.uniform(5, 120, n), np.inf)
    yield "alert", worlds, {"harm_count": "total"}
    yield "others", worlds, {"others_mps2": others, "horizon_s": 6.3}
    yield "later", later.take(forward), {"others_mps2": others[forward], "horizon_s": 5.0}
    yield "obstacle", replace(worlds, obstacle_gap_m=obstacle), {"harm_count": "total"}


def sha256(found: CoupledOptimum) -> str:
    """Of all columns, the first 16 digits."""
    return hashlib.sha256(b"".join(np.ascontiguousarray(column).tobytes() for column in found)).hexdigest()[:16]


def hashes() -> Iterator[tuple[str, str]]:
    """Name and hash of every case."""
    for name, vehicle in SCENARIOS.items():
        worlds = load_scenario(name).sample(60, seed=7).worlds
        for harm_count in ("first", "total"):
            yield f"{name} {harm_count}", sha256(optimise_coupled(worlds, vehicle, harm_count=harm_count))
    for vehicles in (2, 4, 7):
        for kind, worlds, options in kinds(vehicles):
            for vehicle in sorted({0, vehicles // 2, vehicles - 1}):
                yield f"{vehicles} {kind} {vehicle}", sha256(optimise_coupled(worlds, vehicle, **options))


if __name__ == "__main__":
    for case, digest in hashes():
        print(f'    "{case}": "{digest}",')
