"""Take over the weights of a trained policy that observes fewer features."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.training.training import Training


def widened(policy: Policy, training: Training) -> dict[str, NDArray[np.float32]]:
    """Return the weights of a trained policy, by name, enlarged to the features that a new training observes.

    The weights of features that the policy does not observe are 0. Raises ``InvalidInput`` if the training lacks a
    feature of the policy, or has another network.
    """
    recipe, wanted = training.recipe, training.recipe.network_spec(training.observation.size)
    network = policy.manifest.network
    if network.networks > 1:
        raise InvalidInput(
            f"recipe {recipe.name!r}: start: this policy is a mixture of {network.networks} networks; give a"
            " policy with one network"
        )
    for name in ("policy_hidden", "activation", "output"):
        if getattr(network, name) != getattr(wanted, name):
            raise InvalidInput(
                f"recipe {recipe.name!r}: network: {name} is {getattr(wanted, name)}, but {getattr(network, name)} in"
                " the policy to start from; they must be the same"
            )
    return padded(policy, training, "start")


def padded(policy: Policy, training: Training, key: str) -> dict[str, NDArray[np.float32]]:
    """Return all weights of a trained policy except the critic's, by name, enlarged to the training's features.

    The weights of features that the policy does not observe are 0. Raises ``InvalidInput`` if the training lacks a
    feature of the policy; ``key`` is the key of the recipe that names the policy, for the message.
    """
    names = [feature.name for feature in training.observation.features]
    known = policy.manifest.observation.features
    missing = [name for name in known if name not in names]
    if missing:
        raise InvalidInput(
            f"recipe {training.recipe.name!r}: observation: lacks {', '.join(missing[:5])}, which the policy of {key}"
            " observes; list all of its features"
        )
    weights = {name: tensor.copy() for name, tensor in policy.tensors.items() if not name.startswith("value.")}
    for name in [name for name in weights if name.endswith(".0.weight")]:
        first = np.zeros((len(weights[name]), len(names)), np.float32)
        first[:, [names.index(feature) for feature in known]] = weights[name]
        weights[name] = first
    return weights
