"""Use the weights of a trained policy at the start of a training that observes these and further features."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.training.training import Training


def widened(policy: Policy, training: Training) -> dict[str, NDArray[np.float32]]:
    """Return the weights of a trained policy by name, with added weights for the further features of a training.

    The added weights are 0. Raises ``InvalidInput`` if the training lacks a feature that the policy observes, or if the
    networks of policy and training differ.
    """
    recipe, wanted = training.recipe, training.recipe.network_spec(training.observation.size)
    network = policy.manifest.network
    if network.networks > 1:
        raise InvalidInput(
            f"recipe {recipe.name!r}: start: this policy is a mixture of {network.networks} networks; name a policy"
            " that has one network"
        )
    for name in ("policy_hidden", "activation", "output"):
        if getattr(network, name) != getattr(wanted, name):
            raise InvalidInput(
                f"recipe {recipe.name!r}: network.{name} is {getattr(wanted, name)}, but must be"
                f" {getattr(network, name)}, as in the policy that the key start names"
            )
    return padded(policy, training, "start")


def padded(policy: Policy, training: Training, key: str) -> dict[str, NDArray[np.float32]]:
    """Return the weights of a trained policy by name, with added weights for the further features of a training.

    The added weights are 0. The weights of the critic are left out. Raises ``InvalidInput`` if the training does not
    observe a feature of the policy.

    Args:
        policy: trained policy.
        training: training that begins with these weights.
        key: key of the recipe under which the policy is named, for the error message.

    """
    names = [feature.name for feature in training.observation.features]
    known = policy.manifest.observation.features
    missing = [name for name in known if name not in names]
    if missing:
        raise InvalidInput(
            f"recipe {training.recipe.name!r}: the observation lacks the features {', '.join(missing[:5])}, which the"
            f" policy of the key {key} observes; add them to the observation"
        )
    weights = {name: tensor.copy() for name, tensor in policy.tensors.items() if not name.startswith("value.")}
    for name in [name for name in weights if name.endswith(".0.weight")]:
        first = np.zeros((len(weights[name]), len(names)), np.float32)
        first[:, [names.index(feature) for feature in known]] = weights[name]
        weights[name] = first
    return weights
