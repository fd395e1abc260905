"""Verdicts: does a number or a statement of the paper agree with our results?

The *chance difference* is the largest difference between means of two random lists of worlds that is due to chance
alone (95 %): sqrt(2) times half of the interval. A printed number

- *agrees* if ours is within 2 % of it, or within the chance difference where that is at most 15 % of the larger one;
- is *undecided* if ours is within a larger chance difference: too few worlds;
- *cannot agree* if a lower bound that is proven for every strategy is above it by more than the chance difference;
- *differs* otherwise.

A statement of the paper says that quantities are smaller than others. It agrees if the interval of every difference
(smaller minus larger) is below 0, and is undecided if the others contain 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple, get_args

from ethbrake_marl.evaluation.statistics import difference, mean, unpaired
from ethbrake_marl.files.sheet import Column, Estimate
from ethbrake_marl.motion.layout import Floats

Outcome = Literal["cannot agree", "differs", "undecided", "not run", "agrees"]  # the worst first

TOLERANCE, WIDE = 0.02, 0.15

HARM, PERCENT = Column("Harm"), Column("Collision rate", digits=1, scale=100.0, unit=" %")


class Verdict(NamedTuple):
    """Outcome of a comparison, and the numbers that explain it."""

    what: str
    outcome: Outcome
    because: str


def chance(ours: Estimate) -> float:
    """Return the chance difference."""
    low, high = ours.ends
    return math.sqrt(2.0) * 0.5 * (high - low)


def within(printed: float, ours: Estimate) -> bool:
    """Return whether our number agrees with a printed one."""
    by_chance = chance(ours) if chance(ours) <= WIDE * max(abs(printed), abs(ours.value)) else 0.0
    return abs(ours.value - printed) <= max(by_chance, TOLERANCE * abs(printed))


def compare_number(
    what: str,
    printed: float,
    ours: Estimate,
    *,
    show: Column = HARM,
    least: tuple[str, Estimate] | None = None,
    others: Mapping[str, Estimate] | None = None,
) -> Verdict:
    """Compare a printed number, which is not 0, with ours.

    ``show`` is its format. ``least``: a proven lower bound for all strategies, in words and numbers. ``others``: our
    numbers under other readings; where ours differs, the verdict names the nearest.
    """

    def off(other: Estimate) -> str:
        return f"{100.0 * (other.value / printed - 1.0):+.1f} %"

    text = f"ours {show.show(ours).in_words}, printed {show.scale * printed:.{show.digits + 1}f}{show.unit}"
    if least is not None and least[1].value - printed > chance(least[1]):
        bound = f"{least[0]}: at least {show.show(least[1]).in_words}, whoever drives"
        return Verdict(what, "cannot agree", f"{bound}; {text}")
    if within(printed, ours):
        return Verdict(what, "agrees", text)
    if abs(ours.value - printed) <= chance(ours):
        return Verdict(what, "undecided", f"{text}: too few worlds to tell")
    text += f" ({off(ours)})"
    if others:
        name, nearest = min(others.items(), key=lambda each: abs(each[1].value - printed))
        if abs(nearest.value - printed) < abs(ours.value - printed):
            how = "which agrees" if within(printed, nearest) else off(nearest)
            text += f"; nearest: {name}, {show.show(nearest).in_words}, {how}"
        else:
            text += "; no other reading here comes nearer"
    return Verdict(what, "differs", text)


class Less(NamedTuple):
    """One of the comparisons that a statement needs, such as one for each group of worlds."""

    where: str
    difference: Estimate  # what should be smaller, minus the other
    both_are_0: bool = False  # in every world: nothing can be smaller

    @classmethod
    def of_lists(cls, where: str, smaller: Floats, larger: Floats) -> Less:
        """Compare the means of independent samples, [n] and [m]."""
        return cls(where, unpaired(mean(smaller), mean(larger)))

    @classmethod
    def of_worlds(cls, where: str, smaller: Floats, larger: Floats) -> Less:
        """Compare two quantities in the same worlds, [n]."""
        return cls(where, difference(smaller, larger), not smaller.any() and not larger.any())


def judge_statement(what: str, parts: Sequence[Less], *, or_equal: bool = False, show: Column = HARM) -> Verdict:
    """Return the verdict on a statement. With ``or_equal``, a difference may also be exactly 0."""
    ties = [part.where for part in parts if part.both_are_0]
    compared = [part for part in parts if not part.both_are_0]
    places = ", ".join(ties) if len(ties) <= 2 else f"{len(ties)} more"
    if not compared:
        return Verdict(what, "agrees", f"nothing to undercut: both are 0 in {places}")
    failing = [
        part
        for part in compared
        if not (part.difference.ends[1] < 0.0 or (or_equal and part.difference.ends[1] == 0.0))
    ]
    counts = f"holds in {len(compared) - len(failing)} of {len(compared)}{f' (both are 0 in {places})' if ties else ''}"
    if failing:
        undecided = all(part.difference.ends[0] < 0.0 <= part.difference.ends[1] for part in failing)
        text = ", ".join(f"{part.where}, {show.show(part.difference).in_words}" for part in failing)
        lead = f"{counts}; " if len(parts) > 1 else ""
        return Verdict(
            what, "undecided" if undecided else "differs", f"{lead}not {'shown' if undecided else 'so'}: {text}"
        )
    worst = max(compared, key=lambda part: part.difference.value)
    lead = f"{counts}; the nearest is " if len(parts) > 1 else ""
    return Verdict(what, "agrees", f"{lead}{worst.where}, {show.show(worst.difference).in_words}")


def summarise(verdicts: Sequence[Verdict]) -> Verdict:
    """Return one verdict with the worst outcome: how often each occurs, and the first of the worst."""
    counted = {outcome: sum(each.outcome == outcome for each in verdicts) for outcome in get_args(Outcome)}
    plural = {"agrees": "agree", "differs": "differ"}
    parts = [f"{n} {plural.get(outcome, outcome) if n > 1 else outcome}" for outcome, n in counted.items() if n]
    worst = next(each for outcome in counted for each in verdicts if each.outcome == outcome)
    lead = "" if len(verdicts) == 1 else f"of {len(verdicts)} comparisons {', '.join(parts)}; "
    return Verdict("all", worst.outcome, f"{lead}{worst.what}: {worst.because}")
