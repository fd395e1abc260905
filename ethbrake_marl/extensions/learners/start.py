"""A trained policy as the start of a new training, which may observe more features."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ethbrake_marl.agents.policy_agent import LearnedAgent
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.names import make_agent
from ethbrake_marl.policies.layers import Float32s
from ethbrake_marl.policies.network import NetworkSpec
from ethbrake_marl.policies.policy import Policy


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
    missing = [name for name in policy.observation.names if name not in features]
    if missing:
        raise InvalidInput(
            f"recipe {recipe!r}: the observation lacks the features {', '.join(missing[:5])}, which the policy of the"
            " key start observes; add them to the observation"
        )
    return widen(policy, features)


def widen(policy: Policy, features: Sequence[str]) -> dict[str, Float32s]:
    """Weights of the policy's actor for observations ``features``; 0 for features that the policy did not observe."""
    tensors = {name: tensor.copy() for name, tensor in policy.tensors.items() if name.startswith("policy.")}
    first = np.zeros((len(tensors["policy.0.weight"]), len(features)), np.float32)
    first[:, [list(features).index(name) for name in policy.observation.names]] = tensors["policy.0.weight"]
    return tensors | {"policy.0.weight": first}
