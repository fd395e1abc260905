"""The quantities that describe a world: meaning, unit, allowed range, and the place of each in the random numbers.

Speeds, gaps and an obstacle may be declared in another way (``OTHERWISE``). One table serves the schema, its messages,
the tables of initial states and the sampling.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Discriminator, Field, Tag, model_validator

from ethbrake_marl.files.yaml import UNITS, FileModel, refuse
from ethbrake_marl.physics.compiled import exp_each, log, normal_probability, normal_quantile_each
from ethbrake_marl.physics.worlds import Floats, Ints, Worlds, concatenate

BLOCK = 8  # uniform numbers per vehicle and world; a multiple of 4, the numbers of one Philox counter

SYMBOLS = {"mps": "m/s", "mps2": "m/s2"}  # of the endings that are not their own symbol


@dataclass(frozen=True, slots=True)
class QuantityRule:
    """What a quantity means and which values it may take."""

    name: str  # key in a scenario, field of Worlds or Vehicles
    unit: str  # key of UNITS, or "" for a plain number
    per: Literal["vehicle", "pair", "world"]
    high: float  # largest allowed value
    positive: bool  # 0 is refused
    slot: int  # column inside a vehicle's block of uniform numbers
    column: str  # name in a table of initial states
    meaning: str
    example: str
    low: float = 0.0  # smallest allowed value
    block: int = 0  # vehicle (from 0) in whose block of uniform numbers entry 0 stands

    @property
    def interval(self) -> str:
        """The allowed range, with its unit, as messages write it."""
        unit = f" {SYMBOLS.get(self.unit, self.unit)} ({UNITS[self.unit]})" if self.unit else ""
        return f"finite and in {'(' if self.positive else '['}{self.low:g}, {self.high:g}]{unit}"

    def allows(self, low: float, high: float) -> bool:
        """Whether every value from ``low`` to ``high`` is in range; false for NaN."""
        return (low > 0.0 if self.positive else low >= self.low) and high <= self.high

    def count(self, vehicles: int) -> int:
        """How many values a world of ``vehicles`` vehicles has."""
        return {"vehicle": vehicles, "pair": vehicles - 1, "world": 1}[self.per]

    def place(self, index: int) -> int:
        """Which of a world's uniform numbers belongs to entry ``index`` (from 0)."""
        return BLOCK * (self.block + index) + self.slot

    def column_of(self, index: int) -> str:
        """Name of the column that holds entry ``index`` (from 0) in a table of initial states."""
        return self.column.format(index + 1)

    def owner(self, index: int) -> str:
        """Whose value entry ``index`` (from 0) is, in words; empty for a value of the whole world."""
        front = f"vehicle_{index + 1}"
        return {"vehicle": front, "pair": f"{front} to vehicle_{index + 2}", "world": ""}[self.per]


# The upper ends are far outside traffic: they catch a value in the wrong unit (kilograms, kilometres per hour).
# The slots are fixed for ever: another order would give other worlds for the same seed.
QUANTITIES = {
    rule.name: rule
    for rule in (
        QuantityRule(
            "gaps_m", "m", "pair", 1e4, False, 0, "gap_{}_m",
            "bumper-to-bumper gap of each pair at the alert, front to rear", "[7, 7]",
        ),
        QuantityRule(
            "speeds_mps", "mps", "vehicle", 200.0, False, 1, "speed_{}_mps",
            "speed of each vehicle at the alert", "[20, 18, 20]",
        ),
        QuantityRule(
            "braking_capacity_mps2", "mps2", "vehicle", 100.0, True, 2, "braking_capacity_{}_mps2",
            "largest deceleration of each vehicle", "[6, 7, 6]",
        ),
        QuantityRule(
            "driving_capacity_mps2", "mps2", "vehicle", 100.0, False, 3, "driving_capacity_{}_mps2",
            "largest forward acceleration of each vehicle", "[6, 7, 6]",
        ),
        QuantityRule(
            "latency_s", "s", "vehicle", 3600.0, False, 4, "latency_{}_s",
            "time from the alert until a vehicle's commands take effect; it coasts until then", "[0, 0.5, 0.8]",
        ),
        QuantityRule(
            "mass_t", "t", "vehicle", 1000.0, True, 5, "mass_{}_t",
            "mass of each vehicle", "[4.5, 5.5, 5.9]",
        ),
        QuantityRule(
            "speed_limit_mps", "mps", "vehicle", 200.0, True, 6, "speed_limit_{}_mps",
            "speed at which driving stops accelerating", "40",
        ),
        QuantityRule(
            "restitution", "", "world", 1.0, False, 7, "restitution",
            "coefficient of restitution of every impact: 0 plastic, 1 elastic", "0.1",
        ),
    )
}  # fmt: skip

