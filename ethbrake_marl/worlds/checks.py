"""Checks of a scenario that concern several keys together. Each refuses the first mistake, with its place."""

from __future__ import annotations

from difflib import get_close_matches
from typing import TYPE_CHECKING

from pydantic_core import PydanticCustomError

from ethbrake_marl.files.model import UNSHOWN, refuse, require
from ethbrake_marl.files.yaml import YamlPath, flow_text
from ethbrake_marl.worlds.derived import obstacle_gap, on_road, world_values
from ethbrake_marl.worlds.quantity import support
from ethbrake_marl.worlds.roles import HELD, LEARNER, deceleration_of
from ethbrake_marl.worlds.rules import ALTERNATIVES, OF_A_TYPE, OPTIONAL, RULES, USUAL

if TYPE_CHECKING:
    from ethbrake_marl.worlds.scenario import Scenario

LEAST_WEIGHT = 1e-6  # least weight of harm that one vehicle of a line must have, so that shares of weights are exact


def check_whole(scenario: Scenario) -> None:
    """Refuse a scenario whose keys contradict each other. It is no mixture."""
    _check_declared_once(scenario)
    _check_times(scenario)
    _check_news(scenario)
    _check_speeds(scenario)
    _check_distances(scenario)
    _check_roles(scenario)


def _check_declared_once(scenario: Scenario) -> None:
    alone = "speed_deviations_mps" in scenario.model_fields_set and scenario.line_speed_mps is None
    right = "can be used only with line_speed_mps, the speed to which the deviations are added"
    require(not alone, ("speed_deviations_mps",), scenario.speed_deviations_mps, right)
    for key in scenario.model_fields_set & RULES.keys():
        tabled = [entry for entry in scenario.columns if entry[0] == key]
        right = f"must be left out, because the table has columns of {key} for all"
        whole = len(tabled) == RULES[key].count(scenario.vehicles)
        require(not whole, (key,), getattr(scenario, key), right)
    kinds = scenario.vehicle_types or {}
    for key in set(OF_A_TYPE) - set(USUAL):
        silent = [name for name, kind in kinds.items() if getattr(kind, key) is None]
        is_set = getattr(scenario, key) is not None
        right = undeclared_by_type(key, "".join(silent[:1]))
        require(is_set or len(silent) in (0, len(kinds)), (key,), UNSHOWN, right)
        right = f"must be left out, because every vehicle type declares {key}"
        require(not (is_set and kinds) or len(silent) > 0, (key,), UNSHOWN, right)
    for usual, other in ALTERNATIVES.items():
        present = [key for key in (usual, other) if getattr(scenario, key) is not None]
        columns = [column.name for (key, _), column in scenario.columns.items() if key == usual]
        right = f"the table has the columns {', '.join(columns)}; for the other entries use {usual}, not {other}"
        require(not (columns and other in present), (other,), getattr(scenario, other), right)
        present += [usual] * (usual not in present and scenario.declares(usual))
        if not present and usual not in OPTIONAL:
            raise PydanticCustomError("missing", "missing", {"at": (usual,)})
        right = f"give either {usual} or {other}, not both"
        require(len(present) < 2, (other,), getattr(scenario, other), right)


def _check_times(scenario: Scenario) -> None:
    horizon = f"horizon_s ({scenario.horizon_s:g} s)"
    in_time = scenario.time_step_s <= scenario.horizon_s
    require(in_time, ("time_step_s",), scenario.time_step_s, f"must not be above {horizon}")
    for i, latencies in enumerate(scenario.declarations("latency_s")):
        for kind, latency in latencies.items():
            right = f"must be below {horizon}, otherwise the vehicle can never act"
            acts = support(latency)[1] < scenario.horizon_s
            require(acts, _path(scenario, "latency_s", i, kind), latency, right)
    if scenario.declares("harm_weight"):
        right = f"may be 0 in all vehicles; at least one vehicle must always have a weight of {LEAST_WEIGHT:g} or more"
        weighs = any(low >= LEAST_WEIGHT for low, _ in scenario.bounds("harm_weight"))
        require(weighs, ("harm_weight",), scenario.harm_weight, right)


def _check_news(scenario: Scenario) -> None:
    """Refuse a channel with which a vehicle may not act before the horizon."""
    v2x, channel = scenario.v2x, scenario.v2x.channel
    for name in v2x.vehicles or ():
        right = f"unknown vehicle; this scenario has vehicle_1 ... vehicle_{scenario.vehicles}"
        require(name in scenario.vehicle_names, ("v2x", "vehicles", name), UNSHOWN, right)
    right = f"has no effect, because v2x: {v2x.preset} generates no messages; use another v2x, such as nominal"
    sent = channel.timing != "latency" and channel.hears != "none"
    for name, kind in (scenario.vehicle_types or {}).items():
        require(sent or kind.v2x is None, ("vehicle_types", name, "v2x"), kind.v2x, right)
    right = "works only with v2x: paper, because messages before the alert are not modelled"
    require(scenario.alert_s is None or not v2x.by_link, ("alert_s",), scenario.alert_s, right)
    own = [latest for _, latest in scenario.bounds("latency_s")]
    right = (
        f"the sum of alert_s and latency_s may be {max(own):g} s; it must be below horizon_s"
        f" ({scenario.horizon_s:g} s), or the vehicle cannot act; reduce the sum or raise horizon_s"
    )
    require(scenario.alert_s is None or max(own) < scenario.horizon_s, ("alert_s",), scenario.alert_s, right)
    for i, latest in enumerate(channel.latest_reaction_s(own, scenario.equipped())):
        right = (
            f"vehicle_{i + 1} may get its first news as late as {latest:g} s; this time must be below horizon_s"
            f" ({scenario.horizon_s:g} s); use a faster channel or raise horizon_s"
        )
        require(bool(latest < scenario.horizon_s), ("v2x",), v2x, right)
    for extension in v2x.extensions:
        extension.check(scenario)


