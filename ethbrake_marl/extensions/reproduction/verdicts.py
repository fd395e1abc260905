"""Verdicts on whether the paper's numbers and statements agree with our results.

The *chance difference* is the largest difference of two results that can be due to chance alone: the two results come
from two different random lists of worlds.

- A number that the paper prints *agrees* with our number if the difference is at most ``TOLERANCE`` times the
  printed number. The printed number also agrees if two conditions hold. The difference is at most the chance
  difference, and the chance difference is at most ``WIDE`` times the larger of the two numbers.
- A printed number that does not agree is *undecided* if its difference from our number is at most the chance
  difference.
- A printed number *cannot agree* if it is below a proven lower bound for all strategies by more than the chance
  difference.
- A printed number *differs* in all other cases.

A statement of the paper says that some quantities are smaller than others. A statement *agrees* if every difference
(smaller minus larger quantity) has a 95 % interval below 0. A statement is *undecided* if at least one interval
contains 0 and every other interval is below 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from pydantic import ConfigDict
from pydantic.dataclasses import dataclass as model

from ethbrake_marl.files.sheet import Column, Estimate
from ethbrake_marl.first_edition.evaluation.statistics import mean, paired_difference, unpaired_difference
from ethbrake_marl.first_edition.physics.state import Floats

Judgement = Literal["cannot agree", "differs", "undecided", "not run", "agrees"]  # in this order, the worst first

TOLERANCE = 0.02  # allowed difference, as a share of the printed number

WIDE = 0.15  # limit of chance, as a share of the number; above it, a small difference is undecided

HOW_JUDGED = (
    "Every verdict is computed: a number agrees where it is within the chance between two lists of worlds or"
    f" {100.0 * TOLERANCE:g} % of what is printed, is undecided where that chance alone makes more than"
    f" {100.0 * WIDE:g} %, and cannot agree where a bound that holds for every strategy excludes it. Statements are"
    " those of the paper's text; its figures hold no printed numbers."
)

WRITTEN = ConfigDict(strict=True, extra="forbid")  # for types that are read from files


@model(frozen=True, config=WRITTEN)
class Verdict:
    """Outcome of one comparison with the paper, and the numbers that explain the outcome."""

    what: str  # what was compared
    outcome: Judgement  # ``agrees``, ``differs``, ``undecided``, ``cannot agree`` or ``not run``
    because: str  # text with the numbers that explain the outcome


HARM = Column("Harm")

PERCENT = Column("Collision rate", digits=1, scale=100.0, unit=" %")


def compare_number(
    what: str,
    printed: float,
    ours: Estimate,
    *,
    show: Column = HARM,
    least: tuple[str, Estimate] | None = None,
    others: Mapping[str, Estimate] | None = None,
) -> Verdict:
    """Return a verdict on whether a number that the paper prints agrees with our result.

    ``what`` is the name of the number, and ``show`` its format. ``least`` is the description and the value of a proven
    lower bound for all strategies in our worlds. ``others`` are our results under other assumptions; if ``ours``
    differs from the printed number, the verdict names the assumption with the nearest result.
    """
    text = f"ours {show.show(ours).in_words}, printed {show.scale * printed:.{show.digits + 1}f}{show.unit}"
    if least is not None and least[1].value - printed > _chance(least[1]):
        undercut = f"{least[0]}: at least {show.show(least[1]).in_words}, whoever drives"
        return Verdict(what, "cannot agree", f"{undercut}; {text}")
    off = _off(printed, ours)
    if not off:
        return Verdict(what, "agrees", text)
    if abs(ours.value - printed) <= _chance(ours):
        return Verdict(what, "undecided", f"{text}: too few worlds to tell")
    text += f" ({off})"
    if others:
        name, nearest = min(others.items(), key=lambda each: abs(each[1].value - printed))
        if abs(nearest.value - printed) < abs(ours.value - printed):
            met = _off(printed, nearest) or "which agrees"
            text += f"; nearest: {name}, {show.show(nearest).in_words}, {met}"
        else:
            text += "; no other reading here comes nearer"
    return Verdict(what, "differs", text)


def _off(printed: float, ours: Estimate) -> str:
    """Return how far ``ours`` is from the printed number, as text such as "+3.1 %"; empty if the two numbers agree."""
    chance = _chance(ours)
    off = chance if chance <= WIDE * max(abs(printed), abs(ours.value)) else 0.0
    if abs(ours.value - printed) <= max(off, TOLERANCE * abs(printed)):
        return ""
    return f"{ours.value:+.3g} off" if printed == 0.0 else f"{100.0 * (ours.value / printed - 1.0):+.1f} %"


def _chance(estimate: Estimate) -> float:
    """Return the chance difference: by how much ``estimate`` may differ from one in equally many other worlds.

    It is sqrt(2) times half the width of the 95 % interval.
    """
    low, high = estimate.ends
    return math.sqrt(2.0) * 0.5 * (high - low)


@dataclass(frozen=True, slots=True)
class Less:
    """Comparison of two quantities, of which one is smaller according to a statement of the paper.

    A statement can need several comparisons, for example one for each group of worlds.
    """

    where: str  # text that says which worlds or strategies are compared
    difference: Estimate  # quantity that should be smaller, minus the other one; below 0 if the statement is right
    neither: bool = False  # True if both quantities are 0 in every world
    # proven lower bound of all strategies, minus the quantity that should be larger. If it is above 0, the statement
    # cannot be right for any strategy. None: no bound
    least: Estimate | None = None

    @classmethod
    def of_lists(cls, where: str, smaller: Floats, larger: Floats) -> Less:
        """Compare the means of two independent samples, ``smaller`` [n] and ``larger`` [m]."""
        return cls(where, unpaired_difference(mean(smaller), len(smaller), mean(larger), len(larger)))

    @classmethod
    def of_harms(cls, where: str, harm: Mapping[str, Floats], smaller: str, larger: str) -> Less:
        """Compare the harms of two strategies in the same worlds, and with the proven lower bound if it is known.

        ``harm`` has the harm of each strategy, [n]. ``smaller`` and ``larger`` are names of strategies.
        """
        low, high = harm[smaller], harm[larger]
        least = paired_difference(harm[PROVEN], high) if PROVEN in harm else None
        return cls(where, paired_difference(low, high), not low.any() and not high.any(), least)


def judge_statement(what: str, parts: Sequence[Less], *, or_equal: bool = False, show: Column = HARM) -> Verdict:
    """Return a verdict on a statement of the paper.

    The statement agrees if the 95 % interval of every difference in ``parts`` is below 0; with ``or_equal``, the upper
    end may also be 0.
    """
    compared, ties = [part for part in parts if not part.neither], [part.where for part in parts if part.neither]
    places = ", ".join(ties) if len(ties) <= 2 else f"{len(ties)} more"
    if not compared:
        return Verdict(what, "agrees", f"nothing to undercut: both are 0 in {places}")
    highest = [part.difference.ends[1] for part in compared]
    failing = [
        part for part, high in zip(compared, highest, strict=True) if not (high < 0.0 or (or_equal and high <= 0.0))
    ]
    impossible = [
        f"{part.where} by {show.show(part.least).in_words}"
        for part in failing
        if part.least is not None and part.least.ends[0] > 0.0
    ]
    counts = f"holds in {len(compared) - len(failing)} of {len(compared)}{f' (both are 0 in {places})' if ties else ''}"
    if impossible:
        text = f"the harm proven to be the least is above it in: {', '.join(impossible)}"
        return Verdict(what, "cannot agree", f"{counts}; {text}")
    if failing:
        ends = [part.difference.ends for part in failing]
        is_open = all(low < 0.0 <= high for low, high in ends)  # another list may decide either way
        text = ", ".join(f"{part.where}, {show.show(part.difference).in_words}" for part in failing)
        lead = f"{counts}; not " if len(parts) > 1 else "not "
        shown = f"{lead}{'shown' if is_open else 'so'}: {text}"
        return Verdict(what, "undecided" if is_open else "differs", shown)
    worst = max(compared, key=lambda part: part.difference.value)
    lead = f"{counts}; the nearest is " if len(parts) > 1 else ""
    return Verdict(what, "agrees", f"{lead}{worst.where}, {show.show(worst.difference).in_words}")


def summarise_verdicts(verdicts: Sequence[Verdict]) -> Verdict:
    """Combine all verdicts on an item into one verdict with the worst outcome.

    Its text states how often each outcome occurs, and quotes the first verdict with the worst outcome.
    """
    if not verdicts:
        return Verdict("all", "not run", "nothing was compared")
    counted = {outcome: sum(each.outcome == outcome for each in verdicts) for outcome in get_args(Judgement)}
    plural = {"agrees": "agree", "differs": "differ"}
    parts = [f"{n} {plural.get(outcome, outcome) if n > 1 else outcome}" for outcome, n in counted.items() if n]
    first = next(each for outcome in counted for each in verdicts if each.outcome == outcome)
    lead = "" if len(verdicts) == 1 else f"of {len(verdicts)} comparisons {', '.join(parts)}; "
    return Verdict("all", first.outcome, f"{lead}{first.what}: {first.because}")


Mode = Literal["quick", "full"]

LIST_SEED = 7

MOST_EPISODES = 10_000

PREDICTED, PROVEN = "E-V2X-BM, predicted", "least harm, proven"
