"""Recipe key ``experts``: settings for the training of a mixture of experts."""

from __future__ import annotations

from pydantic import Field, model_validator

from ethbrake_marl.files.model import FileModel
from ethbrake_marl.first_edition.training.recipe import Fraction, Layers, NonNegative, Positive, Rate


class Shares(FileModel):
    """How the updates of a training run are divided among the four stages that train a mixture of experts.

    Each stage gets a share of the updates, from 0 to 1. The shares sum to 1.
    """

    pretraining_first: Fraction  # share for the first expert, which is trained in all worlds
    pretraining_others: Fraction  # share for the other experts together; each is trained in worlds selected for it
    gating: Fraction  # share for the gating network, which chooses an expert at each decision
    joint: Fraction  # share for joint training of all networks; each expert learns at decisions at which it is chosen

    @model_validator(mode="after")
    def _everything(self) -> Shares:
        total = self.pretraining_first + self.pretraining_others + self.gating + self.joint
        if not abs(total - 1.0) <= 1e-9:
            raise ValueError(
                "pretraining_first, pretraining_others, gating and joint are shares of all updates: they must sum to 1,"
                f" but sum to {total:g}"
            )
        return self


class ExpertsPlan(FileModel):
    """Settings of a mixture of experts: several networks, and a gating network that chooses which of these networks
    acts.

    Each expert after the first one is pre-trained in two steps. In the first step, the new expert imitates templates
    (random braking profiles) in worlds in which a template has a higher return than all earlier experts. In the second
    step, the new expert is trained in the worlds in which it has a higher return than the best earlier expert, or has a
    return that is only slightly lower.
    """

    networks: int = Field(ge=2, le=16, description="number of experts")
    gating: Layers = Field(description="hidden layers of the gating network")
    worlds: int = Field(
        ge=1,
        le=1_000_000,
        description="number of worlds in which templates (random braking profiles) are compared with experts",
    )
    templates: int = Field(
        ge=1, le=100_000, description="number of templates (random braking profiles) drawn in each world"
    )
    gain: NonNegative = Field(
        description="a new expert imitates a template if its return exceeds the best earlier expert's return by more"
        " than this number"
    )
    margin: Positive = Field(
        description="a new expert is trained in the worlds in which its return is at least the best earlier expert's"
        " return minus this number"
    )
    imitation_epochs: int = Field(
        ge=1, le=1000, description="number of passes over the decisions of the imitated templates"
    )
    gating_states: int = Field(
        ge=1,
        le=1_000_000,
        description="number of decisions at which the returns of the experts are compared in each update",
    )
    gating_memory: int = Field(
        ge=1, le=1_000_000, description="number of stored decisions at which experts were compared"
    )
    gating_steps: int = Field(
        ge=1, le=100_000, description="number of gradient steps of the gating network in each update"
    )
    tie_break: NonNegative = Field(
        description="weight, when experts are compared, of the harm count (first or total) that the reward does not use"
    )
    joint_rate: Rate = Field(description="factor on the learning rate in the last stage, in which all networks learn")
    shares: Shares = Field(description="share of all updates for each stage of the training; the shares sum to 1")
