"""Scout: a small network that predicts at which decisions the action matters. More branches start at such decisions.

A branch (a copy of the episode with another action) takes as much time if the action has no effect as if it has a large
effect. Therefore decisions at which the action matters are drawn with a higher probability. A decision with a higher
probability gets a smaller weight in the loss, so the expected loss stays the same (importance sampling).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from ethbrake_marl.physics.state import Floats, Ints
from ethbrake_marl.policies.network_spec import Float32s

WIDTH = 64  # units of the hidden layer


class Scout(nn.Module):
    """Small network that predicts from an observation how much the action at a decision matters.

    The network learns to predict the *size* of a decision: the absolute value of the measured gradient, or the measured
    difference in cost. ``inputs`` is the number F of features of an observation.
    """

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(inputs, WIDTH), nn.ReLU(), nn.Linear(WIDTH, 1))
        last = self.layers[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)  # the untrained network predicts the same size for all observations
        nn.init.zeros_(last.bias)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the logarithm of the expected size, at most 20, for observations [rows, F]. The shape is [rows]."""
        logarithm: Tensor = self.layers(observation)[:, 0].clamp(max=20.0)
        return logarithm

    def expect(self, observation: Float32s) -> Floats:
        """Return the expected size [rows], above 0, for observations [rows, F]."""
        with torch.no_grad():
            size: Floats = np.exp(self(torch.from_numpy(observation)).numpy().astype(np.float64))
        return size

    def loss(self, observation: Tensor, size: Tensor, importance: Tensor) -> Tensor:
        """Return a loss that is least if the network predicts the mean size.

        Large sizes influence this loss less than they would influence a squared error.

        Args:
            observation: [rows, F] observations.
            size: [rows] measured sizes.
            importance: [rows] factor of each row in the loss.

        """
        logarithm = self(observation)
        loss: Tensor = (importance * (logarithm.exp() - size * logarithm)).mean()
        return loss


def draw_rows(expected: Floats, count: int, focus: float) -> tuple[Ints, Float32s]:
    """Draw ``count`` of n rows with replacement; a row with a large expected size is drawn more often.

    Args:
        expected: [n] expected size of each row, above 0.
        count: number of rows to draw.
        focus: share of the rows that is drawn in proportion to ``expected``; the rest is drawn uniformly.

    Returns the numbers of the drawn rows [count], and their importance [count]: ``1 / (n p)``, where p is the
    probability with which the row is drawn. The expected importance is 1.

    """
    n = len(expected)
    chance = (1.0 - focus) / n + focus * (expected / expected.sum())
    rows = torch.multinomial(torch.from_numpy(chance), count, replacement=True).numpy()
    return rows, (1.0 / (n * chance[rows])).astype(np.float32)


def choose_rows(
    observed: Float32s, rows: Ints, count: int, focus: float, expect: Callable[[Float32s], Floats] | None
) -> tuple[Ints, Float32s]:
    """Draw ``count`` of the decisions ``rows``, at which actions will be tried.

    Decisions that matter are drawn more often.

    Args:
        observed: [n, F] observations at all decisions.
        rows: row numbers of the decisions to draw from.
        count: number of decisions to draw.
        focus: share of the decisions that are drawn in proportion to ``expect``, with replacement (see ``draw_rows``).
            0: all decisions are drawn uniformly and without replacement.
        expect: function from observations [rows, F] to expected sizes [rows]; None: decisions are drawn as for
            ``focus`` = 0.

    Returns the row numbers of the drawn decisions, and the importance of each: its weight in the loss, 1 if the
    decisions are drawn uniformly.

    """
    if focus == 0.0 or expect is None or len(rows) == 0:
        some = rows[torch.randperm(len(rows))[:count].numpy()]
        return some, np.ones(len(some), np.float32)
    drawn, importance = draw_rows(expect(observed[rows]), count, focus)
    return rows[drawn], importance
