"""The gate between several networks: what it has learned, the average that decides, and what it remembers."""

from __future__ import annotations

import copy

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import Schedule
from torch import Tensor, nn

from ethbrake_marl.learning.algorithms.modes import ModesPlan
from ethbrake_marl.learning.algorithms.networks import ACTIVATIONS, Adam
from ethbrake_marl.learning.algorithms.scout import Scout
from ethbrake_marl.learning.recipe import ActorShape
from ethbrake_marl.physics import Floats
from ethbrake_marl.policies.actor import Float32s


class AveragedGate(nn.Module):
    """A gate that learns (``learning``), and the running average of its weights (``average``), which decides.

    It remembers the last decisions at which networks were compared: what was seen, and how much more than the best one
    each of them costs.
    """

    seen: Tensor  # [M, F]
    more: Tensor  # [M, K]
    compared: Tensor  # [1] so far; the newest take the places of the oldest

    def __init__(self, inputs: int, plan: ModesPlan, shape: ActorShape, rate: Schedule, focus: float = 0.0) -> None:
        super().__init__()
        networks = plan.networks
        layers = create_mlp(inputs, networks, list(plan.gate), ACTIVATIONS[shape.activation])
        nn.init.zeros_(layers[-1].weight)  # type: ignore[arg-type]  # until it learns, the first network acts
        nn.init.zeros_(layers[-1].bias)  # type: ignore[arg-type]
        self.average = nn.Sequential(*layers)
        self.learning = copy.deepcopy(self.average)
        self.scout = Scout(inputs) if focus > 0.0 else None
        learned = [*self.learning.parameters(), *(self.scout.parameters() if self.scout is not None else ())]
        self.optimizer = Adam(learned, lr=rate(1.0), eps=1e-5)
        self.register_buffer("seen", torch.zeros(plan.gate_memory, inputs))
        self.register_buffer("more", torch.zeros(plan.gate_memory, networks))
        self.register_buffer("compared", torch.zeros(1, dtype=torch.int64))

    def remember(self, seen: Float32s, more: Float32s) -> None:
        """Keep compared decisions."""
        M, before = len(self.seen), int(self.compared)
        places = torch.arange(before, before + len(seen)) % M
        self.seen[places], self.more[places] = torch.from_numpy(seen), torch.from_numpy(more)
        self.compared += len(seen)

    def recall(self, count: int) -> tuple[Tensor, Tensor]:
        """Some of the kept ones, [count, F] and [count, K]."""
        some = torch.randint(min(int(self.compared), len(self.seen)), (count,))
        return self.seen[some], self.more[some]

    def choose(self, observation: Float32s) -> NDArray[np.int64]:
        """Which network acts on each of the observations [rows, F], [rows]."""
        with torch.no_grad():
            chosen: NDArray[np.int64] = self.average(torch.from_numpy(observation)).argmax(dim=1).numpy()
        return chosen

    def expect(self, observation: Float32s) -> Floats:
        """How much its scout expects to depend on the choice, [rows]."""
        assert self.scout is not None
        return self.scout.expect(observation)

    def follow(self, keep: float) -> None:
        """Move the average towards the weights that learn, keeping this share of what it was."""
        with torch.no_grad():
            for mean, learns in zip(self.average.parameters(), self.learning.parameters(), strict=True):
                mean.lerp_(learns, 1.0 - keep)
