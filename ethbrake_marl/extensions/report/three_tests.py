"""The three tests whose results are shown together, and a table of all three on one screen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation.summary import SummaryTable
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.scenario.catalogue import load_scenario
from ethbrake_marl.scenario.schema import Scenario

TESTS = {
    "paper-random": "Main test, the paper's rules: Vehicle 2 may drive, nothing stands ahead of Vehicle 1, and pushing"
    " it on costs nothing in either count.",
    "paper-random-brake-only": "Brake-only test: the same worlds, but Vehicle 2 may only brake and coast; it can"
    " neither drive on nor push with its motor.",
    "paper-random-obstacle": "Obstacle test: the same worlds with the obstacle that Vehicle 1 brakes for, 1.7 m beyond"
    " where it stops by itself. Vehicle 1's impact with it is harm.",
}


def is_as_shipped(scenario: Scenario) -> bool:
    """Return whether the scenario equals the shipped one of the same name, apart from title, description and source."""
    one, other = (
        each.model_dump(exclude={"title", "description", "source"}) for each in (scenario, load_scenario(scenario.name))
    )
    return one == other


def other_tests(scenario: Scenario) -> tuple[Scenario, ...]:
    """Return the other two of the three tests (``TESTS``) if ``scenario`` is one of them, as shipped; else an empty
    tuple.
    """
    if scenario.name not in TESTS or not is_as_shipped(scenario):
        return ()
    return tuple(load_scenario(name) for name in TESTS if name != scenario.name)


_KEPT = ("collision_rate", "first_impact_harm", "total_harm")  # columns of the short table


def brief(table: SummaryTable, beside: Mapping[str, SummaryTable]) -> Sheet:
    """Return a table for one screen: each agent's collisions and both harms, and its harm in other tests, and notes
    below.

    Rows of other sources and other measures are left out.

    Args:
        table: summary of the agents on the main test.
        beside: summaries of the agents on other tests, by name of the test.

    """
    ours = SummaryTable(table)
    sheet = ours.terminal()
    short = sheet.only(k for k, name in enumerate(sheet.names) if k == 0 or name in _KEPT)
    columns, rows = list(short.columns), [list(row) for row in short.rows]
    note = f"{ours[0].parameters.line}. Harm: mean per world in m²/s², below it the 95 % interval."
    notes = [note, *(text for _, text in ours.notes())]
    for test, other in beside.items():
        by_agent = {row.agent: row for row in other}
        columns.append(Column(f"{TESTS[test].partition(' test')[0]}:\nfirst, total"))
        for cells, row in zip(rows, (by_agent.get(row.agent) for row in ours), strict=True):
            cells.append(row and f"{row.first_impact_harm.value:.2f}, {row.total_harm.value:.2f}")
        must = [text for kind, text in other.notes() if kind == "note"]
        notes.append(" ".join([TESTS[test], f"{count_of(other[0].episodes, 'world')}.", *must]))
    return replace(short, columns=columns, rows=rows, note="\n".join(notes))
