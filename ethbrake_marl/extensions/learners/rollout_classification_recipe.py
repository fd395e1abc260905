"""Recipe of the algorithm ``rollout-classification``."""

from __future__ import annotations

from functools import cached_property
from operator import not_
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from ethbrake_marl.errors import InvalidInput, refuse_shipped_path
from ethbrake_marl.extensions.learners.recipe_keys import AVERAGING, NO_SHAPING, Averaging, Focus, Holds, OffsetRange
from ethbrake_marl.files.model import refuse
from ethbrake_marl.first_edition.agents.protocol import Source
from ethbrake_marl.first_edition.policies.bundle import load_policy
from ethbrake_marl.first_edition.policies.network_spec import Activation, NetworkSpec
from ethbrake_marl.first_edition.policies.policy import Policy
from ethbrake_marl.first_edition.policies.shipped import load_shipped
from ethbrake_marl.first_edition.training.agents import make_policy_agent
from ethbrake_marl.first_edition.training.recipe import (
    ACTOR_LAYERS,
    Layers,
    NonNegative,
    Positive,
    Shape,
    TrainingRecipe,
)
from ethbrake_marl.first_edition.training.recipes import BATCH_SIZE, NETWORK
from ethbrake_marl.registry import Part


class ChoosingShape(Shape):
    """Network that gives each of several actions a score. The actions are evenly spaced from -1 to 1."""

    policy: Layers = Field(description=ACTOR_LAYERS)
    activation: Activation = "relu"  # activation function of the hidden layers
    choices: int = Field(
        ge=2, le=4096, description="number of actions that the network scores, evenly spaced from -1 to 1"
    )

    def spec(self, observation_size: int, **more: Any) -> NetworkSpec:
        """Return the description of the network, for a policy bundle; ``more`` are values of further fields."""
        return super().spec(observation_size, output="choice", choices=self.choices, **more)


PolicyName = Annotated[str, Field(pattern=r"^[a-z-]+(@.+)?$", max_length=4096)]


