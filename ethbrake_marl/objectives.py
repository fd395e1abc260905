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
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.files.yaml import parse_numeral
from ethbrake_marl.harm import HarmCount, Ledger
from ethbrake_marl.physics.worlds import Floats

KINDS = ("total", "own", "social", "maximin", "mass-weighted", "weighted")
STANDARD = ("total", "own", "social:45", "maximin", "mass-weighted")  # those that need no knowledge of the scenario

Declared = str | tuple[str, ...]  # one objective for all vehicles, or one for each


class Objective(NamedTuple):
    """A parsed objective."""

    kind: str
    angle_deg: float = 0.0
    weights: tuple[float, ...] = ()


@lru_cache(maxsize=256)
def parse_objective(text: str) -> Objective:
    """Read ``total``, ``own``, ``social:45``, ``maximin``, ``mass-weighted`` or ``weighted:1,4,1``.

    Raises ``InvalidInput`` for an unknown name, an angle outside [0, 90] degrees, or a weight outside [1e-6, 1e6].
    """
    kind, colon, argument = text.partition(":")
    if kind not in KINDS:
        raise unknown_name("objective", kind, KINDS)
    if kind not in ("social", "weighted"):
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
    borne, whole = ledger.vehicle_harm(harm_count), ledger.world_harm(harm_count)
    columns = [_of_vehicle(o, i, borne, whole, ledger.mass_t) for i, o in enumerate(objectives)]
    return np.stack(columns, axis=1)


def scored(ledger: Ledger, harm_count: HarmCount, declared: Sequence[Declared] = STANDARD) -> dict[str, Floats]:
    """The same ledger under several objectives: objective -> what it is for each vehicle, [n, N] (m2/s2).

    So one policy, whatever it was trained for, is told under all of them. ``InvalidInput`` for a name without its list.
    """
    if isinstance(declared, str):
        raise InvalidInput(f"scored: {declared!r}: must be a list of objectives, for instance [{declared!r}]")
    vehicles = ledger.mass_t.shape[1]
    return {
        each if isinstance(each, str) else ", ".join(each): objective_harm(
            ledger, harm_count, objectives_of(each, vehicles)
        )
        for each in declared
    }


def _of_vehicle(objective: Objective, vehicle: int, borne: Floats, whole: Floats, mass_t: Floats) -> Floats:
    if objective.kind == "total":
        return whole
    if objective.kind == "own":
        return borne[:, vehicle]
    if objective.kind == "social":
        own, others = _social_weights(objective.angle_deg)
        rest = whole - borne[:, vehicle]
        return own * borne[:, vehicle] + others * rest
    if objective.kind == "maximin":
        worst: Floats = borne.max(axis=1)
        return worst
    weights = mass_t if objective.kind == "mass-weighted" else np.full(borne.shape, objective.weights)
    return _weighted(borne, weights)


def _social_weights(angle_deg: float) -> tuple[float, float]:
    """Weights of the own harm and of the others'; exactly 0 and 1 at 90 degrees too."""
    angle = math.radians(angle_deg)
    return (0.0, 1.0) if angle_deg == 90.0 else (math.cos(angle), math.sin(angle))


def _weighted(borne: Floats, weights: Floats) -> Floats:
    """``N sum_j w_j H_j / sum_j w_j``, summed front to rear: the same bits in any batch."""
    n, vehicles = borne.shape
    harm, whole = np.zeros(n), np.zeros(n)
    for j in range(vehicles):
        harm = harm + weights[:, j] * borne[:, j]
        whole = whole + weights[:, j]
    mean: Floats = vehicles * harm / whole
    return mean
