"""The network that vine trains, and the weights from which it starts. F: observed features."""

from __future__ import annotations

import inspect
import math
from collections.abc import Sequence

import numpy as np
import torch
from stable_baselines3.common.torch_layers import create_mlp
from torch import Tensor, nn

from ethbrake_marl.agent_names import make_agent
from ethbrake_marl.agents.policy_agent import LearnedAgent
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.learners.recipe import VineRecipe
from ethbrake_marl.policies.layers import Float32s
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.training.algorithm import ACTIVATIONS, tensors_of


class Adam(torch.optim.Adam):
    """Torch's Adam, with the same bits, without its decorators, which import torch's compiler (1 to 3 CPU-s)."""


for _name in ("step", "add_param_group", "zero_grad", "state_dict", "load_state_dict"):
    setattr(Adam, _name, torch.no_grad()(inspect.unwrap(getattr(torch.optim.Adam, _name))))


class Actor(nn.Module):
    """Deterministic policy whose action is the network's output, clipped to [-1, 1].

    ``learning`` is the network in training; ``average``, a copy with the running average of its weights, is the trained
    policy. Raises ``InvalidInput`` if the recipe's key ``start`` does not fit ``features``.
    """

    def __init__(self, features: Sequence[str], recipe: VineRecipe) -> None:
        super().__init__()
        self.average = perceptron(len(features), recipe)
        *hidden, last = linear_layers(self.average)
        for layer in hidden:
            nn.init.orthogonal_(layer.weight, math.sqrt(2.0))
            nn.init.zeros_(layer.bias)
        nn.init.orthogonal_(last.weight, 0.01)
        nn.init.constant_(last.bias, recipe.network.initial_action or 0.0)
        self.learning = perceptron(len(features), recipe)
        if recipe.start is not None:
            tensors = start_weights(starting_policy(recipe), features, recipe)
            for name, weight in zip(tensors_of("policy", self.average), self.average.parameters(), strict=True):
                weight.data.copy_(torch.from_numpy(tensors[name]))
        self.learning.load_state_dict(self.average.state_dict())
        self.optimizer = Adam(self.learning.parameters(), lr=recipe.learning_rate.at(1.0), eps=1e-5)

    @torch.no_grad()
    def means(self, observations: Float32s) -> Float32s:
        """Outputs of the network in training, [rows], for observations [rows, F]."""
        means: Float32s = self.learning(torch.from_numpy(observations))[:, 0].numpy()
        return means

    def act(self, observations: Float32s) -> Float32s:
        return np.clip(self.means(observations), -1.0, 1.0)

    def descend(self, loss: Tensor, keep: float) -> Tensor:
        """Take one step of the optimiser, then set ``average = keep * average + (1 - keep) * learning``."""
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        with torch.no_grad():
            for mean, learns in zip(self.average.parameters(), self.learning.parameters(), strict=True):
                mean.lerp_(learns, 1.0 - keep)
        return loss.detach()


def perceptron(inputs: int, recipe: VineRecipe) -> nn.Sequential:
    shape = recipe.network
    return nn.Sequential(*create_mlp(inputs, 1, list(shape.policy), ACTIVATIONS[shape.activation]))


def linear_layers(network: nn.Sequential) -> list[nn.Linear]:
    return [layer for layer in network if isinstance(layer, nn.Linear)]


def starting_policy(recipe: VineRecipe) -> Policy:
    """Policy that the recipe's key ``start`` names. Raises the errors of ``make_agent``, and ``InvalidInput``."""
    agent = make_agent(str(recipe.start))
    if not isinstance(agent, LearnedAgent):
        raise InvalidInput(
            f"recipe {recipe.name!r}: start: {recipe.start}: must name a trained policy, such as ppo or policy@PATH"
        )
    return agent.policy


def start_weights(policy: Policy, features: Sequence[str], recipe: VineRecipe) -> dict[str, Float32s]:
    """Weights with which a network that observes ``features`` is ``policy``.

    Raises ``InvalidInput`` if the network's layers do not fit, or if ``features`` lack a feature that the policy
    observes.
    """
    spec = recipe.network_spec(len(features))
    for name in ("policy_hidden", "activation", "output"):
        if getattr(policy.manifest.network, name) != getattr(spec, name):
            raise InvalidInput(
                f"recipe {recipe.name!r}: network.{name} is {getattr(spec, name)}, but must be"
                f" {getattr(policy.manifest.network, name)}, as in the policy that the key start names"
            )
    missing = [name for name in policy.observation.names if name not in features]
    if missing:
        raise InvalidInput(
            f"recipe {recipe.name!r}: the observation lacks the features {', '.join(missing[:5])}, which the policy of"
            " the key start observes; add them to the observation"
        )
    return widen(policy, features)


def widen(policy: Policy, features: Sequence[str]) -> dict[str, Float32s]:
    """Weights of the policy's actor for observations ``features``; 0 for features that the policy did not observe."""
    tensors = {name: tensor.copy() for name, tensor in policy.tensors.items() if name.startswith("policy.")}
    first = np.zeros((len(tensors["policy.0.weight"]), len(features)), np.float32)
    first[:, [list(features).index(name) for name in policy.observation.names]] = tensors["policy.0.weight"]
    return tensors | {"policy.0.weight": first}
