"""The command ``ethbrake replay``: an episode that a passport names, played again and compared to the bit."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ethbrake_marl.cli.late import LATE
from ethbrake_marl.cli.options import ForceOption, JsonOption, SetOption
from ethbrake_marl.cli.terminal import interruptible, say, show, write_json
from ethbrake_marl.errors import count_of

if TYPE_CHECKING or LATE:
    from ethbrake_marl.cli.report import check_page
    from ethbrake_marl.evaluation import check_target
    from ethbrake_marl.evaluation.episodes import (
        Given,
        Replay,
        check_ending,
        film_bytes,
        film_scenes,
        parse_passport,
        replay,
    )
    from ethbrake_marl.evaluation.results import write_output
    from ethbrake_marl.learning.recipe import read_settings
    from ethbrake_marl.shield.uncertainty import parse_uncertainty

DIFFERS = 1  # exit status
_PAGE = (".html", ".htm")


def replay_command(
    passport: Annotated[str, typer.Argument(metavar="PASSPORT", help="As it stands under an episode of a report.")],
    scenario: Annotated[
        str | None,
        typer.Option(metavar="NAME|PATH", help="Its scenario.", show_default="the shipped one of that name"),
    ] = None,
    agent: Annotated[
        str | None, typer.Option(help="Who drives, where the passport cannot say it.", show_default="the passport's")
    ] = None,
    initial_states: Annotated[
        Path | None, typer.Option(metavar="CSV", help="The worlds, where they came from a file.")
    ] = None,
    uncertainty: Annotated[
        str | None, typer.Option(metavar="QUANTITY=WIDTH,...", help="What +robust did not know.")
    ] = None,
    settings: SetOption = None,
    output: Annotated[
        Path | None,
        typer.Option(metavar="FILE.html|FILE.gif|FILE.mp4|FILE.svg", help="Also write it as a page or a film."),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Play an episode again, bit for bit, or say what differs.

    Exit status 1 where the world or the episode is another one than the passport's.
    """
    named = parse_passport(passport)
    if output is not None:
        check_output(output, force=force)
    given = Given(
        scenario,
        read_settings(settings).scenario,
        agent,
        initial_states,
        None if uncertainty is None else parse_uncertainty(uncertainty),
    )
    with interruptible("nothing was written"):
        found = replay(named, given)
        if output is not None:
            write_output(output, picture_of(found, output.suffix.lower()), force=force)
    if as_json:
        write_json(_to_json(found))
    else:
        for line in _lines(found):
            show(line)
    if output is not None:
        say(f"written: {output}")
    if not found.same:
        raise typer.Exit(DIFFERS)


def check_output(path: Path, *, force: bool) -> None:
    """Refuse a page or film that cannot be written, before any work."""
    if path.suffix.lower() in _PAGE:
        check_page(path, force=force)
    else:
        check_ending(path.suffix.lower())
        check_target(path, force=force)


def picture_of(found: Replay, ending: str) -> bytes:
    """The episode as a page, or as a film."""
    if ending not in _PAGE:
        return film_bytes({found.title: film_scenes(found.worlds, found.agent, scenario=found.scenario)}, ending)
    # Here: matplotlib takes a second to load.
    from ethbrake_marl.pages.frame import Section, page
    from ethbrake_marl.pages.player import Played, player

    name, passport = found.passport.agent, str(found.passport)
    one = Played(found.passport.number, "Replayed", "", {name: found.motion}, {name: passport})
    told = " ".join(_lines(found))
    return page(found.title, [Section("Episode", [player([one], found.scenario.learners)])], lead=told).encode()


def _lines(found: Replay) -> list[str]:
    first, total = found.motion.harm
    impacts = int(found.motion.ledger.impacts[0])
    told = f"{found.title}: {count_of(impacts, 'impact')}, harm {first:.2f} first-impact, {total:.2f} total (m²/s²)."
    verdict = "The same episode, bit for bit." if found.same else "Not the same episode."
    return [told, verdict, *(f"Differs: {each}." for each in found.differences)]


def _to_json(found: Replay) -> dict[str, object]:
    first, total = found.motion.harm
    return {
        "same": found.same,
        "differences": list(found.differences),
        "passport": str(found.passport),
        "impacts": int(found.motion.ledger.impacts[0]),
        "first_impact_harm": first,
        "total_harm": total,
    }
