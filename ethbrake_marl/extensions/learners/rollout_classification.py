"""The algorithm rollout classification: try several actions at a decision, and learn to choose the cheapest one.

Source: Lagoudakis and Parr, Reinforcement Learning as Classification, 2003.
"""

from __future__ import annotations

from typing import Any

from ethbrake_marl.extensions.learners.rollout_classification_model import RolloutClassificationModel
from ethbrake_marl.extensions.learners.rollout_classification_recipe import RolloutClassificationRecipe
from ethbrake_marl.extensions.learners.start_weights import padded
from ethbrake_marl.first_edition.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.first_edition.policies.network_spec import Float32s, NetworkSpec
from ethbrake_marl.first_edition.training.algorithm import Algorithm
from ethbrake_marl.first_edition.training.training import Training


class RolloutClassification(Algorithm):
    """The algorithm rollout classification. One actor drives all learners."""

    def build(self, training: Training, environment: EthBrakeVecEnv) -> RolloutClassificationModel:
        """Return a new model for a training run.

        At first the model acts like the first policy of the recipe's key ``policies``; without this key it brakes
        fully.
        """
        recipe = training.recipe
        assert isinstance(recipe, RolloutClassificationRecipe)
        environment.engine.branch(environment.engine.moment())  # raises at once if the engine cannot branch
        weights = [padded(policy, training, "policies") for policy in recipe.loaded_policies]
        return RolloutClassificationModel(environment, recipe, weights)

    def tensors(self, actor: Any, network: NetworkSpec) -> dict[str, Float32s]:
        """Return copies of an actor's averaged weights, by name, for a policy bundle whose network is ``network``."""
        tensors: dict[str, Float32s] = actor.tensors(network)
        return tensors
