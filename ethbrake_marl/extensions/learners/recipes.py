"""The recipes of the extension's algorithms."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import cached_property
from operator import not_
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationInfo, field_validator, model_validator

from ethbrake_marl.agents.protocol import Source
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.model import FileModel, refuse
from ethbrake_marl.policies.manifest import Activation, NetworkSpec
from ethbrake_marl.policies.network import Policy
from ethbrake_marl.policies.shipped import SHIPPED, load_named_policy
from ethbrake_marl.registry import Part
from ethbrake_marl.training.agents import make_policy_agent
from ethbrake_marl.training.recipe import (
    Averaging,
    Fraction,
    Layers,
    NonNegative,
    Positive,
    Rate,
    Shape,
    TrainingRecipe,
)


class ActorShape(Shape):
    """Hidden layers of the actor, where there is no critic."""

    policy: Layers
    activation: Activation = "relu"
    initial_action: Annotated[float | None, Field(ge=-1.0, le=1.0, exclude_if=lambda v: v is None)] = (
        None  # at first; None: 0
    )


class ChoosingShape(Shape):
    """Hidden layers of an actor that scores a number of actions, evenly from -1 to 1."""

    policy: Layers
    activation: Activation = "relu"
    choices: Annotated[int, Field(ge=2, le=4096)]

    def spec(self, observation_size: int, **more: Any) -> NetworkSpec:
        """The actor, which takes the action of the highest score."""
        return super().spec(observation_size, output="choice", choices=self.choices, **more)


class OffsetRange(FileModel):
    """How far an action is moved to see what comes of it; the logarithm of what is drawn is uniform."""

    smallest: Rate
    largest: Rate

    @field_validator("largest")
    @classmethod
    def _in_order(cls, value: float, info: ValidationInfo) -> float:
        if "smallest" in info.data and not value >= info.data["smallest"]:
            raise ValueError(f"must be at least smallest = {info.data['smallest']:g}")
        return value


class Shares(FileModel):
    """Of all updates, the share of each stage; together they are 1."""

    alone: Fraction  # the first network, in all worlds
    further: Fraction  # each of the others in the worlds of its own mode, one after the other
    gate: Fraction  # the gate between them
    together: Fraction  # all networks and the gate, each network where the gate chooses it

    @model_validator(mode="after")
    def _everything(self) -> Shares:
        total = self.alone + self.further + self.gate + self.together
        if not abs(total - 1.0) <= 1e-9:
            raise ValueError(f"alone, further, gate and together are {total:g} in all; must be 1")
        return self


class ModesPlan(FileModel):
    """How many networks, how the worlds of each further one are found, and how the gate between them learns."""

    networks: Annotated[int, Field(ge=2, le=16)]
    gate: Layers  # hidden layers
    worlds: Annotated[int, Field(ge=1, le=1_000_000)]  # in which a mode is looked for
    templates: Annotated[int, Field(ge=1, le=100_000)]  # drawn in each of them
    gain: NonNegative  # return by which a template must be better than all networks before to be imitated
    margin: Positive  # return by which a network may be worse than those before in a world of its own
    imitation_epochs: Annotated[int, Field(ge=1, le=1000)]
    gate_states: Annotated[int, Field(ge=1, le=1_000_000)]  # in each update, at which networks are compared
    gate_memory: Annotated[int, Field(ge=1, le=1_000_000)]  # of them that are remembered
    gate_steps: Annotated[int, Field(ge=1, le=100_000)]  # of its optimiser in each update
    tie_break: NonNegative  # of the harm by the other count, added to minus the return when networks are compared
    together_rate: Rate  # share of the learning rate in the last stage
    shares: Shares


Steps = Annotated[int, Field(ge=1, le=1000)]

_NO_SHAPING = "must be 0: what is tried is played to the end, where shaping tells nothing more"

Focus = Annotated[float, Field(ge=0.0, le=0.99, exclude_if=not_)]

PolicyName = Annotated[str, Field(pattern=r"^[a-z]+@.+$", max_length=4096)]


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
            refuse(("reward", "shaping"), self.reward.shaping, _NO_SHAPING)
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


class OptionsRecipe(TrainingRecipe):
    """Try ``tried`` of the ``n_envs x n_steps`` decisions of a round with several actions each; learn to choose.

    The actions of the policy are ``network.choices``, evenly from -1 to 1, and those of the policies ``among`` which it
    chooses too. Tried are the one that it takes, one below and one above it in each of the distances ``near``, the
    actions ``fixed``, and ``drawn`` ones: of the policies, or of the actions where there are none.
    """

    most_decisions = 2**22

    algorithm: Literal["options"]
    among: Annotated[tuple[PolicyName, ...], Field(strict=False, max_length=16, exclude_if=not_)] = ()
    n_steps: Annotated[int, Field(ge=1)]
    tried: Annotated[int, Field(ge=1)]
    near: Annotated[tuple[OffsetRange, ...], Field(strict=False, max_length=8)]
    fixed: Annotated[tuple[Annotated[float, Field(ge=-1.0, le=1.0)], ...], Field(strict=False, max_length=16)]
    drawn: Annotated[int, Field(ge=0, le=16)]
    holds: Annotated[tuple[Steps, ...], Field(strict=False, min_length=1, max_length=16)]
    largest_cost: Positive
    caution: Annotated[float, Field(ge=0.0, allow_inf_nan=False, exclude_if=not_)] = 0.0
    tie_break: Annotated[float, Field(ge=0.0, allow_inf_nan=False, exclude_if=not_)] = 0.0
    relative: Annotated[bool, Field(exclude_if=not_)] = False
    focus: Focus = 0.0  # share of what is learned from that is drawn by what there is to lose
    guide: NonNegative
    memory: Annotated[int, Field(ge=1, le=500_000)]
    gradient_steps: Annotated[int, Field(ge=1, le=100_000)]
    batch_size: Annotated[int, Field(ge=2)]
    averaging: Averaging
    network: ChoosingShape

    @model_validator(mode="after")
    def _keys_fit(self) -> OptionsRecipe:
        if self.reward.shaping > 0.0:
            refuse(("reward", "shaping"), self.reward.shaping, _NO_SHAPING)
        visited = self.n_envs * self.n_steps
        if not self.tried <= visited:
            refuse(("tried",), self.tried, f"must be at most n_envs x n_steps = {visited}")
        if not self.memory >= self.tried:
            refuse(("memory",), self.memory, f"must be at least tried = {self.tried}")
        if not self.others:
            refuse(("near",), list(self.near), "must hold a range where there are neither fixed nor drawn actions")
        return self

    @property
    def others(self) -> int:
        """How many actions are tried beside the one that the policy takes."""
        return 2 * len(self.near) + len(self.fixed) + self.drawn

    def network_spec(self, observation_size: int) -> NetworkSpec:
        """The actor, with the policies among which it chooses."""
        several = {"observation_size": observation_size, "value_hidden": ()}
        among = tuple(each.manifest.network.model_copy(update=several) for each in self.policies)
        return self.network.spec(observation_size, among=among)

    @cached_property
    def policies(self) -> tuple[Policy, ...]:
        """Those among which it chooses, read once; raises ``InvalidInput`` naming one that cannot be taken.

        One that itself chooses among policies stands for those.
        """
        found: list[Policy] = []
        for name in self.among:
            kind, _, path = name.partition("@")
            policy = load_named_policy(path)
            where, by = f"recipe {self.name!r}: among: {name}", policy.manifest.algorithm
            if path == SHIPPED or kind not in ("policy", by):
                raise InvalidInput(f"{where}: give policy@shipped/NAME, or {by}@ and its path")
            found += policy.among or [policy]
        if found and not self.drawn <= len(found):
            raise InvalidInput(f"recipe {self.name!r}: drawn = {self.drawn}: must be at most the {len(found)} of among")
        return tuple(found)


COUNTERFACTUAL = Part(CounterfactualRecipe, "ethbrake_marl.extensions.learners.vine:Counterfactual")

OPTIONS = Part(OptionsRecipe, "ethbrake_marl.extensions.learners.rollout_classification:Options")

COUNTERFACTUAL_AGENT = Part(
    make_policy_agent,
    form="counterfactual@PATH",
    about="a policy trained by counterfactuals: a run or a bundle",
    knows=Source.MESSAGES,
)

OPTIONS_AGENT = Part(
    make_policy_agent,
    form="options@PATH",
    about="a policy trained by options: a run, a bundle, or shipped",
    knows=Source.MESSAGES,
)
