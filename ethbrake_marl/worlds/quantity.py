"""Quantities of a scenario: a number, or a distribution that turns a uniform number u in [0, 1) into a value.

Every distribution uses its inverse cumulative distribution function. ``exp``, ``log`` and the normal quantile come from
``motion.elementary``, so a seed gives the same worlds on every machine.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Self

import numpy as np
from pydantic import AfterValidator, Discriminator, Field, Tag, field_validator, model_validator

from ethbrake_marl.files.model import FileModel, require
from ethbrake_marl.motion.elementary import exp_each, log, normal_probability, normal_quantile_each
from ethbrake_marl.motion.layout import Floats, Ints

LEAST_MASS = 1e-6  # least probability of [low, high] before truncation; below it the quantile loses precision


def check_order(ends: tuple[float, float]) -> tuple[float, float]:
    require(ends[0] <= ends[1], (), ends, "low must not be above high")
    return ends


Number = Annotated[float, Field(allow_inf_nan=False)]
PositiveNumber = Annotated[Number, Field(gt=0.0)]
Weight = Annotated[float, Field(gt=0.0, le=1e9, allow_inf_nan=False)]
Pair = Annotated[tuple[Number, Number], Field(strict=False)]
Ends = Annotated[Pair, AfterValidator(check_order)]
PositiveEnds = Annotated[tuple[PositiveNumber, PositiveNumber], Field(strict=False), AfterValidator(check_order)]


def pick(weights: Sequence[float] | Floats, u: Floats) -> Ints:
    """Index that each uniform number in ``u`` chooses: the first k with ``sum(weights[: k + 1]) > u sum(weights)``."""
    cumulative = np.cumsum(np.asarray(weights, np.float64))
    return np.searchsorted(cumulative / cumulative[-1], u, side="right")


class ScenarioPart(FileModel):
    @field_validator("*", mode="before")
    @classmethod
    def _written(cls, value: Any) -> Any:
        require(value is not None, (), value, "must have a value; leave the key out if you do not need it")
        return value


class Distribution(ScenarioPart):
    """Base class of distributions.

    The first field of a subclass has the distribution's name and holds the parameters.
    """

    @property
    def support(self) -> tuple[float, float]:
        shape = getattr(self, next(iter(type(self).model_fields)))
        return (min(shape), max(shape)) if isinstance(shape, tuple) else (shape.low, shape.high)


class Uniform(Distribution):
    """``{uniform: [low, high]}``: ``low + (high - low) u``, u uniform in [0, 1)."""

    uniform: Ends = Field(description="[low, high]")

    def value(self, u: Floats) -> Floats:
        low, high = self.uniform
        return low + (high - low) * u


class LogUniform(Distribution):
    """``{loguniform: [low, high]}``: ``low (high / low)^u``, u uniform in [0, 1), so 1 to 2 is as likely as 2 to 4."""

    loguniform: PositiveEnds = Field(description="[low, high], both above 0")

    def value(self, u: Floats) -> Floats:
        low, high = self.loguniform
        return np.clip(low * exp_each(u * log(high / low)), low, high)


class NormalShape(ScenarioPart):
    """Mean and standard deviation before truncation, and the smallest and largest possible value."""

    mean: Number
    sd: PositiveNumber
    low: Number
    high: Number

    @model_validator(mode="after")
    def _likely(self) -> Self:
        _check_likely(self, self)
        return self

    def shares(self) -> tuple[float, float]:
        """Probabilities of a value below ``low``, and below ``high``, before truncation."""
        low, high = (normal_probability((end - self.mean) / self.sd) for end in (self.low, self.high))
        return low, high

    def value(self, u: Floats) -> Floats:
        """``mean + sd Q(p_low + (p_high - p_low) u)`` with the standard normal quantile function Q and the ``shares``
        p.
        """
        below, above = self.shares()
        return np.clip(self.mean + self.sd * normal_quantile_each(below + (above - below) * u), self.low, self.high)


class Normal(Distribution):
    """``{normal: {mean, sd, low, high}}``: a normal distribution truncated to [low, high]."""

    normal: NormalShape

    def value(self, u: Floats) -> Floats:
        return self.normal.value(u)


class LogNormalShape(ScenarioPart):
    """Median, and standard deviation of the logarithm, before truncation; smallest and largest possible value."""

    median: PositiveNumber
    sigma: PositiveNumber
    low: PositiveNumber
    high: PositiveNumber

    @model_validator(mode="after")
    def _likely(self) -> Self:
        _check_likely(self, self.of_logarithm())
        return self

    def of_logarithm(self) -> NormalShape:
        low, high = log(self.low), log(self.high)
        return NormalShape.model_construct(mean=log(self.median), sd=self.sigma, low=low, high=high)


def _check_likely(shape: ScenarioPart, of_normal: NormalShape) -> None:
    require(of_normal.low < of_normal.high, (), shape, "low must be below high")
    below, above = of_normal.shares()
    right = f"the untruncated distribution must have a probability of at least {LEAST_MASS:g} in [low, high]"
    require(above - below >= LEAST_MASS, (), shape, right)


class LogNormal(Distribution):
    """``{lognormal: {median, sigma, low, high}}``: a lognormal distribution truncated to [low, high]."""

    lognormal: LogNormalShape

    def value(self, u: Floats) -> Floats:
        """``exp(x)`` with x from a normal distribution truncated to [log(low), log(high)]."""
        return np.clip(exp_each(self.lognormal.of_logarithm().value(u)), *self.support)


class Choice(Distribution):
    """``{choice: [a, b, ...]}``: one of the values, equally likely or in proportion to ``weights: [...]``."""

    choice: Annotated[tuple[Number, ...], Field(strict=False, min_length=1)]
    weights: Annotated[tuple[Weight, ...], Field(strict=False)] | None = None

    @model_validator(mode="after")
    def _weighted(self) -> Self:
        count = len(self.choice)
        right = f"must have as many entries as choice ({count})"
        require(self.weights is None or len(self.weights) == count, ("weights",), self.weights, right)
        return self

    def value(self, u: Floats) -> Floats:
        values: Floats = np.asarray(self.choice)[pick(self.weights or (1.0,) * len(self.choice), u)]
        return values


DISTRIBUTIONS = ("uniform", "loguniform", "normal", "lognormal", "choice")


def _tag(value: object) -> str | None:
    if isinstance(value, Distribution):
        return f"#{next(iter(type(value).model_fields))}"
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

ONE_OR_EACH = Discriminator(lambda value: "#each" if isinstance(value, list | tuple) else "#one")

# one entry for all vehicles or pairs, each of which draws its own value, or a list with one entry each
PerVehicle = Annotated[
    Annotated[Quantity, Tag("#one")] | Annotated[tuple[Quantity, ...], Field(strict=False, min_length=1), Tag("#each")],
    ONE_OR_EACH,
]


def support(quantity: Any) -> tuple[float, float]:
    if isinstance(quantity, float):
        return quantity, quantity
    low, high = quantity.support
    return low, high


def values(quantity: Any, u: Floats) -> Floats:
    return np.full(u.shape, quantity) if isinstance(quantity, float) else quantity.value(u)
