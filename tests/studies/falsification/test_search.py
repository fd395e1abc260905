"""The adaptive search of the unit cube."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Floats
from ethbrake_marl.studies.falsification import APART, Scored, far_apart, search


def _peak(points: Floats) -> Floats:
    return -np.abs(points - 0.7).sum(axis=1)


def test_search__climbs_a_peak_that_random_points_stay_away_from() -> None:
    adaptive, at_random = (search(_peak, 6, 2_000, 3, adaptive=how).scores.max() for how in (True, False))
    assert adaptive > 0.6 * at_random


def test_search__stays_in_the_cube_and_repeats_by_seed() -> None:
    one, same, other = (search(_peak, 2, 700, seed) for seed in (1, 1, 2))
    assert len(one.points) == len(one.scores) == 700
    assert ((one.points >= 0.0) & (one.points < 1.0)).all()
    assert np.array_equal(one.points, same.points)
    assert not np.array_equal(one.points, other.points)


def test_search__finds_several_peaks() -> None:
    centres = np.array([[0.2, 0.2, 0.8], [0.8, 0.3, 0.1], [0.5, 0.9, 0.5]])

    def peaks(points: Floats) -> Floats:
        return -np.linalg.norm(points[:, np.newaxis] - centres, axis=2).min(axis=1)

    found = search(peaks, 3, 3_000, 0)
    best = found.points[far_apart(found, 3)]
    assert (np.linalg.norm(best[:, np.newaxis] - centres, axis=2).min(axis=0) < 0.1).all()


def test_search__spreads_evenly_while_all_points_are_alike() -> None:
    found = search(lambda points: np.zeros(len(points)), 3, 1_024, 0)
    cells = np.unique((found.points * 8).astype(int), axis=0)
    assert len(cells) == 512  # every eighth of every coordinate, twice


def test_far_apart__leaves_out_what_does_not_count() -> None:
    points = np.array([[0.1, 0.1], [0.1, 0.1 + 0.9 * APART], [0.9, 0.9], [0.5, 0.5]])
    found = far_apart(Scored(points, np.array([1.0, 2.0, 0.5, -np.inf])), 9)
    assert found.tolist() == [1, 2]


@pytest.mark.parametrize(("budget", "seed"), [(0, 0), (10, -1)])
def test_search__refuses(budget: int, seed: int) -> None:
    with pytest.raises(InvalidInput):
        search(_peak, 2, budget, seed)
