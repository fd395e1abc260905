"""A scout: it learns at which decisions a difference is to be expected, so that most are tried where there is one.

Where nothing depends on what is done, a counterfactual says 0 and costs as much as any other. Decisions are drawn
with unequal chances, and each counts the less, the likelier it was drawn: what is learned is the same on average.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from ethbrake_marl.physics.state import Floats, Ints
from ethbrake_marl.policies.network_spec import Float32s

WIDTH = 64  # of its hidden layer


class Scout(nn.Module):
    """A small network for the size of the difference that is to be expected of an observation."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(inputs, WIDTH), nn.ReLU(), nn.Linear(WIDTH, 1))
        last = self.layers[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)  # until it learns, it expects the same everywhere
        nn.init.zeros_(last.bias)

    def forward(self, observation: Tensor) -> Tensor:
        """The logarithm of what is to be expected [rows] of observations [rows, F]; at most 20."""
        found: Tensor = self.layers(observation)[:, 0].clamp(max=20.0)
        return found

    def expect(self, observation: Float32s) -> Floats:
        """What is to be expected [rows], above 0."""
        with torch.no_grad():
            found: Floats = np.exp(self(torch.from_numpy(observation)).numpy().astype(np.float64))
        return found

    def loss(self, observation: Tensor, size: Tensor, importance: Tensor) -> Tensor:
        """Least where it expects the mean size; of sizes [rows] >= 0, whose largest do not rule it as in a square."""
        logarithm = self(observation)
        found: Tensor = (importance * (logarithm.exp() - size * logarithm)).mean()
        return found


def draw_rows(expected: Floats, count: int, focus: float) -> tuple[Ints, Float32s]:
    """Draw ``count`` of the rows: the share ``focus`` in proportion to ``expected`` [n] > 0, the others evenly.

    A row stands several times where a difference is expected. Each counts 1 / (chance of the row x number of rows),
    whose mean is 1 on average.
    """
    n = len(expected)
    chance = (1.0 - focus) / n + focus * (expected / expected.sum())
    rows = torch.multinomial(torch.from_numpy(chance), count, replacement=True).numpy()
    return rows, (1.0 / (n * chance[rows])).astype(np.float32)


def choose_rows(
    observed: Float32s, rows: Ints, count: int, focus: float, expect: Callable[[Float32s], Floats] | None
) -> tuple[Ints, Float32s]:
    """Draw ``count`` of ``rows``: evenly and each once, or mostly where ``expect`` says that there is a difference."""
    if focus == 0.0 or expect is None or len(rows) == 0:
        some = rows[torch.randperm(len(rows))[:count].numpy()]
        return some, np.ones(len(some), np.float32)
    drawn, importance = draw_rows(expect(observed[rows]), count, focus)
    return rows[drawn], importance
