"""Vehicle types: the quantities of a car, a van or a truck, and the types that are possible at each place of a line.

The type of a vehicle is drawn first, then its quantities from what this type declares. All quantities
``{with_load: [empty, full]}`` of a vehicle depend on the same load: a full truck is heavy *and* brakes weakly.
"""

from __future__ import annotations

from collections.abc import Mapping
from operator import not_
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Discriminator, Field, Tag, ValidationInfo, field_validator

from ethbrake_marl.files.model import NAME_PATTERN, UNSHOWN, FileModel, require, suggestion
from ethbrake_marl.files.yaml import YamlPath
from ethbrake_marl.motion.layout import Floats, Ints
from ethbrake_marl.worlds.channel import Equipage
from ethbrake_marl.worlds.quantity import LEAVE_OUT, Quantity, Uniform, WithLoad, pick, support, values
from ethbrake_marl.worlds.rules import OF_A_TYPE, RULES

ANY = "any"  # every type, in proportion to its weight

Weight = Annotated[float, Field(gt=0.0, le=1e9, allow_inf_nan=False)]


def _tag(value: object) -> str:
    return "#with_load" if isinstance(value, WithLoad) or (isinstance(value, dict) and "with_load" in value) else "#one"


TypeQuantity = Annotated[Annotated[Quantity, Tag("#one")] | Annotated[WithLoad, Tag("#with_load")], Discriminator(_tag)]


class VehicleType(FileModel):
    """A vehicle type. What it does not declare, the scenario declares outside ``vehicle_types``."""

    weight: Weight = Field(default=1.0, description="how likely this type is, relative to the other types")
    load: Quantity = Field(
        default_factory=lambda: Uniform(uniform=(0.0, 1.0)), description="load, as a fraction of the full load, 0 to 1"
    )
    braking_capacity_mps2: TypeQuantity | None = Field(default=None, description=RULES["braking_capacity_mps2"].meaning)
    driving_capacity_mps2: TypeQuantity | None = Field(default=None, description=RULES["driving_capacity_mps2"].meaning)
    mass_t: TypeQuantity | None = Field(default=None, description=RULES["mass_t"].meaning)
    latency_s: TypeQuantity | None = Field(default=None, description=RULES["latency_s"].meaning)
    speed_limit_mps: TypeQuantity | None = Field(default=None, description=RULES["speed_limit_mps"].meaning)
    brake_rate_mps3: TypeQuantity | None = Field(
        default=None, exclude_if=not_, description=RULES["brake_rate_mps3"].meaning
    )
    release_rate_mps3: TypeQuantity | None = Field(
        default=None, exclude_if=not_, description=RULES["release_rate_mps3"].meaning
    )
    v2x: Equipage | None = Field(
        default=None, exclude_if=not_, description="V2X equipment of this type; by default sending and receiving"
    )

    @field_validator(*OF_A_TYPE)
    @classmethod
    def _in_range(cls, value: Any, info: ValidationInfo) -> Any:
        require(value is not None, (), value, LEAVE_OUT)
        rule = RULES[str(info.field_name)]
        require(rule.allows(*support(value)), (), value, f"must be {rule.interval}")
        return value

    @field_validator("load")
    @classmethod
    def _share(cls, value: Any) -> Any:
        low, high = support(value)
        require(low >= 0.0 and high <= 1.0, (), value, "a load must be in [0, 1]: 0 is empty, 1 is full")
        return value


def _check_names(kinds: dict[str, VehicleType]) -> dict[str, VehicleType]:
    require(ANY not in kinds, (ANY,), UNSHOWN, f"{ANY} means every type, so it cannot be a name; use another name")
    return kinds


TypeName = Annotated[str, Field(pattern=NAME_PATTERN)]
VehicleTypes = Annotated[dict[TypeName, VehicleType], Field(min_length=1), AfterValidator(_check_names)]

TypesHere = str | dict[str, Weight]  # possible types of one vehicle: a type, ``any``, or a weight per type
Types = Annotated[
    Annotated[TypesHere, Tag("#one")]
    | Annotated[tuple[TypesHere, ...], Field(strict=False, min_length=1), Tag("#each")],
    Discriminator(lambda value: "#each" if isinstance(value, list | tuple) else "#one"),
]


def check_types(types: Any, kinds: Mapping[str, VehicleType] | None, vehicles: int) -> None:
    """Raise, in a pydantic validator, the error for an entry of the key ``types`` that names no declared type."""
    if kinds is None:
        require(False, (), types, "can be used only with the key vehicle_types, which declares the types")
        return
    listed = isinstance(types, tuple)
    right = f"has {len(types)} entries; must have {vehicles}, one per vehicle, or be a single entry for all"
    require(not listed or len(types) == vehicles, (), UNSHOWN, right)
    for index, entry in enumerate(types if listed else (types,)):
        at: YamlPath = (index,) if listed else ()
        names = [entry] if isinstance(entry, str) else list(entry)
        require(len(names) > 0, at, entry, "must name at least one vehicle type")
        for name in names:
            hint = suggestion(name, kinds) or f"known: {', '.join(kinds)}"
            known = name in kinds or (name == ANY and isinstance(entry, str))
            require(known, at, entry, f"unknown vehicle type {name}; {hint}")


class TypesOfLine:
    """The possible types at each place of a line. A type is named by its index in ``vehicle_types``."""

    def __init__(self, kinds: Mapping[str, VehicleType], types: Any, vehicles: int) -> None:
        self.names, self.kinds = tuple(kinds), tuple(kinds.values())
        each = types if isinstance(types, tuple) else (types or ANY,) * vehicles
        self.weights = np.array([[_weight(kinds, name, here) for name in kinds] for here in each])  # [N, types]

    def possible(self, vehicle: int) -> list[int]:
        """Return the possible types of a vehicle (from 0)."""
        return np.flatnonzero(self.weights[vehicle] > 0.0).tolist()

    def draw(self, u: Floats) -> tuple[Ints, Floats]:
        """Return type and load of every vehicle, [n, N] each, for uniform numbers ``u`` [n, N, PER_TYPE]."""
        types, load = np.zeros(u.shape[:2], np.int64), np.zeros(u.shape[:2])
        for i, weights in enumerate(self.weights):
            types[:, i] = pick(weights, u[:, i, 0])
            for kind in self.possible(i):
                rows = types[:, i] == kind
                load[rows, i] = values(self.kinds[kind].load, u[rows, i, 1])
        return types, load


def _weight(kinds: Mapping[str, VehicleType], name: str, here: TypesHere) -> float:
    if isinstance(here, str):
        return kinds[name].weight if here == ANY else float(here == name)
    return here.get(name, 0.0)
