"""A scenario in words: its keys with ranges and defaults, sentences about it, a new file, and the JSON Schema."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from ethbrake_marl.episode.objectives import OBJECTIVES
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.json_schema import FileSchema, schema_lines
from ethbrake_marl.files.model import NAME_PATTERN
from ethbrake_marl.files.yaml import flow_text
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.channel import CHANNELS, EXTENSIONS
from ethbrake_marl.worlds.describe import recording_of
from ethbrake_marl.worlds.mixture import member_content
from ethbrake_marl.worlds.quantity import DISTRIBUTIONS
from ethbrake_marl.worlds.rules import ALTERNATIVES, NEEDED, OF_A_TYPE, OPTIONAL, RULES, USUAL
from ethbrake_marl.worlds.scenario import Scenario
from ethbrake_marl.worlds.table import WEIGHT


class Key(NamedTuple):
    """A key of a scenario file."""

    name: str
    default: str  # in YAML; empty: none
    range: str  # of a quantity: ``finite and in (0, 1000] t (tonnes)``
    about: str


def listed_keys() -> list[Key]:
    """Return every key of a scenario file, in the order of the file."""
    listed = []
    for name, field in Scenario.model_fields.items():
        fixed = field.default_factory is None and field.default is not None and not field.is_required()
        rule = RULES.get(name)
        listed.append(
            Key(name, flow_text(field.default) if fixed else "", rule.interval if rule else "", str(field.description))
        )
    return listed


# ---- sentences


def sentences(scenario: Scenario, scripts: Mapping[str, str] = {}) -> Iterator[str]:
    """Yield sentences about a scenario. ``scripts`` says of a script's name what it does."""
    yield f"{scenario.name}: {scenario.title or 'no title'}. {scenario.description}".rstrip()
    learners = ", ".join(scenario.vehicle_names[i - 1] for i in scenario.learners) or "nobody"
    yield f"{scenario.vehicles} vehicles in line, vehicle_1 in front, {_obstacle(scenario)}. Learners: {learners}."
    others = [role for role in scenario.roles.values() if role != "learner"]
    for script in dict.fromkeys(others):
        who = ", ".join(name for name, role in scenario.roles.items() if role == script)
        about = f" ({scripts[script]})" if script in scripts else ""
        yield f"Script {script}{about}: {who}."
    if scenario.mixture is not None:
        members = ", ".join(f"{each.scenario['name']} ({each.weight:g})" for each in scenario.mixture)
        yield (
            f"Each world is drawn from one of these scenarios (weights in brackets): {members}. The following ranges"
            " cover all of them."
        )
    yield from _table(scenario)
    yield from _types(scenario)
    for key, rule in RULES.items():
        if text := _declared(scenario, key):
            yield f"{rule.label[0].upper()}{rule.label[1:]}: {text}; {rule.meaning}."
    common = scenario.model_fields_set if scenario.members else Scenario.model_fields  # the same for all members
    yield _news(scenario) if "v2x" in common else "The V2X channel differs between these scenarios."
    early = "is kept" if scenario.early_impacts == "keep" else "is rejected and drawn again"
    yield (
        f"Vehicles decide every {scenario.time_step_s:g} s; an episode is truncated after {scenario.horizon_s:g} s."
        + (f" A world with an impact before a learner can act {early}." if "early_impacts" in common else "")
    )
    objectives = [scenario.objective] if isinstance(scenario.objective, str) else scenario.objective
    aims = (f"{each} ({OBJECTIVES[each.partition(':')[0]].about})" for each in dict.fromkeys(objectives))
    yield f"Objective: {', '.join(aims)}; a shield always bounds the harm of the whole line."


def _obstacle(scenario: Scenario) -> str:
    there = {each.has_obstacle for each in scenario.members or (scenario,)}
    return f"{'an' if any(there) else 'no'} obstacle ahead{'' if len(there) == 1 else ' in some worlds'}"


def _table(scenario: Scenario) -> Iterator[str]:
    if scenario.table is not None:
        rows, columns = len(scenario.table.rows or ()), ", ".join(scenario.table.columns)
        yield f"Each world takes one of the {rows:,} rows of a table with the columns {columns}."
    if scenario.recordings is not None:
        recordings = {*recording_of(scenario.recordings.rows).tolist()}
        yield (
            f"The rows come from {len(recordings):,} recordings; confidence intervals treat worlds of one recording"
            " as dependent."
        )


