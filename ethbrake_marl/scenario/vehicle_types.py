"""Types of vehicles: what a car, a van or a truck is, drawn together, and which of them may stand where.

A world's vehicle first gets its type, then its quantities as that type declares them. What moves with the load of a
vehicle, ``{with_load: [empty, full]}``, moves together: a full truck is heavy *and* brakes weakly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NoReturn

import numpy as np
from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.messages import suggestion
from ethbrake_marl.files.yaml import YamlPath, flow_text
from ethbrake_marl.physics.worlds import Floats, Ints
from ethbrake_marl.scenario.distributions import (
    Choice,
    LogUniform,
    Normal,
    Quantity,
    Uniform,
    WithLoad,
    support,
)
from ethbrake_marl.scenario.quantities import DECLARED

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


class VehicleType(BaseModel):
    """One type: how likely it is, and every quantity that it declares; the rest is as beside ``vehicle_types``."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")

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
            _refuse((), value, "must be a number or a distribution; a key that is not used is left out")
        rule = DECLARED[str(info.field_name)]
        if not rule.allows(*support(value)):
            _refuse((), _plain(value), f"must be {rule.interval}")
        return value

    @field_validator("load")
    @classmethod
    def _share(cls, value: Any) -> Any:
        low, high = support(value)
        if not (low >= 0.0 and high <= 1.0):
            _refuse((), _plain(value), "must be in [0, 1]: 0 empty, 1 full")
        return value


VehicleTypes = Annotated[dict[TypeName, VehicleType], Field(min_length=1)]
TypesHere = str | dict[str, Weight]  # of one vehicle: a type, ``any``, or a weight for each type that may stand there


def _one_or_each(value: object) -> str:
    return "#each" if isinstance(value, list | tuple) else "#types"


Types = Annotated[
    Annotated[TypesHere, Tag("#types")]
    | Annotated[tuple[TypesHere, ...], Field(strict=False, min_length=1), Tag("#each")],
    Discriminator(_one_or_each),
]


def check_type_names(kinds: Mapping[str, VehicleType]) -> None:
    """Refuse a type whose name would mean every type."""
    if ANY in kinds:
        _refuse((ANY,), "", f"{ANY} stands for every type; give another name")


def check_types(types: Any, kinds: Mapping[str, VehicleType] | None, vehicles: int) -> None:
    """Every entry names types that are declared, and a list has one entry per vehicle."""
    if kinds is None:
        _refuse((), _plain(types), "needs vehicle_types, which says what the types are")
    listed = isinstance(types, tuple)
    if listed and len(types) != vehicles:
        _refuse((), "", f"has {len(types)} entries; {vehicles} vehicles need {vehicles}, or one for all")
    for index, entry in enumerate(types if listed else (types,)):
        at: YamlPath = (index,) if listed else ()
        names = [entry] if isinstance(entry, str) else list(entry)
        if not names:
            _refuse(at, entry, "must name a type")
        for name in names:
            if name not in kinds and not (name == ANY and isinstance(entry, str)):
                hint = suggestion(name, kinds) or f"known: {', '.join(kinds)}"
                _refuse(at, entry, f"unknown type {name}; {hint}")


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


def _refuse(at: YamlPath, value: Any, right: str) -> NoReturn:
    shown = value if value == "" else flow_text(value, 60)
    raise PydanticCustomError("scenario", "{right}", {"right": right, "value": shown, "at": at})


def _plain(value: Any) -> Any:
    return value.model_dump(exclude_none=True) if isinstance(value, BaseModel) else value
