"""The command ``scenario from-data``: create a scenario from recorded traffic."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from ethbrake_marl.cli.command import ForceOption, JsonOption, Out, example
from ethbrake_marl.files.store import new_file
from ethbrake_marl.registry import Part


def from_data_command(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Folder of the recordings, with its subfolders, or one file.")
    ],
    format: Annotated[
        Literal["highd", "exid", "ngsim", "openacc", "table"],
        typer.Option(help="Format of the recordings. 'table' is a CSV file whose columns --columns describes."),
    ],
    output: Annotated[
        Path,
        typer.Option(
            metavar="FILE", help="Scenario file (.yaml) to write; the recorded rows go to a .csv file beside it."
        ),
    ],
    columns: Annotated[
        str,
        typer.Option(
            metavar="ROLE=COLUMN,...",
            help="For --format table: which column of the file has which role, for instance"
            " time=T,vehicle=V,lane=L,front=X,length=B,speed=S,units=m if the columns are called T, V, L, X, B and S."
            " Time must be in s: write time=T/1000 if T is in ms, and time=T/25 if T counts frames at 25 Hz. front is"
            " the position of the front bumper, which must increase in the direction of travel. units is m (lengths in"
            " m, speeds in m/s), ft (ft and ft/s) or km/h (m and km/h).",
        ),
    ] = "",
    based_on: Annotated[
        str,
        typer.Option(
            metavar="NAME|PATH",
            help="Scenario that provides the number of vehicles and all quantities that are not recorded;"
            " realistic-pair has two vehicles.",
        ),
    ] = "realistic-motorway",
    every: Annotated[float, typer.Option(help="Take rows from the recordings every so many seconds.")] = 1.0,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Create a scenario from recorded traffic.

    The formats are highD, exiD, NGSIM, OpenACC, and any table of trajectories. Vehicles that follow each other in a
    lane form a chain. Each chain becomes a row of the scenario's table, with the speeds of the vehicles and the gaps
    between them, measured from bumper to bumper.
    """
    with Out(as_json=as_json, force=force) as out:
        from ethbrake_marl.extensions.recorded.scenario import scenario_from_data

        rows = output.with_suffix(".csv")
        out.check(output, ".yaml", what="the scenario")
        out.check(rows)
        result = scenario_from_data(
            output.stem, folder, format, columns=columns, based_on=based_on, every_s=every, progress=out.progress
        )
        for message in result.refused:
            out.note(f"refused: {message}")
        with out.writing():
            with new_file(output) as partial:
                partial.write_text(result.text, "utf-8")
                out.write(rows, result.csv, what="rows")
            out.note(f"written: {output}; try it: ethbrake scenario validate {output}")
        lists = {"found": result.found, "refused": result.refused, "skipped": result.skipped}
        out.result({"scenario": str(output), "rows": str(rows), **lists}, *result.found, in_file=True)


FROM_DATA = Part(
    from_data_command, epilog=example("scenario from-data highd/data --format highd --output my-motorway.yaml")
)
