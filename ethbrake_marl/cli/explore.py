"""The command ``ethbrake explore``: a local page with sliders, on which all agents answer at once."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from ethbrake_marl.cli.late import LATE
from ethbrake_marl.cli.options import ScenarioOption, SetOption, VehicleOption
from ethbrake_marl.cli.terminal import say, show
from ethbrake_marl.defaults import LIST_SEED
from ethbrake_marl.errors import need

if TYPE_CHECKING or LATE:
    from ethbrake_marl.evaluation.inputs import load_driven, make_lineup
    from ethbrake_marl.learning.recipe import read_settings

AGENTS = "full_brake,copy_leader,e_v2x_bm,ppo@shipped,ppo@shipped+step"


def explore_command(
    scenario: ScenarioOption = "paper-random",
    agents: Annotated[str, typer.Option(metavar="A,B,...", help="Who drives; as in `ethbrake evaluate`.")] = AGENTS,
    vehicle: VehicleOption = None,
    settings: SetOption = None,
    world: Annotated[int, typer.Option(help="Number of the first world in the list.", min=0)] = 0,
    seed: Annotated[int, typer.Option(help="Seed of the list.", min=0)] = LIST_SEED,
    harm_count: Annotated[Literal["first", "total"], typer.Option(help="The harm that agents minimise.")] = "first",
    folder: Annotated[Path, typer.Option(metavar="DIR", help="Where states are saved, and nowhere else.")] = Path(),
    port: Annotated[int, typer.Option(help="On 127.0.0.1; 0 takes a free one.", min=0, max=65535)] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Print the address, open nothing.")] = False,
) -> None:
    """Open a local page: sliders for one emergency, every agent's harm and motion at once.

    It listens on this machine alone, and its address holds a token that is new each time. Ctrl-C ends it.
    """
    need("starlette")
    need("uvicorn")
    # Here: the drawing of figures and the server are loaded by no other command.
    from ethbrake_marl.pages.explorer.answer import Explored
    from ethbrake_marl.pages.explorer.server import Setting, serve_explorer

    chosen = load_driven(scenario, vehicle, read_settings(settings).scenario)
    explored = Explored(chosen, make_lineup(agents.split(","), chosen, harm_count=harm_count), harm_count)

    def ready(address: str) -> None:
        show(address)
        say(f"explore {chosen.name} there; files go to {folder.resolve()}; Ctrl-C ends it")
        if not no_browser:
            webbrowser.open(address)

    serve_explorer(Setting(explored, folder.resolve(), seed, world), port, ready)
    say("ended")
