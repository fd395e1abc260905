"""Piecewise-constant commands of one vehicle, played in the exact physics."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.harm import Ledger, empty_ledger
from ethbrake_marl.physics import Floats, Worlds, advance


def play_profile(
    worlds: Worlds, vehicle: int, switch_s: Floats, command_mps2: Floats, *, until_s: float | Floats | None = None
) -> tuple[Worlds, Ledger]:
    """Play ``command_mps2`` [n, K], each from its ``switch_s`` [n, K] to the next, while all others brake fully.

    Absolute times, in order; the first is the worlds' own time, infinite ones are never reached. Ends at ``until_s``
    (default: when everything stands, or never will).
    """
    n, K = worlds.n, switch_s.shape[-1]
    end = np.broadcast_to(rest_s(worlds, switch_s) if until_s is None else until_s, (n,))
    command = -worlds.vehicles.braking_capacity_mps2
    ledger = empty_ledger(worlds)
    for k in range(K):
        command[:, vehicle] = command_mps2[:, k]
        until = np.minimum(switch_s[:, k + 1], end) if k + 1 < K else end
        worlds, impacts = advance(worlds, command, until_s=np.maximum(until, worlds.time_s))
        ledger = ledger.add(impacts)
    return worlds, ledger


def rest_s(worlds: Worlds, switch_s: Floats) -> Floats:
    """A time by which every vehicle that brakes at last stands, [n]: onset or last switch, plus ``limit / a``."""
    v = worlds.vehicles
    last = np.max(np.where(np.isfinite(switch_s), switch_s, 0.0), axis=1)
    stopping = np.maximum(v.speed_limit_mps, worlds.speeds_mps) / v.braking_capacity_mps2
    return np.maximum(v.latency_s.max(axis=1), last) + stopping.sum(axis=1)
