"""The command ``reproduce``: reproduce the paper's figures and tables."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ethbrake_marl.cli.command import ForceOption, JsonOption, Out, example
from ethbrake_marl.errors import InvalidInput, need
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.registry import Part

REMAINS = "the same command goes on with what is in the folder"

PAPER_EPISODES = 10_000


def reproduce_command(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="ITEM", help="Figures and tables to make; --list names them.", show_default="everything"
        ),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Train nothing, use shipped policies (the default).")] = False,
    full: Annotated[bool, typer.Option("--full", help="Train learning curves and a policy stopped early.")] = False,
    output: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder for all results.")] = Path("runs/reproduction"),
    episodes: Annotated[
        int, typer.Option(help="The most worlds of any list; the paper has 10,000.", min=2, max=PAPER_EPISODES)
    ] = PAPER_EPISODES,
    docs: Annotated[
        Path | None, typer.Option(metavar="FILE.json", help="Also write the results as JSON, figures beside it.")
    ] = None,
    cost: Annotated[
        bool, typer.Option("--cost", help="Print what is left to do and how long it takes, and exit.")
    ] = False,
    listed: Annotated[bool, typer.Option("--list", help="List the items, and exit.")] = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Make the paper's figures and tables again.

    Says what agrees, what differs and what cannot agree. Writes one page (index.html), and for each item its figures,
    its data and its result. Prints first how long it will take. The same command goes on after an interruption.
    """
    with Out(as_json=as_json, force=force, remains=REMAINS) as out:
        from ethbrake_marl.extensions.reproduction.folder import Reproduction
        from ethbrake_marl.extensions.reproduction.making import choose_items, make_items
        from ethbrake_marl.extensions.studies.machine import this_machine

        if quick and full:
            raise InvalidInput("--quick and --full: give one of the two")
        chosen = choose_items(names or ())
        if listed:
            rows = [(item.name, ", ".join(item.labels), item.title) for item in chosen]
            known = {"Item": "name", "Label in the paper": "labels", "What": "title"}
            sheet = Sheet("", [Column(heading, key, text=True) for heading, key in known.items()], rows)
            out.result(sheet.json(), sheet)
            return
        if full:
            need("torch")
        asked = Reproduction(
            "full" if full else "quick", output, episodes, out.show_progress, str(this_machine()), docs
        )
        out.note(asked.cost(chosen))
        if cost:
            return
        results, finished = make_items(asked, chosen, force=out.force)
        verdicts = [(result.name, result.verdict.outcome, result.verdict.because) for result in results]
        out.result([result.in_words() for result in results], Sheet("", ("Item", "Verdict", "Because"), verdicts))
        out.note(f"page: {output / 'index.html'}")
        if not finished:
            out.interrupted(f"interrupted: items are made of the trainings that were finished; {REMAINS}")


REPRODUCE = Part(reproduce_command, epilog=example("reproduce random-table harm-distance --quick --output runs/paper"))
