"""From a recipe to a model of Stable-Baselines3, fresh and ready to learn, and from its weights to policies."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from stable_baselines3 import PPO, SAC
from stable_baselines3.common.policies import BasePolicy

from ethbrake_marl.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning.bundle import Policy, make_policy
from ethbrake_marl.learning.central_critic import CentralCriticPolicy
from ethbrake_marl.learning.divergence import watch_gradients
from ethbrake_marl.learning.independent import IndependentPPO
from ethbrake_marl.learning.manifest import observation_schema
from ethbrake_marl.learning.model_state import Model
from ethbrake_marl.learning.policy_team import PolicyTeam, Trained
from ethbrake_marl.learning.recipe import PpoRecipe, SacRecipe, Scheme, TrainingRecipe
from ethbrake_marl.learning.sb3_policy import ppo_arguments, sac_arguments, tensors_of
from ethbrake_marl.learning.schemes import scheme_of
from ethbrake_marl.learning.versions import installed_versions
from ethbrake_marl.observations import ObservationSpec
from ethbrake_marl.scenario import Scenario


def make_model(recipe: TrainingRecipe, environment: EthBrakeVecEnv) -> Model:
    """The model that ``recipe`` asks for, on the CPU, whose optimisers refuse gradients that are not finite."""
    assert isinstance(recipe, PpoRecipe | SacRecipe)
    scheme = scheme_of(recipe, environment.engine.scenario)
    model = _ppo(recipe, environment, scheme) if isinstance(recipe, PpoRecipe) else _sac(recipe, environment)
    watch_gradients(model)
    return model


def policy_maker(
    recipe: TrainingRecipe, scenario: Scenario, observation: ObservationSpec
) -> Callable[[Model], Trained]:
    """How to make policies of a model's present weights: one for all learners, or one for each."""
    network = recipe.network_spec(observation.size)
    if scheme_of(recipe, scenario) == "centralised":
        network = network.model_copy(update={"value_hidden": ()})  # its critic sees what no vehicle sees
    names = tuple(scenario.vehicle_names[vehicle] for vehicle in scenario.learners)
    fixed = {
        "algorithm": recipe.algorithm,
        "network": network,
        "observation": observation_schema(observation),
        "scenario": scenario.model_dump(mode="json"),
        "reward": recipe.reward.model_dump(mode="json"),
        "seeds": {"training": recipe.seed},
        "versions": installed_versions(),
    }

    def made(policy: BasePolicy, learners: tuple[str, ...], steps: int) -> Policy:
        return make_policy(tensors_of(policy, network), learners=learners, steps=steps, **fixed)

    def policies(model: Model) -> Trained:
        if not isinstance(model, IndependentPPO):
            return made(model.policy, names, model.num_timesteps)
        members = zip(names, model.policy.policies, strict=True)
        return PolicyTeam({name: made(policy, (name,), model.num_timesteps) for name, policy in members})

    return policies


def _ppo(recipe: PpoRecipe, environment: EthBrakeVecEnv, scheme: Scheme) -> PPO:
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
    engine = environment.engine
    if scheme == "independent":
        names = [engine.scenario.vehicle_names[vehicle] for vehicle in engine.learners]
        _check_turns(recipe, environment.num_envs, len(names))
        return IndependentPPO(environment, names, recipe.turns, **settings)
    if scheme == "centralised":
        settings["policy_kwargs"]["own"] = engine.observation.size
        return PPO(CentralCriticPolicy, environment, **settings)
    return PPO("MlpPolicy", environment, **settings)


def _check_turns(recipe: PpoRecipe, rows: int, learners: int) -> None:
    """Every turn needs an update of its own."""
    updates = -(-recipe.total_steps // (rows * recipe.n_steps))
    if recipe.turns is not None and recipe.turns * learners > updates:
        raise InvalidInput(
            f"recipe {recipe.name!r}: turns = {recipe.turns}: {learners} learners need {recipe.turns * learners}"
            f" updates, total_steps = {recipe.total_steps} are {updates}"
        )


def _sac(recipe: SacRecipe, environment: EthBrakeVecEnv) -> SAC:
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
