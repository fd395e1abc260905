"""Measures by name: registered ones, summed terms of a reward, objectives, functions of a user's Python file.

The sum of a term over all steps is what a learner with this reward would get (``episode.terms``). An objective such as
``social:45`` is measured in every count of harm, and for each vehicle if it differs between vehicles.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable
from functools import partial
from inspect import signature

import numpy as np

from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.objectives import OBJECTIVES, amounts, objective_name, objectives_of
from ethbrake_marl.episode.reward import RewardParams
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import Step
from ethbrake_marl.episode.terms import BUILT_IN, TERMS, TermFunction, collision, drove, jerk, push, risk
from ethbrake_marl.errors import AlreadyExists, EthBrakeError, InvalidInput, unknown_name
from ethbrake_marl.evaluation.measures import DEFAULT, Measure, MeasureValue, Statistic, Watch, usual_measures
from ethbrake_marl.files.python_file import load_from_file
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.registry import Part, Registry


def register_measure(
    name: str,
    of: Callable[[Game, State, State], MeasureValue] | None = None,
    *,
    unit: str = "1",
    statistics: Iterable[Statistic] = (),
    watch: Callable[[Game, State], Watch | None] | None = None,
) -> None:
    """Register a measure under a name. Packages declare measures as entry points ``ethbrake_marl.measures``.

    The docstring of the function describes the measure. Raises ``AlreadyExists`` for a name in use, and
    ``InvalidInput`` for a bad name or a missing docstring.

    Args:
        name: 1 to 64 characters ``a-z``, ``0-9``, ``_``, beginning with a letter, not ending in ``_`` and a number, nor
            in ``_interval``, ``_low``, ``_high``, ``_error``, ``_freedom``.
        of: function ``of(game, alert, last)``, whose value is described in ``evaluation.measures``.
        unit: unit of the values.
        statistics: how tables show the measure; by default its mean, or the share of worlds in which it is true.
        watch: instead of ``of``: ``watch(game, alert)`` returns a ``Watch``, which sees every step.

    >>> import ethbrake_marl as eb
    >>> def rear_speed(game, alert, last):
    ...     '''Speed at which the rear vehicle ends, m/s.'''
    ...     return last.speeds_mps[:, -1]
    >>> eb.register_measure("rear_speed_mps", rear_speed, unit="m/s")

    """
    measure = _check_measure(name, of, unit, statistics, watch)
    MEASURES.add(name, measure, lambda registered: registered == measure)


def _check_measure(
    name: str,
    of: Callable[[Game, State, State], MeasureValue] | None = None,
    unit: str = "1",
    statistics: Iterable[Statistic] = (),
    watch: Callable[[Game, State], Watch | None] | None = None,
) -> Measure:
    check_measure_name(name)
    function = watch if of is None else of
    if (of is None) == (watch is None) or not callable(function) or not (function.__doc__ or "").strip():
        raise InvalidInput(
            f"measure {name!r}: give one function, of(game, alert, last) or watch(game, alert), with a docstring that"
            " describes the measure"
        )
    if name in {*RESERVED_NAMES, *(measure.name for measure in usual_measures())} or name in TERMS:
        raise AlreadyExists(f"measure {name!r}: this name is already in use; give another name")
    return Measure(name, of, " ".join(str(function.__doc__).split()), str(unit), tuple(statistics), watch)


def check_measure_name(name: object) -> None:
    right = r"(?!.*_([0-9]+|interval|low|high|error|freedom)\Z)[a-z][a-z0-9_]{0,63}"
    if not isinstance(name, str) or re.fullmatch(right, name) is None:
        raise InvalidInput(
            f"measure {name!r:.80}: the name must be 1 to 64 characters a-z, 0-9 and _, beginning with a letter and not"
            " ending in _ and a number, nor in _interval, _low, _high, _error or _freedom"
        )


RESERVED_NAMES = ("agent", "knows", "kind", "world", "scenario", "recording", "hidden", "exploits", "results_sha256")

MEASURES: Registry[Measure] = Registry(
    "measure", "measures", register_measure, {measure.name: measure for measure in DEFAULT}
)

# built-in terms of a step, with the constants of a usual reward
_REWARDED: dict[str, TermFunction] = {
    "collision": partial(collision, RewardParams()),
    "risk": partial(risk, RewardParams()),
    "jerk": jerk,
    "push": push,
    "drove": drove,
}


def split_names(names: str) -> list[str]:
    """Names in a text, split at commas, except those within an objective such as ``weighted:1,4,1``."""
    return re.split(r",(?!\s*[\d.][\d.e+-]*(?:,|$))", names)


def measures_called(names: str | Iterable[str]) -> tuple[Measure, ...]:
    """Measures with these names, without duplicates: registered measures, summed terms of a reward, objectives.

    ``FILE.py:NAME`` runs the file and takes its measure NAME, which keeps this long name beside another NAME. Raises
    ``UnknownName``, and ``InvalidInput`` for a file without such a measure.
    """
    if not isinstance(names, Iterable):
        raise InvalidInput(f"measures = {names!r:.60}: must be names of measures, for instance 'pushed_mps,pushed_m'")
    called: list[tuple[str, Measure]] = []
    for name in dict.fromkeys(split_names(names) if isinstance(names, str) else names):
        called += [
            (name, candidate)
            for candidate in _measures_named(name)
            if candidate not in [measure for _, measure in called]
        ]
    count = Counter(measure.name for _, measure in called)
    return tuple(_qualify_measure(name, measure) if count[measure.name] > 1 else measure for name, measure in called)


def _qualify_measure(name: str, measure: Measure) -> Measure:
    file = name.removesuffix(f":{measure.name}")
    if file == name:
        return measure
    statistics = (
        statistic._replace(
            key=f"{file}:{statistic.key}",
            heading=statistic.heading and f"{statistic.heading} ({file})",
            short=statistic.short and f"{statistic.short}\n({file})",
        )
        for statistic in measure.statistics
    )
    return measure._replace(name=name, statistics=tuple(statistics))


def _measures_named(name: str) -> list[Measure]:
    """Measures that one name stands for; several for an entry point with several."""
    if name in MEASURES and name in TERMS:
        raise AlreadyExists(f"measure {name!r}: a measure and a term of the reward have this name; rename one of them")
    if name in MEASURES:
        return [MEASURES[loaded_name] for loaded_name in MEASURES.load(name)]
    if name in _REWARDED:
        return [_sum_of_term(name, _REWARDED[name], BUILT_IN[name][0])]
    if name in TERMS:
        term = TERMS[name].value
        return [_sum_of_term(name, _intervention if name == "intervention" else term, TERMS[name].unit)]
    file, _, measure_name = str(name).rpartition(":")
    if file.endswith(".py"):
        return [_of_file(file, measure_name)]
    kind = objective_name(str(name))
    if kind in OBJECTIVES:
        meaning = f"What the vehicle would minimise: {OBJECTIVES[kind].about}."
        return [Measure(name, partial(_objective, name), meaning, "m2/s2")]
    raise unknown_name("measure", name, (*MEASURES, *_REWARDED, *TERMS, *OBJECTIVES), may_be_own=True)


def _of_file(file: str, name: str) -> Measure:
    """Measure ``name`` of a user's Python file: a function, or a ``Part`` with arguments of ``register_measure``.

    It may be a function that the file itself registers under this name, also as a term of a reward.
    """
    value = load_from_file(file, name)
    if name in TERMS and TERMS[name].function is value:
        return _sum_of_term(name, TERMS[name].value, TERMS[name].unit)
    if name in MEASURES and value in (MEASURES[name].of, MEASURES[name].watch):
        return MEASURES[name]
    part = value if isinstance(value, Part) else Part(value)
    try:
        measure = _check_measure(**signature(register_measure).bind(name, *part.arguments, **part.settings).arguments)
        if name in MEASURES and MEASURES[name] != measure:
            raise AlreadyExists(f"measure {name!r} is registered already; give another name")
    except TypeError as error:
        raise InvalidInput(f"file {file!r}: measure {name!r}: {error}") from None
    except EthBrakeError as error:
        raise type(error)(f"file {file!r}: {error}") from None
    return measure


def _sum_of_term(name: str, term: TermFunction, unit: str) -> Measure:
    return Measure(name, None, f"Sum of the term {name} over all steps.", unit, watch=partial(SummedTerm, term))


def _intervention(before: State, step: Step, after: State) -> Floats:
    """The term ``intervention``; 0 without a shield, so that tables can compare both."""
    if "shield" not in after.memories:
        return np.zeros(after.speeds_mps.shape)
    return TERMS["intervention"].value(before, step, after)


def _objective(name: str, game: Game, alert: State, last: State) -> MeasureValue:
    objectives = objectives_of(name, last.vehicles)
    values = {count.name: amounts(objectives, None, last, count) for count in last.counts}
    return values if objectives[0].differs else {count: value[:, 0] for count, value in values.items()}


class SummedTerm:
    """Measures the sum of a term of the reward over all steps (a ``Watch``)."""

    def __init__(self, term: TermFunction, game: Game, alert: State) -> None:
        self.term, self.sum = term, np.zeros(alert.n)

    def see(self, before: State, step: Step | None, after: State) -> None:
        """Add the term of one step; 0 for episodes that had ended before."""
        if step is not None:
            value = self.term(before, step, after)
            ended = before.ended if value.ndim == 1 else before.ended[:, np.newaxis]
            self.sum = np.where(ended, 0.0, value) + (self.sum if self.sum.shape == value.shape else 0.0)

    def result(self, last: State) -> MeasureValue:
        return self.sum
