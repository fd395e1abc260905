"""The commands ``agent list`` and ``agent export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ethbrake_marl.cli.command import ForceOption, JsonOption, Out, example
from ethbrake_marl.files.sheet import Sheet

agent_group = typer.Typer(
    help="List the agents, or export a policy.",
    epilog=example("agent list", "agent export runs/early --onnx early.onnx"),
)


@agent_group.command("list", epilog=example("agent list"))
def agent_list(as_json: JsonOption = False) -> None:
    """List all agents, what they do and what they know.

    In the list, a name that begins with + is appended to the name of an agent, as in full_brake+step. The name +search
    comes before a shield, as in full_brake+search+step.
    """
    with Out(as_json=as_json) as out:
        from ethbrake_marl.first_edition.agents.protocol import Knowledge
        from ethbrake_marl.first_edition.agents.registry import agent_entries, agents_refused

        content, rows = [], []
        for entry in agent_entries():
            knows, added = Knowledge.of(entry), "also " if entry.form.startswith("+") else ""
            content.append(
                {"agent": entry.form, "about": entry.about, "knows": list(knows), "omniscient": knows.sees_through}
            )
            rows.append((entry.form, entry.about, f"{added}{knows.text}{' †' if knows.sees_through else ''}"))
        for reason in agents_refused():
            out.note(f"left out: {reason}")
        out.result(
            content,
            Sheet("", ("Agent", "Method", "Knows"), rows, gap=2),
            "† omniscient: the agent reads values that no message carried. With :estimated after its name, an agent"
            " uses only what its vehicle has received.",
            "ladder stands for all agents from coast to best_harm. See docs/evaluate.md and docs/shield.md.",
        )


@agent_group.command("export", epilog=example("agent export runs/early --onnx early.onnx"))
def agent_export(
    policy: Annotated[
        str, typer.Argument(metavar="NAME|PATH", help="Name of a shipped policy, or folder of a run or policy bundle.")
    ],
    onnx: Annotated[Path, typer.Option(metavar="FILE", help="File for the ONNX model.")],
    force: ForceOption = False,
) -> None:
    """Write a policy as an ONNX model.

    The input of the model is an observation, the output an acceleration. The command needs the package onnx, which the
    extra `export` installs.
    """
    with Out(force=force) as out:
        from ethbrake_marl.first_edition.policies.shipped import load_named_policy

        out.check(onnx)
        out.write(onnx, load_named_policy(policy).to_onnx(), what="written")
