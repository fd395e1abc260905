"""Verdicts on the claims of the paper, and the table that lists them.

The table has a verdict for each reading of the paper (``readings``). People write the sentences and the reasons
(``sentences.yaml``); the program writes results and verdicts. What rests on a training was measured once, by
``docs/studies/paper/process.py``, and is read from ``recorded.yaml``.

The *chance difference* is the largest difference (95 %) that chance alone causes between the means of two random lists
of worlds: sqrt(2) times half the width of the 95 % interval. The verdict on a printed number is the first that applies:

- *cannot be* if a proven lower bound for every strategy is above the printed number by more than the chance difference;
- *agrees* if our number is within 2 % of it;
- *undecided* if our number is within the chance difference of it: too few worlds;
- *differs* otherwise.

A statement of the paper says that some quantities are smaller than others. It *agrees* if the interval of every
difference (smaller minus larger) is below 0, is *undecided* if the remaining intervals contain 0, and else *differs*. A
statement about every world agrees if it holds in all of them.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, Literal, NamedTuple, get_args

from ethbrake_marl.evaluation.statistics import difference, mean, rate, unpaired_difference
from ethbrake_marl.extensions.reproduction.readings import OURS, READINGS
from ethbrake_marl.files.package import package_folder
from ethbrake_marl.files.sheet import Column, Estimate, Sheet
from ethbrake_marl.files.yaml import read_yaml
from ethbrake_marl.motion.layout import Bools, Floats

Verdict = Literal["agrees", "differs", "cannot be", "undecided"]

VERDICT_TOLERANCE = 0.02
SHOWN_CHARACTERS = 60  # of a sentence, in a terminal

HARM, PERCENT = Column("Harm"), Column("Collision rate", digits=1, scale=100.0, unit=" %")
DIFFERENCE = Column("Difference", sign="+")


class Result(NamedTuple):
    text: str  # what we found
    verdict: Verdict


class Claim(NamedTuple):
    name: str  # in its item
    results: Mapping[str, Result]  # in each reading, or in ours alone if the reading makes no difference
    share: str = ""  # how small the share of worlds is in which it agrees

    def result(self, reading: str) -> Result:
        return self.results.get(reading, self.results[OURS])


def same_claim(name: str, text: str, verdict: Verdict, share: str = "") -> Claim:
    """Claim with the same result in every reading."""
    return Claim(name, {OURS: Result(text, verdict)}, share)


FOLDER = package_folder() / "extensions" / "reproduction"


@cache
def paper_texts() -> Mapping[str, Any]:
    """Content of ``sentences.yaml``: sentences of the paper with our reasons."""
    content: Mapping[str, Any] = read_yaml(FOLDER / "sentences.yaml").content
    return content


@cache
def recorded() -> Mapping[str, Any]:
    """Content of ``recorded.yaml``: results that rest on a training."""
    content: Mapping[str, Any] = read_yaml(FOLDER / "recorded.yaml").content
    return content


def recorded_claim(name: str) -> Claim:
    results = recorded()["results"][name]
    return Claim(name, {reading: Result(**result) for reading, result in results.items()})


class Judged(NamedTuple):
    """A sentence of the paper, and what we found."""

    where: str
    paper: str
    claim: Claim
    why: str

    def verdict(self, reading: str) -> str:
        verdict = self.claim.result(reading).verdict
        return f"{verdict} ({self.claim.share})" if self.claim.share and verdict == "agrees" else verdict


def judge_sentences(claims: Mapping[str, Mapping[str, Claim]]) -> list[Judged]:
    """``claims``: item -> name -> claim. Sentences of another item are left out."""
    judged = []
    for sentence in paper_texts()["sentences"]:
        item, name = sentence["result"].split("/", 1)
        if item in claims:
            claim = claims[item].get(name) or recorded_claim(sentence["result"])
            why = sentence["why"].get(claim.result(OURS).verdict, "")
            judged.append(Judged(sentence["where"], sentence["paper"], claim, why))
    return judged


def sentences_sheet(judged: Sequence[Judged]) -> Sheet:
    """Everything: verdicts and numbers in each reading, and the reasons."""
    headings = "Where", "The paper", *READINGS, *(f"Numbers, {reading}" for reading in READINGS), "Why"
    rows = [
        (
            *(each.where, each.paper, *map(each.verdict, READINGS)),
            *(each.claim.results[reading].text if reading in each.claim.results else "" for reading in READINGS),
            each.why,
        )
        for each in judged
    ]
    return Sheet("", [Column(heading, text=True) for heading in headings], rows)


def short_lines(judged: Sequence[Judged]) -> str:
    """A line for each sentence: where it is, its beginning, and the verdicts."""
    rows: list[tuple[str, ...]] = [("Where", "The paper", *READINGS)]
    for each in judged:
        cut = len(each.paper) > SHOWN_CHARACTERS
        sentence = each.paper[: SHOWN_CHARACTERS - 1].rstrip() + "…" if cut else each.paper
        rows.append((each.where, sentence, *(each.claim.result(reading).verdict for reading in READINGS)))
    widths = 14, SHOWN_CHARACTERS, 9, 9, 9
    lines = (" ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)) for row in rows)
    return "\n".join(line.rstrip() for line in lines)


def count_sheet(judged: Sequence[Judged]) -> Sheet:
    """How many sentences have each verdict in each reading."""
    counts = [Counter(each.claim.result(reading).verdict for each in judged) for reading in READINGS]
    rows = [(verdict, *(count[verdict] for count in counts)) for verdict in get_args(Verdict)]
    return Sheet(f"Verdicts on {len(judged)} results", ("Verdict", *map(Column, READINGS)), rows)


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


def judge(parts: Sequence[Less], numbers: str = "") -> Result:
    """``numbers``: what to show beside the result; "": the differences that decide."""
    text, verdict, details = judge_statement(parts)
    return Result(f"{text}: {numbers or details}", verdict)


def judge_in_each(name: str, of_reading: Mapping[str, Any], parts: Callable[[Any], Sequence[Less]]) -> Claim:
    """``of_reading``: reading -> what was driven in it. ``parts``: the comparisons to make there."""
    return Claim(name, {reading: judge(parts(driven)) for reading, driven in of_reading.items()})


def judge_share(holds: Bools, of_what: str) -> Result:
    """Our verdict on a statement about every world: *agrees* if it holds in all of them, [n]."""
    if not len(holds):
        return Result("", "undecided")
    text = f"holds in {PERCENT.show(rate(holds)).in_words} of {len(holds):,} {of_what}"
    return Result(text, "agrees" if holds.all() else "differs")
