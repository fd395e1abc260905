"""Vehicle types: the quantities of a car, a van or a truck, and the types that are possible at each place of a line.

A vehicle's type is drawn first, then its quantities. All quantities ``{with_load: [empty, full]}`` of a vehicle use the
same load: a full truck is heavy *and* brakes weakly.
"""

from __future__ import annotations

from collections.abc import Mapping
from operator import not_
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Discriminator, Field, Tag, ValidationInfo, field_validator

from ethbrake_marl.files.model import NAME_PATTERN, UNSHOWN, require, suggestion
from ethbrake_marl.motion.layout import Bools, Floats, Ints
from ethbrake_marl.worlds.channel import Equipage
from ethbrake_marl.worlds.quantities import OF_A_TYPE, QUANTITIES, USUAL, check_length
from ethbrake_marl.worlds.quantity import (
    ONE_OR_EACH,
    Pair,
    Quantity,
    ScenarioPart,
    Uniform,
    Weight,
    pick,
    support,
    values,
)

ANY_TYPE = "any"  # every type, in proportion to its weight


class WithLoad(ScenarioPart):
    """``{with_load: [empty, full]}``: ``empty + (full - empty) load``, plus a value that ``spread`` draws."""

    with_load: Pair = Field(description="[empty, full]: value of an empty vehicle, value of a full vehicle")
    spread: Quantity = Field(
        default=0.0, exclude_if=not_, description="distribution around 0 of a random amount that is added to the value"
    )

    @property
    def support(self) -> tuple[float, float]:
        low, high = support(self.spread)
        return min(self.with_load) + low, max(self.with_load) + high

    def value(self, load: Floats, u: Floats) -> Floats:
        """``load`` [n]: 0 empty, 1 full. Uniform numbers ``u`` [n] draw the spread."""
        empty, full = self.with_load
        value_for_load = np.clip(empty + (full - empty) * load, min(self.with_load), max(self.with_load))
        return value_for_load if self.spread == 0.0 else value_for_load + values(self.spread, u)


def _tag(value: object) -> str:
    return "#with_load" if isinstance(value, WithLoad) or (isinstance(value, dict) and "with_load" in value) else "#one"


TypeQuantity = Annotated[Annotated[Quantity, Tag("#one")] | Annotated[WithLoad, Tag("#with_load")], Discriminator(_tag)]


def _type_quantity(key: str) -> Any:
    return Field(default=None, exclude_if=None if key in USUAL else not_, description=QUANTITIES[key].meaning)


class VehicleType(ScenarioPart):
    """Masses, capacities, latencies and more of one kind of vehicle.

    If a type does not declare a quantity, the scenario's key outside ``vehicle_types`` applies.
    """

    weight: Weight = Field(default=1.0, description="how likely this type is, relative to the other types")
    load: Quantity = Field(
        default_factory=lambda: Uniform(uniform=(0.0, 1.0)), description="load, as a fraction of the full load, 0 to 1"
    )
    braking_capacity_mps2: TypeQuantity | None = _type_quantity("braking_capacity_mps2")
    driving_capacity_mps2: TypeQuantity | None = _type_quantity("driving_capacity_mps2")
    mass_t: TypeQuantity | None = _type_quantity("mass_t")
    latency_s: TypeQuantity | None = _type_quantity("latency_s")
    speed_limit_mps: TypeQuantity | None = _type_quantity("speed_limit_mps")
    brake_rate_mps3: TypeQuantity | None = _type_quantity("brake_rate_mps3")
    release_rate_mps3: TypeQuantity | None = _type_quantity("release_rate_mps3")
    v2x: Equipage | None = Field(
        default=None, exclude_if=not_, description="V2X equipment of this type; by default sending and receiving"
    )

    @field_validator(*OF_A_TYPE)
    @classmethod
    def _in_range(cls, value: Any, info: ValidationInfo) -> Any:
        QUANTITIES[str(info.field_name)].check(value)
        return value

    @field_validator("load")
    @classmethod
    def _share(cls, value: Any) -> Any:
        low, high = support(value)
        require(low >= 0.0 and high <= 1.0, (), value, "a load must be in [0, 1]: 0 is empty, 1 is full")
        return value


