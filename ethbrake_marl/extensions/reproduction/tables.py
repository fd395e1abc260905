"""The paper's tables: the hybrid in 5,000 worlds (``Table:hybrid``), four strategies in 10,000 (``Table:Random``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ethbrake_marl.evaluation.evaluate import Result
from ethbrake_marl.extensions.report.paper_rows import PAPER_ROWS
from ethbrake_marl.extensions.reproduction.beside import (
    Beside,
    compare_rows,
    decrease_verdict,
    numbers_of,
    printed_sheet,
    selection_verdict,
)
from ethbrake_marl.extensions.reproduction.curves import ALONE, HYBRID_PREDICTED, HYBRID_REALISED, drive_hybrid
from ethbrake_marl.extensions.reproduction.limits import least_harm
from ethbrake_marl.extensions.reproduction.made import POLICIES, Made, Settings, about
from ethbrake_marl.extensions.reproduction.readings import (
    COUPLED,
    DISTANCE,
    FOUR,
    NON_ETHICAL,
    RANDOM,
    READINGS,
    REALISED,
    Reading,
    driven,
)


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
