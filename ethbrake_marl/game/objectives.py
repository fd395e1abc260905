"""Objectives: whose harm counts. Each turns the harm of the line, from the one ledger, into an amount per vehicle.

Every objective but the last is an amount of harm (m2/s2) to be minimised; ``H_i`` is the harm that vehicle i bears,
``H`` the harm of all vehicles:

==================  ================================================================================================
total               ``H``: everybody's harm alike; the same number for all vehicles
own                 ``H_i``
social:phi          ``cos(phi) H_i + sin(phi) (H - H_i)``, social value orientation: phi from 0 (own harm only)
                    over 45 (prosocial) to 90 degrees (the others' only)
maximin             ``max_j H_j``: the harm of the vehicle that bears most
mass-weighted       ``N sum_j m_j H_j / sum_j m_j``: harm in a heavy vehicle counts for more
weighted:w1,w2,...  ``N sum_j w_j H_j / sum_j w_j``: a weight (0, or 1e-6 to 1e6) per vehicle, such as its occupants
preference          the same, with the weights ``harm_weight`` that the scenario gives or draws for each world
injury:curve        injuries in 1,000 lines, by the pair that injures a vehicle more (``Ledger.speed_changes``)
==================  ================================================================================================
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
from ethbrake_marl.game.harm import INJURY_CURVES, HarmCount, Ledger, injury_probability
from ethbrake_marl.physics.state import Floats
from ethbrake_marl.registry import Registry

STANDARD = ("total", "own", "social:45", "maximin", "mass-weighted")  # objectives that fit every scenario

_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")

Declared = str | tuple[str, ...]  # one objective for all vehicles, or one per vehicle


class Objective(NamedTuple):
    """An objective that ``parse_objective`` has read from a text such as ``social:45``."""

    kind: str  # name before the colon, such as ``social``
    angle_deg: float = 0.0  # angle of ``social`` (degrees)
    weights: tuple[float, ...] = ()  # weights of ``weighted``, one per vehicle
    curve: str = ""  # curve of ``injury``, a key of ``INJURY_CURVES``


class HarmSoFar(NamedTuple):
    """Read-only input of an objective: harm, masses and changes of speed in n worlds of N vehicles."""

    borne: Floats  # [n, N] harm that each vehicle bears, m2/s2
    whole: Floats  # [n] harm of all vehicles, m2/s2
    mass_t: Floats  # [n, N] mass of each vehicle, t
    front_change_mps: Floats  # [n, N] change of speed of each vehicle by impacts in front, m/s; 0: not hit there
    rear_change_mps: Floats  # [n, N] change of speed of each vehicle by impacts at the rear, m/s; 0: not hit there
    harm_weight: Floats  # [n, N] weight of each vehicle's harm in the objective ``preference``


class Weighed(Protocol):
    """What an objective may weigh the vehicles of n lines by; a ``Ledger`` and ``Vehicles`` have it."""

    @property
    def mass_t(self) -> Floats:
        """Mass of each vehicle, [n, N] t."""

    @property
    def harm_weight(self) -> Floats:
        """Weight of each vehicle's harm in the objective ``preference``, [n, N]."""


ObjectiveFunction = Callable[[HarmSoFar, int], Floats]


class Kind(NamedTuple):
    """One kind of objective, built in or registered: a line of the table at the top of this file."""

    form: str  # how it is written; no argument if there is no ":"
    about: str  # what it means, in words
    amount: Callable[[Objective, HarmSoFar, int], Floats]  # (objective, harm, vehicle) -> amount [n]: less is better
    function: ObjectiveFunction | None = None  # the function of a registered objective
    weights: Callable[[Objective, Weighed, int], Floats] | None = None  # (objective, line, vehicle) -> [n, N]


