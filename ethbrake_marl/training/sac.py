"""SAC: one policy for all learners, trained on stored decisions."""

from __future__ import annotations

from stable_baselines3 import SAC

from ethbrake_marl.faces.sb3 import EthBrakeVecEnv
from ethbrake_marl.training.algorithm import ACTIVATIONS, Algorithm
from ethbrake_marl.training.recipe import SacRecipe
from ethbrake_marl.training.training import Training


class Sac(Algorithm):
    def build(self, training: Training, environment: EthBrakeVecEnv) -> SAC:
        recipe = training.recipe
        assert isinstance(recipe, SacRecipe)
        shape, learned = recipe.network, recipe.ent_coef == "auto"
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
            ent_coef=f"auto_{recipe.initial_ent_coef!r}" if learned else recipe.ent_coef,
            target_update_interval=recipe.target_update_interval,
            target_entropy="auto" if recipe.target_entropy is None else recipe.target_entropy,
            stats_window_size=max(100, environment.num_envs),
            policy_kwargs={
                "net_arch": {"pi": list(shape.policy), "qf": list(shape.value)},
                "activation_fn": ACTIVATIONS[shape.activation],
            },
            seed=recipe.seed,
            device="cpu",
        )
