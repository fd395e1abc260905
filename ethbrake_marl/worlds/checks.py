"""Checks of a scenario that concern several keys together. Each refuses the first mistake, with its place."""

from __future__ import annotations

from difflib import get_close_matches
from typing import TYPE_CHECKING, Any

from pydantic_core import PydanticCustomError

from ethbrake_marl.files.model import UNSHOWN, require
from ethbrake_marl.files.yaml import YamlPath
from ethbrake_marl.worlds.roles import HELD, LEARNER, check_vehicle, deceleration_of
from ethbrake_marl.worlds.rules import ALTERNATIVES, OF_A_TYPE, RULES, USUAL
from ethbrake_marl.worlds.vehicle_types import check_types

if TYPE_CHECKING:
    from ethbrake_marl.worlds.scenario import Scenario

LEAST_WEIGHT = 1e-6  # least weight of harm that one vehicle of a line must have, so that shares of weights are exact


def check_whole(scenario: Scenario) -> None:
    """Refuse a scenario whose keys contradict each other. It is no mixture."""
    if scenario.types is not None:
        check_types(scenario.types, scenario.vehicle_types, scenario.vehicles)
    _check_declared_once(scenario)
    _check_speeds(scenario)
    _check_reactions(scenario)
    _check_roles(scenario)


def _check_declared_once(scenario: Scenario) -> None:
    """Refuse a quantity that nobody declares for some vehicle, or that is declared twice."""
    for key, rule in RULES.items():
        value = getattr(scenario, key)
        kinds = scenario.vehicle_types or {} if key in OF_A_TYPE else {}
        silent = [name for name, kind in kinds.items() if getattr(kind, key) is None]
        columns = [index for of, index in scenario.columns if of == key]
        by_types, by_table = bool(kinds) and not silent, len(columns) == rule.count(scenario.vehicles)
        by = "every vehicle type declares it" if by_types else "the table has columns of it for all"
        twice = key in scenario.model_fields_set and (by_types or by_table)
        require(not twice, (key,), value, f"must be left out, because {by}")
        if key in ALTERNATIVES and (value is not None or columns):
            other, of_table = ALTERNATIVES[key], " (of which the table has columns)" if columns else ""
            right = f"give either {key}{of_table} or {other}, not both"
            require(getattr(scenario, other) is None, (other,), getattr(scenario, other), right)
        if value is None and not (by_types or by_table):
            right = f"vehicle type {''.join(silent[:1])} does not declare {key}; declare {key} in this type, or outside"
            require(len(silent) == len(kinds), (key,), UNSHOWN, f"{right} vehicle_types for all types without it")
            if columns or (key in USUAL and getattr(scenario, ALTERNATIVES.get(key, key)) is None):
                raise PydanticCustomError("missing", "missing", {"at": (key,)})
    alone = "speed_deviations_mps" in scenario.model_fields_set and scenario.line_speed_mps is None
    right = "can be used only with line_speed_mps, the speed to which the deviations are added"
    require(not alone, ("speed_deviations_mps",), scenario.speed_deviations_mps, right)
    if scenario.declares("harm_weight"):
        right = f"may be 0 in all vehicles; at least one vehicle must always have a weight of {LEAST_WEIGHT:g} or more"
        weighs = any(low >= LEAST_WEIGHT for low, _ in scenario.bounds("harm_weight"))
        require(weighs, ("harm_weight",), scenario.harm_weight, right)


def _check_speeds(scenario: Scenario) -> None:
    limits = scenario.bounds("speed_limit_mps")
    for i, (low, high) in enumerate(scenario.bounds("speeds_mps")):
        key = "speeds_mps" if scenario.line_speed_mps is None else "line_speed_mps"
        drives = f"vehicle_{i + 1} has a speed of {low:g}" + ("" if low == high else f" to {high:g}")
        right = f"{drives} m/s; its speed must be from 0 to its speed_limit_mps, {limits[i][0]:g} m/s"
        require(low >= 0.0 and high <= limits[i][0], *_entry(scenario, key, i), right)


def _check_reactions(scenario: Scenario) -> None:
    """Refuse a time step or horizon with which a vehicle may not act, and equipment that has no effect."""
    v2x, channel, horizon = scenario.v2x, scenario.v2x.channel, f"horizon_s ({scenario.horizon_s:g} s)"
    in_time = scenario.time_step_s <= scenario.horizon_s
    require(in_time, ("time_step_s",), scenario.time_step_s, f"must not be above {horizon}")
    for name in v2x.vehicles or ():
        check_vehicle(name, scenario.vehicles, ("v2x", "vehicles", name), UNSHOWN)
    right = f"has no effect, because v2x: {v2x.preset} generates no messages; use another v2x, such as nominal"
    sent = channel.timing != "latency" and channel.hears != "none"
    for name, kind in (scenario.vehicle_types or {}).items():
        require(sent or kind.v2x is None, ("vehicle_types", name, "v2x"), kind.v2x, right)
    right = "works only with v2x: paper, because messages before the alert are not modelled"
    require(scenario.alert_s is None or not v2x.by_link, ("alert_s",), scenario.alert_s, right)
    own = [latest for _, latest in scenario.bounds("latency_s")]
    for i, latest in enumerate(channel.latest_reaction_s(own, scenario.equipped())):
        key = "v2x" if latest > own[i] else "latency_s" if scenario.alert_s is None else "alert_s"
        right = f"vehicle_{i + 1} may not be able to act until {latest:g} s; this time must be below {horizon}"
        require(latest < scenario.horizon_s, *_entry(scenario, key, i), right)
    for extension in v2x.extensions:
        extension.check(scenario)


def _check_roles(scenario: Scenario) -> None:
    for i, (name, role) in enumerate(scenario.roles.items()):
        deceleration = deceleration_of(role) or 0.0
        key = "braking_capacity_mps2" if deceleration > 0.0 else "driving_capacity_mps2"
        capacity = scenario.bounds(key)[i][0]
        right = f"must not be above the {key} of {name}, {capacity:g} m/s2"
        require(abs(deceleration) <= capacity, ("roles", name), role, right)
        script = role.partition(":")[0]
        hint = "".join(f"; did you mean {close}?" for close in get_close_matches(script, HELD, n=1))
        right = f"with early_impacts: reject, a script must be full_brake, coast or constant:a{hint}"
        waits = scenario.early_impacts == "keep" or not scenario.learners or script in (LEARNER, *HELD)
        require(waits, ("roles", name), role, right)
    right = "vehicle_1 can learn only with an obstacle ahead; add one, for instance obstacle_gap_m: 42"
    require(1 not in scenario.learners or scenario.has_obstacle, ("roles", "vehicle_1"), LEARNER, right)


def _entry(scenario: Scenario, key: str, index: int) -> tuple[YamlPath, Any]:
    """Return path and value of the entry of one vehicle, or of the entry for all."""
    value = getattr(scenario, key)
    return ((key, index), value[index]) if isinstance(value, tuple) else ((key,), value)
