"""Who bears pushes, and which speed contacts have given: against a slow reference that shares no code."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from ethbrake_marl.motion import layout as at
from ethbrake_marl.motion.interval import move_lines
from ethbrake_marl.motion.layout import Floats, scratch_for
from tests.motion.random_lines import Runs, random_runs
from tests.reference.conduct import Bearing, Samples, bearing

STEP_S = 2e-3
FULL_MPS2 = 8.0  # a frequent command of random lines
KINDS = [(2, True, False), (3, False, True), (4, True, False), (5, False, True), (6, True, True)]


def samples(runs: Runs) -> tuple[Floats, Floats]:
    """Times [T + 1], and lines [T + 1, n, LINE_ROWS, N + 1] at these times."""
    line, n, bodies = runs.line.copy(), len(runs.line), runs.line.shape[2]
    times, rows, wanted, scratch = [0.0], [line.copy()], np.zeros((n, bodies)), scratch_for(bodies)
    for start, end, command in zip(runs.times[:-1], runs.times[1:], runs.commands, strict=True):
        wanted[:, 1:] = command
        moments = np.linspace(start, end, int(np.ceil((end - start) / STEP_S)) + 1)
        for one, other in pairwise(moments.tolist()):
            move_lines(line, runs.car, np.full(n, one), np.full(n, other), wanted, scratch)
            times.append(other)
            rows.append(line.copy())
    return np.array(times), np.array(rows)


def expected(times: Floats, rows: Floats, car: Floats) -> Bearing:
    motion = (rows[:, row, 1:] for row in (at.SPEED, at.FORCE))
    pairs = (rows[:, row, :-1] for row in (at.GAP, at.PUSHED, at.IMPACTS))
    return bearing(
        Samples(times, *motion, *pairs, *(car[row, 1:] for row in (at.MASS, at.BRAKING, at.LATENCY, at.LIMIT)))
    )


def compare(seed: int, n: int, kind: tuple[int, bool, bool]) -> tuple[int, float]:
    """Number of lines that differ by more than 0.05 m/s and 2 % of the push; and the sum of all pushes."""
    N, builds_up, obstacle = kind
    runs = random_runs(np.random.default_rng(seed), n, N, builds_up=builds_up, obstacle=obstacle)
    runs.car[:, at.BRAKING, 1:] = FULL_MPS2
    times, rows = samples(runs)
    differ, pushed = 0, 0.0
    for k, end in enumerate(rows[-1]):
        answered, shared, own_speed = expected(times, rows[:, k], runs.car[k])
        own = np.maximum(end[at.SPEED, 1:], 0.0) - end[at.FOREIGN, 1:]
        parts = [answered - end[at.ANSWERED, :-1], shared - end[at.SHARED, :-1], own_speed - own]
        pushed += end[at.PUSHED].sum()
        differ += np.abs(parts).max() > 0.05 + 0.02 * end[at.PUSHED].sum()
        assert end[[at.ANSWERED, at.SHARED]].sum() == pytest.approx(end[at.PUSHED].sum())
        met = (rows[:, k, at.GAP, :-1] <= 0.0).any(axis=0) | (end[at.IMPACTS, :-1] > 0.0)
        alone = ~met & ~np.append(met[1:], False)
        assert not end[[at.ANSWERED, at.SHARED], :-1][:, alone].any()
    return int(differ), float(pushed)


@pytest.mark.parametrize("kind", KINDS)
def test_conduct__is_that_of_samples(kind: tuple[int, bool, bool]) -> None:
    differ, pushed = compare(10, 6, kind)
    assert differ == 0 < pushed


@pytest.mark.nightly
@pytest.mark.parametrize("kind", KINDS)
def test_conduct__of_many_lines_is_that_of_samples(kind: tuple[int, bool, bool]) -> None:
    differ, pushed = compare(1, 70, kind)
    assert differ <= 1 and pushed > 70.0  # two events within one sample differ
