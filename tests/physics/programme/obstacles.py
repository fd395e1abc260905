"""Gates on an obstacle ahead of Vehicle 1: the law of clusters, whole runs, and nothing where it is far away."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from functools import cache

import numpy as np

from ethbrake_marl.physics import Floats, Worlds, advance
from tests.physics.exact_simulator import line_of, simulate
from tests.physics.programme.gates import Figure, gate
from tests.physics.random_worlds import HORIZON_S, driving_lines, place_ahead, state_bytes, touching_lines
from tests.physics.test_oracles import law_error_eps
from tests.reference.tolerances import CLUSTER_EPS, EXACT_RUN


@gate("obstacle: cluster law [eps of the largest speed, per round]")
def clusters() -> Figure:
    """Speeds after simultaneous impacts of vehicles that touch each other and the obstacle, against the exact law."""
    worst, worlds = 0.0, 0
    for N, n in {2: 1_500, 3: 1_500, 5: 800, 10: 200, 20: 80, 50: 15}.items():
        for ratio in (1.0, 1e3):
            batch = touching_lines(182, n, N, heaviest_ratio=ratio)
            before = replace(batch.worlds, obstacle_gap_m=np.zeros(n))
            after, impacts = advance(before, batch.command, 0.0)
            rounds = np.maximum(np.maximum(impacts.count.max(axis=1), impacts.obstacle_count), 1)
            worst = max(worst, *(law_error_eps(before, after, k, int(rounds[k])) for k in range(n)))
            worlds += n
    return Figure(worst, CLUSTER_EPS, f"{worlds:,} clusters of 2 to 50 vehicles")


CASCADE = 100  # impacts of a world; between an obstacle and a line they come ever faster, and rounding multiplies
OTHER_CASCADES = 1e-3  # share of worlds in which it may change the order of impacts after so many


def run_difference(end: Worlds, found: Floats, k: int, line: Worlds, command: list[float]) -> float:
    """Largest difference of world k from the exact run; infinite if the impacts are others, NaN if after a cascade.

    ``found`` [impacts, 3]: pair, time, closing speed.
    """
    exact = simulate(line_of(line, command, k), Fraction(HORIZON_S), bits=160)
    pairs, true_pairs = found[:, 0].tolist(), [hit.pair for hit in exact.hits]
    if pairs != true_pairs:
        return np.nan if pairs[:CASCADE] == true_pairs[:CASCADE] else np.inf
    assert exact.obstacle is not None
    mine = [*end.gaps_m[k], *end.speeds_mps[k], end.obstacle_gap_m[k], *found[:, 1:].ravel()]
    truth = [*exact.gaps, *exact.speeds, exact.obstacle, *(x for hit in exact.hits for x in (hit.time, hit.closing))]
    return max(abs(float(x) - float(y)) for x, y in zip(mine, truth, strict=True))


@cache
def differences() -> tuple[Floats, int]:
    """``run_difference`` of every world, and how many impacts with the obstacle there were."""
    worst, with_it = [], 0
    for N, n in {2: 1_500, 3: 1_000, 5: 300, 10: 40}.items():
        batch = place_ahead(driving_lines(183, n, N), 184)
        end, impacts = advance(batch.worlds, batch.command, HORIZON_S, record=True)
        rows = impacts.rows
        assert rows is not None
        columns = np.stack([rows.pair, rows.time_s, rows.closing_speed_mps], axis=1)
        for k in range(n):
            command = batch.command[k].tolist()
            worst.append(run_difference(end, columns[rows.world == k], k, batch.worlds, command))
        with_it += int(impacts.obstacle_count.sum())
    return np.array(worst), with_it


@gate("obstacle: difference from exact runs [m, m/s, s]")
def exact_runs() -> Figure:
    """The impacts of every pair and with the obstacle, in order, their times and closing speeds, final state."""
    found, with_it = differences()
    of = f"{np.isfinite(found).sum():,} worlds of 2 to 10 vehicles, {with_it:,} impacts with the obstacle"
    return Figure(float(np.nanmax(found)), EXACT_RUN, of)


@gate("obstacle: worlds that differ after 100 impacts [share]")
def cascades() -> Figure:
    """Worlds in which rounding changes the order of impacts, after so many of them and never before."""
    found, _ = differences()
    return Figure(float(np.isnan(found).mean()), OTHER_CASCADES, f"{found.size:,} worlds of 2 to 10 vehicles")


@gate("obstacle out of reach: worlds with other bits")
def out_of_reach() -> Figure:
    """The same lines without an obstacle, and with one that they never reach."""
    n, changed = 20_000, 0
    for N in (2, 3, 5):
        worlds, command = driving_lines(185, n, N)
        plain, harm = advance(worlds, command, until_s=HORIZON_S)
        far, same = advance(replace(worlds, obstacle_gap_m=np.full(n, 1e4)), command, until_s=HORIZON_S)
        changed += state_bytes(replace(far, obstacle_gap_m=plain.obstacle_gap_m), same) != state_bytes(plain, harm)
    return Figure(changed, 0, f"{3 * n:,} worlds of 2, 3 and 5 vehicles")
