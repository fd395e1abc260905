"""The recipe of ``vine`` (``algorithm: counterfactual``)."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from operator import not_
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, field_validator, model_validator

from ethbrake_marl.agents.protocol import Source
from ethbrake_marl.errors import InvalidInput, refuse_shipped_path
from ethbrake_marl.extensions.learners.mixture_plan import ModesPlan
from ethbrake_marl.extensions.learners.recipe_keys import AVERAGING, NO_SHAPING, Averaging, Focus, Holds, OffsetRange
from ethbrake_marl.files.model import refuse
from ethbrake_marl.policies.network_spec import Activation, NetworkSpec
from ethbrake_marl.policies.shipped import load_shipped, shipped_policies
from ethbrake_marl.registry import Part
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.training.agents import make_policy_agent
from ethbrake_marl.training.recipe import ACTOR_LAYERS, Layers, Positive, Rate, Shape, TrainingRecipe
from ethbrake_marl.training.recipes import BATCH_SIZE, NETWORK

_RIGHT_START = "must be the name of a shipped policy, for instance ppo, or ppo@ or counterfactual@ and the path of one"


class ActorShape(Shape):
    """Hidden layers of an actor without a critic."""

    policy: Layers = Field(description=ACTOR_LAYERS)
    activation: Activation = "relu"  # activation function of the hidden layers
    initial_action: Annotated[float | None, Field(ge=-1.0, le=1.0, exclude_if=lambda v: v is None)] = Field(
        None, description="about what the network does at first, [-1, 1]; left out: 0, which coasts"
    )


class CounterfactualRecipe(TrainingRecipe):
    """Recipe of vine: some decisions are tried with a higher and a lower action, each to the end of its episode.

    A round has ``n_envs x n_steps`` decisions; ``counterfactuals`` of them are tried. The policy learns from the
    differences of the returns. ``start`` names a trained policy to continue from; without it the weights are random.
    ``start: ppo`` means the shipped policy ``ppo`` or ``ppo-...`` that was trained on the scenario of this training; if
    there is none, the weights are random.
    """

    most_decisions = 2**22

    algorithm: Literal["counterfactual"]
    start: Annotated[str, Field(pattern=r"^((ppo|counterfactual)@.+|[a-z-]+)$", max_length=4096)] | None = Field(
        None,
        description="a policy to continue from, ppo or ppo@PATH; ppo: the shipped policy that was trained on this"
        " scenario, or random weights if there is none; left out: random weights",
    )
    n_steps: int = Field(ge=1, description="decisions of each world between two updates")
    counterfactuals: int = Field(ge=1, description="how many of the decisions of a round are tried in two ways")
    offset: OffsetRange = Field(
        description="how far an action is moved to see what comes of it; the logarithm of what is drawn is uniform"
    )
    holds: Holds = Field(description="for how many steps an action is tried, one of these")
    # Largest size of a measured gradient (return per unit of action); larger ones, at jumps of the harm, are cut to it.
    gradient_limit: Positive | Literal["auto"] = Field(
        description="a larger gradient, at a jump, counts as this one; return per action; auto: as measured"
    )
    # Largest distance from an action to the target that it is trained towards in one update.
    trust_radius: Rate = Field(description="farthest that one update asks an action to move")
    # Weight that holds actions where they are; the larger, the less small gradients move them.
    anchor: Positive = Field(description="how much an action that makes no difference holds to where it is")
    n_epochs: int = Field(ge=1, le=1000, description="how often an update goes through what was collected")
    batch_size: int = Field(ge=2, description=BATCH_SIZE)
    averaging: Averaging = Field(description=AVERAGING)
    # Share of the tried decisions that are drawn in proportion to the gradient that a small network expects there.
    focus: Focus = Field(0.0, description="share of what is tried that a scout draws, where a choice matters most")
    network: ActorShape = Field(description=NETWORK)
    modes: Annotated[ModesPlan | None, Field(exclude_if=not_)] = Field(
        None, description="several networks and a gate between them; left out: one network"
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
    def _keys_fit(self) -> CounterfactualRecipe:
        if self.reward.shaping > 0.0:
            refuse(("reward", "shaping"), self.reward.shaping, NO_SHAPING)
        visited = self.n_envs * self.n_steps
        if not self.counterfactuals <= visited:
            refuse(("counterfactuals",), self.counterfactuals, f"must be at most n_envs x n_steps = {visited}")
        return self

    def network_spec(self, observation_size: int) -> NetworkSpec:
        """Return the description of the network in a policy bundle: an actor, or several actors and a gate.

        ``observation_size`` is the number of features of an observation.
        """
        modes = self.modes
        several = {} if modes is None else {"networks": modes.networks, "gate_hidden": modes.gate}
        return self.network.spec(observation_size, **several)

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
        """Raise ``InvalidInput`` for several networks with several learners; the gate serves one learner only."""
        if self.modes is not None and learners != 1:
            raise InvalidInput(f"recipe {self.name!r}: modes: are for one learner, not for {learners}; leave modes out")


COUNTERFACTUAL = Part(CounterfactualRecipe, "ethbrake_marl.extensions.learners.vine:Counterfactual")

COUNTERFACTUAL_AGENT = Part(
    make_policy_agent,
    form="counterfactual@PATH",
    about="a policy trained by counterfactuals: a run or a bundle",
    knows=Source.MESSAGES,
)
