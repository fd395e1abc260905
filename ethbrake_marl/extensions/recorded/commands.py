"""The command ``scenario from-data``: make a scenario from recorded traffic."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from ethbrake_marl.cli.command import ForceOption, JsonOption, Out, example
from ethbrake_marl.files.store import new_file
from ethbrake_marl.registry import Part


def from_data_command(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of the recordings.")],
    format: Annotated[Literal["highd", "ngsim", "openacc"], typer.Option(help="Format of the recordings.")],
    output: Annotated[
        Path, typer.Option(metavar="FILE", help="The .yaml to write; its rows stand in the .csv beside.")
    ],
    based_on: Annotated[
        str,
        typer.Option(metavar="NAME|PATH", help="Scenario for what is not recorded, and for the number of vehicles."),
    ] = "realistic-motorway",
    every: Annotated[float, typer.Option(help="Seconds between two moments that become rows.")] = 1.0,
    draw: Annotated[
        Literal["rows", "normal", "lognormal", "quantiles"],
        typer.Option(help="Draw whole rows, or each quantity from a fit to it."),
    ] = "rows",
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Make a scenario of recorded traffic: highD, NGSIM, OpenACC.

    Vehicles that follow each other in a lane become rows: speeds, and gaps from bumper to bumper.
    """
    with Out(as_json=as_json, force=force) as out:
        from ethbrake_marl.extensions.recorded.traffic import scenario_from_data

        rows = output.with_suffix(".csv")
        out.check(output, ".yaml", what="the scenario")
        out.check(rows)
        text, table, told = scenario_from_data(
            output.stem, folder, format, based_on=based_on, every_s=every, draw=draw, progress=out.progress
        )
        with new_file(output) as partial:
            partial.write_text(text, "utf-8")
            if draw == "rows":
                out.write(rows, table, what="rows")
            else:  # remove the rows of an earlier run, to which no scenario refers any more
                rows.unlink(missing_ok=True)
        out.note(f"written: {output}; try it: ethbrake scenario validate {output}")
        out.result({"scenario": str(output), "rows": str(rows) if draw == "rows" else None, "found": told}, *told)


FROM_DATA = Part(
    from_data_command, epilog=example("scenario from-data highd/data --format highd --output my-motorway.yaml")
)
