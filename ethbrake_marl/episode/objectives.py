"""Objectives: whose harm a vehicle should minimise.

With the harm ``H_j`` that vehicle j bears (m2/s2), ``H`` of the whole line, and masses ``m_j``, vehicle i minimises:

==================  ================================================================================================
total               ``H``
own                 ``H_i``
social:phi          ``cos(phi) H_i + sin(phi) (H - H_i)``: social value orientation, 0 to 90 degrees
maximin             ``max_j H_j``
mass-weighted       ``N sum_j m_j H_j / sum_j m_j``
weighted:w1,w2,...  ``N sum_j w_j H_j / sum_j w_j``, one weight per vehicle, 0 or from 1e-6 to 1e6
preference          as ``weighted``, with the weights ``harm_weight`` that the scenario declares
injury:curve        expected injuries in 1,000 lines (``episode.injury``), from each pair's harm as if by one impact
==================  ================================================================================================

All but ``maximin``, ``injury`` and registered ones are weighted sums of the vehicles' harm.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ethbrake_marl.episode.counts import own_amounts, pair_amounts
from ethbrake_marl.episode.functions import called, described
from ethbrake_marl.episode.injury import CURVES, injured_by_harm
from ethbrake_marl.episode.state import State, split_harm
from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.files.yaml import parse_numeral
from ethbrake_marl.motion.layout import MASS, WEIGHT, Floats
from ethbrake_marl.registry import Registry

Declared = str | Sequence[str]  # one objective for all vehicles, or one for each


class Harm(NamedTuple):
    """Harm of n worlds over some time, from which an objective computes what a vehicle should minimise."""

    pairs: Floats  # [n, N + 1] harm of each pair, m2/s2; column 0: with the obstacle
    borne: Floats  # [n, N] harm that each vehicle bears, m2/s2
    whole: Floats  # [n] harm of the line, m2/s2
    car: Floats  # [n, CAR_ROWS, N + 1] parameters (`motion.layout`)

    @classmethod
    def of(cls, pairs: Floats, own: Floats, car: Floats) -> Harm:
        """Return the harm whose pairs have ``pairs``, of which the vehicle behind bears ``own`` alone, [n, N + 1]."""
        whole, borne = np.zeros(len(pairs)), np.empty((len(pairs), pairs.shape[1] - 1))
        for p in range(pairs.shape[1]):  # from the obstacle to the rear
            whole = whole + pairs[:, p]
        split_harm(pairs - own, car[:, MASS], borne)
        return cls(pairs, borne + own[:, :-1], whole, car)

    def weighted(self, weights: Floats) -> Floats:
        """Return ``N sum_j w_j H_j / sum_j w_j``, [n] m2/s2, for the ``weights`` [n, N]; sums from front to rear."""
        harm, whole = np.zeros(len(self.borne)), np.zeros(len(self.borne))
        for j in range(self.borne.shape[1]):
            harm = harm + weights[:, j] * self.borne[:, j]
            whole = whole + weights[:, j]
        return self.borne.shape[1] * harm / whole


class Kind(NamedTuple):
    """A kind of objective."""

    form: str  # how it is written; with ":" it takes an argument
    about: str
    amount: Callable[[Harm, int, tuple[float, ...], str], Floats]  # (harm, vehicle from 0, numbers, curve) -> [n]
    weights: Callable[[Floats, int, tuple[float, ...]], Floats] | None = None  # (car, vehicle, numbers) -> [n, N]; sums
    function: Callable[[Harm, int], Floats] | None = None  # of a registered objective

    def __reduce__(self) -> tuple[Callable[[str], Kind], tuple[str]]:
        """Pickle the name: functions need not be picklable."""
        return _kind, (self.form.partition(":")[0],)


class Objective(NamedTuple):
    """An objective as it is written, such as ``social:45``."""

    kind: Kind
    numbers: tuple[float, ...] = ()
    curve: str = ""

    def amount(self, harm: Harm, vehicle: int) -> Floats:
        """Return what ``vehicle`` (from 0) should minimise, [n]."""
        return self.kind.amount(harm, vehicle, self.numbers, self.curve)

    def weights(self, car: Floats, vehicle: int) -> Floats:
        """Return the weight of each vehicle's harm, [n, N]. Raises ``InvalidInput`` unless this is a weighted sum."""
        if self.kind.weights is None:
            known = ", ".join(kind.form for kind in OBJECTIVES.loaded.values() if kind.weights)
            raise InvalidInput(
                f"objective {self.kind.form!r}: is not a weighted sum of the vehicles' harm; use one of {known}"
            )
        weights = self.kind.weights(car, vehicle, self.numbers)
        return np.broadcast_to(weights, (len(car), car.shape[2] - 1)).astype(np.float64)


