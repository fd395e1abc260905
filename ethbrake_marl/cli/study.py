"""The commands of many trainings or evaluations: ``study``, ``reproduce`` and ``benchmark``."""

from __future__ import annotations

import os
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.text import Text

from ethbrake_marl.cli.command import app, command, new_group, schema_option
from ethbrake_marl.cli.evaluate import workers_for
from ethbrake_marl.cli.out import PAGES, Out, plain_table
from ethbrake_marl.defaults import LIST_SEED, HarmCount
from ethbrake_marl.errors import InvalidInput, check_whole_number, count_of, need

if TYPE_CHECKING:
    from ethbrake_marl.studies.ablation import Plan
    from ethbrake_marl.studies.sweep import SweepPlan, SweepResult
    from ethbrake_marl.studies.tuning import TuningPlan, TuningResult

KEPT = "the same command goes on with what is in the folder"
PAPER_EPISODES = 10_000
_MOST_JOBS, _MOST_TRIALS, _MOST_RETRIES = 4096, 100_000, 100
_QUICK = {"seeds": 2, "steps_per_learner": 200_000, "episodes": 500, "search_episodes": 40, "budget": 2_000}
_FULL = {"seeds": 5, "steps_per_learner": 400_000, "episodes": 4_000, "search_episodes": 600, "budget": 20_000}

FolderOption = Annotated[Path, typer.Option(metavar="FOLDER", help="Folder of everything.")]
RetriesOption = Annotated[int, typer.Option(help="Further attempts at a job whose process was lost.")]
DryRunOption = Annotated[
    bool, typer.Option("--dry-run", help="Print what would be done and what it takes; do nothing.")
]
CostOption = Annotated[bool, typer.Option("--cost", help="Say what is left to do and what it takes; stop.")]

study_group = new_group(
    "study",
    "Train and compare many policies: a grid, a search of settings, levels of cooperation, longer lines.",
    "study sweep sweep.yaml --output runs/sweep",
    "study ablate --quick --output runs/ablation-quick",
)


def _sweep_schema() -> dict[str, Any]:
    from ethbrake_marl.studies.sweep import sweep_json_schema

    return sweep_json_schema()


@command(study_group, "sweep", "study sweep sweep.yaml --output runs/sweep", kept=KEPT, json=True)
def sweep_command(
    out: Out,
    file: Annotated[Path, typer.Argument(metavar="SWEEP.yaml", help="A grid or a list of jobs.")],
    output: FolderOption,
    jobs: Annotated[
        int | None,
        typer.Option(help="Jobs at once, a process with one thread each.", show_default="the usable cores"),
    ] = None,
    ray: str | None = None,
    retries: RetriesOption = 2,
    form: Annotated[Literal["csv", "parquet"], typer.Option("--format", help="Of the table.")] = "csv",
    dry_run: DryRunOption = False,
    schema: schema_option(_sweep_schema) = False,  # type: ignore[valid-type]  # made here, read by Typer
) -> None:
    """Train every job of a file, and write one table of what they reached.

    The same command goes on after an interruption: finished jobs are kept, begun ones go on. Exit status 1 where jobs
    failed: failures.csv holds the last lines of each.
    """
    from ethbrake_marl.studies.jobs import JobFolder
    from ethbrake_marl.studies.sweep import plan_sweep, read_sweep, run_sweep

    number = len(os.sched_getaffinity(0)) if jobs is None else jobs
    _check_workers(number, retries, ray)
    if form == "parquet":
        need("pyarrow")
    plan = plan_sweep(read_sweep(file))
    JobFolder(output, "a sweep").check()
    if dry_run:
        _show_sweep(out, plan, output, number)
        return
    with closing(workers_for(ray, jobs)) as workers:
        result = run_sweep(plan, output, workers, retries=retries, form=form, tell=out.show_progress)
    _tell_sweep(out, result, output)


