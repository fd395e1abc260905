"""Checks of a scenario that concern a whole field or several fields at once.

Each raises pydantic's error for the first defect, with the path inside the field or file and the value.
"""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any, NoReturn

import numpy as np
from pydantic import BaseModel
from pydantic_core import PydanticCustomError

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.yaml import YamlPath, flow_text
from ethbrake_marl.objectives import Declared, objectives_of
from ethbrake_marl.physics.messages import MOST_SAMPLES
from ethbrake_marl.scenario.distributions import support
from ethbrake_marl.scenario.features import listed_features
from ethbrake_marl.scenario.fields import LEFT_OUT, ScenarioFields
from ethbrake_marl.scenario.quantities import ALTERNATIVES, OPTIONAL, QUANTITIES, QuantityRule
from ethbrake_marl.scenario.roles import (
    LEARNER,
    STATE_FREE,
    constant_deceleration,
    is_state_free,
    parse_agent_spec,
)
from ethbrake_marl.scenario.sampling import farthest_obstacle_m, quantity_bounds
from ethbrake_marl.scenario.vehicle_types import TYPE_KEYS, missing_quantity


def refuse(at: YamlPath, value: Any, right: str) -> NoReturn:
    """Raise the error for ``value`` at ``at`` (inside the field being checked): ``right`` says what would do."""
    plain = value.model_dump(exclude_none=True) if isinstance(value, BaseModel) else value
    raise PydanticCustomError("scenario", "{right}", {"right": right, "value": flow_text(plain, 60), "at": at})


def check_entries(rule: QuantityRule, value: Any, vehicles: int | None) -> None:
    """Every entry of a quantity is in range over its whole support, and a list has the right length."""
    listed = isinstance(value, tuple)
    if listed and vehicles is not None and len(value) != rule.count(vehicles):
        per = "one per pair" if rule.per == "pair" else "one per vehicle"
        right = f"has {len(value)} entries; {vehicles} vehicles need {rule.count(vehicles)} ({per}), or one for all"
        raise PydanticCustomError("scenario", "{right}", {"right": right, "value": "", "at": ()})
    for index, entry in enumerate(value if listed else (value,)):
        low, high = support(entry)
        if not rule.allows(low, high):
            overlap = "; a negative gap means overlapping vehicles" if rule.per == "pair" and low < 0.0 else ""
            refuse((index,) if listed else (), entry, f"must be {rule.interval}{overlap}")


def check_roles(roles: Mapping[str, str], vehicles: int) -> None:
    """Every key is a vehicle of this scenario and every value is ``learner`` or the syntax of a script."""
    names = [f"vehicle_{i + 1}" for i in range(vehicles)]
    for name, role in roles.items():
        if name not in names:
            close = [] if name.startswith("vehicle_") else get_close_matches(name, names, n=1)
            hint = f"did you mean {close[0]}?" if close else f"this scenario has vehicle_1 ... vehicle_{vehicles}"
            refuse((name,), role, f"unknown vehicle; {hint}")
        try:
            is_state_free(role)
        except InvalidInput as error:
            refuse((name,), role, str(error))
        if role.startswith(f"{LEARNER}:"):
            refuse((name,), role, f"{LEARNER} takes no argument")


def check_objective(declared: Declared, vehicles: int) -> None:
    """The objective is a known one, and there is one for all vehicles or one for each."""
    try:
        objectives_of(declared, vehicles)
    except InvalidInput as error:
        refuse((), declared, str(error).removeprefix("objective: "))


def check_observation(listed: object) -> None:
    """An observation is a list of groups and features that are known, none of them twice."""
    try:
        listed_features(listed)
    except InvalidInput as error:
        refuse((), listed, str(error).removeprefix("observation: "))


def check_given(key: str, value: Any, data: Mapping[str, Any]) -> Any:
    """The value of a quantity that every vehicle needs; None where every type declares it, and nobody else has to.

    ``data`` are the fields before it. Raises pydantic's error where it is missing, and where nobody would read it.
    """
    kinds = data.get("vehicle_types")
    without = None if kinds is None else missing_quantity(kinds, key)
    if value is LEFT_OUT:
        if data.get("mixture") is not None or not {"vehicle_types", "mixture"} <= data.keys():
            return None
        if kinds is None:
            raise PydanticCustomError("missing", "missing", {"at": ()})
        if without is not None:
            right = f"type {without} does not declare it: give it there, or here for every type that does not"
            raise PydanticCustomError("scenario", "{right}", {"right": right, "value": "", "at": ()})
        return None
    if value is None:
        refuse((), value, "must be a number or a distribution; a key that is not used is left out")
    if kinds is not None and without is None:
        refuse((), value, "every type declares it; leave it out")
    return value


def check_alternatives(scenario: ScenarioFields) -> None:
    """Gaps and speeds are declared in one of two ways, an obstacle in one at most; deviations need a line speed."""
    if "speed_deviations_mps" in scenario.model_fields_set and scenario.line_speed_mps is None:
        right = "needs line_speed_mps, the speed that it is added to"
        refuse(("speed_deviations_mps",), _plain(scenario.speed_deviations_mps), right)
    for usual, other in ALTERNATIVES.items():
        given = [key for key in (usual, other) if getattr(scenario, key) is not None]
        if not given and usual not in OPTIONAL:
            raise PydanticCustomError("missing", "missing", {"at": (usual,)})
        if len(given) == 2:
            refuse((other,), _plain(getattr(scenario, other)), f"give either {usual} or {other}, not both")


