"""The command ``ethbrake evaluate``: parse, let the agents drive, print."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ethbrake_marl.cli.late import LATE
from ethbrake_marl.cli.options import (
    AgentsOption,
    ForceOption,
    GroupOption,
    HarmCountOption,
    JsonOption,
    ListEpisodesOption,
    ListSeedOption,
    ObjectiveOption,
    PerWorldOption,
    ScenarioOption,
    SetOption,
    StatesOption,
    UncertaintyOption,
    VehicleOption,
)
from ethbrake_marl.cli.picture import PictureOption, picture_app
from ethbrake_marl.cli.terminal import interruptible, progress_bars, result_console, say, write_json
from ethbrake_marl.defaults import EPISODES, LIST_SEED, HarmCount
from ethbrake_marl.errors import InvalidInput, count_of

if TYPE_CHECKING or LATE:
    from ethbrake_marl.agents.protocol import Driver
    from ethbrake_marl.cli.report import check_page, write_evaluation_report
    from ethbrake_marl.cli.results import counted_without, picture_target, results_beside, tell_left_out, tell_results
    from ethbrake_marl.cli.shards import check_shards, evaluate_in_shards
    from ethbrake_marl.evaluation import (
        Evaluation,
        SummaryRow,
        check_target,
        declared_objectives,
        evaluate,
        horizon_note,
        summarise,
    )
    from ethbrake_marl.evaluation.inputs import (
        PROGRESS_EVERY,
        check_agents,
        choose_worlds,
        load_evaluated,
        make_lineup,
        make_proposers,
    )
    from ethbrake_marl.evaluation.results import check_per_world
    from ethbrake_marl.evaluation.shield_modes import NONE, ModeRow, compare_modes, modes_tables, modes_to_json
    from ethbrake_marl.evaluation.summary import check_group, summarise_by
    from ethbrake_marl.learning.recipe import read_settings
    from ethbrake_marl.scenario import Sample, Scenario, Task
    from ethbrake_marl.scenario.fields import kind_columns
    from ethbrake_marl.shield.uncertainty import parse_uncertainty

ReportOption = Annotated[
    Path | None,
    typer.Option("--report", metavar="FILE.html", help="Also write a page with tables, figures and episodes to watch."),
]
ShardsOption = Annotated[
    int | None, typer.Option(metavar="K", help="Evaluate the list in K parts, in flat memory; changes no figure.")
]
JobsOption = Annotated[int, typer.Option(metavar="N", help="With --shards: processes; changes no figure.")]
RayOption = Annotated[
    str | None,
    typer.Option(
        "--ray", metavar="local|ADDRESS", help="With --shards: on Ray, on all its cores or on --jobs of them."
    ),
]
KeptOption = Annotated[
    Path | None,
    typer.Option("--output", metavar="FOLDER", help="With --shards: keeps finished ones; the same command goes on."),
]
RowsOption = Annotated[
    bool, typer.Option("--rows", help="With --output: also one row per world and agent, as Parquet files in it.")
]


def evaluate_command(
    scenario: ScenarioOption = "paper-random",
    agents: AgentsOption = "full_brake,e_v2x_bm,e_v2x_bm:pairwise",
    episodes: ListEpisodesOption = None,
    seed: ListSeedOption = None,
    harm_count: HarmCountOption = "first",
    uncertainty: UncertaintyOption = None,
    initial_states: StatesOption = None,
    vehicle: VehicleOption = None,
    settings: SetOption = None,
    per_world: PerWorldOption = None,
    report: ReportOption = None,
    objective: ObjectiveOption = None,
    by: GroupOption = None,
    shards: ShardsOption = None,
    jobs: JobsOption = 1,
    ray: RayOption = None,
    output: KeptOption = None,
    rows: RowsOption = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compare agents on the same fixed list of worlds.

    `ethbrake agents` lists who can drive; ladder stands for all of them from coast to best_harm. Behind any agent:
    +refined, then one shield, +episode, +step or +robust; for instance full_brake+step or ppo@PATH+refined+episode.
    PATH is a run or a policy bundle, or shipped.
    """
    whole = {"--per-world": per_world, "--report": report, "--initial-states": initial_states, "--by": by}
    check_shards(shards, jobs, ray, output, rows, whole)
    _check_outputs(per_world, report, force=force)
    chosen = load_evaluated(scenario, vehicle, read_settings(settings).scenario)
    objectives = declared_objectives(objective or (), chosen.vehicles)
    names = agents.split(",")
    if shards is not None:
        evaluate_in_shards(
            chosen, names, shards=shards, jobs=jobs, ray=ray, output=output, rows=rows,
            episodes=EPISODES if episodes is None else episodes, seed=LIST_SEED if seed is None else seed,
            harm_count=harm_count, uncertainty=uncertainty, objectives=objectives, as_json=as_json,
        )  # fmt: skip
        return
    sample, list_seed = choose_worlds(chosen, initial_states=initial_states, episodes=episodes, seed=seed)
    if by is not None:
        check_group(kind_columns(sample.types, sample.scenarios), by)
    intervals = None if uncertainty is None else parse_uncertainty(uncertainty)
    lineup = make_lineup(names, chosen, harm_count=harm_count, uncertainty=intervals)
    check_agents(lineup, sample.worlds, chosen)
    evaluation, summary = _drive(sample, list_seed, lineup, chosen, report, harm_count=harm_count, force=force)
    groups = {} if by is None else summarise_by(evaluation, by)
    tell_results(
        evaluation, summary, groups, objectives, per_world,
        harm_count=harm_count, uncertainty=uncertainty, force=force, as_json=as_json,
    )  # fmt: skip


