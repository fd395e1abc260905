"""A validated, frozen description of a family of worlds: what a scenario file says."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from pydantic import BaseModel, ValidationError, field_validator, model_validator
from pydantic_core.core_schema import ValidationInfo

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.files.html import html_table
from ethbrake_marl.files.json_schema import FileSchema, publish
from ethbrake_marl.files.messages import explain
from ethbrake_marl.files.yaml import Document, flow_text
from ethbrake_marl.scenario.checks import (
    check_alternatives,
    check_entries,
    check_given,
    check_objective,
    check_observation,
    check_roles,
    check_whole,
    refuse,
)
from ethbrake_marl.scenario.fields import OF_EVERY_VEHICLE, ScenarioFields
from ethbrake_marl.scenario.mixture import WORDS, build_members, changed_content, draw_mixture
from ethbrake_marl.scenario.quantities import ALTERNATIVES, DECLARED, OPTIONAL
from ethbrake_marl.scenario.roles import LEARNER, complete_roles
from ethbrake_marl.scenario.sample import Sample
from ethbrake_marl.scenario.sampling import Channel, draw_list, quantity_bounds
from ethbrake_marl.scenario.vehicle_types import check_type_names, check_types
from ethbrake_marl.scenario.wording import ScenarioWording


class Scenario(ScenarioFields):
    """A line of vehicles, how each quantity is drawn, and who learns.

    A quantity is a number, ``{uniform: [low, high]}``, ``{loguniform: [low, high]}``, ``{normal: {mean, sd, low,
    high}}`` or ``{choice: [...]}``. One entry stands for every vehicle (each draws its own value); a list has one entry
    per vehicle, gaps one per pair. Every way to build one (``Scenario(...)``, ``load_scenario``, ``replace``) raises
    ``InvalidInput`` with one message: where, value, what would be right.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("paper-random").replace(mass_t=[4.5, 5.5, 40.0])
    >>> scenario.bounds("mass_t")
    ((4.5, 4.5), (5.5, 5.5), (40.0, 40.0))
    >>> scenario.with_learners(["vehicle_3"]).learners
    (2,)

    """

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

    @field_validator(*ALTERNATIVES, *ALTERNATIVES.values(), mode="before")
    @classmethod
    def _given(cls, value: Any) -> Any:
        """``null`` is no value: a key that is not used is left out."""
        if value is None:
            refuse((), value, "must be a number or a distribution; a key that is not used is left out")
        return value

    @field_validator(*OF_EVERY_VEHICLE, mode="before")
    @classmethod
    def _needed(cls, value: Any, info: ValidationInfo) -> Any:
        return check_given(str(info.field_name), value, info.data)

    @field_validator("vehicle_types", "types", "mixture", mode="before")
    @classmethod
    def _not_empty(cls, value: Any) -> Any:
        if value is None or (isinstance(value, dict | list | tuple) and not value):
            refuse((), value, "must not be empty; a key that is not used is left out")
        return value

    @field_validator("vehicle_types")
    @classmethod
    def _kinds(cls, value: Any) -> Any:
        check_type_names(value)
        return value

    @field_validator("types")
    @classmethod
    def _types(cls, value: Any, info: ValidationInfo) -> Any:
        if "vehicles" in info.data and "vehicle_types" in info.data:
            check_types(value, info.data["vehicle_types"], info.data["vehicles"])
        return value

    @field_validator(*DECLARED)
    @classmethod
    def _entries(cls, value: Any, info: ValidationInfo) -> Any:
        if value is not None:
            check_entries(DECLARED[str(info.field_name)], value, info.data.get("vehicles"))
        return value

    @field_validator("roles")
    @classmethod
    def _roles(cls, value: dict[str, str], info: ValidationInfo) -> dict[str, str]:
        vehicles = info.data.get("vehicles")
        if vehicles is None:
            return value
        check_roles(value, vehicles)
        return complete_roles(value, vehicles)

    @field_validator("objective", mode="before")
    @classmethod
    def _objective(cls, value: Any, info: ValidationInfo) -> Any:
        if "vehicles" in info.data:
            check_objective(value, info.data["vehicles"])
        return value

    @field_validator("observation", mode="before")
    @classmethod
    def _observation(cls, value: Any) -> Any:
        check_observation(value)
        return value

    @model_validator(mode="after")
    def _whole(self) -> Scenario:
        if self.mixture is not None:  # its members have been checked
            return self
        check_alternatives(self)
        check_whole(self)
        return self

    def __repr__(self) -> str:
        learners = ", ".join(self.vehicle_names[i] for i in self.learners) or "nobody"
        return f"Scenario({self.name!r}: {self.vehicles} vehicles, learning: {learners})"

    __str__ = __repr__

    def _repr_html_(self) -> str:
        """What it declares, for a notebook."""
        told = {key: value for key, value in self.declared().items() if key not in ("name", "title")}
        if self.mixture is not None:
            told["mixture"] = ", ".join(f"{e.weight:g} x {e.scenario['name']}" for e in self.mixture)
        rows = [(key, value if isinstance(value, str) else flow_text(value)) for key, value in told.items()]
        return html_table(("Key", "Value"), rows, caption=f"Scenario {self.name}: {self.title or 'no title'}")

    def bounds(self, field: str) -> tuple[tuple[float, float], ...]:
        """Smallest and largest value of each entry of ``gaps_m``, ``speeds_mps``, ..., however it is declared."""
        each = [quantity_bounds(member, field) for member in self.members or (self,)]
        return tuple(
            (min(low for low, _ in entry), max(high for _, high in entry)) for entry in zip(*each, strict=True)
        )

    def declared(self) -> dict[str, Any]:
        """What was given, as plain data: ``Scenario(**scenario.declared())`` is the same scenario."""
        return self.model_dump(mode="json", exclude_unset=True, exclude_none=True)

    def content(self, without: Collection[str]) -> dict[str, Any]:
        """Every value, defaults too, as plain data; of a mixture also those of its members, by name, without texts."""
        content = self.model_dump(mode="json", exclude=set(without))
        if self.mixture is not None and self.members:
            content["mixture"] = [
                {"weight": entry.weight, "scenario": member.model_dump(mode="json", exclude=set(WORDS))}
                for entry, member in zip(self.mixture, self.members, strict=True)
            ]
        return content

    def sample(self, n: int, seed: int, *, first: int = 0, channel: Channel = "list") -> Sample:
        """Worlds ``first`` to ``first + n - 1`` of the endless list that belongs to ``seed``.

        World k is the same bits whatever ``n`` and ``first`` are. The channels ``"list"`` (evaluation) and
        ``"training"`` are independent of each other. Raises ``InvalidInput`` for a negative seed or ``first``,
        ``n < 1``, or when early impacts are rejected and (almost) every draw has one.
        """
        draw = draw_mixture if self.members else draw_list
        return draw(self, n, seed, first=first, channel=channel)

    def replace(self, **changes: Any) -> Scenario:
        """The same scenario with other values in some fields, checked again.

        A new way to declare gaps or speeds takes the place of the old one. In a mixture the values are new in every
        member.
        """
        return Scenario(**changed_content(self.declared(), changes))

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
    one_of_two: list[dict[str, Any]] = [
        {"not": {"required": [*pair]}} if pair[0] in OPTIONAL else {"oneOf": [{"required": [key]} for key in pair]}
        for pair in ALTERNATIVES.items()
    ]
    by_types = {"anyOf": [{"required": ["vehicle_types"]}, {"required": [*OF_EVERY_VEHICLE]}]}
    whole = {"if": {"not": {"required": ["mixture"]}}, "then": {"allOf": [*one_of_two, by_types]}}
    needed = {"speed_deviations_mps": ["line_speed_mps"]}
    schema = Scenario.model_json_schema(schema_generator=FileSchema)
    return publish({**schema, **whole, "dependentRequired": needed})


def _build(scenario: Scenario, document: Document) -> None:
    """Validate the document's content into ``scenario``."""
    if not isinstance(document.content, dict):
        raise InvalidInput(f"{document.file}: must be a mapping of keys to values, for instance name: my-scenario")
    members: tuple[Scenario, ...] = ()
    if "mixture" in document.content:
        document, members = build_members(document, Scenario.from_document)
    try:
        BaseModel.__init__(scenario, **document.content)
    except ValidationError as error:
        raise explain(error, document, ScenarioWording(Scenario.model_fields)) from None
    scenario._members = members


def _plain(value: Any) -> Any:
    """Replace numpy numbers and arrays by Python's own, which the strict schema accepts; scenarios by what they say."""
    if isinstance(value, Scenario):
        return value.declared()
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, list | tuple) else value
