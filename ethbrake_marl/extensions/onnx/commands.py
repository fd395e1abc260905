"""The command ``agent export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ethbrake_marl.cli.command import ForceOption, Out, example
from ethbrake_marl.registry import Part


def export_command(
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
        from ethbrake_marl.extensions.onnx.model import to_onnx
        from ethbrake_marl.policies.bundle import load_named_policy

        out.check(onnx)
        out.write(onnx, to_onnx(load_named_policy(policy)), what="written")


EXPORT = Part(export_command, epilog=example("agent export runs/early --onnx early.onnx"))
