"""The commands ``ethbrake benchmark`` and ``ethbrake leaderboard``: parse, drive or check, print."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ethbrake_marl.cli.late import LATE
from ethbrake_marl.cli.options import ForceOption, JsonOption
from ethbrake_marl.cli.terminal import interruptible, progress_bars, result_console, say, show, write_json
from ethbrake_marl.errors import InvalidInput

if TYPE_CHECKING or LATE:
    from ethbrake_marl.evaluation import check_target
    from ethbrake_marl.evaluation.results import write_output
    from ethbrake_marl.studies.benchmark import load_suite, make_entry, write_entry
    from ethbrake_marl.studies.leaderboard import (
        RANK,
        SCORE,
        Leaderboard,
        leaderboard_markdown,
        leaderboard_table,
        list_table,
        read_leaderboard,
    )

_PAGES = (".html", ".htm")
_MARKDOWN = ".md"


def benchmark_command(
    suite: Annotated[str, typer.Argument(metavar="SUITE", help="A suite that ships, such as v2.")],
    agent: Annotated[str, typer.Option(metavar="SPEC", help="Who drives; any agent of `ethbrake evaluate`.")],
    output: Annotated[
        Path | None, typer.Option(metavar="ENTRY.json", help="Also write the entry to this file.")
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Let an agent drive a frozen suite of lists, and score it.

    The score of a list is the realised share of what is possible, 0 for full braking and 1 for the best known. A list
    that the agent cannot drive has none, and then there is no overall score.
    """
    if output is not None:
        _check_ending(output, (".json",), "an entry ends in .json")
        check_target(output, force=force)
    chosen = load_suite(suite)
    with interruptible("nothing was written"), progress_bars() as bars:
        entry = make_entry(chosen, agent, on_progress=bars.show_progress)
    if output is not None:
        write_entry(output, entry, force=force)
        say(f"entry: {output}")
    if as_json:
        write_json(entry.model_dump(mode="json"))
        return
    result_console().print(list_table(entry, chosen))
    mean = entry.mean_of_driven.in_words(digits=1, scale=100.0, unit=" %")
    if entry.overall is not None:
        show(f"{agent}: overall {mean} of what is possible, mean over {len(chosen.lists)} lists of suite {suite}")
    else:
        show(
            f"{agent}: no overall score, as it drives {entry.lists_driven} of {len(chosen.lists)} lists of suite"
            f" {suite}; {mean} of what is possible there"
        )


def leaderboard_command(
    entries: Annotated[list[Path], typer.Argument(metavar="ENTRY.json...", help="Entries of one suite.")],
    output: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also write the table, as a page (.html) or Markdown (.md).")
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Show entries of `ethbrake benchmark` as one table, sorted by their score.

    Refused by name: entries of another suite, and changed ones.
    """
    if output is not None:
        _check_ending(output, (*_PAGES, _MARKDOWN), "the table ends in .html or .md")
        check_target(output, force=force)
    found = read_leaderboard(entries)
    if output is not None:
        write_output(output, _as_file(found, output).encode(), force=force)
        say(f"table: {output}")
    if as_json:
        write_json(found.to_json())
        return
    result_console().print(leaderboard_table(found))
    for text in (SCORE, RANK, f"Suite {found.suite.name}, SHA-256 {found.suite.sha256}"):
        show(text)


def _as_file(found: Leaderboard, output: Path) -> str:
    """The table as what the file's ending asks for."""
    if output.suffix.lower() == _MARKDOWN:
        return leaderboard_markdown(found)
    # Here: templates take time to load, and most commands write no page.
    from ethbrake_marl.studies.leaderboard import leaderboard_page

    return leaderboard_page(found)


def _check_ending(path: Path, endings: tuple[str, ...], right: str) -> None:
    if path.suffix.lower() not in endings:
        raise InvalidInput(f"{path}: {right}")
