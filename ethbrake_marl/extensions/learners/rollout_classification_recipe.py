"""The recipe of the algorithm ``rollout-classification``."""

from __future__ import annotations

from functools import cached_property
from operator import not_
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from ethbrake_marl.agents.protocol import Source
from ethbrake_marl.errors import InvalidInput, refuse_shipped_path
from ethbrake_marl.extensions.learners.recipe_keys import AVERAGING, NO_SHAPING, Averaging, Focus, Holds, OffsetRange
from ethbrake_marl.files.model import refuse
from ethbrake_marl.policies.bundle import load_policy
from ethbrake_marl.policies.network_spec import Activation, NetworkSpec
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.policies.shipped import load_shipped
from ethbrake_marl.registry import Part
from ethbrake_marl.training.agents import make_policy_agent
from ethbrake_marl.training.recipe import ACTOR_LAYERS, Layers, NonNegative, Positive, Shape, TrainingRecipe
from ethbrake_marl.training.recipes import BATCH_SIZE, NETWORK


class ChoosingShape(Shape):
    """Hidden layers of an actor that scores a number of actions, spread evenly from -1 to 1."""

    policy: Layers = Field(description=ACTOR_LAYERS)
    activation: Activation = "relu"  # activation function of the hidden layers
    choices: int = Field(
        ge=2, le=4096, description="number of actions that the network scores, evenly spaced from -1 to 1"
    )

    def spec(self, observation_size: int, **more: Any) -> NetworkSpec:
        """Return the description of the network in a policy bundle: an actor that takes the action of highest score.

        ``observation_size`` is the number of features of an observation; ``more`` are other fields of ``NetworkSpec``.
        """
        return super().spec(observation_size, output="choice", choices=self.choices, **more)


PolicyName = Annotated[str, Field(pattern=r"^[a-z-]+(@.+)?$", max_length=4096)]


