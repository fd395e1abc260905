"""Counts of harm: the amounts that rewards, agents, shields and searches minimise, as weights of the rows of a line.

======  ================================================================================================================
first   harm of the first impact of each pair, as in the paper
total   harm of every impact
honest  harm of every impact, also where a contact passes it on to another pair, plus a price of conduct: 10 m/s times
        the push, which is closing speed that forces build up and a contact absorbs; 10 m/s times the speed that a
        vehicle's engine gives by driving; ``v^2`` for a vehicle that still moves at v at the horizon, as if it then hit
        a standing object, unless a script commands this motion (``episode.step.note_motion``). The default everywhere
======  ================================================================================================================

All are in m2/s2 and never fall during an episode. Without the price of conduct, the best braking pushes Vehicle 1 away
(docs/findings.md). The two vehicles of a pair share harm by their masses; each vehicle alone bears the price of the
pushes for which it answers (``motion.push``), of its driving and of its motion. Those in contact share the price of a
push for which nobody answers, so the harm that vehicles bear adds up to that of the line. ``register_count`` adds a
count. A ``harm_count`` is a name or a ``HarmCount``; the functions that users call turn it into a ``HarmCount``, which
is then passed along.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.layout import ANSWERED, DROVE, FIRST, MOVING, PASSED, PUSHED, SHARED, TOTAL, Floats
from ethbrake_marl.registry import Registry

COUNTED_ROWS = [FIRST, TOTAL, PASSED, PUSHED, DROVE, MOVING]  # rows of a line that a count can weigh
OF_FIRST, OF_TOTAL, OF_PASSED, OF_PUSHED, OF_DROVE, OF_MOVING = range(6)  # places of their weights
EXACT_IMPACTS = "exact impacts"  # gives all rows; another physics gives only FIRST and TOTAL


@dataclass(frozen=True)
class HarmCount:
    """A count of harm. Raises ``InvalidInput`` for bad values.

    Args:
        name: 1 to 32 characters ``a-z``, ``0-9``, ``-``, beginning with a letter.
        weights: [6], each 0 or more, of first-impact harm, total harm, harm that contacts pass on, pushes (m/s), speed
            by driving (m/s) and squared speeds at the horizon.
        column: name of its column in an evaluation, such as ``total_harm``.
        words: name in tables and messages, such as ``total harm``.
        requires: ``("exact impacts",)`` if it weighs more than first-impact and total harm.

    >>> import ethbrake_marl as eb
    >>> pushing = eb.HarmCount("pushing", [0, 1, 0, 5, 0, 0], "pushing_cost", "pushing cost", ("exact impacts",))
    >>> eb.load_scenario("paper-random").sample(2, seed=7).harm(pushing)
    array([0., 0.])

    """

    name: str
    weights: tuple[float, ...]  # any sequence of numbers becomes a tuple, which nobody can change
    column: str
    words: str
    requires: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        where = f"count {self.name!r:.60}"
        column_form = "(?!predicted_|proven_)[a-z][a-z_]*_(cost|harm)"  # as no other column of an evaluation
        for what, text, form in (("name", self.name, "[a-z][a-z0-9-]{0,31}"), ("column", self.column, column_form)):
            if not isinstance(text, str) or re.fullmatch(form, text) is None:
                raise InvalidInput(f"{where}: {what} = {text!r:.60}: must have the form {form}")
        if not isinstance(self.words, str) or not self.words.strip() or not self.words.isprintable():
            raise InvalidInput(f"{where}: words = {self.words!r:.60}: must be a text on one line")
        try:
            weights = np.array(self.weights, np.float64)
        except (TypeError, ValueError):
            weights = np.zeros(0)
        if weights.shape != (len(COUNTED_ROWS),) or not (np.isfinite(weights) & (weights >= 0.0)).all():
            raise InvalidInput(f"{where}: weights = {self.weights!r:.80}: must be 6 finite numbers, each 0 or more")
        if self.requires not in ((), (EXACT_IMPACTS,)) or (not self.requires and weights[OF_PASSED:].any()):
            raise InvalidInput(
                f"{where}: requires = {self.requires!r:.60}: must be ('{EXACT_IMPACTS}',), or () if only first-impact"
                " and total harm have a weight"
            )
        object.__setattr__(self, "weights", tuple(weights.tolist()))

    @staticmethod
    def of(harm_count: object, what: str = "harm_count") -> HarmCount:
        """The count that a caller means by ``harm_count``, a name or a count; the error calls it ``what``."""
        if isinstance(harm_count, HarmCount):
            return harm_count
        if not isinstance(harm_count, str) or harm_count not in COUNTS:
            *others, last = map(repr, COUNTS)
            raise InvalidInput(
                f"{what} = {harm_count!r:.60}: must be {', '.join(others)} or {last}; your own count must be registered"
                " first, for instance by --load FILE.py (docs/extend.md)"
            )
        return COUNTS[harm_count]

    @property
    def weight_array(self) -> Floats:
        """A new array of the weights, [6], for compiled functions."""
        return np.array(self.weights)

    @property
    def tie_breaker(self) -> HarmCount:
        """The count that decides between commands of equal harm."""
        return ALL_IMPACTS if self == FIRST_IMPACTS else FIRST_IMPACTS


FIRST_IMPACTS = HarmCount("first", (1.0, 0.0, 0.0, 0.0, 0.0, 0.0), "first_impact_harm", "first-impact harm")
ALL_IMPACTS = HarmCount("total", (0.0, 1.0, 0.0, 0.0, 0.0, 0.0), "total_harm", "total harm")
HONEST = HarmCount("honest", (0.0, 1.0, 1.0, 10.0, 10.0, 1.0), "honest_cost", "honest cost", (EXACT_IMPACTS,))
IMPACT_COUNTS = (FIRST_IMPACTS, ALL_IMPACTS)  # counts of harm alone, which tables always show
BUILT_IN_COUNTS = (*IMPACT_COUNTS, HONEST)


def register_count(
    name: str, weights: Sequence[float] | Floats, *, column: str, words: str, requires: Sequence[str] = ()
) -> None:
    """Register a ``HarmCount`` for rewards, agents, shields, searches and tables.

    Entry points: ``ethbrake_marl.counts``. Raises ``AlreadyExists`` for a name in use, and the errors of ``HarmCount``,
    whose fields the arguments are.
    """
    count = HarmCount(name, weights, column, words, tuple(requires))  # type: ignore[arg-type]  # becomes a tuple
    if column in {other.column for other in COUNTS.loaded.values() if other.name != name}:
        raise InvalidInput(f"count {name!r}: column = {column!r}: is the column of another count; give another name")
    COUNTS.add(name, count, lambda known: known == count)


COUNTS: Registry[HarmCount] = Registry(
    "count", "counts", register_count, {count.name: count for count in BUILT_IN_COUNTS}
)


AnyCount = str | HarmCount  # a count, or its name


def all_counts(*more: HarmCount) -> list[HarmCount]:
    """All counts that can be loaded: ``first``, ``total``, ``honest``, registered ones; and ``more``."""
    return [*dict.fromkeys([*COUNTS.usable().values(), *more])]


@kernel
def unshared_amount(line, p, weights):
    """Part of ``pair_amount`` that the pair does not share by mass (m2/s2): the price of conduct."""
    pushed, drove = weights[OF_PUSHED] * line[PUSHED, p], weights[OF_DROVE] * line[DROVE, p]
    return pushed + drove + weights[OF_MOVING] * line[MOVING, p]


@kernel
def conduct_amount(line, p, weights):
    """Price of conduct that the rear vehicle of pair ``p`` bears so far (m2/s2)."""
    pushed = weights[OF_PUSHED] * (line[ANSWERED, p] + line[SHARED, p])
    return pushed + weights[OF_DROVE] * line[DROVE, p] + weights[OF_MOVING] * line[MOVING, p]


@kernel
def pair_amount(line, p, weights):
    """Harm of pair ``p`` so far in one world (m2/s2), in the count with these ``weights`` [6].

    Pair 0 is the obstacle and Vehicle 1. ``line``: [LINE_ROWS, N + 1] (``motion.layout``).
    """
    harm = weights[OF_FIRST] * line[FIRST, p] + weights[OF_TOTAL] * line[TOTAL, p]
    return harm + (weights[OF_PASSED] * line[PASSED, p] + unshared_amount(line, p, weights))


@kernel
def amount_so_far(line: Floats, weights: Floats) -> float:
    """Harm of one world so far (m2/s2): sum of ``pair_amount`` over all pairs, always from the obstacle to the rear."""
    amount = 0.0
    for p in range(line.shape[1] - 1):
        amount += pair_amount(line, p, weights)
    return amount


@kernel
def cost_of_step(before, line, impact_harm, weights):
    """Harm of one world in a step (m2/s2): the increase of ``amount_so_far``, which is ``before`` at the step's begin.

    ``impact_harm`` is the harm of the step's impacts alone, which has more digits, in a count without other weights.
    """
    beside = weights[OF_PASSED] + weights[OF_PUSHED] + weights[OF_DROVE] + weights[OF_MOVING]
    return amount_so_far(line, weights) - before if beside > 0.0 else impact_harm


@large
def _amounts(line, weights, out):
    last = out.shape[2] - 1
    for k in range(out.shape[1]):
        for p in range(last):
            out[0, k, p] = pair_amount(line[k], p, weights)
            out[1, k, p] = unshared_amount(line[k], p, weights)
            out[2, k, p] = conduct_amount(line[k], p, weights)
        out[0, k, last] = out[1, k, last] = out[2, k, last] = 0.0


def pair_amounts(line: Floats, count: HarmCount) -> Floats:
    """Harm of every pair so far, its price of conduct, and the price that its rear vehicle bears, [3, n, N + 1] m2/s2.

    ``line`` is an array of a ``State``. Column 0 is the pair with the obstacle. For one pair: ``pair_amount``,
    ``unshared_amount``, ``conduct_amount``.
    """
    out = np.empty((3, len(line), line.shape[2]))
    _amounts(line, count.weight_array, out)
    return out
