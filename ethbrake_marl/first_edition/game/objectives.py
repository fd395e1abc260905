"""Objectives: the amount that each vehicle should minimise, computed from the harm in a ledger.

In this table, ``H_i`` is the harm that vehicle i bears (m2/s2), ``H`` the harm of all N vehicles, and ``m_i`` the mass
of vehicle i. The amounts are in m2/s2, except for the objective ``injury``:

==================  ================================================================================================
objective           amount for vehicle i
==================  ================================================================================================
total               ``H``, the harm of all vehicles
own                 ``H_i``, the harm of the vehicle itself
social:phi          ``cos(phi) H_i + sin(phi) (H - H_i)``, social value orientation; the angle phi is 0 for own harm
                    only, 45 degrees for a prosocial vehicle, and 90 degrees for the harm of the other vehicles only
maximin             ``max_j H_j``, the harm of the vehicle that bears most
mass-weighted       ``N sum_j m_j H_j / sum_j m_j``: the harm of a heavy vehicle has a larger weight
weighted:w1,w2,...  ``N sum_j w_j H_j / sum_j w_j`` with one weight per vehicle (0, or 1e-6 to 1e6), for example its
                    number of occupants
preference          the formula of ``weighted``, with the weights ``harm_weight`` that the scenario declares
injury:curve        expected injuries in 1,000 lines; a vehicle's injury risk is the risk by impacts at its front or the
                    risk by impacts at its rear, whichever is larger (``Ledger.speed_changes``)
==================  ================================================================================================

Arguments that several functions share: ``ledger`` has the harm in n worlds since the start of the episode.
``harm_count`` selects first-impact harm (``"first"``) or total harm (``"total"``). ``objectives`` has the objective of
each of the N vehicles, front to rear.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np

from ethbrake_marl.errors import InvalidInput, describe_error, unknown_name
from ethbrake_marl.files.yaml import parse_numeral
from ethbrake_marl.first_edition.game.harm import INJURY_CURVES, HarmCount, Ledger, injury_probability
from ethbrake_marl.first_edition.physics.state import Floats
from ethbrake_marl.registry import Registry

# objectives without parameters that depend on the scenario, so that every scenario can use them
STANDARD = ("total", "own", "social:45", "maximin", "mass-weighted")

_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")

Declared = str | tuple[str, ...]  # one objective for all vehicles, or one per vehicle


class Objective(NamedTuple):
    """An objective, parsed by ``parse_objective`` from a text such as ``social:45``."""

    kind: str  # name before the colon, such as ``social``
    angle_deg: float = 0.0  # angle phi of the objective ``social`` (degrees)
    weights: tuple[float, ...] = ()  # weights of the objective ``weighted``, one per vehicle
    curve: str = ""  # injury curve of the objective ``injury``, a key of ``INJURY_CURVES``


class HarmSoFar(NamedTuple):
    """Data from which an objective computes its amount, in n worlds of N vehicles."""

    borne: Floats  # [n, N] harm that each vehicle bears, m2/s2
    whole: Floats  # [n] harm of all vehicles, m2/s2
    mass_t: Floats  # [n, N] mass of each vehicle, t
    front_change_mps: Floats  # [n, N] change of speed of each vehicle by impacts at its front, m/s; 0 without an impact
    rear_change_mps: Floats  # [n, N] change of speed of each vehicle by impacts at its rear, m/s; 0 without an impact
    harm_weight: Floats  # [n, N] weight of each vehicle's harm in the objective ``preference``


class Weighed(Protocol):
    """Data from which an objective can compute the weights of the vehicles' harm: a ``Ledger`` or ``Vehicles``."""

    @property
    def mass_t(self) -> Floats:
        """Mass of each vehicle, [n, N] t."""

    @property
    def harm_weight(self) -> Floats:
        """Weight of each vehicle's harm in the objective ``preference``, [n, N]."""


ObjectiveFunction = Callable[[HarmSoFar, int], Floats]


class Kind(NamedTuple):
    """A kind of objective, built in or registered."""

    form: str  # how a scenario writes the objective, such as ``social:ANGLE``; without ":" it takes no argument
    about: str  # meaning of the objective, in words
    amount: Callable[[Objective, HarmSoFar, int], Floats]  # (objective, harm, vehicle) -> amount to minimise, [n]
    function: ObjectiveFunction | None = None  # function of a registered objective; None: built in
    # (objective, vehicles, vehicle) -> weights of the vehicles' harm, [n, N]; None: the amount is not a weighted sum
    weights: Callable[[Objective, Weighed, int], Floats] | None = None