class RolloutClassificationRecipe(TrainingRecipe):
    """Recipe of rollout classification: at some decisions several actions are tried, and after each tried action the
    episode is simulated to its end.

    At each decision the policy chooses one of ``network.choices`` actions, evenly spaced from -1 to 1, or one of the
    trained ``policies``. A round of the training run consists of ``n_envs x n_steps`` decisions and an update of the
    network. At ``tried`` decisions of a round, the following choices are tried:

    - the choice of the policy itself;
    - for each range of ``near``, one action below and one action above the action of the policy;
    - the actions ``fixed``;
    - ``drawn`` random choices: trained policies if the recipe has the key ``policies``, else actions.

    The *cost* of a choice is minus the return from the decision to the end of the episode.
    """

    most_decisions = 2**22

    algorithm: Literal["rollout-classification"]
    policies: Annotated[tuple[PolicyName, ...], Field(strict=False, max_length=16, exclude_if=not_)] = Field(
        (), description="trained policies; at a decision the network can let one of them act; left out: none"
    )
    n_steps: int = Field(ge=1, description="number of decisions in each world between two updates")
    tried: int = Field(ge=1, description="number of decisions per update at which several actions are tried")
    near: Annotated[tuple[OffsetRange, ...], Field(strict=False, max_length=8)] = Field(
        description="ranges of distances; from each range one distance is drawn, and the actions this far below and"
        " above the policy's action are tried"
    )
    fixed: Annotated[tuple[Annotated[float, Field(ge=-1.0, le=1.0)], ...], Field(strict=False, max_length=16)] = Field(
        description="actions that are always tried, -1 (full braking) to 1; rounded to the nearest choice of the"
        " network"
    )
    drawn: int = Field(
        ge=0,
        le=16,
        description="number of choices that are drawn at random and tried: policies if the key policies is"
        " set, otherwise actions",
    )
    holds: Holds = Field(description="numbers of time steps for which a tried action may last; one of them is drawn")
    largest_cost: Positive = Field(
        description="limit of an action's extra cost (its cost minus the best tried action's cost); a larger extra cost"
        " is cut to this limit"
    )
    caution: float = Field(
        0.0,
        ge=0.0,
        allow_inf_nan=False,
        exclude_if=not_,
        description="weight of a further cost, which is the action's cost minus the cost of full braking to the end of"
        " the episode, if positive; the weight grows from 0 to this value during the training",
    )
    tie_break: float = Field(
        0.0,
        ge=0.0,
        allow_inf_nan=False,
        exclude_if=not_,
        description="weight, in the cost, of the harm count (first or total) that the reward does not use",
    )
    relative: bool = Field(
        False,
        exclude_if=not_,
        description="true: in a mixture of scenarios, a cost is divided by the mean cost in its scenario",
    )
    focus: Focus = Field(
        0.0, description="share of the training decisions that are drawn in proportion to their largest extra cost"
    )
    guide: NonNegative = Field(
        description="weight of the convex term of the loss; without it learning can stall at the beginning"
    )
    memory: int = Field(
        ge=1,
        le=500_000,
        description="number of decisions in memory, from which the network learns: the latest decisions at which the"
        " tried actions differ in cost",
    )
    gradient_steps: int = Field(ge=1, le=100_000, description="number of steps of the optimiser in one update")
    batch_size: int = Field(ge=2, description=BATCH_SIZE)
    averaging: Averaging = Field(description=AVERAGING)
    network: ChoosingShape = Field(description=NETWORK)

    @model_validator(mode="after")
    def _keys_fit(self) -> RolloutClassificationRecipe:
        if self.reward.shaping > 0.0:
            refuse(("reward", "shaping"), self.reward.shaping, NO_SHAPING)
        visited = self.n_envs * self.n_steps
        if not self.tried <= visited:
            refuse(("tried",), self.tried, f"must be at most n_envs x n_steps = {visited}")
        if not self.memory >= self.tried:
            refuse(("memory",), self.memory, f"must be at least tried, which is {self.tried}")
        if not self.others:
            refuse(("near",), list(self.near), "must contain a range, because the recipe has no fixed or drawn actions")
        return self

    @property
    def others(self) -> int:
        """Number of choices, other than the policy's own choice, that are tried at a decision."""
        return 2 * len(self.near) + len(self.fixed) + self.drawn

    def network_spec(self, observation_size: int) -> NetworkSpec:
        """Return the description of the network, and of the policies that it can choose, for a policy bundle."""
        several = {"observation_size": observation_size, "value_hidden": ()}
        networks = tuple(each.manifest.network.model_copy(update=several) for each in self.loaded_policies)
        return self.network.spec(observation_size, among=networks)

    @cached_property
    def loaded_policies(self) -> tuple[Policy, ...]:
        """The trained policies that the key ``policies`` names.

        If a named policy itself chooses among several policies, these policies take the place of the named policy.

        Raises ``InvalidInput`` if a policy cannot be used.
        """
        loaded: list[Policy] = []
        for name in self.policies:
            kind, _, path = name.partition("@")
            refuse_shipped_path(path, kind)
            policy = load_policy(path) if path else load_shipped(kind)
            by = policy.manifest.algorithm
            if path and kind not in ("policy", by):
                raise InvalidInput(
                    f"recipe {self.name!r}: policies: {name}: this policy was trained by {by}; write {by}@{path}"
                )
            loaded += policy.among or [policy]
        if loaded and not self.drawn <= len(loaded):
            raise InvalidInput(
                f"recipe {self.name!r}: drawn = {self.drawn}: drawn must be at most {len(loaded)}, the number of"
                " policies"
            )
        return tuple(loaded)


ROLLOUT_CLASSIFICATION = Part(
    RolloutClassificationRecipe, "ethbrake_marl.extensions.learners.rollout_classification:RolloutClassification"
)

ROLLOUT_CLASSIFICATION_AGENT = Part(
    make_policy_agent,
    form="rollout-classification@PATH",
    about="a policy trained by rollout classification; PATH is a run or a bundle",
    knows=Source.MESSAGES,
)