def check_whole(scenario: ScenarioFields) -> None:
    """Fields that limit each other: time step, horizon, latency, speeds, gaps, constant scripts, rejection."""
    if not scenario.time_step_s <= scenario.horizon_s:
        refuse(("time_step_s",), scenario.time_step_s, f"must not be above horizon_s ({scenario.horizon_s:g} s)")
    for i, latencies in enumerate(scenario.possible_quantities("latency_s")):
        for kind, latency in latencies.items():
            if not support(latency)[1] < scenario.horizon_s:
                right = f"must be below horizon_s ({scenario.horizon_s:g} s), or the vehicle can never act"
                refuse(_path(scenario, "latency_s", i, kind), latency, right)
    _check_reactions(scenario)
    _check_speeds(scenario)
    if scenario.time_gaps_s is not None:
        _check_time_gaps(scenario)
    if scenario.obstacle_margin_m is not None:
        _check_obstacle_margin(scenario)
    _check_constant_scripts(scenario)
    if 0 in scenario.learners and not scenario.has_obstacle:
        right = (
            "has nothing to lose without an obstacle ahead; give obstacle_gap_m too, for instance obstacle_gap_m: 42"
        )
        refuse(("roles", "vehicle_1"), LEARNER, right)
    if scenario.early_impacts == "reject" and scenario.learners:
        _check_rejection(scenario)


def _check_reactions(scenario: ScenarioFields) -> None:
    """However late the news is, every vehicle may act before the horizon."""
    own = np.array([latest for _, latest in scenario.supports("latency_s")])
    latest = scenario.v2x.latest_reaction_s(own)
    if not (latest < scenario.horizon_s).all():
        i = int(np.argmin(latest < scenario.horizon_s))
        right = (
            f"vehicle_{i + 1} may have no news until {latest[i]:g} s; it must be below horizon_s"
            f" ({scenario.horizon_s:g} s), which may be raised"
        )
        refuse(("v2x",), scenario.v2x, right)
    if not (samples := scenario.v2x.channel.samples(scenario.time_step_s)) <= MOST_SAMPLES:
        right = f"a message is on its way for {samples - 3} time steps; at most {MOST_SAMPLES - 3} are possible"
        refuse(("v2x",), scenario.v2x, right)


def _check_speeds(scenario: ScenarioFields) -> None:
    limits = scenario.possible_quantities("speed_limit_mps")
    for i, (low, high) in enumerate(quantity_bounds(scenario, "speeds_mps")):
        lowest = min(limits[i].values(), key=lambda quantity: support(quantity)[0])
        if low >= 0.0 and high <= support(lowest)[0]:
            continue
        limit = f"speed_limit_mps of vehicle_{i + 1}, {flow_text(_plain(lowest))} m/s"
        if scenario.line_speed_mps is None:
            speed = scenario.quantities("speeds_mps")[i]
            refuse(_path(scenario, "speeds_mps", i), speed, f"must not be above {limit}")
        drives = f"vehicle_{i + 1} drives {low:g}" + ("" if low == high else f" to {high:g}")
        deviates = "with speed_deviations_mps " if "speed_deviations_mps" in scenario.model_fields_set else ""
        right = f"{deviates}{drives} m/s; must be 0 to {limit}"
        refuse(("line_speed_mps",), scenario.line_speed_mps, right)


def _check_time_gaps(scenario: ScenarioFields) -> None:
    largest = QUANTITIES["gaps_m"].high
    for pair, (_, high) in enumerate(quantity_bounds(scenario, "gaps_m")):
        if not high <= largest:
            right = f"is up to {high:g} m at the speed of vehicle_{pair + 2}; a gap must not be above {largest:g} m"
            refuse(_path(scenario, "time_gaps_s", pair), scenario.quantities("time_gaps_s")[pair], right)


def _check_obstacle_margin(scenario: ScenarioFields) -> None:
    farthest = farthest_obstacle_m(scenario)
    if not farthest <= OPTIONAL["obstacle_gap_m"].high:
        right = (
            f"puts the obstacle up to {farthest:g} m ahead of vehicle_1; that distance must not be above"
            f" {OPTIONAL['obstacle_gap_m'].high:g} m"
        )
        refuse(("obstacle_margin_m",), scenario.obstacle_margin_m, right)


def _check_constant_scripts(scenario: ScenarioFields) -> None:
    for i, script in scenario.scripts.items():
        deceleration = constant_deceleration(script) or 0.0
        field = "braking_capacity_mps2" if deceleration > 0.0 else "driving_capacity_mps2"
        capacity = scenario.supports(field)[i][0]
        if not abs(deceleration) <= capacity:
            refuse(("roles", f"vehicle_{i + 1}"), script, f"is above this vehicle's {field}, {capacity:g} m/s2")


def _check_rejection(scenario: ScenarioFields) -> None:
    for i, script in scenario.scripts.items():
        if not is_state_free(script):
            close = get_close_matches(parse_agent_spec(script)[0], STATE_FREE, n=1)
            hint = f"; did you mean {close[0]}?" if close else ""
            right = f"with early_impacts: reject a script must be full_brake, coast or constant:a{hint}"
            refuse(("roles", f"vehicle_{i + 1}"), script, right)


def _path(scenario: ScenarioFields, field: str, index: int, kind: int = 0) -> YamlPath:
    line = scenario.types_of_line
    if line is not None and field in TYPE_KEYS and getattr(line.kinds[kind], field) is not None:
        return ("vehicle_types", line.names[kind], field)
    return (field, index) if isinstance(getattr(scenario, field), tuple) else (field,)


def _plain(quantity: Any) -> Any:
    return quantity.model_dump(exclude_none=True) if isinstance(quantity, BaseModel) else quantity