@lru_cache(maxsize=256)
def parse_objective(text: str) -> Objective:
    """Parse the text of an objective: ``total``, ``own``, ``social:45``, ``weighted:1,4,1``, ``injury:lr4s``, ...

    Raises ``InvalidInput`` for an unknown name or injury curve, an angle outside [0, 90] degrees, a weight that is
    neither 0 nor in [1e-6, 1e6], and weights that are all 0.
    """
    kind, colon, argument = text.partition(":")
    if ":" not in OBJECTIVES[kind].form:
        if colon:
            raise InvalidInput(f"objective {text!r}: {kind} takes no argument")
        return Objective(kind)
    if kind == "injury":
        if argument not in INJURY_CURVES:
            raise unknown_name("injury curve", argument, INJURY_CURVES)
        return Objective(kind, curve=argument)
    written = [parse_numeral(part.strip()) for part in argument.split(",")]
    numbers = tuple(number for number in written if number is not None) if None not in written else ()
    if kind == "social":
        if len(numbers) != 1 or not 0.0 <= numbers[0] <= 90.0:
            raise InvalidInput(f"objective {text!r}: social needs an angle from 0 to 90 degrees, as in social:45")
        return Objective(kind, angle_deg=numbers[0])
    if not (any(numbers) and all(weight == 0.0 or 1e-6 <= weight <= 1e6 for weight in numbers)):
        raise InvalidInput(
            f"objective {text!r}: weighted needs one weight per vehicle, as in weighted:1,4,1; a weight is 0 or from"
            " 1e-6 to 1e6, and at least one weight must not be 0"
        )
    return Objective(kind, weights=numbers)


def check_declared(declared: object) -> None:
    """Raise ``InvalidInput`` unless ``declared`` is the text of an objective, such as ``own``, or a list of such texts.

    The number of texts is not checked.
    """
    each = [declared] if isinstance(declared, str) else declared
    if not isinstance(each, list | tuple) or not all(isinstance(text, str) for text in each):
        raise InvalidInput(
            "objective: must be the name of an objective, for instance own or social:45, or a list with one name per"
            " vehicle"
        )
    for text in each:
        parse_objective(text)


def objectives_of(declared: Declared, vehicles: int) -> tuple[Objective, ...]:
    """Return the parsed objective of each vehicle, front to rear.

    ``declared`` is one text for all vehicles, or one text per vehicle. Raises ``InvalidInput`` for an invalid
    objective, or if the number of texts or weights differs from the number of ``vehicles``.
    """
    check_declared(declared)
    each = (declared,) * vehicles if isinstance(declared, str) else tuple(declared)
    if len(each) != vehicles:
        raise InvalidInput(
            f"objective: the list has {len(each)} entries; must have {vehicles}, one per vehicle; or give one objective"
            " for all vehicles, without a list"
        )
    parsed = tuple(parse_objective(text) for text in each)
    for text, objective in zip(each, parsed, strict=True):
        if objective.weights and len(objective.weights) != vehicles:
            names = len(objective.weights)
            raise InvalidInput(f"objective {text!r}: has {names} weights; must have {vehicles}, one per vehicle")
    return parsed


def objective_harm(ledger: Ledger, harm_count: HarmCount, objectives: Sequence[Objective]) -> Floats:
    """Return the amount that each vehicle should minimise, [n, N] m2/s2, or injuries in 1,000 lines for ``injury``."""
    harms = ledger.vehicle_harm(harm_count), ledger.world_harm(harm_count)
    # only objectives that are not weighted sums may use changes of speed
    no_sums = any(OBJECTIVES[each.kind].weights is None for each in objectives)
    changes = ledger.speed_changes(harm_count) if no_sums else 2 * (np.full(ledger.mass_t.shape, np.nan),)
    arrays = *harms, ledger.mass_t, *changes, ledger.harm_weight
    harm = HarmSoFar(*(np.broadcast_to(each, each.shape) for each in arrays))  # read-only views
    return np.stack([OBJECTIVES[o.kind].amount(o, harm, i) for i, o in enumerate(objectives)], axis=1)


def added_harm(before: Ledger, after: Ledger, harm_count: HarmCount, objectives: Sequence[Objective]) -> Floats:
    """Return how much a step changes the amount that each vehicle should minimise, [n, N].

    For an objective that is a weighted sum of the vehicles' harms, the change is the weighted sum of the harms in this
    step. For any other objective, the change is the amount after the step minus the amount before the step. ``before``
    and ``after`` are the ledgers at the beginning and at the end of the step.
    """
    sums = [OBJECTIVES[each.kind].weights is not None for each in objectives]
    harm = objective_harm(after.since(before), harm_count, objectives) if any(sums) else 0.0
    if all(sums):
        return np.asarray(harm)
    whole = objective_harm(after, harm_count, objectives) - objective_harm(before, harm_count, objectives)
    return np.where(sums, harm, whole)


