"""Quantities: a number or a distribution, which turns one uniform number u in [0, 1) into a value.

Every distribution uses its inverse cumulative distribution function. ``exp``, ``log`` and the normal quantile come from
``motion.elementary``, so a seed gives the same worlds on every machine.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import not_
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Discriminator, Field, Tag, field_validator, model_validator

from ethbrake_marl.files.model import FileModel, require
from ethbrake_marl.motion.elementary import exp_each, log, normal_probability, normal_quantile_each
from ethbrake_marl.motion.layout import Floats, Ints

LEAVE_OUT = "must be a number or a distribution; leave the key out if you do not need it"

LEAST_MASS = 1e-6  # least probability of [low, high] before truncation; below it the quantile loses precision

Number = Annotated[float, Field(allow_inf_nan=False)]
Pair = Annotated[tuple[Number, Number], Field(strict=False)]
Numbers = Annotated[tuple[Number, ...], Field(strict=False, min_length=1)]


def pick(weights: Sequence[float] | Floats, u: Floats) -> Ints:
    """Return for each ``u`` the first index whose cumulative share of the ``weights`` is above it."""
    cumulative = np.cumsum(np.asarray(weights, np.float64))
    return np.searchsorted(cumulative / cumulative[-1], u, side="right")


class Distribution(FileModel):
    """Base class of the distributions. The first field, of the distribution's name, has its shape."""

    @property
    def support(self) -> tuple[float, float]:
        """Smallest and largest value."""
        shape = getattr(self, next(iter(type(self).model_fields)))
        return (min(shape), max(shape)) if isinstance(shape, tuple) else (shape.low, shape.high)


class Uniform(Distribution):
    """``{uniform: [low, high]}``: ``low + (high - low) u``."""

    uniform: Pair = Field(description="[low, high]")

    @model_validator(mode="after")
    def _ordered(self) -> Uniform:
        require(self.uniform[0] <= self.uniform[1], ("uniform",), self.uniform, "low must not be above high")
        return self

    def value(self, u: Floats) -> Floats:
        """Return the values; none is above high, because u is at most 1 - 2^-53."""
        low, high = self.uniform
        return low + (high - low) * u


class LogUniform(Distribution):
    """``{loguniform: [low, high]}``: ``low (high / low)^u``, so 1 to 2 is as likely as 2 to 4."""

    loguniform: Pair = Field(description="[low, high], both above 0")

    @model_validator(mode="after")
    def _ordered(self) -> LogUniform:
        low, high = self.loguniform
        require(low > 0.0, ("loguniform",), self.loguniform, "low must be above 0")
        require(low <= high, ("loguniform",), self.loguniform, "low must not be above high")
        return self

    def value(self, u: Floats) -> Floats:
        low, high = self.loguniform
        return np.clip(low * exp_each(u * log(high / low)), low, high)


class _TruncatedNormal(NamedTuple):
    mean: float  # before truncation
    sd: float
    low: float
    high: float

    def shares(self) -> tuple[float, float]:
        """Return the probabilities of a value below ``low`` and below ``high`` before truncation."""
        low, high = (normal_probability((end - self.mean) / self.sd) for end in (self.low, self.high))
        return low, high

    def check(self, at: str, shape: FileModel) -> None:
        right = f"the untruncated distribution must have a probability of at least {LEAST_MASS:g} in [low, high]"
        below, above = self.shares()
        require(above - below >= LEAST_MASS, (at,), shape, right)

    def value(self, u: Floats) -> Floats:
        """Return ``mean + sd Q(p_low + (p_high - p_low) u)`` with the standard normal quantile function Q."""
        below, above = self.shares()
        return np.clip(self.mean + self.sd * normal_quantile_each(below + (above - below) * u), self.low, self.high)


class NormalShape(FileModel):
    """Mean and standard deviation before truncation, and the smallest and largest possible value."""

    mean: Number
    sd: Number
    low: Number
    high: Number


class Normal(Distribution):
    """``{normal: {mean, sd, low, high}}``: a normal distribution truncated to [low, high]."""

    normal: NormalShape

    @model_validator(mode="after")
    def _possible(self) -> Normal:
        shape = self.normal
        require(shape.sd > 0.0, ("normal",), shape, "sd must be above 0")
        require(shape.low < shape.high, ("normal",), shape, "low must be below high")
        self._truncated.check("normal", shape)
        return self

    def value(self, u: Floats) -> Floats:
        return self._truncated.value(u)

    @property
    def _truncated(self) -> _TruncatedNormal:
        shape = self.normal
        return _TruncatedNormal(shape.mean, shape.sd, shape.low, shape.high)


class LogNormalShape(FileModel):
    """Median and standard deviation of the logarithm before truncation, and the smallest and largest value."""

    median: Number
    sigma: Number
    low: Number
    high: Number


