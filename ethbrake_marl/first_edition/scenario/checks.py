"""Checks of a scenario that concern several fields together.

Each check raises a pydantic error for the first mistake that the check finds. The error contains the invalid value and
its path (keys and indices) inside the file.
"""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches

import numpy as np
from pydantic_core import PydanticCustomError

from ethbrake_marl.files.model import UNSHOWN, refuse, require
from ethbrake_marl.files.yaml import YamlPath, flow_text
from ethbrake_marl.first_edition.physics.state import LEAST_WEIGHT
from ethbrake_marl.first_edition.scenario.declared import ScenarioFields, undeclared_by_type
from ethbrake_marl.first_edition.scenario.distributions import support
from ethbrake_marl.first_edition.scenario.fields import QUANTITY
from ethbrake_marl.first_edition.scenario.roles import LEARNER, ScriptSpec

MOST_SAMPLES = 1_000  # largest number of samples that a vehicle may have to store for delayed messages


def check_whole(scenario: ScenarioFields) -> None:
    """Check the fields of a scenario that depend on each other.

    The checks concern time step, horizon, latencies, channel, speeds, gaps, obstacle, scripts, and quantities that are
    declared twice.
    """
    alone = "speed_deviations_mps" in scenario.model_fields_set and scenario.line_speed_mps is None
    right = "can be used only with line_speed_mps, the speed to which the deviations are added"
    require(not alone, ("speed_deviations_mps",), scenario.speed_deviations_mps, right)
    for key in scenario.model_fields_set & QUANTITY.declared.keys():
        tabled = [entry for entry in scenario.table_entries if entry[0] == key]
        whole = len(tabled) == QUANTITY.declared[key].count(scenario.vehicles)
        right = f"must be left out, because the table has columns of {key} for all"
        require(not whole, (key,), getattr(scenario, key), right)
    kinds = scenario.vehicle_types or {}
    for key in set(QUANTITY.of_a_type) - set(QUANTITY.usual):
        silent = [name for name, kind in kinds.items() if getattr(kind, key) is None]
        is_set = getattr(scenario, key) is not None
        right = undeclared_by_type(key, "".join(silent[:1]))
        require(is_set or len(silent) in (0, len(kinds)), (key,), UNSHOWN, right)
        right = f"must be left out, because every vehicle type declares {key}"
        require(not (is_set and kinds) or len(silent) > 0, (key,), UNSHOWN, right)
    for usual, other in QUANTITY.alternatives.items():
        present = [key for key in (usual, other) if getattr(scenario, key) is not None]
        columns = [column.name for (key, _), column in scenario.table_entries.items() if key == usual]
        right = f"the table has the columns {', '.join(columns)}; for the other entries use {usual}, not {other}"
        require(not (columns and other in present), (other,), getattr(scenario, other), right)
        present += [usual] * (usual not in present and scenario.declares(usual))
        if not present and usual not in QUANTITY.optional:
            raise PydanticCustomError("missing", "missing", {"at": (usual,)})
        right = f"give either {usual} or {other}, not both"
        require(len(present) < 2, (other,), getattr(scenario, other), right)
    horizon = f"horizon_s ({scenario.horizon_s:g} s)"
    in_time = scenario.time_step_s <= scenario.horizon_s
    require(in_time, ("time_step_s",), scenario.time_step_s, f"must not be above {horizon}")
    for i, latencies in enumerate(scenario.possible_quantities("latency_s")):
        for kind, latency in latencies.items():
            right = f"must be below {horizon}, otherwise the vehicle can never act"
            acts = support(latency)[1] < scenario.horizon_s
            require(acts, _path(scenario, "latency_s", i, kind), latency, right)
    if scenario.declares("harm_weight"):
        right = f"may be 0 in all vehicles; at least one vehicle must always have a weight of {LEAST_WEIGHT:g} or more"
        weighs = any(low >= LEAST_WEIGHT for low, _ in scenario.bounds("harm_weight"))
        require(weighs, ("harm_weight",), scenario.harm_weight, right)
    _check_reactions(scenario)
    _check_speeds(scenario)
    _check_derived(scenario)
    _check_scripts(scenario)


