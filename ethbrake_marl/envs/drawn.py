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
from ethbrake_marl.physics import Ints, Worlds
from ethbrake_marl.scenario import Sample
from ethbrake_marl.scenario.sample import join_samples, kind_columns, quantity_columns

_MOST_APART = 1024  # numbers between two worlds that are still drawn in one go

Columns = dict[str, NDArray[Any]]


def describe_worlds(engine: Engine) -> Columns:
    """What each running world was drawn as: column -> values [n].

    Quantities of the world at the alert, named as in a table of initial states (``gap_1_m``, ``mass_2_t``); where there
    is such, ``scenario`` of a mixture and ``vehicle_2_type``; and ``world_seed`` and ``world`` as in the infos. Raises
    ``InvalidInput`` for worlds of which nobody knows: after a snapshot was restored, or where a world could not be
    advanced to its first decision and another one stands in its place.
    """
    numbers, given = engine.roster.numbers, engine.roster.given
    named = {"world_seed": np.full(engine.n, engine.roster.seed), "world": numbers.copy()}
    if (numbers < 0).all() and given is not None:
        return {**quantity_columns(given), **named}
    if (numbers < 0).any():
        return _describe_mixed(engine, named)
    sample = _drawn_again(engine, numbers)
    _check_same(engine, sample.worlds)
    return {**kind_columns(sample.types, sample.scenarios), **quantity_columns(sample.worlds), **named}


def describe_world(engine: Engine) -> dict[str, Any]:
    """The same of the only world, as plain numbers and texts."""
    return {name: column[0].item() for name, column in describe_worlds(engine).items()}


def _describe_mixed(engine: Engine, named: Columns) -> Columns:
    """Of a batch in which some worlds were given, and others have taken their places since; types are of these only."""
    numbers, given = engine.roster.numbers, engine.roster.given
    if given is None:
        raise InvalidInput(
            "describe_worlds: these episodes go on from a snapshot, which does not keep what they were drawn as; ask"
            " again once they have ended, or after a reset"
        )
    own = numbers < 0
    found: Columns = {}
    renewed = _drawn_again(engine, numbers[~own])
    _check_same(engine, renewed.worlds, np.flatnonzero(~own))
    drawn = {**kind_columns(renewed.types, renewed.scenarios), **quantity_columns(renewed.worlds)}
    started = quantity_columns(given.take(own))
    for name, column in drawn.items():
        found[name] = np.zeros(engine.n, column.dtype)
        found[name][~own] = column
        if name in started:
            found[name][own] = started[name]
    return {**found, **named}


def _drawn_again(engine: Engine, numbers: Ints) -> Sample:
    """These worlds of the training stream, in the order of ``numbers``."""
    ordered, places = np.unique(numbers, return_inverse=True)
    breaks = np.flatnonzero(np.diff(ordered) > _MOST_APART) + 1
    parts = []
    for run in np.split(ordered, breaks):
        first = int(run[0])
        span = engine.scenario.sample(int(run[-1]) - first + 1, engine.roster.seed, first=first, channel="training")
        parts.append(span.take(run - first))
    return join_samples(parts, 0).take(places)


def _check_same(engine: Engine, drawn: Worlds, rows: Ints | None = None) -> None:
    """Refuse worlds that do not stand in the engine."""
    running = engine.worlds.vehicles if rows is None else engine.worlds.vehicles.take(rows)
    same = np.ones(drawn.n, np.bool_)
    for name in ("mass_t", "braking_capacity_mps2", "driving_capacity_mps2", "latency_s"):
        same &= (getattr(running, name) == getattr(drawn.vehicles, name)).all(axis=1)
    if not same.all():
        k = int(np.argmin(same)) if rows is None else int(rows[np.argmin(same)])
        raise InvalidInput(
            f"describe_worlds: world {engine.roster.numbers[k]} of seed {engine.roster.seed} could not be advanced to"
            f" its first decision; another one stands in row {k}"
        )