class RolloutClassificationRecipe(TrainingRecipe):
    """Recipe of rollout classification: the policy learns from several actions, each tried to the end of its episode.

    It learns to choose between ``network.choices`` actions, spread evenly from -1 to 1, and the ``policies``. In
    a round (``n_envs x n_steps`` decisions, then an update), ``tried`` of the decisions are tried with: the action that
    the policy takes; one below and one above it for each distance of ``near``; the actions ``fixed``; and ``drawn``
    random ones (policies if there are any, else actions). The *cost* of an action is minus the return after it.
    """

    most_decisions = 2**22

    algorithm: Literal["rollout-classification"]
    # Trained policies that the network can choose instead of an action. A policy that itself chooses between policies
    # is replaced by these.
    policies: Annotated[tuple[PolicyName, ...], Field(strict=False, max_length=16, exclude_if=not_)] = Field(
        (), description="trained policies, one of which can be chosen to act at a decision; left out: none"
    )
    # Number of consecutive decisions in each world between two updates.
    n_steps: int = Field(ge=1, description="decisions of each world between two updates")
    tried: int = Field(ge=1, description="decisions of a round that are tried with other actions")
    # Ranges of distances; from each, one is drawn, and the actions this far below and above the taken one are tried.
    near: Annotated[tuple[OffsetRange, ...], Field(strict=False, max_length=8)] = Field(
        description="ranges of distances, drawn uniformly in the logarithm; the actions this far below and above the"
        " policy's are tried"
    )
    # Actions that are tried at every such decision; each is rounded to the nearest of the ``choices`` of the network.
    fixed: Annotated[tuple[Annotated[float, Field(ge=-1.0, le=1.0)], ...], Field(strict=False, max_length=16)] = Field(
        description="actions tried at each of these decisions, -1 (full braking) to 1; rounded to the network's choices"
    )
    # Number of random choices that are tried: ``policies``, or actions if there are none.
    drawn: int = Field(
        ge=0, le=16, description="number of random choices tried as well: policies, or actions if there are none"
    )
    # Numbers of steps, one of which is drawn at each decision; a tried action is held for so long.
    holds: Holds = Field(description="numbers of steps, one of which is drawn; a tried action is held for so long")
    # Upper limit of an action's extra cost over the best tried action, so that rare large costs do not dominate.
    largest_cost: Positive = Field(
        description="largest extra cost of an action over the best one; larger ones are cut to it"
    )
    # Factor, growing from 0 to this value during the training, of an additional cost: by how much more an action costs
    # than braking fully from this decision on.
    caution: float = Field(
        0.0,
        ge=0.0,
        allow_inf_nan=False,
        exclude_if=not_,
        description="weight of an action's extra cost over full braking from there on; grows from 0 to this at the end",
    )
    # Weight, in the cost, of the line's harm under the count that the reward does not use (first impacts or all).
    tie_break: float = Field(
        0.0,
        ge=0.0,
        allow_inf_nan=False,
        exclude_if=not_,
        description="weight of the line's harm in the count that the reward does not use",
    )
    # Whether costs are divided by the mean cost in the same scenario of a mixture, so that all scenarios count alike.
    relative: bool = Field(
        False,
        exclude_if=not_,
        description="true: in a mixture, costs are divided by the mean cost in the same scenario",
    )
    # Share of the decisions to learn from that are drawn in proportion to how much the tried actions differ in cost.
    focus: Focus = Field(
        0.0, description="share of the decisions to learn from that are drawn where the costs differ most"
    )
    # Weight of a convex term in the loss, which keeps gradients alive where the policy is nearly certain.
    guide: NonNegative = Field(
        description="weight of the convex part of the loss, without which learning can stall at the beginning"
    )
    # Number of decisions in memory, from which the network learns: the latest with a difference between the costs.
    memory: int = Field(
        ge=1, le=500_000, description="decisions to learn from: the last ones at which the tried actions differ in cost"
    )
    gradient_steps: int = Field(ge=1, le=100_000, description="steps of the optimiser in one update")
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
            refuse(("memory",), self.memory, f"must be at least tried = {self.tried}")
        if not self.others:
            refuse(("near",), list(self.near), "must hold a range if there are neither fixed nor drawn actions")
        return self

    @property
    def others(self) -> int:
        """Number of actions that are tried in addition to the action that the policy takes."""
        return 2 * len(self.near) + len(self.fixed) + self.drawn

    def network_spec(self, observation_size: int) -> NetworkSpec:
        """Return the description of the network in a policy bundle, including the policies that it may choose.

        ``observation_size`` is the number of features of an observation.
        """
        several = {"observation_size": observation_size, "value_hidden": ()}
        networks = tuple(each.manifest.network.model_copy(update=several) for each in self.loaded_policies)
        return self.network.spec(observation_size, among=networks)

    @cached_property
    def loaded_policies(self) -> tuple[Policy, ...]:
        """The policies that the key ``policies`` names, loaded once.

        A policy that itself chooses between policies is replaced by these.

        Raises ``InvalidInput`` with the name of a policy that cannot be used.
        """
        loaded: list[Policy] = []
        for name in self.policies:
            kind, _, path = name.partition("@")
            refuse_shipped_path(path, kind)
            policy = load_policy(path) if path else load_shipped(kind)
            by = policy.manifest.algorithm
            if path and kind not in ("policy", by):
                raise InvalidInput(f"recipe {self.name!r}: policies: {name}: must be {by}@{path}")
            loaded += policy.among or [policy]
        if loaded and not self.drawn <= len(loaded):
            raise InvalidInput(
                f"recipe {self.name!r}: drawn = {self.drawn}: must be at most the number of policies, {len(loaded)}"
            )
        return tuple(loaded)


ROLLOUT_CLASSIFICATION = Part(
    RolloutClassificationRecipe, "ethbrake_marl.extensions.learners.rollout_classification:RolloutClassification"
)

ROLLOUT_CLASSIFICATION_AGENT = Part(
    make_policy_agent,
    form="rollout-classification@PATH",
    about="a policy trained by rollout classification: a run or a bundle",
    knows=Source.MESSAGES,
)
