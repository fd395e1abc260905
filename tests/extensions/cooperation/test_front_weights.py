"""Weights of the vehicles' harm: the grid, and what is refused."""

import math

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.cooperation.front import corners, search_front, weight_grid


@pytest.mark.parametrize(("vehicles", "steps"), [(2, 7), (4, 3)])
def test_grid__has_every_weight_once_and_neighbours_one_step_apart(vehicles: int, steps: int) -> None:
    rows = np.rint(weight_grid(vehicles, steps) * steps).astype(int)
    assert len(rows) == math.comb(steps + vehicles - 1, vehicles - 1) == len({tuple(row) for row in rows.tolist()})
    assert (rows.sum(axis=1) == steps).all() and (rows >= 0).all()
    assert (np.abs(np.diff(rows, axis=0)).sum(axis=1) == 2).all()


def test_corners__put_one_vehicle_first() -> None:
    assert corners(2).tolist() == [[1.0, 1e-4], [1e-4, 1.0]]


@pytest.mark.parametrize("row", [[1.0, 1.0], [1e7, 1.0, 1.0]])
def test_weights__that_are_none_are_refused(row: list[float]) -> None:
    scenario = eb.load_scenario("paper-random")
    with pytest.raises(InvalidInput, match="weight"):
        search_front(scenario, scenario.sample(1, 7), [[1.0, 0.0, 0.0], row])


@pytest.mark.parametrize(("vehicles", "steps"), [(3, 1_000_000)])
def test_grid__of_too_many_weights_is_refused_at_once(vehicles: int, steps: int) -> None:
    with pytest.raises(InvalidInput, match="give fewer steps"):
        weight_grid(vehicles, steps)
