"""The paper's two tables (``Table:hybrid``, ``Table:Random``), and our numbers beside every number that they print."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from ethbrake_marl.evaluation.evaluate import Result
from ethbrake_marl.evaluation.statistics import decrease, mean, rate
from ethbrake_marl.extensions.report.paper_rows import HYBRID_TEST, RANDOM_TEST, PaperRow, printed_sheet
from ethbrake_marl.extensions.reproduction.curves import ALONE, HYBRID_PREDICTED, HYBRID_REALISED, drive_hybrid
from ethbrake_marl.extensions.reproduction.made import POLICIES, Made, Settings, about
from ethbrake_marl.extensions.reproduction.readings import (
    ABOUT_BASELINE,
    COUPLED,
    DISTANCE,
    FOUR,
    NON_ETHICAL,
    RANDOM,
    READINGS,
    REALISED,
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
MAY_MEAN = {AVERAGE: (AVERAGE, EXPECTED, TOTAL)}  # a printed quantity -> ours that it may mean; the first is compared

NOBODY = "least possible (proven)"
UNDERCUT = {RATE: "worlds in which no command avoids an impact", AVERAGE: "harm that no command undercuts"}

Numbers = Mapping[str, Mapping[str, Estimate]]  # strategy -> quantity -> ours
Meant = Mapping[str, Sequence[str]]  # row of the paper -> our strategies that it may mean; the first is compared


def numbers_of(result: Result, least: Floats) -> Numbers:
    """Return our numbers. ``least`` [n] is a proven lower bound of the harm in each world, which becomes a row."""
    numbers, braking = dict[str, dict[str, Estimate]](), result.columns.get(NON_ETHICAL)
    for name, columns in result.columns.items():
        harm, expected = columns["first_impact_harm"], columns.get("predicted_harm", columns.get("expected_harm"))
        numbers[name] = own = {RATE: rate(columns["collided"]), AVERAGE: mean(harm), TOTAL: mean(columns["total_harm"])}
        if expected is not None:
            own[EXPECTED] = mean(expected)
        if braking is not None and (saved := decrease(harm, braking["first_impact_harm"])) is not None:
            own[DECREASE] = saved
    return {**numbers, NOBODY: {RATE: rate(least > 0.0), AVERAGE: mean(least), TOTAL: mean(least)}}


def numbers_sheet(title: str, numbers: Numbers, worlds: int) -> Sheet:
    """Return our numbers under one reading as a table."""
    rows = [(name, *map(own.get, COLUMNS)) for name, own in numbers.items()]
    note = f"{worlds:,} worlds; 95 % intervals; harm in m²/s². {ABOUT_BASELINE}"
    sheet = Sheet(title, ("Strategy", *COLUMNS.values()), rows, note)
    return sheet.only(sheet.filled())


def compare_rows(printed: Sequence[PaperRow], readings: Mapping[str, Numbers], ours: Meant) -> list[Verdict]:
    """Compare every number that the paper prints with ours, under each reading."""
    verdicts = []
    for reading, numbers in readings.items():
        for row in printed:
            stated = {RATE: row.collision_rate, AVERAGE: row.average_harm, DECREASE: row.harm_decrease}
            for quantity, number in stated.items():
                if not number:  # not printed, or the decrease of the baseline itself
                    continue
                strategy, least = ours[row.agent][0], numbers[NOBODY].get(quantity)
                others = {
                    f"{name}, {meant} ({title})": every[name][meant]
                    for title, every in readings.items()
                    for name in ours[row.agent]
                    for meant in MAY_MEAN.get(quantity, (quantity,))
                    if meant in every[name] and (title, name, meant) != (reading, strategy, quantity)
                }
                verdicts.append(
                    compare_number(
                        f"{row.agent}, {quantity} ({reading})",
                        number,
                        numbers[strategy][quantity],
                        show=COLUMNS[quantity],
                        least=None if least is None else (UNDERCUT[quantity], least),
                        others=others,
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


def made_of(printed: tuple[PaperRow, ...], results: Mapping[str, tuple[Result, Floats]], ours: Meant) -> Made:
    """Return comparisons and tables; ``results`` are ours, and the least harm, by reading."""
    readings = {reading: numbers_of(*each) for reading, each in results.items()}
    sheets = [numbers_sheet(reading, numbers, results[reading][0].n) for reading, numbers in readings.items()]
    notes = [about(result) for result, _ in results.values()]
    return Made(compare_rows(printed, readings, ours), [printed_sheet(printed), *sheets], notes=notes)


def reproduce_hybrid_table(settings: Settings) -> Made:
    """Reproduce the table of 5,000 worlds. The paper does not say at which of its two sets of speeds: we do both."""
    ours = {"E-V2X-BM": (REALISED, COUPLED), "Standalone DRL": (ALONE,), "Hybrid": (HYBRID_PREDICTED, HYBRID_REALISED)}
    results = {
        f"{speeds}, {reading.name}": drive_hybrid(name, settings, reading)
        for name, speeds in ((RANDOM, "speeds 18 to 22 m/s"), (DISTANCE, "speeds 20, 18, 20 m/s"))
        for reading in READINGS
    }
    made = made_of(HYBRID_TEST, results, ours)
    note = (
        "The paper does not describe its policy that has not converged. The rows of Standalone DRL and Hybrid are of"
        " ours: whether they agree depends on when a training is stopped."
    )
    verdicts = [selection_verdict(*HYBRID_TEST), *made.verdicts]
    return made._replace(verdicts=verdicts, notes=[note, *made.notes])


def reproduce_random_table(settings: Settings) -> Made:
    """Reproduce the table of the random test."""
    ours: dict[str, tuple[str, ...]] = {"Non-E": (NON_ETHICAL,), "E-V2X-BM": (REALISED, COUPLED)}
    agents = {name: FOUR[name] for name in (NON_ETHICAL, REALISED, COUPLED)}
    for kind in ("SAC", "PPO"):
        realised, predicted = f"Hybrid {kind}, realised H*", f"Hybrid {kind}, predicted H*"
        agents |= {realised: f"{kind.lower()}+episode", predicted: f"{kind.lower()}+episode:pairwise"}
        ours[f"Hybrid {kind}"] = realised, predicted
    results = {reading.name: driven(RANDOM, reading, tuple(agents.items()), settings.episodes) for reading in READINGS}
    made = made_of(RANDOM_TEST, results, ours)
    return made._replace(notes=[POLICIES, *made.notes])
