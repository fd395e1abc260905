"""The wording of messages about a scenario file: its keys, their places and their meanings."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from pydantic_core import ErrorDetails

from ethbrake_marl.files.messages import Wording, suggestion
from ethbrake_marl.files.yaml import YamlPath
from ethbrake_marl.scenario.distributions import DISTRIBUTIONS, Choice, NormalShape
from ethbrake_marl.scenario.fields import Member
from ethbrake_marl.scenario.quantities import ALTERNATIVES, DECLARED
from ethbrake_marl.scenario.v2x import V2X
from ethbrake_marl.scenario.vehicle_types import VehicleType

_DISTRIBUTION = (
    "{uniform: [low, high]}, {loguniform: [low, high]}, {normal: {mean, sd, low, high}} or {choice: [a, b, ...]}"
)
_INSIDE = {
    "uniform": ("uniform",),
    "loguniform": ("loguniform",),
    "normal": tuple(NormalShape.model_fields),
    "choice": tuple(Choice.model_fields),
}


@dataclass(frozen=True, slots=True)
class ScenarioWording(Wording):
    """The ``Wording`` of a scenario; ``keys`` are its top-level keys."""

    keys: Iterable[str]

    def known(self, path: YamlPath) -> list[str]:
        """The keys that may stand where ``path`` ends: at the top, in a distribution, in its parameters, in v2x."""
        if len(path) == 1:
            return list(self.keys)
        if path[0] == "vehicle_types" and len(path) == 3:
            return list(VehicleType.model_fields)
        if path[0] == "mixture":
            return list(Member.model_fields)
        outer = str(path[-2])
        if outer == "v2x":
            return list(V2X.model_fields)
        return list(_INSIDE[outer]) if outer == "normal" else sorted({*DISTRIBUTIONS, "weights"})

    def instead(self, key: str) -> str:
        """What the model has in place of friction: what each vehicle's brakes can on that road."""
        if "friction" not in key and key != "mu":
            return ""
        return "the model has no friction; braking_capacity_mps2 is what brakes and road allow, about 9.81 x friction"

    def needed(self, path: YamlPath) -> str:
        """What is needed at ``path``, with an example."""
        key = path[-1]
        if path[0] == "mixture":
            return "it is needed, for instance {scenario: paper-random, weight: 2}"
        if isinstance(key, int):
            return "two numbers [low, high] are needed"
        rule = DECLARED.get(key)
        if rule is None and len(path) > 1:
            return "a number is needed, as in {normal: {mean: 20, sd: 1, low: 18, high: 22}}"
        if rule is None:
            return f"it is needed, for instance {key}: my-scenario"
        other = f", or {ALTERNATIVES[key]}: {DECLARED[ALTERNATIVES[key]].example}" if key in ALTERNATIVES else ""
        return f"the {rule.meaning} is needed, for instance {key}: {rule.example}{other}"

    def owner(self, path: YamlPath) -> str:
        """Whose value stands at ``path``: a vehicle or a pair; empty for anything else."""
        rule = DECLARED.get(str(path[0])) if len(path) > 1 else None
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
    hints = [suggestion(key, DISTRIBUTIONS) for key in given if isinstance(key, str)] if isinstance(given, dict) else []
    return "".join(f"; {hint}" for hint in hints if hint)
