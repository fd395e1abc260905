"""Whole runs, in one piece and in several."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.physics import Bools, Floats, Impacts, Worlds, advance
from ethbrake_marl.physics.tolerances import FEW_IMPACTS
from tests.physics.random_worlds import Batch, driving_lines

HORIZON_S = 6.0


def once(batch: Batch) -> tuple[Worlds, Impacts]:
    """The whole run in one piece, with its list of impacts."""
    return advance(batch.worlds, batch.command, until_s=HORIZON_S, record=True)


def state_bytes(worlds: Worlds, impacts: Impacts) -> tuple[bytes, ...]:
    """Every bit of a result."""
    columns = (worlds.gaps_m, worlds.speeds_mps, worlds.time_s, worlds.pair_hit, worlds.command_mps2)
    return tuple(c.tobytes() for c in (*columns, impacts.first_impact_harm, impacts.total_harm, impacts.count))


def split_errors(N: int, n: int, cuts: int, key: int) -> tuple[Floats, Bools]:
    """Relative changes of worlds cut at random times, and which of them have few impacts; [worlds of equal counts]."""
    batch = driving_lines(key, n, N)
    whole, impacts = once(batch)
    edges = np.sort(np.random.default_rng(cuts).uniform(0.0, HORIZON_S, (cuts, n)), axis=0)
    edges[-1], world, total, count = HORIZON_S, batch.worlds, np.zeros(whole.gaps_m.shape), np.zeros(whole.gaps_m.shape)
    for edge in edges:
        world, part = advance(world, batch.command, until_s=edge)
        total, count = total + part.total_harm, count + part.count
    same = (count == impacts.count).all(axis=1)
    worst = np.zeros(n)
    parts = ((world.gaps_m, whole.gaps_m, 100.0), (world.speeds_mps, whole.speeds_mps, 30.0))
    for mine, theirs, size in (*parts, (total, impacts.total_harm, 900.0)):
        scale = np.maximum(np.abs(theirs).max(axis=1), size)
        worst = np.maximum(worst, np.abs(mine - theirs).max(axis=1) / scale)
    return worst[same], count.sum(axis=1)[same] <= FEW_IMPACTS