def _check_reactions(scenario: ScenarioFields) -> None:
    """Raise an error unless every vehicle can act before the horizon even with the largest delay of its news."""
    for name in scenario.v2x.vehicles or ():
        right = f"unknown vehicle; this scenario has vehicle_1 ... vehicle_{scenario.vehicles}"
        require(name in scenario.vehicle_names, ("v2x", "vehicles", name), UNSHOWN, right)
    tells = scenario.v2x.channel.tells
    for name in tells if isinstance(tells, Mapping) else ():
        right = f"unknown vehicle; this scenario has vehicle_1 ... vehicle_{scenario.vehicles}"
        require(name in scenario.vehicle_names, ("v2x", "tells", name), UNSHOWN, right)
        equipped = (scenario.v2x.vehicles or {}).get(name)
        right = f"has no effect, because {name} sends no messages (v2x.vehicles); leave it out"
        require(equipped is None or equipped.sends, ("v2x", "tells", name), UNSHOWN, right)
    kinds = {name: kind.v2x for name, kind in (scenario.vehicle_types or {}).items() if kind.v2x is not None}
    right = f"has no effect, because v2x: {scenario.v2x.preset} generates no messages; use another v2x, such as nominal"
    for name, equipage in kinds.items():
        sent = scenario.v2x.channel.timing != "latency" and scenario.v2x.channel.hears != "none"
        require(sent, ("vehicle_types", name, "v2x"), equipage, right)
    right = "works only with v2x: paper, because messages before the alert are not modelled"
    require(scenario.alert_s is None or not scenario.v2x.delays, ("alert_s",), scenario.alert_s, right)
    own = np.array([latest for _, latest in scenario.bounds("latency_s")])
    right = (
        f"the sum of alert_s and latency_s may be {own.max():g} s; it must be below horizon_s"
        f" ({scenario.horizon_s:g} s), or the vehicle cannot act; reduce the sum or raise horizon_s"
    )
    require(scenario.alert_s is None or own.max() < scenario.horizon_s, ("alert_s",), scenario.alert_s, right)
    for i, latest in enumerate(scenario.v2x.latest_reaction_s(own, scenario.equipped())):
        right = (
            f"vehicle_{i + 1} may get its first news as late as {latest:g} s; this time must be below horizon_s"
            f" ({scenario.horizon_s:g} s); use a faster channel or raise horizon_s"
        )
        require(bool(latest < scenario.horizon_s), ("v2x",), scenario.v2x, right)
    samples = scenario.v2x.channel.samples(scenario.time_step_s)
    right = (
        f"a message takes {samples - 3} time steps; at most {MOST_SAMPLES - 3} are possible, so shorten the delay of"
        " messages or lengthen time_step_s"
    )
    require(samples <= MOST_SAMPLES, ("v2x",), scenario.v2x, right)


def _check_speeds(scenario: ScenarioFields) -> None:
    limits = scenario.possible_quantities("speed_limit_mps")
    for i, (low, high) in enumerate(scenario.bounds("speeds_mps")):
        lowest = min(limits[i].values(), key=lambda quantity: support(quantity)[0])
        if low >= 0.0 and high <= support(lowest)[0]:
            continue
        limit = f"speed_limit_mps of vehicle_{i + 1}, {flow_text(lowest)} m/s"
        if scenario.line_speed_mps is None:
            speed = scenario.quantities("speeds_mps")[i]
            refuse(_path(scenario, "speeds_mps", i), speed, f"must not be above {limit}")
        drives = f"vehicle_{i + 1} has a speed of {low:g}" + ("" if low == high else f" to {high:g}")
        deviates = "with speed_deviations_mps " if "speed_deviations_mps" in scenario.model_fields_set else ""
        right = f"{deviates}{drives} m/s; the speed must be from 0 to {limit}"
        refuse(("line_speed_mps",), scenario.line_speed_mps, right)


def _check_derived(scenario: ScenarioFields) -> None:
    """Raise an error if a gap (computed from a time gap) or obstacle distance (from a margin) is too large."""
    largest = QUANTITY.usual["gaps_m"].high
    for pair, (_, high) in enumerate(scenario.bounds("gaps_m") if scenario.time_gaps_s is not None else ()):
        right = f"gives gaps up to {high:g} m at the speed of vehicle_{pair + 2}; a gap must not be above {largest:g} m"
        require(high <= largest, _path(scenario, "time_gaps_s", pair), scenario.quantities("time_gaps_s")[pair], right)
    largest = QUANTITY.optional["obstacle_gap_m"].high
    if scenario.obstacle_margin_m is not None:
        farthest = scenario.farthest_obstacle_m
        right = (
            f"puts the obstacle up to {farthest:g} m ahead of vehicle_1; that distance must not be above {largest:g} m"
        )
        require(farthest <= largest, ("obstacle_margin_m",), scenario.obstacle_margin_m, right)


def _check_scripts(scenario: ScenarioFields) -> None:
    """Raise an error if a script exceeds the capacity of its vehicle, or if vehicle_1 learns without an obstacle ahead.

    Also raise an error if the scenario rejects early impacts (impacts before the first learner can act) and a script
    depends on the state.
    """
    for i, script in scenario.scripts.items():
        deceleration = ScriptSpec.parse(script).hardest_mps2 or 0.0
        field = "braking_capacity_mps2" if deceleration > 0.0 else "driving_capacity_mps2"
        capacity = scenario.bounds(field)[i][0]
        right = f"must not be above the {field} of vehicle_{i + 1}, {capacity:g} m/s2"
        require(abs(deceleration) <= capacity, ("roles", f"vehicle_{i + 1}"), script, right)
    right = "vehicle_1 can learn only with an obstacle ahead; add one, for instance obstacle_gap_m: 42"
    require(0 not in scenario.learners or scenario.has_obstacle, ("roles", "vehicle_1"), LEARNER, right)
    for i, script in scenario.scripts.items() if scenario.early_impacts == "reject" and scenario.learners else ():
        spec = ScriptSpec.parse(script)
        close = get_close_matches(spec.name, ("full_brake", "coast", "constant"), n=1)
        hint = f"; did you mean {close[0]}?" if close else ""
        right = f"with early_impacts: reject, a script must be full_brake, coast, constant:a or a profile{hint}"
        require(spec.is_state_free(), ("roles", f"vehicle_{i + 1}"), script, right)


def _path(scenario: ScenarioFields, field: str, index: int, kind: int = 0) -> YamlPath:
    line = scenario.types_of_line
    if line is not None and field in QUANTITY.of_a_type and getattr(line.kinds[kind], field) is not None:
        return ("vehicle_types", line.names[kind], field)
    return (field, index) if isinstance(getattr(scenario, field), tuple) else (field,)
