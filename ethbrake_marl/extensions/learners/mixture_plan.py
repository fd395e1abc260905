"""The recipe's key ``experts``: how a mixture of experts is trained."""

from __future__ import annotations

from pydantic import Field, model_validator

from ethbrake_marl.files.model import FileModel
from ethbrake_marl.training.recipe import Fraction, Layers, NonNegative, Positive, Rate


class Shares(FileModel):
    """Share, 0 to 1, of all updates that each stage of training a mixture of experts has; the shares sum to 1."""

    pretraining_first: Fraction  # share for the first expert, in all worlds
    pretraining_others: Fraction  # share for the other experts, one after the other, each in worlds of its own
    gating: Fraction  # share for the gating network, which chooses an expert at each decision
    joint: Fraction  # share for all experts and the gating network; each expert learns where it is chosen

    @model_validator(mode="after")
    def _everything(self) -> Shares:
        total = self.pretraining_first + self.pretraining_others + self.gating + self.joint
        if not abs(total - 1.0) <= 1e-9:
            raise ValueError(f"the sum of the shares is {total:g}; must be 1")
        return self


class ExpertsPlan(FileModel):
    """Settings of a mixture of experts: several networks that drive, and a gating network that chooses one of them.

    Each expert after the first is pre-trained in two steps. It imitates templates (random braking profiles) in worlds
    where one of them does better than all experts before. It is then trained in worlds of its own: those in which it is
    hardly worse than these experts.
    """

    networks: int = Field(ge=2, le=16, description="number of experts")
    gating: Layers = Field(description="hidden layers of the gating network")
    # Number of worlds, the first of the training, in which templates are compared with the experts so far.
    worlds: int = Field(ge=1, le=1_000_000, description="worlds in which templates are compared with the experts")
    templates: int = Field(ge=1, le=100_000, description="templates (random braking profiles) drawn in each world")
    # A template is imitated if its return exceeds the return of every earlier expert by more than this.
    gain: NonNegative = Field(
        description="a template is imitated if its return exceeds that of every earlier expert by this"
    )
    # A world belongs to a new expert if its return there is at most this much below the best earlier expert.
    margin: Positive = Field(
        description="an expert is trained in worlds where its return is at most this below the best earlier expert"
    )
    imitation_epochs: int = Field(ge=1, le=1000, description="passes over the decisions of the imitated templates")
    # Number of decisions in each update at which every expert is played to the end, for the gating network to learn.
    gating_states: int = Field(ge=1, le=1_000_000, description="decisions of an update at which experts are compared")
    gating_memory: int = Field(ge=1, le=1_000_000, description="compared decisions that are kept in memory")
    gating_steps: int = Field(ge=1, le=100_000, description="gradient steps of the gating network in each update")
    # Weight, in that comparison, of harm under the count that the reward does not use (first impacts or all).
    tie_break: NonNegative = Field(
        description="weight, in this comparison, of harm in the count that the reward does not use"
    )
    # Factor on the learning rate in the last stage, in which all networks learn.
    joint_rate: Rate = Field(description="factor on the learning rate in the last stage, in which all networks learn")
    shares: Shares = Field(description="share of all updates that each stage has; their sum is 1")
