"""Between our tensor table and Stable-Baselines3's actor-critic policy."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from ethbrake_marl.learning.forward import Float32s
from ethbrake_marl.learning.networks import Activation, NetworkSpec, tensor_table

_ACTIVATIONS: dict[Activation, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh}


def policy_arguments(spec: NetworkSpec, initial_log_std: float) -> dict[str, Any]:
    """Arguments of ``ActorCriticPolicy`` for ``spec``: separate actor and critic, orthogonal initial weights."""
    return {
        "net_arch": {"pi": list(spec.policy_hidden), "vf": list(spec.value_hidden)},
        "activation_fn": _ACTIVATIONS[spec.activation],
        "ortho_init": True,
        "log_std_init": initial_log_std,
    }


def tensors_of(policy: ActorCriticPolicy, spec: NetworkSpec) -> dict[str, Float32s]:
    """Copy the policy's weights under the names of our table."""
    state = policy.state_dict()
    return {row.name: state[row.sb3_name].detach().cpu().numpy().astype(np.float32) for row in tensor_table(spec)}
