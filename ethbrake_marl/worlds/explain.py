"""A scenario in words: its keys with ranges and defaults, sentences about it, a new file, the JSON Schema."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, NamedTuple

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.json_schema import FileSchema, schema_lines
from ethbrake_marl.files.model import NAME_PATTERN
from ethbrake_marl.files.yaml import flow_text, read_yaml
from ethbrake_marl.worlds.catalogue import load_scenario, scenario_path
from ethbrake_marl.worlds.roles import LEARNER
from ethbrake_marl.worlds.rules import ALTERNATIVES, RULES
from ethbrake_marl.worlds.scenario import Scenario


class Key(NamedTuple):
    name: str
    example: str  # of its value, in YAML
    about: str
    comment: str  # what the key means, its range, and which key cannot stand beside it


def listed_keys() -> list[Key]:
    keys, others = [], {**ALTERNATIVES, **{new: usual for usual, new in ALTERNATIVES.items()}}
    for name, field in Scenario.model_fields.items():
        about, rule = str(field.description), RULES.get(name)
        example = _EXAMPLES.get(name) or flow_text(field.default) if rule is None else rule.example
        either = [f"give either this key or {others[name]}"] if name in others else []
        keys.append(Key(name, example, about, "; ".join([about, *([rule.interval] if rule else []), *either])))
    return keys


def sentences(scenario: Scenario) -> Iterator[str]:
    """Sentences about the line, the roles, and every key of the file."""
    yield f"{scenario.name}: {scenario.title or 'no title'}. {scenario.description}".rstrip()
    there = {each.has_obstacle for each in scenario.members or (scenario,)}
    obstacle = f"{'an' if any(there) else 'no'} obstacle ahead{'' if len(there) == 1 else ' in some worlds'}"
    learners = ", ".join(name for name, role in scenario.roles.items() if role == LEARNER) or "nobody"
    yield f"{scenario.vehicles} vehicles in line, vehicle_1 in front, {obstacle}. Learners: {learners}."
    for script in dict.fromkeys(role for role in scenario.roles.values() if role != LEARNER):
        yield f"Script {script}: {', '.join(name for name, role in scenario.roles.items() if role == script)}."
    for key in listed_keys():
        value = getattr(scenario, key.name)
        if key.name == "mixture" and value is not None:
            value = {each.name: entry.weight for each, entry in zip(scenario.members, value, strict=True)}
        if key.name == "table" and value is not None:
            value = f"{len(value.rows):,} rows with the columns {', '.join(value.columns)}"
        own = key.name in RULES and scenario.members  # a mixture itself has no quantities
        if key.name not in ("name", "title", "description", "vehicles", "roles") and value is not None and not own:
            yield f"{key.name}: {flow_text(value)} ({key.about})."


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
    if re.fullmatch(NAME_PATTERN, name) is None:
        raise InvalidInput(
            f"{kind} name {name!r}: must be 1 to 64 lower case letters, digits, - and _, beginning with a letter or"
            " digit"
        )


def new_scenario_text(name: str, based_on: str = "paper-random", *, rows_file: str = "") -> str:
    """Text of a new scenario file, with comments and the values of ``based_on``.

    Unused keys are comments with an example. ``rows_file``: name of a copy of the table's CSV file.
    """
    check_file_name("scenario", name)
    base, values = load_scenario(based_on), dict(read_yaml(scenario_path(based_on)).content)
    values |= {
        "name": name,
        "title": "One-line title for lists and figures",
        "description": "What the scenario is for.",
    }
    values["source"] = f"Values of {base.name}, to be changed. Its own source: {base.source}"
    if rows_file and "file" in values.get("table", {}):
        values["table"] |= {"file": rows_file}
    text = _HEAD.format(name=name, based_on=base.name) + schema_lines("scenario", "scenario schema")
    for key in listed_keys():
        line = f"{key.name}: {flow_text(values[key.name])}" if key.name in values else f"# {key.name}: {key.example}"
        text += f"\n# {key.comment}\n{line}\n"
    return text


def scenario_json_schema() -> dict[str, Any]:
    schema = Scenario.model_json_schema(schema_generator=FileSchema)
    for properties in (schema["properties"], schema["$defs"]["VehicleType"]["properties"]):
        for key in properties.keys() & RULES.keys():
            properties[key]["allOf"] = [{"$ref": f"#/$defs/range_{key}"}]
    ranges = {f"range_{key}": rule.schema for key, rule in RULES.items()}
    return FileSchema.publish({**schema, "$defs": {**schema["$defs"], **ranges}})
