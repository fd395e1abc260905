"""Between our tensor table and Stable-Baselines3's policies."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.policies import BasePolicy
from torch import nn

from ethbrake_marl.learning.forward import Float32s
from ethbrake_marl.learning.networks import Activation, NetworkSpec, tensor_table
from ethbrake_marl.learning.recipe import NetworkShape, SquashedShape

_ACTIVATIONS: dict[Activation, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh}


def ppo_arguments(shape: NetworkShape) -> dict[str, Any]:
    """Arguments of PPO's policy: separate actor and critic, orthogonal initial weights."""
    return {
        "net_arch": {"pi": list(shape.policy), "vf": list(shape.value)},
        "activation_fn": _ACTIVATIONS[shape.activation],
        "ortho_init": True,
        "log_std_init": shape.initial_log_std,
    }


def sac_arguments(shape: SquashedShape) -> dict[str, Any]:
    """Arguments of SAC's policy: an actor and two critics."""
    return {
        "net_arch": {"pi": list(shape.policy), "qf": list(shape.value)},
        "activation_fn": _ACTIVATIONS[shape.activation],
    }


def tensors_of(policy: BasePolicy, spec: NetworkSpec) -> dict[str, Float32s]:
    """Copy the policy's weights under the names of our table."""
    state = policy.state_dict()
    return {row.name: state[row.sb3_name].detach().cpu().numpy().astype(np.float32) for row in tensor_table(spec)}
