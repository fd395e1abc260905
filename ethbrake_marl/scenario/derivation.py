"""From what a scenario declares to what a world has.

Speeds from the speed of the line, gaps from time gaps, the distance to an obstacle from its margin.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from ethbrake_marl.physics.events import stopping_distances
from ethbrake_marl.physics.worlds import Floats
from ethbrake_marl.scenario.distributions import support, values
from ethbrake_marl.scenario.quantities import DECLARED, QUANTITIES

if TYPE_CHECKING:
    from ethbrake_marl.scenario.schema import Scenario


def world_quantities(scenario: Scenario, declared: Callable[[str], Floats]) -> dict[str, Floats]:
    """Every quantity of k worlds, each [k, entries], from what ``declared(key)`` gives for the keys in use.

    ``speed = line speed + own deviation`` and ``gap = time gap x speed of the rear vehicle of the pair``. Both only
    grow with what they are made of, so the bounds of what is declared give the bounds of what the worlds have.
    """
    found = {key: declared(key) for key in QUANTITIES if getattr(scenario, key) is not None}
    if scenario.line_speed_mps is not None:
        found["speeds_mps"] = declared("line_speed_mps") + declared("speed_deviations_mps")
    if scenario.time_gaps_s is not None:
        found["gaps_m"] = declared("time_gaps_s") * found["speeds_mps"][:, 1:]
    return {key: found[key] for key in QUANTITIES}


def hazard_gap(scenario: Scenario, found: Mapping[str, Floats], declared: Callable[[str], Floats]) -> Floats | None:
    """Distance from Vehicle 1 to the obstacle ahead, [k], of worlds with the quantities ``found``; None without one.

    As declared, or ``margin + v_1 tau_1 + v_1^2 / (2 a_1)``: so far beyond where Vehicle 1 stops by itself.
    """
    if scenario.hazard_gap_m is not None:
        return declared("hazard_gap_m")
    if scenario.hazard_margin_m is None:
        return None
    speed, latency, capacity = (found[key][:, 0] for key in ("speeds_mps", "latency_s", "braking_capacity_mps2"))
    return declared("hazard_margin_m") + stopping_distances(speed, latency, capacity)


def farthest_hazard_m(scenario: Scenario) -> float:
    """Upper bound of the distance to an obstacle that is declared by its margin."""
    low, high = ({key: bounds[[row]] for key, bounds in quantity_bounds(scenario).items()} for row in (0, 1))
    slowest = high | {"braking_capacity_mps2": low["braking_capacity_mps2"]}
    farthest = hazard_gap(scenario, slowest, lambda key: np.array([support(scenario.quantities(key)[0])[1]]))
    assert farthest is not None
    return float(farthest[0])


def drawn_quantities(scenario: Scenario, u: Floats) -> dict[str, Floats]:
    """Every quantity of n worlds, each [n, entries], from their uniform numbers ``u`` [n, width]."""

    def drawn(key: str) -> Floats:
        entries, rule = scenario.quantities(key), DECLARED[key]
        found = np.empty((len(u), len(entries)))
        for i, entry in enumerate(entries):
            found[:, i] = values(entry, u[:, rule.place(i)])
        return found

    return world_quantities(scenario, drawn)


def quantity_bounds(scenario: Scenario) -> dict[str, Floats]:
    """Smallest and largest value of every entry of every quantity of a world: each [2, entries]."""
    return world_quantities(scenario, lambda key: np.array([support(q) for q in scenario.quantities(key)]).T)
