"""The motion in many worlds: against rational numbers and small steps, and every bit of a batch.

Each kind of worlds (2 to 6 vehicles, with an obstacle or not, with brakes that act at once or build up) has 25 times
``--size`` worlds.
"""

import numpy as np
import pytest

from ethbrake_marl.motion import layout as at
from tests.motion.random_lines import (
    Runs,
    differences,
    exactly,
    played,
    push_differences,
    pushes_off,
    random_runs,
    stepped,
)

CLOSE, CLOSE_STEPS = 1e-7, 1e-3  # relative; a contact with a closing speed near 0 loses half of the digits
CLOSE_PUSHES, PUSHES = 1e-6, 200  # relative; worlds of a kind whose pushes are compared, by finer steps
FEW = 30  # impacts, after which rounding may change their order
UNRESOLVED = 0.04  # largest share of worlds in which two plastic impacts take turns faster than small steps

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.parametrize("N", [2, 3, 4, 5, 6]),
    pytest.mark.parametrize("obstacle", [False, True]),
]


def some(size: int, N: int, obstacle: bool, *, builds_up: bool) -> tuple[Runs, np.ndarray, np.ndarray]:
    """Worlds, their ends, and the number of impacts of each; another order, or fewer, must not change a bit."""
    rng = np.random.default_rng([1, N, obstacle, builds_up])
    runs = random_runs(rng, 25 * size, N, builds_up=builds_up, obstacle=obstacle)
    end, order = played(runs), np.random.default_rng(0).permutation(25 * size)
    for rows in (order, *order[:20, np.newaxis]):
        assert played(runs.take(rows)).tobytes() == end[rows].tobytes()
    return runs, end, end[:, at.IMPACTS, :-1].sum(axis=1)


def test_motion__is_that_of_rational_numbers(size: int, N: int, obstacle: bool) -> None:
    runs, end, impacts = some(size, N, obstacle, builds_up=False)
    rows = np.flatnonzero(impacts <= 2 * FEW)
    exact = np.stack([exactly(runs, k) for k in rows])
    off, pushes = differences(end[rows], exact).max(), push_differences(end[rows], exact).max()
    print(f"{len(rows)} of {len(end)} worlds: off by {off:.1e} at most, pushes by {pushes:.1e}")
    assert max(off, pushes) <= CLOSE and (end[rows, at.IMPACTS] == exact[:, at.IMPACTS]).all()


def test_motion__is_that_of_small_steps_where_brakes_build_up(size: int, N: int, obstacle: bool) -> None:
    runs, end, impacts = some(size, N, obstacle, builds_up=True)
    runs, end = runs.take(impacts <= FEW), end[impacts <= FEW]
    off, step_s = differences(end, stepped(runs, 1e-3)), 1e-3
    while (far := ~(off <= CLOSE_STEPS)).any() and step_s > 2e-5:
        step_s /= 10.0
        off[far] = differences(end[far], stepped(runs.take(far), step_s))
    ends = stepped(runs.take(far), step_s)
    fewer = ends[:, at.IMPACTS, :-1].sum(axis=1) < end[far, at.IMPACTS, :-1].sum(axis=1)
    ends[:, at.TOTAL] = end[far, at.TOTAL]  # small steps miss the last impacts of a series, and nothing else
    pushes, same = pushes_off(runs.take(np.arange(min(PUSHES, len(end)))), CLOSE_PUSHES)
    print(f"{len(end)} worlds: off by {off[~far].max():.1e} at most, {far.sum()} plastic series, {same.sum()} pushes")
    assert far.mean() <= UNRESOLVED and fewer.all() and not (differences(end[far], ends) > CLOSE_STEPS).any()
    assert pushes[same].max() <= CLOSE_PUSHES
