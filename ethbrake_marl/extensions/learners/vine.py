"""The algorithm ``vine``: try two actions in the same state, and measure the gradient of the return.

The name of the algorithm is from Schulman et al. 2015 (TRPO), who sample branches from visited states with common
random numbers.
"""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from torch.optim import Optimizer

from ethbrake_marl.extensions.learners.mixture_model import ExpertsModel
from ethbrake_marl.extensions.learners.start_weights import widened
from ethbrake_marl.extensions.learners.vine_model import VineModel
from ethbrake_marl.extensions.learners.vine_recipe import VineRecipe
from ethbrake_marl.first_edition.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.first_edition.policies.bundle import load_policy
from ethbrake_marl.first_edition.policies.network_spec import Float32s, NetworkSpec
from ethbrake_marl.first_edition.policies.shipped import load_shipped
from ethbrake_marl.first_edition.training.algorithm import Algorithm
from ethbrake_marl.first_edition.training.training import Training


class Vine(Algorithm):
    """The algorithm vine, which measures gradients of the return and trains an actor with them.

    The same actor drives all learners. If there is only one learner, a mixture of experts may drive this learner
    instead.
    """

    def build(self, training: Training, environment: EthBrakeVecEnv) -> VineModel:
        """Return a new model for a training run.

        The initial weights come from the policy that the recipe's key ``start`` names; without this key they are
        random.
        """
        recipe = training.recipe
        assert isinstance(recipe, VineRecipe)
        environment.engine.branch(environment.engine.moment())  # raises at once if the engine cannot branch
        model = (VineModel if recipe.experts is None else ExpertsModel)(environment, recipe)
        start = recipe.policy_to_start_from(training.scenario)
        if start is not None:
            name, _, path = start.partition("@")
            policy = load_policy(path) if path else load_shipped(name)
            first = model.policy.actors[0] if isinstance(model, ExpertsModel) else model.policy
            first.take_over(widened(policy, training))
        return model

    def tensors(self, actor: Any, network: NetworkSpec) -> dict[str, Float32s]:
        """Return copies of an actor's averaged weights, by name, for a policy bundle whose network is ``network``."""
        tensors: dict[str, Float32s] = actor.tensors(network)
        return tensors

    def optimizers(self, model: BaseAlgorithm) -> dict[str, Optimizer]:
        """Return the optimisers of the model, by name.

        A model with one actor has one optimiser, ``policy``. A mixture of experts has the optimisers ``network_1``,
        ``network_2``, ... of its experts, and ``gate`` of its gating network.
        """
        if not isinstance(model, ExpertsModel):
            return {"policy": model.policy.optimizer}
        members = {f"network_{k + 1}": actor.optimizer for k, actor in enumerate(model.policy.actors)}
        return {**members, "gate": model.policy.gate.optimizer}
