"""PPO: one policy for all learners, with or without a central critic, or one for each (``training.several``)."""

from __future__ import annotations

from typing import Any

from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

from ethbrake_marl.faces.sb3 import EthBrakeVecEnv
from ethbrake_marl.training.algorithm import ACTIVATIONS, Algorithm
from ethbrake_marl.training.recipe import PpoRecipe
from ethbrake_marl.training.several import CentralCriticPolicy, IndependentPPO
from ethbrake_marl.training.training import Training


class Ppo(Algorithm):
    def build(self, training: Training, environment: EthBrakeVecEnv) -> PPO:
        recipe = training.recipe
        assert isinstance(recipe, PpoRecipe)
        shape = recipe.network
        network: dict[str, Any] = {
            "net_arch": {"pi": list(shape.policy), "vf": list(shape.value)},
            "activation_fn": ACTIVATIONS[shape.activation],
            "log_std_init": shape.initial_log_std,
        }
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
            "seed": recipe.seed,
            "device": "cpu",
        }
        if training.scheme == "independent":
            return IndependentPPO(environment, training, policy_kwargs=network, **settings)
        if training.scheme == "centralised":
            network["actor_size"] = len(training.row.names)
            return PPO(CentralCriticPolicy, environment, policy_kwargs=network, **settings)
        return PPO("MlpPolicy", environment, policy_kwargs=network, **settings)

    def actors(self, model: BaseAlgorithm) -> list[BasePolicy]:
        return [*model.policy.policies] if isinstance(model, IndependentPPO) else [model.policy]