# Other ways to declare speeds, gaps and an obstacle. What replaces a quantity takes over its uniform numbers; the speed
# of the line has the one number of vehicle_2 that restitution, one per world, leaves free.
OTHERWISE = {
    rule.name: rule
    for rule in (
        QuantityRule(
            "time_gaps_s", "s", "pair", 60.0, True, 0, "",
            "gap of each pair divided by the speed of its rear vehicle, front to rear", "[1, 1]",
        ),
        QuantityRule(
            "line_speed_mps", "mps", "world", 200.0, False, 7, "",
            "speed that all vehicles share at the alert", "20", block=1,
        ),
        QuantityRule(
            "speed_deviations_mps", "mps", "vehicle", 200.0, False, 1, "",
            "what each vehicle adds to line_speed_mps", "[0, -2, 0]", low=-200.0,
        ),
        QuantityRule(
            "obstacle_margin_m", "m", "world", 1e4, True, 0, "",
            "distance of that obstacle from where vehicle_1 stops by full braking as soon as it can", "1.7",
        ),
    )
}  # fmt: skip
# What a world need not have. It has a stream of random numbers of its own.
OPTIONAL = {
    rule.name: rule
    for rule in (
        QuantityRule(
            "obstacle_gap_m", "m", "world", 1e4, True, 0, "obstacle_gap_m",
            "distance from the front of vehicle_1 to an unmovable obstacle ahead, at the alert", "42",
        ),
    )
}  # fmt: skip
DECLARED = {**QUANTITIES, **OTHERWISE, **OPTIONAL}  # every key that declares a quantity
# A scenario has exactly one of each two, or at most one where what they declare is optional.
ALTERNATIVES = {"gaps_m": "time_gaps_s", "speeds_mps": "line_speed_mps", "obstacle_gap_m": "obstacle_margin_m"}


# A quantity of a scenario: a fixed number, or a declared distribution.
#
# Each distribution is a pure function of one uniform number ``u`` in [0, 1): its inverse cumulative distribution
# function. One quantity therefore uses up exactly one uniform number, whatever its distribution is.

LEAST_MASS = 1e-6  # of a normal distribution inside its bounds; below it the inverse loses its digits

Number = Annotated[float, Field(allow_inf_nan=False)]
Pair = Annotated[tuple[Number, Number], Field(strict=False)]
Numbers = Annotated[tuple[Number, ...], Field(strict=False, min_length=1)]


class _Distribution(FileModel):
    """A way to draw a quantity."""


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
        refuse((key,), value, right)


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


# A part of a list of worlds: the worlds, where they stand in the list, and what they were drawn as.

Texts = NDArray[np.str_]


@dataclass(frozen=True, slots=True)
class Sample:
    """Worlds at the alert, and where in the list they stand.

    >>> import ethbrake_marl as eb
    >>> sample = eb.load_scenario("paper-random").sample(2, seed=7)
    >>> sample.index, sample.worlds.gaps_m.round(2)
    (array([0, 1]), array([[6.62, 8.49], [5.33, 7.79]]))

    """

    worlds: Worlds  # at t = 0
    index: Ints  # [n] number of each world in the list of its seed
    rejected: int  # draws refused because of an early impact
    types: Texts | None = None  # [n, N] type of every vehicle, where a scenario has types; empty: it has none
    scenarios: Texts | None = None  # [n] the scenario of a mixture that each world was drawn from

    def __repr__(self) -> str:
        numbers = f"numbers {self.index.min()} to {self.index.max()}" if len(self.index) else "no numbers"
        return f"Sample({self.worlds!r}, {numbers}, {self.rejected:,} rejected)"

    def take(self, rows: ArrayLike) -> Sample:
        """Some of the worlds, by row or mask (always a copy); none of them was rejected."""
        some = np.asarray(rows)
        types, scenarios = (None if each is None else each[some] for each in (self.types, self.scenarios))
        return Sample(self.worlds.take(some), self.index[some], 0, types, scenarios)


def quantity(worlds: Worlds, field: str) -> Floats:
    """A quantity of every world, [n, entries]: one entry per vehicle, pair or world (see ``QUANTITIES``)."""
    holder = worlds if field in ("gaps_m", "speeds_mps", *OPTIONAL) else worlds.vehicles
    values: Floats = getattr(holder, field)
    return values.reshape(worlds.n, -1)


def quantity_rules(worlds: Worlds) -> dict[str, QuantityRule]:
    """The quantities that these worlds have: the distance to an obstacle only where there is one."""
    return {**QUANTITIES, **OPTIONAL} if np.isfinite(worlds.obstacle_gap_m).all() else QUANTITIES


def quantity_columns(worlds: Worlds) -> dict[str, Floats]:
    """Every quantity of the worlds, each [n], named as in a table of initial states: ``gap_1_m``, ``mass_2_t``."""
    return {
        rule.column_of(i): values
        for field, rule in quantity_rules(worlds).items()
        for i, values in enumerate(quantity(worlds, field).T)
    }


def kind_columns(types: Texts | None, scenarios: Texts | None) -> dict[str, Texts]:
    """``scenario`` of a mixture and ``vehicle_K_type``, each [n], where the worlds were drawn with such."""
    columns = {} if scenarios is None else {"scenario": scenarios}
    if types is not None:
        columns |= {f"vehicle_{i + 1}_type": column for i, column in enumerate(types.T)}
    return columns


def count_kinds(sample: Sample) -> str:
    """How often each scenario of a mixture, and each type of a vehicle, is in the sample; empty without such."""
    told = ""
    for kind, column in kind_columns(sample.types, sample.scenarios).items():
        names, counts = np.unique(column, return_counts=True)
        told += f"; {kind}: " + ", ".join(f"{n or 'none'} {c}" for n, c in zip(names, counts, strict=True))
    return told


def join_samples(parts: Sequence[Sample], rejected: int) -> Sample:
    """The worlds of all parts in the order of their numbers; all have types, or scenarios, or none has."""
    index = np.concatenate([part.index for part in parts])
    order = np.argsort(index)
    types, scenarios = (_joined([getattr(part, name) for part in parts], order) for name in ("types", "scenarios"))
    worlds = concatenate([part.worlds for part in parts]).take(order)
    return Sample(worlds, index[order], rejected, types, scenarios)


def _joined(columns: Sequence[Texts | None], order: Ints) -> Texts | None:
    given = [column for column in columns if column is not None]
    return np.concatenate(given)[order] if given else None
