"""Actor of ``vine``: a network in training, and a copy of it with averaged weights, which the trained policy uses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Space, flatdim
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import Tensor, nn

from ethbrake_marl.extensions.learners.optimizer import adam
from ethbrake_marl.extensions.learners.scout import Scout
from ethbrake_marl.extensions.learners.vine_recipe import VineRecipe
from ethbrake_marl.first_edition.physics.state import Floats
from ethbrake_marl.first_edition.policies.network_spec import Float32s, NetworkSpec
from ethbrake_marl.first_edition.training.networks import ACTIVATIONS, sb3_names, tensors_of


class Deterministic(BasePolicy):
    """Base class of policies without exploration noise: actions are the network's outputs, clipped to [-1, 1].

    A subclass must define ``forward``, and either ``means`` or ``act``. If the recipe of ``vine`` has ``focus`` above
    0, the subclass must also define ``expect``. In all methods, ``rows`` is the number of observations, and F the
    number of features of an observation.
    """

    def means(self, observation: Float32s) -> Float32s:
        """Return the outputs [rows] of the network in training, not clipped to [-1, 1], for observations [rows, F]."""
        raise NotImplementedError

    def expect(self, observation: Float32s) -> Floats:
        """Return the predicted absolute gradient, [rows], of the return with respect to the action."""
        raise NotImplementedError

    def act(self, observation: Float32s) -> Float32s:
        """Return the actions [rows], in [-1, 1], for observations [rows, F]."""
        return np.clip(self.means(observation), -1.0, 1.0)

    def tensors(self, network: NetworkSpec) -> dict[str, Float32s]:
        """Return copies of the averaged weights, by name, for a policy bundle whose network is ``network``."""
        return tensors_of(self, network)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> Tensor:
        action: Tensor = self.forward(observation)
        return action


class AveragedActor(Deterministic):
    """Actor with two networks: ``learning`` is trained; ``average`` has running averages of the trained weights.

    A trained policy uses the averaged weights. They have the same names as in PPO of Stable-Baselines3.

    Args:
        observation_space: space of an observation.
        action_space: space of an action.
        rate: learning rate as a function of the share of the training run that remains (1 to 0).
        recipe: recipe of the training run; it also describes the network.

    """

    def __init__(self, observation_space: Space[Any], action_space: Any, rate: Schedule, recipe: VineRecipe) -> None:
        super().__init__(observation_space, action_space)
        inputs, shape = flatdim(observation_space), recipe.network
        hidden, activation = list(shape.policy), ACTIVATIONS[shape.activation]
        self.mlp_extractor = nn.ModuleDict({"policy_net": nn.Sequential(*create_mlp(inputs, -1, hidden, activation))})
        self.action_net = nn.Linear(hidden[-1], 1)
        for layer in self.mlp_extractor.modules():
            if isinstance(layer, nn.Linear):
                nn.init.orthogonal_(layer.weight, math.sqrt(2.0))
                nn.init.zeros_(layer.bias)
        nn.init.orthogonal_(self.action_net.weight, 0.01)
        nn.init.constant_(self.action_net.bias, shape.initial_action or 0.0)
        # a policy bundle needs this parameter; the actor itself never explores
        self.log_std = nn.Parameter(torch.full((1,), -3.0), requires_grad=False)
        last = nn.Linear(hidden[-1], 1)
        self.learning = nn.Sequential(*create_mlp(inputs, -1, hidden, activation), last)
        self.average = [*self.mlp_extractor.parameters(), *self.action_net.parameters()]
        self._spec = shape.spec(inputs)
        self._learn_from_average()
        self.scout = Scout(inputs) if recipe.focus > 0.0 else None
        self.optimizer = adam(rate(1.0), self.learning, self.scout)

    @torch.no_grad()
    def _learn_from_average(self) -> None:
        for mean, learns in zip(self.average, self.learning.parameters(), strict=True):
            learns.copy_(mean)

    def take_over(self, tensors: Mapping[str, Float32s]) -> None:
        """Copy the weights ``tensors`` of a policy bundle into both networks."""
        state = self.state_dict()
        for name, theirs in sb3_names(self._spec).items():
            state[theirs].copy_(torch.from_numpy(tensors[name]))
        self._learn_from_average()

    @torch.no_grad()
    def means(self, observation: Float32s) -> Float32s:
        means: Float32s = self.learning(torch.from_numpy(observation))[:, 0].numpy()
        return means

    def expect(self, observation: Float32s) -> Floats:
        assert self.scout is not None
        return self.scout.expect(observation)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the actions [rows, 1] of the averaged network for observations [rows, F]."""
        means: Tensor = self.action_net(self.mlp_extractor["policy_net"](observation))
        return means.clamp(-1.0, 1.0)
