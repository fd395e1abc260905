"""Measures that the user registered: how evaluations load them, and their columns and headings in tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from ethbrake_marl.files.python_file import load_from_file
from ethbrake_marl.first_edition.game.impacts import EpisodeImpacts
from ethbrake_marl.first_edition.game.measures import MEASURES, REPORTED, NamedMeasure, register_measure
from ethbrake_marl.registry import Part

LOADED: dict[str, None] = {}  # all names that ``load_measures`` has loaded so far, in order


def load_measures(names: Iterable[str]) -> None:
    """Load measures by name. All later evaluations of this process report these measures.

    A name is ``risk``, ``injury``, the name of a measure of an installed package, or ``FILE:NAME``. For
    ``my_file.py:measure``, the Python file is run with your permissions; ``measure`` must be a function, or a ``Part``
    (a function together with settings for ``register_measure``). Raises ``UnknownName`` for an unknown name, and
    ``InvalidInput`` for a measure that cannot be loaded.
    """
    for name in names:
        file, colon, own = name.rpartition(":")
        if colon:
            part = load_from_file(file, own)
            arguments, settings = (part.given, part.settings) if isinstance(part, Part) else ((part,), {})
            register_measure(own, *arguments, **settings)
        else:
            REPORTED.update({each: MEASURES[each] for each in MEASURES.load(name)})
        LOADED[name] = None


def heading_of(column: str) -> str:
    measure = registered_measure(column)
    if measure is None:  # the measure was registered in another process
        return column
    vehicle = column.removeprefix(measure.name).removeprefix("_")
    return f"{measure.name}{f', vehicle {vehicle}' if vehicle else ''} ({measure.unit})"


def registered_measure(column: str) -> NamedMeasure | None:
    return REPORTED.get(column) or REPORTED.get(column.rpartition("_")[0])


def measure_columns(terms: Mapping[str, Any], episodes: EpisodeImpacts | None) -> dict[str, Any]:
    """Return the values of every registered measure: name of a column -> values [n].

    A measure with one value per vehicle has the columns ``NAME_1``, ``NAME_2`` and so on. ``terms`` maps each measure
    that is computed at each step to its sum over each episode, [n] or [n, N]. The other measures are computed from the
    impacts ``episodes`` (None if there are no other measures).
    """
    columns: dict[str, Any] = {}
    for name, measure in REPORTED.items():
        values = terms[name] if episodes is None or measure.by == "step" else measure.of(episodes)
        if values.ndim == 1:
            columns[name] = values
        else:
            columns |= {f"{name}_{i + 1}": column.copy() for i, column in enumerate(values.T)}
    return columns
