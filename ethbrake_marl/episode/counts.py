"""Counts of harm: the amounts that rewards, agents, shields and searches minimise, as weights of the rows of a line.

======  ================================================================================================================
first   harm of the first impact of each pair, as in the paper
total   harm of every impact
honest  harm of every impact, also where a contact passes it on to another pair, plus a price of conduct: 10 m/s times
        the push, which is closing speed that forces build up and a contact absorbs; 10 m/s times the speed that a
        vehicle's engine gives by driving; ``v^2`` for a vehicle that still moves at v at the horizon, as if it then hit
        a standing object
======  ================================================================================================================

All are in m2/s2 and never fall during an episode. Without the price of conduct, the best braking pushes Vehicle 1 away
(docs/findings.md). The two vehicles of a pair share harm by their masses; each vehicle alone bears the price of its
push against the vehicle ahead, of its driving and of its motion.
"""

from __future__ import annotations

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.layout import DROVE, FIRST, MOVING, PASSED, PUSHED, TOTAL, Floats

COUNTED_ROWS = [FIRST, TOTAL, PASSED, PUSHED, DROVE, MOVING]  # rows of a line that a count can weigh
OF_FIRST, OF_TOTAL, OF_PASSED, OF_PUSHED, OF_DROVE, OF_MOVING = range(6)  # places of their weights

COUNTS = {  # name -> weights of these rows
    "first": np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
    "total": np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0]),
    "honest": np.array([0.0, 1.0, 1.0, 10.0, 10.0, 1.0]),
}
SHORT_NAMES = {"honest": "honest", "paper": "first"}  # short name -> count
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
    """The count that breaks ties in ``count``: ``total`` for ``first``, ``first`` for all others."""
    return "total" if isinstance(count, str) and count == "first" else "first"


@kernel
def unshared_amount(line, p, weights):
    """Part of ``pair_amount`` that the pair's rear vehicle bears alone (m2/s2): the price of its conduct."""
    pushed, drove = weights[OF_PUSHED] * line[PUSHED, p], weights[OF_DROVE] * line[DROVE, p]
    return pushed + drove + weights[OF_MOVING] * line[MOVING, p]


@kernel
def pair_amount(line, p, weights):
    """Harm of pair ``p`` so far in one world (m2/s2), in the count with these ``weights`` [6], a value of ``COUNTS``.

    Pair 0 is the obstacle and Vehicle 1. ``line``: [LINE_ROWS, N + 1] (``motion.layout``).
    """
    harm = weights[OF_FIRST] * line[FIRST, p] + weights[OF_TOTAL] * line[TOTAL, p]
    return harm + (weights[OF_PASSED] * line[PASSED, p] + unshared_amount(line, p, weights))


@kernel
def amount_so_far(line, weights):
    """Harm of one world so far (m2/s2): sum of ``pair_amount`` over all pairs, always from the obstacle to the rear."""
    amount = 0.0
    for p in range(line.shape[1] - 1):
        amount += pair_amount(line, p, weights)
    return amount


@kernel
def beside_harm(line: Floats, weights: Floats) -> float:
    """Part of ``amount_so_far`` that is not impact harm (m2/s2): harm passed on and the price of conduct, of one world.

    The order of the sum differs from ``amount_so_far``; the last bits of rewards depend on this order.
    """
    amount = 0.0
    for p in range(line.shape[1] - 1):
        amount += weights[OF_PASSED] * line[PASSED, p] + weights[OF_PUSHED] * line[PUSHED, p]
        amount += weights[OF_DROVE] * line[DROVE, p] + weights[OF_MOVING] * line[MOVING, p]
    return amount


@large
def _amounts(line, weights, out):
    for k in range(out.shape[1]):
        for p in range(out.shape[2]):
            out[0, k, p] = pair_amount(line[k], p, weights)
            out[1, k, p] = unshared_amount(line[k], p, weights)


def pair_amounts(line: Floats, count: Count) -> Floats:
    """Harm of every pair so far, and the part of it that the rear vehicle bears alone, [2, n, N + 1] m2/s2.

    ``line`` is an array of a ``State``. Column 0 is the pair with the obstacle. For one pair: ``pair_amount``,
    ``unshared_amount``.
    """
    out = np.empty((2, len(line), line.shape[2]))
    _amounts(line, weights_of(count), out)
    return out
