"""Hypervolumes and non-dominated points, by hand and beside a count of small boxes."""

import numpy as np
import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.fronts.hypervolume import hypervolume, nondominated


@pytest.mark.parametrize(
    ("points", "reference", "volume"),
    [
        ([[1.0]], [3.0], 2.0),
        ([[1.0, 2.0], [2.0, 1.0]], [3.0, 3.0], 3.0),
        ([[1.0, 2.0], [2.0, 1.0], [2.0, 2.0], [1.0, 2.0]], [3.0, 3.0], 3.0),  # beaten and equal points add nothing
        ([[0.0, 0.0, 0.0]], [2.0, 3.0, 4.0], 24.0),
        ([[0.0, 1.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 0.0]], [2.0, 2.0, 2.0], 4.0),
        ([[3.0, 0.0], [0.0, 4.0]], [3.0, 3.0], 0.0),  # on the reference, or beyond it
    ],
)
def test_volume__by_hand(points: list[list[float]], reference: list[float], volume: float) -> None:
    assert hypervolume(np.array(points), np.array(reference)) == volume


@pytest.mark.parametrize("dimensions", [2, 3, 4, 5])
def test_volume__of_points_on_a_grid_is_the_number_of_boxes_that_some_point_beats(dimensions: int) -> None:
    rng = np.random.default_rng(dimensions)
    points = rng.integers(0, 6, (7, dimensions)).astype(float)
    boxes = np.stack(np.meshgrid(*dimensions * [np.arange(5)], indexing="ij"), axis=-1).reshape(-1, 1, dimensions)
    assert hypervolume(points, np.full(dimensions, 5.0)) == (points <= boxes).all(axis=2).any(axis=1).sum()


def test_nondominated__equal_points_do_not_beat_each_other() -> None:
    points = np.array([[1.0, 2.0], [1.0, 2.0], [2.0, 2.0], [0.0, 3.0]])
    assert nondominated(points).tolist() == [True, True, False, True]


def test_volume__of_many_vehicles_is_refused() -> None:
    with pytest.raises(InvalidInput, match="the points have 6 coordinates, but at most 5"):
        hypervolume(np.zeros((1, 6)), np.ones(6))


@pytest.mark.parametrize(
    ("points", "reference"), [([[np.nan, 0.0]], [1.0, 1.0]), ([[0.0, 0.0]], [np.inf, 1.0]), ([[0.0]], [1.0, 1.0])]
)
def test_volume__of_what_is_not_finite_or_fits_not_is_refused(points: list, reference: list) -> None:
    with pytest.raises(InvalidInput, match="points must be finite numbers"):
        hypervolume(np.array(points), np.array(reference))
