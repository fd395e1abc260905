"""Registered measures as evaluations show them: which ones, their columns, and the headings of these."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from ethbrake_marl.files.python_file import load_from_file
from ethbrake_marl.game.impacts import EpisodeImpacts
from ethbrake_marl.game.measures import MEASURES, REPORTED, NamedMeasure, register_measure
from ethbrake_marl.registry import Part

LOADED: dict[str, None] = {}  # names that ``load_measures`` was given, in order


def load_measures(names: Iterable[str]) -> None:
    """Make every evaluation from now on show these measures: ``risk``, ``injury``, those of installed packages.

    ``my_file.py:measure`` runs that file, which can do whatever you can: it names a function or a ``Part``. Raises
    ``UnknownName`` with a suggestion, ``InvalidInput`` for what cannot be loaded.
    """
    for name in names:
        file, colon, own = name.rpartition(":")
        if colon:
            part = load_from_file(file, own)
            given, settings = (part.given, part.settings) if isinstance(part, Part) else ((part,), {})
            register_measure(own, *given, **settings)
        else:
            REPORTED.update({each: MEASURES[each] for each in MEASURES.load(name)})
        LOADED[name] = None


def heading_of(column: str) -> str:
    measure = registered_measure(column)
    if measure is None:  # of results that were computed before it was forgotten
        return column
    vehicle = column.removeprefix(measure.name).removeprefix("_")
    return f"{measure.name}{f', vehicle {vehicle}' if vehicle else ''} ({measure.unit})"


def registered_measure(column: str) -> NamedMeasure | None:
    return REPORTED.get(column) or REPORTED.get(column.rpartition("_")[0])


def measure_columns(terms: Mapping[str, Any], episodes: EpisodeImpacts | None) -> dict[str, Any]:
    """Every reported measure of these episodes by column, [n]: ``NAME``, or ``NAME_1``, ``NAME_2``, ... by vehicle.

    ``terms``: sums of the measures by step; ``episodes``: None where no measure is computed from impacts.
    """
    columns: dict[str, Any] = {}
    for name, measure in REPORTED.items():
        values = terms[name] if episodes is None or measure.by == "step" else measure.of(episodes)
        if values.ndim == 1:
            columns[name] = values
        else:
            columns |= {f"{name}_{i + 1}": column.copy() for i, column in enumerate(values.T)}
    return columns