def aim_of(objective: Objective, line: Weighed, vehicle: int) -> tuple[Floats, bool]:
    """Return the weight of each vehicle's harm in an objective, [n, N], and how the weighted harms are combined.

    The second result is False if the objective is the sum of the weighted harms, and True if it is the largest weighted
    harm. ``vehicle`` is the index of the vehicle that has this objective (0 = front). Raises ``InvalidInput`` for an
    objective such as ``injury``, which is neither a sum nor a maximum of weighted harms.
    """
    weights = OBJECTIVES[objective.kind].weights
    if objective.kind == "maximin":
        return np.ones(line.mass_t.shape), True
    if weights is None:
        known = ", ".join(kind.form for kind in _BUILT_IN.values() if kind.weights) + ", maximin"
        raise InvalidInput(
            f"objective {objective.kind!r}: is not a weighted sum of the vehicles' harm; use one of {known}"
        )
    return np.broadcast_to(weights(objective, line, vehicle), line.mass_t.shape).astype(np.float64), False


def standard_objectives() -> tuple[str, ...]:
    """Return the names of the objectives that every scenario can use, including loaded registered objectives."""
    return (*STANDARD, *(name for name, kind in OBJECTIVES.loaded.items() if kind.function is not None))


def register_objective(name: str, function: ObjectiveFunction) -> None:
    """Register an objective, so that scenarios, rewards and ``--objective`` can use it under ``name``.

    An installed package registers an objective with an entry point of the group ``ethbrake_marl.first_edition.objectives`` that names
    the function.

    Registering the same function again under the same name changes nothing. Raises ``AlreadyExists`` if the name
    belongs to another objective, and ``InvalidInput`` for an invalid name or a function without a docstring.

    Args:
        name: 1 to 64 characters ``a-z``, ``0-9``, ``-`` and ``_``, beginning with a letter or digit.
        function: ``function(harm, vehicle)`` takes a ``HarmSoFar`` and the index of a vehicle (0 = front), and returns
            the amount that this vehicle should minimise, [n] m2/s2. The docstring of ``function`` is shown as the
            description of the objective.

    """
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise InvalidInput(
            f"objective {name!r:.80}: the name must be 1 to 64 characters a-z, 0-9, - and _, beginning with a letter or"
            " digit"
        )
    if not callable(function) or not (function.__doc__ or "").strip():
        raise InvalidInput(f"objective {name!r}: must be a function with a docstring that describes the objective")

    def amount(_: Objective, harm: HarmSoFar, vehicle: int) -> Floats:
        try:
            harms = np.asarray(function(harm, vehicle))
        except Exception as error:
            raise InvalidInput(
                f"objective {name!r}: its function fails for vehicle_{vehicle + 1}: {describe_error(error)}"
            ) from error
        worlds = len(harm.whole)
        if harms.shape != (worlds,) or harms.dtype.kind not in "fiub":
            raise InvalidInput(
                f"objective {name!r}: its function returned {harms.dtype} values of shape {harms.shape}; must return"
                f" numbers of shape ({worlds},), one per world"
            )
        if not np.isfinite(harms).all():
            world = int(np.argmin(np.isfinite(harms)))
            raise InvalidInput(
                f"objective {name!r}: its function returned {harms[world]} for vehicle_{vehicle + 1} in world {world};"
                " must be finite"
            )
        return harms.astype(np.float64)

    entry = Kind(name, " ".join((function.__doc__ or "").split()), amount, function)
    OBJECTIVES.add(name, entry, lambda kind: kind.function is function)


def scored(ledger: Ledger, harm_count: HarmCount, declared: Sequence[Declared] | None = None) -> dict[str, Floats]:
    """Return the amounts that vehicles should minimise under several objectives: ``{"own": [n, N], ...}``.

    All amounts are computed from the same harm, so a policy can be evaluated under objectives for which it was not
    trained. Amounts are in m2/s2, or injuries in 1,000 lines for the objective ``injury``; less is better.

    Each item of ``declared`` is the text of one objective for all vehicles, or a tuple with one text per vehicle. None
    means ``standard_objectives()``. Raises ``InvalidInput`` if ``declared`` is a single text instead of a list.
    """
    if isinstance(declared, str):
        raise InvalidInput(f"scored = {declared!r}: must be a list of objectives, for instance [{declared!r}]")
    for each in declared or ():
        check_declared(each)
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


