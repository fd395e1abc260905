"""Counts of harm: the amounts that a reward, an agent, a shield or a search keeps small, and the weight of each.

======  ================================================================================================================
first   harm of the first impact of each pair, as in the paper
total   harm of every impact
honest  harm of every impact, also where a contact passes it on to another pair, plus a price of conduct without impact:
        10 m/s times the push, the closing speed that forces build up and a contact takes up; 10 m/s times the speed
        that a vehicle's engine gives by driving; ``v^2`` for a vehicle that still moves at v at the horizon, as if it
        then hit a standing object
======  ================================================================================================================

All are in m2/s2 and never fall during an episode. Without the price in ``honest``, the best braking pushes Vehicle 1
away (docs/findings.md). The two vehicles of a pair share harm by their masses. Conduct is its author's: a vehicle
alone bears the price of its push against the vehicle ahead, of its driving and of its motion.
"""

from __future__ import annotations

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.motion.compiling import kernel
from ethbrake_marl.motion.layout import DROVE, FIRST, MOVING, PASSED, PUSHED, TOTAL, Floats

ROWS = [FIRST, TOTAL, PASSED, PUSHED, DROVE, MOVING]  # rows of a line that can count

COUNTS = {  # name -> weight of each row
    "first": np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
    "total": np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0]),
    "honest": np.array([0.0, 1.0, 1.0, 10.0, 10.0, 1.0]),
}
RULES = {"honest": "honest", "paper": "first"}  # short name -> count
Count = str | Floats  # the name of a count, or its weights, [6]

HARM = {"first": "first_impact_harm", "total": "total_harm"}  # counts of harm alone -> column of an evaluation
COLUMN = {**HARM, "honest": "honest_cost"}  # count -> column
IN_WORDS = {"first": "first-impact harm", "total": "total harm", "honest": "honest cost"}


def weights_of(count: Count) -> Floats:
    return COUNTS[count] if isinstance(count, str) else count


def check_count(what: str, count: object) -> None:
    if count not in COUNTS:
        raise InvalidInput(f"{what} = {count!r}: must be 'first', 'total' or 'honest'")


def other_count(count: Count) -> str:
    """The count that decides where harms in ``count`` are equal: total for ``first``, first for all others."""
    return "total" if isinstance(count, str) and count == "first" else "first"


@kernel
def own_amount(line, p, weights):
    """Part of ``pair_amount`` for conduct (m2/s2), which the rear vehicle of the pair bears alone."""
    return weights[3] * line[PUSHED, p] + weights[4] * line[DROVE, p] + weights[5] * line[MOVING, p]


@kernel
def pair_amount(line, p, weights):
    """Harm of pair ``p`` (0: with the obstacle) so far, in one world's ``line`` (``motion.layout``), m2/s2.

    ``weights`` [6] are a value of ``COUNTS``.
    """
    harm = weights[0] * line[FIRST, p] + weights[1] * line[TOTAL, p]
    return harm + (weights[2] * line[PASSED, p] + own_amount(line, p, weights))


@kernel
def amount_so_far(line, weights):
    """Harm of one world so far (m2/s2): ``pair_amount`` of all pairs, always summed from the obstacle to the rear."""
    amount = 0.0
    for p in range(line.shape[1] - 1):
        amount += pair_amount(line, p, weights)
    return amount


def pair_amounts(line: Floats, count: Count) -> Floats:
    """Harm of each pair so far, as ``count`` counts it, [n, N + 1] m2/s2; column 0 is the pair with the obstacle.

    ``line``: the array of a ``State``.
    """
    first, total, passed, *_ = weights_of(count)
    harm = first * line[:, FIRST] + total * line[:, TOTAL]
    return harm + (passed * line[:, PASSED] + own_amounts(line, count))


def own_amounts(line: Floats, count: Count) -> Floats:
    """Part of ``pair_amounts`` for conduct, which the rear vehicle bears alone, [n, N + 1] m2/s2."""
    push, drove, moving = weights_of(count)[3:]
    return np.asarray(push * line[:, PUSHED] + drove * line[:, DROVE] + moving * line[:, MOVING])