def _check_workers(jobs: int, retries: int, ray: str | None) -> None:
    check_whole_number("jobs", jobs, 1, _MOST_JOBS)
    check_whole_number("retries", retries, 0, _MOST_RETRIES)
    if ray is not None:
        need("ray")


def _show_sweep(out: Out, plan: SweepPlan, output: Path, number: int) -> None:
    """Every job and its state, and what is left takes."""
    from ethbrake_marl.studies.sweep import cost_of

    cost = cost_of(plan, output)
    states = [(row, cost.states[row.name]) for row in plan.rows]
    jobs = [{"hash": row.identity, "job": row.name, "set": row.settings, "state": state} for row, state in states]
    lines = ["  ".join([f"{state:8}", row.name, *row.asked.settings]) for row, state in states]
    out.result({"jobs": jobs, "decisions_left": cost.decisions, "core_s_left": cost.work_s}, *lines)
    if not out.as_json:
        out.note(cost.in_words(number))


def _tell_sweep(out: Out, result: SweepResult, output: Path) -> None:
    from ethbrake_marl.studies.sweep import FAILURES

    counts = {"jobs": result.jobs, "finished": result.finished, "failed": result.failed}
    out.result({**counts, "interrupted": result.interrupted, "table": str(result.table)})
    told = f"{result.finished:,} of {result.jobs:,} jobs finished; table: {result.table}"
    if result.failed:
        told += f"; {result.failed:,} failed: {output / FAILURES}"
    if result.interrupted:
        out.interrupted(f"interrupted; {told}; {KEPT}")
    out.note(told)
    if result.failed:
        raise typer.Exit(1)


def _tuning_schema() -> dict[str, Any]:
    from ethbrake_marl.studies.tuning import tuning_json_schema

    return tuning_json_schema()


@command(
    study_group, "tune", "study tune tuning.yaml --output runs/tuning --trials 30 --export best.yaml",
    kept=KEPT, needs=("optuna",), json=True, force=True,
)  # fmt: skip
def tune_command(
    out: Out,
    file: Annotated[Path, typer.Argument(metavar="TUNING.yaml", help="A training and the ranges of its settings.")],
    output: FolderOption,
    trials: Annotated[int, typer.Option(help="Trials that the folder shall have altogether.")] = 30,
    jobs: Annotated[int, typer.Option(help="Trials at once, a process each; more than one change what is tried.")] = 1,
    ray: str | None = None,
    storage: Annotated[
        str | None,
        typer.Option(metavar="URL", help="Of the study, to be shared.", show_default="a journal file in FOLDER"),
    ] = None,
    retries: RetriesOption = 2,
    export: Annotated[
        Path | None, typer.Option(metavar="NAME.yaml", help="Write the best trial as a recipe of this name.")
    ] = None,
    dry_run: DryRunOption = False,
    schema: schema_option(_tuning_schema) = False,  # type: ignore[valid-type]  # made here, read by Typer
) -> None:
    """Search the settings of a recipe that do least harm on a list of worlds of its own.

    The same command goes on after an interruption: trials that ended are kept, those that were begun go on. Exit status
    1 where no trial came to its end.
    """
    from ethbrake_marl.studies.tuning import plan_tuning, read_tuning, run_tuning, tuning_folder

    check_whole_number("trials", trials, 1, _MOST_TRIALS)
    _check_workers(jobs, retries, ray)
    if storage is not None and "://" not in storage:
        raise InvalidInput("storage: must be an address such as sqlite:///study.db; leave it out for a journal file")
    plan = plan_tuning(read_tuning(file))
    tuning_folder(plan, output).check()
    _check_export(out, plan, export)
    if dry_run:
        _show_tuning(out, plan, trials, jobs)
        return
    with closing(workers_for(ray, jobs)) as workers:
        result = run_tuning(plan, output, workers, trials, storage=storage, retries=retries, tell=out.show_progress)
    _tell_tuning(out, plan, result, export)


