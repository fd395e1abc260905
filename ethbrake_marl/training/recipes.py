"""The recipes of PPO and SAC."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, get_args

from pydantic import Field, field_validator, model_validator

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.model import refuse
from ethbrake_marl.registry import Part
from ethbrake_marl.training.recipe import (
    Fraction,
    NetworkShape,
    NonNegative,
    Positive,
    Rate,
    Scheme,
    SquashedShape,
    TrainingRecipe,
)


class PpoRecipe(TrainingRecipe):
    """PPO: collect ``n_steps`` decisions of every learner, then go through them ``n_epochs`` times."""

    schemes = get_args(Scheme)
    most_decisions = 2**24

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
    def _keys_fit(self) -> PpoRecipe:
        if self.turns is not None and self.scheme != "independent":
            refuse(("turns",), self.turns, "is for scheme: independent only; leave it out")
        rollout = self.n_envs * self.n_steps
        if rollout % self.batch_size:
            refuse(("batch_size",), self.batch_size, f"must divide n_envs x n_steps = {rollout}")
        return self

    def check_learners(self, learners: int) -> None:
        """Every turn needs an update of its own."""
        updates = -(-self.total_steps // (self.n_envs * learners * self.n_steps))
        if self.turns is not None and self.turns * learners > updates:
            raise InvalidInput(
                f"recipe {self.name!r}: turns = {self.turns}: {learners} learners need {self.turns * learners}"
                f" updates, total_steps = {self.total_steps} are {updates}"
            )


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

    @property
    def rounds(self) -> int:
        """Decisions of each learner between two updates."""
        return self.steps_per_update

    @property
    def update_ratio(self) -> float:
        """Gradient steps per decision of one learner in each world."""
        return self.gradient_steps / (self.n_envs * self.steps_per_update)


PPO = Part(PpoRecipe, "ethbrake_marl.training.ppo:Ppo")

SAC = Part(SacRecipe, "ethbrake_marl.training.sac:Sac")
