"""``ScenarioFields``: the fields of a scenario file, their checks, and properties derived from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from difflib import get_close_matches
from functools import cached_property
from operator import not_
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, PrivateAttr, ValidationInfo, field_validator, model_validator
from pydantic_core import PydanticCustomError

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.model import NAME_PATTERN, UNSHOWN, FileModel, refuse, require, suggestion
from ethbrake_marl.files.yaml import YamlPath
from ethbrake_marl.first_edition.game.features import ListedFeatures, listed_features
from ethbrake_marl.first_edition.game.objectives import objectives_of
from ethbrake_marl.first_edition.physics.motion import stopping_distances
from ethbrake_marl.first_edition.physics.state import Floats, Ints, Worlds, as_road_allows
from ethbrake_marl.first_edition.scenario.channel import V2X, Equipage, Equipped
from ethbrake_marl.first_edition.scenario.distributions import (
    LEAVE_OUT,
    AnyQuantity,
    AnyTypeQuantity,
    Quantity,
    TableColumn,
    support,
)
from ethbrake_marl.first_edition.scenario.fields import (
    ALSO,
    MEANING,
    QUANTITY,
    RECORDING,
    Entry,
    columns_of_table,
    is_tabled,
)
from ethbrake_marl.first_edition.scenario.follower import Follower
from ethbrake_marl.first_edition.scenario.member import Member
from ethbrake_marl.first_edition.scenario.roles import LEARNER, Role, Roles, ScriptSpec
from ethbrake_marl.first_edition.scenario.vehicle_types import (
    ANY,
    LEFT_OUT,
    ListedByVehicle,
    ObjectiveName,
    PerVehicle,
    Table,
    Types,
    TypesOfLine,
    VehicleTypes,
)


class ScenarioFields(FileModel):
    """The fields of a scenario file; base class of ``Scenario``."""

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
    gaps_m: PerVehicle | None = Field(default=None, description=MEANING["gaps_m"])
    time_gaps_s: PerVehicle | None = Field(default=None, description=MEANING["time_gaps_s"])
    speeds_mps: PerVehicle | None = Field(default=None, description=MEANING["speeds_mps"])
    line_speed_mps: Quantity | None = Field(default=None, description=MEANING["line_speed_mps"])
    speed_deviations_mps: PerVehicle = Field(default=0.0, description=MEANING["speed_deviations_mps"])
    braking_capacity_mps2: PerVehicle | None = Field(
        default_factory=lambda: LEFT_OUT, validate_default=True, description=MEANING["braking_capacity_mps2"]
    )
    driving_capacity_mps2: PerVehicle | None = Field(
        default_factory=lambda: LEFT_OUT, validate_default=True, description=MEANING["driving_capacity_mps2"]
    )
    mass_t: PerVehicle | None = Field(
        default_factory=lambda: LEFT_OUT, validate_default=True, description=MEANING["mass_t"]
    )
    latency_s: PerVehicle | None = Field(
        default_factory=lambda: LEFT_OUT, validate_default=True, description=MEANING["latency_s"]
    )
    speed_limit_mps: PerVehicle = Field(default=40.0, description=MEANING["speed_limit_mps"])
    restitution: Quantity = Field(default=0.1, description=MEANING["restitution"])
    roles: dict[str, Role] = Field(
        default_factory=lambda data: Roles.complete(None, data.get("vehicles", 3)),
        description="role of each vehicle: learner, or the name of a script; a vehicle without an entry brakes fully",
    )
    obstacle_gap_m: Quantity | None = Field(default=None, description=MEANING["obstacle_gap_m"])
    obstacle_margin_m: Quantity | None = Field(default=None, description=MEANING["obstacle_margin_m"])
    friction: Quantity | None = Field(default=None, exclude_if=not_, description=MEANING["friction"])
    brake_rate_mps3: PerVehicle | None = Field(default=None, exclude_if=not_, description=MEANING["brake_rate_mps3"])
    release_rate_mps3: PerVehicle | None = Field(
        default=None, exclude_if=not_, description=MEANING["release_rate_mps3"]
    )
    harm_weight: PerVehicle | None = Field(default=None, exclude_if=not_, description=MEANING["harm_weight"])
    alert_s: Quantity | None = Field(default=None, exclude_if=not_, description=MEANING["alert_s"])
    follower: Follower | None = Field(
        default=None,
        exclude_if=not_,
        description="additional vehicle behind the last vehicle of the line, at the same speed",
    )
    early_impacts: Literal["keep", "reject"] = Field(
        default="keep", description="keep or reject worlds with an impact at or before the first decision of a learner"
    )

    objective: ObjectiveName | Annotated[tuple[ObjectiveName, ...], Field(strict=False)] = Field(
        default="total",
        description="whose harm a reward counts: one objective for all vehicles, or a list with one per vehicle",
    )
    observation: ListedFeatures | ListedByVehicle | None = Field(
        default=None,
        exclude_if=not_,
        description="features and groups of features that a vehicle observes, in this order: one list for all"
        " vehicles, or a mapping from vehicle names to lists",
    )
    v2x: V2X = Field(
        default_factory=V2X,
        description="what each vehicle knows, and when: name of a preset, or a mapping with settings of your own",
    )

    _members: tuple[ScenarioFields, ...] = PrivateAttr(default=())
    _columns: dict[Entry, TableColumn] = PrivateAttr(default_factory=dict)  # table's columns, by quantity and index
    _recordings: TableColumn | None = PrivateAttr(default=None)

    @model_validator(mode="after")
    def _tabulated(self) -> ScenarioFields:
        if self.table is not None:
            known = columns_of_table(QUANTITY.declared, self.vehicles)
            columns = self.table.column_values()
            self._recordings = columns.pop(RECORDING, None)
            self._columns = {known[name]: column for name, column in columns.items()}
        return self

    @classmethod
    def of_dump(cls, content: Mapping[str, Any]) -> Self:
        """Rebuild a scenario from the result of ``model_dump``, which includes keys with default values.

        Raises ``ValueError`` if the content does not describe a scenario.
        """
        usual = {key: (None, field.default) for key, field in cls.model_fields.items()}

        def without_none(part: Any) -> Any:
            if isinstance(part, Mapping):
                return {key: without_none(value) for key, value in part.items() if value is not None}
            return [without_none(each) for each in part] if isinstance(part, list | tuple) else part

        # next to a mixture, the default v2x would apply to all members
        usual["v2x"] = None, without_none(V2X().model_dump(mode="json"))

        def declared(scenario: Mapping[str, Any]) -> dict[str, Any]:
            stripped = {key: without_none(value) for key, value in scenario.items()}
            values = {key: value for key, value in stripped.items() if value not in usual.get(key, ())}
            if "mixture" in values:
                values["mixture"] = [{**each, "scenario": declared(each["scenario"])} for each in values["mixture"]]
            return values

        return cls.model_validate(declared(content))

    @field_validator(
        *QUANTITY.alternatives, *QUANTITY.alternatives.values(), *QUANTITY.optional, "alert_s", mode="before"
    )
    @classmethod
    def _given(cls, value: Any) -> Any:
        """Raise an error for ``null`` as the value of a quantity."""
        require(value is not None, (), value, LEAVE_OUT)
        return value

    @field_validator(*QUANTITY.needed, mode="before")
    @classmethod
    def _needed(cls, value: Any, info: ValidationInfo) -> Any:
        """Raise an error if a quantity has neither a value nor a default.

        The value may be missing if every vehicle type, or the table, declares the quantity, or if the scenario is a
        mixture.
        """
        key, data = str(info.field_name), info.data
        kinds = data.get("vehicle_types")
        without = None if kinds is None else next((k for k, kind in kinds.items() if getattr(kind, key) is None), None)
        if value is not LEFT_OUT:
            require(value is not None, (), value, LEAVE_OUT)
            right = f"must be left out, because every vehicle type declares {key}"
            require(kinds is None or without is not None, (), value, right)
            return value
        if data.get("mixture") is None and {"vehicle_types", "mixture"} <= data.keys() and not is_tabled(data, key):
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
        """Check that each entry of ``types`` names declared types, and that a list has one entry per vehicle."""
        if not {"vehicles", "vehicle_types"} <= info.data.keys():
            return value
        vehicles, kinds = info.data["vehicles"], info.data["vehicle_types"]
        require(kinds is not None, (), value, "can be used only with the key vehicle_types, which declares the types")
        listed = isinstance(value, tuple)
        right = f"has {len(value)} entries; must have {vehicles}, one per vehicle, or be a single entry for all"
        require(not listed or len(value) == vehicles, (), UNSHOWN, right)
        for index, entry in enumerate(value if listed else (value,)):
            at: YamlPath = (index,) if listed else ()
            names = [entry] if isinstance(entry, str) else list(entry)
            require(len(names) > 0, at, entry, "must name at least one vehicle type")
            for name in names:
                hint = suggestion(name, kinds) or f"known: {', '.join(kinds)}"
                known = name in kinds or (name == ANY and isinstance(entry, str))
                require(known, at, entry, f"unknown vehicle type {name}; {hint}")
        return value

    @field_validator("table")
    @classmethod
    def _columns_of_line(cls, value: Table | None, info: ValidationInfo) -> Table | None:
        """Check that each column of the table fits the number of vehicles, and that all its numbers are in range."""
        if value is None or "vehicles" not in info.data:
            return value
        known = columns_of_table({**QUANTITY.usual, **QUANTITY.optional}, info.data["vehicles"])
        for name, column in value.column_values().items():
            if name == RECORDING:
                continue
            hint = suggestion(name, known) or f"known: {', '.join(known)}"
            require(name in known, ("columns",), name, f"unknown column; {hint}")
            rule = QUANTITY.declared[known[name][0]]
            bad = [k for k, number in enumerate(column.rows.tolist()) if not rule.allows(number, number)]
            at = ("rows", bad[0], value.columns.index(name)) if bad else ()
            require(not bad, at, column.rows[bad[0]] if bad else 0.0, f"{name} must be {rule.interval}")
        return value

    @field_validator(*QUANTITY.declared)
    @classmethod
    def _entries(cls, value: Any, info: ValidationInfo) -> Any:
        """Check that all values of a quantity are in range, and that a list has one value per vehicle or pair."""
        rule, vehicles = QUANTITY.declared[str(info.field_name)], info.data.get("vehicles")
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
                ScriptSpec.parse(role).is_state_free()
            except InvalidInput as error:
                refuse((name,), role, str(error))
            require(not role.startswith(f"{LEARNER}:"), (name,), role, f"{LEARNER} takes no argument")
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

    @property
    def members(self) -> tuple[ScenarioFields, ...]:
        """The scenarios of a mixture; empty for a scenario that is not a mixture."""
        return self._members

    @cached_property
    def vehicle_names(self) -> tuple[str, ...]:
        """Names ``vehicle_1`` (front) to ``vehicle_N`` (rear)."""
        return tuple(f"vehicle_{i + 1}" for i in range(self.vehicles))

    @property
    def learners(self) -> tuple[int, ...]:
        """Indices (from 0) of the vehicles that learn."""
        return tuple(i for i, name in enumerate(self.vehicle_names) if self.roles[name] == LEARNER)

    @property
    def scripts(self) -> dict[int, str]:
        """Index of each vehicle that does not learn (from 0) -> name of its script."""
        roles = [self.roles[name] for name in self.vehicle_names]
        return {i: role for i, role in enumerate(roles) if role != LEARNER}

    def play_pieces(self, worlds: Worlds, driven: Sequence[int] = ()) -> Worlds:
        """Return ``worlds`` with the accelerations over time of each vehicle that follows a ``profile`` script.

        The controlled vehicles ``driven`` (indices from 0) follow no script.
        """
        return worlds.play_pieces({i: ScriptSpec.parse(s).pieces for i, s in self.scripts.items() if i not in driven})

    @property
    def has_obstacle(self) -> bool:
        """Whether there is an obstacle ahead of Vehicle 1; for a mixture: in at least one of its scenarios."""
        if self.members:
            return any(member.has_obstacle for member in self.members)
        return self.declares("obstacle_gap_m") or self.obstacle_margin_m is not None

    @property
    def has_friction(self) -> bool:
        """Whether the friction of the road is declared; for a mixture: in at least one of its scenarios."""
        return any(member.has_friction for member in self.members) or self.declares("friction")

    @property
    def builds_up(self) -> bool:
        """Whether braking builds up or falls at a finite rate; for a mixture: in at least one of its scenarios."""
        own = self.declares("brake_rate_mps3") or self.declares("release_rate_mps3")
        return own or any(member.builds_up for member in self.members)

    def declares(self, field: str) -> bool:
        """Return whether the scenario declares the quantity ``field``, for example ``"mass_t"``.

        A quantity may be declared by its key in the scenario or in a vehicle type, or by columns of the table for all
        vehicles.
        """
        kinds = (self.vehicle_types or {}).values() if field in QUANTITY.of_a_type else ()
        return (
            getattr(self, field) is not None
            or any(getattr(kind, field) is not None for kind in kinds)
            or is_tabled({"table": self.table, "vehicles": self.vehicles}, field)
        )

    @property
    def table_entries(self) -> dict[Entry, TableColumn]:
        """Columns of the scenario's table by key and index, ``{("gaps_m", 0): column}``; empty without a table."""
        return self._columns

    @property
    def recordings(self) -> TableColumn | None:
        """Column of the table that names each row's recording; None for a mixture, or without such a column."""
        return self._recordings

    @property
    def by_link(self) -> bool:
        """Whether ``v2x`` differs from the paper's rule (a vehicle knows everything once its own latency has elapsed).

        For a mixture: in at least one of its scenarios.
        """
        return any(member.by_link for member in self.members) or self.v2x.by_link

    @property
    def types_of_line(self) -> TypesOfLine | None:
        """The possible vehicle types at each place of the line, with their weights; None without vehicle types."""
        return None if self.vehicle_types is None else TypesOfLine(self.vehicle_types, self.types, self.vehicles)

    def equipped(self, types: Ints | None = None) -> Equipped:
        """Return the V2X equipment of vehicles with the types ``types`` (indices of vehicle types, [n, N]).

        If ``types`` is None, the result has one row, [1, N]: the least equipment among all possible types of each
        vehicle.
        """
        line, each = self.types_of_line, []
        own = self.v2x.vehicles or {}
        for i, name in enumerate(self.vehicle_names):
            kinds = [Equipage()] if line is None else [kind.v2x or Equipage() for kind in line.kinds]
            if name in own:
                kinds = [own[name]] * len(kinds)
            here = Equipped.of(kinds)
            if types is not None:
                each.append((here.sends[0, types[:, i]], here.hears[0, types[:, i]]))
            else:
                possible = [0] if line is None else line.possible(i)
                each.append((here.sends[:, possible].all(axis=1), here.hears[:, possible].max(axis=1)))
        sends, hears = zip(*each, strict=True)
        return Equipped(np.stack(sends, axis=1), np.stack(hears, axis=1))

    def possible_quantities(self, field: str) -> tuple[dict[int, AnyTypeQuantity], ...]:
        """Return for each vehicle, pair or world a mapping from vehicle type to the declaration of the quantity.

        An example is ``({0: 2.0, 1: 9.5}, ...)`` for ``mass_t``. The keys are the indices of the vehicle's possible
        types; without vehicle types the only key is 0. If a type does not declare the quantity, the scenario's
        declaration outside ``vehicle_types`` applies to it. Raises the same errors as ``quantities``.
        """
        line = self.types_of_line
        if line is None or field not in QUANTITY.of_a_type:
            return tuple({0: each} for each in self.quantities(field))
        quantities: list[dict[int, AnyTypeQuantity]] = []
        for i in range(self.vehicles):
            if (field, i) in self.table_entries:
                quantities.append({0: self.table_entries[field, i]})
                continue
            own = {kind: getattr(line.kinds[kind], field) for kind in line.possible(i)}
            quantities.append({kind: self.quantities(field)[i] if each is None else each for kind, each in own.items()})
        return tuple(quantities)

    def supports(self, field: str) -> tuple[tuple[float, float], ...]:
        """Return (smallest, largest) possible value of the quantity ``field`` for each vehicle, pair or world.

        The range of a vehicle includes the values of all its possible types.
        """
        supports = []
        for each in self.possible_quantities(field):
            lows, highs = zip(*(support(quantity) for quantity in each.values()), strict=True)
            supports.append((min(lows), max(highs)))
        return tuple(supports)

    def quantities(self, field: str) -> tuple[AnyQuantity, ...]:
        """Return the declaration of the quantity ``field``: a number or distribution for each vehicle, pair or world.

        Gaps have one entry per pair; restitution and line speed have one per world. Raises ``InvalidInput`` for a
        mixture, and for a key that this scenario does not use, for example ``gaps_m`` if it declares ``time_gaps_s``.
        """
        declared: AnyQuantity | tuple[AnyQuantity, ...] | None = getattr(self, QUANTITY.declared[field].name)
        if self.members:
            raise InvalidInput(
                f"scenario {self.name!r}: is a mixture of scenarios, each of which declares its own {field}; read"
                f" {field} from a scenario in Scenario.members"
            )
        if declared is None and not self.declares(field):
            raise InvalidInput(
                f"scenario {self.name!r}: does not declare {field}; if {field} follows from other quantities,"
                " Scenario.bounds gives its range"
            )
        count = QUANTITY.declared[field].count(self.vehicles)
        entries: tuple[Any, ...] = declared if isinstance(declared, tuple) else (declared,) * count
        return tuple(self.table_entries.get((field, i), entry) for i, entry in enumerate(entries))

    def bounds(self, field: str, *, dry: bool = False) -> tuple[tuple[float, float], ...]:
        """Return (smallest, largest) possible value of a declared or derived quantity for each vehicle, pair or world.

        ``field`` is the key of a quantity that every world has, such as ``gaps_m``. With ``dry``, the friction of the
        road does not limit the braking and driving capacities.
        """
        bounds = [world_quantities(member, _supports_of(member)) for member in self.members or (self,)]
        at_once = np.full((2, self.vehicles), QUANTITY.declared[field].high)  # for members that declare no brake rate
        lows, highs = zip(*((each if dry else on_road(each)).get(field, at_once) for each in bounds), strict=True)
        return tuple(zip(np.min(lows, axis=0).tolist(), np.max(highs, axis=0).tolist(), strict=True))

    @property
    def farthest_obstacle_m(self) -> float:
        """Largest possible distance (m) from Vehicle 1 to the obstacle, if ``obstacle_margin_m`` is declared."""
        positions = on_road(world_quantities(self, _supports_of(self)))
        low, high = ({key: bounds[[row]] for key, bounds in positions.items()} for row in (0, 1))
        slowest = high | {key: low[key] for key in ("braking_capacity_mps2", "brake_rate_mps3") if key in low}
        farthest = obstacle_gap(self, slowest, lambda key: np.array([support(self.quantities(key)[0])[1]]))
        assert farthest is not None
        return float(farthest[0])


