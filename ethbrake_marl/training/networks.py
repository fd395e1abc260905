"""Networks of Stable-Baselines3's models, and how their weights get the names of a policy's tensors."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.policies import BasePolicy
from torch import nn

from ethbrake_marl.policies.network_spec import Activation, Float32s, NetworkSpec
from ethbrake_marl.training.recipe import NetworkShape

ACTIVATIONS: dict[Activation, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh}


def tensors_of(policy: BasePolicy, spec: NetworkSpec) -> dict[str, Float32s]:
    """Copy the policy's weights under the names of our table."""
    state = policy.state_dict()
    return {row.name: state[row.sb3_name].detach().cpu().numpy().astype(np.float32) for row in spec.tensors}


def ppo_arguments(shape: NetworkShape) -> dict[str, Any]:
    """Arguments of PPO's policy: separate actor and critic, orthogonal initial weights."""
    return {
        "net_arch": {"pi": list(shape.policy), "vf": list(shape.value)},
        "activation_fn": ACTIVATIONS[shape.activation],
        "ortho_init": True,
        "log_std_init": shape.initial_log_std,
    }
