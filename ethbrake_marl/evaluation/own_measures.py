"""Measures that a user registers: functions of every impact of an episode."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from ethbrake_marl.errors import InvalidInput, describe_error
from ethbrake_marl.evaluation.impacts import EpisodeImpacts
from ethbrake_marl.evaluation.outcome import Values
from ethbrake_marl.files.python_file import load_from_file
from ethbrake_marl.physics.left_out import ImpactRows
from ethbrake_marl.physics.state import make_worlds
from ethbrake_marl.registry import Part, Registry

_NAME = re.compile(r"(?!.*_([0-9]+|interval|low|high)\Z)[a-z][a-z0-9_]{0,63}")  # x_2 is that of the second vehicle

EpisodeFunction = Callable[[EpisodeImpacts], Values]


@dataclass(frozen=True, slots=True)
class _Registered:
    """A measure beside the usual ones."""

    name: str
    unit: str
    about: str
    function: EpisodeFunction
    form: str = ""  # what it gives: a truth or a number, per world or per vehicle


def register_measure(name: str, function: EpisodeFunction, *, unit: str = "1") -> None:
    """Make every evaluation from now on tell ``name`` with its interval: in tables, files and pages.

    An installed package does the same, for evaluations that name it, with an entry point of the group
    ``ethbrake_marl.measures``: its function, a ``Part`` of it, or a mapping of names to such.

    Args:
        name: 1 to 64 of ``a-z``, digits and ``_``, beginning with a letter, not ending in ``_`` and a number,
            ``_interval``, ``_low`` or ``_high``; columns are called ``metric_NAME``.
        function: from ``EpisodeImpacts`` to a number for each world [n], or one for each vehicle [n, N], which
            become columns of their own; of truths a rate is told. Its docstring says what it is. It must work for
            lines of any length.
        unit: of its numbers.

    Registering the same again changes nothing. Raises ``AlreadyExists`` for another one under a name that is taken,
    ``InvalidInput`` for what cannot be used, a function among that which fails, or gives another shape or a number that
    is not finite, in two worlds.

    """
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise InvalidInput(
            f"measure {name!r:.80}: must be 1 to 64 of a-z, 0-9 and _, beginning with a letter, not ending in _"
            " and a number, _interval, _low or _high"
        )
    if not callable(function) or not (function.__doc__ or "").strip():
        raise InvalidInput(f"measure {name!r}: needs a function with a docstring that says what it is")
    metric = _Registered(name, str(unit), " ".join((function.__doc__ or "").split()), function)
    metric = replace(metric, form=_form(_checked(metric, _tried())))
    MEASURES.add(name, metric, lambda other: other == metric)


MEASURES: Registry[_Registered] = Registry("measure", "measures", register_measure)

REGISTERED = MEASURES.loaded  # those that every evaluation tells

LOADED: dict[str, None] = {}  # names that ``load_measures`` was given, in order


def load_measures(names: Iterable[str]) -> None:
    """Make every evaluation from now on tell these measures: those of installed packages, ``injury`` among them.

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
            MEASURES.load(name)
        LOADED[name] = None


def heading_of(column: str) -> str:
    metric = registered_measure(column)
    if metric is None:  # of results that were computed before it was forgotten
        return column
    vehicle = column.removeprefix(metric.name).removeprefix("_")
    return f"{metric.name}{f', vehicle {vehicle}' if vehicle else ''} ({metric.unit})"


def registered_measure(column: str) -> _Registered | None:
    return REGISTERED.get(column) or REGISTERED.get(column.rpartition("_")[0])


def _form(values: Values) -> str:
    return f"a {'truth' if values.dtype == np.bool_ else 'number'} per {'world' if values.ndim == 1 else 'vehicle'}"


def _checked(metric: _Registered, episodes: EpisodeImpacts) -> Values:
    """What it gives, [n] or [n, N], checked."""
    what, (n, vehicles) = f"measure {metric.name!r}", episodes.worlds.speeds_mps.shape
    try:
        given = metric.function(episodes)
        value = np.asarray(None if np.ma.isMaskedArray(given) else given)
    except Exception as error:
        raise InvalidInput(f"{what}: its function fails: {describe_error(error)}") from error
    if value.shape not in ((n,), (n, vehicles)) or value.dtype.kind not in "fiub":
        raise InvalidInput(
            f"{what}: gave {value.dtype} of shape {value.shape}; must be numbers of shape ({n},), one per world, or"
            f" ({n}, {vehicles}), one per vehicle too"
        )
    finite = np.isfinite(value).reshape(n, -1).all(axis=1)
    if not finite.all():
        world = int(np.argmin(finite))
        raise InvalidInput(f"{what}: is {value[world]} in world {world}; must be finite")
    return value if value.dtype == np.bool_ else value.astype(np.float64)


def _tried() -> EpisodeImpacts:
    """Two lines of three, one with an impact of its second pair."""
    worlds = make_worlds(
        [[8.0, 6.0], [3.0, 21.0]],
        [[20.0, 18.0, 22.0], [9.0, 13.0, 11.0]],
        braking_capacity_mps2=[6.0, 7.0, 5.0],
        driving_capacity_mps2=[1.0, 2.0, 3.0],
        latency_s=[0.0, 0.5, 0.25],
        mass_t=[4.5, 15.5, 5.9],
        restitution=[0.0, 0.3],
    )
    one = (np.array([each]) for each in (2.5, 4.0, True, 1.2, -3.1))
    return EpisodeImpacts.unwritable(worlds, ImpactRows(np.array([0]), np.array([1]), *one))


def measure_impacts(episodes: EpisodeImpacts) -> dict[str, Values]:
    """Every registered measure of these episodes by column, [n]: ``NAME``, or ``NAME_1``, ``NAME_2``, ...

    Raises ``InvalidInput`` that names measure and world.
    """
    columns: dict[str, Values] = {}
    for metric in REGISTERED.values():
        values = _checked(metric, episodes)
        if _form(values) != metric.form:
            raise InvalidInput(
                f"measure {metric.name!r}: gave {_form(values)}; when it was registered it gave {metric.form}"
            )
        if values.ndim == 1:
            columns[metric.name] = values
        else:
            columns |= {f"{metric.name}_{i + 1}": column.copy() for i, column in enumerate(values.T)}
    return columns
