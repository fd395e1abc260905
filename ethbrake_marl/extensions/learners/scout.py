"""A scout: a small network that learns which decisions matter, so that most branches are spent on those.

A branch costs the same at every decision, but its gradient is 0 where the action changes nothing. So decisions are
drawn with unequal probabilities. Decisions that are drawn more often get a smaller weight, so the expectation is the
same (importance sampling).
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
    """Small network that predicts from an observation how much the choice of the action matters there.

    It learns the size of the measured gradient, or cost difference. ``inputs`` is the number of features.
    """

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(inputs, WIDTH), nn.ReLU(), nn.Linear(WIDTH, 1))
        last = self.layers[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)  # until it learns, its prediction is the same everywhere
        nn.init.zeros_(last.bias)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the logarithm of the expected gradient size, [rows], for observations [rows, F]; at most 20."""
        logarithm: Tensor = self.layers(observation)[:, 0].clamp(max=20.0)
        return logarithm

    def expect(self, observation: Float32s) -> Floats:
        """Return the expected size [rows], above 0, for observations [rows, F]."""
        with torch.no_grad():
            size: Floats = np.exp(self(torch.from_numpy(observation)).numpy().astype(np.float64))
        return size

    def loss(self, observation: Tensor, size: Tensor, importance: Tensor) -> Tensor:
        """Return a loss whose minimum is reached by predicting the mean size.

        Large sizes weigh less than in a squared error.

        Args:
            observation: [rows, F] observations.
            size: [rows] measured sizes.
            importance: [rows] factor of each row.

        """
        logarithm = self(observation)
        loss: Tensor = (importance * (logarithm.exp() - size * logarithm)).mean()
        return loss


def draw_rows(expected: Floats, count: int, focus: float) -> tuple[Ints, Float32s]:
    """Draw ``count`` of n rows with replacement, preferring rows with a large expected size.

    The share ``focus`` is drawn in proportion to ``expected`` [n] > 0, the rest uniformly. Returns the rows and their
    importance, 1 / (probability of the row x number of rows), which is 1 on average.
    """
    n = len(expected)
    chance = (1.0 - focus) / n + focus * (expected / expected.sum())
    rows = torch.multinomial(torch.from_numpy(chance), count, replacement=True).numpy()
    return rows, (1.0 / (n * chance[rows])).astype(np.float32)


def choose_rows(
    observed: Float32s, rows: Ints, count: int, focus: float, expect: Callable[[Float32s], Floats] | None
) -> tuple[Ints, Float32s]:
    """Draw ``count`` of ``rows`` at which to try actions, preferring decisions that matter.

    Args:
        observed: [n, F] observations of all decisions.
        rows: row numbers of the decisions to draw from.
        count: number of rows to draw.
        focus: share drawn in proportion to ``expect`` with replacement (``draw_rows``). 0: all are drawn uniformly
            without replacement.
        expect: function from observations to the expected size of the difference, [rows]; None: all are drawn
            uniformly.

    Returns the drawn rows and their importance (1 if drawn uniformly).

    """
    if focus == 0.0 or expect is None or len(rows) == 0:
        some = rows[torch.randperm(len(rows))[:count].numpy()]
        return some, np.ones(len(some), np.float32)
    drawn, importance = draw_rows(expect(observed[rows]), count, focus)
    return rows[drawn], importance
