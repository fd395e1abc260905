"""The commands about policies as files: export one, or import one that another program saved."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from ethbrake_marl.command_options import ForceOption, ScenarioOption
from ethbrake_marl.errors import AlreadyExists
from ethbrake_marl.evaluation.output_files import check_target, write_output
from ethbrake_marl.learning.bundle import save_policy
from ethbrake_marl.learning.onnx_export import onnx_model
from ethbrake_marl.learning.shipped import load_named_policy
from ethbrake_marl.lineup import load_runnable
from ethbrake_marl.terminal import say


def export_command(
    policy: Annotated[str, typer.Argument(metavar="FOLDER", help="A run, a policy bundle, or shipped/NAME.")],
    onnx: Annotated[Path, typer.Option("--onnx", metavar="FILE", help="The ONNX model to write.")],
    force: ForceOption = False,
) -> None:
    """Write a policy as an ONNX model: observation in, acceleration out.

    Needs the package onnx, which the extra `export` brings.
    """
    check_target(onnx, force=force)
    write_output(onnx, onnx_model(load_named_policy(policy)), force=force)
    say(f"written: {onnx}")


def import_legacy_command(
    file: Annotated[Path, typer.Argument(metavar="FILE.zip", help="What Stable-Baselines3's save() wrote.")],
    output: Annotated[Path, typer.Option("--output", metavar="FOLDER", help="The new policy bundle.")],
    scenario: ScenarioOption = "paper-random",
    algorithm: Annotated[Literal["ppo", "sac"], typer.Option(help="Which algorithm saved it.")] = "ppo",
    trusted: Annotated[
        bool, typer.Option("--i-trust-this-file", help="Reading the file runs the code inside it: I know who wrote it.")
    ] = False,
) -> None:
    """Make a policy bundle from a .zip of Stable-Baselines3.

    Such a file can do anything that you can, when it is read. A bundle cannot: share those instead.
    """
    if output.exists() or output.is_symlink():
        raise AlreadyExists(f"{output}: is there already; give another name")
    from ethbrake_marl.learning.legacy_import import import_legacy  # torch takes seconds to load

    save_policy(import_legacy(file, load_runnable(scenario), algorithm=algorithm, trusted=trusted), output)
    say(f"written: {output}; use it as {algorithm}@{output}")
