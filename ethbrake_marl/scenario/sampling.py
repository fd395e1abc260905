"""Fields of a scenario: the quantities of a world and how they are drawn, roles, and types of vehicles."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from operator import not_
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, PrivateAttr, ValidationInfo, field_validator, model_validator
from pydantic_core import PydanticCustomError

from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.files.store import read_plain
from ethbrake_marl.files.yaml import (
    NAME_PATTERN,
    UNSHOWN,
    FileModel,
    YamlPath,
    parse_numeral,
    refuse,
    require,
    suggestion,
)
from ethbrake_marl.game.features import ListedFeatures, listed_features
from ethbrake_marl.game.objectives import objectives_of
from ethbrake_marl.physics.advance import advance
from ethbrake_marl.physics.motion import stopping_distances
from ethbrake_marl.physics.state import Bools, Floats, Ints, Worlds, as_road_allows, make_worlds, real_numbers
from ethbrake_marl.scenario.channel import V2X, Equipage, Equipped
from ethbrake_marl.scenario.distributions import (
    LEAVE_OUT,
    AnyQuantity,
    AnyTypeQuantity,
    Quantity,
    TableColumn,
    WithLoad,
    support,
    values,
)
from ethbrake_marl.scenario.fields import (
    ALSO,
    BLOCK,
    BRAKES,
    LATER_LOSSES,
    MEANING,
    MIXTURE,
    OBSTACLE,
    OF_WORLD,
    PER_TYPE,
    QUANTITY,
    ROW,
    SURROUNDINGS,
    TYPES,
    V2X_NEWS,
    Place,
    QuantityRule,
)
from ethbrake_marl.scenario.roles import LEARNER, Role, Roles, ScriptSpec
from ethbrake_marl.scenario.sample import Sample
from ethbrake_marl.scenario.vehicle_types import (
    ANY,
    LEFT_OUT,
    ListedByVehicle,
    Member,
    ObjectiveName,
    PerVehicle,
    Table,
    Types,
    TypesOfLine,
    VehicleTypes,
)

# Types of vehicles: what a car, a van or a truck is, drawn together, and which of them may stand where.
#
# A world's vehicle first gets its type, then its quantities as that type declares them. What moves with the load of a
# vehicle, ``{with_load: [empty, full]}``, moves together: a full truck is heavy *and* brakes weakly.


class ScenarioFields(FileModel):
    """What is declared of a line of vehicles, and what follows from the declaration alone. See ``Scenario``."""

    name: str = Field(pattern=NAME_PATTERN, description="name; equal to the file's name without .yaml")
    title: str = Field(default="", description="one line for lists and figures")
    description: str = Field(default="", description="what the scenario is for")
    source: str = Field(default="", description="where the values come from")
    vehicles: int = Field(default=3, ge=2, le=64, description="number of vehicles N, vehicle_1 in front")
    vehicle_types: VehicleTypes | None = Field(
        default=None, exclude_if=not_, description="what a car, a truck, ... is: type -> weight and quantities"
    )
    types: Types | None = Field(
        default=None,
        exclude_if=not_,
        description="which types may stand where: a type, any, or a weight for each; one entry for all or one for each",
    )
    mixture: Annotated[tuple[Member, ...], Field(strict=False)] | None = Field(
        default=None, exclude_if=not_, description="scenarios that each world is drawn from one of, by weight"
    )
    table: Table | None = Field(
        default=None, exclude_if=not_, description="measured rows of which every world takes one; the rest is drawn"
    )
    time_step_s: float = Field(default=0.1, ge=1e-3, allow_inf_nan=False, description="time between two decisions")
    horizon_s: float = Field(
        default=8.0, gt=0.0, le=3600.0, allow_inf_nan=False, description="time after which an episode is cut off"
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
        description="learner or a script for each vehicle; vehicles left out of a given mapping brake fully",
    )
    obstacle_gap_m: Quantity | None = Field(default=None, description=MEANING["obstacle_gap_m"])
    obstacle_margin_m: Quantity | None = Field(default=None, description=MEANING["obstacle_margin_m"])
    friction: Quantity | None = Field(default=None, exclude_if=not_, description=MEANING["friction"])
    brake_rate_mps3: PerVehicle | None = Field(default=None, exclude_if=not_, description=MEANING["brake_rate_mps3"])
    release_rate_mps3: PerVehicle | None = Field(
        default=None, exclude_if=not_, description=MEANING["release_rate_mps3"]
    )
    alert_s: Quantity | None = Field(default=None, exclude_if=not_, description=MEANING["alert_s"])
    early_impacts: Literal["keep", "reject"] = Field(
        default="keep", description="what happens to worlds with an impact before the first learner may act"
    )

    objective: ObjectiveName | Annotated[tuple[ObjectiveName, ...], Field(strict=False)] = Field(
        default="total", description="whose harm a reward counts: one for all vehicles, or one for each"
    )
    observation: ListedFeatures | ListedByVehicle | None = Field(
        default=None,
        exclude_if=not_,
        description="what vehicles observe, or by name what each does: groups and single features, in this order",
    )
    v2x: V2X = Field(
        default_factory=V2X, description="what each vehicle knows when: a preset, and what differs from it"
    )

    _members: tuple[ScenarioFields, ...] = PrivateAttr(default=())
    _columns: dict[Entry, TableColumn] = PrivateAttr(default_factory=dict)  # those of the table

    @model_validator(mode="after")
    def _tabulated(self) -> ScenarioFields:
        if self.table is not None:
            known = _table_columns(QUANTITY.declared, self.vehicles)
            self._columns = {known[name]: column for name, column in self.table.column_values().items()}
        return self

    @classmethod
    def of_dump(cls, content: Mapping[str, Any]) -> Self:
        """That of which ``model_dump`` wrote every key, also those that nobody gave; raises ``ValueError``."""
        usual = {key: (None, field.default) for key, field in cls.model_fields.items()}

        def given(part: Any) -> Any:
            if isinstance(part, Mapping):
                return {key: given(value) for key, value in part.items() if value is not None}
            return [given(each) for each in part] if isinstance(part, list | tuple) else part

        usual["v2x"] = None, given(V2X().model_dump(mode="json"))  # beside a mixture it would hold for all members

        def declared(scenario: Mapping[str, Any]) -> dict[str, Any]:
            told = {key: given(value) for key, value in scenario.items() if given(value) not in usual.get(key, ())}
            if "mixture" in told:
                told["mixture"] = [{**each, "scenario": declared(each["scenario"])} for each in told["mixture"]]
            return told

        return cls.model_validate(declared(content))

    @field_validator(
        *QUANTITY.alternatives, *QUANTITY.alternatives.values(), *QUANTITY.optional, "alert_s", mode="before"
    )
    @classmethod
    def _given(cls, value: Any) -> Any:
        """``null`` is no value: a key that is not used is left out."""
        require(value is not None, (), value, LEAVE_OUT)
        return value

    @field_validator(*QUANTITY.needed, mode="before")
    @classmethod
    def _needed(cls, value: Any, info: ValidationInfo) -> Any:
        """None where every type declares it, and nobody else has to."""
        key, data = str(info.field_name), info.data
        kinds = data.get("vehicle_types")
        without = None if kinds is None else next((k for k, kind in kinds.items() if getattr(kind, key) is None), None)
        if value is not LEFT_OUT:
            require(value is not None, (), value, LEAVE_OUT)
            require(kinds is None or without is not None, (), value, "every type declares it; leave it out")
            return value
        if data.get("mixture") is None and {"vehicle_types", "mixture"} <= data.keys() and not _tabled(data, key):
            if kinds is None:
                raise PydanticCustomError("missing", "missing", {"at": ()})
            right = f"type {without} does not declare it: give it there, or here for every type that does not"
            require(without is None, (), UNSHOWN, right)
        return None

    @field_validator("vehicle_types", "types", "mixture", "table", mode="before")
    @classmethod
    def _not_empty(cls, value: Any) -> Any:
        empty = value is None or (isinstance(value, dict | list | tuple) and not value)
        require(not empty, (), value, "must not be empty; a key that is not used is left out")
        return value

    @field_validator("types")
    @classmethod
    def _types(cls, value: Any, info: ValidationInfo) -> Any:
        """Every entry names types that are declared, and a list has one entry per vehicle."""
        if not {"vehicles", "vehicle_types"} <= info.data.keys():
            return value
        vehicles, kinds = info.data["vehicles"], info.data["vehicle_types"]
        require(kinds is not None, (), value, "needs vehicle_types, which says what the types are")
        listed = isinstance(value, tuple)
        right = f"has {len(value)} entries; {vehicles} vehicles need {vehicles}, or one for all"
        require(not listed or len(value) == vehicles, (), UNSHOWN, right)
        for index, entry in enumerate(value if listed else (value,)):
            at: YamlPath = (index,) if listed else ()
            names = [entry] if isinstance(entry, str) else list(entry)
            require(len(names) > 0, at, entry, "must name a type")
            for name in names:
                hint = suggestion(name, kinds) or f"known: {', '.join(kinds)}"
                known = name in kinds or (name == ANY and isinstance(entry, str))
                require(known, at, entry, f"unknown type {name}; {hint}")
        return value

    @field_validator("table")
    @classmethod
    def _columns_of_line(cls, value: Table | None, info: ValidationInfo) -> Table | None:
        """Every column is one of this line's, and its numbers are in range."""
        if value is None or "vehicles" not in info.data:
            return value
        known = _table_columns({**QUANTITY.usual, **QUANTITY.optional}, info.data["vehicles"])
        for name, column in value.column_values().items():
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
        """Every entry of a quantity is in range over its whole support, and a list has the right length."""
        rule, vehicles = QUANTITY.declared[str(info.field_name)], info.data.get("vehicles")
        if value is None:
            return value
        listed = isinstance(value, tuple)
        if listed and vehicles is not None:
            count, per = rule.count(vehicles), "one per pair" if rule.per == "pair" else "one per vehicle"
            right = f"has {len(value)} entries; {vehicles} vehicles need {count} ({per}), or one for all"
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

    def play_pieces(self, worlds: Worlds, driven: Sequence[int] = ()) -> Worlds:
        """These worlds, in which its scripts brake in the pieces of their ``profile``, but for ``driven`` vehicles."""
        return worlds.play_pieces({i: ScriptSpec.parse(s).pieces for i, s in self.scripts.items() if i not in driven})

    @property
    def has_obstacle(self) -> bool:
        """Whether an obstacle stands ahead of Vehicle 1, however its distance is declared."""
        if self.members:
            return any(member.has_obstacle for member in self.members)
        return self.declares("obstacle_gap_m") or self.obstacle_margin_m is not None

    @property
    def has_friction(self) -> bool:
        """Whether the road is known, in some member of a mixture at least."""
        return any(member.has_friction for member in self.members) or self.declares("friction")

    @property
    def builds_up(self) -> bool:
        """Whether brakes may build up, in some member of a mixture at least."""
        own = self.declares("brake_rate_mps3") or self.declares("release_rate_mps3")
        return own or any(member.builds_up for member in self.members)

    def declares(self, field: str) -> bool:
        """Whether it says what a quantity is: under its key, by type, or in its table for every vehicle or pair."""
        kinds = (self.vehicle_types or {}).values() if field in QUANTITY.of_a_type else ()
        return (
            getattr(self, field) is not None
            or any(getattr(kind, field) is not None for kind in kinds)
            or _tabled({"table": self.table, "vehicles": self.vehicles}, field)
        )

    @property
    def table_entries(self) -> dict[Entry, TableColumn]:
        """The columns of the table by what they say; none without a table."""
        return self._columns

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
        if line is None or field not in QUANTITY.of_a_type:
            return tuple({0: each} for each in self.quantities(field))
        found: list[dict[int, AnyTypeQuantity]] = []
        for i in range(self.vehicles):
            if (field, i) in self.table_entries:
                found.append({0: self.table_entries[field, i]})
                continue
            own = {kind: getattr(line.kinds[kind], field) for kind in line.possible(i)}
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
        declared: AnyQuantity | tuple[AnyQuantity, ...] | None = getattr(self, QUANTITY.declared[field].name)
        if self.members:
            raise InvalidInput(f"scenario {self.name!r}: is a mixture; its members say what {field} is")
        if declared is None and not self.declares(field):
            raise InvalidInput(f"scenario {self.name!r}: {field} is not given; it is derived, see Scenario.bounds")
        count = QUANTITY.declared[field].count(self.vehicles)
        entries: tuple[Any, ...] = declared if isinstance(declared, tuple) else (declared,) * count
        return tuple(self.table_entries.get((field, i), entry) for i, entry in enumerate(entries))

    def bounds(self, field: str, *, dry: bool = False) -> tuple[tuple[float, float], ...]:
        """Smallest and largest value of each entry of ``gaps_m``, ``speeds_mps``, ..., however it is declared.

        Capacities are what the road allows; ``dry``: what they are on a dry one.
        """
        found = [world_quantities(member, _supports_of(member)) for member in self.members or (self,)]
        at_once = np.full((2, self.vehicles), QUANTITY.declared[field].high)  # of members that declare no rate
        lows, highs = zip(*((each if dry else on_road(each)).get(field, at_once) for each in found), strict=True)
        return tuple(zip(np.min(lows, axis=0).tolist(), np.max(highs, axis=0).tolist(), strict=True))

    @property
    def farthest_obstacle_m(self) -> float:
        """Upper bound of the distance to an obstacle that is declared by its margin."""
        found = on_road(world_quantities(self, _supports_of(self)))
        low, high = ({key: bounds[[row]] for key, bounds in found.items()} for row in (0, 1))
        slowest = high | {key: low[key] for key in ("braking_capacity_mps2", "brake_rate_mps3") if key in low}
        farthest = obstacle_gap(self, slowest, lambda key: np.array([support(self.quantities(key)[0])[1]]))
        assert farthest is not None
        return float(farthest[0])

    def sample(self, n: int, seed: int, *, first: int = 0, channel: Channel = "list") -> Sample:
        """Worlds ``first`` to ``first + n - 1`` of the endless list that belongs to ``seed``.

        World k is the same bits whatever ``n`` and ``first`` are. The channels ``"list"`` (evaluation) and
        ``"training"`` are independent of each other. Raises ``InvalidInput`` for a negative seed or ``first``,
        ``n < 1``, or when early impacts are rejected and (almost) every draw has one.

        World k of a mixture is drawn from one member, by weight, and is then that member's own world k under the same
        seed, bit for bit. So results on a mixture can be compared with results on its members, world by world.
        """
        for name, value, least in (
            ("number of worlds", n, 1),
            ("seed of the list", seed, 0),
            ("first world", first, 0),
        ):
            check_whole_number(name, value, least)
        if not n <= MOST_AT_ONCE:
            raise InvalidInput(f"number of worlds = {n}: at most {MOST_AT_ONCE:,} at once; draw a longer list in parts")
        if not int(first) + int(n) <= _MOST_WORLDS:
            raise InvalidInput(f"sample: first = {first!r}: a list has {_MOST_WORLDS} worlds")
        if channel not in CHANNELS:
            raise InvalidInput(f"sample: channel {channel!r}: must be one of {', '.join(CHANNELS)}")
        if self.mixture is None:
            return _draw_numbers(self, np.arange(first, first + n, dtype=np.int64), int(seed), channel)
        chosen = self.members_of(n, int(seed), first=first, channel=channel)
        typed = any(member.vehicle_types is not None for member in self.members)
        parts = []
        for k, member in enumerate(self.members):
            index = first + np.flatnonzero(chosen == k)
            if len(index):
                drawn = _draw_numbers(member, index, int(seed), channel)
                no_type = np.full((len(index), self.vehicles), "") if typed and drawn.types is None else drawn.types
                parts.append(replace(drawn, types=no_type, scenarios=np.full(len(index), member.name)))
        return Sample.join(parts, sum(part.rejected for part in parts))

    def members_of(self, n: int, seed: int, *, first: int = 0, channel: Channel = "list") -> Ints:
        """From which of its ``members`` such worlds of a mixture are drawn, [n]; 0 without a mixture."""
        cumulative = np.cumsum([member.weight for member in self.mixture or ()] or [1.0])
        u = uniform_numbers(seed, channel, 0, first, n, OF_WORLD, of=MIXTURE)[:, 0]
        return np.searchsorted(cumulative / cumulative[-1], u, side="right")

    def equipped(self, types: Ints | None = None) -> Equipped:
        """Who has what of V2X in worlds with these types [n, N]; without them, what everybody surely has, [1, N]."""
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

    def middle_world(self) -> Worlds:
        """The world (n = 1) in which every number is in the middle of its distribution: the median."""
        alone = self.model_copy()
        alone._columns = {entry: column.middle for entry, column in self.table_entries.items()}
        return alone.sample_by(lambda width, of: np.full((1, width), 0.5), np.zeros(1, np.int64)).worlds

    def sample_by(self, numbers: Callable[[int, tuple[int, ...]], Floats], index: Ints) -> Sample:
        """The worlds of ``numbers(width, of)``, uniform numbers [n, width] of a stream, ``()`` the first; all of them.

        An early impact is not refused here.
        """
        line, typed = self.types_of_line, None
        if line is not None:
            u = numbers(PER_TYPE * self.vehicles, TYPES)
            typed = line.draw(u.reshape(len(u), self.vehicles, PER_TYPE))
        declared = drawn_quantities(self, numbers, typed)
        drawn = world_quantities(self, declared)
        obstacle_gap_m = obstacle_gap(self, on_road(drawn), lambda key: declared(key)[:, 0])
        of_world = {key: drawn.pop(key)[:, 0] for key in ("restitution", "friction") if key in drawn}
        worlds = make_worlds(
            drawn.pop("gaps_m"), drawn.pop("speeds_mps"), obstacle_gap_m=obstacle_gap_m, **of_world, **drawn
        )
        if self.v2x.by_link:
            u = numbers(self.v2x.width(self.vehicles), V2X_NEWS)
            periodic = self.v2x.channel.persistence == "periodic"
            key = numbers(OF_WORLD, LATER_LOSSES)[:, 0] if periodic else np.zeros(len(u))
            equipped = self.equipped(None if typed is None else typed[0])
            worlds = self.v2x.with_channel(worlds, u, key, self.time_step_s, equipped)
        worlds = self.play_pieces(worlds)
        return Sample(worlds, index, 0, None if typed is None or line is None else np.array(line.names)[typed[0]])

    @property
    def table_columns(self) -> dict[str, Entry]:
        """Columns that a table of initial states may have for this scenario: ``gap_1_m``, ``speed_1_mps``, ..."""
        return _table_columns(_quantities(self), self.vehicles)

    def read_worlds(self, path: str | Path) -> Worlds:
        """Read worlds from a CSV file with a header line; columns as in ``worlds_from_table``.

        Raises ``InvalidInput`` with file, line and column for an unknown, repeated or missing column, a value that is
        not a number or out of range, a row of another length, a file without rows, or one beyond ``SIZE_LIMIT``.
        """
        file = Path(path)
        header, rows, lines = _read_csv(file)
        entries = _known_columns(header, self, f"{file}, line 1")
        table = np.empty((len(rows), len(header)))
        for r, row in enumerate(rows):
            table[r] = [_number_at(file, header, row, lines[r], name) for name in header]
        given = {entry: table[:, c] for c, entry in enumerate(entries)}
        return _worlds(given, self, _Naming(str(file), "file", lines))

    @staticmethod
    def read_rows(file: Path, columns: object, weights: object) -> dict[str, Any]:
        """The rows of a scenario's table, and their weights, from these columns of a CSV file.

        Raises ``InvalidInput`` naming file, line and column.
        """
        header, rows, lines = _read_csv(file)
        weights_of = [] if weights is None else [weights]
        if not isinstance(columns, list | tuple):
            raise InvalidInput(f"{file}: columns = {columns!r:.60}: must be a list of columns: {', '.join(header)}")
        for name in (*columns, *weights_of):
            if header.count(name) != 1:
                many = "is there twice" if name in header else f"is not there; {suggestion(str(name), header)}"
                raise InvalidInput(f"{file}, line 1: column {name!r:.60} {many.removesuffix('; ')}")
        found = [
            [_number_at(file, header, row, line, str(name)) for name in (*columns, *weights_of)]
            for row, line in zip(rows, lines, strict=False)  # blank lines at the end are no rows
        ]
        told: dict[str, Any] = {"rows": [row[: len(columns)] for row in found]}
        return told if weights is None else told | {"weights": [row[-1] for row in found]}

    def worlds_from_table(self, columns: Mapping[str, ArrayLike]) -> Worlds:
        """Worlds from columns of equal length n: ``gap_1_m`` ..., ``speed_1_mps`` ..., and optionally the others.

        Optional: ``braking_capacity_1_mps2``, ``driving_capacity_1_mps2``, ``latency_1_s``, ``mass_1_t``,
        ``speed_limit_1_mps`` and so on for each vehicle, ``restitution``, and ``obstacle_gap_m`` where the scenario has
        it. What is left out comes from the scenario, where it must be a fixed number. Raises ``InvalidInput`` naming
        the column and the row (from 0).
        """
        entries = _known_columns(list(columns), self, "initial states")
        given = {
            entry: _numbers(f"initial states: {name}", column)
            for entry, (name, column) in zip(entries, columns.items(), strict=True)
        }
        shapes = {column.shape for column in given.values()}
        if len(shapes) != 1 or len(next(iter(shapes))) != 1:
            lengths = ", ".join(f"{name} {list(np.shape(column))}" for name, column in columns.items())
            raise InvalidInput(f"initial states: columns must be lists of one and the same length, not {lengths}")
        return _worlds(given, self, _Naming("initial states", "table"))

    def worlds_from_state(self, initial_state: Mapping[str, Any]) -> Worlds:
        """The one world of ``{"gaps_m": [7, 7], "speeds_mps": [20, 18, 20], ...}``; keys are a scenario's quantities.

        A single number stands for every vehicle. What is left out comes from the scenario, where it must be a fixed
        number. Raises ``InvalidInput`` naming the key and the entry.
        """
        if not isinstance(initial_state, Mapping):
            raise InvalidInput(f"initial_state = {initial_state!r}: must be a mapping such as {{'gaps_m': [7, 7]}}")
        given: dict[Entry, Floats] = {}
        known = _quantities(self)
        for field, value in initial_state.items():
            if field not in known:
                if field in QUANTITY.optional:
                    raise InvalidInput(f"initial_state: {field} is not of this scenario: {self.name!r} has no {field}")
                hint = suggestion(str(field), known) or f"known: {', '.join(known)}"
                raise InvalidInput(f"initial_state: unknown key {field!r}; {hint}")
            count = known[field].count(self.vehicles)
            numbers = _numbers(f"initial_state: {field}", value)
            if numbers.shape not in ((), (count,)):
                several = f"{self.vehicles} vehicles need {count} numbers, or one for all"
                right = "must be one number" if known[field].per == "world" else several
                raise InvalidInput(f"initial_state: {field} has shape {list(numbers.shape)}; {right}")
            for index, number in enumerate(np.broadcast_to(numbers, (count,))):
                given[field, index] = np.array([number])
        return _worlds(given, self, _Naming("initial_state", "state"))

    def ranges(self) -> Ranges:
        """Every number that the scenario draws.

        Raises ``InvalidInput`` for a scenario that draws nothing, a mixture, and a channel whose delays are drawn:
        worlds of these cannot be given one by one.
        """
        if self.members:
            members = ", ".join(member.name for member in self.members)
            raise InvalidInput(f"scenario {self.name!r}: is a mixture; take one of its scenarios: {members}")
        if self.v2x.by_link:
            raise InvalidInput(
                f"scenario {self.name!r}: v2x: draws delays and losses, which no table of worlds holds; give v2x: paper"
                " (--set v2x=paper)"
            )
        found = {**_of_types(self), **_of_quantities(self)}
        if not found:
            raise InvalidInput(f"scenario {self.name!r}: draws nothing: all its worlds are the same")
        return Ranges(self, tuple(found), tuple(found.values()))


