"""Gates on what must not matter: cuts, the origin of time, the batch, its order, threads, another day."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from ethbrake_marl.physics import Impacts, Worlds, advance
from tests.golden.test_golden import GOLDEN, figures
from tests.physics.programme.gates import Figure, gate
from tests.physics.random_worlds import (
    HARMS,
    HORIZON_S,
    Batch,
    Split,
    driving_lines,
    last_digit_errors,
    once,
    split_errors,
    state_bytes,
    touching_lines,
)
from tests.reference.tolerances import BOUNCE_SERIES_EPS, EPS, SPLIT, SPLIT_CASCADE

# ---------------------------------------------------------------- what must not matter


_SPLITS: list[Split] = []


def splits() -> list[Split]:
    """All split worlds; made once."""
    if not _SPLITS:
        _SPLITS.extend(split_errors(N, 60_000 // N, cuts, 91) for N in (2, 3, 5, 10, 20) for cuts in (2, 7, 80))
    return _SPLITS


@gate("a segment that is split, few impacts [relative]")
def splitting() -> Figure:
    """Gaps, speeds and harm, relative to at least 100 m, 30 m/s, 900 m2/s2; up to 30 impacts."""
    worst = max(float(s.error[s.few].max()) for s in splits() if s.few.any())
    return Figure(worst, SPLIT, f"{sum(int(s.few.sum()) for s in splits()):,} worlds in 2, 7 and 80 parts")


@gate("a segment that is split, cascades [relative]")
def splitting_cascades() -> Figure:
    """The same for worlds with more impacts; beside it what another last digit of the initial gaps changes in them."""
    worst = max(float(s.error[~s.few].max()) for s in splits() if not s.few.all())
    digits = [last_digit_errors(N, 60_000 // N, 91) for N in (3, 5, 10, 20)]
    known = max(float(s.error[~s.few].max()) for s in digits)
    worlds = sum(int((~s.few).sum()) for s in splits())
    return Figure(
        worst, SPLIT_CASCADE, f"{worlds:,} worlds with more than 30 impacts; a last digit of their gaps: {known:.2g}"
    )


@gate("a segment that is split, worlds with other impacts")
def splitting_counts() -> Figure:
    """Worlds in which some pair has another number of impacts."""
    return Figure(sum(int(s.other.sum()) for s in splits()), 0, "the same worlds")


@gate("worlds changed by the origin of time")
def origin() -> Figure:
    """To the last bit; times on a grid of 2^-20 s."""
    batch = driving_lines(92, 50_000, 4)
    v = batch.worlds.vehicles
    grid = replace(batch.worlds, vehicles=replace(v, latency_s=np.round(v.latency_s * 2**20) / 2**20))
    here, impacts = advance(grid, batch.command, until_s=6.0)
    changed = 0
    for shift in (-0.5, 64.0, 4096.0):
        vehicles = replace(grid.vehicles, latency_s=grid.vehicles.latency_s + shift)
        moved = replace(grid, vehicles=vehicles, time_s=grid.time_s + shift)
        there, same = advance(moved, batch.command, until_s=6.0 + shift)
        columns = (
            (here.gaps_m, there.gaps_m),
            (here.speeds_mps, there.speeds_mps),
            (impacts.total_harm, same.total_harm),
        )
        changed += int(np.any([(a != b).any(axis=1) for a, b in columns], axis=0).sum())
    return Figure(changed, 0, "50,000 worlds, three shifts (positions are not stored: space has no origin)")


@gate("batches whose bits depend on their make-up")
def batches() -> Figure:
    """One world alone, in any order, in one thread or two."""
    n, changed = 20_000, 0
    batch = driving_lines(93, n, 3)
    whole = state_bytes(*once(batch))

    def together(parts: list[tuple[Worlds, Impacts]]) -> tuple[bytes, ...]:
        harm = [np.concatenate([getattr(i, f) for _, i in parts]) for f in HARMS]
        return state_bytes(Worlds.concatenate([world for world, _ in parts]), Impacts(*harm))

    def chunk(rows: np.ndarray) -> tuple[Worlds, Impacts]:
        return once(Batch(batch.worlds.take(rows), batch.command[rows]))

    changed += together([chunk(np.array([k])) for k in range(n)]) != whole
    changed += state_bytes(*advance(batch.worlds, batch.command, until_s=HORIZON_S, threads=2)) != whole
    with ThreadPoolExecutor(2) as pool:
        changed += together(list(pool.map(chunk, np.array_split(np.arange(n), 64)))) != whole
    for seed in range(10):
        order = np.random.default_rng(seed).permutation(n)
        world, impacts = chunk(order)
        back = np.argsort(order)
        harm = [getattr(impacts, f)[back] for f in HARMS]
        changed += state_bytes(world.take(back), Impacts(*harm)) != whole
    return Figure(changed, 0, f"{n:,} worlds alone, on 2 threads (threads=2, and 64 parts by hand), in 10 orders")


@gate("golden hash of 10,000 worlds, different")
def golden() -> Figure:
    """``tests/golden/physics_worlds.json``."""
    found = figures()
    return Figure(
        int(found != json.loads(GOLDEN.read_text("utf-8"))["all"]), 0, f"sha256 {str(found['sha256'])[:16]}..."
    )


@gate("bounces: total time of a series [relative]")
def bounces() -> Figure:
    """Against the geometric sum of flights, for e from 0.05 to 0.99."""
    worst = 0.0
    for e in np.linspace(0.05, 0.99, 95):
        wall = touching_lines(0, 1, 2).worlds
        wall = replace(wall, speeds_mps=np.array([[0.0, 8.0]]))
        vehicles = replace(wall.vehicles, mass_t=np.array([[2.0**50, 1.0]]), restitution=np.array([e]))
        _, impacts = advance(replace(wall, vehicles=vehicles), [-8.0, 4.0], 2_000.0, record=True)
        closing = [8.0]
        while closing[-1] >= 0.05:
            closing.append(closing[-1] * e)
        flights = sum(2.0 * w / 4.0 for w in closing[1:])
        assert impacts.rows is not None
        if impacts.count[0, 0] != len(closing):
            return Figure(np.nan, 0, f"e = {e}: {impacts.count[0, 0]} impacts instead of {len(closing)}")
        worst = max(worst, abs(float(impacts.rows.time_s[-1]) / flights - 1.0))
    return Figure(worst, BOUNCE_SERIES_EPS * EPS, "95 series of up to 506 impacts")
