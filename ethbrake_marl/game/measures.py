"""Measures by name: what is reported can be rewarded, and what is rewarded can be reported.

A measure is computed either from each step or from all impacts of an episode:

=======  ==================  ===================================  ===========================
by       computed from       a reward counts in each step         an evaluation shows
=======  ==================  ===================================  ===========================
step     ``StepOutcome``     its value                            its sum over the episode
impacts  ``EpisodeImpacts``  its change by the step's impacts     its value for all impacts
=======  ==================  ===================================  ===========================

So the rewards of an episode add up to what evaluations show, minus the value before the first decision.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from ethbrake_marl.errors import AlreadyExists, InvalidInput, describe_error
from ethbrake_marl.game.impacts import EpisodeImpacts
from ethbrake_marl.game.step_outcome import StepOutcome, collision, jerk, risk
from ethbrake_marl.physics.left_out import ImpactRows
from ethbrake_marl.physics.state import Bools, Floats, Ints, make_worlds
from ethbrake_marl.registry import Registry

_NAME = re.compile(r"(?!.*_([0-9]+|interval|low|high)\Z)[a-z][a-z0-9_]{0,63}")  # column x_2 is that of vehicle 2

By = Literal["step", "impacts"]

MeasureFunction = Callable[[Any], Any]  # from a ``StepOutcome`` or ``EpisodeImpacts`` to numbers


@dataclass(frozen=True, slots=True)
class NamedMeasure:
    """A measure that can be reported and rewarded under its name."""

    name: str  # key of its weight in a reward
    meaning: str  # what it measures, in words
    unit: str  # unit of its value; ``1`` for a plain number
    by: By  # ``step`` or ``impacts``: what it is computed from
    function: Callable[..., Any] | None = None  # computes the measure; None: the engine does
    settings: tuple[str, ...] = ()  # fields of RewardParams that a built-in function takes as further arguments
    form: str = ""  # result of a registered function, such as ``a number per vehicle`` or ``a truth per world``

    def built_in(self, step: StepOutcome, params: Any) -> Floats:
        """Return the value of a built-in measure in one step, [n] or [n, N].

        ``params``: the ``RewardParams`` whose settings the measure takes.
        """
        assert self.function is not None
        value: Floats = self.function(step, *(getattr(params, name) for name in self.settings))
        return value

    def of(self, given: StepOutcome | EpisodeImpacts, counts: Bools | None = None, steps: Ints | None = None) -> Any:
        """Return the value of a registered measure: [n], or [n, N] for a measure of each vehicle.

        Raises ``InvalidInput`` naming the measure, world, vehicle and step of a number that is not finite.

        Args:
            given: what the measure is computed from: a step, or the impacts of an episode.
            counts: worlds to compute, a mask [n]; all others get 0. None: all worlds.
            steps: number of steps that each world has made, [n], for messages.

        """
        if isinstance(given, StepOutcome):
            given.protect()
        what = f"measure {self.name!r}" + ("" if steps is None else f" at step {int(steps.max())}")
        value = self._numbers(given, what)
        if counts is not None:
            value = np.where(counts if value.ndim == 1 else counts[:, np.newaxis], value, 0.0)
        if not np.isfinite(value).all():
            world, *vehicle = np.argwhere(~np.isfinite(value))[0]
            whose = "".join(f" for vehicle_{i + 1}" for i in vehicle)
            when = "" if steps is None else f" at step {steps[world]}"
            number = value[(world, *vehicle)]
            raise InvalidInput(f"measure {self.name!r}: is {number}{whose} in world {world}{when}; must be finite")
        if self.form not in ("", form := _form(value)):
            raise InvalidInput(f"{what}: gave {form}; when it was registered it gave {self.form}")
        return value

    def _numbers(self, given: StepOutcome | EpisodeImpacts, what: str) -> Any:
        """Call the measure's function and return its result, [n] or [n, N]; raise ``InvalidInput`` if it is unusable.

        The result is float64; truth values of a measure by impacts stay truth values. Values per learner are filled up
        with 0 for other vehicles. ``what``: how messages name the measure.
        """
        assert self.function is not None
        learners = given.learners if isinstance(given, StepOutcome) else None
        n, vehicles = (given.worlds if isinstance(given, EpisodeImpacts) else given).speeds_mps.shape
        try:
            value: Any = self.function(given)
            value = np.asarray(None if np.ma.isMaskedArray(value) else value)
        except (Exception, SystemExit) as error:
            raise InvalidInput(f"{what}: its function fails: {describe_error(error)}") from error
        right = {(n,): "one per world", (n, vehicles): "one per vehicle"}
        if learners is not None:
            right.setdefault((n, len(learners)), "one per learner")
        if value.shape not in right or value.dtype.kind not in "fiub":
            shapes = " or ".join(f"{shape}, {each}" for shape, each in right.items())
            raise InvalidInput(f"{what}: gave {value.dtype} of shape {value.shape}; must be numbers of shape {shapes}")
        if learners is None:
            return value if value.dtype == np.bool_ else value.astype(np.float64)
        if right[value.shape] != "one per learner":
            return value.astype(np.float64)
        whole = np.zeros((n, vehicles))
        whole[:, learners] = value
        return whole

    def change(self, before: EpisodeImpacts, after: EpisodeImpacts, steps: Ints) -> Floats:
        """Return how much the new impacts in ``after`` change a measure by impacts, [n] or [n, N].

        ``before`` and ``after`` are the same episodes; ``steps`` [n] is the number of steps so far, for messages.
        """
        if len(before.rows.world) == len(after.rows.world):
            return np.zeros(after.worlds.speeds_mps.shape[: 2 if self.form.endswith("vehicle") else 1])
        return np.asarray(1.0 * self.of(after, steps=steps) - self.of(before, steps=steps))


def register_measure(name: str, function: MeasureFunction, *, unit: str = "1", by: By = "impacts") -> None:
    """Register a measure: rewards may give ``name`` a weight, and every evaluation from now on shows it.

    An installed package registers a measure with an entry point of the group ``ethbrake_marl.measures``: its function,
    a ``Part`` of it, or a mapping of names to such. Evaluations show such a measure only on request.

    Args:
        name: 1 to 64 of ``a-z``, digits and ``_``, beginning with a letter, not ending in ``_`` and a number,
            ``_interval``, ``_low`` or ``_high``. It is the key of the weight in a reward; columns of results are called
            ``metric_NAME``, infos of a step ``reward_NAME``.
        function: takes an ``EpisodeImpacts`` or, by step, a ``StepOutcome``; returns one number for each world [n] or
            each vehicle [n, N]; by step also for each learner [n, L]. Its docstring describes the measure. It must work
            for lines of any length. Truth values by impacts are shown as a rate.
        unit: unit of the numbers.
        by: ``impacts`` or ``step``, what it is computed from.

    Registering the same measure again changes nothing. Raises ``AlreadyExists`` if the name belongs to another measure,
    ``InvalidInput`` for invalid arguments, or if in two test worlds the function fails, or returns another shape or a
    number that is not finite.

    """
    _add(name, function, unit=unit, by=by)
    REPORTED[name] = MEASURES.loaded[name]


def _add(name: str, function: MeasureFunction, *, unit: str = "1", by: By = "impacts") -> None:
    """Add a measure to the registry, without showing it in evaluations. Arguments are those of ``register_measure``."""
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise InvalidInput(
            f"measure {name!r:.80}: must be 1 to 64 of a-z, 0-9 and _, beginning with a letter, not ending in _"
            " and a number, _interval, _low or _high"
        )
    if by not in get_args(By):
        raise InvalidInput(f"measure {name!r}: by = {by!r}: must be {' or '.join(get_args(By))}")
    if not callable(function) or not (function.__doc__ or "").strip():
        raise InvalidInput(f"measure {name!r}: needs a function with a docstring that says what it is")
    if name in (*SETTINGS, *BUILT_IN):
        raise AlreadyExists(f"measure {name!r} is registered already; give another name")
    measure = NamedMeasure(name, " ".join((function.__doc__ or "").split()), str(unit), by, function)
    value = measure.of(_a_step() if by == "step" else _some_impacts())
    measure = replace(measure, form=_form(value))
    MEASURES.add(name, measure, lambda other: other == measure)


def _form(value: Any) -> str:
    return f"a {'truth' if value.dtype == np.bool_ else 'number'} per {'world' if value.ndim == 1 else 'vehicle'}"


def _some_impacts() -> EpisodeImpacts:
    """Return the impacts of two test lines of three vehicles; one line has an impact of its second pair."""
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
    return EpisodeImpacts.of(worlds, [ImpactRows(np.array([0]), np.array([1]), *one)])


def _a_step() -> StepOutcome:
    """Return a step of these two test lines, in which two vehicles learn."""
    w = _some_impacts().worlds
    v, command = w.vehicles, np.array([[-6.0, 0.0, 1.5], [-6.0, -7.0, -2.5]])
    return StepOutcome(
        np.array([16.0, 0.0]), np.array([17.0, 0.0]), np.array([False, True]), w.gaps_m.copy(), w.speeds_mps.copy(),
        command, 0.5 * command, 0.1, np.array([0.6, 2.4]), v.braking_capacity_mps2, v.driving_capacity_mps2,
        v.latency_s, v.mass_t, np.array([1, 2]),
    )  # fmt: skip


_OF_RISK = ("ttc_scale_s", "safety_buffer_m", "target_gap_m", "distance_slope_per_m")

# Terms of ``RewardParams`` that have a weight of their own.
BUILT_IN = {
    each.name: each
    for each in (
        NamedMeasure("harm", "minus the harm of the step, as `harm_count` and `objective` count it", "m2/s2", "step"),
        NamedMeasure(
            "collision", "minus `k_energy` times the harm of every impact of the step", "m2/s2", "step", collision,
            ("k_energy",),
        ),
        NamedMeasure(
            "risk", "minus how near and how soon a collision of each own pair is, 0 to 2 a pair", "1", "step", risk,
            _OF_RISK,
        ),
        NamedMeasure("jerk", "minus the squared rate of change of the own command", "m2/s6", "step", jerk),
        NamedMeasure("terminal", "1 when an episode ends without any collision", "1", "step"),
        NamedMeasure("shaping", "difference of potentials: minus the least harm ahead, for learners", "m2/s2", "step"),
    )
}  # fmt: skip

# Keys of a reward that are not measures.
SETTINGS = ("harm_count", "objective", "shaping_discount", "k_energy", *_OF_RISK, "terms")

MEASURES: Registry[NamedMeasure] = Registry("measure", "measures", _add, BUILT_IN)

REPORTED: dict[str, NamedMeasure] = {}  # measures that every evaluation shows, by name