# From what a scenario declares, or a table gives, to worlds.


def world_quantities(scenario: ScenarioFields, declared: Callable[[str], Floats]) -> dict[str, Floats]:
    """Every quantity of k worlds, each [k, entries], from what ``declared(key)`` gives for the keys in use.

    ``speed = line speed + own deviation`` and ``gap = time gap x speed of the rear vehicle of the pair``. Both only
    grow with what they are made of, so the bounds of what is declared give the bounds of what the worlds have.
    """
    other = {"gaps_m": scenario.time_gaps_s, "speeds_mps": scenario.line_speed_mps}
    found = {key: declared(key) for key in QUANTITY.usual if other.get(key) is None}
    if scenario.alert_s is not None:
        found["latency_s"] = found["latency_s"] + declared("alert_s")
    for key in ALSO:
        if scenario.declares(key):
            found[key] = declared(key)
    if scenario.line_speed_mps is not None:
        found["speeds_mps"] = declared("line_speed_mps") + declared("speed_deviations_mps")
    if scenario.time_gaps_s is not None:
        found["gaps_m"] = declared("time_gaps_s") * found["speeds_mps"][:, 1:]
    return {key: found[key] for key in (*QUANTITY.usual, *ALSO) if key in found}


def on_road(found: Mapping[str, Floats]) -> dict[str, Floats]:
    """Quantities of worlds, their capacities as the road allows them: at most friction times gravity."""
    return as_road_allows(found, found["friction"]) if "friction" in found else dict(found)


