"""Texts of scenario files: a new file, all values of a scenario, and the JSON Schema for editors."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.json_schema import FileSchema
from ethbrake_marl.files.model import NAME_PATTERN
from ethbrake_marl.files.plain import read_plain
from ethbrake_marl.files.yaml import YAML_SIZE_LIMIT, flow_text, parse_yaml
from ethbrake_marl.worlds.catalogue import load_scenario, scenario_path, shipped_folder
from ethbrake_marl.worlds.channel import V2X
from ethbrake_marl.worlds.channel_table import key_table, values_of
from ethbrake_marl.worlds.mixture import DESCRIPTIVE_KEYS
from ethbrake_marl.worlds.quantities import ALTERNATIVES, QUANTITIES
from ethbrake_marl.worlds.scenario import Scenario

_HEAD = """\
# The scenario {base} with other values: remove the # in front of a key and change its value; null takes the key away.
# All values: ethbrake scenario show {name}.yaml
# A quantity is a fixed number, or a distribution from which every world draws a value:
#   {{uniform: [low, high]}}, {{loguniform: [low, high]}}
#   {{normal: {{mean: 20, sd: 1, low: 18, high: 22}}}}    truncated to [low, high]
#   {{lognormal: {{median: 1.1, sigma: 0.4, low: 0.3, high: 3}}}}    truncated to [low, high]
#   {{choice: [6, 7, 8]}}    optionally with weights: [1, 2, 1]
# A single entry is for all vehicles, each of which draws its own value. A list has one entry per vehicle.
# With this schema an editor completes and checks this file:
# yaml-language-server: $schema={schema}

name: {name}
title: One-line title for lists and figures
description: What the scenario is for.
source: Where the values come from.
based_on: {based_on}
"""
_EXAMPLES = {
    "based_on": "paper-random",
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


def new_scenario_text(name: str, based_on: str = "paper-random", *, folder: Path = Path()) -> str:
    check_file_name("scenario", name)
    base = load_scenario(based_on)
    values, path = base.declared(), scenario_path(based_on)
    if path.suffix and path == Path(based_on).expanduser():  # a path, and no name
        based_on = Path(os.path.relpath(path, folder)).as_posix()
    schema = (shipped_folder() / "scenario.schema.json").as_uri()
    text = _HEAD.format(name=name, base=base.name, based_on=flow_text(based_on), schema=schema)
    alternatives = ALTERNATIVES | {instead: key for key, instead in ALTERNATIVES.items()}
    for key, field in Scenario.model_fields.items():
        if key not in ("name", *DESCRIPTIVE_KEYS, "based_on"):
            rule, comment = QUANTITIES.get(key), [str(field.description)]
            comment += [] if rule is None else [rule.interval]
            comment += [f"give either this key or {alternatives[key]}"] if key in alternatives else []
            example = _EXAMPLES.get(key) or flow_text(field.default) if rule is None else rule.example
            short = key in values and key not in ("mixture", "table")
            text += f"\n# {'; '.join(comment)}\n# {key}: {flow_text(values[key]) if short else example}\n"
    return text


def whole_text(scenario: str | Path) -> str:
    """Text of a scenario's file. If the scenario is based on another one: a text with all values of the scenario."""
    path, loaded = scenario_path(scenario), load_scenario(scenario)
    text = read_plain(path, YAML_SIZE_LIMIT).decode("utf-8")
    declared, has_channel = loaded.declared(), "v2x" in loaded.model_fields_set and not loaded.members
    if "based_on" in parse_yaml(text).content:
        if has_channel:
            declared["v2x"] = values_of(loaded.v2x)
        text = "".join(f"{key}: {flow_text(value)}\n" for key, value in declared.items())
    return text + (_channel_comment(loaded.v2x) if has_channel else "")


def _channel_comment(v2x: V2X) -> str:
    rows = key_table(v2x)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    head = "All keys of v2x: the value here, and the value of each preset (–: none, or without effect)"
    return "".join(f"# {line}\n" for line in [head, *lines])


def scenario_json_schema() -> dict[str, Any]:
    schema = Scenario.model_json_schema(schema_generator=FileSchema)
    for properties in (schema["properties"], schema["$defs"]["VehicleType"]["properties"]):
        for key in properties.keys() & QUANTITIES.keys():
            properties[key]["allOf"] = [{"$ref": f"#/$defs/range_{key}"}]
    for key, property_schema in schema["properties"].items():
        if key not in ("name", *DESCRIPTIVE_KEYS, "based_on"):  # null takes the key of another scenario away
            schema["properties"][key] = {"anyOf": [property_schema, {"type": "null"}]}
    ranges = {f"range_{key}": rule.schema for key, rule in QUANTITIES.items()}
    return FileSchema.publish({**schema, "$defs": {**schema["$defs"], **ranges}})
