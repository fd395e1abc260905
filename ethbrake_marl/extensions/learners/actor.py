"""The network that vine trains, and the weights from which it starts. F: observed features."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

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
from ethbrake_marl.policies.training_range import MARGIN
from ethbrake_marl.training.algorithm import ACTIVATIONS, tensors_of

CLOSING = 10.0  # M: a sum of distances (as observed) of 0.1 closes a difference of 1 between policy and feature


class Adam(torch.optim.Adam):
    """Torch's Adam, with the same bits, without its decorators, which import torch's compiler (1 to 3 CPU-s)."""


for _name in ("step", "add_param_group", "zero_grad", "state_dict", "load_state_dict"):
    setattr(Adam, _name, torch.no_grad()(inspect.unwrap(getattr(torch.optim.Adam, _name))))


class Actor(nn.Module):
    """Deterministic policy whose action is the network's output, clipped to [-1, 1].

    ``learning`` is the network in training; ``average``, a copy with the running average of its weights, is the trained
    policy. Raises ``InvalidInput`` if the recipe's keys ``start`` or ``network.initial_action`` do not fit
    ``features``.
    """

    def __init__(self, features: Sequence[str], recipe: VineRecipe) -> None:
        super().__init__()
        shape = recipe.network
        self.average = perceptron(len(features), recipe)
        *hidden, last = linear_layers(self.average)
        for layer in hidden:
            nn.init.orthogonal_(layer.weight, math.sqrt(2.0))
            nn.init.zeros_(layer.bias)
        if isinstance(shape.initial_action, str):
            if shape.initial_action not in features:
                raise InvalidInput(
                    f"recipe {recipe.name!r}: the observation lacks the feature {shape.initial_action}, which"
                    " network.initial_action names; add it to the observation"
                )
            pass_through(hidden, last, features.index(shape.initial_action))
        else:
            nn.init.orthogonal_(last.weight, 0.01)
            nn.init.constant_(last.bias, shape.initial_action or 0.0)
        self.learning = perceptron(len(features), recipe)
        if recipe.start is not None:
            random = tensors_of("policy", self.average)
            tensors = start_weights(starting_policy(recipe), random, features, recipe)
            for name, weight in zip(random, self.average.parameters(), strict=True):
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


@torch.no_grad()
def pass_through(hidden: Sequence[nn.Linear], last: nn.Linear, column: int) -> None:
    """Set weights of a relu network so that its output is exactly the input x in this ``column``.

    The first two units of every hidden layer are max(x, 0) and max(-x, 0), and the output is their difference. The
    other hidden units keep their weights, but have the weight 0 in the output.
    """
    first, *between = hidden
    first.weight[:2] = 0.0
    first.weight[:2, column] = torch.tensor([1.0, -1.0])
    for layer in between:
        layer.weight[:2] = torch.eye(2, layer.in_features)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    last.weight[0, :2] = torch.tensor([1.0, -1.0])


def starting_policy(recipe: VineRecipe) -> Policy:
    """Policy that the recipe's key ``start`` names. Raises the errors of ``make_agent``, and ``InvalidInput``."""
    agent = make_agent(str(recipe.start))
    if not isinstance(agent, LearnedAgent):
        raise InvalidInput(
            f"recipe {recipe.name!r}: start: {recipe.start}: must name a trained policy, such as ppo or policy@PATH"
        )
    return agent.policy


def start_weights(
    policy: Policy, network: Mapping[str, Float32s], features: Sequence[str], recipe: VineRecipe
) -> dict[str, Float32s]:
    """Weights with which a network that observes ``features`` is ``policy``.

    If the recipe's key ``network.initial_action`` names a feature, the network is the policy only in the range of its
    training, and this feature elsewhere (``ranged_weights``). ``network``: random weights. Raises ``InvalidInput`` if
    the network's layers do not fit, or if ``features`` lack a feature that the policy observes.
    """
    spec, outside = recipe.network_spec(len(features)), recipe.network.initial_action
    if not isinstance(outside, str):
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
    if isinstance(outside, str):
        return ranged_weights(policy, network, features, outside, recipe.name)
    return widen(policy, features)


