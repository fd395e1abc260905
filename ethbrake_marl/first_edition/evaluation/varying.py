"""Initial states of worlds as rows of a table, and the quantities that differ between worlds."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.first_edition.physics.state import Floats, Worlds
from ethbrake_marl.first_edition.scenario.fields import QUANTITY
from ethbrake_marl.first_edition.scenario.schema import Scenario


def states_of(worlds: Worlds, scenario: Scenario) -> list[dict[str, float | None]]:
    """Return the initial state of each world by column, such as ``{"gap_1_m": 6.6, "speed_1_mps": 19.0}``.

    The columns are all gaps and speeds, and every other quantity that the scenario does not fix. In a world without an
    obstacle, the distance to the obstacle is None.
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


_LONGEST_OWNERS = 30  # longest text of vehicle or pair names, in characters


def drawn_alike(worlds: Worlds, scenario: Scenario) -> dict[str, dict[str, Floats]]:
    """Return the values of every quantity that differs between worlds.

    The vehicles (or pairs) for which the scenario declares the same smallest and largest value form a group. The result
    maps the key of a quantity to a dictionary: name of a group -> values [n, number of vehicles or pairs], for instance
    ``{"gaps_m": {"": values}, "mass_t": {"vehicle_2": values}}``. The name of a group lists its vehicles; it is "" if
    the group contains all vehicles (or pairs). Worlds that lack a quantity, such as the gap to an obstacle, are omitted
    from its values.
    """
    of_quantities: dict[str, dict[str, Floats]] = {}
    for key, rule in QUANTITY.of(worlds).items():
        values, groups = rule.of(worlds), dict[object, list[int]]()
        values = values[~np.isnan(values).any(axis=1)]
        for i in np.flatnonzero(np.ptp(values, axis=0)).tolist():
            groups.setdefault(None if rule.per == "world" else scenario.bounds(key, dry=True)[i], []).append(i)
        for number, alike in enumerate(groups.values()):
            names = ", ".join(map(rule.owner, alike))
            few = names if len(names) <= _LONGEST_OWNERS else f"{len(alike)} {rule.per}s"
            of_key = of_quantities.setdefault(key, {})
            few += f" ({number + 1})" if few in of_key else ""
            of_key["" if len(alike) == values.shape[1] else few] = values[:, alike]
    return of_quantities
