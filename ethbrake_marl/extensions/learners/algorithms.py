"""How a training builds the models of this extension, and turns them into policies."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from ethbrake_marl.extensions.learners.recipes import VineRecipe
from ethbrake_marl.extensions.learners.rollout_classification import RolloutClassificationModel
from ethbrake_marl.extensions.learners.start import ranged_weights, start_weights, starting_policy
from ethbrake_marl.extensions.learners.vine import VineModel
from ethbrake_marl.faces.sb3 import EthBrakeVecEnv
from ethbrake_marl.policies.layers import Float32s
from ethbrake_marl.policies.network import NetworkSpec
from ethbrake_marl.training.algorithm import Algorithm
from ethbrake_marl.training.training import Training


class Vine(Algorithm):
    """Algorithm vine: gradients from simulations with a higher and a lower action. One policy controls all learners."""

    def build(self, training: Training, environment: EthBrakeVecEnv) -> VineModel:
        """New model. Its weights are random, or those of the policy that the recipe's key ``start`` names."""
        recipe = training.recipe
        assert isinstance(recipe, VineRecipe)
        model = self.new_model(training, environment)
        if recipe.start is not None:
            policy, network = starting_policy(recipe.start, recipe.name), recipe.network_spec(len(model.features))
            outside = recipe.network.initial_action
            if isinstance(outside, str):
                random = model.policy.tensors("policy")
                tensors = ranged_weights(policy, random, model.features, outside, recipe.name)
            else:
                tensors = start_weights(policy, network, model.features, recipe.name)
            for name, weight in model.policy.weights("policy").items():
                weight.copy_(torch.from_numpy(tensors[name]))
            model.policy.learning.load_state_dict(model.policy.average.state_dict())
        return model

    def new_model(self, training: Training, environment: EthBrakeVecEnv) -> VineModel:
        return VineModel(training, environment)

    def tensors(self, actor: Any, network: NetworkSpec) -> dict[str, Float32s]:
        log_std = {"policy.log_std": np.full(1, -3.0, np.float32)}  # which never counts, because vine does not explore
        return dict(actor.tensors("policy") | log_std)


class RolloutClassification(Algorithm):
    def build(self, training: Training, environment: EthBrakeVecEnv) -> RolloutClassificationModel:
        """New model, whose untrained policy brakes fully."""
        return RolloutClassificationModel(training, environment)

    def tensors(self, actor: Any, network: NetworkSpec) -> dict[str, Float32s]:
        return dict(actor.tensors("policy"))
