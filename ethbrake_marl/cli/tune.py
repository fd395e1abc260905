"""The command ``ethbrake tune``: search the settings of a recipe that do least harm."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ethbrake_marl.cli.options import ForceOption, JsonOption, schema_option
from ethbrake_marl.cli.sweep import FAILED, KEPT, workers_for
from ethbrake_marl.cli.terminal import INTERRUPTED, interruptible, progress_bars, say, show, write_json
from ethbrake_marl.errors import InvalidInput, count_of, need

if TYPE_CHECKING:
    from ethbrake_marl.studies.tuning import TuningPlan, TuningResult

_MOST, _MOST_TRIALS = 4096, 100_000


def _schema() -> dict[str, Any]:
    from ethbrake_marl.studies.tuning import tuning_json_schema

    return tuning_json_schema()


StorageOption = Annotated[
    str | None,
    typer.Option(metavar="URL", help="Of the study, to be shared.", show_default="a journal file in FOLDER"),
]
SchemaOption = Annotated[bool, schema_option(_schema)]


def tune_command(
    file: Annotated[Path, typer.Argument(metavar="TUNING.yaml", help="A training and the ranges of its settings.")],
    output: Annotated[Path, typer.Option("--output", metavar="FOLDER", help="Folder of everything.")],
    trials: Annotated[int, typer.Option(help="Trials that the folder shall have altogether.")] = 30,
    jobs: Annotated[int, typer.Option(help="Trials at once, a process each; more than one change what is tried.")] = 1,
    ray: Annotated[
        str | None, typer.Option(metavar="local|ADDRESS", help="Run the trials on Ray, not in processes of our own.")
    ] = None,
    storage: StorageOption = None,
    retries: Annotated[int, typer.Option(help="Further attempts at a trial whose process was lost.")] = 2,
    export: Annotated[
        Path | None, typer.Option(metavar="NAME.yaml", help="Write the best trial as a recipe of this name.")
    ] = None,
    force: ForceOption = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the space and what the trials take; do nothing.")
    ] = False,
    as_json: JsonOption = False,
    schema: SchemaOption = False,
) -> None:
    """Search the settings of a recipe that do least harm on a list of worlds of its own.

    The same command goes on after an interruption: trials that ended are kept, those that were begun go on. Exit status
    1 where no trial came to its end.
    """
    need("optuna")
    with interruptible(KEPT):
        # torch takes seconds to load
        from ethbrake_marl.studies.tuning import plan_tuning, read_tuning, run_tuning, tuning_folder

        _check_options(trials, jobs, retries, storage)
        if ray is not None:
            need("ray")
        plan = plan_tuning(read_tuning(file))
        tuning_folder(plan, output).check()
        if export is not None:
            force = force or _is_an_export(plan, export)
            _check_export(plan, export, force)
        if dry_run:
            _show_plan(plan, trials, jobs, as_json)
            return
        with closing(workers_for(ray, jobs, jobs)) as workers, progress_bars() as bars:
            result = run_tuning(
                plan, output, workers, trials, storage=storage, retries=retries, tell=bars.show_progress
            )
    _show_result(plan, result, export, force, as_json)


def _check_options(trials: int, jobs: int, retries: int, storage: str | None) -> None:
    limits = {"trials": (trials, 1, _MOST_TRIALS), "jobs": (jobs, 1, _MOST), "retries": (retries, 0, 100)}
    for name, (value, least, most) in limits.items():
        if not least <= value <= most:
            raise InvalidInput(f"{name} {value}: must be from {least} to {most:,}")
    if storage is not None and "://" not in storage:
        raise InvalidInput("storage: must be an address such as sqlite:///study.db; leave it out for a journal file")


def _check_export(plan: TuningPlan, export: Path, force: bool) -> None:
    """Raise before the work begins what would be raised at its end."""
    from ethbrake_marl.evaluation.results import check_target
    from ethbrake_marl.studies.tuning import best_recipe

    if export.suffix != ".yaml":
        raise InvalidInput(f"export {export}: must end in .yaml, as recipes do")
    best_recipe(plan, {}, export, "")
    check_target(export, force=force)


def _is_an_export(plan: TuningPlan, export: Path) -> bool:
    """Whether this tuning wrote the file before: then the same command goes on, and replaces it."""
    from ethbrake_marl.studies.tuning import export_head

    head = export_head(plan, export).encode()
    if not export.is_file():
        return False
    with export.open("rb") as file:
        return file.read(len(head)) == head


def _show_plan(plan: TuningPlan, trials: int, jobs: int, as_json: bool) -> None:
    from ethbrake_marl.studies.trainings import told_seconds

    per_trial = plan.seconds_per_trial()
    own = plan.own_values()
    space = {key: dimension.model_dump(mode="json") for key, dimension in plan.file.search.items()}
    if as_json:
        write_json({"search": space, "own_values": own, "core_s_per_trial": per_trial, "trials": trials})
        return
    for key, dimension in plan.file.search.items():
        now = "not in the space" if own is None else f"the recipe has {own[key]}"
        show(f"{key}  {dimension}  ({now})")
    say(
        f"{count_of(trials, 'trial')} of {plan.recipe.total_steps:,} decisions:"
        f" about {told_seconds(trials * per_trial)} of one core, {told_seconds(trials * per_trial / jobs)} with {jobs}"
        " at once; less where trials are pruned or have ended already"
        " (a few updates of the recipe timed on this machine)"
    )


def _show_result(plan: TuningPlan, result: TuningResult, export: Path | None, force: bool, as_json: bool) -> None:
    best = result.best
    export = None if best is None or result.interrupted else export  # what goes on exports at its end
    if best is not None and export is not None:
        from ethbrake_marl.evaluation.results import write_output
        from ethbrake_marl.studies.tuning import best_recipe

        told = f"ethbrake tune: trial {best.number}, harm {best.harm!r} on the list of seed {plan.file.measure.seed}"
        write_output(export, best_recipe(plan, best.values, export, told).encode(), force=force)
    if as_json:
        shown = None if best is None else {"trial": best.number, "harm": best.harm, "values": best.values}
        counts = {"trials": result.counts, "interrupted": result.interrupted, "table": str(result.table)}
        write_json({"best": shown, **counts, "exported": None if export is None else str(export)})
    elif best is not None:
        show(f"best: trial {best.number}, harm {best.harm:.4f}")
        for key, value in best.values.items():
            show(f"  {key} = {value}")
    counted = ", ".join(f"{number:,} {state}" for state, number in sorted(result.counts.items()))
    told = f"trials: {counted or 'none'}; table: {result.table}"
    told += f"; recipe: {export}" if export is not None else ""
    say(f"interrupted; {told}; {KEPT}" if result.interrupted else told)
    if result.interrupted:
        raise typer.Exit(INTERRUPTED)
    if best is None:
        raise typer.Exit(FAILED)
