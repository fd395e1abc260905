"""Quantities of worlds that follow from those declared in a scenario, and checks of all quantities."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from ethbrake_marl.motion.forces import stopping_distances
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.worlds.quantities import OPTIONAL, USUAL
from ethbrake_marl.worlds.roles import deceleration_of

if TYPE_CHECKING:
    from ethbrake_marl.worlds.scenario import Scenario

GRAVITY_MPS2 = 9.81

QuantityValues = dict[str, Floats]  # key of a quantity -> values in k worlds, [k, vehicles, pairs or 1]


def world_values(
    scenario: Scenario,
    declared: Callable[[str], Floats],
    settle: Callable[[str, Floats], Floats] = lambda _, values: values,
) -> QuantityValues:
    """All quantities of k worlds except the distance of the obstacle: key -> [k, entries].

    There is an entry for each vehicle or pair, or one for the world. ``declared(key)`` returns the drawn values of a
    declared quantity, [k, entries]. Other quantities follow: ``speed = line speed + own deviation``, ``latency = own
    latency + time of the alert``, ``gap = time gap x speed of the rear vehicle``. Friction limits capacities to
    friction x grip x gravity. ``settle(key, values)`` may replace the values of a quantity before they enter gaps and
    limits. No result decreases if a declared quantity increases, so bounds of declared quantities give bounds of the
    results.
    """
    keys = [key for key in (*USUAL, *OPTIONAL) if key != "obstacle_gap_m" and key in scenario.sources]
    values = {key: declared(key) for key in keys}
    if scenario.alert_s is not None:
        values["latency_s"] = values["latency_s"] + declared("alert_s")
    if scenario.line_speed_mps is not None:
        values["speeds_mps"] = declared("line_speed_mps") + declared("speed_deviations_mps")
    values = {key: settle(key, quantity_values) for key, quantity_values in values.items()}
    if scenario.time_gaps_s is not None:
        values["gaps_m"] = settle("gaps_m", declared("time_gaps_s") * values["speeds_mps"][:, 1:])
    if "friction" in values:
        limit = values["friction"] * GRAVITY_MPS2 * values.get("grip", np.ones(1))
        for key in ("braking_capacity_mps2", "driving_capacity_mps2"):
            values[key] = np.minimum(values[key], limit)
    return values


def obstacle_gap(scenario: Scenario, values: QuantityValues, declared: Callable[[str], Floats]) -> Floats:
    """Distance from Vehicle 1 to the obstacle, [k, 1] m, in k worlds of a scenario with an obstacle.

    With a margin the distance is ``margin + v_1 tau_1 + v_1^2 / (2 a_1)``, with speed v_1, latency tau_1 and braking
    capacity a_1 of Vehicle 1. It is longer if brakes build up (``motion.forces.stopping_m``).
    """
    if "obstacle_gap_m" in scenario.sources:
        return declared("obstacle_gap_m")
    speed, latency, capacity = (values[key][:, 0] for key in ("speeds_mps", "latency_s", "braking_capacity_mps2"))
    rate = values["brake_rate_mps3"][:, 0] if "brake_rate_mps3" in values else np.full(len(speed), np.inf)
    stop = stopping_distances(*np.broadcast_arrays(speed, latency, capacity, rate))
    return declared("obstacle_margin_m") + stop[:, np.newaxis]


def mistakes(scenario: Scenario, low: QuantityValues, high: QuantityValues) -> Iterator[tuple[str, int, int, str]]:
    """Contradictions in k worlds whose quantities lie between ``low`` and ``high`` (key -> [k, entries] each).

    Each contradiction consists of the quantity's key (``v2x`` if messages are the reason), the vehicle's index from 0,
    the first world with the contradiction (row of ``low``), and what would be right.
    """

    def first(holds: Any) -> Any:
        return np.flatnonzero(~holds)[:1].tolist()

    latest = scenario.v2x.latest_reaction_s(high["latency_s"], scenario.unheard())
    for i, (name, role) in enumerate(scenario.roles.items()):
        slow, fast, limit = low["speeds_mps"][:, i], high["speeds_mps"][:, i], low["speed_limit_mps"][:, i]
        for row in first((slow >= 0.0) & (fast <= limit)):
            speed = f"{slow[row]:g}" if slow[row] == fast[row] else f"{slow[row]:g} to {fast[row]:g}"
            right = f"its speed must be from 0 to its speed_limit_mps, {limit[row]:g} m/s"
            yield "speeds_mps", i, row, f"{name} has a speed of {speed} m/s; {right}"
        for row in first(latest[:, i] < scenario.horizon_s):
            key = "v2x" if latest[row, i] > high["latency_s"][row, i] else "latency_s"
            right = f"this time must be below horizon_s ({scenario.horizon_s:g} s)"
            yield key, i, row, f"{name} may not be able to act until {latest[row, i]:g} s; {right}"
        deceleration = deceleration_of(role) or 0.0
        key = "braking_capacity_mps2" if deceleration > 0.0 else "driving_capacity_mps2"
        for row in first(low[key][:, i] >= abs(deceleration)):
            right = f"must be at least {abs(deceleration):g} m/s2 on the road, because roles.{name} = {role}"
            yield key, i, row, right
