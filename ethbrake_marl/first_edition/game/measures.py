"""Measures by name: every measure can be shown in evaluations and can be a term of a reward.

A measure is computed either from each step or from all impacts of an episode:

=======  ==================  ==========================================  ====================================
``by``   computed from       value of the reward term in a step          number that an evaluation shows
=======  ==================  ==========================================  ====================================
step     ``StepOutcome``     value of the measure in the step            sum of the values over the episode
impacts  ``EpisodeImpacts``  change of the measure during the step       value for all impacts of the episode
=======  ==================  ==========================================  ====================================

For each measure, the values of its reward term, summed over an episode, equal the number that an evaluation shows minus
the value of the measure before the first decision.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from ethbrake_marl.errors import AlreadyExists, InvalidInput, describe_error
from ethbrake_marl.first_edition.game.impacts import EpisodeImpacts
from ethbrake_marl.first_edition.game.step_outcome import StepOutcome, collision, jerk, risk
from ethbrake_marl.first_edition.physics.left_out import ImpactRows
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, make_worlds
from ethbrake_marl.registry import Registry

# names must not end like the columns of results: x_2 is the value of measure x for vehicle 2
_NAME = re.compile(r"(?!.*_([0-9]+|interval|low|high)\Z)[a-z][a-z0-9_]{0,63}")

By = Literal["step", "impacts"]

MeasureFunction = Callable[[Any], Any]  # maps a ``StepOutcome`` or ``EpisodeImpacts`` to numbers


@dataclass(frozen=True, slots=True)
class NamedMeasure:
    """A measure, with its name, unit and function."""

    name: str  # name of the measure, and key of its weight in a reward
    meaning: str  # what it measures, in words
    unit: str  # unit of the value; ``1`` for a plain number
    by: By  # what the measure is computed from: ``step`` or ``impacts``
    function: Callable[..., Any] | None = None  # function that computes the measure; None: the engine computes it
    settings: tuple[str, ...] = ()  # fields of RewardParams that a built-in function takes as further arguments
    form: str = ""  # kind of a registered function's result: ``a number per vehicle``, ``a truth value per world``, ...

    def built_in(self, step: StepOutcome, params: Any) -> Floats:
        """Return the value of a built-in measure in one step, [n] or [n, N]; ``params`` is the reward."""
        assert self.function is not None
        value: Floats = self.function(step, *(getattr(params, name) for name in self.settings))
        return value

    def of(self, given: StepOutcome | EpisodeImpacts, counts: Bools | None = None, steps: Ints | None = None) -> Any:
        """Return the value of a registered measure: [n] for one number per world, [n, N] for one number per vehicle.

        The value is 0 in worlds where the mask ``counts`` [n] is False; None: all worlds count. ``steps``, the number
        of steps that each episode has taken, [n], appears in error messages. Raises ``InvalidInput``, which names the
        measure, if a value is not finite or the result has a wrong shape or type.
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
            raise InvalidInput(
                f"measure {self.name!r}: its value is {number}{whose} in world {world}{when}; must be finite"
            )
        if self.form not in ("", form := _form(value)):
            raise InvalidInput(f"{what}: its function returned {form}, but {self.form} when it was registered")
        return value

    def _numbers(self, given: StepOutcome | EpisodeImpacts, what: str) -> Any:
        """Call the measure's function; return the result, [n] or [n, N]; raise ``InvalidInput`` for an unusable result.

        The result is converted to float64, except truth values of a measure with ``by="impacts"``. If the function
        returns one number per learner, vehicles that do not learn get the number 0. Error messages begin with ``what``.
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
            raise InvalidInput(
                f"{what}: its function returned {value.dtype} of shape {value.shape}; must return numbers of shape"
                f" {shapes}"
            )
        if learners is None:
            return value if value.dtype == np.bool_ else value.astype(np.float64)
        if right[value.shape] != "one per learner":
            return value.astype(np.float64)
        whole = np.zeros((n, vehicles))
        whole[:, learners] = value
        return whole

    def change(self, before: EpisodeImpacts, after: EpisodeImpacts, steps: Ints) -> Floats:
        """Return how much a measure with ``by="impacts"`` has changed during a step, [n] or [n, N].

        ``before`` and ``after`` have the impacts of the same episodes up to the beginning and to the end of the step.
        ``steps`` is the number of steps that each episode has taken, [n], for error messages.
        """
        if len(before.rows.world) == len(after.rows.world):
            return np.zeros(after.worlds.speeds_mps.shape[: 2 if self.form.endswith("vehicle") else 1])
        return np.asarray(1.0 * self.of(after, steps=steps) - self.of(before, steps=steps))


def register_measure(name: str, function: MeasureFunction, *, unit: str = "1", by: By = "impacts") -> None:
    """Register a measure: rewards can give it a weight under ``name``, and later evaluations show it.

    An installed package registers a measure with an entry point of the group ``ethbrake_marl.first_edition.measures``. The entry
    point names the function, a ``Part`` that contains it, or a mapping from names to functions or parts. Evaluations
    show measures from entry points only on request.

    Registering the same measure again changes nothing. Raises ``AlreadyExists`` if the name belongs to another measure,
    and ``InvalidInput`` for invalid arguments, or if the function, called for two test worlds, fails or returns a wrong
    shape or number.

    Args:
        name: 1 to 64 characters ``a-z``, ``0-9`` and ``_``, beginning with a letter, and not ending in ``_interval``,
            ``_low``, ``_high``, or ``_`` and a number. The measure appears under NAME in a reward, as ``metric_NAME``
            in results, and as ``reward_NAME`` in the infos of a step.
        function: function of an ``EpisodeImpacts`` (``by="impacts"``) or a ``StepOutcome`` (``by="step"``). The
            function returns one number per world, [n], or per vehicle, [n, N]; with ``by="step"`` it may also return
            one number per learner, [n, L]. It must work for any number of vehicles. Its docstring describes the
            measure. If a function with ``by="impacts"`` returns truth values, evaluations show the share of worlds (or
            vehicles) with the value True.
        unit: unit of the numbers that the function returns.
        by: from which data the measure is computed: ``impacts``, all impacts of an episode, or ``step``, each single
            step.

    """
    _add(name, function, unit=unit, by=by)
    REPORTED[name] = MEASURES.loaded[name]


def _add(name: str, function: MeasureFunction, *, unit: str = "1", by: By = "impacts") -> None:
    """Register a measure that evaluations show only on request; for the arguments, see ``register_measure``."""
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise InvalidInput(
            f"measure {name!r:.80}: the name must be 1 to 64 characters a-z, 0-9 and _, and must begin with a letter;"
            " it must not end in _interval, in _low, in _high, or in _ and a number"
        )
    if by not in get_args(By):
        raise InvalidInput(f"measure {name!r}: by = {by!r}: must be {' or '.join(map(repr, get_args(By)))}")
    if not callable(function) or not (function.__doc__ or "").strip():
        raise InvalidInput(f"measure {name!r}: must be a function with a docstring that describes the measure")
    if name in (*SETTINGS, *BUILT_IN):
        raise AlreadyExists(f"measure {name!r}: this name is already in use; give another name")
    measure = NamedMeasure(name, " ".join((function.__doc__ or "").split()), str(unit), by, function)
    value = measure.of(_a_step() if by == "step" else _some_impacts())
    measure = replace(measure, form=_form(value))
    MEASURES.add(name, measure, lambda other: other == measure)


def _form(value: Any) -> str:
    kind = "truth value" if value.dtype == np.bool_ else "number"
    return f"a {kind} per {'world' if value.ndim == 1 else 'vehicle'}"


def _some_impacts() -> EpisodeImpacts:
    """Return the impacts in two test worlds of three vehicles: one impact, of Vehicles 2 and 3 in world 0."""
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
    """Return the result of a step in the two test worlds of ``_some_impacts``, in which Vehicles 2 and 3 learn."""
    w = _some_impacts().worlds
    v, command = w.vehicles, np.array([[-6.0, 0.0, 1.5], [-6.0, -7.0, -2.5]])
    return StepOutcome(
        np.array([16.0, 0.0]), np.array([17.0, 0.0]), np.array([False, True]), w.gaps_m.copy(), w.speeds_mps.copy(),
        command, 0.5 * command, 0.1, np.array([0.6, 2.4]), v.braking_capacity_mps2, v.driving_capacity_mps2,
        v.latency_s, v.mass_t, np.array([1, 2]),
    )  # fmt: skip


_OF_RISK = ("ttc_scale_s", "safety_buffer_m", "target_gap_m", "distance_slope_per_m")

# Built-in terms of a reward, whose weights are fields of ``RewardParams``.
BUILT_IN = {
    each.name: each
    for each in (
        NamedMeasure("harm", "minus the harm of the step, as `harm_count` and `objective` count it", "m2/s2", "step"),
        NamedMeasure(
            "collision", "minus `k_energy` times the total harm of the step", "m2/s2", "step", collision,
            ("k_energy",),
        ),
        NamedMeasure(
            "risk", "minus the collision risk of the vehicle's pairs, from 0 (no risk) to 1.5 (imminent) per pair", "1",
            "step", risk, _OF_RISK,
        ),
        NamedMeasure("jerk", "minus the squared rate of change of the vehicle's acceleration", "m2/s6", "step", jerk),
        NamedMeasure("terminal", "1 in the last step of an episode without collision, otherwise 0", "1", "step"),
        NamedMeasure(
            "shaping", "discounted potential after the step minus potential before it; the potential is minus the least"
            " harm that the learners can reach by constant braking", "m2/s2", "step",
        ),
    )
}  # fmt: skip

# Keys of a reward that are not measures.
SETTINGS = ("harm_count", "objective", "shaping_discount", "k_energy", *_OF_RISK, "terms")

MEASURES: Registry[NamedMeasure] = Registry("measure", "first_edition.measures", _add, BUILT_IN)

REPORTED: dict[str, NamedMeasure] = {}  # measures that every evaluation shows, by name
