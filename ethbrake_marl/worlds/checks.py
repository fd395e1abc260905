"""Checks of a scenario that involve several keys."""

from __future__ import annotations

from difflib import get_close_matches
from typing import TYPE_CHECKING

from pydantic_core import ErrorDetails, PydanticCustomError

from ethbrake_marl.files.model import UNSHOWN, Wording, refuse, require, suggestion
from ethbrake_marl.files.yaml import YamlPath
from ethbrake_marl.worlds.derived import mistakes, world_values
from ethbrake_marl.worlds.physics import PHYSICS, departures_by
from ethbrake_marl.worlds.quantities import ALTERNATIVES, OF_A_TYPE, QUANTITIES, USUAL
from ethbrake_marl.worlds.quantity import DISTRIBUTIONS
from ethbrake_marl.worlds.roles import HOLDING_SCRIPTS, LEARNER
from ethbrake_marl.worlds.vehicle_types import check_types

if TYPE_CHECKING:
    from ethbrake_marl.worlds.scenario import Scenario


def check_scenario(scenario: Scenario) -> None:
    if scenario.types is not None:
        check_types(scenario.types, scenario.vehicle_types, scenario.vehicles)
    _check_declared_once(scenario)
    if scenario.physics is not None:
        is_known = scenario.physics in PHYSICS
        require(is_known, ("physics",), UNSHOWN, "" if is_known else str(PHYSICS.unknown(scenario.physics)))
    _check_channel(scenario)
    _check_roles(scenario)
    if scenario.physics is not None:
        PHYSICS[scenario.physics].check(scenario)
    ends = world_values(scenario, scenario.ends)
    low, high = ({key: values[row : row + 1] for key, values in ends.items()} for row in (0, 1))
    for key, i, _, right in mistakes(scenario, low, high):
        instead = {"speeds_mps": "line_speed_mps", "latency_s": "alert_s"}.get(key, key)
        key = key if getattr(scenario, instead) is None else instead
        value = getattr(scenario, key)
        is_list = isinstance(value, tuple)
        refuse((key, i) if is_list else (key,), value[i] if is_list else value, right)


def _check_declared_once(scenario: Scenario) -> None:
    for key, rule in QUANTITIES.items():
        value = getattr(scenario, key)
        kinds = scenario.vehicle_types or {} if key in OF_A_TYPE else {}
        silent = [name for name, kind in kinds.items() if getattr(kind, key) is None]
        columns = [rule.column_of(i) in scenario.columns for i in range(rule.count(scenario.vehicles))]
        by_types = bool(kinds) and not silent
        reason = "every vehicle type declares it" if by_types else "the table has columns of it for all"
        twice = key in scenario.model_fields_set and (by_types or all(columns))
        require(not twice, (key,), value, f"must be left out, because {reason}")
        if key in ALTERNATIVES and (value is not None or any(columns)):
            alternative, of_table = ALTERNATIVES[key], " (of which the table has columns)" if any(columns) else ""
            right = f"give either {key}{of_table} or {alternative}, not both"
            require(getattr(scenario, alternative) is None, (alternative,), getattr(scenario, alternative), right)
        if value is None and not (by_types or all(columns)):
            right = f"vehicle type {''.join(silent[:1])} does not declare {key}; declare {key} in this type, or outside"
            require(len(silent) == len(kinds), (key,), UNSHOWN, f"{right} vehicle_types for all types without it")
            if any(columns) or (key in USUAL and getattr(scenario, ALTERNATIVES.get(key, key)) is None):
                raise PydanticCustomError("missing", "missing", {"at": (key,)})
    alone = "speed_deviations_mps" in scenario.model_fields_set and scenario.line_speed_mps is None
    right = "can be used only with line_speed_mps, the speed to which the deviations are added"
    require(not alone, ("speed_deviations_mps",), scenario.speed_deviations_mps, right)
    right = "can be used only with friction, of which it is a share"
    require("friction" in scenario.sources or "grip" not in scenario.sources, ("grip",), scenario.grip, right)