def _kind(name: str) -> Kind:
    return OBJECTIVES[name]


@lru_cache(maxsize=256)
def parse_objective(text: str) -> Objective:
    """Return the objective of a text such as ``own``, ``social:45`` or ``weighted:1,4,1``. Raises ``InvalidInput``."""
    name, colon, argument = text.partition(":")
    kind = OBJECTIVES[name]
    if ":" not in kind.form:
        if colon:
            raise InvalidInput(f"objective {text!r}: {name} takes no argument")
        return Objective(kind)
    if name == "injury":
        if argument not in CURVES:
            raise unknown_name("injury curve", argument, CURVES)
        return Objective(kind, curve=argument)
    written = [parse_numeral(part.strip()) for part in argument.split(",")]
    numbers = tuple(number for number in written if number is not None) if None not in written else ()
    if name == "social":
        if len(numbers) != 1 or not 0.0 <= numbers[0] <= 90.0:
            raise InvalidInput(f"objective {text!r}: social needs an angle from 0 to 90 degrees, as in social:45")
        return Objective(kind, _cosine_and_sine(numbers[0]))
    if not (any(numbers) and all(weight == 0.0 or 1e-6 <= weight <= 1e6 for weight in numbers)):
        raise InvalidInput(
            f"objective {text!r}: weighted needs one weight per vehicle, as in weighted:1,4,1; a weight is 0 or from"
            " 1e-6 to 1e6, and at least one weight must not be 0"
        )
    return Objective(kind, numbers)


def objectives_of(declared: Declared, vehicles: int) -> tuple[Objective, ...]:
    """Return the objective of each vehicle, front to rear. Raises ``InvalidInput`` for a bad text or a wrong number."""
    each = [declared] * vehicles if isinstance(declared, str) else declared
    if not isinstance(each, Sequence) or not all(isinstance(text, str) for text in each):
        raise InvalidInput(
            "objective: must be the name of an objective, for instance own or social:45, or a list with one name per"
            " vehicle"
        )
    if len(each) != vehicles:
        raise InvalidInput(
            f"objective: the list has {len(each)} entries; must have {vehicles}, one per vehicle; or give one objective"
            " for all vehicles, without a list"
        )
    parsed = tuple(parse_objective(text) for text in each)
    for text, objective in zip(each, parsed, strict=True):
        if text.startswith("weighted:") and len(objective.numbers) != vehicles:
            names = len(objective.numbers)
            raise InvalidInput(f"objective {text!r}: has {names} weights; must have {vehicles}, one per vehicle")
    return parsed


def amounts(objectives: Sequence[Objective], before: State | None, after: State, count: str) -> Floats:
    """Return how much each vehicle's amount has grown since ``before`` (None: since the alert), [n, N].

    A weighted sum is taken of the harm since then; any other amount is the amount after minus the amount before.
    """
    now, own = pair_amounts(after.line, count), own_amounts(after.line, count)
    whole = Harm.of(now, own, after.car)
    if before is None:
        return np.stack([each.amount(whole, i) for i, each in enumerate(objectives)], axis=1)
    earlier, earlier_own = pair_amounts(before.line, count), own_amounts(before.line, count)
    since = Harm.of(now - earlier, own - earlier_own, after.car)
    then = Harm.of(earlier, earlier_own, after.car)
    columns = [
        each.amount(since, i) if each.kind.weights else each.amount(whole, i) - each.amount(then, i)
        for i, each in enumerate(objectives)
    ]
    return np.stack(columns, axis=1)


