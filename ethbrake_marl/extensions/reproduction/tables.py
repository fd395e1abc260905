"""The paper's two tables (``Table:hybrid``, ``Table:Random``), and our numbers beside every number that they print."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

from ethbrake_marl.evaluation.evaluate import Result
from ethbrake_marl.evaluation.statistics import decrease, mean, rate
from ethbrake_marl.extensions.report.paper_rows import PAPER_ROWS, PaperRow
from ethbrake_marl.extensions.reproduction.curves import ALONE, HYBRID_PREDICTED, HYBRID_REALISED, drive_hybrid
from ethbrake_marl.extensions.reproduction.limits import least_harm
from ethbrake_marl.extensions.reproduction.made import POLICIES, Made, Settings, about
from ethbrake_marl.extensions.reproduction.readings import (
    ABOUT_BASELINE,
    COUPLED,
    DISTANCE,
    FOUR,
    NON_ETHICAL,
    PREDICTED,
    RANDOM,
    READINGS,
    REALISED,
    Reading,
    driven,
)
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


def beside(title: str, name: str, reading: Reading, result: Result, ours: Mapping[str, Sequence[str]]) -> Beside:
    """Return our numbers in a shipped scenario under a reading."""
    return Beside(title, result.n, numbers_of(result, least_harm(reading.scenario(name), result)), ours)


def reproduce_hybrid_table(settings: Settings) -> Made:
    """Reproduce the table of 5,000 worlds. The paper does not say at which of its two sets of speeds: we do both."""
    ours = {"E-V2X-BM": (REALISED, COUPLED), "Standalone DRL": (ALONE,), "Hybrid": (HYBRID_PREDICTED, HYBRID_REALISED)}
    besides, notes = [], []
    for name, speeds in ((RANDOM, "speeds 18 to 22 m/s"), (DISTANCE, "speeds 20, 18, 20 m/s")):
        for reading in READINGS:
            result = drive_hybrid(name, settings, reading)
            besides.append(beside(f"{speeds}, {reading.name}", name, reading, result, ours))
            notes.append(about(result))
    printed = {row.agent: row for row in PAPER_ROWS if row.table == "hybrid test"}
    verdicts = [selection_verdict(*(printed[agent] for agent in ours)), *compare_rows([*printed.values()], besides)]
    note = (
        "The paper does not describe its policy that has not converged. The rows of Standalone DRL and Hybrid are of"
        " ours: whether they agree depends on when a training is stopped."
    )
    sheets = [printed_sheet([*printed.values()]), *(each.sheet() for each in besides)]
    return Made(verdicts, sheets, notes=[note, *notes])


def reproduce_random_table(settings: Settings) -> Made:
    """Reproduce the table of the random test."""
    ours: dict[str, tuple[str, ...]] = {"Non-E": (NON_ETHICAL,), "E-V2X-BM": (REALISED, COUPLED)}
    agents = {name: FOUR[name] for name in (NON_ETHICAL, REALISED, COUPLED)}
    for kind in ("SAC", "PPO"):
        realised, predicted = f"Hybrid {kind}, realised H*", f"Hybrid {kind}, predicted H*"
        agents |= {realised: f"{kind.lower()}+episode", predicted: f"{kind.lower()}+episode:pairwise"}
        ours[f"Hybrid {kind}"] = realised, predicted
    besides, notes = [], [POLICIES]
    for reading in READINGS:
        result = driven(RANDOM, reading, agents, settings.episodes)
        besides.append(beside(reading.name, RANDOM, reading, result, ours))
        notes.append(about(result))
    baseline, *others = printed = [row for row in PAPER_ROWS if row.table == "random test"]
    verdicts = [*(decrease_verdict(row, baseline) for row in others), *compare_rows(printed, besides)]
    return Made(verdicts, [printed_sheet(printed), *(each.sheet() for each in besides)], notes=notes)
