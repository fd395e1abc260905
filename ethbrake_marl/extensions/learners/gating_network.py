"""Gating network of a mixture of experts: at each decision it chooses the expert that acts."""

from __future__ import annotations

import copy

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import Schedule
from torch import Tensor, nn

from ethbrake_marl.extensions.learners.optimizer import adam
from ethbrake_marl.extensions.learners.scout import Scout
from ethbrake_marl.extensions.learners.vine_recipe import VineRecipe
from ethbrake_marl.first_edition.policies.network_spec import Float32s
from ethbrake_marl.first_edition.training.networks import ACTIVATIONS


class AveragedGatingNetwork(nn.Module):
    """Gating network: from an observation of F features it chooses which of K experts acts.

    The network ``learning`` is trained; ``average`` has running averages of the weights of ``learning``, and chooses
    the expert.

    A memory stores the observation, and the extra cost of each expert, for the last M decisions at which the experts
    were compared. The extra cost is the cost minus the cost of the cheapest expert.

    Args:
        inputs: number F of features of an observation.
        rate: learning rate as a function of the share of the training run that remains (1 to 0).
        recipe: recipe with the key ``experts``.

    """

    seen: Tensor  # [M, F] observations in memory
    more: Tensor  # [M, K] extra cost of each expert at these decisions
    compared: Tensor  # [1] number of decisions added to the memory so far; a new decision replaces the oldest

    def __init__(self, inputs: int, rate: Schedule, recipe: VineRecipe) -> None:
        super().__init__()
        plan = recipe.experts
        assert plan is not None
        layers = create_mlp(inputs, plan.networks, list(plan.gating), ACTIVATIONS[recipe.network.activation])
        nn.init.zeros_(layers[-1].weight)  # type: ignore[arg-type]  # until it learns, the first expert acts
        nn.init.zeros_(layers[-1].bias)  # type: ignore[arg-type]
        self.average = nn.Sequential(*layers)
        self.learning = copy.deepcopy(self.average)
        self.scout = Scout(inputs) if recipe.focus > 0.0 else None
        self.optimizer = adam(rate(1.0), self.learning, self.scout)
        self.register_buffer("seen", torch.zeros(plan.gating_memory, inputs))
        self.register_buffer("more", torch.zeros(plan.gating_memory, plan.networks))
        self.register_buffer("compared", torch.zeros(1, dtype=torch.int64))

    def remember(self, seen: Float32s, more: Float32s) -> None:
        """Store m decisions: their observations ``seen`` [m, F], and the experts' extra costs ``more`` [m, K]."""
        places = torch.arange(int(self.compared), int(self.compared) + len(seen)) % len(self.seen)
        self.seen[places], self.more[places] = torch.from_numpy(seen), torch.from_numpy(more)
        self.compared += len(seen)

    def recall(self, count: int) -> tuple[Tensor, Tensor]:
        """Draw ``count`` decisions from the memory; return observations [count, F] and extra costs [count, K]."""
        some = torch.randint(min(int(self.compared), len(self.seen)), (count,))
        return self.seen[some], self.more[some]

    def choose(self, observation: Float32s) -> NDArray[np.int64]:
        """Return the index, [rows], of the expert that ``average`` chooses for each of the observations [rows, F]."""
        with torch.no_grad():
            chosen: NDArray[np.int64] = self.average(torch.from_numpy(observation)).argmax(dim=1).numpy()
        return chosen
