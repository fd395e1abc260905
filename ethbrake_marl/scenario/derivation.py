"""From what a scenario declares to what a world has: speeds from the speed of the line, gaps from time gaps."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

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
