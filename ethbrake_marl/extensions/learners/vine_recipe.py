"""Recipe of the algorithm ``vine``."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from operator import not_
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, field_validator, model_validator

from ethbrake_marl.errors import InvalidInput, refuse_shipped_path
from ethbrake_marl.extensions.learners.mixture_plan import ExpertsPlan
from ethbrake_marl.extensions.learners.recipe_keys import AVERAGING, NO_SHAPING, Averaging, Focus, Holds, OffsetRange
from ethbrake_marl.files.model import refuse
from ethbrake_marl.first_edition.agents.protocol import Source
from ethbrake_marl.first_edition.policies.network_spec import Activation, NetworkSpec
from ethbrake_marl.first_edition.policies.shipped import load_shipped, shipped_policies
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.training.agents import make_policy_agent
from ethbrake_marl.first_edition.training.recipe import ACTOR_LAYERS, Layers, Positive, Rate, Shape, TrainingRecipe
from ethbrake_marl.first_edition.training.recipes import BATCH_SIZE, NETWORK
from ethbrake_marl.registry import Part

_RIGHT_START = "must be the name of a shipped policy, for instance ppo, or ppo@PATH or vine@PATH of a trained policy"


class ActorShape(Shape):
    """Description of the actor's network. The algorithm vine has no critic."""

    policy: Layers = Field(description=ACTOR_LAYERS)
    activation: Activation = "relu"  # activation function of the hidden layers
    initial_action: Annotated[float | None, Field(ge=-1.0, le=1.0, exclude_if=lambda v: v is None)] = Field(
        None, description="approximate action of the untrained network, -1 to 1; left out: 0, which coasts"
    )


class VineRecipe(TrainingRecipe):
    """Recipe of vine: at some decisions, a higher and a lower action are tried, and each is simulated to the end of the
    episode.

    A round of the training run has ``n_envs x n_steps`` decisions. At ``tried`` decisions of a round, a higher and a
    lower action are tried. The policy learns from the difference between the two returns.

    ``start`` names a trained policy, whose weights are the initial weights; without this key, the initial weights are
    random. ``start: ppo`` means the shipped policy ``ppo`` or ``ppo-...`` that was trained on the scenario of this
    training run. If there is no such shipped policy, the initial weights are random.
    """

    most_decisions = 2**22

    algorithm: Literal["vine"]
    start: Annotated[str, Field(pattern=r"^((ppo|vine)@.+|[a-z-]+)$", max_length=4096)] | None = Field(
        None,
        description="policy to start from, ppo or ppo@PATH; ppo: the shipped policy that was trained on this scenario,"
        " or random weights if no such policy is shipped; left out: random weights",
    )
    n_steps: int = Field(ge=1, description="number of decisions in each world between two updates")
    tried: int = Field(
        ge=1, description="number of decisions per update at which a higher and a lower action are tried"
    )
    offset: OffsetRange = Field(description="range of the offset between a tried action and the policy's action")
    holds: Holds = Field(description="numbers of time steps for which a tried offset may last; one of them is drawn")
    gradient_limit: Positive | Literal["auto"] = Field(
        description="largest gradient (return per unit of action); a larger gradient is cut to this limit; auto: the"
        " limit is computed from measured gradients"
    )
    trust_radius: Rate = Field(description="largest distance, in one update, between an action and its target")
    anchor: Positive = Field(
        description="weight that holds actions at their value; with a larger weight, small gradients change them less"
    )
    n_epochs: int = Field(ge=1, le=1000, description="number of passes of each update over the tried decisions")
    batch_size: int = Field(ge=2, description=BATCH_SIZE)
    averaging: Averaging = Field(description=AVERAGING)
    focus: Focus = Field(
        0.0,
        description="share of the tried decisions that are drawn in proportion to the gradient that a small network"
        " predicts",
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
        raise ValueError("must be 'auto' or a finite number above 0")

    @model_validator(mode="after")
    def _keys_fit(self) -> VineRecipe:
        if self.reward.shaping > 0.0:
            refuse(("reward", "shaping"), self.reward.shaping, NO_SHAPING)
        visited = self.n_envs * self.n_steps
        if not self.tried <= visited:
            refuse(("tried",), self.tried, f"must be at most n_envs x n_steps = {visited}")
        return self

    def network_spec(self, observation_size: int) -> NetworkSpec:
        """Return the network's description for a policy bundle: an actor, or several actors and a gating network."""
        plan = self.experts
        mixture = {} if plan is None else {"networks": plan.networks, "gate_hidden": plan.gating}
        return self.network.spec(observation_size, **mixture)

    def policy_to_start_from(self, scenario: Scenario) -> str | None:
        """Return the policy with the initial weights for ``scenario``; None: the initial weights are random.

        The policy is a text such as ``ppo-obstacle`` or ``ppo@runs/x``.
        """
        if self.start is None or "@" in self.start:
            return self.start
        names = [self.start, *(name for name in shipped_policies() if name.startswith(f"{self.start}-"))]
        return next((name for name in names if load_shipped(name).manifest.scenario.get("name") == scenario.name), None)

    def begins(self, scenario: Scenario) -> str:
        """Return the origin of the initial weights for messages: a policy such as ``ppo``, or ``random weights``.

        If the policy that ``start`` names is not shipped for ``scenario``, the text gives this reason.
        """
        why = "" if self.start is None else f", because no {self.start} is shipped for scenario {scenario.name!r}"
        return self.policy_to_start_from(scenario) or f"random weights{why}"

    def check_learners(self, learners: int) -> None:
        """Raise ``InvalidInput`` if the recipe has a mixture of experts but the training run has several learners."""
        if self.experts is not None and learners != 1:
            raise InvalidInput(
                f"recipe {self.name!r}: experts: a mixture of experts can drive only one learner, but the scenario has"
                f" {learners} learners; leave out experts"
            )


VINE = Part(VineRecipe, "ethbrake_marl.extensions.learners.vine:Vine")

VINE_AGENT = Part(
    make_policy_agent,
    form="vine@PATH",
    about="a policy trained by vine; PATH is a run or a bundle",
    knows=Source.MESSAGES,
)
