"""Piecewise-constant commands of one vehicle, played in the exact physics."""

import numpy as np

from ethbrake_marl.first_edition.game.harm import Ledger, empty_ledger
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.state import Floats, Worlds


def play_profile(worlds: Worlds, vehicle: int, switch_s: Floats, command_mps2: Floats) -> tuple[Worlds, Ledger]:
    """Play ``command_mps2`` [n, K], each from its ``switch_s`` [n, K] to the next, while all others brake fully.

    Absolute times, in order; the first is the worlds' own time, infinite ones are never reached. Ends when everything
    stands, or never will: at the last onset or switch, plus ``limit / a`` of each vehicle.
    """
    v = worlds.vehicles
    last = np.max(np.where(np.isfinite(switch_s), switch_s, 0.0), axis=1)
    stopping = np.maximum(v.speed_limit_mps, worlds.speeds_mps) / v.braking_capacity_mps2
    end = np.maximum(v.latency_s.max(axis=1), last) + stopping.sum(axis=1)
    command = -v.braking_capacity_mps2
    ledger = empty_ledger(worlds)
    for k, until in enumerate([*switch_s.T[1:], end]):
        command[:, vehicle] = command_mps2[:, k]
        worlds, impacts = advance(worlds, command, until_s=np.maximum(np.minimum(until, end), worlds.time_s))
        ledger = ledger.add(impacts)
    return worlds, ledger
