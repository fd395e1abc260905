"""Harm metrics of the user's own: functions of every impact of an episode, told beside the two counts of harm."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields

import numpy as np

from ethbrake_marl.errors import AlreadyExists, InvalidInput, describe_error
from ethbrake_marl.physics import Floats, ImpactRows, Worlds, advance, make_worlds
from ethbrake_marl.physics.worlds import read_only

COLUMN = "metric_"  # before the name, in JSON and in files with every world
_NAME = re.compile(r"(?!.*_[0-9]+\Z)[a-z][a-z0-9_]{0,63}")  # x_2 is that of the second vehicle


@dataclass(frozen=True, slots=True)
class EpisodeImpacts:
    """What a harm metric is computed from, for n episodes of N vehicles; its arrays cannot be written to."""

    worlds: Worlds  # [n] at the alert
    rows: ImpactRows  # every impact, by world and then by time, arrays [k]

    @property
    def largest_speed_change_mps(self) -> Floats:
        """The largest change of speed of each vehicle in one impact (delta-v), [n, N]; 0 without one."""
        rows, change = self.rows, np.zeros(self.worlds.speeds_mps.shape)
        np.maximum.at(change, (rows.world, rows.pair + 1), np.abs(rows.rear_speed_change_mps))
        pairs = rows.pair >= 0  # an obstacle ahead is no vehicle
        np.maximum.at(change, (rows.world[pairs], rows.pair[pairs]), np.abs(rows.front_speed_change_mps[pairs]))
        return change


MetricFunction = Callable[[EpisodeImpacts], Floats]


@dataclass(frozen=True, slots=True)
class HarmMetric:
    """A registered metric."""

    name: str
    unit: str
    about: str
    function: MetricFunction


METRICS: dict[str, HarmMetric] = {}


def register_harm_metric(name: str, function: MetricFunction, *, unit: str) -> None:
    """Make every evaluation from now on tell ``name`` beside first-impact and total harm, with its interval.

    Args:
        name: 1 to 64 of ``a-z``, digits and ``_``, beginning with a letter, not ending in ``_`` and a number; columns
            are called ``metric_NAME``.
        function: from ``EpisodeImpacts`` to a number for each world [n], or one for each vehicle [n, N], which
            become columns of their own; its docstring says what it is. It must work for lines of any length.
        unit: of its numbers.

    Registering the same again changes nothing. Raises ``AlreadyExists`` for another one under a name that is taken,
    ``InvalidInput`` for what cannot be used, a function among that which fails, or gives another shape or a number that
    is not finite, in two worlds.

    """
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise InvalidInput(
            f"harm metric {name!r:.80}: must be 1 to 64 of a-z, 0-9 and _, beginning with a letter, not ending in _"
            " and a number"
        )
    if not callable(function) or not (function.__doc__ or "").strip():
        raise InvalidInput(f"harm metric {name!r}: needs a function with a docstring that says what it is")
    metric = HarmMetric(name, str(unit), " ".join((function.__doc__ or "").split()), function)
    _columns(metric, _tried())
    if METRICS.setdefault(name, metric) != metric:
        raise AlreadyExists(f"harm metric {name!r} is registered already; give another name")


def metric_columns(episodes: EpisodeImpacts) -> dict[str, Floats]:
    """Every registered metric by column, [n]: ``NAME``, or ``NAME_1``, ``NAME_2``, ... front to rear.

    Raises ``InvalidInput`` that names metric and world.
    """
    found: dict[str, Floats] = {}
    for metric in METRICS.values():
        found |= _columns(metric, episodes)
    return found


def metric_headings(columns: Mapping[str, object]) -> dict[str, str]:
    """Column -> its heading with vehicle and unit: ``delta_v, vehicle 2 (m/s)``."""
    return {column: _heading(column) for column in columns}


def metric_meanings(columns: Mapping[str, object]) -> dict[str, str]:
    """Name -> what each metric among the columns means."""
    metrics = [_metric_of(column) for column in columns]
    return {metric.name: metric.about for metric in metrics if metric is not None}


def _heading(column: str) -> str:
    metric = _metric_of(column)
    if metric is None:  # of results that were computed before it was forgotten
        return column
    vehicle = column.removeprefix(metric.name).removeprefix("_")
    return f"{metric.name}{f', vehicle {vehicle}' if vehicle else ''} ({metric.unit})"


def _metric_of(column: str) -> HarmMetric | None:
    return METRICS.get(column) or METRICS.get(column.rpartition("_")[0])


def _columns(metric: HarmMetric, episodes: EpisodeImpacts) -> dict[str, Floats]:
    """What a metric gives, checked."""
    what, (n, vehicles) = f"harm metric {metric.name!r}", episodes.worlds.speeds_mps.shape
    try:
        value = np.asarray(metric.function(episodes))
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
    value = value.astype(np.float64)
    if value.ndim == 1:
        return {metric.name: value}
    return {f"{metric.name}_{i + 1}": value[:, i].copy() for i in range(vehicles)}


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
    return _read_only(worlds, ImpactRows(np.array([0]), np.array([1]), *one))


def _read_only(worlds: Worlds, rows: ImpactRows) -> EpisodeImpacts:
    for field in fields(rows):
        getattr(rows, field.name).flags.writeable = False
    return EpisodeImpacts(read_only(worlds), rows)


class ImpactWatch:
    """Watches episodes and keeps every impact, for the metrics; see ``of``."""

    def __init__(self, worlds: Worlds) -> None:
        self._worlds = worlds
        self._parts: list[ImpactRows] = []

    @classmethod
    def of(cls, worlds: Worlds) -> ImpactWatch | None:
        """What watches these worlds (at the alert); None where no metric is registered."""
        return cls(worlds) if METRICS else None

    def see(self, before: Worlds, command_mps2: Floats, until_s: Floats) -> None:
        """Keep the impacts of one step."""
        moving = np.flatnonzero(until_s > before.time_s)
        _, impacts = advance(before.take(moving), command_mps2[moving], until_s=until_s[moving], record=True)
        assert impacts.rows is not None
        columns = {field.name: getattr(impacts.rows, field.name) for field in fields(ImpactRows)}
        self._parts.append(ImpactRows(**{**columns, "world": moving[impacts.rows.world]}))

    def finish(self) -> dict[str, Floats]:
        """The metrics of these episodes, as ``metric_columns``."""
        joined = [np.concatenate([getattr(part, f.name) for part in self._parts]) for f in fields(ImpactRows)]
        order = np.argsort(joined[0], kind="stable")  # by world; in each by time already
        everything = np.arange(self._worlds.n)
        return metric_columns(
            _read_only(self._worlds.take(everything), ImpactRows(*(column[order] for column in joined)))
        )
