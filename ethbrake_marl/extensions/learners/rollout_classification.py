"""The algorithm rollout classification: try several actions at a decision, learn to choose the one that costs least.

Lagoudakis and Parr 2003. Recipes call it ``algorithm: options``.
"""

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
    """Rollout classification, with one actor for all learners."""

    def build(self, training: Training, environment: EthBrakeVecEnv) -> OptionsModel:
        """The model, which at first brakes fully, or takes the first policy ``among``."""
        recipe = training.recipe
        assert isinstance(recipe, OptionsRecipe)
        environment.engine.branch(environment.engine.moment())  # refuses what cannot be branched before it begins
        among = [padded(policy, training, "among") for policy in recipe.policies]
        return OptionsModel(environment, recipe, among)

    def tensors(self, actor: Any, network: NetworkSpec) -> dict[str, Float32s]:
        """Copy the running average of the weights."""
        found: dict[str, Float32s] = actor.tensors(network)
        return found
