"""The command ``ethbrake agents``: who can drive."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich import box
from rich.table import Table

from ethbrake_marl.cli.late import LATE
from ethbrake_marl.cli.options import JsonOption
from ethbrake_marl.cli.terminal import result_console, show, write_json

if TYPE_CHECKING or LATE:
    from ethbrake_marl.agents.protocol import knowledge_text, sees_through
    from ethbrake_marl.agents.registry import agent_entries


def agents_command(as_json: JsonOption = False) -> None:
    """List all agents: how each is written, what it does, what it knows.

    What begins with + goes behind any agent, for instance full_brake+step: +refined first, then one shield.
    """
    entries = agent_entries()
    if as_json:
        write_json(
            [
                {"agent": e.form, "about": e.about, "knows": list(e.knows), "omniscient": sees_through(e.knows)}
                for e in entries
            ]
        )
        return
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("Agent", no_wrap=True)
    table.add_column("Drives by", overflow="fold")
    table.add_column("Knows", overflow="fold")
    for entry in entries:
        added = "also " if entry.form.startswith("+") else ""
        mark = " †" if sees_through(entry.knows) else ""
        table.add_row(entry.form, entry.about, added + knowledge_text(entry.knows) + mark)
    result_console().print(table)
    show("† omniscient: reads what no channel brought. With :believed behind it, it decides on what was received.")
    show("ladder stands for coast to best_harm; a typo gets a suggestion. See docs/baselines.md and docs/shield.md.")
