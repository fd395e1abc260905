"""The recipe of ``vine``: keys, limits, and what they mean."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator

from ethbrake_marl.agents.trained import make_trained
from ethbrake_marl.episode.layer import MESSAGES
from ethbrake_marl.files.model import FileModel, Positive, refuse
from ethbrake_marl.policies.network import Activation
from ethbrake_marl.registry import Part
from ethbrake_marl.training.recipe import ACTOR_LAYERS, BATCH_SIZE, NETWORK, LayerSizes, Rate, TrainingRecipe

MOST_DECISIONS = 2**22  # of one update whose states fit into memory

Text = Annotated[str, Field(max_length=4096)]
Action = Annotated[float, Field(ge=-1.0, le=1.0)]
Steps = Annotated[tuple[Annotated[int, Field(ge=1, le=1000)], ...], Field(strict=False, min_length=1, max_length=16)]


class Range(FileModel):
    """Range of a distance between two actions. The logarithm of the distance is drawn uniformly."""

    smallest: Rate
    largest: Rate

    @field_validator("largest")
    @classmethod
    def _in_order(cls, value: float, info: ValidationInfo) -> float:
        if "smallest" in info.data and not value >= info.data["smallest"]:
            raise ValueError(f"must be at least the value of the key smallest, {info.data['smallest']:g}")
        return value


class ActorShape(FileModel):
    policy: LayerSizes = Field(description=ACTOR_LAYERS)
    activation: Activation = "relu"
    initial_action: Annotated[Action | None, Field(exclude_if=lambda action: action is None)] = Field(
        None, description="approximate action of the untrained network, from -1 to 1; left out: 0, which coasts"
    )


class VineRecipe(TrainingRecipe):
    """Recipe of vine: the difference in return between a higher and a lower action gives the gradient."""

    n_steps: int = Field(ge=1, description="number of decisions in each world between two updates")
    tried: int = Field(ge=1, description="number of decisions per update at which other actions are tried")
    holds: Steps = Field(description="numbers of time steps for which a tried action may last; one of them is drawn")
    batch_size: int = Field(ge=2, description=BATCH_SIZE)
    averaging: float = Field(
        ge=0.0,
        lt=1.0,
        description="share of the weight average that a gradient step keeps; the trained policy uses the average",
    )
    algorithm: Annotated[str, Field(pattern="^vine$")]
    start: Text | None = Field(
        None, description="trained policy to start from, as in --agents: ppo, or policy@PATH; left out: random weights"
    )
    offset: Range = Field(description="range of the offset between a tried action and the policy's action")
    gradient_limit: Positive = Field(
        description="largest gradient (return per unit of action); larger ones are cut to it"
    )
    trust_radius: Rate = Field(description="largest distance, in one update, between an action and its target")
    anchor: Positive = Field(description="weight that holds actions at their value where the gradient is small")
    n_epochs: int = Field(ge=1, le=1000, description="number of passes of each update over the tried decisions")
    network: ActorShape = Field(description=NETWORK)

    @model_validator(mode="after")
    def _branches_fit(self) -> Self:
        if self.reward.shaping > 0.0:
            right = "must be 0: this algorithm plays tried actions to the end of the episode, so shaping has no effect"
            refuse(("reward", "shaping"), self.reward.shaping, right)
        visited = self.n_envs * self.n_steps
        if not visited <= MOST_DECISIONS:
            right = f"n_envs x n_steps = {visited} decisions per update are too many (at most {MOST_DECISIONS})"
            refuse(("n_envs",), self.n_envs, right)
        if not self.tried <= visited:
            refuse(("tried",), self.tried, f"must be at most n_envs x n_steps = {visited}")
        return self

    @model_validator(mode="after")
    def _begins_in_one_way(self) -> Self:
        if self.start is not None and self.network.initial_action is not None:
            right = "must be left out beside the key start, whose policy gives the first action"
            refuse(("network", "initial_action"), self.network.initial_action, right)
        return self


VINE = Part(VineRecipe, "ethbrake_marl.extensions.learners.vine:Vine")
VINE_AGENT = Part(
    make_trained, form="vine@PATH", about="a policy trained by vine; PATH is a run or a bundle", knows=MESSAGES
)
