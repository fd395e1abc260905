"""Differences between the worlds of a list: their initial states, and the quantities that vary."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.physics.state import Floats, Worlds
from ethbrake_marl.scenario.fields import QUANTITY
from ethbrake_marl.scenario.schema import Scenario


def states_of(worlds: Worlds, scenario: Scenario) -> list[dict[str, float | None]]:
    """Return the initial state of each world: gaps, speeds, and all columns that the scenario does not fix.

    The distance to an obstacle is None in worlds without one.
    """
    fixed = {
        rule.column_of(i)
        for key, rule in QUANTITY.usual.items()
        for i, (low, high) in enumerate(scenario.bounds(key, dry=bool(np.isfinite(worlds.friction).all())))
        if low == high
    }
    columns = {
        name: values
        for name, values in QUANTITY.columns(worlds).items()
        if name not in fixed or (name.startswith(("gap_", "speed_")) and not name.startswith("speed_limit"))
    }
    return [
        {name: None if np.isnan(values[k]) else float(values[k]) for name, values in columns.items()}
        for k in range(worlds.n)
    ]


_LONGEST_OWNERS = 30  # longest list of vehicle or pair names, in characters


def drawn_alike(worlds: Worlds, scenario: Scenario) -> dict[str, dict[str, Floats]]:
    """Return every quantity that varies between the worlds, by key, in groups with the same bounds.

    Each group maps a short name of its vehicles or pairs, or "" if it contains all of them, to its values [n, entries].
    """
    found: dict[str, dict[str, Floats]] = {}
    for key, rule in QUANTITY.of(worlds).items():
        values, groups = rule.of(worlds), dict[object, list[int]]()
        values = values[~np.isnan(values).any(axis=1)]
        for i in np.flatnonzero(np.ptp(values, axis=0)).tolist():
            groups.setdefault(None if rule.per == "world" else scenario.bounds(key, dry=True)[i], []).append(i)
        for number, alike in enumerate(groups.values()):
            names = ", ".join(map(rule.owner, alike))
            few = names if len(names) <= _LONGEST_OWNERS else f"{len(alike)} {rule.per}s"
            of_key = found.setdefault(key, {})
            few += f" ({number + 1})" if few in of_key else ""
            of_key["" if len(alike) == values.shape[1] else few] = values[:, alike]
    return found
