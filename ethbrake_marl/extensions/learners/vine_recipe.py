"""The recipe of the algorithm ``vine``."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from operator import not_
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, field_validator, model_validator

from ethbrake_marl.agents.protocol import Source
from ethbrake_marl.errors import InvalidInput, refuse_shipped_path
from ethbrake_marl.extensions.learners.mixture_plan import ExpertsPlan
from ethbrake_marl.extensions.learners.recipe_keys import AVERAGING, NO_SHAPING, Averaging, Focus, Holds, OffsetRange
from ethbrake_marl.files.model import refuse
from ethbrake_marl.policies.network_spec import Activation, NetworkSpec
from ethbrake_marl.policies.shipped import load_shipped, shipped_policies
from ethbrake_marl.registry import Part
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.training.agents import make_policy_agent
from ethbrake_marl.training.recipe import ACTOR_LAYERS, Layers, Positive, Rate, Shape, TrainingRecipe
from ethbrake_marl.training.recipes import BATCH_SIZE, NETWORK

_RIGHT_START = "must be the name of a shipped policy, for instance ppo, or ppo@ or vine@ and the path of one"


class ActorShape(Shape):
    """Hidden layers of an actor without a critic."""

    policy: Layers = Field(description=ACTOR_LAYERS)
    activation: Activation = "relu"  # activation function of the hidden layers
    initial_action: Annotated[float | None, Field(ge=-1.0, le=1.0, exclude_if=lambda v: v is None)] = Field(
        None, description="action of the untrained network, [-1, 1], about; left out: 0, which coasts"
    )


class VineRecipe(TrainingRecipe):
    """Recipe of vine: some decisions are tried with a higher and a lower action, each to the end of its episode.

    A round has ``n_envs x n_steps`` decisions; ``tried`` of them are tried. The policy learns from the
    differences of the returns. ``start`` names a trained policy to continue from; without it the weights are random.
    ``start: ppo`` means the shipped policy ``ppo`` or ``ppo-...`` that was trained on the scenario of this training; if
    there is none, the weights are random.
    """

    most_decisions = 2**22

    algorithm: Literal["vine"]
    start: Annotated[str, Field(pattern=r"^((ppo|vine)@.+|[a-z-]+)$", max_length=4096)] | None = Field(
        None,
        description="a policy to continue from, ppo or ppo@PATH; ppo: the shipped policy that was trained on this"
        " scenario, or random weights if there is none; left out: random weights",
    )
    n_steps: int = Field(ge=1, description="decisions of each world between two updates")
    tried: int = Field(ge=1, description="decisions of a round that are tried with a higher and a lower action")
    offset: OffsetRange = Field(description="range of the change of the tried action; drawn uniformly in its logarithm")
    holds: Holds = Field(description="numbers of steps, one of which is drawn; the action is changed for so long")
    # Largest size of a measured gradient (return per unit of action); larger ones, at jumps of the harm, are cut to it.
    gradient_limit: Positive | Literal["auto"] = Field(
        description="largest gradient, in return per action; larger ones are cut to it; auto: as measured"
    )
    # Largest distance from an action to the target that it is trained towards in one update.
    trust_radius: Rate = Field(description="largest change of an action that one update aims at")
    # Weight that holds actions where they are; the larger, the less small gradients move them.
    anchor: Positive = Field(
        description="weight that holds an action in place; the larger, the less small gradients move it"
    )
    n_epochs: int = Field(ge=1, le=1000, description="passes of an update over the tried decisions")
    batch_size: int = Field(ge=2, description=BATCH_SIZE)
    averaging: Averaging = Field(description=AVERAGING)
    # Share of the tried decisions that are drawn in proportion to the gradient that a small network expects there.
    focus: Focus = Field(
        0.0, description="share of the tried decisions drawn where a small network expects large gradients"
    )
    network: ActorShape = Field(description=NETWORK)
    experts: Annotated[ExpertsPlan | None, Field(exclude_if=not_)] = Field(
        None, description="mixture of experts: several networks and a gating network; left out: one network"
    )

    @field_validator("start", mode="wrap")
    @classmethod
    def _names_a_policy(cls, value: Any, check: Callable[[Any], Any]) -> Any:
        try:
            start = check(value)
        except ValidationError as error:
            if error.errors()[0]["type"] != "string_pattern_mismatch":
                raise
            raise ValueError(_RIGHT_START) from None
        name, _, path = (start or "").partition("@")
        refuse_shipped_path(path, name)
        return start

    @field_validator("gradient_limit", mode="wrap")
    @classmethod
    def _automatic_or_fixed(cls, value: Any, check: Callable[[Any], Any]) -> Any:
        with suppress(ValueError):
            return check(value)
        raise ValueError("must be auto or a finite number above 0")

    @model_validator(mode="after")
    def _keys_fit(self) -> VineRecipe:
        if self.reward.shaping > 0.0:
            refuse(("reward", "shaping"), self.reward.shaping, NO_SHAPING)
        visited = self.n_envs * self.n_steps
        if not self.tried <= visited:
            refuse(("tried",), self.tried, f"must be at most n_envs x n_steps = {visited}")
        return self

    def network_spec(self, observation_size: int) -> NetworkSpec:
        """Return the description of the network in a policy bundle: an actor, or several actors and a gating network.

        ``observation_size`` is the number of features of an observation.
        """
        plan = self.experts
        mixture = {} if plan is None else {"networks": plan.networks, "gate_hidden": plan.gating}
        return self.network.spec(observation_size, **mixture)

    def policy_to_start_from(self, scenario: Scenario) -> str | None:
        """Return the spec of the policy whose weights a training on ``scenario`` begins with.

        For instance ``ppo-obstacle`` or ``ppo@runs/x``; None: random weights.
        """
        if self.start is None or "@" in self.start:
            return self.start
        names = [self.start, *(name for name in shipped_policies() if name.startswith(f"{self.start}-"))]
        return next((name for name in names if load_shipped(name).manifest.scenario.get("name") == scenario.name), None)

    def begins(self, scenario: Scenario) -> str:
        """Return a phrase about the initial weights, for messages.

        It is the spec of a policy, such as ``ppo``, or ``random weights`` with the reason.
        """
        why = "" if self.start is None else f", as no {self.start} ships for scenario {scenario.name!r}"
        return self.policy_to_start_from(scenario) or f"random weights{why}"

    def check_learners(self, learners: int) -> None:
        """Raise ``InvalidInput`` for a mixture of experts with several learners; it is for one learner only."""
        if self.experts is not None and learners != 1:
            raise InvalidInput(
                f"recipe {self.name!r}: experts: a mixture is for one learner, not for {learners}; leave experts out"
            )


VINE = Part(VineRecipe, "ethbrake_marl.extensions.learners.vine:Vine")

VINE_AGENT = Part(
    make_policy_agent, form="vine@PATH", about="a policy trained by vine: a run or a bundle", knows=Source.MESSAGES
)
