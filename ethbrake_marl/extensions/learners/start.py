"""Trained policies in a new training, which may observe more features: as its start, or as choices."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ethbrake_marl.agents.policy_agent import LearnedAgent
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.names import make_agent
from ethbrake_marl.policies.layers import Float32s
from ethbrake_marl.policies.network import NetworkSpec
from ethbrake_marl.policies.policy import Policy


class Member(NamedTuple):
    network: NetworkSpec
    tensors: dict[str, Float32s]
    features: tuple[str, ...]  # that it observes


def members_of(policy: Policy) -> list[Member]:
    """Return the policies among which ``policy`` chooses; if it does not choose, only itself."""
    features, network = tuple(policy.observation.names), policy.manifest.network
    parts = {f"among_{m}.": member for m, member in enumerate(network.among, 1)} or {"": network}
    return [
        Member(
            member,
            {
                name.removeprefix(prefix): tensor
                for name, tensor in policy.tensors.items()
                if name.startswith(prefix) and not name.startswith("value.")
            },
            features,
        )
        for prefix, member in parts.items()
    ]


def named_policy(name: str, recipe: str, key: str) -> Policy:
    """Return the policy of an agent's name such as ``ppo`` or ``policy@runs/mine``.

    ``recipe`` and its ``key`` are for error messages. Raises the errors of ``make_agent``, and ``InvalidInput`` for an
    agent that is no policy.
    """
    driver = make_agent(name)
    if not isinstance(driver, LearnedAgent):
        raise InvalidInput(f"recipe {recipe!r}: {key}: {name}: must name a trained policy, such as ppo or policy@PATH")
    return driver.policy


def start_weights(policy: Policy, wanted: NetworkSpec, features: Sequence[str], recipe: str) -> dict[str, Float32s]:
    """Return the weights of ``policy`` for a network ``wanted`` that observes ``features``.

    Raises ``InvalidInput`` for a mixture of experts, for other layers, and for a feature that is not observed.
    """
    network = policy.manifest.network
    if network.networks > 1:
        raise InvalidInput(
            f"recipe {recipe!r}: start: the policy that this key names is a mixture of {network.networks} networks;"
            " name a policy that has one network"
        )
    for name in ("policy_hidden", "activation", "output"):
        if getattr(network, name) != getattr(wanted, name):
            raise InvalidInput(
                f"recipe {recipe!r}: network.{name} is {getattr(wanted, name)}, but must be {getattr(network, name)},"
                " as in the policy that the key start names"
            )
    return widened(members_of(policy)[0], features, recipe, "start")


def widened(member: Member, features: Sequence[str], recipe: str, key: str) -> dict[str, Float32s]:
    """Return a policy's weights for observations ``features``, with weight 0 for those that it did not know.

    Raises ``InvalidInput`` if ``features`` lack one that the policy needs.
    """
    missing = [name for name in member.features if name not in features]
    if missing:
        raise InvalidInput(
            f"recipe {recipe!r}: the observation lacks the features {', '.join(missing[:5])}, which the policy of the"
            f" key {key} observes; add them to the observation"
        )
    columns = [list(features).index(name) for name in member.features]
    tensors = {name: tensor.copy() for name, tensor in member.tensors.items()}
    for name in [name for name in tensors if name.endswith(".0.weight")]:
        first = np.zeros((len(tensors[name]), len(features)), np.float32)
        first[:, columns] = tensors[name]
        tensors[name] = first
    return tensors