@lru_cache
def _social_weights(angle_deg: float) -> tuple[float, float]:
    """Return the weight of own harm, cos(angle), and the weight of the other vehicles' harm, sin(angle).

    At 90 degrees the weights are exactly 0 and 1. The power series of cosine and sine are summed in exact fractions and
    rounded once, because results of the C library differ between processors in the last bits.
    """
    if angle_deg == 90.0:
        return 0.0, 1.0
    angle, term, sums = Fraction(math.radians(angle_deg)), Fraction(1), [Fraction(0), Fraction(0)]
    for k in range(28):
        sums[k % 2] += -term if k % 4 >= 2 else term
        term = term * angle / (k + 1)
    return float(sums[0]), float(sums[1])


def _injured(objective: Objective, harm: HarmSoFar, vehicle: int) -> Floats:
    """Return how many injuries are expected in 1,000 lines of vehicles, [n]; the number does not depend on ``vehicle``.

    For a vehicle that is hit at its front and at its rear, the larger of the two injury risks is used. If the risk of
    the larger change of speed were used instead, a further impact could lower the number of injuries, because the same
    change of speed leads to different risks at the front and at the rear.
    """
    del vehicle
    front, rear = harm.front_change_mps, harm.rear_change_mps
    injured = np.zeros(len(front))
    for j in range(front.shape[1]):
        by_front = np.where(front[:, j] > 0.0, injury_probability(front[:, j], "front", objective.curve), 0.0)
        by_rear = np.where(rear[:, j] > 0.0, injury_probability(rear[:, j], "rear", objective.curve), 0.0)
        injured = injured + 1_000.0 * np.maximum(by_front, by_rear)
    return injured


def weighted_harm(borne: Floats, weights: Floats) -> Floats:
    """Return ``N (sum_j w_j H_j) / (sum_j w_j)``, [n] m2/s2. Each sum over j runs over the vehicles from front to rear.

    ``borne`` has the harm H_j that each vehicle bears, [n, N] m2/s2; ``weights`` has the weights w_j, [n, N].
    """
    n, vehicles = borne.shape
    harm, whole = np.zeros(n), np.zeros(n)
    for j in range(vehicles):
        harm = harm + weights[:, j] * borne[:, j]
        whole = whole + weights[:, j]
    mean: Floats = vehicles * harm / whole
    return mean


def _shares(weights: Floats) -> Floats:
    """Return ``weights`` [n, N], each divided by the mean weight of the vehicles in the same world."""
    shares: Floats = weights * (weights.shape[1] / weights.sum(axis=1, keepdims=True))
    return shares


_BUILT_IN: dict[str, Kind] = {
    "total": Kind(
        "total",
        "harm of all vehicles, with equal weights",
        lambda _, harm, vehicle: harm.whole,
        weights=lambda _, line, vehicle: np.ones(line.mass_t.shape[1]),
    ),
    "own": Kind(
        "own",
        "harm that the vehicle itself bears",
        lambda _, harm, vehicle: harm.borne[:, vehicle],
        weights=lambda _, line, vehicle: np.eye(line.mass_t.shape[1])[vehicle],
    ),
    "social": Kind(
        "social:ANGLE",
        "social value orientation: own harm at 0 degrees, harm of the other vehicles at 90 degrees",
        _social,
        weights=lambda objective, line, vehicle: np.where(
            np.eye(line.mass_t.shape[1])[vehicle], *_social_weights(objective.angle_deg)
        ),
    ),
    "maximin": Kind("maximin", "harm of the vehicle that bears most", lambda _, harm, vehicle: harm.borne.max(axis=1)),
    "mass-weighted": Kind(
        "mass-weighted",
        "harm of all vehicles, weighted by their masses",
        lambda _, harm, vehicle: weighted_harm(harm.borne, harm.mass_t),
        weights=lambda _, line, vehicle: _shares(line.mass_t),
    ),
    "weighted": Kind(
        "weighted:W1,W2,...",
        "harm of all vehicles, with one given weight per vehicle",
        lambda objective, harm, vehicle: weighted_harm(harm.borne, np.full(harm.borne.shape, objective.weights)),
        weights=lambda objective, line, vehicle: _shares(np.array([objective.weights])),
    ),
    "preference": Kind(
        "preference",
        "harm of all vehicles, with the weights harm_weight of the scenario",
        lambda _, harm, vehicle: weighted_harm(harm.borne, harm.harm_weight),
        weights=lambda _, line, vehicle: _shares(line.harm_weight),
    ),
    "injury": Kind(
        "injury:CURVE",
        "expected injuries in 1,000 lines, by the impact with the largest risk for each vehicle",
        _injured,
    ),
}

OBJECTIVES: Registry[Kind] = Registry("objective", "first_edition.objectives", register_objective, _BUILT_IN)
