"""The lower bound is rounded outward: no run undercuts it by the last bits, however finely it is cut into steps."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.harm import empty_ledger
from ethbrake_marl.limits.lower_bound import lower_bound, rounding
from ethbrake_marl.physics import advance, make_worlds


def two_vehicles(n, seed):
    """Pairs of any gap, speed, capacity, mass and restitution; both act from the start."""
    rng = np.random.default_rng(seed)
    return make_worlds(
        rng.uniform(0.01, 60, (n, 1)) * rng.choice([0.05, 0.3, 1.0], (n, 1)),
        rng.uniform(0, 45, (n, 2)),
        braking_capacity_mps2=rng.uniform(1, 12, (n, 2)),
        driving_capacity_mps2=rng.uniform(0, 8, (n, 2)),
        latency_s=0.0,
        mass_t=10 ** rng.uniform(-1.3, 2, (n, 2)),
        restitution=rng.uniform(0, 1, n),
        speed_limit_mps=60.0,
    )


def driven(worlds, command, step):
    """Total harm under a constant command, advanced step by step as the engine does."""
    ledger = empty_ledger(worlds)
    for k in range(1, round(8.0 / step) + 1):
        worlds, impacts = advance(worlds, command, until_s=np.minimum(k * step, 8.0))
        ledger = ledger.add(impacts)
    return ledger.world_harm("first")


@pytest.mark.parametrize("vehicle", [0, 1])
@pytest.mark.parametrize("step", [0.1, 0.02])
def test_bound__is_never_above_what_its_own_optimum_realises_in_steps(vehicle, step):
    # Full braking behind a leader, or full drive ahead of a follower, attains the bound; rounding alone decides.
    worlds = two_vehicles(4000, seed=61)
    command = -worlds.vehicles.braking_capacity_mps2
    if vehicle == 0:
        command[:, 0] = worlds.vehicles.driving_capacity_mps2[:, 0]
    bound, harm = lower_bound(worlds, vehicle).harm, driven(worlds, command, step)
    attained = (harm > 0) & (harm - bound < 1e-6)
    assert attained.sum() > 500
    assert np.all(bound <= harm)
    # Most of what is subtracted is not needed, and all of it is little.
    assert np.max(np.abs(harm - rounding(worlds, vehicle) - bound)[attained]) < 0.1 * rounding(worlds, vehicle).max()
    assert rounding(worlds, vehicle).max() < 1e-7
