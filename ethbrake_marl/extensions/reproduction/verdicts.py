"""Verdicts on the claims of the paper, and the table that lists them.

The table's columns are: a sentence of the paper, our result with the parameters as stated, our result in the *nearest
reading* (the interpretation of the paper that comes nearest to the printed numbers), the verdict, and a reason. People
write the sentences and the reasons (``sentences.yaml``); the program writes results and verdicts.

The *chance difference* is the largest difference (95 %) that chance alone causes between the means of two random lists
of worlds: sqrt(2) times half the width of the 95 % interval. The verdict on a printed number is the first that applies:

- *cannot be* if a proven lower bound for every strategy is above the printed number by more than the chance difference;
- *agrees* if our number is within 2 % of it;
- *undecided* if our number is within the chance difference of it: too few worlds;
- *differs* otherwise.

A statement of the paper says that some quantities are smaller than others. It *agrees* if the interval of every
difference (smaller minus larger) is below 0, is *undecided* if the remaining intervals contain 0, and else *differs*. A
statement about a training that has not converged has no other verdict than *not converged*.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

from ethbrake_marl.evaluation.statistics import difference, mean, rate, unpaired_difference
from ethbrake_marl.files.sheet import Column, Estimate, Sheet
from ethbrake_marl.files.yaml import read_yaml
from ethbrake_marl.motion.layout import Bools, Floats

Verdict = Literal["agrees", "differs", "cannot be", "undecided", "not converged", "not run"]
REASONS = {"not run": "needs a training: ethbrake reproduce --full"}  # for every sentence without a reason of its own

VERDICT_TOLERANCE = 0.02

HARM, PERCENT = Column("Harm"), Column("Collision rate", digits=1, scale=100.0, unit=" %")
DIFFERENCE = Column("Difference", sign="+")
COLUMNS = "Where", "The paper", "Ours, as stated", "Ours, nearest reading", "Verdict", "Why"


class Claim(NamedTuple):
    name: str  # in its item
    ours: str  # our result with the parameters as stated
    nearest: str  # our result in the nearest reading
    verdict: Verdict  # on our result as stated


@cache
def paper_texts() -> Mapping[str, Any]:
    """Content of ``sentences.yaml``: sentences of the paper with our reasons, and changes that make claims true."""
    content: Mapping[str, Any] = read_yaml(Path(__file__).with_name("sentences.yaml")).content
    return content


def sentences_sheet(claims: Mapping[str, Mapping[str, Claim]]) -> Sheet:
    """``claims``: item -> name -> claim. A sentence of an item that has no such claim was not run, and a sentence of
    another item is left out.
    """
    rows = []
    for sentence in paper_texts()["sentences"]:
        item, name = sentence["result"].split("/")
        if item in claims:
            claim = claims[item].get(name, Claim(name, "", "", "not run"))
            why = sentence["why"].get(claim.verdict, REASONS.get(claim.verdict, ""))
            rows.append((sentence["where"], sentence["paper"], *claim[1:], why))
    return Sheet("", [Column(heading, text=True) for heading in COLUMNS], rows)


def chance_difference(ours: Estimate) -> float:
    low, high = ours.ends
    return math.sqrt(2.0) * 0.5 * (high - low)


def judge_number(printed: float, ours: Estimate, least: Estimate | None = None) -> Verdict:
    """``ours``: our number. ``least``: proven lower bound for all strategies."""
    if least is not None and least.value - printed > chance_difference(least):
        return "cannot be"
    if abs(ours.value - printed) <= VERDICT_TOLERANCE * abs(printed):
        return "agrees"
    return "undecided" if abs(ours.value - printed) <= chance_difference(ours) else "differs"


class Less(NamedTuple):
    """Comparison of two quantities, the first of which is smaller according to the paper.

    ``both_are_0``: both quantities are 0 in every world, so there is nothing to compare.
    """

    where: str
    difference: Estimate  # quantity that should be smaller, minus the larger one
    both_are_0: bool = False  # in every world: nothing can be smaller

    @classmethod
    def of_lists(cls, where: str, smaller: Floats, larger: Floats) -> Less:
        return cls(where, unpaired_difference(mean(smaller), mean(larger)))

    @classmethod
    def of_worlds(cls, where: str, smaller: Floats, larger: Floats) -> Less:
        return cls(where, difference(smaller, larger), not smaller.any() and not larger.any())

    @property
    def holds(self) -> bool:
        return self.difference.ends[1] < 0.0


def judge_statement(parts: Sequence[Less]) -> tuple[str, Verdict, str]:
    """The result says in how many of the comparisons ``parts`` the statement holds. The details are the differences of
    the comparisons that fail or, if none fails, of the closest one.
    """
    compared = [part for part in parts if not part.both_are_0]
    failing = [part for part in compared if not part.holds]
    ties = f", both are 0 in {len(parts) - len(compared)} more" if len(compared) < len(parts) else ""
    text = f"holds in {len(compared) - len(failing)} of {len(compared)}{ties}"
    if not compared:
        return "nothing to compare", "undecided", "both are 0 in all worlds" if parts else "too few worlds"
    undecided = all(part.difference.ends[0] < 0.0 for part in failing)
    if len(parts) == 1:
        text = ("not shown" if undecided else "does not hold") if failing else "holds"
    named = failing or [max(compared, key=lambda part: part.difference.value)]
    numbers = "; ".join(f"{part.where}, {DIFFERENCE.show(part.difference).in_words}" for part in named)
    return text, ("undecided" if undecided else "differs") if failing else "agrees", numbers


def judge(name: str, stated: Sequence[Less], nearest: Sequence[Less] = (), *, numbers: str = "") -> Claim:
    """``stated``, ``nearest``: comparisons with the parameters as stated, and in the nearest reading. ``numbers``: what
    to show beside the result; "": the differences that decide.
    """
    text, verdict, details = judge_statement(stated)
    nearest_result = judge_statement(nearest)[0] if nearest else ""
    return Claim(name, f"{text}: {numbers or details}", nearest_result, verdict)


def judge_share(name: str, holds: Bools, of_what: str) -> Claim:
    """Claim with our verdict on a statement about every world: *agrees* if it holds in all of them, [n]."""
    ours = f"holds in {PERCENT.show(rate(holds)).in_words} of {len(holds):,} {of_what}" if len(holds) else ""
    return Claim(name, ours, "", ("agrees" if holds.all() else "differs") if len(holds) else "undecided")
