"""Types of the values of recipe keys that both algorithms, ``vine`` and ``rollout-classification``, use."""

from __future__ import annotations

from operator import not_
from typing import Annotated

from pydantic import Field, ValidationInfo, field_validator

from ethbrake_marl.files.model import FileModel
from ethbrake_marl.first_edition.training.recipe import Rate


class OffsetRange(FileModel):
    """Range from which a distance between two actions is drawn; the logarithm of the distance is uniformly distributed.

    Actions are numbers from -1 (full braking) to 1 (full drive).
    """

    smallest: Rate  # lower end of the range
    largest: Rate  # upper end of the range

    @field_validator("largest")
    @classmethod
    def _in_order(cls, value: float, info: ValidationInfo) -> float:
        if "smallest" in info.data and not value >= info.data["smallest"]:
            raise ValueError(f"must be at least the value of the key smallest, {info.data['smallest']:g}")
        return value


Holds = Annotated[tuple[Annotated[int, Field(ge=1, le=1000)], ...], Field(strict=False, min_length=1, max_length=16)]

Averaging = Annotated[float, Field(ge=0.0, lt=1.0)]  # with 1 the average would never change

AVERAGING = "share of the weight average that a gradient step keeps; the trained policy uses the averaged weights"

NO_SHAPING = "must be 0: this algorithm plays tried actions to the end of the episode, so shaping has no effect"

Focus = Annotated[float, Field(ge=0.0, le=0.99, exclude_if=not_)]
