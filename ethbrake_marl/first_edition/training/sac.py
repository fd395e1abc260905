"""Algorithm SAC, with the model of Stable-Baselines3."""

from __future__ import annotations

from typing import Any

from stable_baselines3 import SAC
from torch import Tensor
from torch.optim import Optimizer

from ethbrake_marl.first_edition.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.first_edition.training.algorithm import Algorithm
from ethbrake_marl.first_edition.training.networks import ACTIVATIONS
from ethbrake_marl.first_edition.training.recipes import SacRecipe
from ethbrake_marl.first_edition.training.training import Training


class Sac(Algorithm):
    """Algorithm SAC, with one policy for all learners."""

    def build(self, training: Training, environment: EthBrakeVecEnv) -> SAC:
        """Return a new SAC model for a training run, seeded by its recipe, which learns in ``environment``."""
        recipe = training.recipe
        assert isinstance(recipe, SacRecipe)
        automatic = recipe.ent_coef == "auto"
        return SAC(
            "MlpPolicy",
            environment,
            learning_rate=recipe.learning_rate.at,
            buffer_size=recipe.buffer_size,
            learning_starts=recipe.learning_starts,
            batch_size=recipe.batch_size,
            tau=recipe.tau,
            gamma=recipe.gamma,
            train_freq=(recipe.steps_per_update, "step"),
            gradient_steps=recipe.gradient_steps,
            ent_coef=f"auto_{recipe.initial_ent_coef!r}" if automatic else recipe.ent_coef,
            target_update_interval=recipe.target_update_interval,
            target_entropy="auto" if recipe.target_entropy is None else recipe.target_entropy,
            stats_window_size=max(100, environment.num_envs),
            policy_kwargs=sac_arguments(recipe),
            seed=recipe.seed,
            device="cpu",
        )

    def optimizers(self, model: Any) -> dict[str, Optimizer]:
        """Return the optimisers ``actor``, ``critic`` and, if the entropy coefficient is learned, ``ent_coef``."""
        optimizers = {"actor": model.actor.optimizer, "critic": model.critic.optimizer}
        return optimizers if model.ent_coef_optimizer is None else {**optimizers, "ent_coef": model.ent_coef_optimizer}

    def learned_beside(self, model: Any) -> dict[str, Tensor]:
        """Return the logarithm of the learned entropy coefficient as ``log_ent_coef``; {} if it is not learned."""
        coefficient = self.log_noise(model)
        return {} if coefficient is None else {"log_ent_coef": coefficient}

    def log_noise(self, model: Any) -> Tensor | None:
        """Return the logarithm of the learned entropy coefficient; None if it is not learned."""
        return None if model.log_ent_coef is None else model.log_ent_coef.detach()


def sac_arguments(recipe: SacRecipe) -> dict[str, Any]:
    """Return ``policy_kwargs`` of Stable-Baselines3's SAC: layers and activation of actor and critics."""
    shape = recipe.network
    return {
        "net_arch": {"pi": list(shape.policy), "qf": list(shape.value)},
        "activation_fn": ACTIVATIONS[shape.activation],
    }
