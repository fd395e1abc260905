"""The command ``ethbrake compare``: two results on the same worlds, agent by agent."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich import box
from rich.table import Table
from rich.text import Text

from ethbrake_marl.cli.late import LATE
from ethbrake_marl.cli.options import JsonOption
from ethbrake_marl.cli.terminal import result_console, say, write_json

if TYPE_CHECKING or LATE:
    from ethbrake_marl.evaluation.results import Comparison, compare_results, read_result

_FILE = typer.Argument(metavar="RESULTS.json", help="Results of evaluate, shield (--json) or run.")
_HARMS = {"first_impact_harm": "First-impact harm", "total_harm": "Total harm", "harm": "Harm"}
_POLICIES = {"same": "the same", "other": "another", "none": ""}


def compare_command(
    first: Annotated[Path, _FILE],
    second: Annotated[Path, _FILE],
    as_json: JsonOption = False,
) -> None:
    """Difference of harm between two results, the second minus the first, for agents of the same name.

    Both must be of one command, and about the same worlds of the same scenario. Intervals are paired by world where the
    files of --per-world lie beside both results.
    """
    found = compare_results(read_result(first), read_result(second))
    if as_json:
        write_json(found.to_json())
    else:
        result_console().print(comparison_table(found))
    tell_conditions(found)


def comparison_table(found: Comparison) -> Table:
    """One line per agent, for a terminal."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, title_justify="left")
    table.add_column("Agent", overflow="fold")
    table.add_column("Policy")
    for name in found.differences[0].harms:
        table.add_column(_HARMS[name], justify="right", no_wrap=True)
    for each in found.differences:
        harms = (estimate.in_words() for estimate in each.harms.values())
        table.add_row(Text(each.agent), _POLICIES[each.policy], *map(Text, harms))
    return table


def tell_conditions(found: Comparison) -> None:
    """On stderr: how the intervals were made, who stands in one result only, and which settings and versions differ."""
    say("second minus first, mean per world in m²/s²; in brackets: 95 % intervals,")
    why = found.unpaired_because
    say("paired by world" if why is None else f"NOT paired, wider than they would be paired by world: {why}")
    for which, agents in zip(("first", "second"), found.left_over, strict=True):
        if agents:
            say(f"in the {which} only: {', '.join(agents)}")
    for name, (one, other) in {**found.other_settings, **found.other_versions}.items():
        say(f"note: {name} {one} in the first, {other} in the second")
