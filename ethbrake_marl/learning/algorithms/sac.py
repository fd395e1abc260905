"""SAC: its recipes and its model."""

# Stable-Baselines3 is imported where a model is built: it loads torch, which takes seconds, and a recipe needs neither.

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from ethbrake_marl.learning.algorithms.protocol import Algorithm
from ethbrake_marl.learning.recipe import Positive, Rate, SquashedShape, TrainingRecipe
from ethbrake_marl.learning.training import Training
from ethbrake_marl.policies.actor import NetworkSpec
from ethbrake_marl.scenario.schema import refuse

if TYPE_CHECKING:
    from stable_baselines3 import SAC
    from stable_baselines3.common.base_class import BaseAlgorithm
    from torch import Tensor
    from torch.optim import Optimizer

    from ethbrake_marl.envs.sb3 import EthBrakeVecEnv


class SacRecipe(TrainingRecipe):
    """SAC: collect ``steps_per_update`` decisions of every learner, then ``gradient_steps`` steps from the memory."""

    algorithm: Literal["sac"]
    batch_size: Annotated[int, Field(ge=2)]
    steps_per_update: Annotated[int, Field(ge=1, le=10_000)] = 1
    gradient_steps: Annotated[int, Field(ge=1, le=100_000)] = 1
    buffer_size: Annotated[int, Field(ge=1, le=10_000_000)]
    learning_starts: Annotated[int, Field(ge=0)]
    tau: Rate
    ent_coef: float | str = "auto"
    initial_ent_coef: Positive = 1.0  # where an automatic one starts
    target_entropy: Annotated[float, Field(allow_inf_nan=False)] | None = None  # None: -1 per action
    target_update_interval: Annotated[int, Field(ge=1)] = 1
    network: SquashedShape
    log_every_updates: Annotated[int, Field(ge=1)]

    @field_validator("ent_coef", mode="plain")
    @classmethod
    def _automatic_or_fixed(cls, value: Any) -> float | str:
        if value == "auto":
            return "auto"
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value < math.inf:
            raise ValueError("must be auto or a number of at least 0")
        return float(value)

    @model_validator(mode="after")
    def _room_for_everybody(self) -> SacRecipe:
        if not self.buffer_size >= self.n_envs:
            refuse(("buffer_size",), self.buffer_size, f"must be at least n_envs = {self.n_envs}")
        return self

    def network_spec(self, observation_size: int) -> NetworkSpec:
        """The actor alone."""
        return self.network.spec(observation_size)

    @property
    def rounds(self) -> int:
        """Decisions of each learner between two updates."""
        return self.steps_per_update

    @property
    def logged_updates(self) -> int:
        """Updates between two rows of the progress table."""
        return self.log_every_updates

    @property
    def update_ratio(self) -> float:
        """Gradient steps per decision of one learner in each world."""
        return self.gradient_steps / (self.n_envs * self.steps_per_update)

    @property
    def facts(self) -> dict[str, Any]:
        """The update ratio."""
        return {"update_ratio": self.update_ratio}


class Sac(Algorithm):
    """Stable-Baselines3's SAC, one for all learners."""

    def build(self, training: Training, environment: EthBrakeVecEnv) -> SAC:
        """The model."""
        from stable_baselines3 import SAC

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
            policy_kwargs=sac_arguments(recipe.network),
            seed=recipe.seed,
            device="cpu",
        )

    def optimizers(self, model: BaseAlgorithm) -> dict[str, Optimizer]:
        """Those of actor and critics, and of the entropy coefficient where it is learned."""
        from stable_baselines3 import SAC

        assert isinstance(model, SAC)
        found: dict[str, Any] = {"actor": model.actor.optimizer, "critic": model.critic.optimizer}
        if model.ent_coef_optimizer is not None:
            found["ent_coef"] = model.ent_coef_optimizer
        return found

    def learned_beside(self, model: BaseAlgorithm) -> dict[str, Tensor]:
        """The logarithm of the entropy coefficient, where it is learned."""
        coefficient = self.log_noise(model)
        return {} if coefficient is None else {"log_ent_coef": coefficient}

    def log_noise(self, model: BaseAlgorithm) -> Tensor | None:
        """The logarithm of the entropy coefficient; None where it is fixed."""
        from stable_baselines3 import SAC

        assert isinstance(model, SAC)
        return None if model.log_ent_coef is None else model.log_ent_coef.detach()


def sac_arguments(shape: SquashedShape) -> dict[str, Any]:
    """Arguments of SAC's policy: an actor and two critics."""
    from ethbrake_marl.learning.algorithms.networks import ACTIVATIONS

    return {
        "net_arch": {"pi": list(shape.policy), "qf": list(shape.value)},
        "activation_fn": ACTIVATIONS[shape.activation],
    }
