"""The command ``watch``: write films of episodes."""

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
from ethbrake_marl.registry import Part


def watch_command(
    output: Annotated[
        Path, typer.Option(metavar="FILE.gif|FILE.mp4|FILE.png", help="File for the film; .png: three moments of it.")
    ],
    agents: AgentsOption = "e_v2x_bm",
    scenario: ScenarioOption = "paper-random",
    world: Annotated[int, typer.Option(help="Number of the world in the evaluation list.", min=0)] = 0,
    seed: SeedOption = 7,
    settings: SettingsOption = None,
    force: ForceOption = False,
) -> None:
    """Write a real-time film of agents that drive the same world.

    The film shows the road to scale, the commands, the impacts and the harm. A PNG file shows three moments: the alert,
    the hardest impact, and the end.
    """
    from ethbrake_marl.cli.settings import read_settings
    from ethbrake_marl.extensions.rendering.film import check_film, film
    from ethbrake_marl.names import open_game, require_learner, teams_of

    with Out(force=force) as out:
        out.check(output)
        check_film(output.suffix.lower())
        what = "pictures" if output.suffix.lower() == ".png" else "film"
        chosen = read_settings(settings, of_command=("harm_count",))
        loaded, game = open_game(chosen.change_scenario(scenario))
        require_learner(loaded)
        teams = teams_of(agents, loaded, harm_count=chosen.command.get("harm_count", "first"))
        titled = {f"{name}: world {world} of {loaded.name}": team for name, team in teams.items()}
        alert = loaded.sample(1, seed, first=world)
        out.write(output, film(alert, titled, output.suffix.lower(), game), what=what)


WATCH = Part(watch_command, epilog=example("watch --agents full_brake,e_v2x_bm --world 3 --output both.gif"))
