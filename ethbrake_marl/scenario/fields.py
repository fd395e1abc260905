"""The fields of a scenario: what a file may say, before anything is checked or drawn."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Discriminator, Field, GetJsonSchemaHandler, PrivateAttr, Tag
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.objectives import ObjectiveName
from ethbrake_marl.scenario.distributions import Choice, LogUniform, Normal, Quantity, Uniform, support
from ethbrake_marl.scenario.features import ListedFeatures
from ethbrake_marl.scenario.quantities import DECLARED
from ethbrake_marl.scenario.roles import LEARNER, complete_roles
from ethbrake_marl.scenario.v2x import V2X
from ethbrake_marl.scenario.vehicle_types import (
    TYPE_KEYS,
    AnyTypeQuantity,
    Types,
    TypesOfLine,
    VehicleTypes,
    Weight,
    typed_quantity,
)

AnyQuantity = float | Uniform | LogUniform | Normal | Choice

OF_EVERY_VEHICLE = ("braking_capacity_mps2", "driving_capacity_mps2", "mass_t", "latency_s")  # needed: no default

NAME_PATTERN = r"^[a-z0-9][a-z0-9_-]{0,63}$"


def _one_or_each(value: object) -> str:
    return "#each" if isinstance(value, list | tuple) else "#one"


def _none(value: Any) -> bool:
    return value is None


class _LeftOut:
    """Stands for a key that is not given, where a check must say whether it may be."""


LEFT_OUT = _LeftOut()


def _left_out() -> Any:
    return LEFT_OUT


PerVehicle = Annotated[
    Annotated[Quantity, Tag("#one")] | Annotated[tuple[Quantity, ...], Field(strict=False, min_length=1), Tag("#each")],
    Discriminator(_one_or_each),
]


class _MemberSchema:
    """In a file also a scenario's name, or the path of its file."""

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {"anyOf": [{"type": "string"}, {"type": "object"}]}


class Member(BaseModel):
    """One scenario of a mixture: what it says, and how likely it is, relative to the others."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")

    scenario: Annotated[dict[str, Any], _MemberSchema] = Field(description="a name, a path, or what its file says")
    weight: Weight = Field(default=1.0, description="how likely it is, relative to the other scenarios")


class ScenarioFields(BaseModel):
    """What is declared of a line of vehicles, and what follows from the declaration alone. See ``Scenario``."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")

    name: str = Field(pattern=NAME_PATTERN, description="name; equal to the file's name without .yaml")
    title: str = Field(default="", description="one line for lists and figures")
    description: str = Field(default="", description="what the scenario is for")
    source: str = Field(default="", description="where the values come from")
    vehicles: int = Field(default=3, ge=2, le=64, description="number of vehicles N, vehicle_1 in front")
    vehicle_types: VehicleTypes | None = Field(
        default=None, exclude_if=_none, description="what a car, a truck, ... is: type -> weight and quantities"
    )
    types: Types | None = Field(
        default=None,
        exclude_if=_none,
        description="which types may stand where: a type, any, or a weight for each; one entry for all or one for each",
    )
    mixture: Annotated[tuple[Member, ...], Field(strict=False)] | None = Field(
        default=None, exclude_if=_none, description="scenarios that each world is drawn from one of, by weight"
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
        default_factory=_left_out, validate_default=True, description=DECLARED["braking_capacity_mps2"].meaning
    )
    driving_capacity_mps2: PerVehicle | None = Field(
        default_factory=_left_out, validate_default=True, description=DECLARED["driving_capacity_mps2"].meaning
    )
    mass_t: PerVehicle | None = Field(
        default_factory=_left_out, validate_default=True, description=DECLARED["mass_t"].meaning
    )
    latency_s: PerVehicle | None = Field(
        default_factory=_left_out, validate_default=True, description=DECLARED["latency_s"].meaning
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
        default=None, exclude_if=_none, description="what vehicles observe: groups and single features, in this order"
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
