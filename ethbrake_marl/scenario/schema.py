"""A validated, frozen description of a family of worlds: what a scenario file says."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, ValidationError, field_validator, model_validator
from pydantic_core.core_schema import ValidationInfo

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.scenario.consistency import check_entries, check_roles, check_whole, complete_roles
from ethbrake_marl.scenario.distributions import Choice, Normal, Quantity, Uniform
from ethbrake_marl.scenario.quantities import QUANTITIES
from ethbrake_marl.scenario.sampling import Channel, Sample, draw_list
from ethbrake_marl.scenario.scenario_wording import ScenarioWording
from ethbrake_marl.scenario.scripts import LEARNER
from ethbrake_marl.scenario.validation_messages import explain
from ethbrake_marl.scenario.yaml_loading import Document

AnyQuantity = float | Uniform | Normal | Choice

NAME_PATTERN = r"^[a-z0-9][a-z0-9_-]{0,63}$"


def _one_or_each(value: object) -> str:
    return "#each" if isinstance(value, list | tuple) else "#one"


PerVehicle = Annotated[
    Annotated[Quantity, Tag("#one")] | Annotated[tuple[Quantity, ...], Field(strict=False, min_length=1), Tag("#each")],
    Discriminator(_one_or_each),
]


class Scenario(BaseModel):
    """A line of vehicles, how each quantity is drawn, and who learns.

    A quantity is a number, ``{uniform: [low, high]}``, ``{normal: {mean, sd, low, high}}`` or ``{choice: [...]}``.
    One entry stands for every vehicle (each draws its own value); a list has one entry per vehicle, gaps one per
    pair. Every way to build one (``Scenario(...)``, ``load_scenario``, ``replace``) raises ``InvalidInput`` with
    one message: where, value, what would be right.
    """

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")

    name: str = Field(pattern=NAME_PATTERN, description="name; equal to the file's name without .yaml")
    title: str = Field(default="", description="one line for lists and figures")
    description: str = Field(default="", description="what the scenario is for")
    source: str = Field(default="", description="where the values come from")
    vehicles: int = Field(default=3, ge=2, le=64, description="number of vehicles N, vehicle_1 in front")
    time_step_s: float = Field(default=0.1, ge=1e-4, allow_inf_nan=False, description="time between two decisions")
    horizon_s: float = Field(
        default=8.0, gt=0.0, le=3600.0, allow_inf_nan=False, description="time after which an episode is cut off"
    )
    gaps_m: PerVehicle = Field(description=QUANTITIES["gaps_m"].meaning)
    speeds_mps: PerVehicle = Field(description=QUANTITIES["speeds_mps"].meaning)
    braking_capacity_mps2: PerVehicle = Field(description=QUANTITIES["braking_capacity_mps2"].meaning)
    driving_capacity_mps2: PerVehicle = Field(description=QUANTITIES["driving_capacity_mps2"].meaning)
    mass_t: PerVehicle = Field(description=QUANTITIES["mass_t"].meaning)
    latency_s: PerVehicle = Field(description=QUANTITIES["latency_s"].meaning)
    speed_limit_mps: PerVehicle = Field(default=40.0, description=QUANTITIES["speed_limit_mps"].meaning)
    restitution: Quantity = Field(default=0.1, description=QUANTITIES["restitution"].meaning)
    roles: dict[str, str] = Field(
        default_factory=lambda data: complete_roles(None, data.get("vehicles", 3)),
        description="learner or a script for each vehicle; vehicles left out of a given mapping brake fully",
    )
    early_impacts: Literal["keep", "reject"] = Field(
        default="keep", description="what happens to worlds with an impact before the first learner may act"
    )

    def __init__(self, /, **data: Any) -> None:
        name = data.get("name")
        document = Document(f"scenario {name!r}" if isinstance(name, str) else "scenario", _plain(data), {})
        _build(self, document)

    @classmethod
    def from_document(cls, document: Document) -> Scenario:
        """Build a scenario from a parsed file; messages name its file and line."""
        scenario = cls.__new__(cls)
        _build(scenario, document)
        return scenario

    @field_validator(*QUANTITIES)
    @classmethod
    def _entries(cls, value: Any, info: ValidationInfo) -> Any:
        check_entries(QUANTITIES[str(info.field_name)], value, info.data.get("vehicles"))
        return value

    @field_validator("roles")
    @classmethod
    def _roles(cls, value: dict[str, str], info: ValidationInfo) -> dict[str, str]:
        vehicles = info.data.get("vehicles")
        if vehicles is None:
            return value
        check_roles(value, vehicles)
        return complete_roles(value, vehicles)

    @model_validator(mode="after")
    def _whole(self) -> Scenario:
        check_whole(self)
        return self

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

    def quantities(self, field: str) -> tuple[AnyQuantity, ...]:
        """The entries of a quantity, one per vehicle (gaps: per pair; restitution: one)."""
        declared = getattr(self, QUANTITIES[field].name)
        if isinstance(declared, tuple):
            return declared
        return (declared,) * QUANTITIES[field].count(self.vehicles)

    def declared(self) -> dict[str, Any]:
        """What was given, as plain data: ``Scenario(**scenario.declared())`` is the same scenario."""
        return self.model_dump(mode="json", exclude_unset=True, exclude_none=True)

    def sample(self, n: int, seed: int, *, first: int = 0, channel: Channel = "list") -> Sample:
        """Worlds ``first`` to ``first + n - 1`` of the endless list that belongs to ``seed``.

        World k is the same bits whatever ``n`` and ``first`` are. The channels ``"list"`` (evaluation) and
        ``"training"`` are independent of each other. Raises ``InvalidInput`` for a negative seed or ``first``,
        ``n < 1``, or when early impacts are rejected and (almost) every draw has one.
        """
        return draw_list(self, n, seed, first=first, channel=channel)

    def replace(self, **changes: Any) -> Scenario:
        """The same scenario with other values in some fields, checked again."""
        return Scenario(**{**self.declared(), **changes})

    def with_learners(self, learners: Sequence[str | int]) -> Scenario:
        """The same scenario with exactly these learners, by name (``vehicle_2``) or index (from 0).

        A vehicle that learned and is not listed brakes fully; other scripts stay. Raises ``InvalidInput`` for
        an unknown vehicle or one listed twice.
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
                f"learners: {vehicle!r}: must be a name (vehicle_1 ... vehicle_{self.vehicles}) or an index"
                f" from 0 to {self.vehicles - 1}"
            )
        return self.vehicle_names[vehicle]


def scenario_json_schema() -> dict[str, Any]:
    """JSON Schema of a scenario file, for editors that complete and check YAML."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **Scenario.model_json_schema()}


def _build(scenario: Scenario, document: Document) -> None:
    """Validate the document's content into ``scenario``."""
    if not isinstance(document.content, dict):
        raise InvalidInput(f"{document.file}: must be a mapping of keys to values, for instance name: my-scenario")
    try:
        BaseModel.__init__(scenario, **document.content)
    except ValidationError as error:
        raise explain(error, document, ScenarioWording(Scenario.model_fields)) from None


def _plain(value: Any) -> Any:
    """Replace numpy numbers and arrays by Python's own, which the strict schema accepts."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, list | tuple) else value
