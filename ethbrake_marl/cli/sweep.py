"""The command ``ethbrake sweep``: many trainings from one file, here or on a Ray cluster."""

from __future__ import annotations

import os
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ethbrake_marl.cli.options import JsonOption, schema_option
from ethbrake_marl.cli.terminal import INTERRUPTED, interruptible, progress_bars, say, show, write_json
from ethbrake_marl.errors import InvalidInput, need

if TYPE_CHECKING:
    from ethbrake_marl.studies.jobs import Workers
    from ethbrake_marl.studies.sweep import SweepPlan, SweepResult

FAILED = 1  # exit status where some jobs failed
KEPT = "the same command goes on with what is in the folder"
_MOST = 4096


def _schema() -> dict[str, Any]:
    from ethbrake_marl.studies.sweep import sweep_json_schema

    return sweep_json_schema()


SchemaOption = Annotated[bool, schema_option(_schema)]


def sweep_command(
    file: Annotated[Path, typer.Argument(metavar="SWEEP.yaml", help="A grid or a list of jobs.")],
    output: Annotated[Path, typer.Option("--output", metavar="FOLDER", help="Folder of everything.")],
    jobs: Annotated[
        int | None,
        typer.Option(help="Jobs at once, a process with one thread each.", show_default="the usable cores"),
    ] = None,
    ray: Annotated[
        str | None, typer.Option(metavar="local|ADDRESS", help="Run the jobs on Ray, not in processes of our own.")
    ] = None,
    retries: Annotated[int, typer.Option(help="Further attempts at a job whose process was lost.")] = 2,
    form: Annotated[Literal["csv", "parquet"], typer.Option("--format", help="Of the table.")] = "csv",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the jobs and what they take; do nothing.")] = False,
    as_json: JsonOption = False,
    schema: SchemaOption = False,
) -> None:
    """Train every job of a file, and write one table of what they reached.

    The same command goes on after an interruption: finished jobs are kept, begun ones go on. Exit status 1 where jobs
    failed: failures.csv holds the last lines of each.
    """
    with interruptible(KEPT):
        # torch takes seconds to load, and no other command needs it
        from ethbrake_marl.studies.jobs import JobFolder
        from ethbrake_marl.studies.sweep import plan_sweep, read_sweep, run_sweep

        number = len(os.sched_getaffinity(0)) if jobs is None else jobs
        if ray is not None:
            need("ray")
        if not 1 <= number <= _MOST or not 0 <= retries <= 100:
            raise InvalidInput(f"jobs {number}, retries {retries}: must be from 1 to {_MOST:,}, and from 0 to 100")
        if form == "parquet":
            need("pyarrow")
        plan = plan_sweep(read_sweep(file))
        JobFolder(output, "a sweep").check()
        if dry_run:
            _show_plan(plan, output, number, as_json)
            return
        with closing(workers_for(ray, jobs, number)) as workers, progress_bars() as bars:
            result = run_sweep(plan, output, workers, retries=retries, form=form, tell=bars.show_progress)
    _show_result(result, output, as_json)


def workers_for(ray: str | None, jobs: int | None, number: int) -> Workers:
    """Where jobs run: ``number`` processes of this machine, or a Ray; of a cluster at most ``jobs`` at once."""
    if ray is None:
        from ethbrake_marl.studies.jobs import LocalWorkers

        return LocalWorkers(number)
    from ethbrake_marl.studies.jobs import LOCAL, RayWorkers

    return RayWorkers(ray, number if ray == LOCAL else jobs)


def _show_plan(plan: SweepPlan, output: Path, number: int, as_json: bool) -> None:
    from ethbrake_marl.studies.sweep import cost_of

    cost = cost_of(plan, output)
    if as_json:
        jobs = [
            {"hash": row.identity, "job": row.name, "set": row.settings, "state": cost.states[row.name]}
            for row in plan.rows
        ]
        write_json({"jobs": jobs, "decisions_left": cost.decisions, "core_s_left": cost.work_s})
        return
    for row in plan.rows:
        show("  ".join([f"{cost.states[row.name]:8}", row.name, *row.asked.settings]))
    say(cost.in_words(number))


def _show_result(result: SweepResult, output: Path, as_json: bool) -> None:
    from ethbrake_marl.studies.sweep import FAILURES

    counts = {"jobs": result.jobs, "finished": result.finished, "failed": result.failed}
    if as_json:
        write_json({**counts, "interrupted": result.interrupted, "table": str(result.table)})
    told = f"{result.finished:,} of {result.jobs:,} jobs finished; table: {result.table}"
    if result.failed:
        told += f"; {result.failed:,} failed: {output / FAILURES}"
    say(f"interrupted; {told}; {KEPT}" if result.interrupted else told)
    if result.interrupted:
        raise typer.Exit(INTERRUPTED)
    if result.failed:
        raise typer.Exit(FAILED)
