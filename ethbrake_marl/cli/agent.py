"""The command ``agent list``."""

from __future__ import annotations

import typer

from ethbrake_marl.cli.command import JsonOption, Out, example
from ethbrake_marl.files.sheet import Sheet

agent_group = typer.Typer(help="List the agents.", epilog=example("agent list", "agent list --json"))


@agent_group.command("list", epilog=example("agent list"))
def agent_list(as_json: JsonOption = False) -> None:
    """List all agents, what they do and what they know.

    A name that begins with + is appended to the name of an agent, as in full_brake+step.
    """
    with Out(as_json=as_json) as out:
        from ethbrake_marl.names import group, listed_agents, why_not_listed

        entries = listed_agents()
        out.result(
            [{"agent": entry.form, "about": entry.about, "knows": entry.knows} for entry in entries],
            Sheet(
                "", ("Agent", "Method", "Knows"), [(entry.form, entry.about, entry.knows) for entry in entries], gap=2
            ),
            f"ladder stands for {', '.join(group('ladder'))}. See docs/evaluate.md and docs/shield.md.",
        )
        for reason in why_not_listed():
            out.note(f"left out: {reason}")
