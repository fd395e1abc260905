"""A quantity of a scenario: a fixed number, or a declared distribution.

Each distribution is a pure function of one uniform number ``u`` in [0, 1): its inverse cumulative distribution
function. One quantity therefore uses up exactly one uniform number, whatever its distribution is.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, model_validator
from pydantic_core import PydanticCustomError

from ethbrake_marl.files.yaml import flow_text
from ethbrake_marl.physics.elementary import exp_each, log, normal_probability, normal_quantile_each
from ethbrake_marl.physics.worlds import Floats

LEAST_MASS = 1e-6  # of a normal distribution inside its bounds; below it the inverse loses its digits

Number = Annotated[float, Field(allow_inf_nan=False)]
Pair = Annotated[tuple[Number, Number], Field(strict=False)]
Numbers = Annotated[tuple[Number, ...], Field(strict=False, min_length=1)]


class _Distribution(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")


class Uniform(_Distribution):
    """``{uniform: [low, high]}``: every value from low to high is equally likely."""

    uniform: Pair = Field(description="[low, high]")

    @model_validator(mode="after")
    def _ordered(self) -> Uniform:
        _require(self.uniform[0] <= self.uniform[1], "uniform", self.uniform, "low must not be above high")
        return self

    @property
    def support(self) -> tuple[float, float]:
        """Smallest and largest value that can be drawn."""
        return self.uniform

    def value(self, u: Floats) -> Floats:
        """``low + (high - low) u``, in the shape of ``u`` in [0, 1).

        Never above high: u is at most 1 - 2^-53, so (high - low) u is rounded to less than the rounded high - low.
        """
        low, high = self.uniform
        return low + (high - low) * u


class LogUniform(_Distribution):
    """``{loguniform: [low, high]}``: every ratio is equally likely, as between 1 and 2 so between 2 and 4."""

    loguniform: Pair = Field(description="[low, high], both above 0")

    @model_validator(mode="after")
    def _ordered(self) -> LogUniform:
        low, high = self.loguniform
        _require(low > 0.0, "loguniform", self.loguniform, "low must be above 0")
        _require(low <= high, "loguniform", self.loguniform, "low must not be above high")
        return self

    @property
    def support(self) -> tuple[float, float]:
        """Smallest and largest value that can be drawn."""
        return self.loguniform

    def value(self, u: Floats) -> Floats:
        """``low (high / low)^u``, in the shape of ``u`` in [0, 1)."""
        low, high = self.loguniform
        return np.clip(low * exp_each((u * log(high / low)).ravel()).reshape(u.shape), low, high)


class NormalShape(_Distribution):
    """Mean and standard deviation of the untruncated bell, and the bounds that cut it."""

    mean: Number
    sd: Number
    low: Number
    high: Number


class Normal(_Distribution):
    """``{normal: {mean, sd, low, high}}``: a normal distribution truncated to [low, high]."""

    normal: NormalShape

    @model_validator(mode="after")
    def _possible(self) -> Normal:
        shape = self.normal
        declared = shape.model_dump()
        _require(shape.sd > 0.0, "normal", declared, "sd must be above 0")
        _require(shape.low < shape.high, "normal", declared, "low must be below high")
        below, above = self._bounds()
        right = f"[low, high] must hold at least {LEAST_MASS:g} of the untruncated distribution"
        _require(above - below >= LEAST_MASS, "normal", declared, right)
        return self

    def _bounds(self) -> tuple[float, float]:
        """Probability below low and below high."""
        shape = self.normal
        low, high = (normal_probability((end - shape.mean) / shape.sd) for end in (shape.low, shape.high))
        return low, high

    @property
    def support(self) -> tuple[float, float]:
        """Smallest and largest value that can be drawn."""
        return self.normal.low, self.normal.high

    def value(self, u: Floats) -> Floats:
        """``mean + sd Q(p_low + (p_high - p_low) u)`` with the normal quantile Q; same shape as ``u`` in [0, 1)."""
        shape = self.normal
        below, above = self._bounds()
        quantile = normal_quantile_each((below + (above - below) * u).ravel()).reshape(u.shape)
        return np.clip(shape.mean + shape.sd * quantile, shape.low, shape.high)


class Choice(_Distribution):
    """``{choice: [a, b, ...]}``: one of these values, equally likely or as ``weights: [...]`` says."""

    choice: Numbers
    weights: Numbers | None = None

    @model_validator(mode="after")
    def _weighted(self) -> Choice:
        if self.weights is not None:
            fits = f"must have as many entries as choice, {len(self.choice)}"
            _require(len(self.weights) == len(self.choice), "weights", self.weights, fits)
            positive = all(w > 0.0 for w in self.weights) and math.isfinite(sum(self.weights))
            _require(positive, "weights", self.weights, "every weight must be above 0, and their sum finite")
        return self

    @property
    def support(self) -> tuple[float, float]:
        """Smallest and largest value that can be drawn."""
        return min(self.choice), max(self.choice)

    def value(self, u: Floats) -> Floats:
        """The first entry whose cumulative weight is above ``u``; same shape as ``u`` in [0, 1)."""
        cumulative = np.cumsum(np.asarray(self.weights or (1.0,) * len(self.choice)))
        cumulative /= cumulative[-1]
        return np.asarray(self.choice)[np.searchsorted(cumulative, u, side="right")]


class WithLoad(_Distribution):
    """``{with_load: [empty, full]}``, of a vehicle type only: moves with the load of the vehicle, from 0 to 1."""

    with_load: Pair = Field(description="[empty, full]: at load 0 and at load 1")

    @property
    def support(self) -> tuple[float, float]:
        """Smallest and largest value that can be drawn."""
        return min(self.with_load), max(self.with_load)

    def value(self, load: Floats) -> Floats:
        """``empty + (full - empty) load``, in the shape of ``load`` in [0, 1]; never beyond either end."""
        empty, full = self.with_load
        return np.clip(empty + (full - empty) * load, *self.support)


def _require(holds: bool, key: str, value: Any, right: str) -> None:
    """Refuse the value of ``key`` unless ``holds``; ``right`` says what would do."""
    if not holds:
        raise PydanticCustomError("distribution", "{right}", {"right": right, "value": flow_text(value), "at": (key,)})


def _kind(value: object) -> str | None:
    """Which member of ``Quantity`` a value means; decides whose error messages are shown."""
    if isinstance(value, _Distribution):
        return f"#{type(value).__name__.lower()}"
    if isinstance(value, dict):
        return next((f"#{name}" for name in DISTRIBUTIONS if name in value), None)
    return None if isinstance(value, list | tuple) else "#number"


DISTRIBUTIONS = ("uniform", "loguniform", "normal", "choice")

# Tags begin with # so that they can be told from keys in the location of an error.
Quantity = Annotated[
    Annotated[Number, Tag("#number")]
    | Annotated[Uniform, Tag("#uniform")]
    | Annotated[LogUniform, Tag("#loguniform")]
    | Annotated[Normal, Tag("#normal")]
    | Annotated[Choice, Tag("#choice")],
    Discriminator(_kind, custom_error_type="quantity", custom_error_message="no such quantity"),
]


def support(quantity: float | Uniform | LogUniform | Normal | Choice | WithLoad) -> tuple[float, float]:
    """Smallest and largest value that the quantity can take."""
    return (quantity, quantity) if isinstance(quantity, float) else quantity.support


def values(quantity: float | Uniform | LogUniform | Normal | Choice, u: Floats) -> Floats:
    """The quantity's values for uniform numbers ``u`` in [0, 1), in the shape of ``u``."""
    return np.full(u.shape, quantity) if isinstance(quantity, float) else quantity.value(u)