def _check_speeds(scenario: Scenario) -> None:
    limits = scenario.declarations("speed_limit_mps")
    for i, (low, high) in enumerate(scenario.bounds("speeds_mps")):
        lowest = min(limits[i].values(), key=lambda quantity: support(quantity)[0])
        if low >= 0.0 and high <= support(lowest)[0]:
            continue
        limit = f"speed_limit_mps of vehicle_{i + 1}, {flow_text(lowest)} m/s"
        if scenario.line_speed_mps is None:
            speed = scenario.declarations("speeds_mps")[i][0]
            refuse(_path(scenario, "speeds_mps", i), speed, f"must not be above {limit}")
        drives = f"vehicle_{i + 1} has a speed of {low:g}" + ("" if low == high else f" to {high:g}")
        deviates = "with speed_deviations_mps " if "speed_deviations_mps" in scenario.model_fields_set else ""
        right = f"{deviates}{drives} m/s; the speed must be from 0 to {limit}"
        refuse(("line_speed_mps",), scenario.line_speed_mps, right)


def _check_distances(scenario: Scenario) -> None:
    """Refuse time gaps and margins that lead to larger distances than can be declared."""
    largest = RULES["gaps_m"].high
    for pair, (_, high) in enumerate(scenario.bounds("gaps_m") if scenario.time_gaps_s is not None else ()):
        right = f"gives gaps up to {high:g} m at the speed of vehicle_{pair + 2}; a gap must not be above {largest:g} m"
        gap = scenario.declarations("time_gaps_s")[pair][0]
        require(high <= largest, _path(scenario, "time_gaps_s", pair), gap, right)
    largest = RULES["obstacle_gap_m"].high
    if scenario.obstacle_margin_m is not None:
        farthest = farthest_obstacle_m(scenario)
        right = (
            f"puts the obstacle up to {farthest:g} m ahead of vehicle_1; that distance must not be above {largest:g} m"
        )
        require(farthest <= largest, ("obstacle_margin_m",), scenario.obstacle_margin_m, right)


def farthest_obstacle_m(scenario: Scenario) -> float:
    """Return the largest distance of an obstacle (m) that a margin may lead to: Vehicle 1 is fast and brakes weakly."""
    ends = on_road(world_values(scenario, scenario.ends))
    weak = ("braking_capacity_mps2", "brake_rate_mps3")
    slowest = {key: values[[0 if key in weak else 1]] for key, values in ends.items()}
    gap = obstacle_gap(scenario, slowest, lambda key: scenario.ends(key)[[1]])
    return 0.0 if gap is None else float(gap[0, 0])


def _check_roles(scenario: Scenario) -> None:
    for name, role in scenario.roles.items():
        deceleration = deceleration_of(role) or 0.0
        key = "braking_capacity_mps2" if deceleration > 0.0 else "driving_capacity_mps2"
        capacity = scenario.bounds(key)[scenario.vehicle_names.index(name)][0]
        right = f"must not be above the {key} of {name}, {capacity:g} m/s2"
        require(abs(deceleration) <= capacity, ("roles", name), role, right)
        if scenario.early_impacts == "reject" and scenario.learners and role != LEARNER:
            script = role.partition(":")[0]
            close = get_close_matches(script, HELD, n=1)
            hint = f"; did you mean {close[0]}?" if close else ""
            right = f"with early_impacts: reject, a script must be full_brake, coast or constant:a{hint}"
            require(script in HELD, ("roles", name), role, right)
    right = "vehicle_1 can learn only with an obstacle ahead; add one, for instance obstacle_gap_m: 42"
    require(1 not in scenario.learners or scenario.has_obstacle, ("roles", "vehicle_1"), LEARNER, right)


def _path(scenario: Scenario, key: str, index: int, kind: int = 0) -> YamlPath:
    line = scenario.types_of_line
    if line is not None and key in OF_A_TYPE and getattr(line.kinds[kind], key) is not None:
        return "vehicle_types", line.names[kind], key
    return (key, index) if isinstance(getattr(scenario, key), tuple) else (key,)


def undeclared_by_type(key: str, kind: object) -> str:
    """Return the error text for a quantity that a vehicle type does not declare."""
    return (
        f"vehicle type {kind} does not declare {key}; declare {key} in this type, or outside vehicle_types for all"
        " types without it"
    )
