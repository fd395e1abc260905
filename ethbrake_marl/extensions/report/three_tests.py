"""The three tests on which a policy is evaluated, and a table with the results of all three."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ethbrake_marl.errors import count_of
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.first_edition.evaluation.summary import SummaryTable
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.schema import Scenario

TESTS = {
    "paper-random": "Main test, the paper's rules: Vehicle 2 may drive, there is no obstacle ahead of Vehicle 1, and"
    " pushing Vehicle 1 does no harm in either count.",
    "paper-random-brake-only": "Brake-only test: the same worlds, but Vehicle 2 may only brake and coast, so it cannot"
    " push with its motor.",
    "paper-random-obstacle": "Obstacle test: the same worlds with an obstacle 1.7 m beyond the place where Vehicle 1"
    " stops by itself. An impact of Vehicle 1 with the obstacle is harm.",
}


def is_as_shipped(scenario: Scenario) -> bool:
    """Return whether the scenario equals the shipped scenario of the same name.

    The keys ``title``, ``description`` and ``source`` are not compared.
    """
    one, other = (
        each.model_dump(exclude={"title", "description", "source"}) for each in (scenario, load_scenario(scenario.name))
    )
    return one == other


def other_tests(scenario: Scenario) -> tuple[Scenario, ...]:
    """If ``scenario`` is one of the three shipped ``TESTS``, return the other two; else return an empty tuple."""
    if scenario.name not in TESTS or not is_as_shipped(scenario):
        return ()
    return tuple(load_scenario(name) for name in TESTS if name != scenario.name)


_KEPT = ("collision_rate", "first_impact_harm", "total_harm")  # columns of the short table


def brief(table: SummaryTable, beside: Mapping[str, SummaryTable]) -> Sheet:
    """Return a short table of each agent's collision rate and harms, and of its harms on the other tests.

    *Harms* are first-impact harm and total harm. The table contains no results that the paper prints.

    ``table`` is the summary on the scenario of the run; ``beside`` has the summaries on the other tests, by name.
    """
    ours = SummaryTable(table)
    sheet = ours.terminal()
    short = sheet.only(k for k, name in enumerate(sheet.names) if k == 0 or name in _KEPT)
    columns, rows = list(short.columns), [list(row) for row in short.rows]
    note = f"{ours[0].parameters.line}. Harm: mean over the worlds in m²/s², with the 95 % interval below."
    notes = [note, *(text for _, text in ours.notes())]
    for test, other in beside.items():
        by_agent = {row.agent: row for row in other}
        columns.append(Column(f"{TESTS[test].partition(' test')[0]}:\nfirst, total"))
        for cells, row in zip(rows, (by_agent.get(row.agent) for row in ours), strict=True):
            cells.append(row and f"{row.first_impact_harm.value:.2f}, {row.total_harm.value:.2f}")
        must = [text for kind, text in other.notes() if kind == "note"]
        notes.append(" ".join([TESTS[test], f"{count_of(other[0].episodes, 'world')}.", *must]))
    return replace(short, columns=columns, rows=rows, note="\n".join(notes))
