"""Networks whose trained policy uses a running average of their weights, and what they learn with. F: features."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.torch_layers import create_mlp
from torch import Tensor, nn

from ethbrake_marl.motion.layout import Floats, Ints
from ethbrake_marl.policies.layers import Float32s
from ethbrake_marl.policies.network import Activation
from ethbrake_marl.training.algorithm import ACTIVATIONS

PARTS = ("weight", "bias")
SCOUT_WIDTH = 64  # units of the hidden layer of a scout


class Adam(torch.optim.Adam):
    """Torch's Adam without the decorators of its methods, which import torch's compiler (1 to 3 CPU-s). Same bits."""


for _name in ("step", "add_param_group", "zero_grad", "state_dict", "load_state_dict"):
    setattr(Adam, _name, torch.no_grad()(inspect.unwrap(getattr(torch.optim.Adam, _name))))


def perceptron(inputs: int, outputs: int, hidden: Sequence[int], activation: Activation) -> nn.Sequential:
    """Return a new network."""
    return nn.Sequential(*create_mlp(inputs, outputs, list(hidden), ACTIVATIONS[activation]))


def silent(network: nn.Sequential) -> nn.Sequential:
    """Let all outputs of a new network be 0, and return it."""
    last = linear_layers(network)[-1]
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return network


def linear_layers(network: nn.Sequential) -> list[nn.Linear]:
    """Return the layers that have weights."""
    return [layer for layer in network if isinstance(layer, nn.Linear)]


class Averaged(nn.Module):
    """A network ``learning``, and ``average``, the running average of its weights; perhaps a scout."""

    def __init__(self, average: nn.Sequential, learning: nn.Sequential, rate: float, scout: Scout | None) -> None:
        super().__init__()
        self.average, self.learning, self.scout = average, learning, scout
        learning.load_state_dict(average.state_dict())
        self.new_optimizer(rate)

    def new_optimizer(self, rate: float, *, alone: bool = False) -> None:
        """Begin with a new optimiser. ``alone``: it does not train the scout."""
        weights = [*self.learning.parameters()]
        if self.scout is not None and not alone:
            weights += self.scout.parameters()
        self.optimizer = Adam(weights, lr=rate, eps=1e-5)

    def descend(self, *losses: Tensor) -> None:
        """Make one step of the optimiser on the sum of losses."""
        self.optimizer.zero_grad()
        for loss in losses:
            loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()

    @torch.no_grad()
    def follow(self, keep: float) -> None:
        """Set ``average = keep * average + (1 - keep) * learning``."""
        for mean, learns in zip(self.average.parameters(), self.learning.parameters(), strict=True):
            mean.lerp_(learns, 1.0 - keep)

    @torch.no_grad()
    def best(self, observations: Float32s) -> Ints:
        """Return the output of ``average`` with the highest score for each of the observations [rows, F], [rows]."""
        chosen: Ints = self.average(torch.from_numpy(observations)).argmax(dim=1).numpy()
        return chosen

    def expect(self, observations: Float32s) -> Floats:
        """Return the size that the scout expects of each decision, [rows]."""
        assert self.scout is not None
        return self.scout.expect(observations)

    def weights(self, name: str) -> dict[str, Tensor]:
        """Return the averaged weights: names as in a policy file, which begin with ``name``."""
        linear = linear_layers(self.average)
        places = [f"{name}.{k}" for k in range(len(linear) - 1)] + [f"{name}.output"]
        layers = zip(places, linear, strict=True)
        return {f"{place}.{part}": getattr(layer, part).detach() for place, layer in layers for part in PARTS}

    def tensors(self, name: str) -> dict[str, Float32s]:
        """Return copies of ``weights``."""
        return {place: weight.numpy().copy() for place, weight in self.weights(name).items()}


class Memory(nn.Module):
    """The latest decisions, in buffers, which checkpoints save. ``columns``: name -> zeros of the shape of one entry."""

    known: Tensor  # number of decisions stored so far; a new one replaces the oldest

    def __init__(self, size: int, **columns: Tensor) -> None:
        super().__init__()
        self.size = size
        for name, entry in columns.items():
            self.register_buffer(name, entry.new_zeros((size, *entry.shape)))
        self.register_buffer("known", torch.zeros(1, dtype=torch.int64))

    def store(self, **arrays: NDArray[Any]) -> None:
        """Store m decisions: name of a column -> [m, ...]."""
        m = len(next(iter(arrays.values())))
        places = torch.arange(int(self.known), int(self.known) + m) % self.size
        for name, array in arrays.items():
            self.get_buffer(name)[places] = torch.from_numpy(array)
        self.known += m

    def __len__(self) -> int:
        """Return the number of decisions that can be recalled."""
        return min(int(self.known), self.size)


class Scout(nn.Module):
    """Small network that predicts at which decisions the action matters, so that more branches start there.

    The *size* of a decision is the absolute gradient measured there or, for a mixture of experts, the largest difference
    in cost between experts.
    """

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.layers = silent(perceptron(inputs, 1, [SCOUT_WIDTH], "relu"))  # at first all decisions have the same size

    def forward(self, observations: Tensor) -> Tensor:
        """Return the logarithm of the predicted sizes, [rows], for observations [rows, F]."""
        logarithm: Tensor = self.layers(observations)[:, 0].clamp(max=20.0)
        return logarithm

    @torch.no_grad()
    def expect(self, observations: Float32s) -> Floats:
        """Return the predicted sizes, [rows], above 0."""
        size: Floats = np.exp(self(torch.from_numpy(observations)).numpy().astype(np.float64))
        return size

    def loss(self, observations: Tensor, size: Tensor, importance: Tensor) -> Tensor:
        """Return the loss ``e^l - size l`` of the predicted logarithm l, least at the mean size of such decisions."""
        logarithm = self(observations)
        loss: Tensor = (importance * (logarithm.exp() - size * logarithm)).mean()
        return loss


def draw_rows(expected: Floats, count: int, focus: float) -> tuple[Ints, Float32s]:
    """Draw ``count`` of n decisions with replacement, and return their numbers and their importance, [count] each.

    The share ``focus`` of them is drawn in proportion to the size ``expected`` [n], the others uniformly. The
    importance, which weighs a decision in the loss, is ``1 / (n p)`` with the probability p of drawing it: its mean is
    1, and the mean of the loss stays as it is.
    """
    n = len(expected)
    chance = (1.0 - focus) / n + focus * (expected / expected.sum())
    rows = torch.multinomial(torch.from_numpy(chance), count, replacement=True).numpy()
    return rows, (1.0 / (n * chance[rows])).astype(np.float32)


def choose_rows(
    observed: Float32s, rows: Ints, count: int, focus: float, expect: Callable[[Float32s], Floats]
) -> tuple[Ints, Float32s]:
    """Draw ``count`` of the decisions ``rows``, and return them and their importance.

    ``observed`` [n, F] are the observations at all n decisions; ``expect`` predicts the sizes of decisions. With
    ``focus`` 0 each is drawn at most once, and has the importance 1.
    """
    if focus == 0.0 or len(rows) == 0:
        some = rows[torch.randperm(len(rows))[:count].numpy()]
        return some, np.ones(len(some), np.float32)
    drawn, importance = draw_rows(expect(observed[rows]), count, focus)
    return rows[drawn], importance
