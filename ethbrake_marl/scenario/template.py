"""A commented scenario file to start from."""

from __future__ import annotations

import re
from collections.abc import Mapping

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.scenario.catalogue import load_scenario
from ethbrake_marl.scenario.flow_text import flow_text
from ethbrake_marl.scenario.quantities import ALTERNATIVES, DECLARED
from ethbrake_marl.scenario.schema import NAME_PATTERN, Scenario

_HEAD = """\
# Scenario {name}, started from {based_on}.
# A quantity is a number, or is drawn for every world:
#   {{uniform: [low, high]}}, {{loguniform: [low, high]}}
#   {{normal: {{mean: 20, sd: 1, low: 18, high: 22}}}}    truncated to [low, high]
#   {{choice: [6, 7, 8]}}    optionally with weights: [1, 2, 1]
# One entry stands for every vehicle (each draws its own value); a list has one entry per vehicle, front to rear.
"""


def new_scenario_text(name: str, based_on: str = "paper-random") -> str:
    """Text of a commented YAML file for a new scenario ``name`` with the values of ``based_on``, all keys written out.

    A key that stands for another way to declare gaps or speeds is there as a comment with an example.
    Save it as ``<name>.yaml``. Raises ``InvalidInput`` for a name that cannot be one, or an unknown ``based_on``.
    """
    if re.fullmatch(NAME_PATTERN, name) is None:
        raise InvalidInput(
            f"scenario name {name!r}: must be 1 to 64 lower case letters, digits, - and _, beginning with a letter or"
            " digit"
        )
    base = load_scenario(based_on)
    values = {
        **base.model_dump(mode="json", exclude_none=True),
        "name": name,
        "title": "One line for lists and figures",
        "description": "What this scenario is for.",
        "source": f"Values of {base.name}, to be changed.",
    }
    if base.line_speed_mps is None:
        del values["speed_deviations_mps"]
    keys = [f"\n# {_comment(key)}\n{_line(key, values)}\n" for key in Scenario.model_fields]
    return _HEAD.format(name=name, based_on=base.name) + "".join(keys)


def _line(key: str, values: Mapping[str, object]) -> str:
    """``key: value``; a key that goes only with the other way to declare the same stands in a comment."""
    return f"{key}:{_value(values[key])}" if key in values else f"# {key}: {DECLARED[key].example}"


def _comment(key: str) -> str:
    rule = DECLARED.get(key)
    if rule is None:
        return str(Scenario.model_fields[key].description)
    other = {**ALTERNATIVES, **{new: usual for usual, new in ALTERNATIVES.items()}}.get(key)
    besides = f"; either this or {other}" if other else ""
    besides = "; only beside line_speed_mps" if key == "speed_deviations_mps" else besides
    return f"{rule.meaning}; {rule.interval}{', below horizon_s' if key == 'latency_s' else ''}{besides}"


def _value(value: object) -> str:
    """Roles one per line, everything else on the line of its key."""
    if isinstance(value, dict) and all(isinstance(entry, str) for entry in value.values()):
        return "".join(f"\n  {key}: {flow_text(entry)}" for key, entry in value.items())
    return f" {flow_text(value)}"
