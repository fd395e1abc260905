"""``Scenario``: a validated, immutable description of how worlds are drawn."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from functools import cached_property
from operator import not_
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    Field,
    GetJsonSchemaHandler,
    PrivateAttr,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError

from ethbrake_marl.episode.features import known_names, listed_features
from ethbrake_marl.episode.objectives import OBJECTIVES, objectives_of
from ethbrake_marl.episode.observe import View
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.files.model import NAME_PATTERN, UNSHOWN, FileModel, explain, refuse, require, suggestion
from ethbrake_marl.files.yaml import Document
from ethbrake_marl.motion.layout import Floats, Ints
from ethbrake_marl.worlds.channel import HEARS, V2X, Equipage, Equipped
from ethbrake_marl.worlds.checks import check_whole, undeclared_by_type
from ethbrake_marl.worlds.counters import Channel
from ethbrake_marl.worlds.derived import on_road, world_values
from ethbrake_marl.worlds.describe import columns_of
from ethbrake_marl.worlds.mixture import WORDS, Member, build_members, changed_content
from ethbrake_marl.worlds.quantity import LEAVE_OUT, PerVehicle, Quantity, support
from ethbrake_marl.worlds.roles import LEARNER, Roles, check_role
from ethbrake_marl.worlds.rules import (
    ALTERNATIVES,
    NEEDED,
    OF_A_TYPE,
    OPTIONAL,
    RECORDING,
    RULES,
    USUAL,
    Entry,
    table_columns,
)
from ethbrake_marl.worlds.sampling import Drawn, draw
from ethbrake_marl.worlds.table import Table, TableColumn
from ethbrake_marl.worlds.vehicle_types import Types, TypesOfLine, VehicleTypes, check_types
from ethbrake_marl.worlds.wording import ScenarioWording

_LEFT_OUT: Any = object()  # default of a missing key, which a check then accepts or refuses


class _ObjectiveSchema:
    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        kinds = OBJECTIVES.usable()
        plain = [name for name, kind in kinds.items() if ":" not in kind.form]
        with_argument = "|".join(name for name, kind in kinds.items() if ":" in kind.form)
        return {"type": "string", "anyOf": [{"enum": plain}, {"pattern": f"^({with_argument}):"}]}


class _FeaturesSchema:
    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        further = {"type": "string", "pattern": r"^(front|rear)_[1-9][0-9]?(\.[a-z0-9_]+)?$"}
        items = {"anyOf": [{"type": "string", "enum": known_names()}, further]}
        return {"type": "array", "items": items, "minItems": 1, "uniqueItems": True}


Objective = Annotated[str, _ObjectiveSchema]
Listed = Annotated[tuple[str, ...], Field(strict=False), _FeaturesSchema]
ListedByVehicle = Annotated[
    dict[Annotated[str, Field(pattern=r"^vehicle_[1-9][0-9]?$")], Listed],
    Field(min_length=1, json_schema_extra={"additionalProperties": False}),
]


def _meaning(key: str, **more: Any) -> Any:
    """Return the field of a quantity that may be left out."""
    return Field(default=None, description=RULES[key].meaning, **more)


def _needed(key: str) -> Any:
    return Field(default_factory=lambda: _LEFT_OUT, validate_default=True, description=RULES[key].meaning)


class Scenario(FileModel):
    """A line of vehicles, the distribution of each quantity, and the vehicles that learn.

    A quantity is a number, ``{uniform: [low, high]}``, ``{loguniform: [low, high]}``,
    ``{normal: {mean, sd, low, high}}``, ``{lognormal: {median, sigma, low, high}}`` or ``{choice: [...]}``. One entry
    is for all vehicles, each of which draws its own value; a list has one entry per vehicle, or per pair for gaps.
    ``Scenario(...)``, ``load_scenario`` and ``replace`` raise ``InvalidInput`` for an invalid value.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("paper-random").replace(mass_t=[4.5, 5.5, 40.0])
    >>> scenario.bounds("mass_t")
    ((4.5, 4.5), (5.5, 5.5), (40.0, 40.0))

    """

    name: str = Field(pattern=NAME_PATTERN, description="name of the scenario: the file's name without .yaml")
    title: str = Field(default="", description="one-line title for lists and figures")
    description: str = Field(default="", description="what the scenario is for")
    source: str = Field(default="", description="where the values come from")
    vehicles: int = Field(default=3, ge=2, le=64, description="number of vehicles N, with vehicle_1 in front")
    vehicle_types: VehicleTypes | None = Field(
        default=None,
        exclude_if=not_,
        description="vehicle types by name, such as car and truck: how likely each type is, and its quantities",
    )
    types: Types | None = Field(
        default=None,
        exclude_if=not_,
        description="possible types of each vehicle: a type's name, any, or a mapping from types to weights; give one"
        " entry for all vehicles or a list with one entry per vehicle",
    )
    mixture: Annotated[tuple[Member, ...], Field(strict=False)] | None = Field(
        default=None, exclude_if=not_, description="scenarios with weights; each world is drawn from one of them"
    )
    table: Table | None = Field(
        default=None,
        exclude_if=not_,
        description="table of measured values: every world takes one row; quantities without a column are drawn",
    )
    time_step_s: float = Field(default=0.1, ge=1e-3, allow_inf_nan=False, description="time between two decisions")
    horizon_s: float = Field(
        default=8.0, gt=0.0, le=3600.0, allow_inf_nan=False, description="time at which an episode is truncated"
    )
    gaps_m: PerVehicle | None = _meaning("gaps_m")
    time_gaps_s: PerVehicle | None = _meaning("time_gaps_s")
    speeds_mps: PerVehicle | None = _meaning("speeds_mps")
    line_speed_mps: Quantity | None = _meaning("line_speed_mps")
    speed_deviations_mps: PerVehicle = Field(default=0.0, description=RULES["speed_deviations_mps"].meaning)
    braking_capacity_mps2: PerVehicle | None = _needed("braking_capacity_mps2")
    driving_capacity_mps2: PerVehicle | None = _needed("driving_capacity_mps2")
    mass_t: PerVehicle | None = _needed("mass_t")
    latency_s: PerVehicle | None = _needed("latency_s")
    speed_limit_mps: PerVehicle = Field(default=40.0, description=RULES["speed_limit_mps"].meaning)
    restitution: Quantity = Field(default=0.1, description=RULES["restitution"].meaning)
    roles: dict[str, str] = Field(
        default_factory=lambda data: Roles.complete({"vehicle_2": LEARNER}, data.get("vehicles", 3)),
        description="role of each vehicle: learner, or the name of a script; a vehicle without an entry brakes fully",
    )
    obstacle_gap_m: Quantity | None = _meaning("obstacle_gap_m")
    obstacle_margin_m: Quantity | None = _meaning("obstacle_margin_m")
    friction: Quantity | None = _meaning("friction", exclude_if=not_)
    brake_rate_mps3: PerVehicle | None = _meaning("brake_rate_mps3", exclude_if=not_)
    release_rate_mps3: PerVehicle | None = _meaning("release_rate_mps3", exclude_if=not_)
    harm_weight: PerVehicle | None = _meaning("harm_weight", exclude_if=not_)
    alert_s: Quantity | None = _meaning("alert_s", exclude_if=not_)
    early_impacts: Literal["keep", "reject"] = Field(
        default="keep", description="keep or reject worlds with an impact at or before the first decision of a learner"
    )
    objective: Objective | Annotated[tuple[Objective, ...], Field(strict=False)] = Field(
        default="total",
        description="whose harm a reward counts: one objective for all vehicles, or a list with one per vehicle",
    )
    observation: Listed | ListedByVehicle | None = Field(
        default=None,
        exclude_if=not_,
        description="features and groups of features that a vehicle observes, in this order: one list for all"
        " vehicles, or a mapping from vehicle names to lists",
    )
    v2x: V2X = Field(
        default_factory=V2X,
        description="what each vehicle knows, and when: name of a preset, or a mapping with settings of your own",
    )

    _members: tuple[Scenario, ...] = PrivateAttr(default=())

    def __init__(self, /, **data: Any) -> None:
        name = data.get("name")
        _build(self, Document(f"scenario {name!r}" if isinstance(name, str) else "scenario", plain(data), {}))

    @classmethod
    def from_document(cls, document: Document) -> Self:
        """Build a scenario from a parsed file, whose name and lines then stand in error messages."""
        scenario = cls.__new__(cls)
        _build(scenario, document)
        return scenario

    @field_validator(*ALTERNATIVES, *ALTERNATIVES.values(), *OPTIONAL, "alert_s", mode="before")
    @classmethod
    def _given(cls, value: Any) -> Any:
        require(value is not None, (), value, LEAVE_OUT)
        return value

    @field_validator(*NEEDED, mode="before")
    @classmethod
    def _needed(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuse a quantity that nobody declares: neither the scenario, nor every type, nor the table, nor members."""
        key, data = str(info.field_name), info.data
        kinds = data.get("vehicle_types")
        without = None if kinds is None else next((k for k, kind in kinds.items() if getattr(kind, key) is None), None)
        if value is not _LEFT_OUT:
            require(value is not None, (), value, LEAVE_OUT)
            right = f"must be left out, because every vehicle type declares {key}"
            require(kinds is None or without is not None, (), value, right)
            return value
        if data.get("mixture") is None and {"vehicle_types", "mixture"} <= data.keys() and not _is_tabled(data, key):
            if kinds is None:
                raise PydanticCustomError("missing", "missing", {"at": ()})
            require(without is None, (), UNSHOWN, undeclared_by_type(key, without))
        return None

    @field_validator("vehicle_types", "types", "mixture", "table", mode="before")
    @classmethod
    def _not_empty(cls, value: Any) -> Any:
        empty = value is None or (isinstance(value, dict | list | tuple) and not value)
        require(not empty, (), value, "must not be empty; leave the key out if you do not need it")
        return value

    @field_validator("types")
    @classmethod
    def _types(cls, value: Any, info: ValidationInfo) -> Any:
        if {"vehicles", "vehicle_types"} <= info.data.keys():
            check_types(value, info.data["vehicle_types"], info.data["vehicles"])
        return value

    @field_validator("table")
    @classmethod
    def _columns_of_line(cls, value: Table | None, info: ValidationInfo) -> Table | None:
        if value is None or "vehicles" not in info.data:
            return value
        known = table_columns((*USUAL, *OPTIONAL), info.data["vehicles"])
        for name, column in value.column_values().items():
            if name == RECORDING:
                continue
            hint = suggestion(name, known) or f"known: {', '.join(known)}"
            require(name in known, ("columns",), name, f"unknown column; {hint}")
            rule = RULES[known[name][0]]
            bad = [k for k, number in enumerate(column.rows.tolist()) if not rule.allows(number, number)]
            at = ("rows", bad[0], value.columns.index(name)) if bad else ()
            require(not bad, at, column.rows[bad[0]] if bad else 0.0, f"{name} must be {rule.interval}")
        return value

    @field_validator(*RULES)
    @classmethod
    def _entries(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuse values out of range, and a list that has not one entry per vehicle or pair."""
        rule, vehicles = RULES[str(info.field_name)], info.data.get("vehicles")
        if value is None:
            return value
        listed = isinstance(value, tuple)
        if listed and vehicles is not None:
            count, per = rule.count(vehicles), "one per pair" if rule.per == "pair" else "one per vehicle"
            right = f"has {len(value)} entries; must have {count}, {per}, or be a single entry for all"
            require(len(value) == count, (), UNSHOWN, right)
        for index, entry in enumerate(value if listed else (value,)):
            low, high = support(entry)
            overlap = "; a negative gap means overlapping vehicles" if rule.per == "pair" and low < 0.0 else ""
            at = (index,) if listed else ()
            require(rule.allows(low, high), at, entry, f"must be {rule.interval}{overlap}")
        return value

    @field_validator("roles")
    @classmethod
    def _roles(cls, value: dict[str, str], info: ValidationInfo) -> dict[str, str]:
        vehicles = info.data.get("vehicles")
        if vehicles is None:
            return value
        names = [f"vehicle_{i + 1}" for i in range(vehicles)]
        for name, role in value.items():
            close = [] if name.startswith("vehicle_") else get_close_matches(name, names, n=1)
            hint = f"did you mean {close[0]}?" if close else f"this scenario has vehicle_1 ... vehicle_{vehicles}"
            require(name in names, (name,), role, f"unknown vehicle; {hint}")
            try:
                check_role(role)
            except InvalidInput as error:
                refuse((name,), role, str(error))
        return Roles.complete(value, vehicles)

    @field_validator("objective", mode="before")
    @classmethod
    def _objective(cls, value: Any, info: ValidationInfo) -> Any:
        if "vehicles" in info.data:
            try:
                objectives_of(value, info.data["vehicles"])
            except InvalidInput as error:
                refuse((), value, str(error).removeprefix("objective: "))
        return value

    @field_validator("observation", mode="before")
    @classmethod
    def _observation(cls, value: Any, info: ValidationInfo) -> Any:
        vehicles = info.data.get("vehicles", 0)
        names = [f"vehicle_{i + 1}" for i in range(vehicles)]
        for name, listed in value.items() if isinstance(value, dict) and value else [(None, value)]:
            at = () if name is None else (name,)
            right = f"unknown vehicle; this scenario has vehicle_1 ... vehicle_{vehicles}"
            require(name is None or not names or name in names, at, UNSHOWN, right)
            try:
                listed_features(listed)
            except InvalidInput as error:
                refuse(at, listed, str(error).removeprefix("observation: "))
        return value

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if self.mixture is None:  # otherwise its members have been checked
            check_whole(self)
        return self

    def __repr__(self) -> str:
        learners = ", ".join(self.vehicle_names[i - 1] for i in self.learners) or "nobody"
        return f"Scenario({self.name!r}: {self.vehicles} vehicles, learning: {learners})"

    __str__ = __repr__

    # ---- its worlds

    def sample(self, n: int, seed: int, *, first: int = 0, channel: Channel = "list") -> State:
        """Return worlds ``first`` to ``first + n - 1`` of the endless list of the seed, at the alert.

        World k is always the same, bit for bit. A seed has two independent lists: ``channel="list"`` for evaluation,
        ``"training"`` for training. Raises ``InvalidInput`` for bad arguments, and if ``early_impacts: reject`` leaves
        no world.
        """
        return self.draw(n, seed, first=first, channel=channel).worlds

    def draw(self, n: int, seed: int, *, first: int = 0, channel: Channel = "list") -> Drawn:
        """Return the worlds of ``sample``, their types, members and recordings, and the number of rejected draws."""
        return draw(self, n, seed, first=first, channel=channel)

    def describe(self, n: int, seed: int, *, first: int = 0, channel: Channel = "list") -> dict[str, NDArray[Any]]:
        """Return the worlds of ``sample`` as columns [n]: ``world``, ``vehicle_1_type``, ``gap_1_m`` and so on."""
        return columns_of(self.draw(n, seed, first=first, channel=channel))

    # ---- who is in the line

    @property
    def members(self) -> tuple[Scenario, ...]:
        """The scenarios of a mixture, with the keys beside ``mixture``; empty for a scenario that is none."""
        return self._members

    @cached_property
    def vehicle_names(self) -> tuple[str, ...]:
        """``vehicle_1`` (front) to ``vehicle_N`` (rear)."""
        return tuple(f"vehicle_{i + 1}" for i in range(self.vehicles))

    @cached_property
    def learners(self) -> tuple[int, ...]:
        """The bodies that learn: 1 is Vehicle 1."""
        return tuple(i + 1 for i, name in enumerate(self.vehicle_names) if self.roles[name] == LEARNER)

    @property
    def has_obstacle(self) -> bool:
        """Whether there is an obstacle ahead of Vehicle 1, in some of the worlds at least."""
        own = self.declares("obstacle_gap_m") or self.obstacle_margin_m is not None
        return own or any(member.has_obstacle for member in self.members)

    def equipped(self, types: Ints | None = None) -> Equipped:
        """Return the V2X equipment of vehicles with these types [n, N], or the least that each vehicle may have."""
        line, own = self.types_of_line, self.v2x.vehicles or {}
        kinds = [Equipage()] if line is None else [kind.v2x or Equipage() for kind in line.kinds]
        sends, hears = [], []
        for i, name in enumerate(self.vehicle_names):
            here = [own[name]] * len(kinds) if name in own else kinds
            sending, hearing = np.array([each.sends for each in here]), np.array([HEARS.index(e.hears) for e in here])
            if types is None:
                possible = [0] if line is None else line.possible(i)
                sends.append(np.array([sending[possible].all()]))
                hears.append(np.array([hearing[possible].max()]))
            else:
                sends.append(sending[types[:, i]])
                hears.append(hearing[types[:, i]])
        return Equipped(np.stack(sends, axis=1), np.stack(hears, axis=1))

    # ---- its quantities

    @cached_property
    def types_of_line(self) -> TypesOfLine | None:
        """The vehicle types at each place of the line; None without types."""
        return None if self.vehicle_types is None else TypesOfLine(self.vehicle_types, self.types, self.vehicles)

    @cached_property
    def columns(self) -> dict[Entry, TableColumn]:
        """Columns of the table: ``{("gaps_m", 0): column}``; empty without a table."""
        known = table_columns((*USUAL, *OPTIONAL), self.vehicles)
        values = {} if self.table is None else self.table.column_values()
        return {known[name]: column for name, column in values.items() if name != RECORDING}

    @cached_property
    def recordings(self) -> TableColumn | None:
        """Column of the table that names each row's recording; None without it."""
        return None if self.table is None else self.table.column_values().get(RECORDING)

    def declares(self, key: str) -> bool:
        """Return whether the scenario declares a quantity, by its key, in a vehicle type, or by a whole table."""
        kinds = (self.vehicle_types or {}).values() if key in OF_A_TYPE else ()
        return (
            getattr(self, key) is not None
            or any(getattr(kind, key) is not None for kind in kinds)
            or _is_tabled({"table": self.table, "vehicles": self.vehicles}, key)
        )

    def declarations(self, key: str) -> tuple[dict[int, Any], ...]:
        """Return for each vehicle, pair or world: vehicle type (0 without types) -> number, distribution or column.

        ``declarations("mass_t")`` may be ``({0: 2.0, 1: 9.5}, ...)``. Raises ``InvalidInput`` for a mixture, and for
        a quantity that is not declared.
        """
        if self.members:
            raise InvalidInput(
                f"scenario {self.name!r}: is a mixture of scenarios, each of which declares its own {key}; read"
                f" {key} from a scenario in Scenario.members"
            )
        if not self.declares(key):
            raise InvalidInput(
                f"scenario {self.name!r}: does not declare {key}; if {key} follows from other quantities,"
                " Scenario.bounds gives its range"
            )
        own, line = getattr(self, key), self.types_of_line if key in OF_A_TYPE else None
        each = own if isinstance(own, tuple) else (own,) * RULES[key].count(self.vehicles)
        entries = []
        for i, outside in enumerate(each):
            if (key, i) in self.columns:
                entries.append({0: self.columns[key, i]})
            elif line is None:
                entries.append({0: outside})
            else:
                kinds = {kind: getattr(line.kinds[kind], key) for kind in line.possible(i)}
                entries.append({kind: outside if inside is None else inside for kind, inside in kinds.items()})
        return tuple(entries)

    def bounds(self, key: str, *, dry: bool = False) -> tuple[tuple[float, float], ...]:
        """Return smallest and largest value of a quantity that every world has, for each vehicle, pair or world.

        ``dry``: friction does not limit capacities. A rate that nobody declares is the largest that can be declared.
        """
        ranges = [world_values(member, member.ends) for member in self.members or (self,)]
        at_once = np.full((2, self.vehicles), RULES[key].high)
        each = [(values if dry else on_road(values)).get(key, at_once) for values in ranges]
        lows, highs = np.min(each, axis=0)[0], np.max(each, axis=0)[1]
        return tuple(zip(lows.tolist(), highs.tolist(), strict=True))

    def ends(self, key: str) -> Floats:
        """Return smallest and largest value of a declared quantity, [2, entries]."""
        supports = [np.array([support(quantity) for quantity in entry.values()]) for entry in self.declarations(key)]
        return np.array([(ends[:, 0].min(), ends[:, 1].max()) for ends in supports]).T

    # ---- its content, and scenarios like it

    def declared(self) -> dict[str, Any]:
        """Return what is declared as plain data: ``Scenario(**scenario.declared())`` equals the scenario."""
        return self.model_dump(mode="json", exclude_unset=True, exclude_none=True)

    def content(self, without: Sequence[str] = ()) -> dict[str, Any]:
        """Return every value, defaults too, as plain data, except the keys ``without``; of members without words."""
        content = self.model_dump(mode="json", exclude=set(without))
        if self.mixture is not None and self.members:
            content["mixture"] = [
                {"weight": entry.weight, "scenario": member.model_dump(mode="json", exclude=set(WORDS))}
                for entry, member in zip(self.mixture, self.members, strict=True)
            ]
        return content

    def replace(self, **changes: Any) -> Scenario:
        """Return the scenario with other values: ``replace(mass_t=2.0)``, in each member if it is a mixture.

        A new way to declare gaps, speeds or an obstacle (``time_gaps_s``) takes the place of the old one (``gaps_m``).
        """
        return Scenario(**changed_content(self.declared(), changes))

    def with_learners(self, learners: Iterable[str | int]) -> Scenario:
        """Return the scenario with exactly these learners, by name (``vehicle_2``) or number (0 = front).

        A learner that is not listed brakes fully. Raises ``InvalidInput`` for an unknown vehicle, or one listed twice.
        """
        if isinstance(learners, str):
            raise InvalidInput(f"learners: {learners!r}: must be a list of vehicles, for instance [{learners!r}]")
        chosen = [self._vehicle_name(learner) for learner in learners]
        if twice := {name for name in chosen if chosen.count(name) > 1}:
            raise InvalidInput(f"learners: {', '.join(sorted(twice))} is listed twice")
        stay = {name: "full_brake" if role == LEARNER else role for name, role in self.roles.items()}
        return self.replace(roles={**stay, **dict.fromkeys(chosen, LEARNER)})

    def _vehicle_name(self, vehicle: str | int) -> str:
        if isinstance(vehicle, str):
            if vehicle not in self.vehicle_names:
                raise unknown_name("vehicle", vehicle, self.vehicle_names)
            return vehicle
        if isinstance(vehicle, bool) or not isinstance(vehicle, int | np.integer) or not 0 <= vehicle < self.vehicles:
            raise InvalidInput(
                f"learners: {vehicle!r}: must be the name of a vehicle (vehicle_1 ... vehicle_{self.vehicles}) or its"
                f" index (0 ... {self.vehicles - 1})"
            )
        return self.vehicle_names[vehicle]


def _is_tabled(data: Mapping[str, Any], key: str) -> bool:
    """Return whether the table has a column of the quantity for every vehicle, pair or world."""
    table, rule = data.get("table"), RULES[key]
    if table is None or "vehicles" not in data or not rule.column:
        return False
    return all(rule.column_of(i) in table.columns for i in range(rule.count(data["vehicles"])))


def _build(scenario: Scenario, document: Document) -> None:
    """Check the content of a document, and set the fields of a new, empty scenario."""
    if not isinstance(document.content, dict):
        raise InvalidInput(f"{document.file}: must be a mapping of keys to values, for instance name: my-scenario")
    members: tuple[Scenario, ...] = ()
    if "mixture" in document.content:
        document, members = build_members(document, tuple(Scenario.model_fields), Scenario.from_document)
    try:
        BaseModel.__init__(scenario, **document.content)
    except ValidationError as error:
        raise explain(document, error, ScenarioWording(Scenario)) from None
    scenario._members = members


def plain(value: Any) -> Any:
    """Return what a user gives as dict, list and Python numbers: any mapping or sequence, arrays, models, a View."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json", exclude_unset=True, exclude_none=True)
    if isinstance(value, View):
        return list(value.names)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [plain(entry) for entry in value]
    return value