def _check_export(out: Out, plan: TuningPlan, export: Path | None) -> None:
    """Raise before the work begins what would be raised at its end.

    A file that this tuning wrote before is replaced: the same command goes on.
    """
    from ethbrake_marl.studies.tuning import best_recipe, export_head

    if export is None:
        return
    if export.is_file():
        head = export_head(plan, export).encode()
        with export.open("rb") as file:
            out.force = out.force or file.read(len(head)) == head
    if export.suffix != ".yaml":
        raise InvalidInput(f"export {export}: must end in .yaml, as recipes do")
    best_recipe(plan, {}, export, "")
    out.check(export)


def _show_tuning(out: Out, plan: TuningPlan, trials: int, jobs: int) -> None:
    """The space, and what the trials take."""
    from ethbrake_marl.studies.trainings import told_seconds

    per_trial, own = plan.seconds_per_trial(), plan.own_values()
    space = {key: dimension.model_dump(mode="json") for key, dimension in plan.file.search.items()}
    now = {key: "not in the space" if own is None else f"the recipe has {own[key]}" for key in space}
    out.result(
        {"search": space, "own_values": own, "core_s_per_trial": per_trial, "trials": trials},
        *(f"{key}  {dimension}  ({now[key]})" for key, dimension in plan.file.search.items()),
    )
    if not out.as_json:
        out.note(
            f"{count_of(trials, 'trial')} of {plan.recipe.total_steps:,} decisions:"
            f" about {told_seconds(trials * per_trial)} of one core, {told_seconds(trials * per_trial / jobs)} with"
            f" {jobs} at once; less where trials are pruned or have ended already"
            " (a few updates of the recipe timed on this machine)"
        )


def _tell_tuning(out: Out, plan: TuningPlan, result: TuningResult, export: Path | None) -> None:
    from ethbrake_marl.studies.tuning import best_recipe

    best = result.best
    export = None if best is None or result.interrupted else export  # what goes on exports at its end
    if best is not None and export is not None:
        told = (
            f"ethbrake study tune: trial {best.number}, harm {best.harm!r} on the list of seed {plan.file.measure.seed}"
        )
        out.write(export, best_recipe(plan, best.values, export, told))
    shown = None if best is None else {"trial": best.number, "harm": best.harm, "values": best.values}
    counts = {"trials": result.counts, "interrupted": result.interrupted, "table": str(result.table)}
    lines = [] if best is None else [f"best: trial {best.number}, harm {best.harm:.4f}"]
    lines += [] if best is None else [f"  {key} = {value}" for key, value in best.values.items()]
    out.result({"best": shown, **counts, "exported": None if export is None else str(export)}, *lines)
    counted = ", ".join(f"{number:,} {state}" for state, number in sorted(result.counts.items()))
    told = f"trials: {counted or 'none'}; table: {result.table}"
    told += f"; recipe: {export}" if export is not None else ""
    if result.interrupted:
        out.interrupted(f"interrupted; {told}; {KEPT}")
    out.note(told)
    if best is None:
        raise typer.Exit(1)