def _check_channel(scenario: Scenario) -> None:
    v2x = scenario.v2x
    in_time = scenario.time_step_s <= scenario.horizon_s
    right = f"must not be above horizon_s ({scenario.horizon_s:g} s)"
    require(in_time, ("time_step_s",), scenario.time_step_s, right)
    right = f"has no effect, because v2x: {v2x.preset} generates no messages; use another v2x, such as nominal"
    has_messages = v2x.timing != "latency" and v2x.hears != "none"
    for name, kind in (scenario.vehicle_types or {}).items():
        require(has_messages or kind.v2x is None, ("vehicle_types", name, "v2x"), kind.v2x, right)
    right = "works only with v2x: paper, because messages before the alert are not modelled"
    require(scenario.alert_s is None or not v2x.by_link, ("alert_s",), scenario.alert_s, right)
    right = f"is not known to physics: {scenario.physics}; leave one of the two out"
    require(not v2x.channel_keys or not departures_by(scenario.physics), ("v2x",), UNSHOWN, right)
    for channel_key in v2x.channel_keys:
        channel_key.check(scenario)


def _check_roles(scenario: Scenario) -> None:
    for name, role in scenario.roles.items():
        script = role.partition(":")[0]
        hint = "".join(f"; did you mean {close}?" for close in get_close_matches(script, HOLDING_SCRIPTS, n=1))
        right = f"with early_impacts: reject, a script must be full_brake, coast or constant:a{hint}"
        waits = scenario.early_impacts == "keep" or not scenario.learners or script in (LEARNER, *HOLDING_SCRIPTS)
        require(waits, ("roles", name), role, right)
    right = "vehicle_1 can learn only with an obstacle ahead; add one, for instance obstacle_gap_m: 42"
    require(1 not in scenario.learners or scenario.has_obstacle, ("roles", "vehicle_1"), LEARNER, right)


# ---- texts for mistakes that pydantic finds

_DISTRIBUTION = (
    "{uniform: [low, high]}, {loguniform: [low, high]}, {normal: {mean, sd, low, high}},"
    " {lognormal: {median, sigma, low, high}} or {choice: [a, b, ...]}"
)
_FRICTION = "declare the friction of the road with the key friction, for instance friction: 0.5"
_REPLACEMENT_HINTS = {
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
    def instead(self, key: str) -> str:
        return _REPLACEMENT_HINTS.get(key, "")

    def needed(self, path: YamlPath) -> str:
        rule, key = QUANTITIES.get(str(path[-1])), str(path[-1])
        if rule is None:
            return f"write, for instance, {_EXAMPLES[key]}" if key in _EXAMPLES else f"write {_DISTRIBUTION}"
        alternative = (
            f", or {ALTERNATIVES[key]}: {QUANTITIES[ALTERNATIVES[key]].example}" if key in ALTERNATIVES else ""
        )
        return f"write, for instance, {key}: {rule.example}{alternative} ({rule.meaning})"

    def owner(self, path: YamlPath) -> str:
        rule = QUANTITIES.get(str(path[0])) if len(path) > 1 else None
        return rule.owner(path[1]) if rule is not None and isinstance(path[1], int) else ""

    def right(self, detail: ErrorDetails) -> str:
        value, kind = detail["input"], detail["type"]
        if kind == "quantity" or (kind == "float_type" and detail["loc"][-1] == "#number"):
            hints = [suggestion(str(key), DISTRIBUTIONS) for key in value] if isinstance(value, dict) else []
            load = "; with_load is allowed only in vehicle_types" * (isinstance(value, dict) and "with_load" in value)
            return f"must be a number or a distribution, {_DISTRIBUTION}{load}" + "".join(f"; {h}" for h in hints if h)
        if kind == "none_required":
            return "works only in a file and with load_scenario"
        if kind == "string_type" and detail["loc"][0] == "roles":
            return "must be learner or the name of a script, such as full_brake, coast or constant:3"
        return ""
