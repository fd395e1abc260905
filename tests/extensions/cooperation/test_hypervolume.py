"""Hypervolumes by hand and beside a count of small boxes."""

import numpy as np
import pytest

from ethbrake_marl.extensions.cooperation.front_results import hypervolume


@pytest.mark.parametrize(
    ("points", "reference", "volume"),
    [
        ([[1.0, 2.0], [2.0, 1.0]], [3.0, 3.0], 3.0),
        ([[1.0, 2.0], [2.0, 1.0], [2.0, 2.0], [1.0, 2.0]], [3.0, 3.0], 3.0),  # beaten and equal points add nothing
        ([[0.0, 1.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 0.0]], [2.0, 2.0, 2.0], 4.0),
        ([[3.0, 0.0], [0.0, 4.0]], [3.0, 3.0], 0.0),  # on the reference, or beyond it
    ],
)
def test_volume__by_hand(points: list[list[float]], reference: list[float], volume: float) -> None:
    assert hypervolume(np.array(points), np.array(reference)) == volume


@pytest.mark.parametrize("dimensions", [2, 5])
def test_volume__of_points_on_a_grid_is_the_number_of_boxes_that_some_point_beats(dimensions: int) -> None:
    rng = np.random.default_rng(dimensions)
    points = rng.integers(0, 6, (7, dimensions)).astype(float)
    boxes = np.stack(np.meshgrid(*dimensions * [np.arange(5)], indexing="ij"), axis=-1).reshape(-1, 1, dimensions)
    assert hypervolume(points, np.full(dimensions, 5.0)) == (points <= boxes).all(axis=2).any(axis=1).sum()
