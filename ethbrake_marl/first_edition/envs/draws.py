"""Columns that describe what was drawn at random for each world: initial states, vehicle types and scenarios.

The scenario, the seed and the number of a world determine the world completely. Therefore a world is not stored but
drawn again on request.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.physics.state import Ints
from ethbrake_marl.first_edition.scenario.fields import QUANTITY
from ethbrake_marl.first_edition.scenario.sample import Sample
from ethbrake_marl.first_edition.scenario.schema import as_scenario

_MOST_APART = 1024  # largest distance between the numbers of two worlds that are drawn in one call

Columns = dict[str, NDArray[Any]]


def describe_worlds(engine: Engine) -> Columns:
    """Return what was drawn for each running world, as columns such as ``{"gap_1_m": [n], "mass_2_t": [n]}``.

    There is one column for each quantity of a world at the alert, with the same name as in a table of initial states.
    If the scenario is a mixture, the column ``scenario`` names the drawn scenario; if the scenario has vehicle types,
    columns such as ``vehicle_2_type`` name the drawn types. The columns ``world_seed`` and ``world`` are the infos with
    these names.

    Raises ``InvalidInput`` if the caller passed the worlds and the environment was later restored from a snapshot,
    because a snapshot does not contain these worlds. Also raises ``InvalidInput`` if the physics failed in a drawn
    world before its first decision, so that another world replaced the drawn world.
    """
    numbers, placed = engine.roster.numbers, engine.roster.given
    named = {"world_seed": np.full(engine.n, engine.roster.seed), "world": numbers.copy()}
    own, columns = numbers < 0, dict[str, NDArray[Any]]()
    if own.any():
        if placed is None:
            raise InvalidInput(
                "describe_worlds: the initial states of these worlds are not known, because the environment was"
                " restored from a snapshot; call describe_worlds after these episodes have ended, or after a reset"
            )
        columns = QUANTITY.columns(placed)
    if not own.all():
        sample = _drawn_again(engine, numbers[~own])
        drawn, started = {**sample.kinds, **QUANTITY.columns(sample.worlds)}, columns
        columns = {name: np.zeros(engine.n, column.dtype) for name, column in drawn.items()}
        for name, column in drawn.items():
            columns[name][~own] = column
            if name in started:
                columns[name][own] = started[name][own]
    return {**columns, **named}


def _drawn_again(engine: Engine, numbers: Ints) -> Sample:
    """Draw again the worlds that have the ``numbers`` in the training stream; return them in this order.

    Raises ``InvalidInput`` if a drawn world differs from the running world (see ``describe_worlds``).
    """
    ordered, places = np.unique(numbers, return_inverse=True)
    breaks = np.flatnonzero(np.diff(ordered) > _MOST_APART) + 1
    parts, scenario = [], as_scenario(engine.scenario)
    for run in np.split(ordered, breaks):
        first = int(run[0])
        span = scenario.sample(int(run[-1]) - first + 1, engine.roster.seed, first=first, channel="training")
        parts.append(span.take(run - first))
    sample = Sample.join(parts, 0).take(places)
    rows = np.flatnonzero(engine.roster.numbers >= 0)
    running, drawn = engine.worlds.vehicles.take(rows), sample.worlds.vehicles
    same = np.ones(len(rows), np.bool_)
    rates = ("brake_rate_mps3", "release_rate_mps3")
    for name in ("mass_t", "braking_capacity_mps2", "driving_capacity_mps2", "latency_s", *rates):
        same &= (getattr(running, name) == getattr(drawn, name)).all(axis=1)
    if not same.all():
        k = int(rows[np.argmin(same)])
        raise InvalidInput(
            f"describe_worlds: the random draw of row {k} is unknown: the physics failed in world"
            f" {engine.roster.numbers[k]} of seed {engine.roster.seed} before its first decision, so another world"
            " replaced this world; call reset"
        )
    return sample