@command(study_group, "ablate", "study ablate --quick --output runs/ablation-quick", kept=KEPT, json=True)
def ablate_command(
    out: Out,
    output: FolderOption,
    levels: Annotated[
        str | None, typer.Option(metavar="A,B,...", help="Scenarios in this order.", show_default="the shipped ladder")
    ] = None,
    recipes: Annotated[str, typer.Option(metavar="A,B,...", help="Training recipes.")] = "cooperation",
    scheme: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="How several learners are trained.", show_default="the recipe's; else shared"
        ),
    ] = None,
    seeds: Annotated[int | None, typer.Option(help="Trainings of each, seeds 0, 1, ...", show_default="5")] = None,
    steps: Annotated[
        int | None, typer.Option(help="Decisions per training, for each of its learners.", show_default="400000")
    ] = None,
    episodes: Annotated[int | None, typer.Option(help="Common worlds to measure on.", show_default="4000")] = None,
    list_seed: Annotated[int, typer.Option(help="Seed of the common worlds.")] = LIST_SEED,
    search_episodes: Annotated[
        int | None, typer.Option(help="Worlds of the joint optimum, the first ones.", show_default="600")
    ] = None,
    budget: Annotated[
        int | None, typer.Option(help="Candidates per world and count of that search.", show_default="20000")
    ] = None,
    shield: Annotated[
        str | None,
        typer.Option(metavar="step", help="Also drive behind this shield, one for all learners.", show_default="none"),
    ] = None,
    settings: list[str] | None = None,
    quick: Annotated[bool, typer.Option("--quick", help="A first look: few seeds, worlds and decisions.")] = False,
    jobs: int = 1,
    cost: CostOption = False,
) -> None:
    """Train levels of cooperation, compare them on common worlds.

    Says first what it will take. The same command goes on after an interruption: finished trainings are kept, begun
    ones go on. Writes ablation.html, ablation.md, ablation.csv, ablation.json and three figures.
    """
    from ethbrake_marl.studies.ablation import (
        LADDER,
        STANDARD,
        check_finished,
        cost_of,
        run_ablation,
    )
    from ethbrake_marl.studies.ablation_report import FIGURES, PAGE, TEXT, write_ablation
    from ethbrake_marl.studies.speed import this_machine

    given = {"seeds": seeds, "steps_per_learner": steps, "episodes": episodes, "search_episodes": search_episodes}
    numbers = dict(_QUICK if quick else _FULL)
    numbers |= {name: value for name, value in {**given, "budget": budget}.items() if value is not None}
    names = [*(LADDER if quick else STANDARD)] if levels is None else levels.split(",")
    plan = _plan(out, names, recipes, scheme, settings, list_seed, output, shield, numbers)
    if not cost:
        plan.job_folder().check()
    check_finished(plan.trainings())
    out.note(str(cost_of(plan)))
    if cost:
        return
    measured = run_ablation(plan, jobs, out.show_progress)
    if measured is None:
        out.interrupted(f"interrupted; {KEPT}")
    found = write_ablation(plan, measured, str(this_machine()))
    if out.as_json:
        out.print_json(found)
    else:
        out.show((plan.folder / TEXT).read_text("utf-8"), end="")
    figures = ", ".join(str(plan.folder / name) for name in FIGURES if (plan.folder / name).is_file())
    written = f"page: {plan.folder / PAGE}; tables: {plan.folder / TEXT}"
    out.note(written + (f"; figures: {figures}" if figures else ""))


def _plan(
    out: Out,
    names: list[str],
    recipes: str,
    scheme: str | None,
    settings: list[str] | None,
    list_seed: int,
    output: Path,
    shield: str | None,
    numbers: dict[str, int],
) -> Plan:
    """The ablation that is asked for; raises for whatever cannot be trained in it."""
    from ethbrake_marl.learning.recipe import check_scheme, load_recipe, read_settings, scheme_of
    from ethbrake_marl.studies.ablation import Plan, check_plan, common_worlds, read_levels, with_scheme
    from ethbrake_marl.studies.jobs import JobFolder

    chosen = None if scheme is None else check_scheme(scheme)
    loaded = [load_recipe(each.strip()) for each in recipes.split(",")]
    given = read_settings(settings, loaded)
    plan = Plan(
        levels=tuple(read_levels([each.strip() for each in names], given.scenario)),
        recipes=tuple(with_scheme(given.change(recipe, out.note), chosen) for recipe in loaded),
        noted=given.texts,
        list_seed=list_seed,
        folder=output,
        shield=shield,
        **numbers,
    )
    check_plan(plan)
    JobFolder(output, "an ablation").check()
    common_worlds(plan.levels, 5, list_seed)
    for training in plan.trainings():
        scheme_of(training.recipe, training.level.scenario)
    return plan


