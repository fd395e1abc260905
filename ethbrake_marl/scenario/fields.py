"""Fields of a scenario: the quantities of a world and how they are drawn, roles, and types of vehicles."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from operator import not_
from typing import Annotated, Any, Literal, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import (
    AfterValidator,
    Discriminator,
    Field,
    GetJsonSchemaHandler,
    PrivateAttr,
    Tag,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.yaml import UNITS, UNSHOWN, FileModel, YamlPath, parse_numeral, refuse, suggestion
from ethbrake_marl.harm import ObjectiveName
from ethbrake_marl.physics.compiled import exp_each, log, normal_probability, normal_quantile_each
from ethbrake_marl.physics.worlds import Floats, Ints, Worlds, concatenate
from ethbrake_marl.scenario.features import ListedFeatures
from ethbrake_marl.scenario.v2x import V2X

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


# The fields of a scenario: what a file may say, before anything is checked or drawn.

# Roles: who learns, names of scripts (``name[:argument]``), and the commands of the scripts that need no state.

LEARNER = "learner"
STATE_FREE = ("full_brake", "coast", "constant")  # names of the scripts whose command never depends on the state

_SPEC = re.compile(r"(?P<name>[a-z][a-z0-9_@.-]*)(:(?P<argument>\S+))?")


@lru_cache(maxsize=256)
def parse_agent_spec(spec: str) -> tuple[str, str | None]:
    """Split ``name[:argument]``, for instance ``constant:3.5``, into its name and its argument or None.

    Raises ``InvalidInput`` unless the name matches ``[a-z][a-z0-9_@.-]*`` and the argument has no blanks, and for a
    Python file: a scenario that somebody else wrote must not run code.
    """
    match = _SPEC.fullmatch(spec) if isinstance(spec, str) else None
    if match is None:
        raise InvalidInput(
            f"agent {spec!r}: must be name or name:argument, the name in lower case letters, digits and _ @ . -,"
            " for instance full_brake or constant:3.5"
        )
    if match["name"].endswith(".py"):
        raise InvalidInput(
            f"agent {spec!r}: is a function of a Python file, and those are loaded only where a person names them"
            " (--agents, --plugin); no scenario does. A plug-in can register it under a name"
        )
    return match["name"], match["argument"]


@lru_cache(maxsize=256)
def constant_deceleration(spec: str) -> float | None:
    """The deceleration a (m/s2, negative = drive) of ``constant:a``; None for any other script.

    Raises ``InvalidInput`` when a is missing or not a finite number.
    """
    name, argument = parse_agent_spec(spec)
    if name != "constant":
        return None
    deceleration = parse_numeral(argument or "")
    if deceleration is None or not math.isfinite(deceleration):
        raise InvalidInput(
            f"agent {spec!r}: constant needs a finite deceleration in m/s2 after the colon, for instance constant:3.5"
        )
    return deceleration


@lru_cache(maxsize=256)
def is_state_free(spec: str) -> bool:
    """Whether the script's command never depends on the state: ``full_brake``, ``coast`` or ``constant:a``.

    Raises ``InvalidInput`` when such a script has an argument it does not take, or lacks the one it needs.
    """
    name, argument = parse_agent_spec(spec)
    if name in ("full_brake", "coast"):
        if argument is not None:
            raise InvalidInput(f"agent {spec!r}: {name} takes no argument")
        return True
    return constant_deceleration(spec) is not None


def constant_command(
    spec: str, braking_capacity_mps2: ArrayLike, driving_capacity_mps2: ArrayLike | None = None
) -> Floats | None:
    """Signed command (m/s2) of a state-free script, in the shape of the capacity; None for any other script.

    ``full_brake`` -> -capacity, ``coast`` -> 0, ``constant:a`` -> -a. Raises ``InvalidInput`` when a is above the
    braking capacity of any vehicle, or -a above its driving capacity where that is given.
    """
    capacity = np.asarray(braking_capacity_mps2, dtype=np.float64)
    if not is_state_free(spec):
        return None
    deceleration = constant_deceleration(spec)
    if deceleration is None:
        return -capacity if spec == "full_brake" else np.zeros(capacity.shape)
    if not np.all(deceleration <= capacity):
        raise InvalidInput(f"agent {spec!r}: above the braking capacity {np.min(capacity):g} m/s2")
    if driving_capacity_mps2 is not None and not np.all(-deceleration <= np.asarray(driving_capacity_mps2)):
        raise InvalidInput(f"agent {spec!r}: above the driving capacity {np.min(driving_capacity_mps2):g} m/s2")
    return np.full(capacity.shape, 0.0 - deceleration)


class Roles(dict[str, str]):
    """Vehicle -> ``learner`` or a script; like the rest of a scenario it cannot be changed."""

    def _refuse(self, *args: object, **kwargs: object) -> NoReturn:
        raise InvalidInput("roles of a scenario are frozen; use scenario.replace(roles=...) or scenario.with_learners")

    __setitem__ = __delitem__ = __ior__ = _refuse
    update = setdefault = pop = popitem = clear = _refuse

    def __reduce__(self) -> tuple[type[Roles], tuple[dict[str, str]]]:
        """Copy and pickle through the constructor."""
        return Roles, (dict(self),)


def complete_roles(given: Mapping[str, str] | None, vehicles: int) -> Roles:
    """A role for every vehicle in order: full braking where none is given; by default vehicle_2 learns."""
    roles = {"vehicle_2": LEARNER} if given is None else given
    names = [f"vehicle_{i + 1}" for i in range(vehicles)]
    return Roles({name: roles.get(name, "full_brake") for name in names})


# Types of vehicles: what a car, a van or a truck is, drawn together, and which of them may stand where.
#
# A world's vehicle first gets its type, then its quantities as that type declares them. What moves with the load of a
# vehicle, ``{with_load: [empty, full]}``, moves together: a full truck is heavy *and* brakes weakly.

ANY = "any"  # in ``types``: every type, by its weight
TYPE_KEYS = ("braking_capacity_mps2", "driving_capacity_mps2", "mass_t", "latency_s", "speed_limit_mps")

TypeName = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,63}$")]
Weight = Annotated[float, Field(gt=0.0, le=1e9, allow_inf_nan=False)]


def _loaded(value: object) -> str:
    return "#with_load" if isinstance(value, WithLoad) or (isinstance(value, dict) and "with_load" in value) else "#one"


TypeQuantity = Annotated[
    Annotated[Quantity, Tag("#one")] | Annotated[WithLoad, Tag("#with_load")], Discriminator(_loaded)
]
AnyTypeQuantity = float | Uniform | LogUniform | Normal | Choice | WithLoad


class VehicleType(FileModel):
    """One type: how likely it is, and every quantity that it declares; the rest is as beside ``vehicle_types``."""

    weight: Weight = Field(default=1.0, description="how likely it is, relative to the other types")
    load: Quantity = Field(
        default_factory=lambda: Uniform(uniform=(0.0, 1.0)), description="share of the full load, 0 to 1"
    )
    braking_capacity_mps2: TypeQuantity | None = Field(
        default=None, description=DECLARED["braking_capacity_mps2"].meaning
    )
    driving_capacity_mps2: TypeQuantity | None = Field(
        default=None, description=DECLARED["driving_capacity_mps2"].meaning
    )
    mass_t: TypeQuantity | None = Field(default=None, description=DECLARED["mass_t"].meaning)
    latency_s: TypeQuantity | None = Field(default=None, description=DECLARED["latency_s"].meaning)
    speed_limit_mps: TypeQuantity | None = Field(default=None, description=DECLARED["speed_limit_mps"].meaning)

    @field_validator(*TYPE_KEYS)
    @classmethod
    def _in_range(cls, value: Any, info: ValidationInfo) -> Any:
        if value is None:
            refuse((), value, "must be a number or a distribution; a key that is not used is left out")
        rule = DECLARED[str(info.field_name)]
        if not rule.allows(*support(value)):
            refuse((), value, f"must be {rule.interval}")
        return value

    @field_validator("load")
    @classmethod
    def _share(cls, value: Any) -> Any:
        low, high = support(value)
        if not (low >= 0.0 and high <= 1.0):
            refuse((), value, "must be in [0, 1]: 0 empty, 1 full")
        return value


def _check_type_names(kinds: dict[str, VehicleType]) -> dict[str, VehicleType]:
    if ANY in kinds:
        refuse((ANY,), UNSHOWN, f"{ANY} stands for every type; give another name")
    return kinds


VehicleTypes = Annotated[dict[TypeName, VehicleType], Field(min_length=1), AfterValidator(_check_type_names)]
TypesHere = str | dict[str, Weight]  # of one vehicle: a type, ``any``, or a weight for each type that may stand there


def _one_or_each(value: object) -> str:
    return "#each" if isinstance(value, list | tuple) else "#one"


Types = Annotated[
    Annotated[TypesHere, Tag("#one")]
    | Annotated[tuple[TypesHere, ...], Field(strict=False, min_length=1), Tag("#each")],
    Discriminator(_one_or_each),
]


def check_types(types: Any, kinds: Mapping[str, VehicleType] | None, vehicles: int) -> None:
    """Every entry names types that are declared, and a list has one entry per vehicle."""
    if kinds is None:
        refuse((), types, "needs vehicle_types, which says what the types are")
    listed = isinstance(types, tuple)
    if listed and len(types) != vehicles:
        refuse((), UNSHOWN, f"has {len(types)} entries; {vehicles} vehicles need {vehicles}, or one for all")
    for index, entry in enumerate(types if listed else (types,)):
        at: YamlPath = (index,) if listed else ()
        names = [entry] if isinstance(entry, str) else list(entry)
        if not names:
            refuse(at, entry, "must name a type")
        for name in names:
            if name not in kinds and not (name == ANY and isinstance(entry, str)):
                hint = suggestion(name, kinds) or f"known: {', '.join(kinds)}"
                refuse(at, entry, f"unknown type {name}; {hint}")


class TypesOfLine:
    """Which types may stand at each place of a line, and how likely each is there."""

    def __init__(self, kinds: Mapping[str, VehicleType], types: Types | None, vehicles: int) -> None:
        self.names = tuple(kinds)
        self.kinds = tuple(kinds.values())
        given: Sequence[TypesHere]
        given = types if isinstance(types, tuple) else (ANY if types is None else types,) * vehicles
        self.weights = np.array([[_weight(kinds, name, here) for name in kinds] for here in given])

    def possible(self, vehicle: int) -> list[int]:
        """Indices of the types that may stand there."""
        return np.flatnonzero(self.weights[vehicle] > 0.0).tolist()

    def draw(self, u: Floats) -> tuple[Ints, Floats]:
        """Type (index) and load of every vehicle, both [n, N], from uniform numbers ``u`` [n, N, 2]."""
        n, vehicles = u.shape[:2]
        types, load = np.zeros((n, vehicles), np.int64), np.zeros((n, vehicles))
        for i in range(vehicles):
            cumulative = np.cumsum(self.weights[i])
            types[:, i] = np.searchsorted(cumulative / cumulative[-1], u[:, i, 0], side="right")
            for kind in self.possible(i):
                rows, shape = types[:, i] == kind, self.kinds[kind].load
                load[rows, i] = shape if isinstance(shape, float) else shape.value(u[rows, i, 1])
        return types, load


def _weight(kinds: Mapping[str, VehicleType], name: str, here: TypesHere) -> float:
    if isinstance(here, str):
        return kinds[name].weight if here == ANY else float(here == name)
    return here.get(name, 0.0)


def missing_quantity(kinds: Mapping[str, VehicleType], key: str) -> str | None:
    """The first type that does not declare ``key``; None where all do."""
    return next((name for name, kind in kinds.items() if getattr(kind, key) is None), None)


def typed_quantity(kinds: Sequence[VehicleType], kind: int, key: str) -> AnyTypeQuantity | None:
    """What a type declares under ``key``; None where it leaves that to what stands beside ``vehicle_types``."""
    if key not in TYPE_KEYS:
        raise InvalidInput(f"{key}: is no quantity of a type; those are {', '.join(TYPE_KEYS)}")
    found: AnyTypeQuantity | None = getattr(kinds[kind], key)
    return found


AnyQuantity = float | Uniform | LogUniform | Normal | Choice

OF_EVERY_VEHICLE = ("braking_capacity_mps2", "driving_capacity_mps2", "mass_t", "latency_s")  # needed: no default

NAME_PATTERN = r"^[a-z0-9][a-z0-9_-]{0,63}$"


LEFT_OUT: Any = object()  # a key that is not given, where a check must say whether it may be


PerVehicle = Annotated[
    Annotated[Quantity, Tag("#one")] | Annotated[tuple[Quantity, ...], Field(strict=False, min_length=1), Tag("#each")],
    Discriminator(_one_or_each),
]


class _MemberSchema:
    """In a file also a scenario's name, or the path of its file."""

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {"anyOf": [{"type": "string"}, {"type": "object"}]}


