"""Objectives: whose harm a vehicle should minimise.

Let ``H_j`` be the harm that vehicle j bears (m2/s2), ``H`` the harm of the line. Vehicle i minimises:

==================  ================================================================================================
total               ``H``
own                 ``H_i``
vehicle_K           ``H_K``
social:phi          ``cos(phi) H_i + sin(phi) (H - H_i)``: social value orientation, 0 to 90 degrees
maximin             ``max_j H_j``
weighted:w1,w2,...  ``N sum_j w_j H_j / sum_j w_j``, one weight per vehicle, 0 or from 1e-6 to 1e6
==================  ================================================================================================

All are weighted sums of the vehicles' harm, except ``maximin`` and registered objectives. Some give the impacts of a
pair no weight (``free_pairs``); then causing them costs nothing.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ethbrake_marl.episode.counts import HarmCount, pair_amounts
from ethbrake_marl.episode.functions import call_function, description_of
from ethbrake_marl.episode.state import State, split_harm
from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.files.yaml import parse_numeral
from ethbrake_marl.motion.layout import CAR_ROWS, MASS, Floats
from ethbrake_marl.registry import Registry

Declared = str | Sequence[str]  # one objective for all vehicles, or one for each

PERSONAL = ("own", "social")  # objectives whose amount depends on the vehicle, beside registered ones


class Harm(NamedTuple):
    """Harm of n worlds over some time: of each pair, of each vehicle, and of the line."""

    pairs: Floats  # [n, N + 1] harm of each pair without the price of conduct, m2/s2; column 0: with the obstacle
    borne: Floats  # [n, N] harm that each vehicle bears, m2/s2
    whole: Floats  # [n] harm of the line, m2/s2
    car: Floats  # [n, CAR_ROWS, N + 1] parameters (`motion.layout`)

    @classmethod
    def of(cls, amounts: Floats, car: Floats) -> Harm:
        """Harm of pairs, vehicles and line, from ``pair_amounts`` and the parameters ``car`` of a ``State``.

        Each vehicle bears the price of its conduct; a pair shares the rest of its harm by mass.
        """
        pairs, unshared, conduct = amounts
        line_harm, borne = np.zeros(len(pairs)), np.empty((len(pairs), pairs.shape[1] - 1))
        for p in range(pairs.shape[1]):  # from the obstacle to the rear
            line_harm = line_harm + pairs[:, p]
        impacts = np.maximum(pairs - unshared, 0.0)
        split_harm(impacts, car[:, MASS], borne)
        return cls(impacts, borne + conduct[:, :-1], line_harm, car)

    def weighted(self, weights: Floats) -> Floats:
        """Weighted harm ``N sum_j w_j H_j / sum_j w_j``, [n] m2/s2, with ``weights`` w [n, N].

        The sums run from front to rear.
        """
        harm, total_weight = np.zeros(len(self.borne)), np.zeros(len(self.borne))
        for j in range(self.borne.shape[1]):
            harm = harm + weights[:, j] * self.borne[:, j]
            total_weight = total_weight + weights[:, j]
        return self.borne.shape[1] * harm / total_weight


class Kind(NamedTuple):
    form: str  # how it is written; with ":" it takes an argument
    about: str
    amount: Callable[[Harm, int, Objective], Floats]  # (harm, vehicle from 0, objective) -> [n]
    weights: Callable[[Floats, int, Objective], Floats] | None = None  # of sums: (car, vehicle, objective) -> [n, N]
    function: Callable[..., Floats] | None = None  # of a registered objective
    arguments: tuple[str, ...] | type[float] = ()  # that a registered objective may have; float: any number

    @property
    def name(self) -> str:
        return self.form.partition(":")[0]

    def __reduce__(self) -> tuple[Callable[[str], Kind], tuple[str]]:
        """Pickle only the name, because functions may not be picklable."""
        return _kind, (self.name,)


class Objective(NamedTuple):
    """An objective of one vehicle, such as ``social:45``."""

    kind: Kind
    numbers: tuple[float, ...] = ()
    argument: str = ""  # of a registered objective

    @property
    def is_sum(self) -> bool:
        return self.kind.weights is not None

    @property
    def differs(self) -> bool:
        """Whether two vehicles with this objective may minimise different amounts, as with ``own``."""
        return self.kind.name in PERSONAL or self.kind.function is not None

    def amount(self, harm: Harm, vehicle: int) -> Floats:
        """Amount that ``vehicle`` (0: Vehicle 1) should minimise, [n]."""
        return self.kind.amount(harm, vehicle, self)

    def weights(self, car: Floats, vehicle: int) -> Floats:
        """Weight of each vehicle's harm in the amount that ``vehicle`` (0: Vehicle 1) should minimise, [n, N].

        ``car`` is the array of a ``State``. Raises ``InvalidInput`` unless the objective is a weighted sum.
        """
        if self.kind.weights is None:
            forms = ", ".join(kind.form for kind in OBJECTIVES.loaded.values() if kind.weights)
            raise InvalidInput(
                f"objective {self.kind.form!r}: is not a weighted sum of the vehicles' harm; use one of {forms}"
            )
        weights = self.kind.weights(car, vehicle, self)
        return np.broadcast_to(weights, (len(car), car.shape[2] - 1)).astype(np.float64)


def _kind(name: str) -> Kind:
    return OBJECTIVES[name]


@lru_cache(maxsize=256)
def parse_objective(text: str) -> Objective:
    """Objective for a text such as ``own``, ``social:45`` or ``weighted:1,4,1``. Raises ``InvalidInput``."""
    name, (_, colon, argument) = objective_name(text), text.partition(":")
    kind = OBJECTIVES[name]
    if name == "vehicle_K":
        if text == name:
            raise InvalidInput("objective 'vehicle_K': must name a vehicle, as in vehicle_3")
        return Objective(kind, (float(text.removeprefix("vehicle_")),))
    if ":" not in kind.form:
        if colon:
            raise InvalidInput(f"objective {text!r}: {name} takes no argument")
        return Objective(kind)
    number = parse_numeral(argument) if kind.arguments is float else 0.0
    if number is None or not math.isfinite(number):
        raise InvalidInput(f"objective {text!r}: {name} needs a number, as in {name}:5")
    if kind.arguments:
        if isinstance(kind.arguments, tuple) and argument not in kind.arguments:
            raise unknown_name(f"argument of the objective {name}", argument, kind.arguments)
        return Objective(kind, argument=argument)
    numerals = [parse_numeral(part.strip()) for part in argument.split(",")]
    numbers = tuple(number for number in numerals if number is not None) if None not in numerals else ()
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


def objective_name(text: str) -> str:
    """Name of an objective without its argument: ``social`` for ``social:45``, ``vehicle_K`` for ``vehicle_3``."""
    return re.sub("vehicle_[1-9][0-9]?", "vehicle_K", text) if ":" not in text else text.partition(":")[0]


def objectives_of(declared: Declared, vehicles: int) -> tuple[Objective, ...]:
    """Objective of each vehicle, front to rear, from one text for all vehicles or a list of texts.

    Raises ``InvalidInput`` for a bad text or the wrong number of texts.
    """
    texts = [declared] * vehicles if isinstance(declared, str) else declared
    if not isinstance(texts, Sequence) or not all(isinstance(text, str) for text in texts):
        raise InvalidInput(
            "objective: must be the name of an objective, for instance own or social:45, or a list with one name per"
            " vehicle"
        )
    if len(texts) != vehicles:
        raise InvalidInput(
            f"objective: the list has {len(texts)} entries; must have {vehicles}, one per vehicle; or give one"
            " objective for all vehicles, without a list"
        )
    parsed = tuple(parse_objective(text) for text in texts)
    for text, objective in zip(texts, parsed, strict=True):
        _check_vehicles(text, objective, vehicles)
    return parsed


def _check_vehicles(text: str, objective: Objective, vehicles: int) -> None:
    numbers = objective.numbers
    if objective.kind.name == "weighted" and len(numbers) != vehicles:
        raise InvalidInput(f"objective {text!r}: has {len(numbers)} weights; must have {vehicles}, one per vehicle")
    if objective.kind.name == "vehicle_K" and numbers[0] > vehicles:
        raise InvalidInput(
            f"objective {text!r}: there is no vehicle_{numbers[0]:.0f}; this scenario has vehicle_1 ..."
            f" vehicle_{vehicles}"
        )


def free_pairs(objective: Objective, vehicle: int, vehicles: int, *, obstacle: bool) -> list[int]:
    """Pairs whose impacts cost ``vehicle`` (0: Vehicle 1) nothing; K: Vehicles K and K + 1, 0: obstacle and Vehicle 1.

    Only for ``weighted`` and ``vehicle_K``, whose weights of 0 may be a mistake. With other objectives, such as ``own``
    or ``social:90``, indifference is intended, and the result is empty. ``obstacle``: whether there is an obstacle.
    """
    if objective.kind.name not in ("weighted", "vehicle_K"):
        return []
    counts = np.concatenate([[0.0], objective.weights(np.ones((1, CAR_ROWS, vehicles + 1)), vehicle)[0]]) > 0.0
    return [pair for pair in range(0 if obstacle else 1, vehicles) if not counts[pair] and not counts[pair + 1]]


def with_every_weight(objective: Objective, vehicles: int) -> str:
    """``weighted`` with 1 for each weight of 0 of ``weighted`` or ``vehicle_K``, and at least 1,000 for the others."""
    weights = objective.numbers
    if objective.kind.name == "vehicle_K":
        weights = tuple(float(vehicle == weights[0]) for vehicle in range(1, vehicles + 1))
    least = min(weight for weight in weights if weight)
    return f"weighted:{','.join(f'{min(1e3 * weight / least, 1e6) if weight else 1:g}' for weight in weights)}"


def amounts(objectives: Sequence[Objective], before: State | None, after: State, count: HarmCount) -> Floats:
    """Increase of the amount that each vehicle should minimise, since ``before`` (None: since the alert), [n, N].

    A weighted sum is computed from the harm since ``before``; any other objective is the amount after minus the amount
    before.
    """
    amounts_after = pair_amounts(after.line, count)
    harm_so_far = Harm.of(amounts_after, after.car)
    if before is None:
        return np.stack([objective.amount(harm_so_far, i) for i, objective in enumerate(objectives)], axis=1)
    amounts_before = pair_amounts(before.line, count)
    growth, harm_before = Harm.of(amounts_after - amounts_before, after.car), Harm.of(amounts_before, after.car)
    columns = [
        objective.amount(growth, i)
        if objective.is_sum
        else objective.amount(harm_so_far, i) - objective.amount(harm_before, i)
        for i, objective in enumerate(objectives)
    ]
    return np.stack(columns, axis=1)


def _cosine_and_sine(angle_deg: float) -> tuple[float, float]:
    """Cosine and sine with the same bits on every processor, from power series in exact fractions."""
    if angle_deg == 90.0:
        return 0.0, 1.0
    angle, term, sums = Fraction(math.radians(angle_deg)), Fraction(1), [Fraction(0), Fraction(0)]
    for k in range(28):
        sums[k % 2] += -term if k % 4 >= 2 else term
        term = term * angle / (k + 1)
    return float(sums[0]), float(sums[1])


def _shares(weights: Floats) -> Floats:
    return weights * (weights.shape[1] / weights.sum(axis=1, keepdims=True))


def _unit_weights(car: Floats, vehicle: int) -> Floats:
    return np.eye(car.shape[2] - 1)[vehicle]


def _social(harm: Harm, vehicle: int, own_weight: float, others_weight: float) -> Floats:
    return own_weight * harm.borne[:, vehicle] + others_weight * (harm.whole - harm.borne[:, vehicle])


def register_objective(
    name: str, function: Callable[..., Floats], *, arguments: Sequence[str] | type[float] = ()
) -> None:
    """Register an objective for scenarios and rewards. Entry points: ``ethbrake_marl.objectives``.

    ``function(harm, vehicle)`` returns the amount that ``vehicle`` (0: Vehicle 1) should minimise, [n], for a ``Harm``;
    its docstring describes this amount. With ``arguments`` the objective is written ``name:argument``, and the argument
    is the function's third parameter: one of the texts in ``arguments``, or any number if ``arguments`` is ``float``.
    Raises ``AlreadyExists`` for a name in use, and ``InvalidInput`` for a bad name or a function without a docstring.
    """
    form = "a-z, 0-9, - and _, beginning with a letter or digit, and no name of a vehicle"
    meaning = description_of("objective", name, function, r"(?!vehicle_\d+$)[a-z0-9][a-z0-9_-]{0,63}", form)

    def amount(harm: Harm, vehicle: int, objective: Objective) -> Floats:
        what = f"objective {name!r} of vehicle_{vehicle + 1}"
        argument = float(objective.argument) if arguments is float else objective.argument
        call_arguments = (harm, vehicle, argument) if arguments else (harm, vehicle)
        value = call_function(what, function, call_arguments, harm.whole.shape)
        if not np.isfinite(value).all():
            raise InvalidInput(f"{what}: its value is not finite in row {int(np.argmin(np.isfinite(value)))}")
        return value.astype(np.float64)

    listed = () if isinstance(arguments, type) else arguments
    is_list = isinstance(listed, Sequence) and all(isinstance(argument, str) for argument in listed)
    if not is_list or (isinstance(arguments, type) and arguments is not float):
        raise InvalidInput(f"objective {name!r}: arguments = {arguments!r:.60}: must be a list of texts, or float")
    form = f"{name}:{'|'.join(listed) or 'NUMBER'}" if arguments else name
    allowed = float if isinstance(arguments, type) else tuple(listed)
    kind = Kind(form, meaning, amount, function=function, arguments=allowed)
    OBJECTIVES.add(name, kind, lambda registered: registered.function is function)


OBJECTIVES: Registry[Kind] = Registry(
    "objective",
    "objectives",
    register_objective,
    {
        "total": Kind(
            "total", "harm of all vehicles, with equal weights", lambda harm, i, written: harm.whole,
            lambda car, i, written: np.ones(car.shape[2] - 1),
        ),
        "own": Kind(
            "own", "harm that the vehicle itself bears", lambda harm, i, written: harm.borne[:, i],
            lambda car, i, written: _unit_weights(car, i),
        ),
        "social": Kind(
            "social:ANGLE", "social value orientation: own harm at 0 degrees, harm of the others at 90 degrees",
            lambda harm, i, written: _social(harm, i, *written.numbers),
            lambda car, i, written: np.where(_unit_weights(car, i), *written.numbers),
        ),
        "maximin": Kind(
            "maximin", "harm of the vehicle that bears most", lambda harm, i, written: harm.borne.max(axis=1)
        ),
        "weighted": Kind(
            "weighted:W1,W2,...", "harm of all vehicles, with one given weight per vehicle",
            lambda harm, i, written: harm.weighted(np.full(harm.borne.shape, written.numbers)),
            lambda car, i, written: _shares(np.array([written.numbers])),
        ),
        "vehicle_K": Kind(
            "vehicle_K", "harm that Vehicle K bears",
            lambda harm, i, written: harm.borne[:, int(written.numbers[0]) - 1],
            lambda car, i, written: _unit_weights(car, int(written.numbers[0]) - 1),
        ),
    },
)  # fmt: skip