@command(
    study_group, "generalise", "study generalise --runs runs/cooperation-4-all-cooperation-seed0 --vehicles 3,5,10",
    json=True,
)  # fmt: skip
def generalise_command(
    out: Out,
    runs: Annotated[str, typer.Option(metavar="RUN,RUN,...", help="Runs or bundles, seeds of one training.")],
    scenario: str = "cooperation-4-all",
    vehicles: Annotated[
        str, typer.Option(metavar="N,N,...", help="Lengths of the lines; vehicle i > 3 is like vehicle i - 2.")
    ] = "3,4,5,6,7,8,9,10",
    episodes: Annotated[int, typer.Option(help="Worlds of each length.")] = 1000,
    seed: int = LIST_SEED,
    harm_count: HarmCount = "total",
    search_episodes: Annotated[int, typer.Option(help="Worlds of the joint optimum; 0: none.")] = 0,
    budget: Annotated[int, typer.Option(help="Candidates per world of that search.")] = 20_000,
    settings: list[str] | None = None,
    jobs: int = 1,
) -> None:
    """Let trained policies drive longer lines with the same weights.

    They drive every follower, and Vehicle 1 where it learns in the scenario.
    """
    from ethbrake_marl.evaluation.inputs import load_runnable
    from ethbrake_marl.learning.recipe import read_settings
    from ethbrake_marl.studies.ablation_report import LineQuestion, drive_longer, lines_markdown, load_runs

    lengths = tuple(int(each) if each.strip().isdecimal() else 0 for each in vehicles.split(","))
    if not all(2 <= each <= 64 for each in lengths):
        raise InvalidInput(f"vehicles {vehicles!r}: must be lengths from 2 to 64, for instance 3,4,5")
    check_whole_number("episodes", episodes, 1)
    check_whole_number("search-episodes", search_episodes, 0, episodes)
    check_whole_number("budget", budget, 1)
    line = load_runnable(scenario, read_settings(settings).scenario)
    agents = load_runs([each.strip() for each in runs.split(",")], line)
    question = LineQuestion(line, lengths, episodes, seed, harm_count, search_episodes, budget)
    found = drive_longer(question, agents, out.show_progress, jobs)
    if out.as_json:
        out.print_json([one.to_json() for one in found])
    else:
        out.show(lines_markdown(found, question, len(agents)), end="")


@command(
    app, "reproduce", "reproduce random-table harm-distance --quick --output runs/paper",
    kept=KEPT, json=True, force=True,
)  # fmt: skip
def reproduce_command(
    out: Out,
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[ITEM ...]", help="What to make.", show_default="everything")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Train nothing: shipped policies (the default).")] = False,
    full: Annotated[bool, typer.Option("--full", help="Train learning curves and a policy stopped early.")] = False,
    output: FolderOption = Path("runs/reproduction"),
    episodes: Annotated[int, typer.Option(help="The most worlds of any list; the paper has 10,000.")] = PAPER_EPISODES,
    docs: Annotated[
        Path | None, typer.Option(metavar="FILE.md", help="Write the results as Markdown, too, figures beside it.")
    ] = None,
    cost: CostOption = False,
    listed: Annotated[bool, typer.Option("--list", help="List the items; stop.")] = False,
) -> None:
    """Make the paper's figures and tables again, and say what agrees, what differs and what cannot agree.

    Writes one page (index.html), and for each item its figures, its data and its result. Says first what it will take.
    The same command goes on after an interruption.
    """
    from ethbrake_marl.studies.reproduction.folder import (
        PAGE,
        check_docs,
        choose_items,
        reproduce,
        tell_cost,
        write_docs,
    )
    from ethbrake_marl.studies.reproduction.item import Settings
    from ethbrake_marl.studies.speed import this_machine

    chosen = choose_items(names or ())
    if listed:
        rows = [(item.name, ", ".join(item.labels), item.title) for item in chosen]
        table = plain_table("Item", "Label in the paper", "What", show_edge=False)
        for row in rows:
            table.add_row(*map(Text, row))
        out.result([dict(zip(("name", "labels", "title"), row, strict=True)) for row in rows], table)
        return
    if quick and full:
        raise InvalidInput("--quick and --full: give one of the two")
    check_whole_number("episodes", episodes, 2, PAPER_EPISODES)
    if full:
        need("torch")
    if docs is not None:
        check_docs(docs)
    settings = Settings("full" if full else "quick", output, episodes, out.show_progress, str(this_machine()))
    out.note(tell_cost(chosen, settings))
    if cost:
        return
    results, finished = reproduce(chosen, settings, force=out.force)
    if docs is not None:
        write_docs(docs, output, results)
    table = plain_table("Item", "Verdict", "Because", show_edge=False)
    for result in results:
        table.add_row(Text(result.name), Text(result.verdict.outcome), Text(result.verdict.because))
    out.result([asdict(result) for result in results], table)
    out.note(f"page: {output / PAGE}")
    if not finished:
        out.interrupted(f"interrupted: items are made of the trainings that were finished; {KEPT}")


