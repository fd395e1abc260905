"""Scout: a small network that predicts at which decisions the action matters, so that more branches start there.

A branch is a copy of the episode with another action. To simulate a branch from a decision at which the action has no
effect is a waste of time. Therefore decisions at which the action matters are drawn with a higher probability, and get
a smaller weight in the loss, so that the expected loss stays the same (importance sampling).

The *size* of a decision is the absolute value of the measured gradient or, for a mixture of experts, the difference in
cost between the experts. F is the number of features of an observation.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from ethbrake_marl.first_edition.physics.state import Floats, Ints
from ethbrake_marl.first_edition.policies.network_spec import Float32s

WIDTH = 64  # units of the hidden layer


class Scout(nn.Module):
    """Network that predicts the size of a decision from an observation with ``inputs`` features."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(inputs, WIDTH), nn.ReLU(), nn.Linear(WIDTH, 1))
        last = self.layers[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)  # the untrained network predicts the same size for all observations
        nn.init.zeros_(last.bias)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the natural logarithm, cut off at 20, of each predicted size, [rows], for observations [rows, F]."""
        logarithm: Tensor = self.layers(observation)[:, 0].clamp(max=20.0)
        return logarithm

    def expect(self, observation: Float32s) -> Floats:
        """Return the predicted size of each decision, [rows], above 0, for observations [rows, F]."""
        with torch.no_grad():
            size: Floats = np.exp(self(torch.from_numpy(observation)).numpy().astype(np.float64))
        return size

    def loss(self, observation: Tensor, size: Tensor, importance: Tensor) -> Tensor:
        """Return a loss that is smallest if the network predicts the mean size of the decisions with an observation.

        Decisions of a large size influence this loss less than they would influence a squared error. ``observation`` is
        [rows, F]; ``size`` [rows] are the measured sizes; ``importance`` [rows] weighs the decisions in the loss.
        """
        logarithm = self(observation)
        loss: Tensor = (importance * (logarithm.exp() - size * logarithm)).mean()
        return loss


def draw_rows(expected: Floats, count: int, focus: float) -> tuple[Ints, Float32s]:
    """Draw ``count`` of n decisions with replacement; decisions of a larger size are drawn more often.

    In the share ``focus`` of the draws, the probability of a decision is proportional to its size ``expected`` [n],
    above 0; the other draws are uniform. Returns the indices of the drawn decisions [count], and their importance
    [count], which is their weight in the loss: ``1 / (n p)``, where p is the probability of drawing the decision. The
    expected value of the importance is 1.
    """
    n = len(expected)
    chance = (1.0 - focus) / n + focus * (expected / expected.sum())
    rows = torch.multinomial(torch.from_numpy(chance), count, replacement=True).numpy()
    return rows, (1.0 / (n * chance[rows])).astype(np.float32)


def choose_rows(
    observed: Float32s, rows: Ints, count: int, focus: float, expect: Callable[[Float32s], Floats] | None
) -> tuple[Ints, Float32s]:
    """Draw ``count`` of the decisions ``rows``, at which several actions will be tried.

    ``observed`` [n, F] are the observations at all decisions; ``rows`` are indices in ``observed``. Decisions are drawn
    as in ``draw_rows``, with the sizes that ``expect`` (such as ``Scout.expect``) predicts from observations. If
    ``focus`` is 0 or ``expect`` is None, they are drawn uniformly and without replacement (all of them, if they are
    fewer than ``count``).

    Returns the indices of the drawn decisions in ``observed``, and the weight of each in the loss (*importance*), which
    is 1 if the decisions are drawn uniformly.
    """
    if focus == 0.0 or expect is None or len(rows) == 0:
        some = rows[torch.randperm(len(rows))[:count].numpy()]
        return some, np.ones(len(some), np.float32)
    drawn, importance = draw_rows(expect(observed[rows]), count, focus)
    return rows[drawn], importance
