"""Texts for errors in scenario files: what would be right instead."""

from __future__ import annotations

from pydantic_core import ErrorDetails

from ethbrake_marl.files.model import Wording, suggestion
from ethbrake_marl.files.yaml import YamlPath
from ethbrake_marl.worlds.quantity import DISTRIBUTIONS
from ethbrake_marl.worlds.rules import ALTERNATIVES, RULES

_DISTRIBUTION = (
    "{uniform: [low, high]}, {loguniform: [low, high]}, {normal: {mean, sd, low, high}},"
    " {lognormal: {median, sigma, low, high}} or {choice: [a, b, ...]}"
)
_FRICTION = "declare the friction of the road with the key friction, for instance friction: 0.5"
_INSTEAD = {
    "grade": "the model has no slopes; for a road downhill, lower the braking capacities by 9.81 x grade m/s2 and raise"
    " the driving capacities as much",
    "mu": _FRICTION,
    "road_friction": _FRICTION,
    "friction_coefficient": _FRICTION,
    "follower": "give the line one more vehicle: raise vehicles, and add its gap, speed, latency_s and the like to the"
    " lists",
}
_EXAMPLES = {"name": "name: my-scenario", "scenario": "{scenario: paper-random, weight: 2}"}


class ScenarioWording(Wording):
    """Texts for error messages about the content of a scenario file."""

    def instead(self, key: str) -> str:
        """Return what to write instead of a key that people try, or that earlier versions had."""
        return _INSTEAD.get(key, "")

    def needed(self, path: YamlPath) -> str:
        """Return advice on what to write at ``path``, with an example."""
        rule, key = RULES.get(str(path[-1])), str(path[-1])
        if rule is None:
            return f"write, for instance, {_EXAMPLES[key]}" if key in _EXAMPLES else f"write {_DISTRIBUTION}"
        other = f", or {ALTERNATIVES[key]}: {RULES[ALTERNATIVES[key]].example}" if key in ALTERNATIVES else ""
        return f"write, for instance, {key}: {rule.example}{other} ({rule.meaning})"

    def owner(self, path: YamlPath) -> str:
        """Return the vehicle or pair whose value is at ``path``, such as ``vehicle_2``."""
        rule = RULES.get(str(path[0])) if len(path) > 1 else None
        return rule.owner(path[1]) if rule is not None and isinstance(path[1], int) else ""

    def right(self, detail: ErrorDetails) -> str:
        """Return what would be valid instead of a bad quantity or role."""
        given, kind = detail["input"], detail["type"]
        if kind == "quantity" or (kind == "float_type" and detail["loc"][-1] == "#number"):
            hints = [suggestion(str(key), DISTRIBUTIONS) for key in given] if isinstance(given, dict) else []
            load = "; with_load is allowed only in vehicle_types" * (isinstance(given, dict) and "with_load" in given)
            return f"must be a number or a distribution, {_DISTRIBUTION}{load}" + "".join(f"; {h}" for h in hints if h)
        if kind == "string_type" and detail["loc"][0] == "roles":
            return "must be learner or the name of a script, such as full_brake, coast or constant:3"
        return ""
