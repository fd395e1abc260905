"""The recipes of PPO and SAC."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, get_args

from pydantic import Field, field_validator, model_validator

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.model import refuse
from ethbrake_marl.policies.network_spec import Activation, NetworkSpec
from ethbrake_marl.registry import Part
from ethbrake_marl.training.recipe import (
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

BATCH_SIZE = "decisions in one step of the optimiser"

NETWORK = "hidden layers of the actor, and of the critic if there is one, and their activation"


class PpoRecipe(TrainingRecipe):
    """PPO recipe: collect ``n_steps`` decisions of every learner, then learn from them in ``n_epochs`` passes."""

    schemes = get_args(Scheme)
    most_decisions = 2**24

    algorithm: Literal["ppo"]
    batch_size: int = Field(ge=2, description=BATCH_SIZE)
    n_steps: int = Field(ge=2, description="decisions of each world between two updates")
    n_epochs: int = Field(ge=1, le=1000, description="passes of one update over the collected decisions")
    gae_lambda: Fraction = Field(description="lambda of the advantage estimates, from 0 (one step) to 1 (all)")
    clip_range: Rate = Field(description="how far the probability of an action may move in one update")
    ent_coef: NonNegative = Field(description="weight of the policy's entropy")
    vf_coef: NonNegative = Field(description="weight of the critic's loss")
    max_grad_norm: Positive = Field(description="largest norm of a gradient; a longer one is scaled down")
    target_kl: Positive | None = Field(None, description="an update stops beyond this KL divergence")
    turns: Annotated[int, Field(ge=1, le=1000)] | None = Field(  # None: all learn at once
        None, description="rounds in which independent learners learn one after the other"
    )
    network: NetworkShape = Field(description=NETWORK)

    @model_validator(mode="after")
    def _keys_fit(self) -> PpoRecipe:
        if self.turns is not None and self.scheme != "independent":
            refuse(("turns",), self.turns, "is for scheme: independent only; leave it out")
        rollout = self.n_envs * self.n_steps
        if rollout % self.batch_size:
            refuse(("batch_size",), self.batch_size, f"must divide n_envs x n_steps = {rollout}")
        return self

    def check_learners(self, learners: int) -> None:
        """Raise ``InvalidInput`` if the training has fewer updates than turns of this number of learners."""
        updates = -(-self.total_steps // (self.n_envs * learners * self.n_steps))
        if self.turns is not None and self.turns * learners > updates:
            raise InvalidInput(
                f"recipe {self.name!r}: turns = {self.turns}: {learners} learners need {self.turns * learners}"
                f" updates, total_steps = {self.total_steps} are {updates}"
            )


class SquashedShape(Shape):
    """Hidden layers of SAC's actor and of each of its two critics; the actor's noise depends on the observation."""

    policy: Layers = Field(description=ACTOR_LAYERS)
    value: Layers = Field(description="hidden layers of each of the two critics")
    activation: Activation = "relu"

    def spec(self, observation_size: int, **more: Any) -> NetworkSpec:
        """Return the description of the network in a policy bundle: the actor only, whose action is tanh of its mean.

        ``observation_size`` is the number of features of an observation; ``more`` are other fields of ``NetworkSpec``.
        """
        return super().spec(observation_size, output="tanh", **more)


class SacRecipe(TrainingRecipe):
    """SAC recipe: collect ``steps_per_update`` decisions of every learner, then take ``gradient_steps`` steps."""

    algorithm: Literal["sac"]
    batch_size: int = Field(ge=2, description=BATCH_SIZE)
    steps_per_update: int = Field(1, ge=1, le=10_000, description="decisions of each world between two updates")
    gradient_steps: int = Field(1, ge=1, le=100_000, description="steps of the optimiser in one update")
    buffer_size: int = Field(ge=1, le=10_000_000, description="decisions that the replay memory holds")
    learning_starts: int = Field(ge=0, description="decisions before the first update")
    tau: Rate = Field(description="share by which the target critic follows in one update")
    ent_coef: float | str = Field("auto", description="weight of the policy's entropy: auto, or a number")
    initial_ent_coef: Positive = Field(1.0, description="value at which an automatic ent_coef starts")
    target_entropy: Annotated[float, Field(allow_inf_nan=False)] | None = Field(
        None, description="entropy that an automatic ent_coef aims at; without it -1 per action"
    )
    target_update_interval: int = Field(1, ge=1, description="updates between two changes of the target critic")
    network: SquashedShape = Field(description=NETWORK)
    log_every_updates: int = Field(ge=1, description="updates between two rows of the progress table")

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
        """Decisions of each learner in each world between two updates: ``steps_per_update``."""
        return self.steps_per_update

    @property
    def updates_per_row(self) -> int:
        """Number of updates between two rows of ``progress.csv``: ``log_every_updates``."""
        return self.log_every_updates

    @property
    def update_ratio(self) -> float:
        """Number of gradient steps per decision: ``gradient_steps / (n_envs * steps_per_update)``."""
        return self.gradient_steps / (self.n_envs * self.steps_per_update)

    def derived(self) -> dict[str, float]:
        """Return ``{"update_ratio": ...}``, gradient steps per decision, to be recorded in ``config.json``."""
        return {"update_ratio": self.update_ratio}


PPO = Part(PpoRecipe, "ethbrake_marl.training.ppo:Ppo")

SAC = Part(SacRecipe, "ethbrake_marl.training.sac:Sac")
