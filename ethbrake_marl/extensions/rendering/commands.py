"""The command ``watch``: write films of episodes, and OpenSCENARIO files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ethbrake_marl.cli.command import (
    AgentsOption,
    ForceOption,
    Out,
    ScenarioOption,
    SeedOption,
    SettingsOption,
    example,
)
from ethbrake_marl.errors import InvalidInput, MissingExtra
from ethbrake_marl.registry import Part

DEFAULT_FILE = "watch.gif"


def watch_command(
    output: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.gif|FILE.mp4|FILE.png|FILE.svg|FILE.xosc|-",
            help="File for the film; .png, .svg: three moments of it; .xosc: OpenSCENARIO; -: print it as text.",
            show_default=f"a window, or {DEFAULT_FILE} if none can be opened",
        ),
    ] = None,
    agents: AgentsOption = "e_v2x_bm",
    scenario: ScenarioOption = "paper-random",
    world: Annotated[int, typer.Option(help="Number of the world in the evaluation list.", min=0)] = 0,
    seed: SeedOption = 7,
    settings: SettingsOption = None,
    force: ForceOption = False,
) -> None:
    """Show a real-time film of agents that drive the same world.

    The film shows the road to scale, the commands, the impacts and the harm. A PNG or SVG file shows three moments: the
    alert, the hardest impact under any agent, and the end; the text shows the alert, each pair's first impact in a time
    step, and the end. An OpenSCENARIO file (1.3) holds the trajectories under one agent; its road (OpenDRIVE) is
    beside it.
    """
    from ethbrake_marl.agent_names import open_game, require_learner, teams_of
    from ethbrake_marl.cli.settings import read_settings
    from ethbrake_marl.evaluation.record import record_episodes
    from ethbrake_marl.extensions.rendering.film import (
        OPENSCENARIO,
        WRITERS,
        check_film,
        films_in_words,
        films_of,
        show_in_window,
    )

    with Out(force=force) as out:
        in_words = output == Path("-")
        if output is not None and not in_words:
            check_film(output.suffix.lower())
            out.check(output)
        chosen = read_settings(settings, of_command=("harm_count",))
        loaded, game = open_game(chosen.change_scenario(scenario))
        require_learner(loaded)
        teams = teams_of(agents, loaded, **chosen.command)
        if output is not None and output.suffix.lower() == OPENSCENARIO:
            if len(teams) > 1:
                raise InvalidInput(f"--output {output}: holds the motion under one agent; --agents names {len(teams)}")
            from ethbrake_marl.extensions.rendering.openscenario import to_openscenario

            road = output.with_suffix(".xodr")
            out.check(road)
            record = record_episodes(loaded.sample(1, seed, first=world), next(iter(teams.values())), game)[0]
            for path, content in zip((output, road), to_openscenario(record, road.name), strict=True):
                out.write(path, content, what="written")
            return
        titled = {f"{name}: world {world} of {loaded.name}": team for name, team in teams.items()}
        films = films_of(loaded.sample(1, seed, first=world), titled, game)
        if in_words:
            out.show(films_in_words(films), end="")
            return
        if output is None:
            try:
                show_in_window(films)
                return
            except (InvalidInput, MissingExtra) as error:
                out.note(str(error))
            out.check(Path(DEFAULT_FILE))
        path = output or Path(DEFAULT_FILE)
        what = "pictures" if path.suffix.lower() in (".png", ".svg") else "film"
        out.write(path, WRITERS[path.suffix.lower()](films), what=what)


WATCH = Part(watch_command, epilog=example("watch --agents full_brake,e_v2x_bm --world 3 --output both.gif"))
