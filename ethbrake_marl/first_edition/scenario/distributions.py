"""Quantities of a scenario: a quantity is a fixed number or a distribution.

Every distribution turns one uniform number ``u`` in [0, 1) into a value, by its inverse cumulative distribution
function. The method ``value`` takes an array of such numbers and returns values in the same shape. The property
``support`` is the smallest and largest value that can be drawn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field as data_field, replace
from operator import not_
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Discriminator, Field, PrivateAttr, Tag, ValidationError, field_validator, model_validator

from ethbrake_marl.files.model import FileModel, refuse, require
from ethbrake_marl.first_edition.physics.elementary import exp_each, log, normal_probability, normal_quantile_each
from ethbrake_marl.first_edition.physics.state import Floats

LEAVE_OUT = "must be a number or a distribution; leave the key out if you do not need it"

# least probability that a value of the untruncated normal distribution lies within the bounds; the inverse
# distribution function loses precision below
LEAST_MASS = 1e-6

_LEAST = f"the untruncated distribution must have a probability of at least {LEAST_MASS:g} in [low, high]"

Number = Annotated[float, Field(allow_inf_nan=False)]

Pair = Annotated[tuple[Number, Number], Field(strict=False)]

Numbers = Annotated[tuple[Number, ...], Field(strict=False, min_length=1)]


class _Distribution(FileModel):
    """Base class of the distributions that a quantity in a scenario file may have, such as ``Uniform``.

    A subclass declares its parameters as fields, and defines ``support`` and ``value``.
    """


class Uniform(_Distribution):
    """``{uniform: [low, high]}``: uniform distribution from low to high."""

    uniform: Pair = Field(description="[low, high]")

    @model_validator(mode="after")
    def _ordered(self) -> Uniform:
        require(self.uniform[0] <= self.uniform[1], ("uniform",), self.uniform, "low must not be above high")
        return self

    @property
    def support(self) -> tuple[float, float]:
        return self.uniform

    def value(self, u: Floats) -> Floats:
        """Return ``low + (high - low) u``.

        No value is above high. Because u is at most 1 - 2^-53, the rounded product (high - low) u is below the rounded
        difference high - low.
        """
        low, high = self.uniform
        return low + (high - low) * u


class LogUniform(_Distribution):
    """``{loguniform: [low, high]}``: the logarithm of the value is uniform, so 1 to 2 is as likely as 2 to 4."""

    loguniform: Pair = Field(description="[low, high], both above 0")

    @model_validator(mode="after")
    def _ordered(self) -> LogUniform:
        low, high = self.loguniform
        require(low > 0.0, ("loguniform",), self.loguniform, "low must be above 0")
        require(
            math.isfinite(high / low), ("loguniform",), self.loguniform, "low is too near to 0: high / low overflows"
        )
        require(low <= high, ("loguniform",), self.loguniform, "low must not be above high")
        return self

    @property
    def support(self) -> tuple[float, float]:
        return self.loguniform

    def value(self, u: Floats) -> Floats:
        """Return ``low (high / low)^u``."""
        low, high = self.loguniform
        return np.clip(low * exp_each((u * log(high / low)).ravel()).reshape(u.shape), low, high)


class NormalShape(_Distribution):
    """Parameters of a truncated normal distribution: mean and standard deviation before truncation, and bounds."""

    mean: Number  # mean before truncation
    sd: Number  # standard deviation before truncation
    low: Number  # smallest possible value
    high: Number  # largest possible value


class Normal(_Distribution):
    """``{normal: {mean, sd, low, high}}``: a normal distribution truncated to [low, high]."""

    normal: NormalShape  # parameters of the distribution

    @model_validator(mode="after")
    def _possible(self) -> Normal:
        shape = self.normal
        require(shape.sd > 0.0, ("normal",), shape, "sd must be above 0")
        require(shape.low < shape.high, ("normal",), shape, "low must be below high")
        below, above = self._bounds()
        require(above - below >= LEAST_MASS, ("normal",), shape, _LEAST)
        return self

    def _bounds(self) -> tuple[float, float]:
        """Return the probabilities that a value before truncation is below ``low``, and below ``high``."""
        shape = self.normal
        low, high = (normal_probability((end - shape.mean) / shape.sd) for end in (shape.low, shape.high))
        return low, high

    @property
    def support(self) -> tuple[float, float]:
        return self.normal.low, self.normal.high

    def value(self, u: Floats) -> Floats:
        """Return ``mean + sd Q(p_low + (p_high - p_low) u)``.

        Q is the quantile function of the standard normal distribution; p_low and p_high are the two probabilities that
        ``_bounds`` returns.
        """
        shape = self.normal
        below, above = self._bounds()
        quantile = normal_quantile_each((below + (above - below) * u).ravel()).reshape(u.shape)
        return np.clip(shape.mean + shape.sd * quantile, shape.low, shape.high)


class LogNormalShape(_Distribution):
    """Parameters of a truncated lognormal distribution: median, standard deviation of the logarithm, and bounds."""

    median: Number  # median before truncation
    sigma: Number  # standard deviation of the logarithm, before truncation
    low: Number  # smallest possible value
    high: Number  # largest possible value


class LogNormal(_Distribution):
    """``{lognormal: {median, sigma, low, high}}``: a lognormal distribution truncated to [low, high]."""

    lognormal: LogNormalShape  # parameters of the distribution
    _of_logarithm: Normal = PrivateAttr()  # distribution of the logarithm of a value

    @model_validator(mode="after")
    def _possible(self) -> LogNormal:
        shape, at = self.lognormal, ("lognormal",)
        require(min(shape.median, shape.low) > 0.0, at, shape, "median and low must be above 0")
        require(shape.sigma > 0.0, at, shape, "sigma must be above 0")
        require(shape.low < shape.high, at, shape, "low must be below high")
        middle, low, high = (log(value) for value in (shape.median, shape.low, shape.high))
        try:
            self._of_logarithm = Normal(normal={"mean": middle, "sd": shape.sigma, "low": low, "high": high})  # type: ignore[arg-type]
        except ValidationError:
            refuse(at, shape, _LEAST)
        return self

    @property
    def support(self) -> tuple[float, float]:
        return self.lognormal.low, self.lognormal.high

    def value(self, u: Floats) -> Floats:
        """Return ``exp(x)``, where x has a normal distribution truncated to [log(low), log(high)]."""
        drawn = exp_each(self._of_logarithm.value(u).ravel()).reshape(u.shape)
        return np.clip(drawn, *self.support)


class Choice(_Distribution):
    """``{choice: [a, b, ...]}``: one of the listed values, equally likely or in proportion to ``weights: [...]``."""

    choice: Numbers  # the possible values
    weights: Numbers | None = None  # weight of each value; None: all values are equally likely

    @model_validator(mode="after")
    def _weighted(self) -> Choice:
        if self.weights is not None:
            fits = f"must have as many entries as choice ({len(self.choice)})"
            require(len(self.weights) == len(self.choice), ("weights",), self.weights, fits)
            positive = all(w > 0.0 for w in self.weights) and math.isfinite(sum(self.weights))
            require(positive, ("weights",), self.weights, "every weight must be above 0, and their sum finite")
        return self

    @property
    def support(self) -> tuple[float, float]:
        return min(self.choice), max(self.choice)

    def value(self, u: Floats) -> Floats:
        """Return the first entry of ``choice`` whose cumulative weight, normalised to a total of 1, is above ``u``."""
        cumulative = np.cumsum(np.asarray(self.weights or (1.0,) * len(self.choice)))
        cumulative /= cumulative[-1]
        return np.asarray(self.choice)[np.searchsorted(cumulative, u, side="right")]


@dataclass(frozen=True, slots=True, repr=False)
class TableColumn:
    """A column of a scenario's table of measured values; every world takes one row of the table, drawn by weight."""

    name: str  # name of the column, such as ``gap_1_m``
    rows: NDArray[Any] = data_field(compare=False)  # [rows] value in each row; texts in the column ``recording``
    cumulative: Floats = data_field(compare=False)  # [rows] cumulative weight of the rows; the last one is 1

    def __repr__(self) -> str:
        return f"column {self.name} of the table"

    @property
    def support(self) -> tuple[float, float]:
        return float(self.rows.min()), float(self.rows.max())

    @property
    def middle(self) -> TableColumn:
        """Copy of this column with a single row, which contains the weighted median of all rows."""
        order = np.argsort(self.rows, kind="stable")
        shares = np.cumsum(np.diff(self.cumulative, prepend=0.0)[order])
        return replace(self, rows=self.rows[order][[np.searchsorted(shares, 0.5)]], cumulative=np.ones(1))

    def value(self, u: Floats) -> NDArray[Any]:
        """Return the entry of the first row whose cumulative weight, normalised to a total of 1, is above ``u``."""
        return self.rows[np.searchsorted(self.cumulative, u, side="right")]


