"""What a world's quantities are: those that are declared, and those that follow from them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from ethbrake_marl.motion.forces import stopping_distances
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.worlds.rules import OPTIONAL, USUAL

if TYPE_CHECKING:
    from ethbrake_marl.worlds.scenario import Scenario

GRAVITY_MPS2 = 9.81

Values = dict[str, Floats]  # key of a quantity -> values in k worlds, [k, vehicles, pairs or 1]


def world_values(
    scenario: Scenario,
    declared: Callable[[str], Floats],
    settle: Callable[[str, Floats], Floats] = lambda _, values: values,
) -> Values:
    """Return all quantities of k worlds except the distance of the obstacle, from the declared ones.

    ``speed = line speed + own deviation``, ``gap = time gap x speed of the rear vehicle`` and ``latency = own latency +
    time of the alert`` grow with what is declared: bounds of the declared quantities give bounds of these. Friction
    limits capacities to friction x gravity. ``settle`` may replace the values of a key, before others follow from it.
    """
    keys = [key for key in (*USUAL, *OPTIONAL) if key != "obstacle_gap_m" and scenario.declares(key)]
    values = {key: declared(key) for key in keys}
    if scenario.alert_s is not None:
        values["latency_s"] = values["latency_s"] + declared("alert_s")
    if scenario.line_speed_mps is not None:
        values["speeds_mps"] = declared("line_speed_mps") + declared("speed_deviations_mps")
    values = {key: settle(key, drawn) for key, drawn in values.items()}
    if scenario.time_gaps_s is not None:
        values["gaps_m"] = settle("gaps_m", declared("time_gaps_s") * values["speeds_mps"][:, 1:])
    if "friction" in values:
        for key in ("braking_capacity_mps2", "driving_capacity_mps2"):
            values[key] = np.minimum(values[key], values["friction"] * GRAVITY_MPS2)
    return values


def obstacle_gap(scenario: Scenario, values: Values, declared: Callable[[str], Floats]) -> Floats:
    """Return the distance from Vehicle 1 to the obstacle, [k, 1] m, in a scenario with an obstacle.

    It is declared, or ``margin + v_1 tau_1 + v_1^2 / (2 a_1)``: the margin is what is left if Vehicle 1 brakes fully
    (longer while its brakes build up: ``motion.forces.stopping_m``).
    """
    if scenario.declares("obstacle_gap_m"):
        return declared("obstacle_gap_m")
    speed, latency, capacity = (values[key][:, 0] for key in ("speeds_mps", "latency_s", "braking_capacity_mps2"))
    rate = values["brake_rate_mps3"][:, 0] if "brake_rate_mps3" in values else np.full(len(speed), np.inf)
    stop = stopping_distances(*np.broadcast_arrays(speed, latency, capacity, rate))
    return declared("obstacle_margin_m") + stop[:, np.newaxis]