@lru_cache(maxsize=256)
def parse_objective(text: str) -> Objective:
    """Parse the text of an objective: ``total``, ``own``, ``social:45``, ``weighted:1,4,1``, ``injury:lr4s``, ...

    Raises ``InvalidInput`` for an unknown name, an angle outside [0, 90] degrees, a weight that is neither 0 nor
    in [1e-6, 1e6], weights that are all 0, or an unknown curve.
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
            f"objective {text!r}: weighted needs a weight for each vehicle, 0 or from 1e-6 to 1e6 and not 0 for all, as"
            " in weighted:1,4,1"
        )
    return Objective(kind, weights=numbers)


def check_declared(declared: object) -> None:
    """Raise ``InvalidInput`` unless ``declared`` is an objective as a scenario writes it, such as ``own``, or a list.

    The number of objectives in a list is not checked here.
    """
    each = [declared] if isinstance(declared, str) else declared
    if not isinstance(each, list | tuple) or not all(isinstance(text, str) for text in each):
        raise InvalidInput("objective: must be a name, for instance own or social:45, or a list with one per vehicle")
    for text in each:
        parse_objective(text)


def objectives_of(declared: Declared, vehicles: int) -> tuple[Objective, ...]:
    """Return the parsed objective of each of ``vehicles`` vehicles; raise ``InvalidInput`` if their number is wrong.

    ``declared``: the text of one objective for all vehicles, or one text per vehicle.
    """
    check_declared(declared)
    each = (declared,) * vehicles if isinstance(declared, str) else tuple(declared)
    if len(each) != vehicles:
        raise InvalidInput(
            f"objective: {len(each)} entries; {vehicles} vehicles need {vehicles} (one per vehicle), or one for all"
        )
    parsed = tuple(parse_objective(text) for text in each)
    for text, objective in zip(each, parsed, strict=True):
        if objective.weights and len(objective.weights) != vehicles:
            names = len(objective.weights)
            raise InvalidInput(f"objective {text!r}: {names} weights; {vehicles} vehicles need {vehicles}")
    return parsed


def objective_harm(ledger: Ledger, harm_count: HarmCount, objectives: Sequence[Objective]) -> Floats:
    """Return what each vehicle should minimise, for the harm so far, [n, N] (m2/s2, or injuries in 1,000 lines).

    Args:
        ledger: harm of n worlds since the start of the episode.
        harm_count: impacts that count: ``"first"`` of each pair, or ``"total"``.
        objectives: objective of each vehicle, N of them.

    """
    harms = ledger.vehicle_harm(harm_count), ledger.world_harm(harm_count)
    no_sums = any(OBJECTIVES[each.kind].weights is None for each in objectives)  # only these may read changes of speed
    changes = ledger.speed_changes(harm_count) if no_sums else 2 * (np.full(ledger.mass_t.shape, np.nan),)
    arrays = *harms, ledger.mass_t, *changes, ledger.harm_weight
    harm = HarmSoFar(*(np.broadcast_to(each, each.shape) for each in arrays))  # read-only views
    return np.stack([OBJECTIVES[o.kind].amount(o, harm, i) for i, o in enumerate(objectives)], axis=1)


def added_harm(before: Ledger, after: Ledger, harm_count: HarmCount, objectives: Sequence[Objective]) -> Floats:
    """Return by how much a step raised what each vehicle should minimise, [n, N].

    Of a weighted sum of what the vehicles bear it is the same sum of what they bear in the step; of any other
    objective it is the difference.

    Args:
        before: harm before the step.
        after: harm after it.
        harm_count: impacts that count, ``first`` of each pair or ``total``.
        objectives: objective of each vehicle, N of them.

    """
    sums = [OBJECTIVES[each.kind].weights is not None for each in objectives]
    harm = objective_harm(after.since(before), harm_count, objectives) if any(sums) else 0.0
    if all(sums):
        return np.asarray(harm)
    whole = objective_harm(after, harm_count, objectives) - objective_harm(before, harm_count, objectives)
    return np.where(sums, harm, whole)


def aim_of(objective: Objective, line: Weighed, vehicle: int) -> tuple[Floats, bool]:
    """Return the weights of the vehicles' harm in an objective, [n, N], and whether the largest counts, not the sum.

    Args:
        objective: the objective.
        line: ``Vehicles`` or ledger of n lines of N vehicles.
        vehicle: index of the vehicle whose objective it is (0 = front).

    Raises ``InvalidInput`` for an objective that is neither, such as ``injury``.

    """
    weights = OBJECTIVES[objective.kind].weights
    if objective.kind == "maximin":
        return np.ones(line.mass_t.shape), True
    if weights is None:
        known = ", ".join(kind.form for kind in _BUILT_IN.values() if kind.weights) + ", maximin"
        raise InvalidInput(f"objective {objective.kind!r}: is no weighted sum of the vehicles' harm; known: {known}")
    return np.broadcast_to(weights(objective, line, vehicle), line.mass_t.shape).astype(np.float64), False


def standard_objectives() -> tuple[str, ...]:
    """Return the built-in objectives that fit every scenario, then the registered ones that are loaded."""
    return (*STANDARD, *(name for name, kind in OBJECTIVES.loaded.items() if kind.function is not None))


def declared_objectives(texts: Sequence[str], vehicles: int) -> list[str]:
    """Return the names of objectives, with ``standard`` replaced by all of ``standard_objectives``.

    Raises ``InvalidInput`` if an objective is unknown, listed twice, or made for another number of vehicles.

    Args:
        texts: names of objectives, or ``standard``.
        vehicles: number of vehicles in the line.

    """
    names = [name for text in texts for name in (standard_objectives() if text == "standard" else (text,))]
    for k, name in enumerate(names):
        objectives_of(name, vehicles)
        if name in names[:k]:
            raise InvalidInput(f"objective {name!r} is given twice")
    return names


def register_objective(name: str, function: ObjectiveFunction) -> None:
    """Register an objective, so that scenarios, rewards and ``--objective`` can use ``name``.

    An installed package registers an objective with an entry point of the group ``ethbrake_marl.objectives`` that names
    the function.

    Args:
        name: 1 to 64 of ``a-z``, digits, ``-`` and ``_``.
        function: ``function(harm, vehicle)`` returns the amount of harm that this vehicle should minimise, [n] (m2/s2).
            ``harm`` is a ``HarmSoFar``, vehicle 0 is in front. Its docstring describes the objective.

    Registering the same function again changes nothing. Raises ``AlreadyExists`` if the name belongs to another
    objective, ``InvalidInput`` for an invalid name or a function without a docstring.

    """
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise InvalidInput(f"objective {name!r:.80}: must be 1 to 64 of a-z, 0-9, - and _, not beginning with - or _")
    if not callable(function) or not (function.__doc__ or "").strip():
        raise InvalidInput(f"objective {name!r}: needs a function with a docstring that says what it is")

    def amount(_: Objective, harm: HarmSoFar, vehicle: int) -> Floats:
        try:
            harms = np.asarray(function(harm, vehicle))
        except Exception as error:
            raise InvalidInput(f"objective {name!r}: of vehicle_{vehicle + 1}: {describe_error(error)}") from error
        worlds = len(harm.whole)
        if harms.shape != (worlds,) or harms.dtype.kind not in "fiub":
            raise InvalidInput(
                f"objective {name!r}: gave {harms.dtype} of shape {harms.shape}; must be numbers of shape ({worlds},),"
                " one per world"
            )
        if not np.isfinite(harms).all():
            world = int(np.argmin(np.isfinite(harms)))
            raise InvalidInput(
                f"objective {name!r}: gave {harms[world]} for vehicle_{vehicle + 1} in world {world}; must be finite"
            )
        return harms.astype(np.float64)

    entry = Kind(name, " ".join((function.__doc__ or "").split()), amount, function)
    OBJECTIVES.add(name, entry, lambda kind: kind.function is function)


def scored(ledger: Ledger, harm_count: HarmCount, declared: Sequence[Declared] | None = None) -> dict[str, Floats]:
    """Evaluate one ledger under several objectives; return the amount for each vehicle: ``{"own": [n, N], ...}``.

    So a policy can be judged under objectives that it was not trained for. Amounts are in m2/s2, or injuries in 1,000
    lines; less is better.

    Args:
        ledger: harm of n worlds since the start of the episode.
        harm_count: impacts that count: ``"first"`` of each pair, or ``"total"``.
        declared: list of objectives, each for all vehicles or one per vehicle; None: ``standard_objectives``.

    Raises ``InvalidInput`` for a single name instead of a list.

    """
    if isinstance(declared, str):
        raise InvalidInput(f"scored: {declared!r}: must be a list of objectives, for instance [{declared!r}]")
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
    """Return the weights of own harm and others' harm: cosine and sine of the angle, exactly 0 and 1 at 90 degrees.

    Computed by their series in exact fractions and rounded once, because the C library's last bits differ by processor.
    """
    if angle_deg == 90.0:
        return 0.0, 1.0
    angle, term, sums = Fraction(math.radians(angle_deg)), Fraction(1), [Fraction(0), Fraction(0)]
    for k in range(28):
        sums[k % 2] += -term if k % 4 >= 2 else term
        term = term * angle / (k + 1)
    return float(sums[0]), float(sums[1])


def _injured(objective: Objective, harm: HarmSoFar, vehicle: int) -> Floats:
    """Return the injuries in 1,000 lines, [n], summed front to rear; the same number for all vehicles.

    If a vehicle has two impacts, the larger risk counts, not the larger change of speed, so that no further impact can
    lower the number.
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
    """Return ``N sum_j w_j H_j / sum_j w_j``, [n], summed front to rear: the same bits in any batch.

    ``borne``: harm H_j of each vehicle, [n, N] m2/s2; ``weights``: w_j, [n, N].
    """
    n, vehicles = borne.shape
    harm, whole = np.zeros(n), np.zeros(n)
    for j in range(vehicles):
        harm = harm + weights[:, j] * borne[:, j]
        whole = whole + weights[:, j]
    mean: Floats = vehicles * harm / whole
    return mean