def _kind(value: object) -> str | None:
    """Return the tag of the class in ``Quantity`` that checks a value from a file, such as ``"#uniform"``.

    Return None for a list, and for a mapping that contains no name of a distribution.
    """
    if isinstance(value, _Distribution):
        return f"#{type(value).__name__.lower()}"
    if isinstance(value, dict):
        return next((f"#{name}" for name in DISTRIBUTIONS if name in value), None)
    return None if isinstance(value, list | tuple) else "#number"


DISTRIBUTIONS = ("uniform", "loguniform", "normal", "lognormal", "choice")

# Tags begin with # to distinguish them from keys in the location of an error.
Quantity = Annotated[
    Annotated[Number, Tag("#number")]
    | Annotated[Uniform, Tag("#uniform")]
    | Annotated[LogUniform, Tag("#loguniform")]
    | Annotated[Normal, Tag("#normal")]
    | Annotated[LogNormal, Tag("#lognormal")]
    | Annotated[Choice, Tag("#choice")],
    Discriminator(_kind, custom_error_type="quantity", custom_error_message="no such quantity"),
]


class WithLoad(_Distribution):
    """``{with_load: [empty, full]}``: linear in the load, ``empty`` at 0 and ``full`` at 1; only in vehicle types.

    ``spread`` is the distribution, around 0, of a random amount that is added to each vehicle's value.
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
        """Return ``empty + (full - empty) load``, plus the value of the distribution ``spread`` for ``u``.

        The loads are in [0, 1]; ``load`` and ``u`` have the same shape.
        """
        empty, full = self.with_load
        moved = np.clip(empty + (full - empty) * load, min(self.with_load), max(self.with_load))
        return moved if self.spread == 0.0 else moved + values(self.spread, u)


AnyQuantity = float | Uniform | LogUniform | Normal | LogNormal | Choice | TableColumn

AnyTypeQuantity = AnyQuantity | WithLoad


def support(quantity: AnyTypeQuantity) -> tuple[float, float]:
    """Return the smallest and the largest value that ``quantity`` can have."""
    return (quantity, quantity) if isinstance(quantity, float) else quantity.support


def values(quantity: AnyQuantity, u: Floats) -> Floats:
    """Return the values of ``quantity`` drawn by uniform numbers ``u`` in [0, 1), in the shape of ``u``."""
    return np.full(u.shape, quantity) if isinstance(quantity, float) else quantity.value(u)
