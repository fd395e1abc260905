"""Networks with a running average of their weights, which the trained policy uses, and their optimiser. F: features."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any

import torch
from numpy.typing import NDArray
from stable_baselines3.common.torch_layers import create_mlp
from torch import Tensor, nn

from ethbrake_marl.motion.layout import Ints
from ethbrake_marl.policies.layers import Float32s
from ethbrake_marl.policies.network import Activation
from ethbrake_marl.training.algorithm import ACTIVATIONS

LAYER_PARTS = ("weight", "bias")


class Adam(torch.optim.Adam):
    """Torch's Adam, with the same bits, without its decorators, which import torch's compiler (1 to 3 CPU-s)."""


for _name in ("step", "add_param_group", "zero_grad", "state_dict", "load_state_dict"):
    setattr(Adam, _name, torch.no_grad()(inspect.unwrap(getattr(torch.optim.Adam, _name))))


def perceptron(inputs: int, outputs: int, hidden: Sequence[int], activation: Activation) -> nn.Sequential:
    return nn.Sequential(*create_mlp(inputs, outputs, list(hidden), ACTIVATIONS[activation]))


def zero_last_layer(network: nn.Sequential) -> nn.Sequential:
    last = linear_layers(network)[-1]
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return network


def linear_layers(network: nn.Sequential) -> list[nn.Linear]:
    return [layer for layer in network if isinstance(layer, nn.Linear)]


class AveragedNetwork(nn.Module):
    """A network in training, ``learning``, and ``average``, a copy whose weights are its running average."""

    def __init__(self, average: nn.Sequential, learning: nn.Sequential, rate: float) -> None:
        super().__init__()
        self.average, self.learning = average, learning
        learning.load_state_dict(average.state_dict())
        self.new_optimizer(rate)

    def new_optimizer(self, rate: float) -> None:
        self.optimizer = Adam(self.learning.parameters(), lr=rate, eps=1e-5)

    def descend(self, loss: Tensor, keep: float) -> Tensor:
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        self.follow(keep)
        return loss.detach()

    @torch.no_grad()
    def follow(self, keep: float) -> None:
        """Set ``average = keep * average + (1 - keep) * learning``."""
        for mean, learns in zip(self.average.parameters(), self.learning.parameters(), strict=True):
            mean.lerp_(learns, 1.0 - keep)

    @torch.no_grad()
    def best(self, observations: Float32s) -> Ints:
        """Index of the largest output of ``average``, [rows], for observations [rows, F]."""
        chosen: Ints = self.average(torch.from_numpy(observations)).argmax(dim=1).numpy()
        return chosen

    def weights(self, name: str) -> dict[str, Tensor]:
        """Weights of ``average`` for a policy file, name of a tensor -> tensor; all names begin with ``name``."""
        linear = linear_layers(self.average)
        places = [f"{name}.{k}" for k in range(len(linear) - 1)] + [f"{name}.output"]
        layers = zip(places, linear, strict=True)
        return {f"{place}.{part}": getattr(layer, part).detach() for place, layer in layers for part in LAYER_PARTS}

    def tensors(self, name: str) -> dict[str, Float32s]:
        return {place: weight.cpu().numpy().copy() for place, weight in self.weights(name).items()}


class ReplayBuffer(nn.Module):
    """Ring buffer of the latest ``size`` decisions of a training; checkpoints save it.

    ``columns``: name -> a zero tensor with the shape and type of one entry.
    """

    known: Tensor  # number of decisions stored so far; a new one replaces the oldest

    def __init__(self, size: int, **columns: Tensor) -> None:
        super().__init__()
        self.size = size
        for name, entry in columns.items():
            self.register_buffer(name, entry.new_zeros((size, *entry.shape)))
        self.register_buffer("known", torch.zeros(1, dtype=torch.int64))

    def store(self, **arrays: NDArray[Any]) -> None:
        m = len(next(iter(arrays.values())))
        places = torch.arange(int(self.known), int(self.known) + m) % self.size
        for name, array in arrays.items():
            self.get_buffer(name)[places] = torch.from_numpy(array)
        self.known += m

    def __len__(self) -> int:
        return min(int(self.known), self.size)


def draw_rows(rows: Ints, count: int) -> Ints:
    """Sample of ``count`` of the ``rows``, without repetition; all of them, in random order, if there are fewer."""
    sample: Ints = rows[torch.randperm(len(rows))[:count].numpy()]
    return sample
