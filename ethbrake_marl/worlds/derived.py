"""What a world's quantities are: those that are declared, and those that follow from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from ethbrake_marl.motion.forces import stopping_distances
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.worlds.rules import USUAL

if TYPE_CHECKING:
    from ethbrake_marl.worlds.scenario import Scenario

GRAVITY_MPS2 = 9.81

Values = dict[str, Floats]  # key of a quantity -> values in k worlds, [k, vehicles, pairs or 1]

_INDEPENDENT = ("friction", "brake_rate_mps3", "release_rate_mps3", "harm_weight")


def world_values(scenario: Scenario, declared: Callable[[str], Floats]) -> Values:
    """Return all quantities of k worlds except the distance of the obstacle, from the declared ones.

    ``speed = line speed + own deviation``, ``gap = time gap x speed of the rear vehicle`` and ``latency = own latency +
    time of the alert`` grow with what is declared: bounds of the declared quantities give bounds of these.
    """
    replaced = {"gaps_m": scenario.time_gaps_s, "speeds_mps": scenario.line_speed_mps}
    values = {key: declared(key) for key in USUAL if replaced.get(key) is None}
    values |= {key: declared(key) for key in _INDEPENDENT if scenario.declares(key)}
    if scenario.alert_s is not None:
        values["latency_s"] = values["latency_s"] + declared("alert_s")
    if scenario.line_speed_mps is not None:
        values["speeds_mps"] = declared("line_speed_mps") + declared("speed_deviations_mps")
    if scenario.time_gaps_s is not None:
        values["gaps_m"] = declared("time_gaps_s") * values["speeds_mps"][:, 1:]
    return values


def on_road(values: Mapping[str, Floats]) -> Values:
    """Return the quantities with capacities of at most friction x gravity, if there is a friction."""
    limited = dict(values)
    if "friction" in values:
        for key in ("braking_capacity_mps2", "driving_capacity_mps2"):
            limited[key] = np.minimum(values[key], values["friction"] * GRAVITY_MPS2)
    return limited


def obstacle_gap(scenario: Scenario, values: Mapping[str, Floats], declared: Callable[[str], Floats]) -> Floats | None:
    """Return the distance from Vehicle 1 to the obstacle, [k, 1] m; None without an obstacle.

    It is declared, or ``margin + v_1 tau_1 + v_1^2 / (2 a_1)``: the margin is what is left if Vehicle 1 brakes fully
    (longer while its brakes build up: ``motion.forces.stopping_m``). ``values`` are those on this road.
    """
    if scenario.declares("obstacle_gap_m"):
        return declared("obstacle_gap_m")
    if scenario.obstacle_margin_m is None:
        return None
    speed, latency, capacity = (values[key][:, 0] for key in ("speeds_mps", "latency_s", "braking_capacity_mps2"))
    rate = values["brake_rate_mps3"][:, 0] if "brake_rate_mps3" in values else np.full(len(speed), np.inf)
    stop = stopping_distances(*np.broadcast_arrays(speed, latency, capacity, rate))
    return declared("obstacle_margin_m") + stop[:, np.newaxis]
