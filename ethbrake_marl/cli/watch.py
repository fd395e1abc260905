"""The commands ``watch ...``: films, episodes played again, the explorer, pictures, and what was seen as a dataset."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ethbrake_marl.cli.command import command, new_group
from ethbrake_marl.cli.evaluate import (
    PROPOSERS,
    asked_task,
    make_drivers,
    measure_modes,
    tell_left_out,
)
from ethbrake_marl.cli.out import PAGES, Out
from ethbrake_marl.defaults import LIST_SEED, DatasetFormat, HarmCount
from ethbrake_marl.errors import count_of

if TYPE_CHECKING:
    from ethbrake_marl.evaluation.passport import Replay
    from ethbrake_marl.physics import LeftOutRows
    from ethbrake_marl.scenario import Scenario

watch_group = new_group(
    "watch",
    "See and keep episodes: films, replays, the explorer, pictures, datasets.",
    "watch record --agents full_brake,e_v2x_bm --world 3 --output both.gif",
    "watch explore --agents full_brake,ppo@shipped",
)


@command(watch_group, "record", "watch record --agents full_brake,e_v2x_bm --world 3 --output both.gif", force=True)
def record_command(
    out: Out,
    output: Annotated[Path, typer.Option(metavar="FILE.gif|FILE.mp4|FILE.svg", help="The film to write.")],
    agents: str = "e_v2x_bm",
    scenario: str = "paper-random",
    world: int = 0,
    seed: int = LIST_SEED,
    vehicle: str | None = None,
    uncertainty: str | None = None,
) -> None:
    """Agents in one world of the list, in real time: the road to scale, commands, impacts, harm."""
    from ethbrake_marl.evaluation.episodes import check_ending, check_number_of_films, film_bytes, film_scenes

    check_ending(output.suffix.lower())
    out.check(output)
    check_number_of_films(len(agents.split(",")))
    chosen = asked_task(scenario, vehicle, None).scenario
    lineup = make_drivers(agents, chosen, uncertainty=uncertainty)
    worlds = chosen.sample(1, seed, first=world).worlds
    films = {
        f"{name}: world {world} of {chosen.name}": film_scenes(worlds, agent, scenario=chosen)
        for name, agent in lineup.items()
    }
    out.write(output, film_bytes(films, output.suffix.lower()), what="film")


@command(watch_group, "replay", "watch replay PASSPORT --output again.html", json=True, force=True)
def replay_command(
    out: Out,
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
    uncertainty: str | None = None,
    settings: list[str] | None = None,
    output: Annotated[
        Path | None,
        typer.Option(metavar="FILE.html|FILE.gif|FILE.mp4|FILE.svg", help="Also write it as a page or a film."),
    ] = None,
) -> None:
    """Play an episode again, bit for bit, or say what differs.

    Exit status 1 where the world or the episode is another one than the passport's.
    """
    from ethbrake_marl.evaluation.episodes import check_ending
    from ethbrake_marl.evaluation.passport import Given, parse_passport, replay
    from ethbrake_marl.learning.recipe import read_settings
    from ethbrake_marl.shield.uncertainty import parse_uncertainty

    named = parse_passport(passport)
    if output is not None and output.suffix.lower() not in PAGES:
        check_ending(output.suffix.lower())
    out.check(output)
    intervals = None if uncertainty is None else parse_uncertainty(uncertainty)
    found = replay(named, Given(scenario, read_settings(settings).scenario, agent, initial_states, intervals))
    first, total = found.motion.harm
    impacts = int(found.motion.ledger.impacts[0])
    lines = [
        f"{found.title}: {count_of(impacts, 'impact')}, harm {first:.2f} first-impact, {total:.2f} total (m²/s²).",
        "The same episode, bit for bit." if found.same else "Not the same episode.",
        *(f"Differs: {each}." for each in found.differences),
    ]
    if output is not None:
        out.write(output, _picture_of(found, lines, output.suffix.lower()))
    told = {
        "same": found.same,
        "differences": list(found.differences),
        "passport": str(found.passport),
        "impacts": impacts,
        "first_impact_harm": first,
        "total_harm": total,
    }
    out.result(told, *lines)
    if output is not None:
        out.note(f"written: {output}")
    if not found.same:
        raise typer.Exit(1)


def _picture_of(found: Replay, lines: list[str], ending: str) -> bytes:
    """The episode as a page, or as a film."""
    if ending not in PAGES:
        from ethbrake_marl.evaluation.episodes import film_bytes, film_scenes

        return film_bytes({found.title: film_scenes(found.worlds, found.agent, scenario=found.scenario)}, ending)
    from ethbrake_marl.pages.frame import Section, page
    from ethbrake_marl.pages.player import Played, player

    name, passport = found.passport.agent, str(found.passport)
    one = Played(found.passport.number, "Replayed", "", {name: found.motion}, {name: passport})
    section = Section("Episode", [player([one], found.scenario.learners)])
    return page(found.title, [section], lead=" ".join(lines)).encode()


@command(watch_group, "explore", "watch explore --agents full_brake,ppo@shipped", needs=("starlette", "uvicorn"))
def explore_command(
    out: Out,
    scenario: str = "paper-random",
    agents: str = "full_brake,copy_leader,e_v2x_bm,ppo@shipped,ppo@shipped+step",
    vehicle: str | None = None,
    settings: list[str] | None = None,
    world: int = 0,
    seed: int = LIST_SEED,
    harm_count: HarmCount = "first",
    folder: Annotated[Path, typer.Option(metavar="DIR", help="Where states are saved, and nowhere else.")] = Path(),
    port: Annotated[int, typer.Option(help="On 127.0.0.1; 0 takes a free one.", min=0, max=65535)] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Print the address, open nothing.")] = False,
) -> None:
    """Open a local page: sliders for one emergency, every agent's harm and motion at once.

    It listens on this machine alone, and its address holds a token that is new each time. Ctrl-C ends it.
    """
    from ethbrake_marl.pages.explorer.answer import Explored
    from ethbrake_marl.pages.explorer.server import Setting, serve_explorer

    chosen = asked_task(scenario, vehicle, settings, alone=True).scenario
    explored = Explored(chosen, make_drivers(agents, chosen, harm_count), harm_count)

    def ready(address: str) -> None:
        out.show(address)
        out.note(f"explore {chosen.name} there; files go to {folder.resolve()}; Ctrl-C ends it")
        if not no_browser:
            webbrowser.open(address)

    serve_explorer(Setting(explored, folder.resolve(), seed, world), port, ready)
    out.note("ended")


@command(watch_group, "dataset", "watch dataset --agents best_harm --episodes 1000 --output best.parquet", force=True)
def dataset_command(
    out: Out,
    output: Annotated[Path, typer.Option(metavar="FILE.parquet|NAME-v0", help="The dataset to write.")],
    agents: str = "best_harm",
    scenario: str = "paper-random",
    episodes: int = 1_000,
    seed: int = LIST_SEED,
    format: Annotated[
        DatasetFormat | None, typer.Option(help="Of the dataset.", show_default="as the name of --output says")
    ] = None,
    vehicle: str | None = None,
    harm_count: HarmCount = "first",
    uncertainty: str | None = None,
    settings: list[str] | None = None,
) -> None:
    """Record what agents see, do and are rewarded with, decision by decision.

    As one Parquet file of any agents and learners, or as a dataset of Minari of one learner. The recorded actions
    replay to the same bits. The reward counts the harm of --harm-count, too.
    """
    from ethbrake_marl.evaluation.dataset import check_dataset, write_dataset
    from ethbrake_marl.evaluation.inputs import check_agents

    chosen = asked_task(scenario, vehicle, settings, harm_count).scenario
    kind = check_dataset(output, chosen, format, force=out.force)
    lineup = make_drivers(agents, chosen, harm_count, uncertainty)
    check_agents(lineup, chosen.sample(1, seed).worlds, chosen)
    summary = write_dataset(
        output,
        lineup,
        scenario=chosen,
        episodes=episodes,
        seed=seed,
        format=kind,
        reward="harm" if harm_count == "first" else "total-harm",
        force=out.force,
        on_progress=lambda agent, done: out.progress(agent, done, episodes),
    )
    for agent, number in summary.episodes.items():
        change = f"harm differs from `ethbrake evaluate` by at most {summary.off_by[agent]:.2g} m2/s2 in a world"
        out.note(f"{agent}: {count_of(number, 'episode')}; {change}")
    for left in summary.left_out:
        out.note(f"left out: world {left.world} with {left.agent}: {left.reason}")
    out.note(f"dataset: {summary.path}, {count_of(summary.decisions, 'decision')}")
    if summary.format == "minari":
        folder = summary.path.resolve().parent
        out.note(f"load it: MINARI_DATASETS_PATH={folder}, minari.load_dataset({summary.path.name!r})")


picture_group = new_group(
    "picture",
    "Draw what is critical in a scenario, what one world asks for, or what the shield does.",
    "watch picture criticality --output map.png",
    "watch picture shield-modes --episodes 500 --output modes.png",
    inside=watch_group,
)
PictureOption = Annotated[Path, typer.Option(metavar="FILE", help="The picture to write: .png, .svg or .pdf.")]


@command(
    picture_group, "criticality",
    "watch picture criticality --scenario paper-distance --agent e_v2x_bm --output map.png", force=True,
)  # fmt: skip
def picture_criticality(
    out: Out,
    output: PictureOption,
    scenario: str = "paper-distance",
    agent: Annotated[str, typer.Option(help="Who drives; any agent of `ethbrake evaluate`.")] = "e_v2x_bm",
    harm_count: HarmCount = "first",
    cells: Annotated[int, typer.Option(help="Worlds along each gap.")] = 81,
    gaps: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="LOW HIGH", help="Range of both gaps (m).", show_default="the scenario's"),
    ] = None,
    settings: list[str] | None = None,
) -> None:
    """Harm of an agent over both gaps, with the boundary of what is avoidable.

    Everything else must be a fixed number in the scenario.
    """
    from ethbrake_marl.evaluation.curves import criticality_map
    from ethbrake_marl.evaluation.inputs import make_agents

    _check_picture(out, output)
    chosen = asked_task(scenario, None, settings, alone=True).scenario
    lineup = make_agents([agent], chosen, harm_count=harm_count)
    found = criticality_map(chosen, lineup, cells=cells, gap_range_m=gaps, on_progress=out.progress)
    from ethbrake_marl.figures.evaluation import criticality_figure  # matplotlib takes a second to load

    _write_picture(out, output, criticality_figure(found))


def _check_picture(out: Out, output: Path) -> None:
    """Refuse a picture that cannot be written, before any work."""
    from ethbrake_marl.figures import picture_ending

    picture_ending(output)
    out.check(output)


def _write_picture(out: Out, output: Path, figure: Any, left_out: LeftOutRows = (), whole: int = 0) -> None:
    """Write a picture; ``left_out`` of ``whole`` worlds count in none of its figures."""
    from ethbrake_marl.figures.style import write_picture

    write_picture(output, figure, force=out.force)
    tell_left_out(left_out, whole)
    out.note(f"picture: {output}")


def _caption(scenario: Scenario, episodes: int, rest: str, left_out: LeftOutRows) -> str:
    """What a picture of a list is about, and how many of its worlds count in no figure."""
    told = f"{scenario.name}, {count_of(episodes, 'world')} of the list of seed {LIST_SEED}{rest}"
    return told + (f" Left out: {len(left_out):,}, which the physics could not advance." if left_out else "")


@command(
    picture_group, "deceleration",
    "watch picture deceleration --scenario paper-scenario-1 --world 0 --output curve.png", force=True,
)  # fmt: skip
def picture_deceleration(
    out: Out,
    output: PictureOption,
    scenario: str = "paper-scenario-1",
    world: int = 0,
    seed: int = LIST_SEED,
    vehicle: str | None = None,
    settings: list[str] | None = None,
) -> None:
    """Harm of one world against the constant deceleration of one vehicle: predicted, realised, and the best known."""
    from ethbrake_marl.evaluation.curves import deceleration_curve
    from ethbrake_marl.figures.evaluation import deceleration_figure

    _check_picture(out, output)
    task = asked_task(scenario, vehicle, settings, alone=True)
    curve = deceleration_curve(task.scenario.sample(1, seed, first=world).worlds, task)
    title = f"{task.scenario.name}, world {world} of the list of seed {seed}"
    _write_picture(out, output, deceleration_figure(curve, title=title))


@command(
    picture_group, "shield", "watch picture shield --agents ppo@shipped,full_brake --output shield.png", force=True
)
def picture_shield(
    out: Out,
    output: PictureOption,
    agents: str = "full_brake,constant:3",
    scenario: str = "paper-random",
    episodes: int = 500,
    harm_count: HarmCount = "first",
    vehicle: str | None = None,
    settings: list[str] | None = None,
) -> None:
    """How often the step shield intervenes against the harm that remains, from no allowance to any.

    The agents propose, and --harm-count is the harm that is guaranteed.
    """
    from ethbrake_marl.evaluation.inputs import make_proposers
    from ethbrake_marl.figures.evaluation import operating_figure
    from ethbrake_marl.shield.review import ALLOWANCES, operating_curves

    _check_picture(out, output)
    task = asked_task(scenario, vehicle, settings, harm_count)
    worlds = task.scenario.sample(episodes, LIST_SEED).worlds
    lineup = make_proposers(agents.split(","), task.scenario, harm_count=harm_count)
    curves = operating_curves(
        worlds, lineup, task, ALLOWANCES,
        on_progress=lambda name: out.progress(name, episodes, episodes),
    )  # fmt: skip
    left_out = next(iter(curves.values()))[0].left_out
    rest = f"; step shield, {harm_count} harm. Beside the points: what certificates may reach above the bound (m²/s²)."
    figure = operating_figure(list(curves.items()), caption=_caption(task.scenario, episodes, rest, left_out))
    _write_picture(out, output, figure, left_out, episodes)


@command(picture_group, "shield-modes", "watch picture shield-modes --episodes 500 --output modes.png", force=True)
def picture_shield_modes(
    out: Out,
    output: PictureOption,
    agents: str = PROPOSERS,
    scenario: str = "paper-random",
    episodes: int = 2_000,
    harm_count: HarmCount = "first",
    vehicle: str | None = None,
    settings: list[str] | None = None,
) -> None:
    """Harm without a shield and in step mode beside episode mode, as ``ethbrake shield`` measures it."""
    from ethbrake_marl.figures.evaluation import shield_modes_figure

    _check_picture(out, output)
    task = asked_task(scenario, vehicle, settings, harm_count)
    rows = measure_modes(out, agents, task.scenario.sample(episodes, LIST_SEED), task)
    rest = f", {harm_count} harm; mean and 95 % interval of the difference, paired by world."
    figure = shield_modes_figure(rows, caption=_caption(task.scenario, episodes, rest, rows[0].left_out))
    _write_picture(out, output, figure, rows[0].left_out, episodes)


@command(
    picture_group, "robustness",
    "watch picture robustness --agent ppo@shipped --episodes 100 --output robust.png", json=True, force=True,
)  # fmt: skip
def picture_robustness(
    out: Out,
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
    scenario: str = "paper-random",
    episodes: int = 200,
    harm_count: HarmCount = "first",
    vehicle: str | None = None,
    settings: list[str] | None = None,
) -> None:
    """What it costs not to know a world: the robust shield's price, and both shields where the truth differs.

    Prints the figures, too.
    """
    from ethbrake_marl.agents.protocol import Agent
    from ethbrake_marl.evaluation.inputs import make_proposers, result_identity
    from ethbrake_marl.figures.evaluation import robustness_figure, robustness_table
    from ethbrake_marl.shield.review import robustness
    from ethbrake_marl.shield.uncertainty import parse_uncertainty

    _check_picture(out, output)
    intervals = parse_uncertainty(uncertainty)
    task = asked_task(scenario, vehicle, settings, harm_count, alone=True)
    sample = task.scenario.sample(episodes, LIST_SEED)
    (policy,) = make_proposers([agent], task.scenario, harm_count=harm_count).values()
    assert isinstance(policy, Agent)  # one vehicle learns
    points = robustness(
        sample.worlds, policy, task, intervals, robust=robust,
        on_progress=lambda what, done: out.progress(what, done, episodes),
    )  # fmt: skip
    left_out = points[0].left_out
    rest = f"; {agent} proposes; {harm_count} harm. Intervals of width 1: {intervals}." + (
        f" Robust mode certifies their {robust}." if robust != "corners" else ""
    )
    caption = _caption(task.scenario, episodes, rest, left_out)
    about = result_identity("robustness", task.scenario, sample, [world for world, _ in left_out])
    _write_picture(out, output, robustness_figure(points, caption=caption), left_out, episodes)
    out.result([about | point._asdict() for point in points], robustness_table(points))
