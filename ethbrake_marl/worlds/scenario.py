"""``Scenario``: a validated, immutable description of how worlds are drawn."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from operator import not_
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, PrivateAttr, ValidationError, ValidationInfo, field_validator, model_validator

from ethbrake_marl.episode.features import listed_features
from ethbrake_marl.episode.objectives import objectives_of
from ethbrake_marl.episode.observe import View
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.files.model import NAME_PATTERN, UNSHOWN, explain, refuse
from ethbrake_marl.files.yaml import Document
from ethbrake_marl.motion.layout import Floats, Ints
from ethbrake_marl.worlds.channel import HEARS, V2X, Equipage, Equipped
from ethbrake_marl.worlds.checks import check_whole
from ethbrake_marl.worlds.counters import Channel
from ethbrake_marl.worlds.derived import world_values
from ethbrake_marl.worlds.describe import columns_of
from ethbrake_marl.worlds.mixture import WORDS, Member, build_members, changed_content
from ethbrake_marl.worlds.quantity import Part, PerVehicle, Quantity, support
from ethbrake_marl.worlds.roles import LEARNER, Roles, check_role, check_vehicle, names_of
from ethbrake_marl.worlds.rules import OF_A_TYPE, OPTIONAL, RECORDING, RULES, USUAL, Entry, check_count, table_columns
from ethbrake_marl.worlds.sampling import Drawn, draw
from ethbrake_marl.worlds.table import Table, TableColumn
from ethbrake_marl.worlds.vehicle_types import Types, TypesOfLine, VehicleTypes
from ethbrake_marl.worlds.wording import ScenarioWording

Listed = Annotated[tuple[str, ...], Field(strict=False)]


def _quantity(key: str, default: Any = None, **more: Any) -> Any:
    """Return the field of a quantity."""
    return Field(default=default, description=RULES[key].meaning, **more)


class Scenario(Part):
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
    mixture: Annotated[tuple[Member, ...], Field(strict=False, min_length=1)] | None = Field(
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
    gaps_m: PerVehicle | None = _quantity("gaps_m")
    time_gaps_s: PerVehicle | None = _quantity("time_gaps_s")
    speeds_mps: PerVehicle | None = _quantity("speeds_mps")
    line_speed_mps: Quantity | None = _quantity("line_speed_mps")
    speed_deviations_mps: PerVehicle = _quantity("speed_deviations_mps", 0.0)
    braking_capacity_mps2: PerVehicle | None = _quantity("braking_capacity_mps2")
    driving_capacity_mps2: PerVehicle | None = _quantity("driving_capacity_mps2")
    mass_t: PerVehicle | None = _quantity("mass_t")
    latency_s: PerVehicle | None = _quantity("latency_s")
    speed_limit_mps: PerVehicle = _quantity("speed_limit_mps", 40.0)
    restitution: Quantity = _quantity("restitution", 0.1)
    roles: dict[str, str] = Field(
        default_factory=lambda data: Roles.complete({"vehicle_2": LEARNER}, data.get("vehicles", 3)),
        description="role of each vehicle: learner, or the name of a script; a vehicle without an entry brakes fully",
    )
    obstacle_gap_m: Quantity | None = _quantity("obstacle_gap_m")
    obstacle_margin_m: Quantity | None = _quantity("obstacle_margin_m")
    friction: Quantity | None = _quantity("friction", exclude_if=not_)
    brake_rate_mps3: PerVehicle | None = _quantity("brake_rate_mps3", exclude_if=not_)
    release_rate_mps3: PerVehicle | None = _quantity("release_rate_mps3", exclude_if=not_)
    harm_weight: PerVehicle | None = _quantity("harm_weight", exclude_if=not_)
    alert_s: Quantity | None = _quantity("alert_s", exclude_if=not_)
    early_impacts: Literal["keep", "reject"] = Field(
        default="keep", description="keep or reject worlds with an impact at or before the first decision of a learner"
    )
    objective: str | Listed = Field(
        default="total",
        description="whose harm a reward counts: one objective for all vehicles, or a list with one per vehicle",
    )
    observation: Listed | dict[str, Listed] | None = Field(
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

    @field_validator("table")
    @classmethod
    def _cells(cls, value: Table, info: ValidationInfo) -> Table:
        if "vehicles" in info.data:
            value.check_cells(table_columns((*USUAL, *OPTIONAL), info.data["vehicles"]))
        return value

    @field_validator(*RULES)
    @classmethod
    def _entries(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuse values out of range, and a list that has not one entry per vehicle or pair."""
        rule = RULES[str(info.field_name)]
        if "vehicles" in info.data:
            check_count(value, rule.count(info.data["vehicles"]), rule.per)
        listed = isinstance(value, tuple)
        for index, entry in enumerate(value if listed else (value,)):
            rule.check(entry, (index,) if listed else ())
        return value

    @field_validator("roles")
    @classmethod
    def _roles(cls, value: dict[str, str], info: ValidationInfo) -> dict[str, str]:
        vehicles = info.data.get("vehicles", len(value))
        for name, role in value.items():
            check_vehicle(name, vehicles, (name,), role)
            try:
                check_role(role)
            except InvalidInput as error:
                refuse((name,), role, str(error))
        return Roles.complete(value, vehicles)

    @field_validator("objective", "observation", mode="before")
    @classmethod
    def _names(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuse names of objectives, features and vehicles that nobody knows."""
        vehicles, by_vehicle = info.data.get("vehicles", 64), isinstance(value, dict) and len(value) > 0
        for name, names in value.items() if by_vehicle else [("", value)]:
            at = (name,) if by_vehicle else ()
            if by_vehicle:
                check_vehicle(name, vehicles, at, UNSHOWN)
            try:
                listed_features(names) if info.field_name == "observation" else objectives_of(names, vehicles)
            except InvalidInput as error:
                refuse(at, names, str(error).removeprefix(f"{info.field_name}: "))
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
        return names_of(self.vehicles)

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
        kinds = [None] if line is None else [kind.v2x for kind in line.kinds]
        each = [[own.get(name, kind) or Equipage() for kind in kinds] for name in self.vehicle_names]  # [N, types]
        sends = np.array([[one.sends for one in here] for here in each])
        hears = np.array([[HEARS.index(one.hears) for one in here] for here in each])
        if types is not None:
            return Equipped(*(np.take_along_axis(every, types.T, axis=1).T for every in (sends, hears)))
        possible = np.ones(sends.shape, bool) if line is None else line.possible
        return Equipped((sends | ~possible).all(axis=1)[np.newaxis], (hears * possible).max(axis=1)[np.newaxis])

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

    @cached_property
    def _possible(self) -> dict[str, tuple[dict[int, Any], ...]]:
        """For each quantity what ``declarations`` returns; None where nobody declares it."""
        possible = {}
        for key, rule in RULES.items():
            own, line, entries = getattr(self, key), self.types_of_line if key in OF_A_TYPE else None, []
            for i, outside in enumerate(own if isinstance(own, tuple) else (own,) * rule.count(self.vehicles)):
                here = {0: self.columns.get((key, i), outside)}
                if line is not None and (key, i) not in self.columns:
                    kinds = {kind: getattr(line.kinds[kind], key) for kind in np.flatnonzero(line.possible[i]).tolist()}
                    here = {kind: outside if inside is None else inside for kind, inside in kinds.items()}
                entries.append(here)
            possible[key] = tuple(entries)
        return possible

    def declares(self, key: str) -> bool:
        """Return whether the scenario declares a quantity, by its key, in a vehicle type, or by a whole table."""
        return all(quantity is not None for entry in self._possible[key] for quantity in entry.values())

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
        return self._possible[key]

    def bounds(self, key: str) -> tuple[tuple[float, float], ...]:
        """Return smallest and largest value of a quantity that every world has, for each vehicle, pair or world.

        Capacities are those on the road. A rate that nobody declares is the largest that can be declared.
        """
        at_once = np.full((2, self.vehicles), RULES[key].high)
        each = [world_values(member, member.ends).get(key, at_once) for member in self.members or (self,)]
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
        for entry, member in zip(content.get("mixture", ()), self.members, strict=False):
            entry["scenario"] = member.content(WORDS)
        return content

    def replace(self, **changes: Any) -> Scenario:
        """Return the scenario with other values: ``replace(mass_t=2.0)``, in each member if it is a mixture.

        A new way to declare gaps, speeds or an obstacle (``time_gaps_s``) takes the place of the old one (``gaps_m``).
        A key that becomes None has its default again.
        """
        return Scenario(**changed_content(self.declared(), changes))

    def with_learners(self, learners: Iterable[str]) -> Scenario:
        """Return the scenario with exactly these learners, such as ``["vehicle_2"]``.

        A learner that is not listed brakes fully. Raises ``InvalidInput`` for an unknown vehicle, or one listed twice.
        """
        if isinstance(learners, str) or not isinstance(learners, Iterable):
            raise InvalidInput(f"learners = {learners!r}: must be a list of vehicles, for instance ['vehicle_2']")
        chosen = list(learners)
        if unknown := [name for name in chosen if name not in self.vehicle_names]:
            raise unknown_name("vehicle", unknown[0], self.vehicle_names)
        if twice := {name for name in chosen if chosen.count(name) > 1}:
            raise InvalidInput(f"learners: {', '.join(sorted(twice))} is listed twice")
        stay = {name: "full_brake" if role == LEARNER else role for name, role in self.roles.items()}
        return self.replace(roles={**stay, **dict.fromkeys(chosen, LEARNER)})


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