def world_quantities(scenario: ScenarioFields, declared: Callable[[str], Floats]) -> dict[str, Floats]:
    """Compute all quantities of k worlds from the declared quantities: key -> values, [k, entries].

    Derived quantities are ``speed = line speed + own deviation``, ``gap = time gap x speed of the pair's rear vehicle``
    and ``latency = own latency + time of the alert``. Every derived quantity increases if a declared quantity
    increases, so bounds of the declared quantities give bounds of the derived quantities. The function ``declared``
    maps a key such as ``"time_gaps_s"`` to its values in the k worlds, [k, entries].
    """
    other = {"gaps_m": scenario.time_gaps_s, "speeds_mps": scenario.line_speed_mps}
    quantities = {key: declared(key) for key in QUANTITY.usual if other.get(key) is None}
    if scenario.alert_s is not None:
        quantities["latency_s"] = quantities["latency_s"] + declared("alert_s")
    for key in ALSO:
        if scenario.declares(key):
            quantities[key] = declared(key)
    if scenario.line_speed_mps is not None:
        quantities["speeds_mps"] = declared("line_speed_mps") + declared("speed_deviations_mps")
    if scenario.time_gaps_s is not None:
        quantities["gaps_m"] = declared("time_gaps_s") * quantities["speeds_mps"][:, 1:]
    return {key: quantities[key] for key in (*QUANTITY.usual, *ALSO) if key in quantities}