def obstacle_gap(
    scenario: ScenarioFields, found: Mapping[str, Floats], declared: Callable[[str], Floats]
) -> Floats | None:
    """Distance from Vehicle 1 to the obstacle ahead, [k], of worlds with the quantities ``found``; None without one.

    As declared, or ``margin + v_1 tau_1 + v_1^2 / (2 a_1)``: so far beyond where Vehicle 1 stops by itself.
    """
    if scenario.declares("obstacle_gap_m"):
        return declared("obstacle_gap_m")
    if scenario.obstacle_margin_m is None:
        return None
    speed, latency, capacity = (found[key][:, 0] for key in ("speeds_mps", "latency_s", "braking_capacity_mps2"))
    rate = found["brake_rate_mps3"][:, 0] if "brake_rate_mps3" in found else np.full(len(speed), np.inf)
    return declared("obstacle_margin_m") + stopping_distances(speed, latency, capacity, rate)


def drawn_quantities(
    scenario: ScenarioFields, numbers: Callable[[int, tuple[int, ...]], Floats], typed: tuple[Ints, Floats] | None
) -> Callable[[str], Floats]:
    """What each declared key is in n worlds, [n, entries], from ``numbers`` as of ``ScenarioFields.sample_by``.

    ``typed``: type (index) and load of every vehicle, both [n, N], where the scenario has types.
    """
    streams: dict[tuple[int, ...], Floats] = {(): numbers(BLOCK * scenario.vehicles, ())}

    def at(place: Place) -> Floats:
        of, column = place
        if of not in streams:
            streams[of] = numbers(BLOCK * scenario.vehicles if of == BRAKES else OF_WORLD, of)
        return streams[of][:, column]

    def drawn(key: str) -> Floats:
        entries, rule = scenario.possible_quantities(key), QUANTITY.declared[key]
        found = np.empty((len(streams[()]), len(entries)))
        for i, possible in enumerate(entries):
            for kind, entry in possible.items():
                rows = slice(None) if typed is None or len(possible) == 1 else typed[0][:, i] == kind
                u = at(ROW if isinstance(entry, TableColumn) else rule.place(i))[rows]
                if isinstance(entry, WithLoad):
                    assert typed is not None
                    found[rows, i] = entry.value(typed[1][rows, i], u)
                else:
                    found[rows, i] = values(entry, u)
        return found

    return drawn


