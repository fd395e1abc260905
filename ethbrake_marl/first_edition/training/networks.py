"""Networks of Stable-Baselines3's models, and the conversion of their weights to the tensors of a policy bundle."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.policies import BasePolicy
from torch import Tensor, nn

from ethbrake_marl.first_edition.policies.network_spec import Activation, Float32s, NetworkSpec
from ethbrake_marl.first_edition.training.recipe import NetworkShape

ACTIVATIONS: dict[Activation, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh}


def tensors_of(policy: BasePolicy, spec: NetworkSpec) -> dict[str, Float32s]:
    """Return a copy of the weights of a PPO or SAC policy: name of a tensor in a policy bundle -> its values.

    ``spec`` is the description of the network in the policy bundle, which must have the same layers as ``policy``.
    """
    state = policy.state_dict()
    return {name: copy_of(state[theirs]) for name, theirs in sb3_names(spec).items()}


def sb3_names(spec: NetworkSpec) -> dict[str, str]:
    """Return the names of a network's tensors: name in a policy bundle -> name in Stable-Baselines3's policy.

    The network belongs to PPO if ``spec.output`` is ``clip``, and otherwise to SAC. Stable-Baselines3 also numbers the
    activations, so hidden layer k of a bundle has the number 2 k in Stable-Baselines3.
    """
    if spec.output == "clip":
        ours = {"policy": ("mlp_extractor.policy_net", "action_net"), "value": ("mlp_extractor.value_net", "value_net")}
        noise = "log_std"
    else:
        ours, noise = {"policy": ("actor.latent_pi", "actor.mu")}, "actor.log_std"

    def theirs(name: str) -> str:
        network, layer, *kind = name.split(".")
        hidden, output = ours[network]
        layers = {"log_std": noise, "output": output}
        return ".".join([layers.get(layer) or f"{hidden}.{2 * int(layer)}", *kind])

    return {row.name: theirs(row.name) for row in spec.tensors}


def tensors_of_layers(name: str, layers: nn.Sequential) -> dict[str, Float32s]:
    """Return a copy of a perceptron's weights: name of a tensor in a policy bundle -> its values.

    All names begin with ``name``, such as ``policy`` or ``gate``. The last linear layer of ``layers`` is the output
    layer; there may be activations between the linear layers.
    """
    linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
    numbers = [*map(str, range(len(linear) - 1)), "output"]
    pairs = {f"{name}.{k}": layer for k, layer in zip(numbers, linear, strict=True)}
    return {
        f"{where}.{kind}": copy_of(tensor)
        for where, layer in pairs.items()
        for kind, tensor in (("weight", layer.weight), ("bias", layer.bias))
    }


def copy_of(tensor: Tensor) -> Float32s:
    return tensor.detach().cpu().numpy().astype(np.float32)


def ppo_arguments(shape: NetworkShape) -> dict[str, Any]:
    """Return ``policy_kwargs`` of Stable-Baselines3's PPO for the value of the key ``network`` of a recipe.

    Actor and critic are separate networks with orthogonal initial weights.
    """
    return {
        "net_arch": {"pi": list(shape.policy), "vf": list(shape.value)},
        "activation_fn": ACTIVATIONS[shape.activation],
        "ortho_init": True,
        "log_std_init": shape.initial_log_std,
    }