def _types(scenario: Scenario) -> Iterator[str]:
    for name, kind in (scenario.vehicle_types or {}).items():
        own = {RULES[key].label: getattr(kind, key) for key in OF_A_TYPE}
        parts = [f"{label} {in_words(each)}" for label, each in own.items() if each is not None]
        parts += [f"V2X {flow_text(kind.v2x)}"] if kind.v2x is not None else []
        text = "; ".join(parts) or "quantities as declared for all types"
        yield f"Vehicle type {name}, weight {kind.weight:g}, load {in_words(kind.load)}: {text}."
    if scenario.vehicle_types:
        yield f"Possible vehicle types, front to rear: {flow_text(scenario.types or 'any')}."


def _declared(scenario: Scenario, key: str) -> str:
    """Return how a quantity is drawn; empty if the scenario does not declare it."""
    if scenario.members:
        roads = key == "friction" and all(each.declares(key) for each in scenario.members)
        ends = [end for each in (scenario.bounds(key) if key in USUAL or roads else ()) for end in each]
        return " to ".join(dict.fromkeys(f"{end(ends):.4g}" for end in (min, max))) if ends else ""
    value = getattr(scenario, key)
    if value is None or (key == "speed_deviations_mps" and key not in scenario.model_fields_set):
        return ""
    if isinstance(value, tuple):
        return ", ".join(map(in_words, value))
    per = RULES[key].per
    return in_words(value) + ("" if isinstance(value, float) or per == "world" else f", drawn for each {per}")


def in_words(quantity: Any) -> str:
    """Return a number or distribution in words: ``5 to 9 (uniform)``."""
    if isinstance(quantity, float):
        return f"{quantity:g}"
    (kind, shape), *more = quantity.model_dump(exclude_none=True).items()
    inner, ends = (shape, quantity.support) if isinstance(shape, dict) else (dict(more), shape)
    details = [f"{name} {flow_text(each)}" for name, each in inner.items() if name not in ("low", "high")]
    values = (" or " if kind == "choice" else " to ").join(f"{each:g}" for each in ends)
    return f"{values} ({', '.join([kind.replace('_', ' '), *details])})"


def _news(scenario: Scenario) -> str:
    about, usual = type(scenario.v2x).model_fields, CHANNELS["paper"]._asdict()
    channel = scenario.v2x.channel._asdict()
    other = {key: value for key, value in channel.items() if key in about and value != usual[key]}
    parts = [f"{key} {flow_text(value)} ({about[key].description})" for key, value in other.items()]
    for key, value in (scenario.v2x.model_extra or {}).items():
        parts.append(f"{key} {flow_text(value)} ({EXTENSIONS[key].schemas[key]['description']})")
    parts += [flow_text(scenario.v2x.vehicles)] if scenario.v2x.vehicles else []
    text = "; ".join(parts) or "each vehicle knows the whole line from its own latency on"
    return f"V2X preset {scenario.v2x.preset}: {text}."


# ---- a new file

_HEAD = """\
# Scenario {name}, started from {based_on}.
# A quantity is a fixed number, or a distribution from which every world draws a value:
#   {{uniform: [low, high]}}, {{loguniform: [low, high]}}
#   {{normal: {{mean: 20, sd: 1, low: 18, high: 22}}}}    truncated to [low, high]
#   {{lognormal: {{median: 1.1, sigma: 0.4, low: 0.3, high: 3}}}}    truncated to [low, high]
#   {{choice: [6, 7, 8]}}    optionally with weights: [1, 2, 1]
# A single entry is for all vehicles, each of which draws its own value. A list has one entry per vehicle.
"""
_EXAMPLES = {
    "observation": "[own, front_1, rear_1]",
    "vehicle_types": "{car: {weight: 9, mass_t: 1.5}, truck: {mass_t: {with_load: [14, 40]}}}",
    "types": "[car, any, truck]",
    "mixture": "[{scenario: paper-random, weight: 2}, {scenario: paper-random-early}]",
    "table": "{file: rows.csv, columns: [gap_1_m, gap_2_m]}",
    "roles": "{vehicle_2: learner}",
    "v2x": "nominal",
}


def check_file_name(kind: str, name: str) -> None:
    """Raise ``InvalidInput`` unless ``name`` can name a scenario or recipe (``kind``) and its file."""
    if re.fullmatch(NAME_PATTERN, name) is None or name.endswith("\n"):
        raise InvalidInput(
            f"{kind} name {name!r}: must be 1 to 64 lower case letters, digits, - and _, beginning with a letter or"
            " digit"
        )