def _supports_of(scenario: ScenarioFields) -> Callable[[str], Floats]:
    """Smallest and largest value of every entry of each declared key, [2, entries]."""
    return lambda key: np.array(scenario.supports(key)).T


Channel = Literal["list", "training"]

CHANNELS: dict[str, int] = {"list": 0, "training": 1}

MOST_ATTEMPTS = 1000  # draws of one world before its scenario is declared unusable

_PATIENCE = 10  # attempts of a whole list before one world is tried to its end

MOST_AT_ONCE = 10_000_000  # worlds of one sample; a longer list is drawn in parts

_MOST_WORLDS = 2**62  # their numbers are 64-bit integers

_NUMBERS_PER_COUNTER = 4  # 64-bit integers that Philox makes from one counter


def uniform_numbers(
    seed: int, channel: Channel, attempt: int, first: int, n: int, width: int, *, of: tuple[int, ...] = ()
) -> Floats:
    """Uniform numbers in [0, 1) of worlds ``first`` to ``first + n - 1``: [n, width], width a multiple of 4.

    Row k depends on (seed, channel, attempt, of, first + k, width) only; ``of`` names a stream of its own, such as
    ``V2X_NEWS``. u is the upper 53 bits of a Philox integer.
    """
    sequence = np.random.SeedSequence([seed], spawn_key=(CHANNELS[channel], attempt, *of))
    key = sequence.generate_state(2, np.uint64)
    stream = np.random.Philox(key=key, counter=first * (width // _NUMBERS_PER_COUNTER))
    integers = np.asarray(stream.random_raw(n * width)).reshape(n, width)
    upper: Floats = (integers >> np.uint64(11)).astype(np.float64)
    return upper * 2.0**-53


def _draw_numbers(scenario: ScenarioFields, index: Ints, seed: int, channel: Channel) -> Sample:
    """The worlds with these numbers (ascending) of the scenario's list."""
    drawn = _draw(scenario, seed, channel, 0, index)
    if scenario.early_impacts == "keep" or not scenario.learners:
        return drawn
    early = early_impact(scenario, drawn.worlds)
    if not early.any():
        return drawn
    return _redraw(scenario, seed, channel, drawn, early)


def early_impact(scenario: ScenarioFields, worlds: Worlds) -> Bools:
    """Which worlds have an impact before (or just when) the first learner may act: [n].

    Vehicles follow their state-free scripts and learners coast, which nobody can change before that moment. Needs a
    learner: without one no impact is early, and ``draw`` refuses nothing.
    """
    vehicles = worlds.vehicles
    command = np.zeros(worlds.speeds_mps.shape)
    for i, script in scenario.scripts.items():
        scripted = ScriptSpec.parse(script).command(
            vehicles.braking_capacity_mps2[:, i], vehicles.driving_capacity_mps2[:, i]
        )
        if scripted is None:
            raise InvalidInput(f"scenario {scenario.name!r}: early_impacts reject: {script!r} depends on the state")
        command[:, i] = scripted
    first_action_s = worlds.first_decision_s(scenario.learners)
    _, impacts = advance(scenario.play_pieces(worlds), command, until_s=first_action_s)
    return np.asarray(impacts.count.sum(axis=1) + impacts.obstacle_count > 0)


def _redraw(scenario: ScenarioFields, seed: int, channel: Channel, drawn: Sample, early: Bools) -> Sample:
    """Draw refused worlds again, attempt by attempt, until every one is accepted."""
    parts, pending, rejected = [drawn.take(~early)], drawn.index[early], int(early.sum())
    for attempt in range(1, MOST_ATTEMPTS):
        if attempt == _PATIENCE and len(pending) > 1:
            _redraw_one(scenario, seed, channel, pending[:1])
        drawn = _draw(scenario, seed, channel, attempt, pending)
        early = early_impact(scenario, drawn.worlds)
        if not early.all():
            parts.append(drawn.take(~early))
        pending = pending[early]
        rejected += len(pending)
        if len(pending) == 0:
            return Sample.join(parts, rejected)
    raise _unusable(scenario, int(pending[0]))


def _redraw_one(scenario: ScenarioFields, seed: int, channel: Channel, index: Ints) -> None:
    """Follow one world to its end; if it fails the whole list fails, and this way soon."""
    for attempt in range(_PATIENCE, MOST_ATTEMPTS):
        if not early_impact(scenario, _draw(scenario, seed, channel, attempt, index).worlds)[0]:
            return
    raise _unusable(scenario, int(index[0]))


def _unusable(scenario: ScenarioFields, world: int) -> InvalidInput:
    learners = ", ".join(scenario.vehicle_names[i] for i in scenario.learners)
    gaps = "time_gaps_s" if scenario.gaps_m is None else "gaps_m"
    return InvalidInput(
        f"scenario {scenario.name!r}: early_impacts: reject, but {MOST_ATTEMPTS} draws of world {world} all have an"
        f" impact before {learners} may act; give larger {gaps}, a smaller latency_s, or early_impacts: keep"
    )


def _draw(scenario: ScenarioFields, seed: int, channel: Channel, attempt: int, index: Ints) -> Sample:
    """The worlds with these numbers (ascending), as drawn in this attempt."""
    first, last = int(index[0]), int(index[-1])

    def numbers(width: int, of: tuple[int, ...] = ()) -> Floats:
        u = uniform_numbers(seed, channel, attempt, first, last - first + 1, width, of=of)
        return u if len(u) == len(index) else u[index - first]

    return scenario.sample_by(numbers, index)


# Worlds whose initial conditions the user gives: a table (one row per world) or one state for ``reset``.

Entry = tuple[str, int]  # quantity and index (from 0) of the vehicle or pair

SIZE_LIMIT = 64 << 20  # bytes of a table

_ALWAYS_IN_A_TABLE = ("gaps_m", "speeds_mps")


@dataclass(frozen=True, slots=True)
class _Naming:
    """How messages call a value: by column and row of a table, or by key and index of one state."""

    where: str
    kind: Literal["file", "table", "state"]
    lines: Sequence[int] = ()  # of a file: on which each row begins

    def entry(self, entry: Entry) -> str:
        field, index = entry
        if self.kind != "state":
            return f"column {QUANTITY.declared[field].column_of(index)}"
        return field if QUANTITY.declared[field].per == "world" else f"{field}[{index}]"

    def value(self, entry: Entry, row: int) -> str:
        if self.kind == "state":
            return f"{self.where}: {self.entry(entry)}"
        place = f"line {self.lines[row]}" if self.kind == "file" else f"row {row}"
        return f"{self.where}, {place}, {self.entry(entry)}"


def _quantities(scenario: ScenarioFields) -> dict[str, QuantityRule]:
    """What a world of this scenario has."""
    there = {"obstacle_gap_m": scenario.has_obstacle, "friction": scenario.has_friction}
    return QUANTITY.usual | {
        key: rule for key, rule in QUANTITY.optional.items() if there.get(key, scenario.declares(key))
    }


def _table_columns(rules: Mapping[str, QuantityRule], vehicles: int) -> dict[str, Entry]:
    """The columns of a table with these quantities, and the entry of each."""
    named = {key: rule for key, rule in rules.items() if rule.column}
    return {rule.column_of(i): (key, i) for key, rule in named.items() for i in range(rule.count(vehicles))}


def _tabled(data: Mapping[str, Any], key: str) -> bool:
    """Whether the table of fields of a scenario has every entry of a quantity."""
    table, rule = data.get("table"), QUANTITY.declared[key]
    if table is None or "vehicles" not in data or not rule.column:
        return False
    return all(rule.column_of(i) in table.columns for i in range(rule.count(data["vehicles"])))


def _worlds(given: Mapping[Entry, Floats], scenario: ScenarioFields, naming: _Naming) -> Worlds:
    """Check the given columns, each [n], fill in the scenario's fixed numbers, and build the worlds."""
    if scenario.members:
        raise InvalidInput(
            f"{naming.where}: scenario {scenario.name!r} is a mixture, and nothing says which of its scenarios a world"
            f" belongs to; take one of them: {', '.join(member.name for member in scenario.members)}"
        )
    n = len(next(iter(given.values()))) if given else 1
    full: dict[str, Floats] = {}
    rules = _quantities(scenario)
    last = ("gaps_m", "obstacle_gap_m")  # may need the others
    for field, rule in sorted(rules.items(), key=lambda item: item[0] in last):
        full[field] = np.empty((n, rule.count(scenario.vehicles)))
        for index in range(rule.count(scenario.vehicles)):
            column = given.get((field, index))
            if column is None:
                column = _fixed(scenario, field, index, full)
            if column is None:
                missing = naming.entry((field, index))
                raise InvalidInput(f"{naming.where}: {missing} is missing, and random in scenario {scenario.name!r}")
            good = (column > 0.0 if rule.positive else column >= 0.0) & (column <= rule.high)
            _require_all(good, naming, (field, index), column, f"must be {rule.interval}")
            full[field][:, index] = column
    _check_together(full, scenario, naming)
    of_world = {field: full.pop(field)[:, 0] for field, rule in rules.items() if rule.per == "world"}
    worlds = make_worlds(full.pop("gaps_m"), full.pop("speeds_mps"), **of_world, **full)
    line = scenario.types_of_line
    drawn = line is not None and any(kind.v2x is not None for kind in line.kinds)
    return scenario.v2x.with_fixed_news(
        scenario.play_pieces(worlds), scenario.time_step_s, naming.where, None if drawn else scenario.equipped()
    )


def _fixed(scenario: ScenarioFields, field: str, index: int, full: Mapping[str, Floats]) -> Floats | None:
    """What the scenario fixes for this entry, [n] or [1]; None if random.

    A time gap is taken at the speeds in ``full``, the margin to an obstacle from where Vehicle 1 stops there.
    """
    if field == "obstacle_gap_m":
        low, high = support(scenario.quantities(field if scenario.declares(field) else "obstacle_margin_m")[0])
        return obstacle_gap(scenario, on_road(full), lambda key: np.array([low])) if low == high else None
    by_time = field == "gaps_m" and scenario.time_gaps_s is not None
    told = scenario.bounds(field, dry=True)[index]
    low, high = support(scenario.quantities("time_gaps_s")[index]) if by_time else told
    if low != high:
        return None
    return low * full["speeds_mps"][:, index + 1] if by_time else np.array([low])


def _check_together(full: Mapping[str, Floats], scenario: ScenarioFields, naming: _Naming) -> None:
    for index in range(scenario.vehicles):
        latency, speed, limit = (full[f][:, index] for f in ("latency_s", "speeds_mps", "speed_limit_mps"))
        right = f"must be below the scenario's horizon_s ({scenario.horizon_s:g} s)"
        _require_all(latency < scenario.horizon_s, naming, ("latency_s", index), latency, right)
        good = speed <= limit
        limit_mps = limit[np.argmin(good)]  # of the world that the message is about
        right = f"must not be above speed_limit_mps of vehicle_{index + 1}, {limit_mps:g} m/s"
        _require_all(good, naming, ("speeds_mps", index), speed, right)


def _require_all(good: Bools, naming: _Naming, entry: Entry, column: Floats, right: str) -> None:
    """Refuse the first world for which ``good`` does not hold."""
    if not good.all():
        row = int(np.argmin(good))
        raise InvalidInput(f"{naming.value(entry, row)} = {column[row]:.12g}: {right}")


def _known_columns(header: list[str], scenario: ScenarioFields, where: str) -> list[Entry]:
    """The entry of each column; unknown, repeated and missing columns are errors."""
    known = scenario.table_columns
    if twice := [name for name, times in Counter(header).items() if times > 1]:
        raise InvalidInput(f"{where}: column {twice[0]!r} is given twice")
    for name in header:
        if name not in known:
            hint = suggestion(name, known) or f"known: {', '.join(known)}"
            separator = "; columns are separated by commas" if ";" in name or "\t" in name else ""
            raise InvalidInput(f"{where}: unknown column {name!r}; {hint}{separator}")
    for name, (field, _) in known.items():
        if field in _ALWAYS_IN_A_TABLE and name not in header:
            raise InvalidInput(f"{where}: column {name!r} is missing; {scenario.vehicles} vehicles need it")
    return [known[name] for name in header]


def _numbers(what: str, value: ArrayLike) -> Floats:
    try:
        return real_numbers(value)
    except ValueError as error:
        raise InvalidInput(f"{what} = {value!r}: {error}; must be a number or a list of numbers") from None


def _read_csv(file: Path) -> tuple[list[str], list[list[str]], list[int]]:
    """Header and rows of a CSV file, unchecked, and the line on which each row begins; there is at least one row."""
    rows: list[list[str]] = []
    lines: list[int] = []
    data = read_plain(file, SIZE_LIMIT)
    try:
        reader = csv.reader(io.StringIO(data.decode("utf-8-sig"), newline=""), strict=True)
        begins = 1
        for row in reader:
            rows.append(row)
            lines.append(begins)
            begins = reader.line_num + 1
    except (csv.Error, ValueError) as error:
        raise InvalidInput(f"{file}: cannot be read as CSV: {error}") from None
    while rows and not rows[-1]:
        rows.pop()  # blank lines at the end
    if not rows or not rows[0]:
        raise InvalidInput(f"{file}, line 1: must name the columns, for instance gap_1_m,gap_2_m,speed_1_mps,...")
    if len(rows) == 1:
        raise InvalidInput(f"{file}: has a header but no rows; one row is one world")
    return [name.strip() for name in rows[0]], rows[1:], lines[1:]


def _number_at(file: Path, header: list[str], row: list[str], line: int, column: str) -> float:
    """The number in this column of a row of a CSV file."""
    if len(row) != len(header):
        raise InvalidInput(f"{file}, line {line}: {len(row)} values, but the header has {len(header)} columns")
    text = row[header.index(column)]
    number = parse_numeral(text.strip())
    if number is None:
        raise InvalidInput(f"{file}, line {line}, column {column}: {text!r:.60} is not a number")
    return number


# The ranges of a scenario as a unit cube: one coordinate for each number that it draws.
#
# A search moves in the cube, where every point is as likely as any other and gives one world; a list is a random sample
# of it.

_UNUSED = 0.5  # in the place of numbers that change nothing


@dataclass(frozen=True, slots=True)
class Ranges:
    """The numbers that a scenario draws: their names, and where each stands among a world's uniform numbers."""

    scenario: ScenarioFields
    names: tuple[str, ...]
    places: tuple[Place, ...]

    def sample(self, points: Floats) -> tuple[Sample, Bools]:
        """The worlds at ``points`` [n, coordinates] of [0, 1), and which of them the scenario would accept, [n].

        A scenario that rejects early impacts does not accept worlds that have one.
        """
        n, vehicles = len(points), self.scenario.vehicles
        widths = {(): BLOCK * vehicles, TYPES: PER_TYPE * vehicles, OBSTACLE: OF_WORLD, SURROUNDINGS: OF_WORLD}
        widths[BRAKES] = widths[()]
        streams = {of: np.full((n, width), _UNUSED) for of, width in widths.items()}
        for (of, column), u in zip(self.places, points.T, strict=True):
            streams[of][:, column] = u
        found = self.scenario.sample_by(lambda _, of: streams[of], np.arange(n, dtype=np.int64))
        if self.scenario.early_impacts == "keep" or not self.scenario.learners:
            return found, np.ones(n, np.bool_)
        return found, ~early_impact(self.scenario, found.worlds)


def _of_quantities(scenario: ScenarioFields) -> dict[str, Place]:
    """Name -> place of every quantity that is drawn."""
    used: list[str] = []

    def note(key: str) -> Floats:
        used.append(key)
        return np.ones((1, len(scenario.possible_quantities(key))))

    world_quantities(scenario, note)
    used += [key for key in ("obstacle_gap_m", "obstacle_margin_m") if getattr(scenario, key) is not None]
    places: dict[str, Place] = {
        _name(key, i): QUANTITY.declared[key].place(i)
        for key in used
        for i, possible in enumerate(scenario.possible_quantities(key))
        if any(_drawn(entry.spread if isinstance(entry, WithLoad) else entry) for entry in possible.values())
    }
    if any(_drawn(column, tabled=True) for column in scenario.table_entries.values()):
        places["row of the table"] = ROW
    return places


def _of_types(scenario: ScenarioFields) -> dict[str, Place]:
    """Name -> place of the type and the load of every vehicle that has several, or moves something with its load."""
    if scenario.types_of_line is None:
        return {}
    places: dict[str, Place] = {}
    for i, vehicle in enumerate(scenario.vehicle_names):
        possible = [scenario.possible_quantities(key)[i] for key in QUANTITY.of_a_type if scenario.declares(key)]
        if any(len(each) > 1 for each in possible):
            places[f"{vehicle} type"] = (TYPES, PER_TYPE * i)
        if any(isinstance(entry, WithLoad) for each in possible for entry in each.values()):
            places[f"{vehicle} load"] = (TYPES, PER_TYPE * i + 1)
    return places


def _drawn(entry: AnyTypeQuantity, *, tabled: bool = False) -> bool:
    low, high = support(entry)
    return low != high and isinstance(entry, TableColumn) == tabled


def _name(key: str, index: int) -> str:
    owner = QUANTITY.declared[key].owner(index)
    return f"{key} of {owner}" if owner else key
