"""Measures by name: registered ones, summed terms of a reward, objectives, functions of a user's Python file.

The sum of a term over all steps is what a learner with this reward would get (``episode.terms``). An objective
(``social:45``) has a value for each vehicle, in both counts of harm.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from functools import partial

import numpy as np

from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.objectives import OBJECTIVES, amounts, objectives_of
from ethbrake_marl.episode.reward import Rewarding
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import Step
from ethbrake_marl.episode.terms import BUILT_IN, TERMS, TermFunction
from ethbrake_marl.errors import AlreadyExists, EthBrakeError, InvalidInput, unknown_name
from ethbrake_marl.evaluation.measures import DEFAULT, Given, Measure, Statistic, Values, Watch
from ethbrake_marl.files.python_file import load_from_file
from ethbrake_marl.registry import Part, Registry


def register_measure(
    name: str,
    of: Callable[[Game, State, State], Given] | None = None,
    *,
    unit: str = "1",
    shown: Iterable[Statistic] = (),
    watch: Callable[[Game, State], Watch | None] | None = None,
) -> None:
    """Register a measure, for ``measures_called``. Entry points: ``ethbrake_marl.measures``.

    Raises ``AlreadyExists`` for a name in use, and ``InvalidInput`` for a bad name or a function without a docstring,
    which says what the measure means.

    Args:
        name: 1 to 64 characters ``a-z``, ``0-9``, ``_``, beginning with a letter, not ending in ``_`` and a number, nor
            in ``_interval``, ``_low``, ``_high``, ``_error``, ``_freedom``.
        of: ``of(game, alert, last)`` returns [n] or [n, N].
        unit: unit of the value.
        shown: how tables show it; by default the mean, or the share of worlds in which it is true.
        watch: in place of ``of``: ``watch(game, alert)`` returns a ``Watch``, which sees every step.

    >>> import ethbrake_marl as eb
    >>> def rear_speed(game, alert, last):
    ...     '''Speed at which the rear vehicle ends, m/s.'''
    ...     return last.speeds_mps[:, -1]
    >>> eb.register_measure("rear_speed_mps", rear_speed, unit="m/s")

    """
    right = r"(?!.*_([0-9]+|interval|low|high|error|freedom)\Z)[a-z][a-z0-9_]{0,63}"
    if not isinstance(name, str) or re.fullmatch(right, name) is None:
        raise InvalidInput(
            f"measure {name!r:.80}: the name must be 1 to 64 characters a-z, 0-9 and _, beginning with a letter and not"
            " ending in _ and a number, nor in _interval, _low, _high, _error or _freedom"
        )
    function = watch if of is None else of
    if (of is None) == (watch is None) or not callable(function) or not (function.__doc__ or "").strip():
        raise InvalidInput(
            f"measure {name!r}: give one function, of(game, alert, last) or watch(game, alert), with a docstring that"
            " describes the measure"
        )
    measure = Measure(name, of, " ".join(str(function.__doc__).split()), str(unit), tuple(shown), watch)
    if name in (*USUAL, *TAKEN) or name in TERMS:
        raise AlreadyExists(f"measure {name!r}: this name is already in use; give another name")
    MEASURES.add(name, measure, lambda other: other == measure)


USUAL = tuple(measure.name for measure in DEFAULT)
TAKEN = ("agent", "knows", "kind", "world", "scenario", "recording", "hidden", "exploits", "results_sha256")

MEASURES: Registry[Measure] = Registry(
    "measure", "measures", register_measure, {measure.name: measure for measure in DEFAULT}
)

_REWARDED = ("collision", "risk", "jerk", "push", "drove")  # built-in terms, with the usual constants


def measures_called(names: str | Iterable[str]) -> tuple[Measure, ...]:
    """Return the measures, summed terms and objectives of these names, each once; ``FILE.py:NAME`` runs the file.

    Raises ``UnknownName``, and ``InvalidInput`` for a file without such a measure.
    """
    if not isinstance(names, Iterable):
        raise InvalidInput(f"measures = {names!r:.60}: must be names of measures, for instance 'injury,sampled_harm'")
    found: dict[str, Measure] = {}
    for name in names.split(",") if isinstance(names, str) else names:
        found |= {measure.name: measure for measure in _called(name)}
    return tuple(found.values())


def _called(name: str) -> list[Measure]:
    if name in MEASURES and name in TERMS:
        raise AlreadyExists(f"measure {name!r}: a measure and a term of the reward have this name; rename one of them")
    if name in MEASURES:
        return [MEASURES[each] for each in MEASURES.load(name)]
    if name in _REWARDED:
        return [_summed(name, partial(_rewarded, name), BUILT_IN[name][0])]
    if name in TERMS:
        return [_summed(name, TERMS[name].value, TERMS[name].unit)]
    file, _, own = str(name).rpartition(":")
    if file.endswith(".py"):
        value = load_from_file(file, own)
        part = value if isinstance(value, Part) else Part(value)
        try:
            register_measure(own, *part.given, **part.settings)
        except EthBrakeError as error:
            raise type(error)(f"file {file!r}: {error}") from None
        return [MEASURES[own]]
    kind = str(name).partition(":")[0]
    if kind in OBJECTIVES:
        meaning = f"What the vehicle would minimise: {OBJECTIVES[kind].about}."
        return [Measure(name, partial(_objective, name), meaning, "m2/s2")]
    raise unknown_name("measure", name, (*MEASURES, *_REWARDED, *TERMS, *OBJECTIVES), may_be_own=True)


def _summed(name: str, term: TermFunction, unit: str) -> Measure:
    return Measure(name, None, f"Sum of the term {name} over all steps.", unit, watch=partial(SummedTerm, term))


def _rewarded(name: str, before: State, step: Step, after: State) -> Values:
    learners, times = np.zeros(0, np.int64), (step.time_step_s, 0.0)
    rewarding, _ = Rewarding.of({"harm": 0.0, name: 1.0}, "total", after.vehicles, learners, times, None)
    return rewarding.terms[0][2](before, step, after)


def _objective(name: str, game: Game, alert: State, last: State) -> Given:
    objectives = objectives_of(name, last.vehicles)
    return {count: amounts(objectives, None, last, count) for count in ("first", "total")}


class SummedTerm:
    """Adds up a term of a reward over all steps."""

    def __init__(self, term: TermFunction, game: Game, alert: State) -> None:
        self.term, self.sum = term, np.zeros(alert.n)

    def see(self, before: State, step: Step | None, after: State) -> None:
        """Add the step's term, 0 in episodes that had ended."""
        if step is not None:
            value = self.term(before, step, after)
            ended = before.ended if value.ndim == 1 else before.ended[:, np.newaxis]
            self.sum = np.where(ended, 0.0, value) + (self.sum if self.sum.shape == value.shape else 0.0)

    def result(self, last: State) -> Given:
        """Return the sum."""
        return self.sum
