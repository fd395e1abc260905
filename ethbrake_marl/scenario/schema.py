"""A validated, frozen description of a family of worlds, and the catalogue of those that ship or are registered."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, ValidationError, model_validator
from pydantic_core import ErrorDetails, PydanticCustomError

from ethbrake_marl.errors import AlreadyExists, InvalidInput, UnknownName, unknown_name
from ethbrake_marl.files.sheet import Sheet
from ethbrake_marl.files.yaml import (
    NAME_PATTERN,
    UNSHOWN,
    Document,
    FileSchema,
    Wording,
    YamlPath,
    flow_text,
    read_yaml,
    refuse,
    require,
    schema_lines,
    suggestion,
)
from ethbrake_marl.harm import HarmCount, check_harm_count
from ethbrake_marl.scenario.sampling import (
    DISTRIBUTIONS,
    LEARNER,
    QUANTITY,
    Member,
    ScenarioFields,
    ScriptSpec,
    support,
)

MOST_SAMPLES = 1_000  # that a message may be older than the newest one

# Checks of a scenario that concern a whole field or several fields at once.
#
# Each raises pydantic's error for the first defect, with the path inside the field or file and the value.


def check_whole(scenario: ScenarioFields) -> None:
    """Fields that limit each other: quantities declared twice, time step, horizon, latency, speeds, gaps, scripts."""
    alone = "speed_deviations_mps" in scenario.model_fields_set and scenario.line_speed_mps is None
    right = "needs line_speed_mps, the speed that it is added to"
    require(not alone, ("speed_deviations_mps",), scenario.speed_deviations_mps, right)
    for key in scenario.model_fields_set & QUANTITY.declared.keys():
        tabled = [entry for entry in scenario.table_entries if entry[0] == key]
        whole = len(tabled) == QUANTITY.declared[key].count(scenario.vehicles)
        require(not whole, (key,), getattr(scenario, key), "the table says it for all; leave it out")
    kinds = scenario.vehicle_types or {}
    for key in set(QUANTITY.of_a_type) - set(QUANTITY.usual):
        silent = [name for name, kind in kinds.items() if getattr(kind, key) is None]
        right = f"type {''.join(silent[:1])} does not declare it: give it there, or here for every type that does not"
        told = getattr(scenario, key) is not None
        require(told or len(silent) in (0, len(kinds)), (key,), UNSHOWN, right)
        require(not (told and kinds) or len(silent) > 0, (key,), UNSHOWN, "every type declares it; leave it out")
    for usual, other in QUANTITY.alternatives.items():
        given = [key for key in (usual, other) if getattr(scenario, key) is not None]
        columns = [column.name for (key, _), column in scenario.table_entries.items() if key == usual]
        right = f"the table has {', '.join(columns)}: give {usual} for the rest, not {other}"
        require(not (columns and other in given), (other,), getattr(scenario, other), right)
        given += [usual] * (usual not in given and scenario.declares(usual))
        if not given and usual not in QUANTITY.optional:
            raise PydanticCustomError("missing", "missing", {"at": (usual,)})
        right = f"give either {usual} or {other}, not both"
        require(len(given) < 2, (other,), getattr(scenario, other), right)
    horizon = f"horizon_s ({scenario.horizon_s:g} s)"
    in_time = scenario.time_step_s <= scenario.horizon_s
    require(in_time, ("time_step_s",), scenario.time_step_s, f"must not be above {horizon}")
    for i, latencies in enumerate(scenario.possible_quantities("latency_s")):
        for kind, latency in latencies.items():
            right = f"must be below {horizon}, or the vehicle can never act"
            acts = support(latency)[1] < scenario.horizon_s
            require(acts, _path(scenario, "latency_s", i, kind), latency, right)
    _check_reactions(scenario)
    _check_speeds(scenario)
    _check_derived(scenario)
    _check_scripts(scenario)


def _check_reactions(scenario: ScenarioFields) -> None:
    """However late the news is, every vehicle may act before the horizon."""
    for name in scenario.v2x.vehicles or ():
        right = f"unknown vehicle; this scenario has vehicle_1 ... vehicle_{scenario.vehicles}"
        require(name in scenario.vehicle_names, ("v2x", "vehicles", name), UNSHOWN, right)
    kinds = {name: kind.v2x for name, kind in (scenario.vehicle_types or {}).items() if kind.v2x is not None}
    right = f"v2x {scenario.v2x.preset} has no messages that a type could lack; give a v2x that has, such as nominal"
    for name, equipage in kinds.items():
        sent = scenario.v2x.channel.timing != "latency" and scenario.v2x.channel.hears != "none"
        require(sent, ("vehicle_types", name, "v2x"), equipage, right)
    right = "only without messages one by one (v2x: paper): what was heard before the alert is not modelled"
    require(scenario.alert_s is None or not scenario.v2x.by_link, ("alert_s",), scenario.alert_s, right)
    own = np.array([latest for _, latest in scenario.bounds("latency_s")])
    right = (
        f"with latency_s a vehicle may act as late as {own.max():g} s; it must be below horizon_s, which may be raised"
    )
    require(scenario.alert_s is None or own.max() < scenario.horizon_s, ("alert_s",), scenario.alert_s, right)
    for i, latest in enumerate(scenario.v2x.latest_reaction_s(own, scenario.equipped())):
        right = (
            f"vehicle_{i + 1} may have no news until {latest:g} s; it must be below horizon_s"
            f" ({scenario.horizon_s:g} s), which may be raised"
        )
        require(bool(latest < scenario.horizon_s), ("v2x",), scenario.v2x, right)
    samples = scenario.v2x.channel.samples(scenario.time_step_s)
    right = f"a message is on its way for {samples - 3} time steps; at most {MOST_SAMPLES - 3} are possible"
    require(samples <= MOST_SAMPLES, ("v2x",), scenario.v2x, right)


def _check_speeds(scenario: ScenarioFields) -> None:
    limits = scenario.possible_quantities("speed_limit_mps")
    for i, (low, high) in enumerate(scenario.bounds("speeds_mps")):
        lowest = min(limits[i].values(), key=lambda quantity: support(quantity)[0])
        if low >= 0.0 and high <= support(lowest)[0]:
            continue
        limit = f"speed_limit_mps of vehicle_{i + 1}, {flow_text(lowest)} m/s"
        if scenario.line_speed_mps is None:
            speed = scenario.quantities("speeds_mps")[i]
            refuse(_path(scenario, "speeds_mps", i), speed, f"must not be above {limit}")
        drives = f"vehicle_{i + 1} drives {low:g}" + ("" if low == high else f" to {high:g}")
        deviates = "with speed_deviations_mps " if "speed_deviations_mps" in scenario.model_fields_set else ""
        refuse(("line_speed_mps",), scenario.line_speed_mps, f"{deviates}{drives} m/s; must be 0 to {limit}")


def _check_derived(scenario: ScenarioFields) -> None:
    """Gaps that follow from time gaps, and an obstacle's distance that follows from its margin, are in range."""
    largest = QUANTITY.usual["gaps_m"].high
    for pair, (_, high) in enumerate(scenario.bounds("gaps_m") if scenario.time_gaps_s is not None else ()):
        right = f"is up to {high:g} m at the speed of vehicle_{pair + 2}; a gap must not be above {largest:g} m"
        require(high <= largest, _path(scenario, "time_gaps_s", pair), scenario.quantities("time_gaps_s")[pair], right)
    largest = QUANTITY.optional["obstacle_gap_m"].high
    if scenario.obstacle_margin_m is not None:
        farthest = scenario.farthest_obstacle_m
        right = (
            f"puts the obstacle up to {farthest:g} m ahead of vehicle_1; that distance must not be above {largest:g} m"
        )
        require(farthest <= largest, ("obstacle_margin_m",), scenario.obstacle_margin_m, right)


