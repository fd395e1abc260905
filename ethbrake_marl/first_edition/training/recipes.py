"""Recipes of the algorithms PPO and SAC."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, get_args

from pydantic import Field, field_validator, model_validator

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.model import refuse
from ethbrake_marl.first_edition.policies.network_spec import Activation, NetworkSpec
from ethbrake_marl.first_edition.training.recipe import (
    ACTOR_LAYERS,
    Fraction,
    Layers,
    NetworkShape,
    NonNegative,
    Positive,
    Rate,
    Scheme,
    Shape,
    TrainingRecipe,
)
from ethbrake_marl.registry import Part

BATCH_SIZE = "number of decisions in one step of the optimiser"

NETWORK = "hidden layers of actor and critic, and their activation"


class PpoRecipe(TrainingRecipe):
    """Recipe of PPO: an update collects ``n_steps`` decisions of every learner, and learns from them."""

    schemes = get_args(Scheme)
    most_decisions = 2**24

    algorithm: Literal["ppo"]
    batch_size: int = Field(ge=2, description=BATCH_SIZE)
    n_steps: int = Field(ge=2, description="number of decisions of each learner in each world between two updates")
    n_epochs: int = Field(ge=1, le=1000, description="number of passes over the collected decisions in one update")
    gae_lambda: Fraction = Field(
        description="lambda of generalised advantage estimation, from 0 (one step) to 1 (whole return)"
    )
    clip_range: Rate = Field(
        description="PPO's clip range: largest relative change of an action's probability in one update"
    )
    ent_coef: NonNegative = Field(description="weight of the policy's entropy in the loss")
    vf_coef: NonNegative = Field(description="weight of the critic's loss")
    max_grad_norm: Positive = Field(description="largest norm of the gradient; longer gradients are scaled down to it")
    target_kl: Positive | None = Field(None, description="KL divergence beyond which an update stops early")
    turns: Annotated[int, Field(ge=1, le=1000)] | None = Field(  # None: all learners learn in every update
        None, description="number of turns of each learner, if independent learners learn one after the other"
    )
    network: NetworkShape = Field(description=NETWORK)

    @model_validator(mode="after")
    def _keys_fit(self) -> PpoRecipe:
        if self.turns is not None and self.scheme != "independent":
            refuse(("turns",), self.turns, "is allowed with scheme: independent only; remove the key turns")
        rollout = self.n_envs * self.n_steps
        if rollout % self.batch_size:
            refuse(("batch_size",), self.batch_size, f"must divide n_envs x n_steps = {rollout}")
        return self

    def check_learners(self, learners: int) -> None:
        """Raise ``InvalidInput`` if the training has fewer updates than turns (the turns of all learners added up)."""
        updates = -(-self.total_steps // (self.n_envs * learners * self.n_steps))
        if self.turns is not None and self.turns * learners > updates:
            raise InvalidInput(
                f"recipe {self.name!r}: turns = {self.turns} for each of {learners} learners needs at least"
                f" {self.turns * learners} updates, but total_steps = {self.total_steps} gives only {updates}; raise"
                " total_steps, or lower turns"
            )


class SquashedShape(Shape):
    """Hidden layers of SAC's actor and of its two critics."""

    policy: Layers = Field(description=ACTOR_LAYERS)
    value: Layers = Field(description="hidden layers of each of the two critics")
    activation: Activation = "relu"

    def spec(self, observation_size: int, **more: Any) -> NetworkSpec:
        """Return the description of an actor whose action is tanh of its output; see ``Shape.spec``."""
        return super().spec(observation_size, output="tanh", **more)


class SacRecipe(TrainingRecipe):
    """Recipe of SAC, which learns from a replay buffer.

    An update adds ``steps_per_update`` decisions of every learner to the buffer, and learns from decisions that it
    draws from the buffer.
    """

    algorithm: Literal["sac"]
    batch_size: int = Field(ge=2, description=BATCH_SIZE)
    steps_per_update: int = Field(
        1, ge=1, le=10_000, description="number of decisions of each learner in each world between two updates"
    )
    gradient_steps: int = Field(1, ge=1, le=100_000, description="number of steps of the optimiser in one update")
    buffer_size: int = Field(ge=1, le=10_000_000, description="largest number of decisions in the replay buffer")
    learning_starts: int = Field(ge=0, description="number of decisions before the first update")
    tau: Rate = Field(description="fraction by which the target critic moves towards the critic in one update")
    ent_coef: float | str = Field("auto", description="weight of the policy's entropy: a number, or auto (learned)")
    initial_ent_coef: Positive = Field(1.0, description="initial value of ent_coef if it is learned")
    target_entropy: Annotated[float, Field(allow_inf_nan=False)] | None = Field(
        None, description="entropy at which a learned ent_coef aims; if missing, -1 per action"
    )
    target_update_interval: int = Field(1, ge=1, description="number of updates between two moves of the target critic")
    network: SquashedShape = Field(description=NETWORK)
    log_every_updates: int = Field(ge=1, description="number of updates between two rows of progress.csv")

    @field_validator("ent_coef", mode="plain")
    @classmethod
    def _automatic_or_fixed(cls, value: Any) -> float | str:
        if value == "auto":
            return "auto"
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value < math.inf:
            raise ValueError("must be 'auto' or a finite number of at least 0")
        return float(value)

    @model_validator(mode="after")
    def _room_for_everybody(self) -> SacRecipe:
        if not self.buffer_size >= self.n_envs:
            refuse(("buffer_size",), self.buffer_size, f"must be at least n_envs = {self.n_envs}")
        return self

    @property
    def rounds(self) -> int:
        """Number of decisions of each learner in each world between two updates (``steps_per_update``)."""
        return self.steps_per_update

    @property
    def updates_per_row(self) -> int:
        """Number of updates between two rows of ``progress.csv`` (``log_every_updates``)."""
        return self.log_every_updates

    @property
    def update_ratio(self) -> float:
        """Number of gradient steps per decision, ``gradient_steps / (n_envs * steps_per_update)``."""
        return self.gradient_steps / (self.n_envs * self.steps_per_update)

    def derived(self) -> dict[str, float]:
        """Return the number of gradient steps per decision as ``{"update_ratio": ...}``, for ``config.json``."""
        return {"update_ratio": self.update_ratio}


PPO = Part(PpoRecipe, "ethbrake_marl.first_edition.training.ppo:Ppo")

SAC = Part(SacRecipe, "ethbrake_marl.first_edition.training.sac:Sac")
