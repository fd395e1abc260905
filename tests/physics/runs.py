"""Whole runs, in one piece and in several."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import NamedTuple

import numpy as np

from ethbrake_marl.physics import Bools, Floats, Impacts, Worlds, advance
from tests.physics.random_worlds import Batch, driving_lines
from tests.reference.tolerances import FEW_IMPACTS

HORIZON_S = 6.0
HARMS = [f.name for f in fields(Impacts) if f.name != "rows"]


def once(batch: Batch) -> tuple[Worlds, Impacts]:
    """The whole run in one piece, with its list of impacts."""
    return advance(batch.worlds, batch.command, until_s=HORIZON_S, record=True)


def state_bytes(worlds: Worlds, impacts: Impacts) -> tuple[bytes, ...]:
    """Every bit of a result."""
    columns = [getattr(worlds, f.name) for f in fields(worlds)[1:]] + [getattr(impacts, name) for name in HARMS]
    return tuple(column.tobytes() for column in columns)


def relative_changes(mine: Worlds, theirs: Worlds, total_harm: Floats, other_harm: Floats) -> Floats:
    """Largest change of a world's gaps, speeds and harm, relative to at least 100 m, 30 m/s, 900 m2/s2, [n]."""
    worst = np.zeros(mine.n)
    parts = ((mine.gaps_m, theirs.gaps_m, 100.0), (mine.speeds_mps, theirs.speeds_mps, 30.0))
    for one, other, size in (*parts, (total_harm, other_harm, 900.0)):
        scale = np.maximum(np.abs(other).max(axis=1), size)
        worst = np.maximum(worst, np.abs(one - other).max(axis=1) / scale)
    return worst


class Split(NamedTuple):
    """What cutting a run at random times changed; arrays [n]."""

    error: Floats  # relative_changes
    few: Bools  # at most FEW_IMPACTS impacts
    other: Bools  # some pair has another number of impacts


def split_errors(N: int, n: int, cuts: int, key: int) -> Split:
    """Whole runs against the same runs cut at random times."""
    batch = driving_lines(key, n, N)
    whole, impacts = once(batch)
    edges = np.sort(np.random.default_rng(cuts).uniform(0.0, HORIZON_S, (cuts, n)), axis=0)
    edges[-1], world, total, count = HORIZON_S, batch.worlds, np.zeros(whole.gaps_m.shape), np.zeros(whole.gaps_m.shape)
    for edge in edges:
        world, part = advance(world, batch.command, until_s=edge)
        total, count = total + part.total_harm, count + part.count
    error = relative_changes(world, whole, total, impacts.total_harm)
    return Split(error, _few(impacts), (count != impacts.count).any(axis=1))


def last_digit_errors(N: int, n: int, key: int) -> Split:
    """The same runs, uncut, against those whose initial gaps have another last digit: what doubles can know at all."""
    batch = driving_lines(key, n, N)
    whole, impacts = once(batch)
    gaps = batch.worlds.gaps_m
    moved = replace(batch.worlds, gaps_m=np.where(gaps > 0.0, np.nextafter(gaps, np.inf), gaps))
    other, changed = once(Batch(moved, batch.command))
    error = relative_changes(other, whole, changed.total_harm, impacts.total_harm)
    return Split(error, _few(impacts), (changed.count != impacts.count).any(axis=1))


def _few(impacts: Impacts) -> Bools:
    few: Bools = impacts.count.sum(axis=1) <= FEW_IMPACTS
    return few