def _cosine_and_sine(angle_deg: float) -> tuple[float, float]:
    """Return cosine and sine of an angle, with the same bits on every processor: power series in exact fractions."""
    if angle_deg == 90.0:
        return 0.0, 1.0
    angle, term, sums = Fraction(math.radians(angle_deg)), Fraction(1), [Fraction(0), Fraction(0)]
    for k in range(28):
        sums[k % 2] += -term if k % 4 >= 2 else term
        term = term * angle / (k + 1)
    return float(sums[0]), float(sums[1])


def _shares(weights: Floats) -> Floats:
    return weights * (weights.shape[1] / weights.sum(axis=1, keepdims=True))


def _own(car: Floats, vehicle: int) -> Floats:
    return np.eye(car.shape[2] - 1)[vehicle]


def register_objective(name: str, function: Callable[[Harm, int], Floats]) -> None:
    """Register an objective, which scenarios, rewards and ``--objective`` then know. Entry points: ``objectives``.

    ``function(harm, vehicle)`` returns what ``vehicle`` (from 0) should minimise, [n]; its docstring says what that is.
    Raises ``AlreadyExists`` for a name in use, and ``InvalidInput`` for a bad name or a function without a docstring.
    """
    form = "a-z, 0-9, - and _, beginning with a letter or digit"
    meaning = described("objective", name, function, r"[a-z0-9][a-z0-9_-]{0,63}", form)

    def amount(harm: Harm, vehicle: int, numbers: tuple[float, ...], curve: str) -> Floats:
        what = f"objective {name!r} of vehicle_{vehicle + 1}"
        value = called(what, function, (harm, vehicle), harm.whole.shape)
        if not np.isfinite(value).all():
            raise InvalidInput(f"{what}: its value is not finite in row {int(np.argmin(np.isfinite(value)))}")
        return value.astype(np.float64)

    kind = Kind(name, meaning, amount, function=function)
    OBJECTIVES.add(name, kind, lambda other: other.function is function)


OBJECTIVES: Registry[Kind] = Registry(
    "objective",
    "objectives",
    register_objective,
    {
        "total": Kind(
            "total", "harm of all vehicles, with equal weights", lambda harm, i, numbers, curve: harm.whole,
            lambda car, i, numbers: np.ones(car.shape[2] - 1),
        ),
        "own": Kind(
            "own", "harm that the vehicle itself bears", lambda harm, i, numbers, curve: harm.borne[:, i],
            lambda car, i, numbers: _own(car, i),
        ),
        "social": Kind(
            "social:ANGLE", "social value orientation: own harm at 0 degrees, harm of the others at 90 degrees",
            lambda harm, i, n, curve: n[0] * harm.borne[:, i] + n[1] * (harm.whole - harm.borne[:, i]),
            lambda car, i, numbers: np.where(_own(car, i), *numbers),
        ),
        "maximin": Kind(
            "maximin", "harm of the vehicle that bears most", lambda harm, i, numbers, curve: harm.borne.max(axis=1)
        ),
        "mass-weighted": Kind(
            "mass-weighted", "harm of all vehicles, weighted by their masses",
            lambda harm, i, numbers, curve: harm.weighted(harm.car[:, MASS, 1:]),
            lambda car, i, numbers: _shares(car[:, MASS, 1:]),
        ),
        "weighted": Kind(
            "weighted:W1,W2,...", "harm of all vehicles, with one given weight per vehicle",
            lambda harm, i, numbers, curve: harm.weighted(np.full(harm.borne.shape, numbers)),
            lambda car, i, numbers: _shares(np.array([numbers])),
        ),
        "preference": Kind(
            "preference", "harm of all vehicles, with the weights harm_weight of the scenario",
            lambda harm, i, numbers, curve: harm.weighted(harm.car[:, WEIGHT, 1:]),
            lambda car, i, numbers: _shares(car[:, WEIGHT, 1:]),
        ),
        "injury": Kind(
            "injury:CURVE", "expected injuries in 1,000 lines, by the impact with the largest risk for each vehicle",
            lambda harm, i, numbers, curve: injured_by_harm(harm.pairs, harm.car, curve),
        ),
    },
)  # fmt: skip
