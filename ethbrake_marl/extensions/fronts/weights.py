"""Choices of weights for the vehicles' harm: a regular grid, and weights that put one vehicle first."""

from __future__ import annotations

from collections.abc import Sequence
from math import comb
from typing import Any

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.motion.layout import Floats

MOST = 1_000  # largest number of choices of weights

SLIGHT = 1e-4  # weight of the other vehicles in a corner; their harm decides between equal choices


def weight_grid(vehicles: int, steps: int) -> Floats:
    """Return W evenly spaced choices of weights, [W, N]. The weights of each choice sum to 1.

    From each row to the next, one weight rises by 1 / ``steps``, and another falls by as much. Raises ``InvalidInput``
    for more than ``MOST`` choices.

    >>> from ethbrake_marl.extensions.fronts.weights import weight_grid
    >>> weight_grid(3, 1).tolist()
    [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    """
    number = comb(steps + vehicles - 1, steps)
    if number > MOST:
        raise InvalidInput(
            f"steps = {steps}: the grid has {number:,} choices of weights for {vehicles} vehicles, but at most"
            f" {MOST:,} are allowed; give fewer steps, or give the choices of weights yourself"
        )
    return np.array(_divisions(vehicles, steps)) / steps


def _divisions(vehicles: int, steps: int) -> list[list[int]]:
    """Return all ways to divide ``steps`` parts among the vehicles; from one way to the next, one part moves."""
    if vehicles == 1:
        return [[steps]]
    divisions: list[list[int]] = []
    for first in range(steps + 1):
        others = _divisions(vehicles - 1, steps - first)
        divisions += [[first, *rest] for rest in others[:: -1 if first % 2 else 1]]
    return divisions


def corners(vehicles: int) -> Floats:
    """Return a choice of weights for each vehicle, [N, N]: 1 for this vehicle, ``SLIGHT`` for the others.

    The others' harm decides only between commands under which this vehicle has almost the same harm.
    """
    return np.where(np.eye(vehicles) == 1.0, 1.0, SLIGHT)


def weight_table(rows: Sequence[Sequence[Any]]) -> Floats:
    """Return choices of weights as an array, [W, N]. Raises ``InvalidInput`` for unequal rows and what is no number."""
    numbers = all(isinstance(each, int | float) and not isinstance(each, bool) for row in rows for each in row)
    if not numbers or len({len(row) for row in rows}) != 1:
        shown = "; ".join(",".join(map(str, row)) for row in rows)
        raise InvalidInput(f"weights {shown:.80}: must be numbers, the same count in each choice, for instance 1,4,1")
    return np.array(rows, np.float64)
