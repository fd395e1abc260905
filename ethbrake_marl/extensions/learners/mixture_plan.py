"""The recipe's key ``modes``: how a mixture of experts is trained."""

from __future__ import annotations

from pydantic import Field, model_validator

from ethbrake_marl.files.model import FileModel
from ethbrake_marl.training.recipe import Fraction, Layers, NonNegative, Positive, Rate


class Shares(FileModel):
    """Share, 0 to 1, of all updates that each stage of training a mixture of experts has; the shares sum to 1."""

    alone: Fraction  # share for the first expert, in all worlds
    further: Fraction  # share for the further experts, one after the other, each in worlds of its own
    gate: Fraction  # share for the gating network, which chooses an expert at each decision
    together: Fraction  # share for all experts and the gate; each expert learns where the gate chooses it

    @model_validator(mode="after")
    def _everything(self) -> Shares:
        total = self.alone + self.further + self.gate + self.together
        if not abs(total - 1.0) <= 1e-9:
            raise ValueError(f"alone, further, gate and together are {total:g} in all; must be 1")
        return self


class ExpertsPlan(FileModel):
    """Settings of a mixture of experts: several networks that drive, and a gate that chooses one at each decision.

    A further expert first imitates templates (random braking profiles) in worlds where one of them does better than all
    networks before. It is then trained in worlds of its own, those in which it is hardly worse than these networks.
    """

    networks: int = Field(ge=2, le=16, description="how many")  # number of networks (experts)
    gate: Layers = Field(description="hidden layers of the gate")
    # Number of worlds, from the first of the training on, in which templates are compared with the networks so far.
    worlds: int = Field(ge=1, le=1_000_000, description="worlds of the training in which a mode is looked for")
    # Number of templates (random braking profiles) that are drawn in each of these worlds.
    templates: int = Field(ge=1, le=100_000, description="how many templates are drawn in each of them")
    # A template is imitated if its return exceeds the return of every earlier network by more than this.
    gain: NonNegative = Field(
        description="return by which a template must be better than every network before, to be imitated"
    )
    # A world belongs to a new network if its return there is at most this much below the best earlier network.
    margin: Positive = Field(
        description="return by which a network may be worse than those before it in a world of its own"
    )
    # Number of passes over the decisions of the imitated templates.
    imitation_epochs: int = Field(ge=1, le=1000, description="how often the shown decisions are gone through")
    # Number of decisions in each update at which every network is played to the end, for the gate to learn from.
    gate_states: int = Field(
        ge=1, le=1_000_000, description="decisions of an update at which the networks are compared"
    )
    # Number of such decisions that the gate keeps in memory.
    gate_memory: int = Field(ge=1, le=1_000_000, description="how many compared decisions are remembered")
    gate_steps: int = Field(ge=1, le=100_000, description="steps of the gate's optimiser in each update")
    # Weight, in that comparison, of harm under the count that the reward does not use (first impacts or all).
    tie_break: NonNegative = Field(description="weight of the other count's harm in that comparison")
    # Factor on the learning rate in the last stage, in which all networks learn.
    together_rate: Rate = Field(
        description="share of the learning rate in the last stage, where noise undoes what was learned"
    )
    shares: Shares = Field(description="share of all updates that each stage has, 1 in all")
