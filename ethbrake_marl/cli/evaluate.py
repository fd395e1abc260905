"""The command ``ethbrake evaluate``: parse, let the agents drive, print."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import typer

from ethbrake_marl.cli.options import (
    ForceOption,
    JsonOption,
    ScenarioOption,
    SetOption,
    UncertaintyOption,
    VehicleOption,
)
from ethbrake_marl.cli.picture import PictureOption, counted_without, picture_app, picture_target, tell_left_out
from ethbrake_marl.cli.report import ReportOption, check_page, write_evaluation_report
from ethbrake_marl.cli.shards import (
    JobsOption,
    KeptOption,
    RayOption,
    RowsOption,
    ShardsOption,
    check_shards,
    evaluate_in_shards,
)
from ethbrake_marl.cli.terminal import interruptible, progress_bars, result_console, say, write_json
from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.evaluation import (
    SummaryRow,
    check_target,
    declared_objectives,
    evaluate,
    horizon_note,
    rescore,
    rescored_table,
    rich_table,
    summarise,
)
from ethbrake_marl.evaluation.frame import check_per_world, write_per_world
from ethbrake_marl.evaluation.groups import check_group, summarise_by
from ethbrake_marl.evaluation.inputs import (
    EPISODES,
    LIST_SEED,
    OLD_SHIELDS,
    PROGRESS_EVERY,
    check_agents,
    choose_worlds,
    load_evaluated,
    make_lineup,
    make_proposers,
)
from ethbrake_marl.evaluation.paper import TESTS
from ethbrake_marl.evaluation.per_world import write_output
from ethbrake_marl.evaluation.results_file import results_to_json
from ethbrake_marl.evaluation.shield_modes import NONE, ModeRow, compare_modes, modes_tables, modes_to_json
from ethbrake_marl.evaluation.text import metrics_table
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.learning.settings import read_settings
from ethbrake_marl.scenario import Sample, Task
from ethbrake_marl.scenario.sample import kind_columns
from ethbrake_marl.shield.uncertainty import parse_uncertainty

Groups = Mapping[str, Sequence[SummaryRow]]


def evaluate_command(
    scenario: ScenarioOption = "paper-random",
    agents: Annotated[
        str, typer.Option(metavar="A,B,...", help="Who drives, with commas between them.")
    ] = "full_brake,e_v2x_bm,e_v2x_bm:pairwise",
    episodes: Annotated[int | None, typer.Option(help="Worlds of the list.", show_default=str(EPISODES))] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the list.", show_default=str(LIST_SEED))] = None,
    harm_count: Annotated[
        HarmCount, typer.Option(help="Harm that agents minimise: first impacts only, or all.")
    ] = "first",
    shield: Annotated[
        str,
        typer.Option(metavar="|".join(OLD_SHIELDS), help="Old: now +SHIELD behind an agent, such as ppo@shipped+step."),
    ] = "none",
    uncertainty: UncertaintyOption = None,
    initial_states: Annotated[
        Path | None, typer.Option(metavar="CSV|YAML", help="Your own worlds: one per row, or named ones of falsify.")
    ] = None,
    vehicle: VehicleOption = None,
    settings: SetOption = None,
    per_world: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also write one row per world and agent (.csv, .parquet), and FILE.json."),
    ] = None,
    report: ReportOption = None,
    objective: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Also tell the results under this objective; standard: under all usual ones. Repeatable.",
        ),
    ] = None,
    by: Annotated[
        str | None,
        typer.Option(metavar="COLUMN", help="Also tell the results by group: scenario (a mixture), vehicle_2_type."),
    ] = None,
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
    if shards is not None:
        evaluate_in_shards(
            chosen,
            agents.split(","),
            shards=shards,
            jobs=jobs,
            ray=ray,
            output=output,
            rows=rows,
            episodes=EPISODES if episodes is None else episodes,
            seed=LIST_SEED if seed is None else seed,
            harm_count=harm_count,
            shield=shield,
            uncertainty=uncertainty,
            objectives=objectives,
            as_json=as_json,
        )
        return
    sample, list_seed = choose_worlds(chosen, initial_states=initial_states, episodes=episodes, seed=seed)
    if by is not None:
        check_group(kind_columns(sample.types, sample.scenarios), by)
    intervals = None if uncertainty is None else parse_uncertainty(uncertainty)
    lineup = make_lineup(agents.split(","), chosen, harm_count=harm_count, shield=shield, uncertainty=intervals)
    check_agents(lineup, sample.worlds, chosen)
    with interruptible("nothing was written"), progress_bars() as bars:
        evaluation = evaluate(
            sample,
            lineup,
            scenario=chosen,
            seed=list_seed,
            chunk=PROGRESS_EVERY,
            on_progress=lambda agent, done: bars.show(agent, done, sample.worlds.n),
        )
        summary = summarise(evaluation)
        if report is not None:
            write_evaluation_report(report, evaluation, summary, lineup, bars, harm_count=harm_count, force=force)
    told = rescore(evaluation, objectives)
    groups = {} if by is None else summarise_by(evaluation, by)
    if per_world is not None:
        write_per_world(per_world, evaluation, objectives=objectives, force=force)
    agents_told = {"harm_count": harm_count, "uncertainty": uncertainty}
    results = results_to_json(summary, told=told, groups=groups, per_world=per_world, settings=agents_told)
    if per_world is not None:
        _write_results_beside(per_world, results, force=force)
    if as_json:
        write_json(results)
    else:
        show_rows(summary)
        show_groups(groups)
    moving = {row.agent: row.horizon_ends for row in summary if row.policy_share is not None}
    if note := horizon_note(moving, sample.worlds.n, chosen.horizon_s):
        say(note)
    if told and not as_json:
        result_console().print(rescored_table(told, harm_count))


def _check_outputs(per_world: Path | None, report: Path | None, *, force: bool) -> None:
    """Refuse outputs that cannot be written, or that would replace one another, before any work."""
    if report is not None:
        check_page(report, force=force)
    if per_world is None:
        return
    check_per_world(per_world)
    for file in (per_world, _results_beside(per_world)):
        check_target(file, force=force)
        if report is not None and file.resolve() == report.resolve():
            raise InvalidInput(f"{file}: is the report, too (--report, --per-world); give another name")


def _results_beside(per_world: Path) -> Path:
    """The results file that stands beside a file with one row per world."""
    return per_world.with_name(f"{per_world.name}.json")


def _write_results_beside(per_world: Path, results: object, *, force: bool) -> None:
    """Write the results file of the file with one row per world that has just been written."""
    content = json.dumps(results, indent=2, allow_nan=False) + "\n"
    write_output(_results_beside(per_world), content.encode(), force=force)
    say(f"every world: {per_world}; the results: {_results_beside(per_world)}")


def show_rows(rows: Sequence[SummaryRow]) -> None:
    """The rows as a table."""
    result_console().print(rich_table(rows))
    if rows and rows[0].metrics:
        result_console().print(metrics_table(rows))


def show_groups(groups: Groups) -> None:
    """The rows of each group of worlds, below its name."""
    for name, rows in groups.items():
        result_console().print(f"\n{name}: {count_of(rows[0].episodes, 'world')}\n", highlight=False, markup=False)
        result_console().print(rich_table(rows))


def show_beside(beside: Mapping[str, Sequence[SummaryRow]]) -> None:
    """The rows of the other tests, each below what its test asks."""
    for test, rows in beside.items():
        result_console().print(f"\n{TESTS[test]}\n", highlight=False, markup=False)
        result_console().print(rich_table(rows))


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
    from ethbrake_marl.figures.shield import shield_modes_figure
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
