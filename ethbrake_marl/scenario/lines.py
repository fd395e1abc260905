"""The fields of a scenario: what a file may say, before anything is checked or drawn."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Annotated, Any, Literal, NoReturn

import numpy as np
from numpy.typing import ArrayLike
from pydantic import (
    AfterValidator,
    Discriminator,
    Field,
    GetJsonSchemaHandler,
    PrivateAttr,
    Tag,
    ValidationInfo,
    field_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.yaml import UNSHOWN, FileModel, YamlPath, parse_numeral, refuse, suggestion
from ethbrake_marl.harm import ObjectiveName
from ethbrake_marl.physics.worlds import Floats, Ints
from ethbrake_marl.scenario.features import ListedFeatures
from ethbrake_marl.scenario.quantities import DECLARED, Choice, LogUniform, Normal, Quantity, Uniform, WithLoad, support
from ethbrake_marl.scenario.v2x import V2X

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


def _types_or_each(value: object) -> str:
    return "#each" if isinstance(value, list | tuple) else "#types"


Types = Annotated[
    Annotated[TypesHere, Tag("#types")]
    | Annotated[tuple[TypesHere, ...], Field(strict=False, min_length=1), Tag("#each")],
    Discriminator(_types_or_each),
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


def _one_or_each(value: object) -> str:
    return "#each" if isinstance(value, list | tuple) else "#one"


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
        exclude_if=lambda value: value is None,
        description="what a car, a truck, ... is: type -> weight and quantities",
    )
    types: Types | None = Field(
        default=None,
        exclude_if=lambda value: value is None,
        description="which types may stand where: a type, any, or a weight for each; one entry for all or one for each",
    )
    mixture: Annotated[tuple[Member, ...], Field(strict=False)] | None = Field(
        default=None,
        exclude_if=lambda value: value is None,
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
        exclude_if=lambda value: value is None,
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
