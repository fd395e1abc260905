"""The recipe's key ``modes``: how a mixture of experts is trained."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from ethbrake_marl.files.yaml import FileModel
from ethbrake_marl.training.recipe import Fraction, Layers, NonNegative, Positive, Rate


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
