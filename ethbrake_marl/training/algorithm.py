"""Base class of learning algorithms: each builds a model of Stable-Baselines3."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import Tensor, nn

from ethbrake_marl.faces.sb3 import EthBrakeVecEnv
from ethbrake_marl.policies.layers import Float32s
from ethbrake_marl.policies.network import Activation, NetworkSpec
from ethbrake_marl.training.training import Training

ACTIVATIONS: dict[Activation, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh}


class Algorithm(ABC):
    """Base class of learning algorithms. A subclass needs only ``build`` if its networks are like PPO's or SAC's.

    Checkpoints save the parts that the model's method ``_get_torch_save_params`` names.
    """

    @abstractmethod
    def build(self, training: Training, environment: EthBrakeVecEnv) -> BaseAlgorithm:
        """Its random numbers come from the recipe's seed alone; one row of ``environment`` for each learner in each
        world.
        """

    def actors(self, model: BaseAlgorithm) -> list[Any]:
        """One for each group of learners (``Training.groups``)."""
        return [model.policy]

    def tensors(self, actor: Any, network: NetworkSpec) -> dict[str, Float32s]:
        """Copy of an actor's weights, name in a policy file -> tensor, for networks like PPO's or SAC's."""
        if network.output != "clip":
            inner = actor.actor
            return tensors_of("policy", [*inner.latent_pi, inner.mu]) | _of_layer("policy.log_std", inner.log_std)
        hidden = actor.mlp_extractor
        tensors = tensors_of("policy", [*hidden.policy_net, actor.action_net])
        tensors["policy.log_std"] = array_of(actor.log_std)
        if network.value_hidden:
            tensors |= tensors_of("value", [*hidden.value_net, actor.value_net])
        return tensors


def tensors_of(name: str, layers: Iterable[nn.Module]) -> dict[str, Float32s]:
    """Weights and biases of the linear layers: ``name.0.weight``, ``name.0.bias``, ... ``name.output.bias``."""
    *hidden, output = (layer for layer in layers if isinstance(layer, nn.Linear))
    tensors: dict[str, Float32s] = {}
    for k, layer in enumerate(hidden):
        tensors |= _of_layer(f"{name}.{k}", layer)
    return tensors | _of_layer(f"{name}.output", output)


def _of_layer(name: str, layer: nn.Linear) -> dict[str, Float32s]:
    return {f"{name}.{kind}": array_of(getattr(layer, kind)) for kind in ("weight", "bias")}


def array_of(tensor: Tensor) -> Float32s:
    return tensor.detach().cpu().numpy().astype(np.float32)
