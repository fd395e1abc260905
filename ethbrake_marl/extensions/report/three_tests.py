"""The three shipped tests of a policy, and a table with the results in all of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ethbrake_marl.episode.counts import COLUMN
from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation.comparison import Comparison
from ethbrake_marl.evaluation.summary import caption
from ethbrake_marl.extensions.report.best_known import BestKnown
from ethbrake_marl.files.sheet import Estimate, Sheet
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.mixture import DESCRIPTIVE_KEYS
from ethbrake_marl.worlds.scenario import Scenario

TESTS = {
    "paper-random": "Main test: Vehicle 2 may drive, and there is no obstacle ahead of Vehicle 1. Neither first-impact"
    " nor total harm includes pushing Vehicle 1; the honest cost does.",
    "paper-random-brake-only": "Brake-only test: the same worlds, but Vehicle 2 may only brake and coast, so it cannot"
    " push with its engine.",
    "paper-random-obstacle": "Obstacle test: the same worlds with an obstacle 1.7 m beyond the place where Vehicle 1"
    " stops by itself. An impact of Vehicle 1 with the obstacle is harm.",
}
SHORT_TABLE = ("collision_rate", *COLUMN.values(), "pushed_mps")  # columns of the short table, if they are shown


def is_as_shipped(scenario: Scenario) -> bool:
    """Whether a scenario equals the shipped scenario of the same name, apart from title, description and source."""
    return scenario.content(without=DESCRIPTIVE_KEYS) == load_scenario(scenario.name).content(without=DESCRIPTIVE_KEYS)


def other_tests(scenario: Scenario) -> list[Scenario]:
    """The other two of the three shipped tests. Empty unless ``scenario`` is one of the three, unchanged."""
    if scenario.name not in TESTS or not is_as_shipped(scenario):
        return []
    return [load_scenario(name) for name in TESTS if name != scenario.name]


def title_of(name: str) -> str:
    return TESTS[name].partition(":")[0]


def short_sheet(compared: Comparison, test_results: Mapping[str, Comparison]) -> Sheet:
    """Short table of agents: collision rate, first-impact and total harm.

    If agents minimise the honest cost, also this cost and the push. ``test_results``: name of another test -> its
    results, whose means follow as further rows.
    """
    table = compared.table
    full_sheet = table.terminal()
    short = full_sheet.only(k for k, name in enumerate(full_sheet.names) if k == 0 or name in SHORT_TABLE)
    rows, line = list(short.rows), "Harm: mean over the worlds in m²/s², with the 95 % interval below."
    best_known = BestKnown.of(compared.result)
    notes = [
        f"{caption(table.parameters)}. {line}",
        *table.notes(),
        *([] if best_known is None else [best_known.in_words]),
    ]
    for test, comparison in test_results.items():
        rows.append(f"{title_of(test)}: {count_of(comparison.result.n, 'world')}")
        for row in comparison.table:
            means = [row[name] for name in short.names[1:]]
            rows.append((row.marked, *(mean and Estimate(mean.value, None) for mean in means)))
        notes.append(" ".join([TESTS[test], *comparison.table.notes()]))
    return replace(short, rows=rows, note="\n".join(notes), keep=None)