def _shares(weights: Floats) -> Floats:
    """Return weights [n, N] as multiples of their mean."""
    shares: Floats = weights * (weights.shape[1] / weights.sum(axis=1, keepdims=True))
    return shares


_BUILT_IN: dict[str, Kind] = {
    "total": Kind(
        "total",
        "everybody's harm alike",
        lambda _, harm, vehicle: harm.whole,
        weights=lambda _, line, vehicle: np.ones(line.mass_t.shape[1]),
    ),
    "own": Kind(
        "own",
        "what the vehicle itself bears",
        lambda _, harm, vehicle: harm.borne[:, vehicle],
        weights=lambda _, line, vehicle: np.eye(line.mass_t.shape[1])[vehicle],
    ),
    "social": Kind(
        "social:ANGLE",
        "social value orientation: own harm at 0, the others' at 90 degrees",
        _social,
        weights=lambda objective, line, vehicle: np.where(
            np.eye(line.mass_t.shape[1])[vehicle], *_social_weights(objective.angle_deg)
        ),
    ),
    "maximin": Kind("maximin", "the harm of whoever bears most", lambda _, harm, vehicle: harm.borne.max(axis=1)),
    "mass-weighted": Kind(
        "mass-weighted",
        "harm in a heavy vehicle counts for more",
        lambda _, harm, vehicle: weighted_harm(harm.borne, harm.mass_t),
        weights=lambda _, line, vehicle: _shares(line.mass_t),
    ),
    "weighted": Kind(
        "weighted:W1,W2,...",
        "one weight for each vehicle",
        lambda objective, harm, vehicle: weighted_harm(harm.borne, np.full(harm.borne.shape, objective.weights)),
        weights=lambda objective, line, vehicle: _shares(np.array([objective.weights])),
    ),
    "preference": Kind(
        "preference",
        "the weights harm_weight of each world",
        lambda _, harm, vehicle: weighted_harm(harm.borne, harm.harm_weight),
        weights=lambda _, line, vehicle: _shares(line.harm_weight),
    ),
    "injury": Kind("injury:CURVE", "injuries in 1,000 lines, by the impact that injures a vehicle more", _injured),
}

OBJECTIVES: Registry[Kind] = Registry("objective", "objectives", register_objective, _BUILT_IN)
