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

    A name that begins with + is appended to the name of an agent, as in full_brake+step.
    """
    with Out(as_json=as_json) as out:
        from ethbrake_marl.names import group, listed_agents, why_not_listed

        entries = listed_agents()
        out.result(
            [{"agent": each.form, "about": each.about, "knows": each.knows} for each in entries],
            Sheet("", ("Agent", "Method", "Knows"), [(each.form, each.about, each.knows) for each in entries], gap=2),
            f"ladder stands for {', '.join(group('ladder'))}. See docs/evaluate.md and docs/shield.md.",
        )
        for reason in why_not_listed():
            out.note(f"left out: {reason}")


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
        from ethbrake_marl.policies.bundle import load_named_policy

        out.check(onnx)
        out.write(onnx, load_named_policy(policy).to_onnx(), what="written")
