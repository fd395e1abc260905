"""The commands ``ethbrake picture ...``: parse, draw, write the picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ethbrake_marl.cli.late import LATE
from ethbrake_marl.cli.options import ForceOption, JsonOption, ScenarioOption, SetOption, VehicleOption
from ethbrake_marl.cli.terminal import interruptible, progress_bars, result_console, say, write_json
from ethbrake_marl.defaults import LIST_SEED, HarmCount
from ethbrake_marl.errors import count_of

if TYPE_CHECKING or LATE:
    from ethbrake_marl.agents.protocol import Agent
    from ethbrake_marl.cli.results import counted_without, picture_target, tell_left_out
    from ethbrake_marl.evaluation.curves import CELLS, criticality_map, deceleration_curve
    from ethbrake_marl.evaluation.inputs import (
        load_driven,
        load_evaluated,
        make_agents,
        make_proposers,
        result_identity,
    )
    from ethbrake_marl.learning.recipe import read_settings
    from ethbrake_marl.scenario import Task
    from ethbrake_marl.shield.uncertainty import parse_uncertainty

picture_app = typer.Typer(
    rich_markup_mode=None,
    help="Draw what is critical in a scenario, or what one world asks for.",
    epilog="Example: ethbrake picture criticality --output map.png",
)

PictureOption = Annotated[
    Path, typer.Option("--output", metavar="FILE", help="The picture to write: .png, .svg or .pdf.")
]


@picture_app.command(
    "criticality",
    epilog="Example: ethbrake picture criticality --scenario paper-distance --agent e_v2x_bm --output map.png",
)
def picture_criticality(
    output: PictureOption,
    scenario: ScenarioOption = "paper-distance",
    agent: Annotated[str, typer.Option(help="Who drives; any agent of `ethbrake evaluate`.")] = "e_v2x_bm",
    harm_count: Annotated[HarmCount, typer.Option(help="Harm that the agent minimises, if it does.")] = "first",
    cells: Annotated[int | None, typer.Option(help="Worlds along each gap.", show_default="81")] = None,
    gaps: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="LOW HIGH", help="Range of both gaps (m).", show_default="the scenario's"),
    ] = None,
    settings: SetOption = None,
    force: ForceOption = False,
) -> None:
    """Harm of an agent over both gaps, with the boundary of what is avoidable.

    Everything else must be a fixed number in the scenario.
    """
    target = picture_target(output, force=force)
    # Here and below: matplotlib takes a second to load, and most commands draw nothing.
    from ethbrake_marl.figures.evaluation import criticality_figure
    from ethbrake_marl.figures.style import write_picture

    chosen = load_driven(scenario, None, read_settings(settings).scenario)
    lineup = make_agents([agent], chosen, harm_count=harm_count)
    with interruptible("nothing was written"), progress_bars() as bars:
        found = criticality_map(
            chosen,
            lineup,
            cells=CELLS if cells is None else cells,
            gap_range_m=gaps,
            on_progress=lambda name, done, total: bars.show(name, done, total),
        )
    write_picture(target, criticality_figure(found), force=force)
    say(f"picture: {target}")


@picture_app.command(
    "deceleration",
    epilog="Example: ethbrake picture deceleration --scenario paper-scenario-1 --world 0 --output curve.png",
)
def picture_deceleration(
    output: PictureOption,
    scenario: ScenarioOption = "paper-scenario-1",
    world: Annotated[int, typer.Option(help="Number of the world in the list.", min=0)] = 0,
    seed: Annotated[int, typer.Option(help="Seed of the list.")] = LIST_SEED,
    vehicle: VehicleOption = None,
    settings: SetOption = None,
    force: ForceOption = False,
) -> None:
    """Harm of one world against the constant deceleration of one vehicle: predicted, realised, and the best known."""
    target = picture_target(output, force=force)
    from ethbrake_marl.figures.evaluation import deceleration_figure
    from ethbrake_marl.figures.style import write_picture

    chosen = load_driven(scenario, vehicle, read_settings(settings).scenario)
    sample = chosen.sample(1, seed, first=world)
    curve = deceleration_curve(sample.worlds, Task(chosen, chosen.learners))
    figure = deceleration_figure(curve, title=f"{chosen.name}, world {world} of the list of seed {seed}")
    write_picture(target, figure, force=force)
    say(f"picture: {target}")


@picture_app.command(
    "shield", epilog="Example: ethbrake picture shield --agents ppo@shipped,full_brake --output shield.png"
)
def picture_shield(
    output: PictureOption,
    agents: Annotated[str, typer.Option(metavar="A,B,...", help="Who proposes.")] = "full_brake,constant:3",
    scenario: ScenarioOption = "paper-random",
    episodes: Annotated[int, typer.Option(help="Worlds of the list.", min=1)] = 500,
    harm_count: Annotated[HarmCount, typer.Option(help="Harm that is guaranteed.")] = "first",
    vehicle: VehicleOption = None,
    settings: SetOption = None,
    force: ForceOption = False,
) -> None:
    """How often the step shield intervenes against the harm that remains, from no allowance to any."""
    target = picture_target(output, force=force)
    from ethbrake_marl.figures.evaluation import operating_figure
    from ethbrake_marl.figures.style import write_picture
    from ethbrake_marl.shield.review import ALLOWANCES, operating_curves

    chosen = load_evaluated(scenario, vehicle, read_settings(settings).scenario)
    worlds = chosen.sample(episodes, LIST_SEED).worlds
    lineup = make_proposers(agents.split(","), chosen, harm_count=harm_count)
    with interruptible("nothing was written"), progress_bars() as bars:
        curves = operating_curves(
            worlds, lineup, Task(chosen, chosen.learners, harm_count), ALLOWANCES,
            on_progress=lambda name: bars.show(name, episodes, episodes),
        )  # fmt: skip
    caption = (
        f"{chosen.name}, {count_of(episodes, 'world')} of the list of seed {LIST_SEED}; step shield, {harm_count} harm."
        " Beside the points: what certificates may reach above the bound (m²/s²)."
    )
    left_out = next(iter(curves.values()))[0].left_out
    figure = operating_figure(list(curves.items()), caption=caption + counted_without(left_out))
    write_picture(target, figure, force=force)
    tell_left_out(left_out, episodes)
    say(f"picture: {target}")


@picture_app.command(
    "robustness", epilog="Example: ethbrake picture robustness --agent ppo@shipped --episodes 100 --output robust.png"
)
def picture_robustness(
    output: PictureOption,
    agent: Annotated[
        str, typer.Option(help="Who proposes; an agent of `ethbrake evaluate` without a shield.")
    ] = "full_brake",
    uncertainty: Annotated[
        str, typer.Option(metavar="QUANTITY=WIDTH,...", help="The intervals; drawn at 0 to 2 times their width.")
    ] = "braking_capacity_mps2=10%,gaps_m=0.5",
    robust: Annotated[
        str, typer.Option(help="What the robust shield certifies of the intervals: their corners, or their interior.")
    ] = "corners",
    scenario: ScenarioOption = "paper-random",
    episodes: Annotated[int, typer.Option(help="Worlds of the list.", min=1)] = 200,
    harm_count: Annotated[HarmCount, typer.Option(help="Harm that is guaranteed.")] = "first",
    vehicle: VehicleOption = None,
    settings: SetOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """What it costs not to know a world: the robust shield's price, and both shields where the truth differs.

    Prints the figures, too.
    """
    target, intervals = picture_target(output, force=force), parse_uncertainty(uncertainty)
    from ethbrake_marl.figures.evaluation import robustness_figure, robustness_table
    from ethbrake_marl.figures.style import write_picture
    from ethbrake_marl.shield.review import robustness

    chosen = load_driven(scenario, vehicle, read_settings(settings).scenario)
    sample = chosen.sample(episodes, LIST_SEED)
    (policy,) = make_proposers([agent], chosen, harm_count=harm_count).values()
    assert isinstance(policy, Agent)  # one vehicle learns
    with interruptible("nothing was written"), progress_bars() as bars:
        points = robustness(
            sample.worlds, policy, Task(chosen, chosen.learners, harm_count), intervals, robust=robust,
            on_progress=lambda what, done: bars.show(what, done, episodes),
        )  # fmt: skip
    caption = (
        f"{chosen.name}, {count_of(episodes, 'world')} of the list of seed {LIST_SEED}; {agent} proposes;"
        f" {harm_count} harm. Intervals of width 1: {intervals}."
        + (f" Robust mode certifies their {robust}." if robust != "corners" else "")
    )
    caption += counted_without(points[0].left_out)
    write_picture(target, robustness_figure(points, caption=caption), force=force)
    if as_json:
        about = result_identity("robustness", chosen, sample, [world for world, _ in points[0].left_out])
        write_json([about | point._asdict() for point in points])
    else:
        result_console().print(robustness_table(points))
    tell_left_out(points[0].left_out, episodes)
    say(f"picture: {target}")
