"""Options: several actions are tried at a decision, and the actor learns to choose the one that costs least."""

from __future__ import annotations

from typing import Any

from ethbrake_marl.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.extensions.learners.rollout_classification_model import OptionsModel
from ethbrake_marl.extensions.learners.rollout_classification_recipe import OptionsRecipe
from ethbrake_marl.extensions.learners.start_weights import padded
from ethbrake_marl.policies.network_spec import Float32s, NetworkSpec
from ethbrake_marl.training.algorithm import Algorithm
from ethbrake_marl.training.training import Training


class Options(Algorithm):
    """Policy iteration by what actions cost in closed loop; one actor for all learners."""

    def build(self, training: Training, environment: EthBrakeVecEnv) -> OptionsModel:
        """The model, from random weights and full braking."""
        recipe = training.recipe
        assert isinstance(recipe, OptionsRecipe)
        environment.engine.branch(environment.engine.moment())  # refuses what cannot be branched before it begins
        among = [padded(policy, training, "among") for policy in recipe.policies]
        return OptionsModel(environment, recipe, among)

    def tensors(self, actor: Any, network: NetworkSpec) -> dict[str, Float32s]:
        """Copy the average of the actor's weights, which drives."""
        found: dict[str, Float32s] = actor.tensors(network)
        return found
