"""The recipe of ``vine`` (``algorithm: counterfactual``)."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from operator import not_
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from ethbrake_marl.agents.protocol import Source
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.learners.mixture_plan import ModesPlan
from ethbrake_marl.extensions.learners.recipe_keys import NO_SHAPING, Focus, OffsetRange, Steps
from ethbrake_marl.files.yaml import refuse
from ethbrake_marl.policies.network_spec import Activation, NetworkSpec
from ethbrake_marl.registry import Part
from ethbrake_marl.training.agents import make_policy_agent
from ethbrake_marl.training.recipe import Averaging, Layers, Positive, Rate, Shape, TrainingRecipe


class ActorShape(Shape):
    """Hidden layers of the actor, where there is no critic."""

    policy: Layers
    activation: Activation = "relu"
    initial_action: Annotated[float | None, Field(ge=-1.0, le=1.0, exclude_if=lambda v: v is None)] = (
        None  # at first; None: 0
    )


class CounterfactualRecipe(TrainingRecipe):
    """Try ``counterfactuals`` of the ``n_envs x n_steps`` decisions of a round otherwise, then learn from all of them.

    ``start`` names a policy to go on from; without one it begins with random weights. ``ppo@shipped`` is the policy
    that ships for the scenario, and random weights where none does; ``Training.begins`` tells which.
    """

    most_decisions = 2**22

    algorithm: Literal["counterfactual"]
    start: Annotated[str, Field(pattern=r"^(ppo|counterfactual|universal)@.+$", max_length=4096)] | None = None
    n_steps: Annotated[int, Field(ge=1)]
    counterfactuals: Annotated[int, Field(ge=1)]
    offset: OffsetRange
    holds: Annotated[tuple[Steps, ...], Field(strict=False, min_length=1, max_length=16)]
    gradient_limit: Positive | Literal["auto"]
    trust_radius: Rate
    anchor: Positive
    n_epochs: Annotated[int, Field(ge=1, le=1000)]
    batch_size: Annotated[int, Field(ge=2)]
    averaging: Averaging
    focus: Focus = 0.0  # share of what is tried that a scout chooses
    network: ActorShape
    modes: Annotated[ModesPlan | None, Field(exclude_if=not_)] = None  # several networks and a gate

    @field_validator("gradient_limit", mode="wrap")
    @classmethod
    def _automatic_or_fixed(cls, value: Any, check: Callable[[Any], Any]) -> Any:
        with suppress(ValueError):
            return check(value)
        raise ValueError("must be auto or a finite number above 0")

    @model_validator(mode="after")
    def _keys_fit(self) -> CounterfactualRecipe:
        if self.reward.shaping > 0.0:
            refuse(("reward", "shaping"), self.reward.shaping, NO_SHAPING)
        visited = self.n_envs * self.n_steps
        if not self.counterfactuals <= visited:
            refuse(("counterfactuals",), self.counterfactuals, f"must be at most n_envs x n_steps = {visited}")
        return self

    def network_spec(self, observation_size: int) -> NetworkSpec:
        """The actor alone, or several and a gate."""
        modes = self.modes
        several = {} if modes is None else {"networks": modes.networks, "gate_hidden": modes.gate}
        return self.network.spec(observation_size, **several)

    def check_learners(self, learners: int) -> None:
        """Several networks are for one learner: a mode of several would have to be chosen by all of them at once."""
        if self.modes is not None and learners != 1:
            raise InvalidInput(f"recipe {self.name!r}: modes: are for one learner, not for {learners}; leave modes out")


COUNTERFACTUAL = Part(CounterfactualRecipe, "ethbrake_marl.extensions.learners.vine:Counterfactual")

COUNTERFACTUAL_AGENT = Part(
    make_policy_agent,
    form="counterfactual@PATH",
    about="a policy trained by counterfactuals: a run or a bundle",
    knows=Source.MESSAGES,
)
