"""The draws behind the worlds of an environment: every quantity at the alert, type and scenario, as flat columns.

Worlds are pure functions of scenario, seed and number, so nothing is kept while episodes run: it costs nothing until
somebody asks, and then the worlds are drawn again.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics.state import Ints
from ethbrake_marl.scenario.fields import QUANTITY
from ethbrake_marl.scenario.sample import Sample
from ethbrake_marl.scenario.schema import as_scenario

_MOST_APART = 1024  # numbers between two worlds that are still drawn in one go

Columns = dict[str, NDArray[Any]]


def describe_worlds(engine: Engine) -> Columns:
    """What each running world was drawn as: column -> values [n].

    Quantities of the world at the alert, named as in a table of initial states (``gap_1_m``, ``mass_2_t``); where there
    is such, ``scenario`` of a mixture and ``vehicle_2_type``; and ``world_seed`` and ``world`` as in the infos. Where
    worlds were given and others have taken the places of some since, types are of these only. Raises ``InvalidInput``
    for worlds of which nobody knows: given ones after a snapshot was restored, or one that could not be advanced to its
    first decision, where another one stands in its place.
    """
    numbers, given = engine.roster.numbers, engine.roster.given
    named = {"world_seed": np.full(engine.n, engine.roster.seed), "world": numbers.copy()}
    own, found = numbers < 0, dict[str, NDArray[Any]]()
    if own.any():
        if given is None:
            raise InvalidInput(
                "describe_worlds: these episodes go on from a snapshot, which does not keep worlds that were given;"
                " ask again once they have ended, or after a reset"
            )
        found = QUANTITY.columns(given)
    if not own.all():
        sample = _drawn_again(engine, numbers[~own])
        drawn, started = {**sample.kinds, **QUANTITY.columns(sample.worlds)}, found
        found = {name: np.zeros(engine.n, column.dtype) for name, column in drawn.items()}
        for name, column in drawn.items():
            found[name][~own] = column
            if name in started:
                found[name][own] = started[name][own]
    return {**found, **named}


def _drawn_again(engine: Engine, numbers: Ints) -> Sample:
    """These worlds of the training stream, in the order of ``numbers``; ``InvalidInput`` if they do not run here."""
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
            f"describe_worlds: world {engine.roster.numbers[k]} of seed {engine.roster.seed} could not be advanced to"
            f" its first decision; another one stands in row {k}"
        )
    return sample