class Member(FileModel):
    """One scenario of a mixture: what it says, and how likely it is, relative to the others."""

    scenario: Annotated[dict[str, Any], _MemberSchema] = Field(description="a name, a path, or what its file says")
    weight: Weight = Field(default=1.0, description="how likely it is, relative to the other scenarios")


class ScenarioFields(FileModel):
    """What is declared of a line of vehicles, and what follows from the declaration alone. See ``Scenario``."""

    name: str = Field(pattern=NAME_PATTERN, description="name; equal to the file's name without .yaml")
    title: str = Field(default="", description="one line for lists and figures")
    description: str = Field(default="", description="what the scenario is for")
    source: str = Field(default="", description="where the values come from")
    vehicles: int = Field(default=3, ge=2, le=64, description="number of vehicles N, vehicle_1 in front")
    vehicle_types: VehicleTypes | None = Field(
        default=None,
        exclude_if=not_,
        description="what a car, a truck, ... is: type -> weight and quantities",
    )
    types: Types | None = Field(
        default=None,
        exclude_if=not_,
        description="which types may stand where: a type, any, or a weight for each; one entry for all or one for each",
    )
    mixture: Annotated[tuple[Member, ...], Field(strict=False)] | None = Field(
        default=None,
        exclude_if=not_,
        description="scenarios that each world is drawn from one of, by weight",
    )
    time_step_s: float = Field(default=0.1, ge=1e-4, allow_inf_nan=False, description="time between two decisions")
    horizon_s: float = Field(
        default=8.0, gt=0.0, le=3600.0, allow_inf_nan=False, description="time after which an episode is cut off"
    )
    gaps_m: PerVehicle | None = Field(default=None, description=DECLARED["gaps_m"].meaning)
    time_gaps_s: PerVehicle | None = Field(default=None, description=DECLARED["time_gaps_s"].meaning)
    speeds_mps: PerVehicle | None = Field(default=None, description=DECLARED["speeds_mps"].meaning)
    line_speed_mps: Quantity | None = Field(default=None, description=DECLARED["line_speed_mps"].meaning)
    speed_deviations_mps: PerVehicle = Field(default=0.0, description=DECLARED["speed_deviations_mps"].meaning)
    braking_capacity_mps2: PerVehicle | None = Field(
        default_factory=lambda: LEFT_OUT, validate_default=True, description=DECLARED["braking_capacity_mps2"].meaning
    )
    driving_capacity_mps2: PerVehicle | None = Field(
        default_factory=lambda: LEFT_OUT, validate_default=True, description=DECLARED["driving_capacity_mps2"].meaning
    )
    mass_t: PerVehicle | None = Field(
        default_factory=lambda: LEFT_OUT, validate_default=True, description=DECLARED["mass_t"].meaning
    )
    latency_s: PerVehicle | None = Field(
        default_factory=lambda: LEFT_OUT, validate_default=True, description=DECLARED["latency_s"].meaning
    )
    speed_limit_mps: PerVehicle = Field(default=40.0, description=DECLARED["speed_limit_mps"].meaning)
    restitution: Quantity = Field(default=0.1, description=DECLARED["restitution"].meaning)
    roles: dict[str, str] = Field(
        default_factory=lambda data: complete_roles(None, data.get("vehicles", 3)),
        description="learner or a script for each vehicle; vehicles left out of a given mapping brake fully",
    )
    obstacle_gap_m: Quantity | None = Field(default=None, description=DECLARED["obstacle_gap_m"].meaning)
    obstacle_margin_m: Quantity | None = Field(default=None, description=DECLARED["obstacle_margin_m"].meaning)
    early_impacts: Literal["keep", "reject"] = Field(
        default="keep", description="what happens to worlds with an impact before the first learner may act"
    )

    objective: ObjectiveName | Annotated[tuple[ObjectiveName, ...], Field(strict=False)] = Field(
        default="total", description="whose harm a reward counts: one for all vehicles, or one for each"
    )
    observation: ListedFeatures | None = Field(
        default=None,
        exclude_if=not_,
        description="what vehicles observe: groups and single features, in this order",
    )
    v2x: V2X = Field(
        default_factory=V2X, description="what each vehicle knows when: a preset, and what differs from it"
    )

    _members: tuple[ScenarioFields, ...] = PrivateAttr(default=())

    @property
    def members(self) -> tuple[ScenarioFields, ...]:
        """The scenarios of a mixture, whole; none for any other scenario."""
        return self._members

    @property
    def vehicle_names(self) -> tuple[str, ...]:
        """``vehicle_1`` (front) to ``vehicle_N`` (rear)."""
        return tuple(f"vehicle_{i + 1}" for i in range(self.vehicles))

    @property
    def learners(self) -> tuple[int, ...]:
        """Indices (from 0) of the vehicles that learn."""
        return tuple(i for i, name in enumerate(self.vehicle_names) if self.roles[name] == LEARNER)

    @property
    def scripts(self) -> dict[int, str]:
        """Index (from 0) -> script of every vehicle that does not learn."""
        roles = [self.roles[name] for name in self.vehicle_names]
        return {i: role for i, role in enumerate(roles) if role != LEARNER}

    @property
    def has_obstacle(self) -> bool:
        """Whether an obstacle stands ahead of Vehicle 1, however its distance is declared."""
        if self.members:
            return any(member.has_obstacle for member in self.members)
        return self.obstacle_gap_m is not None or self.obstacle_margin_m is not None

    @property
    def by_link(self) -> bool:
        """Whether news may come link by link, in some member of a mixture at least; see ``V2X.by_link``."""
        return any(member.by_link for member in self.members) or self.v2x.by_link

    @property
    def types_of_line(self) -> TypesOfLine | None:
        """Which types may stand where; None without types."""
        return None if self.vehicle_types is None else TypesOfLine(self.vehicle_types, self.types, self.vehicles)

    def possible_quantities(self, field: str) -> tuple[dict[int, AnyTypeQuantity], ...]:
        """``quantities`` by the type that the vehicle has (index; 0 without types), one mapping per entry.

        A type that says nothing of it has what is declared beside the types. Raises as ``quantities``.
        """
        line = self.types_of_line
        if line is None or field not in TYPE_KEYS:
            return tuple({0: each} for each in self.quantities(field))
        found: list[dict[int, AnyTypeQuantity]] = []
        for i in range(self.vehicles):
            own = {kind: typed_quantity(line.kinds, kind, field) for kind in line.possible(i)}
            found.append({kind: self.quantities(field)[i] if each is None else each for kind, each in own.items()})
        return tuple(found)

    def supports(self, field: str) -> tuple[tuple[float, float], ...]:
        """Smallest and largest value of every entry of ``quantities``, whatever type stands there."""
        found = []
        for each in self.possible_quantities(field):
            lows, highs = zip(*(support(quantity) for quantity in each.values()), strict=True)
            found.append((min(lows), max(highs)))
        return tuple(found)

    def quantities(self, field: str) -> tuple[AnyQuantity, ...]:
        """What is declared under a key, one entry per vehicle (gaps: per pair; restitution, line speed: one).

        Raises ``InvalidInput`` for a key that this scenario does not use, ``gaps_m`` beside ``time_gaps_s``.
        """
        declared: AnyQuantity | tuple[AnyQuantity, ...] | None = getattr(self, DECLARED[field].name)
        if self.members:
            raise InvalidInput(f"scenario {self.name!r}: is a mixture; its members say what {field} is")
        if declared is None:
            raise InvalidInput(f"scenario {self.name!r}: {field} is not given; it is derived, see Scenario.bounds")
        if isinstance(declared, tuple):
            return declared
        return (declared,) * DECLARED[field].count(self.vehicles)
