"""The command ``ethbrake reproduce``: the paper's figures and tables, made again, with computed verdicts."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich import box
from rich.table import Table
from rich.text import Text

from ethbrake_marl.cli.machine import this_machine
from ethbrake_marl.cli.options import ForceOption, JsonOption
from ethbrake_marl.cli.terminal import INTERRUPTED, interruptible, progress_bars, result_console, say, write_json
from ethbrake_marl.errors import InvalidInput, need

if TYPE_CHECKING:
    from ethbrake_marl.studies.reproduction.item import Result

KEPT = "the same command goes on with what is in the folder"
EPISODES = 10_000


ItemsArgument = Annotated[
    list[str] | None, typer.Argument(metavar="[ITEM ...]", help="What to make.", show_default="everything")
]
FolderOption = Annotated[
    Path | None,
    typer.Option(metavar="FOLDER", help="Folder of everything.", show_default="runs/reproduction"),
]
DocsOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE.md", help="Write the results as Markdown, too, figures beside it."),
]


def reproduce_command(
    names: ItemsArgument = None,
    quick: Annotated[bool, typer.Option("--quick", help="Train nothing: shipped policies (the default).")] = False,
    full: Annotated[bool, typer.Option("--full", help="Train learning curves and a policy stopped early.")] = False,
    output: FolderOption = None,
    episodes: Annotated[int, typer.Option(help="The most worlds of any list; the paper has 10,000.")] = EPISODES,
    docs: DocsOption = None,
    cost: Annotated[bool, typer.Option("--cost", help="Say what is left to do and what it takes; stop.")] = False,
    listed: Annotated[bool, typer.Option("--list", help="List the items; stop.")] = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Make the paper's figures and tables again, and say what agrees, what differs and what cannot agree.

    Writes one page (index.html), and for each item its figures, its data and its result. Says first what it will take.
    The same command goes on after an interruption.
    """
    with interruptible(KEPT):
        # matplotlib and the statistics take seconds to load
        from ethbrake_marl.studies.reproduction.folder import (
            PAGE,
            check_docs,
            choose_items,
            reproduce,
            tell_cost,
            write_docs,
        )
        from ethbrake_marl.studies.reproduction.item import Settings

        chosen = choose_items(names or ())
        if listed:
            _list([(item.name, ", ".join(item.labels), item.title) for item in chosen], as_json)
            return
        _check(quick=quick, full=full, episodes=episodes)
        folder = output or Path("runs") / "reproduction"
        if full:
            need("torch")
        if docs is not None:
            check_docs(docs)
        with progress_bars() as bars:
            settings = Settings("full" if full else "quick", folder, episodes, bars.show_progress, str(this_machine()))
            say(tell_cost(chosen, settings))
            if cost:
                return
            results, finished = reproduce(chosen, settings, force=force)
        if docs is not None:
            write_docs(docs, folder, results)
    if as_json:
        write_json([asdict(result) for result in results])
    else:
        _show(results)
    say(f"page: {folder / PAGE}")
    if not finished:
        say(f"interrupted: items are made of the trainings that were finished; {KEPT}")
        raise typer.Exit(INTERRUPTED)


def _check(*, quick: bool, full: bool, episodes: int) -> None:
    if quick and full:
        raise InvalidInput("--quick and --full: give one of the two")
    if not 2 <= episodes <= EPISODES:
        raise InvalidInput(f"episodes {episodes}: must be from 2 to {EPISODES:,}")


def _list(items: list[tuple[str, str, str]], as_json: bool) -> None:
    """Name, labels in the paper and title of each item."""
    if as_json:
        write_json([dict(zip(("name", "labels", "title"), item, strict=True)) for item in items])
        return
    table = _table("Item", "Label in the paper", "What")
    for item in items:
        table.add_row(*map(Text, item))
    result_console().print(table)


def _show(results: list[Result]) -> None:
    """One line per item."""
    table = _table("Item", "Verdict", "Because")
    for result in results:
        table.add_row(Text(result.name), Text(result.verdict.outcome), Text(result.verdict.because))
    result_console().print(table)


def _table(*columns: str) -> Table:
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, title_justify="left")
    for column in columns:
        table.add_column(column, overflow="fold")
    return table
