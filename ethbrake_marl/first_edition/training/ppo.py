"""Algorithm PPO, with the models of Stable-Baselines3."""

from __future__ import annotations

from typing import Any

from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from torch.optim import Optimizer

from ethbrake_marl.first_edition.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.first_edition.training.algorithm import Algorithm
from ethbrake_marl.first_edition.training.central_critic import CentralCriticPolicy
from ethbrake_marl.first_edition.training.independent import IndependentPPO
from ethbrake_marl.first_edition.training.networks import ppo_arguments
from ethbrake_marl.first_edition.training.recipes import PpoRecipe
from ethbrake_marl.first_edition.training.training import Training


class Ppo(Algorithm):
    """Algorithm PPO: one policy for all learners (optionally with a central critic), or one policy per learner."""

    def build(self, training: Training, environment: EthBrakeVecEnv) -> PPO:
        """Return a new PPO model for a training run, which learns in ``environment``.

        The scheme of the training run decides whether the model has a shared policy, a central critic, or one policy
        for each learner.
        """
        recipe = training.recipe
        assert isinstance(recipe, PpoRecipe)
        settings: dict[str, Any] = {
            "learning_rate": recipe.learning_rate.at,
            "n_steps": recipe.n_steps,
            "batch_size": recipe.batch_size,
            "n_epochs": recipe.n_epochs,
            "gamma": recipe.gamma,
            "gae_lambda": recipe.gae_lambda,
            "clip_range": recipe.clip_range,
            "ent_coef": recipe.ent_coef,
            "vf_coef": recipe.vf_coef,
            "max_grad_norm": recipe.max_grad_norm,
            "target_kl": recipe.target_kl,
            "stats_window_size": max(100, environment.num_envs),
            "policy_kwargs": ppo_arguments(recipe.network),
            "seed": recipe.seed,
            "device": "cpu",
        }
        if training.scheme == "independent":
            return IndependentPPO(environment, list(training.drivers), recipe.turns, training.columns, **settings)
        if training.scheme == "centralised":
            settings["policy_kwargs"]["own"] = training.observation.size
            return PPO(CentralCriticPolicy, environment, **settings)
        return PPO("MlpPolicy", environment, **settings)

    def actors(self, model: BaseAlgorithm) -> tuple[BasePolicy, ...]:
        """Return the model's policy, or the policies of independent learners, front to rear."""
        return tuple(model.policy.policies) if isinstance(model, IndependentPPO) else (model.policy,)

    def optimizers(self, model: BaseAlgorithm) -> dict[str, Optimizer]:
        """Return the optimiser as ``policy``, or the optimisers of independent learners by the vehicle's name."""
        if isinstance(model, IndependentPPO):
            return dict(zip(model.names, (member.optimizer for member in model.policy.policies), strict=True))
        return {"policy": model.policy.optimizer}
