"""``Algorithm``: what a learning algorithm is. It builds a model of Stable-Baselines3, which can then be trained."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from torch import nn

from ethbrake_marl.faces.sb3 import EthBrakeVecEnv
from ethbrake_marl.policies.layers import Float32s
from ethbrake_marl.policies.network import Activation, NetworkSpec
from ethbrake_marl.training.training import Training

ACTIVATIONS: dict[Activation, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh}


class Algorithm(ABC):
    """Base class of learning algorithms. Only ``build`` must be written; PPO's and SAC's networks need no more.

    Checkpoints save what Stable-Baselines3 itself saves of the model: the state of what its method
    ``_get_torch_save_params`` names. A model with further memory names it there.
    """

    @abstractmethod
    def build(self, training: Training, environment: EthBrakeVecEnv) -> BaseAlgorithm:
        """Return a new model on the CPU, whose random numbers depend on the recipe's seed only.

        ``environment`` has one row for each learner in each world.
        """

    def actors(self, model: BaseAlgorithm) -> list[BasePolicy]:
        """Return the policies inside the model that choose actions, one for each of ``training.groups``."""
        return [model.policy]

    def tensors(self, actor: BasePolicy, network: NetworkSpec) -> dict[str, Float32s]:
        """Return a copy of an actor's weights: name in a policy file -> tensor."""
        state = actor.state_dict()
        names = {name: name_in_sb3(name, network) for name in network.tensors}
        return {ours: state[theirs].detach().numpy().astype(np.float32) for ours, theirs in names.items()}


def name_in_sb3(name: str, network: NetworkSpec) -> str:
    """Return the name in Stable-Baselines3 of a tensor of a policy file: ``policy.0.weight``, ``value.output.bias``.

    The network is PPO's if its action is clipped, else SAC's. Stable-Baselines3 numbers activations too.
    """
    if network.output == "clip":
        places = {
            "policy": ("mlp_extractor.policy_net", "action_net"),
            "value": ("mlp_extractor.value_net", "value_net"),
        }
        noise = "log_std"
    else:
        places, noise = {"policy": ("actor.latent_pi", "actor.mu")}, "actor.log_std"
    part, layer, *kind = name.split(".")
    hidden, output = places[part]
    place = {"log_std": noise, "output": output}.get(layer) or f"{hidden}.{2 * int(layer)}"
    return ".".join([place, *kind])