def _check_names(kinds: dict[str, VehicleType]) -> dict[str, VehicleType]:
    require(
        ANY_TYPE not in kinds,
        (ANY_TYPE,),
        UNSHOWN,
        f"{ANY_TYPE} means every type, so it cannot be a name; use another name",
    )
    return kinds


TypeName = Annotated[str, Field(pattern=NAME_PATTERN)]
VehicleTypes = Annotated[dict[TypeName, VehicleType], Field(min_length=1), AfterValidator(_check_names)]

# possible types of one vehicle: a type, ``any``, or a weight per type
TypesHere = str | Annotated[dict[str, Weight], Field(min_length=1)]
Types = Annotated[
    Annotated[TypesHere, Tag("#one")] | Annotated[tuple[TypesHere, ...], Field(strict=False), Tag("#each")], ONE_OR_EACH
]


def check_types(types: Any, kinds: Mapping[str, VehicleType] | None, vehicles: int) -> None:
    right = "can be used only with the key vehicle_types, which declares the types"
    require(kinds is not None, ("types",), types, right)
    check_length(types, vehicles, "vehicle", ("types",))
    known, is_list = [*(kinds or {}), ANY_TYPE], isinstance(types, tuple)
    for index, entry in enumerate(types if is_list else (types,)):
        for name in [entry] if isinstance(entry, str) else entry:
            hint = suggestion(name, known) or f"known: {', '.join(known)}"
            good = name in known and (name != ANY_TYPE or isinstance(entry, str))
            require(good, ("types", index) if is_list else ("types",), entry, f"unknown vehicle type {name}; {hint}")


class TypesOfLine:
    """Types are numbered from 0 in the order of ``vehicle_types``."""

    def __init__(self, kinds: Mapping[str, VehicleType], types: Any, vehicles: int) -> None:
        self.names, self.kinds = tuple(kinds), tuple(kinds.values())
        every = {name: kind.weight for name, kind in kinds.items()}
        places = types if isinstance(types, tuple) else (types or ANY_TYPE,) * vehicles
        weights_by_place = [
            every if here == ANY_TYPE else {here: 1.0} if isinstance(here, str) else here for here in places
        ]
        self.weights = np.array([[here.get(name, 0.0) for name in kinds] for here in weights_by_place])  # [N, types]
        self.possible: Bools = self.weights > 0.0  # [N, types]

    def draw(self, u: Floats) -> tuple[Ints, Floats]:
        """Type and load (0 to 1) of every vehicle, [n, N] each, for uniform numbers ``u`` [n, N, PER_TYPE]."""
        types, load = np.zeros(u.shape[:2], np.int64), np.zeros(u.shape[:2])
        for i, weights in enumerate(self.weights):
            types[:, i] = pick(weights, u[:, i, 0])
            for kind in np.flatnonzero(self.possible[i]):
                rows = types[:, i] == kind
                load[rows, i] = values(self.kinds[kind].load, u[rows, i, 1])
        return types, load

    def unheard(self, types: Ints | None) -> Bools:
        """As in ``Scenario.unheard``."""
        equipment = [kind.v2x or Equipage() for kind in self.kinds]
        silent = np.array([not equipage.sends for equipage in equipment])
        hears = np.array([("all", "front", "none").index(equipage.hears) for equipage in equipment])
        if types is None:  # of the types that are possible at each place the one with the least equipment
            silent, hears = (np.max(levels * self.possible, axis=1)[np.newaxis] for levels in (silent, hears))
        else:
            silent, hears = silent[types], hears[types]
        receiver, sender = np.indices((len(self.weights),) * 2)
        deaf = (hears == 2)[:, :, np.newaxis] | (hears == 1)[:, :, np.newaxis] & (sender >= receiver)
        return np.asarray(silent[:, np.newaxis] | deaf)
