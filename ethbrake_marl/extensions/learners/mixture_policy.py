"""Policy of several actors (experts) and a gating network, which chooses one of the actors at each decision."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Space, flatdim
from numpy.typing import NDArray
from stable_baselines3.common.type_aliases import Schedule
from torch import Tensor, nn

from ethbrake_marl.extensions.learners.averaged_actor import AveragedActor, Deterministic
from ethbrake_marl.extensions.learners.gating_network import AveragedGatingNetwork
from ethbrake_marl.extensions.learners.vine_recipe import VineRecipe
from ethbrake_marl.first_edition.physics.state import Floats
from ethbrake_marl.first_edition.policies.network_spec import Float32s, NetworkSpec
from ethbrake_marl.first_edition.training.networks import tensors_of_layers


class ExpertsPolicy(Deterministic):
    """Mixture of experts: at each decision a gating network chooses which of several actors acts.

    Args:
        observation_space: space of an observation.
        action_space: space of an action.
        rate: learning rate as a function of the share of the training run that remains (1 to 0).
        recipe: recipe with the key ``experts``.

    """

    def __init__(self, observation_space: Space[Any], action_space: Any, rate: Schedule, recipe: VineRecipe) -> None:
        super().__init__(observation_space, action_space)
        assert recipe.experts is not None
        networks = range(recipe.experts.networks)
        self.actors = [AveragedActor(observation_space, action_space, rate, recipe) for _ in networks]
        self.members = nn.ModuleList(self.actors)
        self.gate = AveragedGatingNetwork(flatdim(observation_space), rate, recipe)

    def _chosen(self, observation: Float32s, ask: Callable[[AveragedActor, Float32s], NDArray[Any]]) -> Floats:
        """Return one number for each of the observations [rows, F], computed by the chosen actor.

        ``ask`` computes an actor's numbers from observations, such as ``AveragedActor.means``.
        """
        chosen, values = self.gate.choose(observation), np.empty(len(observation))
        for number, actor in enumerate(self.actors):
            rows = np.flatnonzero(chosen == number)
            values[rows] = ask(actor, observation[rows])
        return values

    def means(self, observation: Float32s) -> Float32s:
        return self._chosen(observation, AveragedActor.means).astype(np.float32)  # lossless: the means are float32

    def expect(self, observation: Float32s) -> Floats:
        return self._chosen(observation, AveragedActor.expect)

    def tensors(self, network: NetworkSpec) -> dict[str, Float32s]:
        tensors = tensors_of_layers("gate", self.gate.average)
        for name, actor in zip(network.actors, self.actors, strict=True):
            tensors |= tensors_of_layers(
                name, nn.Sequential(*actor.mlp_extractor["policy_net"].children(), actor.action_net)
            )
        return tensors

    def forward(self, observation: Tensor) -> Tensor:
        """Return the actions [rows, 1] that the averaged networks choose for observations [rows, F]."""
        chosen = self.gate.average(observation).argmax(dim=1, keepdim=True)
        return torch.cat([actor(observation) for actor in self.actors], dim=1).gather(1, chosen)