class LogNormal(Distribution):
    """``{lognormal: {median, sigma, low, high}}``: a lognormal distribution truncated to [low, high]."""

    lognormal: LogNormalShape

    @model_validator(mode="after")
    def _possible(self) -> LogNormal:
        shape, at = self.lognormal, ("lognormal",)
        require(min(shape.median, shape.low) > 0.0, at, shape, "median and low must be above 0")
        require(shape.sigma > 0.0, at, shape, "sigma must be above 0")
        require(shape.low < shape.high, at, shape, "low must be below high")
        self._of_logarithm.check("lognormal", shape)
        return self

    def value(self, u: Floats) -> Floats:
        """Return ``exp(x)`` with x from a normal distribution truncated to [log(low), log(high)]."""
        return np.clip(exp_each(self._of_logarithm.value(u)), *self.support)

    @property
    def _of_logarithm(self) -> _TruncatedNormal:
        shape = self.lognormal
        return _TruncatedNormal(log(shape.median), shape.sigma, log(shape.low), log(shape.high))


class Choice(Distribution):
    """``{choice: [a, b, ...]}``: one of the values, equally likely or in proportion to ``weights: [...]``."""

    choice: Numbers
    weights: Numbers | None = None

    @model_validator(mode="after")
    def _weighted(self) -> Choice:
        if self.weights is not None:
            fits = f"must have as many entries as choice ({len(self.choice)})"
            require(len(self.weights) == len(self.choice), ("weights",), self.weights, fits)
            positive = all(w > 0.0 for w in self.weights) and math.isfinite(sum(self.weights))
            require(positive, ("weights",), self.weights, "every weight must be above 0, and their sum finite")
        return self

    def value(self, u: Floats) -> Floats:
        values: Floats = np.asarray(self.choice)[pick(self.weights or (1.0,) * len(self.choice), u)]
        return values


DISTRIBUTIONS = ("uniform", "loguniform", "normal", "lognormal", "choice")


def _tag(value: object) -> str | None:
    """Return the tag of the class that checks a value from a file; None if no class can."""
    if isinstance(value, FileModel):
        return f"#{type(value).__name__.lower()}"
    if isinstance(value, dict):
        return next((f"#{name}" for name in DISTRIBUTIONS if name in value), None)
    return None if isinstance(value, list | tuple) else "#number"


# Tags begin with #, so that they differ from keys in the place of an error.
Quantity = Annotated[
    Annotated[Number, Tag("#number")]
    | Annotated[Uniform, Tag("#uniform")]
    | Annotated[LogUniform, Tag("#loguniform")]
    | Annotated[Normal, Tag("#normal")]
    | Annotated[LogNormal, Tag("#lognormal")]
    | Annotated[Choice, Tag("#choice")],
    Discriminator(_tag, custom_error_type="quantity", custom_error_message="no such quantity"),
]


class WithLoad(FileModel):
    """``{with_load: [empty, full]}``: ``empty + (full - empty) load``; only in vehicle types.

    ``spread`` is the distribution, around 0, of an amount that is added to each vehicle's value.
    """

    with_load: Pair = Field(description="[empty, full]: value of an empty vehicle, value of a full vehicle")
    spread: Quantity = Field(
        default=0.0, exclude_if=not_, description="distribution around 0 of a random amount that is added to the value"
    )

    @field_validator("spread")
    @classmethod
    def _spreads(cls, value: Any) -> Any:
        right = "must be a distribution around 0, such as {uniform: [-0.3, 0.3]}"
        require(not isinstance(value, float), (), value, right)
        return value

    @property
    def support(self) -> tuple[float, float]:
        low, high = support(self.spread)
        return min(self.with_load) + low, max(self.with_load) + high

    def value(self, load: Floats, u: Floats) -> Floats:
        """Return the values of vehicles with a ``load`` in [0, 1]; ``u`` draws the spread."""
        empty, full = self.with_load
        moved = np.clip(empty + (full - empty) * load, min(self.with_load), max(self.with_load))
        return moved if self.spread == 0.0 else moved + values(self.spread, u)


def _one_or_each(value: object) -> str:
    return "#each" if isinstance(value, list | tuple) else "#one"


# one entry for all vehicles or pairs, each of which draws its own value, or a list with one entry each
PerVehicle = Annotated[
    Annotated[Quantity, Tag("#one")] | Annotated[tuple[Quantity, ...], Field(strict=False, min_length=1), Tag("#each")],
    Discriminator(_one_or_each),
]


def support(quantity: Any) -> tuple[float, float]:
    """Return the smallest and the largest value that a quantity can have."""
    if isinstance(quantity, float):
        return quantity, quantity
    low, high = quantity.support
    return low, high


def values(quantity: Any, u: Floats) -> Floats:
    """Return the values of a number or distribution for uniform numbers ``u`` [n]."""
    return np.full(u.shape, quantity) if isinstance(quantity, float) else quantity.value(u)