def _check_scripts(scenario: ScenarioFields) -> None:
    """A constant command is within the vehicle's capacity; where impacts are early, no script depends on the state."""
    for i, script in scenario.scripts.items():
        deceleration = ScriptSpec.parse(script).hardest_mps2 or 0.0
        field = "braking_capacity_mps2" if deceleration > 0.0 else "driving_capacity_mps2"
        capacity = scenario.bounds(field)[i][0]
        right = f"is above this vehicle's {field}, {capacity:g} m/s2"
        require(abs(deceleration) <= capacity, ("roles", f"vehicle_{i + 1}"), script, right)
    right = "has nothing to brake for without an obstacle ahead; give obstacle_gap_m too, for instance 42"
    require(0 not in scenario.learners or scenario.has_obstacle, ("roles", "vehicle_1"), LEARNER, right)
    for i, script in scenario.scripts.items() if scenario.early_impacts == "reject" and scenario.learners else ():
        spec = ScriptSpec.parse(script)
        close = get_close_matches(spec.name, ("full_brake", "coast", "constant"), n=1)
        hint = f"; did you mean {close[0]}?" if close else ""
        right = f"with early_impacts: reject a script must be full_brake, coast, constant:a or a profile{hint}"
        require(spec.is_state_free(), ("roles", f"vehicle_{i + 1}"), script, right)


