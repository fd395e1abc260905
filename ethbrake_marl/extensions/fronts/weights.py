"""Weights of the vehicles' harm: a regular grid of weights, and the check of weights that a user gives."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import comb

import numpy as np

from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.files.yaml import parse_numeral
from ethbrake_marl.physics.state import LEAST_WEIGHT, Floats, checked_numbers

MOST = 1_000  # largest number of choices of weights

STEPS = 5  # default number of steps between the weights 0 and 1: 21 choices of weights for three vehicles

SLIGHT = 1e-4  # weight of the other vehicles in a corner; their harm decides between equal choices


def weight_grid(vehicles: int, steps: int = STEPS) -> Floats:
    """Return W evenly spaced choices of weights, [W, N]. In each choice the weights of the N vehicles sum to 1.

    From each row to the next, the weight of one vehicle rises by 1 / ``steps``, and the weight of another vehicle falls
    by 1 / ``steps``. Raises ``InvalidInput`` if ``steps`` is below 1, or if there would be more than ``MOST`` choices.

    >>> from ethbrake_marl.extensions.fronts.weights import weight_grid
    >>> weight_grid(3, 1).tolist()
    [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    """
    check_whole_number("steps of the weights", steps, 1)
    number = comb(steps + vehicles - 1, steps)
    if number > MOST:
        raise InvalidInput(
            f"steps = {steps}: the grid has {number:,} choices of weights for {vehicles} vehicles, but at most"
            f" {MOST:,} are allowed; give fewer steps, or give the choices of weights yourself"
        )

    def shares(number: int, left: int) -> Iterator[list[int]]:
        if number == 1:
            yield [left]
            return
        for mine in range(left + 1):
            rest = list(shares(number - 1, left - mine))
            for others in rest if mine % 2 == 0 else reversed(rest):
                yield [mine, *others]

    return np.array(list(shares(vehicles, steps))) / steps


def corners(vehicles: int) -> Floats:
    """Return one choice of weights for each of the N vehicles, [N, N], with almost all weight on this vehicle.

    In row i, vehicle i has the weight 1, and the others ``SLIGHT``. Their harm decides only between commands under
    which vehicle i has almost the same harm.
    """
    return np.where(np.eye(vehicles) == 1.0, 1.0, SLIGHT)


def checked_weights(weights: Sequence[Sequence[float]] | Floats, vehicles: int) -> Floats:
    """Check W choices of weights, each with one weight per vehicle, and return them as an array [W, N].

    Raises ``InvalidInput`` if there is no choice, if a choice does not have one weight for each vehicle, if a weight is
    neither 0 nor from 1e-6 to 1e6, or if all weights of a choice are 0.
    """
    rows = [checked_numbers("weights", row) for row in weights]
    for k, row in enumerate(rows):
        good = (row == 0.0) | ((row >= LEAST_WEIGHT) & (row <= 1.0 / LEAST_WEIGHT))
        if row.shape != (vehicles,) or not (good.all() and row.any()):
            text = ",".join(f"{weight:g}" for weight in row.ravel())
            raise InvalidInput(
                f"weights[{k}] = {text}: give one number for each of the {vehicles} vehicles, each 0 or from"
                " 1e-6 to 1e6, and not all 0; for instance 1,4,1"
            )
    if not rows:
        raise InvalidInput("weights: there are no weights; give at least one choice of weights, for instance 1,4,1")
    return np.array(rows)


def parsed_weights(texts: Sequence[str], vehicles: int) -> Floats:
    """Convert W texts such as ``1,4,1``, each with the weights of N vehicles, into an array [W, N].

    Raises ``InvalidInput`` if a text does not consist of numbers with commas between them, and the exceptions of
    ``checked_weights``.
    """
    rows = []
    for text in texts:
        numbers = [parse_numeral(part.strip()) for part in text.split(",")]
        if None in numbers:
            raise InvalidInput(f"weights {text!r}: the weights must be numbers separated by commas, as in 1,4,1")
        rows.append([float(number) for number in numbers if number is not None])
    return checked_weights(rows, vehicles)
