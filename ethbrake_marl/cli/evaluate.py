"""The commands that measure: ``evaluate``, in one piece or in parts, ``compare`` and ``shield``."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text

from ethbrake_marl.cli.command import app, command
from ethbrake_marl.cli.out import PAGES, Out, plain_table, say
from ethbrake_marl.defaults import EPISODES, LIST_SEED, HarmCount
from ethbrake_marl.errors import InvalidInput, check_whole_number, count_of, need

if TYPE_CHECKING:
    from ethbrake_marl.agents.protocol import Driver
    from ethbrake_marl.evaluation import Evaluation, SummaryRow
    from ethbrake_marl.evaluation.results import Comparison
    from ethbrake_marl.evaluation.shards import Question
    from ethbrake_marl.evaluation.shield_modes import ModeRow
    from ethbrake_marl.physics import LeftOutRows
    from ethbrake_marl.scenario import Sample, Scenario, Task
    from ethbrake_marl.studies.jobs import Workers

PROPOSERS = "ppo@shipped,full_brake,constant:3"
_INTERVALS = (
    "Intervals: rates exact (Clopper-Pearson), means by Student's t; all from exact sums, the same bits in any"
    " number of shards."
)
_HARMS = {"first_impact_harm": "First-impact harm", "total_harm": "Total harm", "harm": "Harm"}
_POLICIES = {"same": "the same", "other": "another", "none": ""}


def asked_task(
    scenario: str,
    vehicle: str | None,
    settings: Sequence[str] | None,
    harm_count: HarmCount = "first",
    *,
    alone: bool = False,
) -> Task:
    """The scenario that is named, with its settings and with who is driven; ``alone``: that is one vehicle."""
    from ethbrake_marl.evaluation.inputs import load_driven, load_evaluated
    from ethbrake_marl.learning.recipe import read_settings
    from ethbrake_marl.scenario import Task

    load = load_driven if alone else load_evaluated
    chosen = load(scenario, vehicle, read_settings(settings).scenario)
    return Task(chosen, chosen.learners, harm_count)


def make_drivers(
    agents: str, scenario: Scenario, harm_count: HarmCount = "first", uncertainty: str | None = None
) -> dict[str, Driver]:
    """Who is named on the command line, with commas between them."""
    from ethbrake_marl.evaluation.inputs import make_lineup
    from ethbrake_marl.shield.uncertainty import parse_uncertainty

    intervals = None if uncertainty is None else parse_uncertainty(uncertainty)
    return make_lineup(agents.split(","), scenario, harm_count=harm_count, uncertainty=intervals)


@command(
    app,
    "evaluate",
    "evaluate --agents full_brake,constant:3.5,e_v2x_bm --episodes 1000",
    json=True,
    force=True,
    parts=True,
)
def evaluate_command(
    out: Out,
    scenario: str = "paper-random",
    agents: str = "full_brake,e_v2x_bm,e_v2x_bm:pairwise",
    episodes: Annotated[int | None, typer.Option(help="Worlds of the list.", show_default=str(EPISODES))] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the list.", show_default=str(LIST_SEED))] = None,
    harm_count: HarmCount = "first",
    uncertainty: str | None = None,
    initial_states: Annotated[
        Path | None, typer.Option(metavar="CSV|YAML", help="Your own worlds: one per row, or named ones of falsify.")
    ] = None,
    vehicle: str | None = None,
    settings: list[str] | None = None,
    per_world: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also write one row per world and agent (.csv, .parquet), and FILE.json."),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(metavar="FILE.html", help="Also write a page with tables, figures and episodes to watch."),
    ] = None,
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
    shards: Annotated[
        int | None, typer.Option(metavar="K", help="Evaluate the list in K parts, in flat memory; changes no figure.")
    ] = None,
    jobs: Annotated[int, typer.Option(metavar="N", help="With --shards: processes; changes no figure.")] = 1,
    ray: Annotated[
        str | None,
        typer.Option(metavar="local|ADDRESS", help="With --shards: on Ray, on all its cores or on --jobs of them."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="With --shards: keeps finished ones; the same command goes on."),
    ] = None,
    rows: Annotated[
        bool, typer.Option("--rows", help="With --output: also one row per world and agent, as Parquet files in it.")
    ] = False,
) -> None:
    """Compare agents on the same fixed list of worlds.

    `ethbrake agent list` says who can drive; ladder stands for all of them from coast to best_harm. Behind any agent:
    +refined, then one shield, +episode, +step or +robust; for instance full_brake+step or ppo@PATH+refined+episode.
    PATH is a run or a policy bundle, or shipped.
    """
    from ethbrake_marl.evaluation import declared_objectives, evaluate, summarise
    from ethbrake_marl.evaluation.inputs import PROGRESS_EVERY, check_agents, choose_worlds
    from ethbrake_marl.evaluation.shards import Question
    from ethbrake_marl.evaluation.summary import check_group, summarise_by
    from ethbrake_marl.scenario.fields import kind_columns

    whole = {"--per-world": per_world, "--report": report, "--initial-states": initial_states, "--by": by}
    _check_shards(shards, jobs, ray, output, rows, whole)
    _check_outputs(out, per_world, report)
    chosen = asked_task(scenario, vehicle, settings).scenario
    objectives = declared_objectives(objective or (), chosen.vehicles)
    if shards is not None:
        lineup = make_drivers(agents, chosen, harm_count, uncertainty)
        number, list_seed = EPISODES if episodes is None else episodes, LIST_SEED if seed is None else seed
        question = Question(chosen, tuple(lineup), number, list_seed, harm_count, uncertainty, tuple(objectives))
        check_agents(lineup, chosen.sample(1, list_seed).worlds, chosen)
        _evaluate_in_shards(out, question, shards, jobs, ray, output, rows)
        return
    sample, drawn_by = choose_worlds(chosen, initial_states=initial_states, episodes=episodes, seed=seed)
    if by is not None:
        check_group(kind_columns(sample.types, sample.scenarios), by)
    lineup = make_drivers(agents, chosen, harm_count, uncertainty)
    check_agents(lineup, sample.worlds, chosen)
    evaluation = evaluate(
        sample,
        lineup,
        scenario=chosen,
        seed=drawn_by,
        chunk=PROGRESS_EVERY,
        on_progress=lambda agent, done: out.progress(agent, done, sample.worlds.n),
    )
    summary = summarise(evaluation)
    if report is not None:
        _write_report(out, report, evaluation, summary, lineup, harm_count)
    groups = {} if by is None else summarise_by(evaluation, by)
    _tell_results(out, evaluation, summary, groups, objectives, per_world, harm_count, uncertainty)


def _check_shards(
    shards: int | None, jobs: int, ray: str | None, output: Path | None, rows: bool, whole: Mapping[str, object]
) -> None:
    """Refuse options that do not go together; those of ``whole`` need every world at once."""
    from ethbrake_marl.studies.shards import MOST_JOBS

    if shards is None:
        alone = {"--jobs": jobs != 1, "--ray": ray is not None, "--output": output is not None, "--rows": rows}
        if given := [name for name, is_given in alone.items() if is_given]:
            raise InvalidInput(f"{given[0]}: is for an evaluation in parts; add --shards 100")
        return
    if given := [name for name, value in whole.items() if value]:
        more = "; for one row per world give --output FOLDER --rows" if "--per-world" in given else ""
        raise InvalidInput(f"{given[0]}: needs every world at once, and --shards keeps none{more}")
    check_whole_number("shards", shards, 1)
    check_whole_number("jobs", jobs, 1, MOST_JOBS)
    if rows and output is None:
        raise InvalidInput("--rows: needs a folder for them: --output FOLDER")
    if rows:
        need("pyarrow")
    if ray is not None:
        need("ray")


def _check_outputs(out: Out, per_world: Path | None, report: Path | None) -> None:
    """Refuse outputs that cannot be written, or that would replace one another, before any work."""
    from ethbrake_marl.evaluation.results import check_per_world

    out.check(report, *PAGES, what="a report")
    if per_world is None:
        return
    check_per_world(per_world)
    for file in (per_world, _beside(per_world)):
        out.check(file)
        if report is not None and file.resolve() == report.resolve():
            raise InvalidInput(f"{file}: is the report, too (--report, --per-world); give another name")


def _beside(per_world: Path) -> Path:
    """The results file that stands beside a file with one row per world."""
    return per_world.with_name(f"{per_world.name}.json")


def _evaluate_in_shards(
    out: Out, question: Question, shards: int, jobs: int, ray: str | None, output: Path | None, rows: bool
) -> None:
    """Drive the list shard by shard, and print the table that is printed without shards."""
    from ethbrake_marl.evaluation import rescored_table
    from ethbrake_marl.evaluation.shards import ask, rescore_shards, shards_to_json, summarise_shards
    from ethbrake_marl.files.store import write_file
    from ethbrake_marl.studies.shards import evaluate_shards

    asked = ask(question)
    if output is not None:
        out.kept = "finished shards are kept: the same command goes on"
    with ExitStack() as stack:
        # on a Ray all cores where --jobs says nothing
        workers = None if ray is None else stack.enter_context(closing(workers_for(ray, None if jobs == 1 else jobs)))
        tally = evaluate_shards(
            asked,
            shards=shards,
            jobs=jobs,
            workers=workers,
            folder=output,
            with_rows=rows,
            tell=out.show_progress,
        )
    summary = summarise_shards(asked, tally)
    results = shards_to_json(asked, tally, summary)
    if output is not None:
        write_file(output / "results.json", _json_file(results))
        out.note(f"finished shards: {output}; the results: {output / 'results.json'}")
    out.result(results, *_tables(summary), _INTERVALS)
    _tell_horizon(summary, tally.worlds, question.scenario)
    if question.objectives and not out.as_json:
        out.show(rescored_table(rescore_shards(asked, tally), question.harm_count))


def workers_for(ray: str | None, jobs: int | None) -> Workers:
    """Where jobs run: processes of this machine, or a Ray; ``jobs`` at once, by default on every usable core.

    On a cluster None leaves the number to it.
    """
    number = len(os.sched_getaffinity(0)) if jobs is None else jobs
    if ray is None:
        from ethbrake_marl.studies.jobs import LocalWorkers

        return LocalWorkers(number)
    from ethbrake_marl.studies.jobs import LOCAL, RayWorkers

    return RayWorkers(ray, number if ray == LOCAL else jobs)


def _tell_results(
    out: Out,
    evaluation: Evaluation,
    summary: Sequence[SummaryRow],
    groups: Mapping[str, Sequence[SummaryRow]],
    objectives: Sequence[str],
    per_world: Path | None,
    harm_count: HarmCount,
    uncertainty: str | None,
) -> None:
    """Write what was asked for, then print the figures."""
    from ethbrake_marl.evaluation import rescore, rescored_table, rich_table
    from ethbrake_marl.evaluation.results import results_to_json, write_per_world

    if per_world is not None:
        write_per_world(per_world, evaluation, objectives=objectives, force=out.force)
    told = rescore(evaluation, objectives)
    agents_told = {"harm_count": harm_count, "uncertainty": uncertainty}
    results = results_to_json(summary, told=told, groups=groups, per_world=per_world, settings=agents_told)
    if per_world is not None:
        out.write(_beside(per_world), _json_file(results))
        out.note(f"every world: {per_world}; the results: {_beside(per_world)}")
    shown = _tables(summary)
    for name, rows in groups.items():
        shown += [f"\n{name}: {count_of(rows[0].episodes, 'world')}\n", rich_table(rows)]
    out.result(results, *shown)
    _tell_horizon(summary, evaluation.worlds.n, evaluation.scenario)
    if told and not out.as_json:
        out.show(rescored_table(told, harm_count))


def _json_file(content: object) -> bytes:
    return (json.dumps(content, indent=2, allow_nan=False) + "\n").encode()


def _tables(rows: Sequence[SummaryRow]) -> list[Any]:
    from ethbrake_marl.evaluation import rich_table
    from ethbrake_marl.evaluation.summary import metrics_table

    return [rich_table(rows), *([metrics_table(rows)] if rows and rows[0].metrics else [])]


def _tell_horizon(rows: Sequence[SummaryRow], worlds: int, scenario: Scenario) -> None:
    """Say in how many worlds something still moves at the horizon, if in any."""
    from ethbrake_marl.evaluation import horizon_note

    moving = {row.agent: row.horizon_ends for row in rows if row.policy_share is not None}
    if note := horizon_note(moving, worlds, scenario.horizon_s):
        say(note)


def show_run(out: Out, rows: Sequence[SummaryRow], beside: Mapping[str, Sequence[SummaryRow]], results: Any) -> None:
    """The table of a run, and those of the other tests, each below what its test asks."""
    from ethbrake_marl.evaluation import rich_table
    from ethbrake_marl.evaluation.outcome import TESTS

    shown = _tables(rows)
    for test, found in beside.items():
        shown += [Text(f"\n{TESTS[test]}\n"), rich_table(found)]
    out.result(results, *shown)


def _write_report(
    out: Out,
    path: Path,
    evaluation: Evaluation,
    rows: Sequence[SummaryRow],
    agents: Mapping[str, Driver],
    harm_count: HarmCount,
) -> None:
    """Write the page of an evaluation that has just been made."""
    from ethbrake_marl.evaluation import parameter_line

    # matplotlib takes a second to load, and most evaluations draw nothing
    from ethbrake_marl.pages.report import Report, focus_of, play_for_report, shield_evidence, write_report

    done: list[str] = []

    def tell(agent: str) -> None:
        done.append(agent)
        out.progress("report: episodes", len(done), len(agents))

    focus = focus_of(rows)
    played = play_for_report(evaluation, agents, focus, harm_count=harm_count, on_agent=tell)
    scenario, names, asked = evaluation.scenario, ", ".join(row.agent for row in rows), rows[0].parameters
    scripts = ", ".join(f"{vehicle} by {script}" for vehicle, script in asked["scripts"].items())
    report = Report(
        f"{scenario.name}: {names}" if len(names) <= 60 else f"{scenario.name}: {len(rows)} agents compared",
        rows,
        evaluation,
        played,
        shield_evidence(agents, evaluation, harm_count),
        focus,
        summary=scenario.title or "Agents on the same worlds.",
        settings={
            "Command": "ethbrake " + " ".join(sys.argv[1:]),
            "Agents": names,
            "Harm that agents minimise": "first impacts only" if harm_count == "first" else "every impact",
            "Worlds": parameter_line(asked),
            "Driven by the agents": asked.get("controlled_vehicle") or ", ".join(asked["controlled_vehicles"]),
            "Driven by scripts": scripts or "none",
            "Time step, horizon": f"{asked['time_step_s']:g} s, {asked['horizon_s']:g} s",
        },
        versions=rows[0].versions,
    )
    write_report(path, report, force=out.force)
    out.note(f"report: {path}")


_FILE = typer.Argument(metavar="RESULTS.json", help="Results of evaluate, shield (--json) or run.")


@command(app, "compare", "compare before.csv.json after.csv.json", json=True)
def compare_command(out: Out, first: Annotated[Path, _FILE], second: Annotated[Path, _FILE]) -> None:
    """Difference of harm between two results, the second minus the first, for agents of the same name.

    Both must be of one command, and about the same worlds of the same scenario. Intervals are paired by world where the
    files of --per-world lie beside both results.
    """
    from ethbrake_marl.evaluation.results import compare_results, read_result

    found = compare_results(read_result(first), read_result(second))
    table = plain_table("Agent", show_edge=False)
    table.add_column("Policy")
    for name in found.differences[0].harms:
        table.add_column(_HARMS[name], justify="right", no_wrap=True)
    for each in found.differences:
        harms = (estimate.in_words() for estimate in each.harms.values())
        table.add_row(Text(each.agent), _POLICIES[each.policy], *map(Text, harms))
    out.result(found.to_json(), table)
    _tell_conditions(found)


def _tell_conditions(found: Comparison) -> None:
    """On stderr: how the intervals were made, who stands in one result only, and which settings and versions differ."""
    say("second minus first, mean per world in m²/s²; in brackets: 95 % intervals,")
    why = found.unpaired_because
    say("paired by world" if why is None else f"NOT paired, wider than they would be paired by world: {why}")
    for which, agents in zip(("first", "second"), found.left_over, strict=True):
        if agents:
            say(f"in the {which} only: {', '.join(agents)}")
    for name, (one, other) in {**found.other_settings, **found.other_versions}.items():
        say(f"note: {name} {one} in the first, {other} in the second")


@command(app, "shield", "shield --agents ppo@shipped,full_brake --episodes 500", json=True)
def shield_command(
    out: Out,
    agents: str = PROPOSERS,
    scenario: str = "paper-random",
    episodes: int = 2_000,
    harm_count: HarmCount = "first",
    vehicle: str | None = None,
    settings: list[str] | None = None,
) -> None:
    """Compare no shield, episode mode and step mode on the same worlds.

    The agents propose, without a shield of their own, and --harm-count is the harm that is guaranteed. Where several
    vehicles learn: no shield, step mode, and step mode with caps, for the whole team. Each decision that step mode
    replaced is simulated again without it: needed (harm would have been higher), harmless (the same), costly (lower).
    """
    from ethbrake_marl.evaluation import horizon_note
    from ethbrake_marl.evaluation.shield_modes import NONE, modes_tables, modes_to_json

    task = asked_task(scenario, vehicle, settings, harm_count)
    sample = task.scenario.sample(episodes, LIST_SEED)
    rows = measure_modes(out, agents, sample, task)
    out.result(modes_to_json(rows, sample, task), *modes_tables(rows))
    tell_left_out(rows[0].left_out, episodes)
    moving = {f"{row.agent} ({row.mode})": row.horizon_ends for row in rows if row.mode != NONE}
    if note := horizon_note(moving, episodes - len(rows[0].left_out), task.scenario.horizon_s):
        say(note)


def measure_modes(out: Out, agents: str, sample: Sample, task: Task) -> list[ModeRow]:
    """The rows of these agents, with progress on stderr."""
    from ethbrake_marl.evaluation.inputs import make_proposers
    from ethbrake_marl.evaluation.shield_modes import compare_modes

    lineup = make_proposers(agents.split(","), task.scenario, harm_count=task.harm_count)
    n = sample.worlds.n
    return compare_modes(lineup, sample.worlds, task, on_progress=lambda name, done: out.progress(name, done, n))


def tell_left_out(left_out: LeftOutRows, whole: int) -> None:
    """Name the worlds that count in no figure, of ``whole``, in a line on stderr; none where every world counts."""
    from ethbrake_marl.evaluation.summary import left_out_line

    if left_out:
        say(left_out_line([f"world {world} of seed {LIST_SEED} ({reason})" for world, reason in left_out], whole))