benchmark_group = new_group(
    "benchmark",
    "Score an agent on a frozen suite of lists, or show entries as one table.",
    "benchmark v2 --agent ppo@shipped --output mine.json",
    "benchmark table mine.json theirs.json --output table.html",
)


@command(benchmark_group, "drive", "benchmark v2 --agent ppo@shipped --output mine.json", json=True, force=True)
def drive_command(
    out: Out,
    suite: Annotated[str, typer.Argument(metavar="SUITE", help="A suite that ships, such as v2.")],
    agent: Annotated[str, typer.Option(metavar="SPEC", help="Who drives; any agent of `ethbrake evaluate`.")],
    output: Annotated[
        Path | None, typer.Option(metavar="ENTRY.json", help="Also write the entry to this file.")
    ] = None,
) -> None:
    """Let an agent drive a frozen suite of lists, and score it.

    The score of a list is the realised share of what is possible, 0 for full braking and 1 for the best known. A list
    that the agent cannot drive has none, and then there is no overall score.
    """
    from ethbrake_marl.studies.benchmark import entry_sheet, load_suite, make_entry, write_entry

    out.check(output, ".json", what="an entry")
    chosen = load_suite(suite)
    entry = make_entry(chosen, agent, on_progress=out.show_progress)
    if output is not None:
        write_entry(output, entry, force=out.force)
        out.note(f"entry: {output}")
    mean = entry.mean_of_driven.in_words(digits=1, scale=100.0, unit=" %")
    if entry.overall is not None:
        told = f"{agent}: overall {mean} of what is possible, mean over {len(chosen.lists)} lists of suite {suite}"
    else:
        told = (
            f"{agent}: no overall score, as it drives {entry.lists_driven} of {len(chosen.lists)} lists of suite"
            f" {suite}; {mean} of what is possible there"
        )
    out.result(entry.model_dump(mode="json"), entry_sheet(entry, chosen), told)


@command(benchmark_group, "table", "benchmark table mine.json theirs.json --output table.html", json=True, force=True)
def table_command(
    out: Out,
    entries: Annotated[list[Path], typer.Argument(metavar="ENTRY.json...", help="Entries of one suite.")],
    output: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also write the table, as a page (.html) or Markdown (.md).")
    ] = None,
) -> None:
    """Show entries of `ethbrake benchmark` as one table, sorted by their score.

    Refused by name: entries of another suite, and changed ones.
    """
    from ethbrake_marl.studies.benchmark import read_leaderboard

    out.check(output, *PAGES, ".md", what="the table")
    found = read_leaderboard(entries)
    if output is not None:
        out.write(output, found.markdown() if output.suffix.lower() == ".md" else found.page(), what="table")
    out.result(found.to_json(), found.sheet(), *found.notes)
