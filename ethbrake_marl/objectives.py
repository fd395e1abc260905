"""Objectives, whose harm counts: what each vehicle's objective makes of the harm of the line, from the one ledger.

Every objective is an amount of harm (m2/s2) to be made small; ``H_i`` is what vehicle i bears, ``H`` what all do:

==================  ================================================================================================
total               ``H``: everybody's harm alike; the same number for all vehicles
own                 ``H_i``
social:phi          ``cos(phi) H_i + sin(phi) (H - H_i)``, social value orientation: phi from 0 (own harm only) over 45
                    (prosocial) to 90 degrees (the others' only)
maximin             ``max_j H_j``: the harm of whoever bears most
mass-weighted       ``N sum_j m_j H_j / sum_j m_j``: harm in a heavy vehicle counts for more
weighted:w1,w2,...  ``N sum_j w_j H_j / sum_j w_j``: one weight (1e-6 to 1e6) for each vehicle, as for its occupants
==================  ================================================================================================
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import lru_cache
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from ethbrake_marl.errors import AlreadyExists, InvalidInput, describe_error, unknown_name
from ethbrake_marl.files.yaml import parse_numeral
from ethbrake_marl.harm import HarmCount, Ledger
from ethbrake_marl.physics.worlds import Floats, unwritable

STANDARD = ("total", "own", "social:45", "maximin", "mass-weighted")  # those that need no knowledge of the scenario

_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")

Declared = str | tuple[str, ...]  # one objective for all vehicles, or one for each


class Objective(NamedTuple):
    """A parsed objective."""

    kind: str
    angle_deg: float = 0.0
    weights: tuple[float, ...] = ()


class HarmSoFar(NamedTuple):
    """What objectives are computed from, for n worlds of N vehicles; it cannot be written to."""

    borne: Floats  # [n, N] what each vehicle bears, m2/s2
    whole: Floats  # [n] what all do
    mass_t: Floats  # [n, N]


ObjectiveFunction = Callable[[HarmSoFar, int], Floats]


class Kind(NamedTuple):
    """One line of the table of objectives."""

    form: str  # how it is written; without ":" it takes no argument
    about: str
    amount: Callable[[Objective, HarmSoFar, int], Floats]  # of a vehicle, [n]: less is better
    function: ObjectiveFunction | None = None  # what somebody registered


@lru_cache(maxsize=256)
def parse_objective(text: str) -> Objective:
    """Read ``total``, ``own``, ``social:45``, ``maximin``, ``mass-weighted`` or ``weighted:1,4,1``.

    Raises ``InvalidInput`` for an unknown name, an angle outside [0, 90] degrees, or a weight outside [1e-6, 1e6].
    """
    kind, colon, argument = text.partition(":")
    if kind not in KINDS:
        raise unknown_name("objective", kind, KINDS, may_be_own=True)
    if ":" not in KINDS[kind].form:
        if colon:
            raise InvalidInput(f"objective {text!r}: {kind} takes no argument")
        return Objective(kind)
    written = [parse_numeral(part.strip()) for part in argument.split(",")]
    numbers = tuple(number for number in written if number is not None) if None not in written else ()
    if kind == "social":
        if len(numbers) != 1 or not 0.0 <= numbers[0] <= 90.0:
            raise InvalidInput(f"objective {text!r}: social needs an angle from 0 to 90 degrees, as in social:45")
        return Objective(kind, angle_deg=numbers[0])
    if not numbers or not all(1e-6 <= weight <= 1e6 for weight in numbers):
        raise InvalidInput(
            f"objective {text!r}: weighted needs a weight from 1e-6 to 1e6 for each vehicle, as in weighted:1,4,1"
        )
    return Objective(kind, weights=numbers)


def check_declared(declared: object) -> None:
    """Refuse, with ``InvalidInput``, what is not an objective or a list of some, however many vehicles there are."""
    each = [declared] if isinstance(declared, str) else declared
    if not isinstance(each, list | tuple) or not all(isinstance(text, str) for text in each):
        raise InvalidInput("objective: must be a name, for instance own or social:45, or a list with one per vehicle")
    for text in each:
        parse_objective(text)


def objectives_of(declared: Declared, vehicles: int) -> tuple[Objective, ...]:
    """The objective of each of ``vehicles`` vehicles; ``InvalidInput`` if there are too many or too few."""
    check_declared(declared)
    each = (declared,) * vehicles if isinstance(declared, str) else tuple(declared)
    if len(each) != vehicles:
        raise InvalidInput(
            f"objective: {len(each)} entries; {vehicles} vehicles need {vehicles} (one per vehicle), or one for all"
        )
    parsed = tuple(parse_objective(text) for text in each)
    for text, objective in zip(each, parsed, strict=True):
        if objective.weights and len(objective.weights) != vehicles:
            given = len(objective.weights)
            raise InvalidInput(f"objective {text!r}: {given} weights; {vehicles} vehicles need {vehicles}")
    return parsed


def objective_harm(ledger: Ledger, harm_count: HarmCount, objectives: Sequence[Objective]) -> Floats:
    """What the objective of each vehicle makes of the harm so far, [n, N] (m2/s2): less is better."""
    told = ledger.vehicle_harm(harm_count), ledger.world_harm(harm_count), ledger.mass_t
    harm = HarmSoFar(*(unwritable(each) for each in told))
    return np.stack([KINDS[o.kind].amount(o, harm, i) for i, o in enumerate(objectives)], axis=1)


def standard_objectives() -> tuple[str, ...]:
    """The built-in objectives that need no knowledge of the scenario, then the registered ones."""
    return (*STANDARD, *(name for name, kind in KINDS.items() if kind.function is not None))


def register_objective(name: str, function: ObjectiveFunction) -> None:
    """Make ``objective: name`` known to every scenario and reward, and to ``--objective``.

    Args:
        name: 1 to 64 of ``a-z``, digits, ``-`` and ``_``.
        function: from ``HarmSoFar`` and the vehicle (0 = front) to the amount of harm that this vehicle is to make
            small, [n] (m2/s2); its docstring says what it is.

    Registering the same again changes nothing. Raises ``AlreadyExists`` for another one under a name that is taken,
    ``InvalidInput`` for a name that is none and for a function without a docstring.

    """
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise InvalidInput(f"objective {name!r:.80}: must be 1 to 64 of a-z, 0-9, - and _, not beginning with - or _")
    if not callable(function) or not (function.__doc__ or "").strip():
        raise InvalidInput(f"objective {name!r}: needs a function with a docstring that says what it is")

    def amount(_: Objective, harm: HarmSoFar, vehicle: int) -> Floats:
        try:
            value = function(harm, vehicle)
        except Exception as error:
            raise InvalidInput(f"objective {name!r}: of vehicle_{vehicle + 1}: {describe_error(error)}") from error
        return _checked(name, value, vehicle, len(harm.whole))

    entry = Kind(name, " ".join((function.__doc__ or "").split()), amount, function)
    if KINDS.setdefault(name, entry).function is not function:
        raise AlreadyExists(f"objective {name!r} is registered already; give another name")


def _checked(name: str, value: object, vehicle: int, worlds: int) -> Floats:
    amount = np.asarray(value)
    if amount.shape != (worlds,) or amount.dtype.kind not in "fiub":
        raise InvalidInput(
            f"objective {name!r}: gave {amount.dtype} of shape {amount.shape}; must be numbers of shape ({worlds},),"
            " one per world"
        )
    if not np.isfinite(amount).all():
        world = int(np.argmin(np.isfinite(amount)))
        raise InvalidInput(
            f"objective {name!r}: is {amount[world]} for vehicle_{vehicle + 1} in world {world}; must be finite"
        )
    return amount.astype(np.float64)


class _NameSchema:
    """The JSON schema of an objective: what is known when it is asked for."""

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        plain = [name for name, kind in KINDS.items() if ":" not in kind.form]
        with_argument = "|".join(name for name, kind in KINDS.items() if ":" in kind.form)
        return {"type": "string", "anyOf": [{"enum": plain}, {"pattern": f"^({with_argument}):"}]}


ObjectiveName = Annotated[str, _NameSchema]


def scored(ledger: Ledger, harm_count: HarmCount, declared: Sequence[Declared] | None = None) -> dict[str, Floats]:
    """The same ledger under several objectives: objective -> what it is for each vehicle, [n, N] (m2/s2).

    So one policy, whatever it was trained for, is told under all of them. ``InvalidInput`` for a name without its list.
    """
    if isinstance(declared, str):
        raise InvalidInput(f"scored: {declared!r}: must be a list of objectives, for instance [{declared!r}]")
    vehicles, declared = ledger.mass_t.shape[1], standard_objectives() if declared is None else declared
    return {
        each if isinstance(each, str) else ", ".join(each): objective_harm(
            ledger, harm_count, objectives_of(each, vehicles)
        )
        for each in declared
    }


def _social(objective: Objective, harm: HarmSoFar, vehicle: int) -> Floats:
    own, others = _social_weights(objective.angle_deg)
    rest = harm.whole - harm.borne[:, vehicle]
    return own * harm.borne[:, vehicle] + others * rest


def _maximin(objective: Objective, harm: HarmSoFar, vehicle: int) -> Floats:
    worst: Floats = harm.borne.max(axis=1)
    return worst


def _mass_weighted(objective: Objective, harm: HarmSoFar, vehicle: int) -> Floats:
    return _weighted(harm.borne, harm.mass_t)


def _weighted_by_list(objective: Objective, harm: HarmSoFar, vehicle: int) -> Floats:
    return _weighted(harm.borne, np.full(harm.borne.shape, objective.weights))


@lru_cache
def _social_weights(angle_deg: float) -> tuple[float, float]:
    """Weights of the own harm and of the others': cosine and sine; exactly 0 and 1 at 90 degrees too.

    By their series in exact fractions, rounded once: the C library's have other last bits on other processors.
    """
    if angle_deg == 90.0:
        return 0.0, 1.0
    angle, term, sums = Fraction(math.radians(angle_deg)), Fraction(1), [Fraction(0), Fraction(0)]
    for k in range(28):
        sums[k % 2] += -term if k % 4 >= 2 else term
        term = term * angle / (k + 1)
    return float(sums[0]), float(sums[1])


def _weighted(borne: Floats, weights: Floats) -> Floats:
    """``N sum_j w_j H_j / sum_j w_j``, summed front to rear: the same bits in any batch."""
    n, vehicles = borne.shape
    harm, whole = np.zeros(n), np.zeros(n)
    for j in range(vehicles):
        harm = harm + weights[:, j] * borne[:, j]
        whole = whole + weights[:, j]
    mean: Floats = vehicles * harm / whole
    return mean


KINDS: dict[str, Kind] = {
    "total": Kind("total", "everybody's harm alike", lambda _, harm, vehicle: harm.whole),
    "own": Kind("own", "what the vehicle itself bears", lambda _, harm, vehicle: harm.borne[:, vehicle]),
    "social": Kind("social:ANGLE", "social value orientation: own harm at 0, the others' at 90 degrees", _social),
    "maximin": Kind("maximin", "the harm of whoever bears most", _maximin),
    "mass-weighted": Kind("mass-weighted", "harm in a heavy vehicle counts for more", _mass_weighted),
    "weighted": Kind("weighted:W1,W2,...", "one weight for each vehicle", _weighted_by_list),
}
