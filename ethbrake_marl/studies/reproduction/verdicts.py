"""Verdicts on the paper's numbers and statements, computed from ours; nobody writes one by hand.

A number that the paper prints agrees with ours where the two differ by no more than chance between two lists of worlds,
or by no more than ``TOLERANCE`` of the printed number. Where chance alone makes more than ``WIDE`` of it, it is
undecided. It cannot agree where a bound that holds for every strategy lies beyond it by more than chance. A statement
agrees where every comparison that it makes comes out as it says; where one does not but its interval holds 0, it is
undecided.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from ethbrake_marl.evaluation.statistics import Estimate

Outcome = Literal["agrees", "differs", "cannot agree", "undecided", "not run"]
AGREES: Outcome = "agrees"
DIFFERS: Outcome = "differs"
CANNOT: Outcome = "cannot agree"
UNDECIDED: Outcome = "undecided"
NOT_RUN: Outcome = "not run"
TOLERANCE = 0.02  # of the printed number
WIDE = 0.15  # of the printed number: where chance alone makes more, nothing is shown
_MOST_NAMED = 2
_PLURAL = {AGREES: "agree", DIFFERS: "differ", CANNOT: "cannot agree", UNDECIDED: "undecided", NOT_RUN: "not run"}
OUTCOMES: tuple[Outcome, ...] = (CANNOT, DIFFERS, UNDECIDED, NOT_RUN, AGREES)  # the worst first


@dataclass(frozen=True, slots=True)
class Verdict:
    """The outcome of one comparison with the paper, and the numbers that it follows from."""

    what: str
    outcome: Outcome
    because: str

    def to_json(self) -> dict[str, str]:
        """Plain data for JSON."""
        return {"what": self.what, "outcome": self.outcome, "because": self.because}


@dataclass(frozen=True, slots=True)
class Show:
    """The writing of a quantity: each number times ``scale``, then its unit."""

    digits: int = 2
    scale: float = 1.0
    unit: str = ""

    def number(self, value: float, digits: int | None = None) -> str:
        """One number."""
        return f"{self.scale * value:.{self.digits if digits is None else digits}f}{self.unit}"

    def estimate(self, estimate: Estimate) -> str:
        """A value with its interval."""
        return estimate.in_words(digits=self.digits, scale=self.scale, unit=self.unit)


HARM = Show()
PERCENT = Show(1, 100.0, " %")


@dataclass(frozen=True, slots=True)
class Bound:
    """A quantity that no strategy brings below ``least``, proven world by world."""

    what: str  # "impacts that no command avoids"
    least: Estimate  # over our list


def compare_number(
    what: str,
    printed: float,
    ours: Estimate,
    *,
    show: Show = HARM,
    bound: Bound | None = None,
    others: Mapping[str, Estimate] | None = None,
) -> Verdict:
    """Compare a number that the paper prints with ours.

    Args:
        what: which number.
        printed: the paper's.
        ours: the same quantity, with its interval over worlds.
        show: how both are written.
        bound: what no strategy undercuts, where that is proven.
        others: the same quantity under other readings; the nearest of them is named where ours differs.

    """
    told = f"ours {show.estimate(ours)}, printed {show.number(printed, show.digits + 1)}"
    if bound is not None and bound.least.value - printed > _chance(bound.least):
        least = show.estimate(bound.least)
        return Verdict(what, CANNOT, f"{bound.what}: at least {least}, whoever drives; {told}")
    if is_near(printed, ours):
        return Verdict(what, AGREES, told)
    if abs(ours.value - printed) <= _chance(ours):
        return Verdict(what, UNDECIDED, f"{told}: too few worlds to tell")
    return Verdict(what, DIFFERS, f"{told} ({_off(printed, ours)}){_nearest(printed, ours, others or {}, show)}")


def is_near(printed: float, ours: Estimate) -> bool:
    """Whether the two differ by no more than ``TOLERANCE``, or than chance between two lists where that is not wide."""
    chance = _chance(ours)
    told = chance if chance <= WIDE * max(abs(printed), abs(ours.value)) else 0.0
    return abs(ours.value - printed) <= max(told, TOLERANCE * abs(printed))


def _chance(estimate: Estimate) -> float:
    """How far apart two such estimates over two lists may lie: sqrt 2 times the half-width."""
    if estimate.interval is None:
        return 0.0
    return math.sqrt(2.0) * 0.5 * (estimate.interval[1] - estimate.interval[0])


def _off(printed: float, ours: Estimate) -> str:
    if printed == 0.0:
        return f"{ours.value:+.3g} off"
    return f"{100.0 * (ours.value / printed - 1.0):+.1f} %"


def _nearest(printed: float, ours: Estimate, others: Mapping[str, Estimate], show: Show) -> str:
    """The reading that comes nearest to what is printed, if it comes nearer than ours."""
    if not others:
        return ""
    name = min(others, key=lambda each: abs(others[each].value - printed))
    found = others[name]
    if abs(found.value - printed) >= abs(ours.value - printed):
        return "; no other reading here comes nearer"
    met = "which agrees" if is_near(printed, found) else _off(printed, found)
    return f"; nearest: {name}, {show.estimate(found)}, {met}"


@dataclass(frozen=True, slots=True)
class Less:
    """One comparison that a statement makes: ``difference`` (smaller minus larger) should be below 0.

    ``neither`` says that both are 0, where nothing is left to compare. ``least`` is what no strategy undercuts minus
    the larger one, where that is proven: above 0, nobody can bring the smaller one below it.
    """

    where: str
    difference: Estimate
    neither: bool = False
    least: Estimate | None = None

    @property
    def holds(self) -> bool:
        """Whether the whole interval is below 0."""
        return _ends(self.difference)[1] < 0.0

    @property
    def is_open(self) -> bool:
        """Whether the interval holds 0, so that another list or another seed may decide either way."""
        low, high = _ends(self.difference)
        return low < 0.0 <= high

    @property
    def is_impossible(self) -> bool:
        """Whether the proven least exceeds the larger one."""
        return self.least is not None and _ends(self.least)[0] > 0.0


def judge_statement(what: str, parts: Sequence[Less], *, or_equal: bool = False, show: Show = HARM) -> Verdict:
    """Whether every comparison of a statement comes out below 0, or at most 0, by its interval."""
    compared = [part for part in parts if not part.neither]
    ties = [part.where for part in parts if part.neither]
    tied = f" (both are 0 in {_named(ties)})" if ties else ""
    if not compared:
        return Verdict(what, AGREES, f"nothing to undercut: both are 0 in {_named(ties)}")
    failing = [part for part in compared if not part.holds and not (or_equal and _ends(part.difference)[1] <= 0.0)]
    impossible = [part for part in failing if part.is_impossible]
    counts = f"holds in {len(compared) - len(failing)} of {len(compared)}"
    if impossible:
        told = ", ".join(f"{part.where} by {show.estimate(part.least)}" for part in impossible if part.least)
        return Verdict(what, CANNOT, f"{counts}{tied}; the harm proven to be the least is above it in: {told}")
    if failing:
        is_open = all(part.is_open for part in failing)
        outcome: Outcome = UNDECIDED if is_open else DIFFERS
        told = ", ".join(f"{part.where}, {show.estimate(part.difference)}" for part in failing)
        lead = f"{counts}{tied}; not " if len(parts) > 1 else "not "
        return Verdict(what, outcome, f"{lead}{'shown' if is_open else 'so'}: {told}")
    worst = max(compared, key=lambda part: part.difference.value)
    lead = f"{counts}{tied}; the nearest is " if len(parts) > 1 else ""
    return Verdict(what, AGREES, f"{lead}{worst.where}, {show.estimate(worst.difference)}")


def _named(places: Sequence[str]) -> str:
    """The places, or how many where they are many."""
    return ", ".join(places) if len(places) <= _MOST_NAMED else f"{len(places)} more"


def _ends(estimate: Estimate) -> tuple[float, float]:
    return estimate.interval or (estimate.value, estimate.value)


def summarise_verdicts(verdicts: Sequence[Verdict]) -> Verdict:
    """All of an item in one line: how many came out how, and the first of the worst."""
    if not verdicts:
        return Verdict("all", NOT_RUN, "nothing was compared")
    worst = min((each.outcome for each in verdicts), key=OUTCOMES.index)
    counted = [(outcome, sum(each.outcome == outcome for each in verdicts)) for outcome in OUTCOMES]
    words = [(n, outcome if n == 1 else _PLURAL[outcome]) for outcome, n in counted if n]
    counts = ", ".join(f"{n} {word}" for n, word in words)
    first = next(each for each in verdicts if each.outcome == worst)
    lead = "" if len(verdicts) == 1 else f"of {len(verdicts)} comparisons {counts}; "
    return Verdict("all", worst, f"{lead}{first.what}: {first.because}")