def on_road(found: Mapping[str, Floats]) -> dict[str, Floats]:
    """Return the quantities ``found`` with all braking and driving capacities limited to friction times gravity.

    ``found`` maps keys to values, [k, entries]. Without the key ``"friction"``, the capacities are not limited.
    """
    return as_road_allows(found, found["friction"]) if "friction" in found else dict(found)


def obstacle_gap(
    scenario: ScenarioFields, found: Mapping[str, Floats], declared: Callable[[str], Floats]
) -> Floats | None:
    """Return the distance from Vehicle 1 to the obstacle ahead in k worlds, [k] m; None without an obstacle.

    A scenario declares either this distance, or a margin: the distance between the obstacle and the point where Vehicle
    1 stops by full braking. If a margin is declared, ``distance = margin + v_1 tau_1 + v_1^2 / (2 a_1)``. Vehicle 1 has
    the speed v_1, the latency tau_1 and the braking capacity a_1, and its brakes act at once.

    ``found`` has all other quantities of the k worlds: key -> values, [k, entries]. The function ``declared`` maps
    ``"obstacle_gap_m"`` or ``"obstacle_margin_m"`` to its value in each world, [k].
    """
    if scenario.declares("obstacle_gap_m"):
        return declared("obstacle_gap_m")
    if scenario.obstacle_margin_m is None:
        return None
    speed, latency, capacity = (found[key][:, 0] for key in ("speeds_mps", "latency_s", "braking_capacity_mps2"))
    rate = found["brake_rate_mps3"][:, 0] if "brake_rate_mps3" in found else np.full(len(speed), np.inf)
    return declared("obstacle_margin_m") + stopping_distances(speed, latency, capacity, rate)


def _supports_of(scenario: ScenarioFields) -> Callable[[str], Floats]:
    """Return a function: key of a quantity -> smallest and largest value for each vehicle or pair, [2, entries]."""
    return lambda key: np.array(scenario.supports(key)).T


def undeclared_by_type(key: str, kind: object) -> str:
    """Return the error message for a quantity ``key`` that the vehicle type ``kind`` does not declare."""
    return (
        f"vehicle type {kind} does not declare {key}; declare {key} in this type, or outside vehicle_types for all"
        " types without it"
    )
