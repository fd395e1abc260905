"""A trained policy as the start of a new training, which may observe more features.

A network can also begin as a policy inside the range of that policy's training and as an observed feature outside.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from ethbrake_marl.agent_names import make_agent
from ethbrake_marl.agents.policy_agent import LearnedAgent
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.policies.layers import Float32s
from ethbrake_marl.policies.network import NetworkSpec
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.policies.training_range import MARGIN

CLOSING = 10.0  # M: a sum of distances (as observed) of 0.1 closes a difference of 1 between policy and feature


def starting_policy(name: str, recipe: str) -> Policy:
    """Policy behind an agent's name such as ``ppo`` or ``policy@runs/mine``.

    ``recipe``: name of the recipe, for error messages. Raises the errors of ``make_agent``, and ``InvalidInput`` for an
    agent that is no policy.
    """
    driver = make_agent(name)
    if not isinstance(driver, LearnedAgent):
        raise InvalidInput(f"recipe {recipe!r}: start: {name}: must name a trained policy, such as ppo or policy@PATH")
    return driver.policy


def start_weights(policy: Policy, network: NetworkSpec, features: Sequence[str], recipe: str) -> dict[str, Float32s]:
    """Weights of ``policy`` for the network ``network``, which observes ``features``.

    ``recipe``: name of the recipe, for error messages. Raises ``InvalidInput`` if the network has other layers than the
    policy, or if ``features`` lack a feature that the policy observes.
    """
    for name in ("policy_hidden", "activation", "output"):
        if getattr(policy.manifest.network, name) != getattr(network, name):
            raise InvalidInput(
                f"recipe {recipe!r}: network.{name} is {getattr(network, name)}, but must be"
                f" {getattr(policy.manifest.network, name)}, as in the policy that the key start names"
            )
    _check_features(policy, features, recipe)
    return widen(policy, features)


def ranged_weights(
    policy: Policy, network: Mapping[str, Float32s], features: Sequence[str], outside: str, recipe: str
) -> dict[str, Float32s]:
    """Weights of a relu network that begins as ``policy`` in the range of its training, and as a feature elsewhere.

    ``network``: random weights of the new network, which observes ``features``; units that are not needed keep them.
    ``outside``: name of the feature. ``recipe``: name of the recipe, for error messages.

    Let u be the policy's output, p the feature, and g the sum of the distances by which the observed features leave the
    range. The network's first layers carry the policy's units, p, -p, and these distances or g. With M = ``CLOSING``
    the last hidden layer and the output are

        max(u - p - M g, 0) - max(p - u - M g, 0) + max(p, 0) - max(-p, 0),

    which is u for g = 0, and p for large g. Raises ``InvalidInput`` if the policy has no range, if ``features`` lack
    one that it observes, or if the network is too small.
    """
    _check_features(policy, features, recipe)
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


def _check_features(policy: Policy, features: Sequence[str], recipe: str) -> None:
    missing = [name for name in policy.observation.names if name not in features]
    if missing:
        raise InvalidInput(
            f"recipe {recipe!r}: the observation lacks the features {', '.join(missing[:5])}, which the policy of the"
            " key start observes; add them to the observation"
        )


def widen(policy: Policy, features: Sequence[str]) -> dict[str, Float32s]:
    """Weights of the policy's actor for observations ``features``; 0 for features that the policy did not observe."""
    tensors = {name: tensor.copy() for name, tensor in policy.tensors.items() if name.startswith("policy.")}
    first = np.zeros((len(tensors["policy.0.weight"]), len(features)), np.float32)
    first[:, [list(features).index(name) for name in policy.observation.names]] = tensors["policy.0.weight"]
    return tensors | {"policy.0.weight": first}
