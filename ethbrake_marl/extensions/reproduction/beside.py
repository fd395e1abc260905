"""Our numbers beside the rows that the paper prints in its two tables of results."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

from ethbrake_marl.evaluation.evaluate import Result
from ethbrake_marl.evaluation.statistics import decrease, mean, rate
from ethbrake_marl.extensions.report.paper_rows import PaperRow
from ethbrake_marl.extensions.reproduction.readings import ABOUT_BASELINE, NON_ETHICAL, PREDICTED, REALISED
from ethbrake_marl.extensions.reproduction.verdicts import PERCENT, Verdict, compare_number
from ethbrake_marl.files.sheet import Column, Estimate, Sheet
from ethbrake_marl.motion.layout import Floats

RATE, AVERAGE, DECREASE = "collision rate", "average harm", "harm decrease"  # that the paper prints
TOTAL, EXPECTED = "total harm", "predicted harm"

COLUMNS: Mapping[str, Column] = {
    RATE: replace(PERCENT, key="collision_rate"),
    AVERAGE: Column("First-impact harm", "first_impact_harm"),
    TOTAL: Column("Total harm", "total_harm"),
    EXPECTED: Column("Predicted harm", "predicted_harm"),
    DECREASE: replace(PERCENT, heading="Harm decrease", key="harm_decrease"),
}

NOBODY = "least possible (proven)"
UNDERCUT = {RATE: "worlds in which no command avoids an impact", AVERAGE: "harm that no command undercuts"}

Numbers = Mapping[str, Mapping[str, Estimate]]  # strategy -> quantity -> ours


def numbers_of(result: Result, least: Floats | None) -> Numbers:
    """Return our numbers. ``least`` [n] is a proven lower bound of the harm in each world, which becomes a row."""
    numbers, braking = {}, result.columns.get(NON_ETHICAL)
    for name, columns in result.columns.items():
        harm, expected = columns["first_impact_harm"], columns.get("predicted_harm", columns.get("expected_harm"))
        own = {
            RATE: rate(columns["collided"]),
            AVERAGE: mean(harm),
            TOTAL: mean(columns["total_harm"]),
            EXPECTED: None if expected is None else mean(expected),
            DECREASE: None if braking is None else decrease(harm, braking["first_impact_harm"]),
        }
        numbers[name] = {quantity: each for quantity, each in own.items() if each is not None}
    if least is not None:
        numbers[NOBODY] = {RATE: rate(least > 0.0), AVERAGE: mean(least), TOTAL: mean(least)}
    return numbers


@dataclass(frozen=True)
class Beside:
    """Our numbers under one reading."""

    title: str  # the reading
    worlds: int
    numbers: Numbers = field(repr=False)
    ours: Mapping[str, Sequence[str]]  # row of the paper -> our strategies that it may mean; the first is compared

    def sheet(self) -> Sheet:
        """Return our numbers as a table."""
        shown = {name: each for name, each in COLUMNS.items() if any(name in own for own in self.numbers.values())}
        rows = [(name, *map(own.get, shown)) for name, own in self.numbers.items()]
        note = f"{self.worlds:,} worlds; 95 % intervals; harm in m²/s². {ABOUT_BASELINE}"
        return Sheet(self.title, ("Strategy", *shown.values()), rows, note)

    def candidates(self, row: str, quantity: str) -> Iterator[tuple[str, Estimate]]:
        """Yield our numbers that a printed one may mean, with their names; the first is compared with it."""
        for name in self.ours[row]:
            own = self.numbers[name]
            if quantity in own:
                yield f"{name} ({self.title})", own[quantity]
            if quantity == AVERAGE and name == REALISED:
                yield f"{PREDICTED} ({self.title})", own[EXPECTED]
        if quantity == AVERAGE:
            for name in self.ours[row]:
                yield f"{name}, total harm ({self.title})", self.numbers[name][TOTAL]


def compare_rows(printed: Sequence[PaperRow], besides: Sequence[Beside]) -> list[Verdict]:
    """Compare every number that the paper prints with ours, under each reading."""
    verdicts = []
    for beside in besides:
        least = beside.numbers.get(NOBODY, {})
        for row in printed:
            numbers = {RATE: row.collision_rate, AVERAGE: row.average_harm, DECREASE: row.harm_decrease}
            for quantity, number in numbers.items():
                if not number:  # not printed, or the decrease of the baseline itself
                    continue
                (_, ours), *own = beside.candidates(row.agent, quantity)
                others = [other.candidates(row.agent, quantity) for other in besides if other is not beside]
                verdicts.append(
                    compare_number(
                        f"{row.agent}, {quantity} ({beside.title})",
                        number,
                        ours,
                        show=COLUMNS[quantity],
                        least=(UNDERCUT[quantity], least[quantity])
                        if quantity in least and quantity in UNDERCUT
                        else None,
                        others=dict([*own, *chain(*others)]),
                    )
                )
    return verdicts


def selection_verdict(one: PaperRow, other: PaperRow, chosen: PaperRow) -> Verdict:
    """Return the verdict on the printed collisions of a hybrid, which is one of two strategies in every world."""
    first, second, avoided = (row.episodes - row.collisions for row in (one, other, chosen))
    text = (
        f"{chosen.agent} is one of the two in every world, so it avoids at most {first:,} + {second:,} ="
        f" {first + second:,} collisions; printed: {avoided:,}"
    )
    what = f"{chosen.agent} avoids no more than {one.agent} and {other.agent} together (arithmetic of the printed rows)"
    return Verdict(what, "agrees" if avoided <= first + second else "cannot agree", text)


def decrease_verdict(row: PaperRow, baseline: PaperRow) -> Verdict:
    """Return whether a printed decrease follows from the printed harms, to 0.01 percentage points."""
    follows, printed = 1.0 - row.average_harm / baseline.average_harm, row.harm_decrease or 0.0
    text = (
        f"1 - {row.average_harm:g} / {baseline.average_harm:g} = {100.0 * follows:.2f} %; printed {100 * printed:g} %"
    )
    what = f"{row.agent}, harm decrease follows from the printed harms"
    return Verdict(what, "agrees" if abs(follows - printed) < 0.0001 else "cannot agree", text)


def printed_sheet(printed: Sequence[PaperRow]) -> Sheet:
    """Return the paper's rows as a table."""
    columns = ("Strategy", "Collisions", "Rate", "Average harm", "Decrease")
    rows = [
        (
            *(row.agent, f"{row.collisions:,}", f"{100.0 * row.collision_rate:g} %", f"{row.average_harm:g}"),
            *([] if row.harm_decrease is None else [f"{100.0 * row.harm_decrease:g} %"]),
        )
        for row in printed
    ]
    return Sheet("The paper's rows, as printed", columns[: len(rows[0])], rows)
