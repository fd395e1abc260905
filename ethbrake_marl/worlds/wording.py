"""Texts for errors in scenario files: what would be right instead."""

from __future__ import annotations

from typing import Any

from pydantic_core import ErrorDetails

from ethbrake_marl.files.model import Wording, suggestion
from ethbrake_marl.files.yaml import YamlPath
from ethbrake_marl.worlds.quantity import DISTRIBUTIONS
from ethbrake_marl.worlds.rules import ALTERNATIVES, RULES

_DISTRIBUTION = (
    "{uniform: [low, high]}, {loguniform: [low, high]}, {normal: {mean, sd, low, high}},"
    " {lognormal: {median, sigma, low, high}} or {choice: [a, b, ...]}"
)
_INSTEAD = {
    "grade": "the model has no slopes; for a road downhill, lower the braking capacities by 9.81 x grade m/s2 and raise"
    " the driving capacities as much",
    "mu": "declare the friction of the road with the key friction, for instance friction: 0.5",
    "follower": "give the line one more vehicle: raise vehicles, and add its gap, speed, latency_s and the like to the"
    " lists",
}


class ScenarioWording(Wording):
    """Texts for error messages about the content of a scenario file."""

    def instead(self, key: str) -> str:
        """Return what to write instead of a key that people try, or that earlier versions had."""
        return _INSTEAD.get({"slope": "grade"}.get(key, "mu" if "friction" in key else key), "")

    def needed(self, path: YamlPath) -> str:
        """Return advice on what to write at ``path``, with an example."""
        key = path[-1]
        if path[0] == "mixture":
            return "write, for instance, {scenario: paper-random, weight: 2}"
        if isinstance(key, int):
            return "two numbers [low, high] are needed"
        rule = RULES.get(key)
        if rule is None and len(path) > 1:
            log = "lognormal" in path
            shape = "median: 20, sigma: 1, low: 5, high: 90" if log else "mean: 20, sd: 1, low: 18, high: 22"
            return f"a number is needed, as in {{{'log' * log}normal: {{{shape}}}}}"
        if rule is None:
            return f"write, for instance, {key}: my-scenario"
        other = f", or {ALTERNATIVES[key]}: {RULES[ALTERNATIVES[key]].example}" if key in ALTERNATIVES else ""
        return f"write, for instance, {key}: {rule.example}{other} ({rule.meaning})"

    def owner(self, path: YamlPath) -> str:
        """Return the vehicle or pair whose value is at ``path``, such as ``vehicle_2``."""
        rule = RULES.get(str(path[0])) if len(path) > 1 else None
        return rule.owner(path[1]) if rule is not None and isinstance(path[1], int) else ""

    def right(self, detail: ErrorDetails) -> str:
        """Return what would be valid instead of a bad quantity or a bad member of a mixture."""
        if detail["type"] == "quantity":
            return f"must be a number, {_DISTRIBUTION}{_misspelt(detail['input'])}"
        if detail["type"] == "float_type" and detail["loc"][-1] == "#number":
            return f"must be a number or a distribution, {_DISTRIBUTION}"
        if detail["type"] == "string_type" and detail["loc"][0] == "roles" and isinstance(detail["input"], dict):
            return "must be learner or the name of a script, such as full_brake, coast or constant:3"
        if detail["loc"][:1] == ("mixture",) and detail["loc"][-1] == "scenario":
            return "must be the content of a scenario as a mapping; a scenario's name works only with load_scenario"
        return ""


def _misspelt(given: Any) -> str:
    if not isinstance(given, dict):
        return ""
    if "with_load" in given:
        return "; with_load is allowed only in vehicle_types"
    hints = [suggestion(key, DISTRIBUTIONS) for key in given if isinstance(key, str)]
    return "".join(f"; {hint}" for hint in hints if hint)
