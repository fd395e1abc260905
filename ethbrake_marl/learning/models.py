"""From a recipe to a model of Stable-Baselines3, fresh and ready to learn."""

from __future__ import annotations

from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import VecEnv

from ethbrake_marl.learning.divergence import watch_gradients
from ethbrake_marl.learning.model_state import Model
from ethbrake_marl.learning.recipe import PpoRecipe, SacRecipe, TrainingRecipe
from ethbrake_marl.learning.sb3_policy import ppo_arguments, sac_arguments


def make_model(recipe: TrainingRecipe, environment: VecEnv) -> Model:
    """The model that ``recipe`` asks for, on the CPU, whose optimisers refuse gradients that are not finite."""
    assert isinstance(recipe, PpoRecipe | SacRecipe)
    model = _ppo(recipe, environment) if isinstance(recipe, PpoRecipe) else _sac(recipe, environment)
    watch_gradients(model)
    return model


def _ppo(recipe: PpoRecipe, environment: VecEnv) -> PPO:
    return PPO(
        "MlpPolicy",
        environment,
        learning_rate=recipe.learning_rate.at,
        n_steps=recipe.n_steps,
        batch_size=recipe.batch_size,
        n_epochs=recipe.n_epochs,
        gamma=recipe.gamma,
        gae_lambda=recipe.gae_lambda,
        clip_range=recipe.clip_range,
        ent_coef=recipe.ent_coef,
        vf_coef=recipe.vf_coef,
        max_grad_norm=recipe.max_grad_norm,
        target_kl=recipe.target_kl,
        stats_window_size=max(100, environment.num_envs),
        policy_kwargs=ppo_arguments(recipe.network),
        seed=recipe.seed,
        device="cpu",
    )


def _sac(recipe: SacRecipe, environment: VecEnv) -> SAC:
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
        policy_kwargs=sac_arguments(recipe.network),
        seed=recipe.seed,
        device="cpu",
    )
