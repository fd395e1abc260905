"""The command ``reproduce``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ethbrake_marl.cli.command import ForceOption, JsonOption, Out, example
from ethbrake_marl.files.sheet import Sheet
from ethbrake_marl.registry import Part

AFTER_STOPPED_REPRODUCTION = "finished trainings remain; repeat the command to continue"


def reproduce_command(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="ITEM",
            help="Figures and tables to reproduce; --list prints their names.",
            show_default="everything",
        ),
    ] = None,
    full: Annotated[
        bool,
        typer.Option(
            "--full", help="Also train by the paper's own process, which takes hours; --cost prints how many."
        ),
    ] = False,
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

    The command prints how long the work takes, and then one table: each number and statement of the paper, ours, our
    verdict and a reason. Shipped policies drive; only a policy that has not converged is trained. Trainings of an
    earlier --full in the folder are shown, with their number of seeds. The command writes a page (README.md) with this
    table and all items, and figures (SVG, PDF) and tables (CSV) of each. An item is a figure or a table of the paper.
    After an interruption, repeat the command: trainings go on where they were.
    """
    with Out(as_json=as_json, force=force, remains=AFTER_STOPPED_REPRODUCTION) as out:
        from ethbrake_marl.extensions.reproduction import items
        from ethbrake_marl.extensions.reproduction.made import ReproductionSettings
        from ethbrake_marl.extensions.studies.machine import this_machine

        chosen = items.choose_items(names or ())
        if list_only:
            rows = [(item.name, ", ".join(item.labels), item.title) for item in chosen]
            sheet = Sheet("", ("Item", "Label in the paper", "What"), rows)
            out.result(sheet.json(), sheet)
            return
        settings = ReproductionSettings(output, full, episodes, out.show_progress)
        out.note(items.cost(settings, chosen))
        if cost:
            return
        results = items.reproduce(settings, chosen, this_machine(), force=out.force)
        if results is None:
            out.interrupted(f"interrupted; {AFTER_STOPPED_REPRODUCTION}")
        out.result(items.plain_results(results), items.overview(results), in_file=True)
        if not full:
            out.note(items.QUICK_NOTE)
        out.note(f"page: {output / items.RESULTS_FILE}")


REPRODUCE = Part(reproduce_command, epilog=example("reproduce random-table harm-distance --output runs/paper"))
