"""``ethbrake shield`` and ``ethbrake picture shield-modes``: what each mode of the shield makes of agents."""

from __future__ import annotations

from typing import Annotated

import typer

from ethbrake_marl.command_options import ForceOption, JsonOption, ScenarioOption, VehicleOption
from ethbrake_marl.evaluation.output_files import write_output
from ethbrake_marl.evaluation.shield_modes import NONE, ModeRow, compare_modes, modes_table
from ethbrake_marl.evaluation.table import horizon_note
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.lineup import LIST_SEED, load_driven, make_proposers
from ethbrake_marl.picture_commands import PictureOption, picture_app, picture_target
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.terminal import interruptible, progress_bars, result_console, say, write_json

EPISODES = 2_000

ProposersOption = Annotated[
    str,
    typer.Option("--agents", metavar="A,B,...", help="Who proposes; agents of `ethbrake evaluate` without a shield."),
]
EpisodesOption = Annotated[int, typer.Option("--episodes", help="Worlds of the list.", min=1)]
CountOption = Annotated[HarmCount, typer.Option("--count", help="Harm that is guaranteed.")]


def shield_command(
    agents: ProposersOption = "ppo@shipped,full_brake,constant:3",
    scenario: ScenarioOption = "paper-random",
    episodes: EpisodesOption = EPISODES,
    count: CountOption = "first",
    vehicle: VehicleOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compare no shield, episode mode and step mode on the same worlds.

    Each decision that step mode replaced is simulated again without it: needed (harm would have been higher), harmless
    (the same), costly (lower).
    """
    chosen = load_driven(scenario, vehicle)
    rows = measured_modes(agents, chosen, episodes, count)
    if as_json:
        write_json([row.to_json() for row in rows])
    else:
        result_console().print(modes_table(rows))
    moving = {f"{row.agent} ({row.mode})": row.horizon_ends for row in rows if row.mode != NONE}
    if note := horizon_note(moving, episodes, chosen.horizon_s):
        say(note)


@picture_app.command("shield-modes", epilog="Example: ethbrake picture shield-modes --episodes 500 --output modes.png")
def picture_shield_modes(
    output: PictureOption,
    agents: ProposersOption = "ppo@shipped,full_brake,constant:3",
    scenario: ScenarioOption = "paper-random",
    episodes: EpisodesOption = EPISODES,
    count: CountOption = "first",
    vehicle: VehicleOption = None,
    force: ForceOption = False,
) -> None:
    """Harm without a shield and in step mode beside episode mode, as ``ethbrake shield`` measures it."""
    target = picture_target(output, force=force)
    # Here: matplotlib takes a second to load, and most commands draw nothing.
    from ethbrake_marl.evaluation.figure_style import png_bytes
    from ethbrake_marl.evaluation.shield_modes_figure import shield_modes_figure

    chosen = load_driven(scenario, vehicle)
    rows = measured_modes(agents, chosen, episodes, count)
    caption = (
        f"{chosen.name}, {episodes} worlds of the list of seed {LIST_SEED}, {count} harm; mean and 95 % interval of the"
        " difference, paired by world."
    )
    write_output(target, png_bytes(shield_modes_figure(rows, caption=caption)), force=force)
    say(f"picture: {target}")


def measured_modes(agents: str, scenario: Scenario, episodes: int, count: HarmCount) -> list[ModeRow]:
    """The rows of these agents, with progress on stderr."""
    worlds = scenario.sample(episodes, LIST_SEED).worlds
    lineup = make_proposers(agents.split(","), scenario, count=count)
    with interruptible("nothing was written"), progress_bars() as bars:
        return compare_modes(
            lineup,
            worlds,
            scenario,
            scenario.learners[0],
            count=count,
            on_progress=lambda name, done: bars.show(name, done, episodes),
        )
