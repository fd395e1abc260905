"""The command ``reproduce``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ethbrake_marl.cli.command import ForceOption, JsonOption, Out, example
from ethbrake_marl.files.sheet import Sheet
from ethbrake_marl.registry import Part


def reproduce_command(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="ITEM",
            help="Figures and tables to reproduce; --list prints their names.",
            show_default="everything",
        ),
    ] = None,
    output: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder for all results.")] = Path("runs/reproduction"),
    episodes: Annotated[
        int,
        typer.Option(help="Largest number of worlds for a figure or table; the paper uses 10,000.", min=2, max=10_000),
    ] = 10_000,
    cost: Annotated[
        bool, typer.Option("--cost", help="Print how much work is left and how long it will take, and exit.")
    ] = False,
    list_only: Annotated[bool, typer.Option("--list", help="List all figures and tables, and exit.")] = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Reproduce the paper's results, and compare ours with them.

    The command prints our verdict on each number and statement of the paper in three readings of the paper's count of
    harm: ours (the first impact of every pair), R1 (the episode ends at the line's first impact) and R2 (each pair
    counts as if the other did not exist). Shipped policies drive; what rests on a training is recorded. The command
    writes a page (README.md) with numbers, reasons and all items, and figures (SVG, PDF) and tables (CSV) of each. An
    item is a figure or a table of the paper.
    """
    with Out(as_json=as_json, force=force) as out:
        from ethbrake_marl.extensions.reproduction import items
        from ethbrake_marl.extensions.reproduction.made import ReproductionSettings
        from ethbrake_marl.extensions.reproduction.verdicts import count_sheet, short_lines
        from ethbrake_marl.extensions.studies.machine import this_machine

        chosen = items.choose_items(names or ())
        if list_only:
            rows = [(item.name, ", ".join(item.labels), item.title) for item in chosen]
            sheet = Sheet("", ("Item", "Label in the paper", "What"), rows)
            out.result(sheet.json(), sheet)
            return
        settings = ReproductionSettings(output, episodes, out.show_progress)
        out.note(items.cost(chosen))
        if cost:
            return
        results = items.reproduce(settings, chosen, this_machine(), force=out.force)
        judged = items.judged(results)
        out.result(items.plain_results(results), short_lines(judged), "", count_sheet(judged), in_file=True)
        out.note(f"page: {output / items.RESULTS_FILE}")


REPRODUCE = Part(reproduce_command, epilog=example("reproduce random-table harm-distance --output runs/paper"))