def _drive(
    sample: Sample,
    seed: int | None,
    lineup: Mapping[str, Driver],
    scenario: Scenario,
    report: Path | None,
    *,
    harm_count: HarmCount,
    force: bool,
) -> tuple[Evaluation, Sequence[SummaryRow]]:
    """Let all drive the sample, with progress on stderr; where a report is asked for, write it."""
    with interruptible("nothing was written"), progress_bars() as bars:
        evaluation = evaluate(
            sample,
            lineup,
            scenario=scenario,
            seed=seed,
            chunk=PROGRESS_EVERY,
            on_progress=lambda agent, done: bars.show(agent, done, sample.worlds.n),
        )
        summary = summarise(evaluation)
        if report is not None:
            write_evaluation_report(report, evaluation, summary, lineup, bars, harm_count=harm_count, force=force)
    return evaluation, summary


def _check_outputs(per_world: Path | None, report: Path | None, *, force: bool) -> None:
    """Refuse outputs that cannot be written, or that would replace one another, before any work."""
    if report is not None:
        check_page(report, force=force)
    if per_world is None:
        return
    check_per_world(per_world)
    for file in (per_world, results_beside(per_world)):
        check_target(file, force=force)
        if report is not None and file.resolve() == report.resolve():
            raise InvalidInput(f"{file}: is the report, too (--report, --per-world); give another name")


SHIELD_EPISODES = 2_000

ProposersOption = Annotated[
    str,
    typer.Option("--agents", metavar="A,B,...", help="Who proposes; agents of `ethbrake evaluate` without a shield."),
]
EpisodesOption = Annotated[int, typer.Option("--episodes", help="Worlds of the list.", min=1)]
CountOption = Annotated[HarmCount, typer.Option(help="Harm that is guaranteed.")]


def shield_command(
    agents: ProposersOption = "ppo@shipped,full_brake,constant:3",
    scenario: ScenarioOption = "paper-random",
    episodes: EpisodesOption = SHIELD_EPISODES,
    harm_count: CountOption = "first",
    vehicle: VehicleOption = None,
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compare no shield, episode mode and step mode on the same worlds.

    Where several vehicles learn: no shield, step mode, and step mode with caps, for the whole team. Each decision that
    step mode replaced is simulated again without it: needed (harm would have been higher), harmless (the same), costly
    (lower).
    """
    chosen = load_evaluated(scenario, vehicle, read_settings(settings).scenario)
    sample, task = chosen.sample(episodes, LIST_SEED), Task(chosen, chosen.learners, harm_count)
    rows = measure_modes(agents, sample, task)
    if as_json:
        write_json(modes_to_json(rows, sample, task))
    else:
        for table in modes_tables(rows):
            result_console().print(table)
    tell_left_out(rows[0].left_out, episodes)
    moving = {f"{row.agent} ({row.mode})": row.horizon_ends for row in rows if row.mode != NONE}
    if note := horizon_note(moving, episodes - len(rows[0].left_out), chosen.horizon_s):
        say(note)


@picture_app.command("shield-modes", epilog="Example: ethbrake picture shield-modes --episodes 500 --output modes.png")
def picture_shield_modes(
    output: PictureOption,
    agents: ProposersOption = "ppo@shipped,full_brake,constant:3",
    scenario: ScenarioOption = "paper-random",
    episodes: EpisodesOption = SHIELD_EPISODES,
    harm_count: CountOption = "first",
    vehicle: VehicleOption = None,
    settings: SetOption = None,
    force: ForceOption = False,
) -> None:
    """Harm without a shield and in step mode beside episode mode, as ``ethbrake shield`` measures it."""
    target = picture_target(output, force=force)
    # Here: matplotlib takes a second to load, and most commands draw nothing.
    from ethbrake_marl.figures.evaluation import shield_modes_figure
    from ethbrake_marl.figures.style import write_picture

    chosen = load_evaluated(scenario, vehicle, read_settings(settings).scenario)
    rows = measure_modes(agents, chosen.sample(episodes, LIST_SEED), Task(chosen, chosen.learners, harm_count))
    caption = (
        f"{chosen.name}, {count_of(episodes, 'world')} of the list of seed {LIST_SEED}, {harm_count} harm; mean and 95"
        " % interval of the difference, paired by world."
    )
    caption += counted_without(rows[0].left_out)
    write_picture(target, shield_modes_figure(rows, caption=caption), force=force)
    tell_left_out(rows[0].left_out, episodes)
    say(f"picture: {target}")


def measure_modes(agents: str, sample: Sample, task: Task) -> list[ModeRow]:
    """The rows of these agents, with progress on stderr."""
    lineup = make_proposers(agents.split(","), task.scenario, harm_count=task.harm_count)
    with interruptible("nothing was written"), progress_bars() as bars:
        return compare_modes(
            lineup,
            sample.worlds,
            task,
            on_progress=lambda name, done: bars.show(name, done, sample.worlds.n),
        )
