"""PPO: its recipes, and the model of each training scheme."""

# Stable-Baselines3 is imported where a model is built: it loads torch, which takes seconds, and a recipe needs neither.

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

from pydantic import Field, model_validator

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning.algorithms.protocol import Algorithm
from ethbrake_marl.learning.recipe import (
    Fraction,
    NetworkShape,
    NonNegative,
    Positive,
    Rate,
    Scheme,
    TrainingRecipe,
)
from ethbrake_marl.learning.training import Training
from ethbrake_marl.policies.actor import NetworkSpec
from ethbrake_marl.scenario.schema import refuse

if TYPE_CHECKING:
    from stable_baselines3 import PPO
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.policies import BasePolicy
    from torch.optim import Optimizer

    from ethbrake_marl.envs.sb3 import EthBrakeVecEnv

ROLLOUT_LIMIT = 2**24  # decisions held in memory between two updates


class PpoRecipe(TrainingRecipe):
    """PPO: collect ``n_steps`` decisions of every learner, then go through them ``n_epochs`` times."""

    schemes = get_args(Scheme)

    algorithm: Literal["ppo"]
    batch_size: Annotated[int, Field(ge=2)]
    n_steps: Annotated[int, Field(ge=2)]
    n_epochs: Annotated[int, Field(ge=1, le=1000)]
    gae_lambda: Fraction
    clip_range: Rate
    ent_coef: NonNegative
    vf_coef: NonNegative
    max_grad_norm: Positive
    target_kl: Positive | None = None
    turns: Annotated[int, Field(ge=1, le=1000)] | None = None  # of independent learners; None: all learn at once
    network: NetworkShape

    @model_validator(mode="after")
    def _turns_are_for_independent_learners(self) -> PpoRecipe:
        if self.turns is not None and self.scheme != "independent":
            refuse(("turns",), self.turns, "is for scheme: independent only; leave it out")
        return self

    @model_validator(mode="after")
    def _whole_batches(self) -> PpoRecipe:
        rollout = self.n_envs * self.n_steps
        if not rollout <= ROLLOUT_LIMIT:
            right = f"n_envs x n_steps = {rollout} decisions per update; at most {ROLLOUT_LIMIT}"
            refuse(("n_envs",), self.n_envs, right)
        if rollout % self.batch_size:
            refuse(("batch_size",), self.batch_size, f"must divide n_envs x n_steps = {rollout}")
        return self

    def network_spec(self, observation_size: int) -> NetworkSpec:
        """Actor and critic."""
        return self.network.spec(observation_size)

    @property
    def rounds(self) -> int:
        """Decisions of each learner between two updates."""
        return self.n_steps

    def check_learners(self, learners: int) -> None:
        """Every turn needs an update of its own."""
        updates = -(-self.total_steps // (self.n_envs * learners * self.n_steps))
        if self.turns is not None and self.turns * learners > updates:
            raise InvalidInput(
                f"recipe {self.name!r}: turns = {self.turns}: {learners} learners need {self.turns * learners}"
                f" updates, total_steps = {self.total_steps} are {updates}"
            )


class Ppo(Algorithm):
    """Stable-Baselines3's PPO: one for all learners, with a central critic, or one for each."""

    def build(self, training: Training, environment: EthBrakeVecEnv) -> PPO:
        """The model of the training's scheme."""
        from stable_baselines3 import PPO

        from ethbrake_marl.learning.algorithms.networks import CentralCriticPolicy, IndependentPPO

        recipe = training.recipe
        assert isinstance(recipe, PpoRecipe)
        settings = _settings(recipe, environment)
        if training.scheme == "independent":
            return IndependentPPO(environment, list(training.drivers), recipe.turns, **settings)
        if training.scheme == "centralised":
            settings["policy_kwargs"]["own"] = training.observation.size
            return PPO(CentralCriticPolicy, environment, **settings)
        return PPO("MlpPolicy", environment, **settings)

    def actors(self, model: BaseAlgorithm) -> tuple[BasePolicy, ...]:
        """The model's policy, or the one of each independent learner."""
        from ethbrake_marl.learning.algorithms.networks import IndependentPPO

        return tuple(model.policy.policies) if isinstance(model, IndependentPPO) else (model.policy,)

    def optimizers(self, model: BaseAlgorithm) -> dict[str, Optimizer]:
        """The optimiser of the model's policy, or the one of each independent learner by the vehicle's name."""
        from ethbrake_marl.learning.algorithms.networks import IndependentPPO

        if isinstance(model, IndependentPPO):
            return dict(zip(model.names, (member.optimizer for member in model.policy.policies), strict=True))
        return {"policy": model.policy.optimizer}


def ppo_arguments(shape: NetworkShape) -> dict[str, Any]:
    """Arguments of PPO's policy: separate actor and critic, orthogonal initial weights."""
    from ethbrake_marl.learning.algorithms.networks import ACTIVATIONS

    return {
        "net_arch": {"pi": list(shape.policy), "vf": list(shape.value)},
        "activation_fn": ACTIVATIONS[shape.activation],
        "ortho_init": True,
        "log_std_init": shape.initial_log_std,
    }


def _settings(recipe: PpoRecipe, environment: EthBrakeVecEnv) -> dict[str, Any]:
    return {
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
