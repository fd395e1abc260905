"""Use the weights of a trained policy at the start of a training run that observes further features."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.policies.policy import Policy
from ethbrake_marl.first_edition.training.training import Training


def widened(policy: Policy, training: Training) -> dict[str, NDArray[np.float32]]:
    """Return the weights of ``policy`` as initial weights of a training run that may observe more features.

    The weights for features that the policy does not observe are 0. Raises ``InvalidInput`` if the training run does
    not observe a feature of the policy, if the policy is a mixture of experts, or if the networks of the policy and of
    the training run differ in layers or output.
    """
    recipe, wanted = training.recipe, training.recipe.network_spec(training.observation.size)
    network = policy.manifest.network
    if network.networks > 1:
        raise InvalidInput(
            f"recipe {recipe.name!r}: start: the policy that this key names is a mixture of {network.networks}"
            " networks; name a policy that has one network"
        )
    for name in ("policy_hidden", "activation", "output"):
        if getattr(network, name) != getattr(wanted, name):
            raise InvalidInput(
                f"recipe {recipe.name!r}: network.{name} is {getattr(wanted, name)}, but must be"
                f" {getattr(network, name)}, as in the policy that the key start names"
            )
    return padded(policy, training, "start")


def padded(policy: Policy, training: Training, key: str) -> dict[str, NDArray[np.float32]]:
    """Return the weights of ``policy``, without its critic, for a training run that may observe more features.

    The weights for features that the policy does not observe are 0. Raises ``InvalidInput`` if the training run does
    not observe a feature of the policy; the message quotes ``key``, the recipe's key that names the policy.
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