def _path(scenario: ScenarioFields, field: str, index: int, kind: int = 0) -> YamlPath:
    line = scenario.types_of_line
    if line is not None and field in QUANTITY.of_a_type and getattr(line.kinds[kind], field) is not None:
        return ("vehicle_types", line.names[kind], field)
    return (field, index) if isinstance(getattr(scenario, field), tuple) else (field,)


# Mixtures of scenarios: each world is drawn from one member, by weight, and is then that member's own world.

WORDS = ("title", "description", "source")
_OWN = {"name", *WORDS, "mixture"}  # of the mixture itself; every other key beside it holds for all members
_ONE_FOR_ALL = ("vehicles", "time_step_s", "horizon_s", "roles", "objective", "observation")
_SHARED = (*_ONE_FOR_ALL, "v2x", "early_impacts")  # told of the mixture where all members agree

AnyScenario = TypeVar("AnyScenario", bound=ScenarioFields)


def changed_content(content: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """What a scenario says, with other values under some keys; a new way to declare gaps takes the old one's place."""
    old = {key for pair in QUANTITY.alternatives.items() for key in pair if changes.keys() & set(pair)}
    if "speeds_mps" in changes:
        old.add("speed_deviations_mps")
    return {**{key: value for key, value in content.items() if key not in old}, **changes}


def build_members(
    document: Document, build: Callable[[Document], AnyScenario]
) -> tuple[Document, tuple[AnyScenario, ...]]:
    """The members that a document's ``mixture`` lists, and the document with what follows from them.

    What stands beside ``mixture`` replaces what every member says. A list that is none stays for the schema to refuse.
    Raises ``InvalidInput`` naming the member that is wrong, or the key in which two of them differ.
    """
    listed, content = document.content["mixture"], document.content
    if not (isinstance(listed, list | tuple) and listed and all(_is_whole(entry) for entry in listed)):
        return document, ()
    fields = set(ScenarioFields.model_fields) - _OWN - {"vehicles"}
    beside = {key: value for key, value in content.items() if key in fields}
    members = tuple(build(_member_document(document, i, entry, beside)) for i, entry in enumerate(listed))
    _check_members(document, members)
    mixture = [{**entry, "scenario": member_content(member)} for entry, member in zip(listed, members, strict=True)]
    own = {key: value for key, value in content.items() if key not in beside}
    told = [member.model_dump(mode="json", include=set(_SHARED), exclude_none=True) for member in members]
    shared = {key: value for key, value in told[0].items() if all(each.get(key) == value for each in told)}
    return Document(document.file, {**own, **shared, "mixture": mixture}, document.lines), members


def _is_whole(entry: Any) -> bool:
    known = Member.model_fields.keys()  # else the schema names the key that is not
    return isinstance(entry, dict) and isinstance(entry.get("scenario"), dict) and entry.keys() <= known


def member_content(member: ScenarioFields) -> dict[str, Any]:
    """What shapes a member's worlds, as plain data: what it says but its texts, and all that a batch has in common."""
    declared = member.model_dump(mode="json", exclude_unset=True, exclude_none=True, exclude=set(WORDS))
    return {**declared, **member.model_dump(mode="json", include=set(_SHARED), exclude_none=True)}


def _member_document(document: Document, i: int, entry: Mapping[str, Any], beside: Mapping[str, Any]) -> Document:
    """What one member says but its texts, with what stands beside the mixture, each on its line."""
    own = {key: value for key, value in entry["scenario"].items() if key not in WORDS}
    inside = {path[3:]: line for path, line in document.lines.items() if path[:3] == ("mixture", i, "scenario")}
    own = {**{key: document.content[key] for key in ("vehicles",) if key in document.content}, **own}
    above = {path: line for path, line in document.lines.items() if path and path[0] in beside}
    where = f"{document.file}: mixture[{i}] ({own.get('name', 'without a name')})"
    return Document(where, changed_content(own, beside), {**inside, **above})


def _check_members(document: Document, members: Sequence[ScenarioFields]) -> None:
    """Refuse mixtures in mixtures, a name given twice, and members that cannot be one batch."""
    where = f"{document.where(('mixture',))}: mixture"
    first = members[0]
    if (given := document.content.get("vehicles", first.vehicles)) != first.vehicles:
        raise InvalidInput(
            f"{where}: vehicles = {given}: its scenarios have {first.vehicles}, which nothing beside them can change"
        )
    for k, member in enumerate(members):
        if member.members:
            raise InvalidInput(f"{where}[{k}]: {member.name} is a mixture itself; list its scenarios here")
        if member.name in [other.name for other in members[:k]]:
            raise InvalidInput(f"{where}[{k}]: {member.name} is given twice; give it once, with the sum of the weights")
        for key in _ONE_FOR_ALL:
            one, other = (_told(each, key) for each in (first, member))
            if one != other:
                way = "" if key == "vehicles" else f"; give {key} beside mixture, and it holds for all"
                raise InvalidInput(
                    f"{where}: {key} must be the same in all: {first.name} has {one}, {member.name} has {other}{way}"
                )
        samples = [each.v2x.channel.samples(each.time_step_s) for each in (first, member)]
        if samples[0] != samples[1]:
            raise InvalidInput(
                f"{where}: v2x.persistence must be the same in all, and so must the delay of periodic messages:"
                f" {first.name} and {member.name} differ; give v2x beside mixture, and it holds for all"
            )


def _told(scenario: ScenarioFields, key: str) -> str:
    value = getattr(scenario, key)
    return "nothing" if value is None else flow_text(dict(value) if key == "roles" else value, 120)


# The wording of messages about a scenario file: its keys, their places and their meanings.

_DISTRIBUTION = (
    "{uniform: [low, high]}, {loguniform: [low, high]}, {normal: {mean, sd, low, high}},"
    " {lognormal: {median, sigma, low, high}} or {choice: [a, b, ...]}"
)


class ScenarioWording(Wording):
    """The ``Wording`` of a scenario, or of a part of one."""

    def instead(self, key: str) -> str:
        """What the model has in place of another word for friction, and of a slope."""
        if "friction" in key or key == "mu":
            return "friction is that of the road, one for the whole line, for instance friction: 0.5"
        if key in ("grade", "slope"):
            return "the model has no slopes; downhill, braking capacities are 9.81 x grade less, driving ones more"
        return ""

    def needed(self, path: YamlPath) -> str:
        """What is needed at ``path``, with an example."""
        key = path[-1]
        if path[0] == "mixture":
            return "it is needed, for instance {scenario: paper-random, weight: 2}"
        if isinstance(key, int):
            return "two numbers [low, high] are needed"
        rule = QUANTITY.declared.get(key)
        if rule is None and len(path) > 1:
            shape = (
                "median: 20, sigma: 1, low: 5, high: 90"
                if "lognormal" in path
                else "mean: 20, sd: 1, low: 18, high: 22"
            )
            return f"a number is needed, as in {{{'log' * ('lognormal' in path)}normal: {{{shape}}}}}"
        if rule is None:
            return f"it is needed, for instance {key}: my-scenario"
        other = (
            f", or {QUANTITY.alternatives[key]}: {QUANTITY.declared[QUANTITY.alternatives[key]].example}"
            if key in QUANTITY.alternatives
            else ""
        )
        return f"the {rule.meaning} is needed, for instance {key}: {rule.example}{other}"

    def owner(self, path: YamlPath) -> str:
        """Whose value stands at ``path``: a vehicle or a pair; empty for anything else."""
        rule = QUANTITY.declared.get(str(path[0])) if len(path) > 1 else None
        return rule.owner(path[1]) if rule is not None and isinstance(path[1], int) else ""

    def right(self, detail: ErrorDetails) -> str:
        """A number or a distribution, with what a misspelt one was meant to be; empty for what is no quantity."""
        if detail["type"] == "quantity":
            return f"must be a number, {_DISTRIBUTION}{_misspelt(detail['input'])}"
        if detail["type"] == "float_type" and detail["loc"][-1] == "#number":
            return f"must be a number or a distribution, {_DISTRIBUTION}"
        if detail["loc"][:1] == ("mixture",) and detail["loc"][-1] == "scenario":
            return "must be what a scenario says; names are read where they stand in a file (load_scenario)"
        return ""


def _misspelt(given: Any) -> str:
    if isinstance(given, dict) and "with_load" in given:
        return "; with_load stands in a type of vehicle_types"
    hints = [suggestion(key, DISTRIBUTIONS) for key in given if isinstance(key, str)] if isinstance(given, dict) else []
    return "".join(f"; {hint}" for hint in hints if hint)


class Scenario(ScenarioFields):
    """A line of vehicles, how each quantity is drawn, and who learns.

    A quantity is a number, ``{uniform: [low, high]}``, ``{loguniform: [low, high]}``, ``{normal: {mean, sd, low,
    high}}``, ``{lognormal: {median, sigma, low, high}}`` or ``{choice: [...]}``. One entry stands for every vehicle
    (each draws its own value); a list has one entry per vehicle, gaps one per pair. Every way to build one
    (``Scenario(...)``, ``load_scenario``, ``replace``) raises ``InvalidInput`` with one message: where, value, what
    would be right.

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

    @model_validator(mode="after")
    def _whole(self) -> Scenario:
        if self.mixture is not None:  # its members have been checked
            return self
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
        return Sheet(f"Scenario {self.name}: {self.title or 'no title'}", ("Key", "Value"), rows).html()

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
        {"not": {"required": [*pair]}}
        if pair[0] in QUANTITY.optional
        else {"oneOf": [{"required": [key]} for key in pair]}
        for pair in QUANTITY.alternatives.items()
    ]
    by_types = {"anyOf": [{"required": ["vehicle_types"]}, {"required": [*QUANTITY.needed]}]}
    elsewhere = {"anyOf": [{"required": ["mixture"]}, {"required": ["table"]}]}
    whole = {"if": {"not": elsewhere}, "then": {"allOf": [*one_of_two, by_types]}}
    needed = {"speed_deviations_mps": ["line_speed_mps"]}
    schema = Scenario.model_json_schema(schema_generator=FileSchema)
    ranges = {key: _range(key, rule.low, rule.high, rule.positive) for key, rule in QUANTITY.declared.items()}
    ranges["load"] = _range("load", 0.0, 1.0)
    for properties in (schema["properties"], schema["$defs"]["VehicleType"]["properties"]):
        for key in properties.keys() & ranges.keys():
            properties[key]["allOf"] = [_reference(key)]
    defined = schema["$defs"] | {f"range_{key}": limits for key, limits in ranges.items()}
    return FileSchema.publish({**schema, **whole, "dependentRequired": needed, "$defs": defined})


def _reference(key: str) -> dict[str, Any]:
    return {"$ref": f"#/$defs/range_{key}"}


def _range(key: str, low: float, high: float, positive: bool = False) -> dict[str, Any]:
    """What a quantity's range is for a number, and for each that can be drawn of a distribution or of a list."""
    limits = {"exclusiveMinimum" if positive else "minimum": low, "maximum": high}
    above = {"exclusiveMinimum": 0}
    inside = dict.fromkeys(("low", "high", "with_load", *DISTRIBUTIONS), _reference(key))
    inside |= {"loguniform": {"items": {**limits, **above}}, "sd": above, "sigma": above, "weights": {"items": above}}
    inside["lognormal"] = {"allOf": [_reference(key)], "properties": {"median": above, "low": above}}
    return {**limits, "items": _reference(key), "properties": inside}


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
        raise document.explain(error, ScenarioWording(Scenario)) from None
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


# The task of whoever drives: a scenario, the vehicles that are driven in it, and the harm that counts.


@dataclass(frozen=True, slots=True)
class Task:
    """Drive these vehicles of a scenario; all others follow its scripts.

    Raises ``InvalidInput`` for an index that the scenario has no vehicle for, one given twice, or an unknown count.
    """

    scenario: Scenario
    vehicles: tuple[int, ...]  # indices (0 = front), in the order in which they are driven
    harm_count: HarmCount = "first"  # harm that is minimised; what is told under both counts ignores it

    def __post_init__(self) -> None:
        check_harm_count(self.harm_count)
        known = set(range(self.scenario.vehicles))
        if len(set(self.vehicles)) != len(self.vehicles) or not set(self.vehicles) <= known:
            raise InvalidInput(
                f"task: vehicles {self.vehicles}: must be indices from 0 to {self.scenario.vehicles - 1}, each once"
            )

    @property
    def vehicle(self) -> int:
        """The vehicle that is driven; raises ``InvalidInput`` if it is not exactly one."""
        if len(self.vehicles) != 1:
            raise InvalidInput(f"scenario {self.scenario.name!r}: needs one driven vehicle; driven are: {self.names}")
        return self.vehicles[0]

    @property
    def names(self) -> str:
        """The driven vehicles by name, with commas between them; ``none`` where nobody is driven."""
        return ", ".join(self.scenario.vehicle_names[i] for i in self.vehicles) or "none"


# The catalogue of scenarios: those that ship, those of registered folders, and files by path.

_PACKAGE = Path(__file__).resolve().parents[1]


def shipped_folder(folder: Literal["scenarios", "train"] = "scenarios") -> Path:
    """The scenarios, or recipes, that ship: the checkout's ``folder``, or the copy inside an installed package.

    Raises ``InvalidInput`` when neither is there: the installation is damaged.
    """
    checkout, installed = _PACKAGE.parent / folder, _PACKAGE / "_data" / folder
    if (_PACKAGE.parent / "pyproject.toml").is_file() and checkout.is_dir():
        return checkout
    if not installed.is_dir():
        meaning = "recipes" if folder == "train" else folder
        raise InvalidInput(f"the shipped {meaning} are missing: neither {checkout} nor {installed} exists; reinstall")
    return installed


_SUFFIXES = (".yaml", ".yml")
FOLDERS: dict[str, Path] = {}  # registered, by their path


@dataclass(frozen=True, slots=True)
class CatalogueEntry:
    """One shipped or registered scenario."""

    name: str
    title: str
    path: Path
    origin: str = "shipped"  # or the registered folder

    @property
    def shipped(self) -> bool:
        """Whether this package brings it."""
        return self.origin == "shipped"


def register_scenarios(folder: str | os.PathLike[str]) -> None:
    """Make the scenarios of a folder known by name, ``--scenario my-name``: every ``my-name.yaml`` directly in it.

    Whether a file is in order is said when it is used. Registering the same folder again changes nothing. Raises
    ``InvalidInput`` for a folder that is missing or has no such file, ``AlreadyExists`` for one that has a name which a
    shipped scenario, or one of another registered folder, has.
    """
    path = Path(folder).resolve()
    if not path.is_dir():
        raise InvalidInput(f"scenarios {os.fspath(folder)!r}: there is no such folder")
    if not _files_of(path):
        raise InvalidInput(f"scenarios {os.fspath(folder)!r}: no file in it ends in .yaml")
    known = str(path) in FOLDERS
    FOLDERS[str(path)] = path
    try:
        _known_paths()
    except AlreadyExists:
        if not known:
            del FOLDERS[str(path)]
        raise


def load_scenario(scenario: str | Path | Mapping[str, Any] | Scenario) -> Scenario:
    """Load a shipped or registered scenario by name, or a file by path (see ``scenario_path``), or what one would say.

    A ``Scenario`` is given back as it is.

    Raises ``UnknownName`` with a suggestion for an unknown name, and ``InvalidInput`` with file, line, path inside
    it and value for a file that does not describe a scenario, or whose name differs from the file's.
    """
    if isinstance(scenario, Scenario):
        return scenario
    if isinstance(scenario, Mapping):
        document = _with_members(Document("scenario", dict(scenario), {}), Path())
        return Scenario(**document.content)
    return _load(scenario_path(scenario))


def scenario_path(name_or_path: str | Path, folder: Path = Path()) -> Path:
    """The file of a scenario; it need not exist when a path is given.

    A path is what ends in ``.yaml`` or ``.yml``. A shipped scenario has its name, ``stress-wide``; where that begins
    with its folder's, ``stress/wide`` means the same unless there is such a file. A registered one has its name. Any
    other name, ``mine`` or ``my/folder/mine``, is that of ``mine.yaml`` in ``folder``. Shipped and registered names go
    first, so that a stray file cannot change what a paper's command means.
    Raises ``UnknownName`` with a suggestion for an unknown name.
    """
    text = str(name_or_path)
    path = folder / text
    if path.suffix in _SUFFIXES or "\\" in text or ("/" in text and os.path.isfile(path)):
        return path
    paths = _known_paths()
    if "/" in text:
        paths = {f"{p.parent.name}/{p.stem.removeprefix(p.parent.name + '-')}": p for p in _shipped_paths().values()}
    if text in paths:
        return paths[text]
    if os.path.isfile(beside := f"{path}.yaml"):
        return Path(beside)
    patterns = (f"{path.name}.yml", f"*/{path.name}.y*ml") if re.fullmatch(NAME_PATTERN, path.name) else ()
    if near := sorted(each for pattern in patterns for each in path.parent.glob(pattern)):
        raise UnknownName(f"unknown scenario {text!r}; did you mean {os.path.relpath(near[0], folder)}?")
    if "/" in text:
        return path
    raise unknown_name("scenario", text, paths)


BENCHMARK = (  # each ships with a table of best known harm, so that shares of the possible reduction are known
    *("paper-random", "paper-random-brake-only", "paper-random-obstacle", "paper-delay-high", "paper-distance"),
    *("realistic-motorway", "realistic-mixed", "stress-wide", "cooperation-2-blocked", "cooperation-2-five"),
)


def group_of_scenarios(name: str) -> list[str]:
    """``benchmark``, or the scenarios of a folder of those that ship, such as ``standards``; else none."""
    if name == "benchmark":
        return list(BENCHMARK)
    return sorted(stem for stem, path in _shipped_paths().items() if path.parent.name == name)


def list_scenarios() -> list[CatalogueEntry]:
    """Every shipped and registered scenario, sorted by name."""
    shipped = _shipped_paths()
    scenarios = [(_load(path), path) for path in _known_paths().values()]
    entries = [
        CatalogueEntry(s.name, s.title, path, "shipped" if s.name in shipped else str(path.parent))
        for s, path in scenarios
    ]
    return sorted(entries, key=lambda entry: entry.name)


def _known_paths() -> dict[str, Path]:
    """Name -> file of every shipped and registered scenario; raises ``AlreadyExists`` for a name that two have."""
    shipped = _shipped_paths()
    known = dict(shipped)
    for folder in FOLDERS.values():
        for path in _files_of(folder):
            if path.stem in known:
                other = "a shipped scenario" if path.stem in shipped else f"{known[path.stem]}"
                raise AlreadyExists(
                    f"scenario {path}: {other} has the name {path.stem!r} already; give the file another one"
                )
            known[path.stem] = path
    return known


def _files_of(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("*.yaml") if path.is_file())


def _shipped_paths() -> dict[str, Path]:
    return {path.stem: path for path in sorted(shipped_folder().rglob("*.yaml"))}


def _load(path: Path) -> Scenario:
    document = read_yaml(path)
    scenario = Scenario.from_document(_with_members(document, path.parent))
    if scenario.name != path.stem:
        raise InvalidInput(
            f"{document.where(('name',))}: name = {scenario.name}: must be the file's name, {path.stem}"
            f" (or rename the file to {scenario.name}{path.suffix})"
        )
    return scenario


def _with_members(document: Document, folder: Path) -> Document:
    """The document with what it names in place of the names: members of a mixture, and files of tables.

    Paths count from ``folder``.
    """
    content = _with_rows(document, (), document.content, folder)
    listed = content.get("mixture") if isinstance(content, dict) else None
    if isinstance(listed, list | tuple):
        found = []
        for i, entry in enumerate(listed):
            member, at = entry.get("scenario") if isinstance(entry, dict) else None, ("mixture", i, "scenario")
            if isinstance(member, str):
                entry = {**entry, "scenario": _member(member, document.where(at), i, folder)}
            elif isinstance(member, dict):
                entry = {**entry, "scenario": _with_rows(document, at, member, folder)}
            found.append(entry)
        content = {**content, "mixture": found}
    return Document(document.file, content, document.lines)


def _with_rows(document: Document, at: YamlPath, content: Any, folder: Path) -> Any:
    """What a scenario says, with the rows of its table's file."""
    table = content.get("table") if isinstance(content, dict) else None
    if not (isinstance(table, dict) and isinstance(table.get("file"), str)) or "rows" in table:
        return content
    path, where = Path(table["file"]), document.where((*at, "table", "file"))
    if path.is_absolute() or ".." in path.parts:
        raise InvalidInput(f"{where}: table.file = {table['file']}: must be a path from the scenario's folder on")
    with document.refusing_at((*at, "table", "file")):
        rows = ScenarioFields.read_rows(folder / path, table.get("columns"), table.get("weights"))
        kept = {key: value for key, value in table.items() if key != "file"}  # the rows are the scenario, not the file
        return {**content, "table": {**kept, **rows}}


def _member(name: str, where: str, i: int, folder: Path) -> dict[str, Any]:
    try:
        path = scenario_path(name, folder)
        document = read_yaml(path)
        if isinstance(document.content, dict) and "mixture" in document.content:
            raise InvalidInput(f"{name} is a mixture itself; list its scenarios here")
        return _load(path).declared()
    except InvalidInput as error:
        raise InvalidInput(f"{where}: mixture[{i}].scenario = {name}: {error}") from None


_HEAD = """\
# Scenario {name}, started from {based_on}.
# A quantity is a number, or is drawn for every world:
#   {{uniform: [low, high]}}, {{loguniform: [low, high]}}
#   {{normal: {{mean: 20, sd: 1, low: 18, high: 22}}}}    truncated to [low, high]
#   {{lognormal: {{median: 1.1, sigma: 0.4, low: 0.3, high: 3}}}}    its logarithm is normal, truncated
#   {{choice: [6, 7, 8]}}    optionally with weights: [1, 2, 1]
# One entry stands for every vehicle (each draws its own value); a list has one entry per vehicle, front to rear.
"""


def check_file_name(kind: str, name: str) -> None:
    """Raise ``InvalidInput`` for what cannot be the name of a scenario or recipe, which is that of its file."""
    if re.fullmatch(NAME_PATTERN, name) is None:
        raise InvalidInput(
            f"{kind} name {name!r}: must be 1 to 64 lower case letters, digits, - and _, beginning with a letter or"
            " digit"
        )


def new_scenario_text(name: str, based_on: str = "paper-random") -> str:
    """Text of a commented YAML file for a new scenario ``name`` with the values of ``based_on``, all keys written out.

    A key that stands for another way to declare gaps or speeds is there as a comment with an example.
    Save it as ``<name>.yaml``. Raises ``InvalidInput`` for a name that cannot be one, or an unknown ``based_on``.
    """
    check_file_name("scenario", name)
    base = load_scenario(based_on)
    given = base.declared() if base.members else base.model_dump(mode="json", exclude_none=True)
    values = {
        **{key: value for key, value in given.items() if not base.members or key == "mixture"},
        "name": name,
        "title": "One line for lists and figures",
        "description": "What this scenario is for.",
        "source": f"Values of {base.name}, to be changed.",
    }
    if base.line_speed_mps is None:
        values.pop("speed_deviations_mps", None)
    if base.members:
        values["mixture"] = [_short_member(entry) for entry in values["mixture"]]
    keys = [f"\n# {_comment(key)}\n{_line(key, values)}\n" for key in Scenario.model_fields]
    return _HEAD.format(name=name, based_on=base.name) + schema_lines("scenario", "scenario schema") + "".join(keys)


_EXAMPLES = {
    "observation": "[own, front_1, rear_1]",
    "vehicle_types": "{car: {weight: 9, mass_t: 1.5}, truck: {mass_t: {with_load: [14, 40]}}}",
    "types": "[car, any, truck]",
    "mixture": "[{scenario: paper-random, weight: 2}, {scenario: paper-random-early}]",
    "table": "{file: rows.csv, columns: [gap_1_m, gap_2_m]}",
    "roles": "{vehicle_2: learner}",
    "v2x": "nominal",
}  # of keys that are no quantity and may be left out


def _line(key: str, values: Mapping[str, object]) -> str:
    """``key: value``; a key that goes only with the other way to declare the same stands in a comment."""
    if key in values:
        return f"{key}:{_value(values[key])}"
    if key in QUANTITY.declared:
        return f"# {key}: {QUANTITY.declared[key].example}"
    default = Scenario.model_fields[key].default
    return f"# {key}: {_EXAMPLES[key] if key in _EXAMPLES else flow_text(default)}"


def _short_member(entry: dict[str, Any]) -> dict[str, Any]:
    """A member of a mixture by its name, where that is a shipped scenario that says the same."""
    content, name = entry["scenario"], entry["scenario"]["name"]
    as_shipped = name in _shipped_paths() and member_content(load_scenario(name)) == content
    return {**entry, "scenario": name} if as_shipped else entry


def _comment(key: str) -> str:
    rule = QUANTITY.declared.get(key)
    if rule is None:
        return str(Scenario.model_fields[key].description)
    other = {**QUANTITY.alternatives, **{new: usual for usual, new in QUANTITY.alternatives.items()}}.get(key)
    besides = f"; either this or {other}" if other else ""
    besides = "; only beside line_speed_mps" if key == "speed_deviations_mps" else besides
    return f"{rule.meaning}; {rule.interval}{', below horizon_s' if key == 'latency_s' else ''}{besides}"


def _value(value: object) -> str:
    """Roles one per line, everything else on the line of its key."""
    if isinstance(value, dict) and all(isinstance(entry, str) for entry in value.values()):
        return "".join(f"\n  {key}: {flow_text(entry)}" for key, entry in value.items())
    return f" {flow_text(value)}"