def ranged_weights(
    policy: Policy, network: Mapping[str, Float32s], features: Sequence[str], outside: str, recipe: str
) -> dict[str, Float32s]:
    """Weights of a relu network that is ``policy`` in the range of its training, and the feature ``outside`` elsewhere.

    Units that are not needed keep their weights in ``network``. Let u be the policy's output, p the feature, and g the
    sum of the distances by which the observed features leave the range. The network's first layers carry the policy's
    units, p, -p, and these distances or g. With M = ``CLOSING`` the last hidden layer and the output are

        max(u - p - M g, 0) - max(p - u - M g, 0) + max(p, 0) - max(-p, 0),

    which is u for g = 0, and p for large g. Raises ``InvalidInput`` if the policy has no range, or if the network is
    too small.
    """
    known, spec = policy.manifest.training_range, policy.manifest.network
    if known is None or (spec.activation, spec.output) != ("relu", "clip"):
        right = "must name a relu policy whose bundle has the range of its training"
        raise InvalidInput(f"recipe {recipe!r}: start: {right}, if network.initial_action is a feature")
    widths = spec.policy_hidden
    sizes = [widths[0] + 2 + 2 * len(known.low), *(width + 3 for width in widths[1:]), 4]
    weights = [network[f"policy.{k}.weight"].copy() for k in range(len(network) // 2 - 1)]
    biases = [network[f"policy.{k}.bias"].copy() for k in range(len(weights))]
    if len(weights) != len(sizes) or any(len(bias) < size for bias, size in zip(biases, sizes, strict=True)):
        raise InvalidInput(
            f"recipe {recipe!r}: network.policy must have {len(sizes)} layers with at least"
            f" {', '.join(map(str, sizes))} units, to begin as the policy of the key start and as {outside}"
        )
    old, width = widen(policy, features), widths[0]
    for weight, bias, size in zip(weights, biases, sizes, strict=True):
        weight[:size], bias[:size] = 0.0, 0.0
    weights[0][:width], biases[0][:width] = old["policy.0.weight"], old["policy.0.bias"]
    weights[0][width : width + 2, features.index(outside)] = 1.0, -1.0
    for place, name in enumerate(policy.observation.names):
        above, below = width + 2 + 2 * place, width + 3 + 2 * place
        weights[0][[above, below], features.index(name)] = 1.0, -1.0
        biases[0][[above, below]] = -known.high[place] - MARGIN, known.low[place] - MARGIN
    for k, (before, width) in enumerate(pairwise(widths), 1):
        weights[k][:width, :before], biases[k][:width] = old[f"policy.{k}.weight"], old[f"policy.{k}.bias"]
        weights[k][[width, width + 1], [before, before + 1]] = 1.0
        weights[k][width + 2, before + 2 : sizes[k - 1]] = 1.0
    for unit, sign in ((0, 1.0), (1, -1.0)):
        weights[-1][unit, :width] = sign * old["policy.output.weight"][0]
        weights[-1][unit, [width, width + 1]] = -sign, sign
        weights[-1][unit, width + 2 : sizes[-2]] = -CLOSING
        biases[-1][unit] = sign * old["policy.output.bias"][0]
    weights[-1][[2, 3], [width, width + 1]] = 1.0
    output = np.zeros_like(network["policy.output.weight"])
    output[0, :4] = 1.0, -1.0, 1.0, -1.0
    tensors = {"policy.output.weight": output, "policy.output.bias": np.zeros(1, np.float32)}
    tensors |= {f"policy.{k}.weight": weight for k, weight in enumerate(weights)}
    return tensors | {f"policy.{k}.bias": bias for k, bias in enumerate(biases)}


def widen(policy: Policy, features: Sequence[str]) -> dict[str, Float32s]:
    """Weights of the policy's actor for observations ``features``; 0 for features that the policy did not observe."""
    tensors = {name: tensor.copy() for name, tensor in policy.tensors.items() if name.startswith("policy.")}
    first = np.zeros((len(tensors["policy.0.weight"]), len(features)), np.float32)
    first[:, [list(features).index(name) for name in policy.observation.names]] = tensors["policy.0.weight"]
    return tensors | {"policy.0.weight": first}
