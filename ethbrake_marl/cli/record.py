"""The command ``ethbrake record``: agents in one world, as a film."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ethbrake_marl.cli.late import LATE
from ethbrake_marl.cli.options import ForceOption, ScenarioOption, UncertaintyOption, VehicleOption
from ethbrake_marl.cli.terminal import interruptible, say
from ethbrake_marl.defaults import LIST_SEED

if TYPE_CHECKING or LATE:
    from ethbrake_marl.evaluation import check_target
    from ethbrake_marl.evaluation.episodes import check_ending, check_number_of_films, film_bytes, film_scenes
    from ethbrake_marl.evaluation.inputs import load_evaluated, make_lineup
    from ethbrake_marl.evaluation.results import write_output
    from ethbrake_marl.shield.uncertainty import parse_uncertainty


def record_command(
    output: Annotated[Path, typer.Option("--output", metavar="FILE.gif|FILE.mp4|FILE.svg", help="The film to write.")],
    agents: Annotated[
        str, typer.Option(metavar="A,B,...", help="Who drives, one below the other; as in `ethbrake evaluate`.")
    ] = "e_v2x_bm",
    scenario: ScenarioOption = "paper-random",
    world: Annotated[int, typer.Option(help="Number of the world in the list.", min=0)] = 0,
    seed: Annotated[int, typer.Option(help="Seed of the list.", min=0)] = LIST_SEED,
    vehicle: VehicleOption = None,
    uncertainty: UncertaintyOption = None,
    force: ForceOption = False,
) -> None:
    """Agents in one world of the list, in real time: the road to scale, commands, impacts, harm."""
    ending = output.suffix.lower()
    check_ending(ending)
    target = check_target(output, force=force)
    check_number_of_films(len(agents.split(",")))
    chosen = load_evaluated(scenario, vehicle)
    intervals = None if uncertainty is None else parse_uncertainty(uncertainty)
    lineup = make_lineup(agents.split(","), chosen, uncertainty=intervals)
    worlds = chosen.sample(1, seed, first=world).worlds
    films = {}
    with interruptible("nothing was written"):
        for name, agent in lineup.items():
            films[f"{name}: world {world} of {chosen.name}"] = film_scenes(worlds, agent, scenario=chosen)
        write_output(target, film_bytes(films, ending), force=force)
    say(f"film: {target}")