def new_scenario_text(name: str, based_on: str = "paper-random", *, rows_file: str = "") -> str:
    """Return the commented text of a new scenario file with every key, and the values of ``based_on``.

    A key that is not used stands in a comment, with an example. With ``rows_file`` the text names this CSV file
    instead of the table's rows (``table.rows_text``).
    """
    check_file_name("scenario", name)
    base = load_scenario(based_on)
    values: dict[str, Any] = {"mixture": base.declared()["mixture"]} if base.members else {}
    if not base.members:
        values = base.model_dump(mode="json", exclude_none=True)
    values |= {
        "name": name,
        "title": "One-line title for lists and figures",
        "description": "What this scenario is for.",
        "source": f"Values of {base.name}, to be changed." + f" Its table: {base.source}" * (base.table is not None),
    }
    if base.table is not None and rows_file:
        weights = {} if base.table.weights is None else {"weights": WEIGHT}
        values["table"] = {"file": rows_file, "columns": list(base.table.columns), **weights}
    if base.line_speed_mps is None:
        values.pop("speed_deviations_mps", None)
    if base.members:
        values["mixture"] = [_short_member(entry) for entry in values["mixture"]]
    text = "".join(f"\n# {_comment(key)}\n{_line(key, values)}\n" for key in Scenario.model_fields)
    return _HEAD.format(name=name, based_on=base.name) + schema_lines("scenario", "scenario schema") + text


def _short_member(entry: dict[str, Any]) -> dict[str, Any]:
    """Return an entry of ``mixture`` with the name of a shipped scenario instead of its content."""
    content, name = entry["scenario"], entry["scenario"]["name"]
    try:
        as_shipped = member_content(load_scenario(name)) == content
    except InvalidInput:
        as_shipped = False
    return {**entry, "scenario": name} if as_shipped else entry


def _comment(key: str) -> str:
    rule = RULES.get(key)
    if rule is None:
        return str(Scenario.model_fields[key].description)
    other = {**ALTERNATIVES, **{new: usual for usual, new in ALTERNATIVES.items()}}.get(key)
    besides = f"; give either this key or {other}" if other else ""
    besides = "; only together with line_speed_mps" if key == "speed_deviations_mps" else besides
    return f"{rule.meaning}; {rule.interval}{', below horizon_s' if key == 'latency_s' else ''}{besides}"


def _line(key: str, values: Mapping[str, Any]) -> str:
    if key not in values:
        example = RULES[key].example if key in RULES else _EXAMPLES.get(key)
        return f"# {key}: {flow_text(Scenario.model_fields[key].default) if example is None else example}"
    value = values[key]
    if isinstance(value, dict) and all(isinstance(entry, str) for entry in value.values()):
        return f"{key}:" + "".join(f"\n  {name}: {flow_text(entry)}" for name, entry in value.items())
    return f"{key}: {flow_text(value)}"


# ---- JSON Schema


def scenario_json_schema() -> dict[str, Any]:
    """Return the JSON Schema of a scenario file, with which editors complete and check YAML."""
    one_of_two: list[dict[str, Any]] = [
        {"not": {"required": [*pair]}} if pair[0] in OPTIONAL else {"oneOf": [{"required": [key]} for key in pair]}
        for pair in ALTERNATIVES.items()
    ]
    by_types = {"anyOf": [{"required": ["vehicle_types"]}, {"required": [*NEEDED]}]}
    elsewhere = {"anyOf": [{"required": ["mixture"]}, {"required": ["table"]}]}
    whole = {"if": {"not": elsewhere}, "then": {"allOf": [*one_of_two, by_types]}}
    schema = Scenario.model_json_schema(schema_generator=FileSchema)
    ranges = {key: _range(key, rule.low, rule.high, rule.positive) for key, rule in RULES.items()}
    ranges["load"] = _range("load", 0.0, 1.0)
    for properties in (schema["properties"], schema["$defs"]["VehicleType"]["properties"]):
        for key in properties.keys() & ranges.keys():
            properties[key]["allOf"] = [_reference(key)]
    defined = schema["$defs"] | {f"range_{key}": limits for key, limits in ranges.items()}
    needed = {"speed_deviations_mps": ["line_speed_mps"]}
    return FileSchema.publish({**schema, **whole, "dependentRequired": needed, "$defs": defined})


def _reference(key: str) -> dict[str, Any]:
    return {"$ref": f"#/$defs/range_{key}"}


def _range(key: str, low: float, high: float, positive: bool = False) -> dict[str, Any]:
    """Return the schema of a quantity whose numbers, in distributions and lists too, are in [low, high]."""
    limits = {"exclusiveMinimum" if positive else "minimum": low, "maximum": high}
    above = {"exclusiveMinimum": 0}
    inside: dict[str, Any] = dict.fromkeys(("low", "high", "with_load", *DISTRIBUTIONS), _reference(key))
    inside |= {"loguniform": {"items": {**limits, **above}}, "sd": above, "sigma": above, "weights": {"items": above}}
    inside["lognormal"] = {"allOf": [_reference(key)], "properties": {"median": above, "low": above}}
    return {**limits, "items": _reference(key), "properties": inside}
