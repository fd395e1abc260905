"""The command ``reproduce``: reproduce the paper's figures and tables."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ethbrake_marl.cli.command import ForceOption, JsonOption, Out, example
from ethbrake_marl.errors import InvalidInput, need
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.registry import Part

REMAINS = "repeat the command to continue with the results in the folder"

PAPER_EPISODES = 10_000


def reproduce_command(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="ITEM",
            help="Figures and tables to reproduce; --list prints their names.",
            show_default="everything",
        ),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Use shipped policies and train none (default).")] = False,
    full: Annotated[
        bool, typer.Option("--full", help="Also train policies, for example for the learning curves.")
    ] = False,
    output: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder for all results.")] = Path("runs/reproduction"),
    episodes: Annotated[
        int,
        typer.Option(
            help="Largest number of worlds for a figure or table; the paper uses 10,000.", min=2, max=PAPER_EPISODES
        ),
    ] = PAPER_EPISODES,
    cost: Annotated[
        bool, typer.Option("--cost", help="Print how much work is left and how long it will take, and exit.")
    ] = False,
    listed: Annotated[bool, typer.Option("--list", help="List all figures and tables, and exit.")] = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Reproduce the paper's results, and compare ours with them.

    An item is a figure or a table of the paper. The command prints how long the work takes, then reproduces each item.
    The command writes one page (index.html) with all items and, for each item, figures and data. A verdict says whether
    our results agree with the paper, differ, or cannot agree. After an interruption, repeat the command to continue.
    """
    with Out(as_json=as_json, force=force, remains=REMAINS) as out:
        from ethbrake_marl.extensions.reproduction.folder import Reproduction
        from ethbrake_marl.extensions.reproduction.making import choose_items, make_items
        from ethbrake_marl.extensions.studies.machine import this_machine

        if quick and full:
            raise InvalidInput("--quick and --full cannot be combined; give only one of them")
        chosen = choose_items(names or ())
        if listed:
            rows = [(item.name, ", ".join(item.labels), item.title) for item in chosen]
            known = {"Item": "name", "Label in the paper": "labels", "What": "title"}
            sheet = Sheet("", [Column(heading, key, text=True) for heading, key in known.items()], rows)
            out.result(sheet.json(), sheet)
            return
        if full:
            need("torch")
        asked = Reproduction("full" if full else "quick", output, episodes, out.show_progress, str(this_machine()))
        out.note(asked.cost(chosen))
        if cost:
            return
        results, finished = make_items(asked, chosen, force=out.force)
        verdicts = [(result.name, result.verdict.outcome, result.verdict.because) for result in results]
        out.result([result.in_words() for result in results], Sheet("", ("Item", "Verdict", "Because"), verdicts))
        out.note(f"page: {output / 'index.html'}")
        if not finished:
            out.interrupted(f"interrupted: the results use only the finished training runs; {REMAINS}")


REPRODUCE = Part(reproduce_command, epilog=example("reproduce random-table harm-distance --quick --output runs/paper"))
