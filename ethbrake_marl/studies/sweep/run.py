"""Run a sweep: what is finished is kept, what is begun goes on, what fails is told at the end."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ethbrake_marl.files.durable import hold_lock, remove_unfinished
from ethbrake_marl.learning.run_folder import RunDirectory
from ethbrake_marl.policies.policy import has_bundle
from ethbrake_marl.studies.jobs.run import RETRIES, Attempt, run_jobs
from ethbrake_marl.studies.jobs.training import TrainingJob
from ethbrake_marl.studies.jobs.work import Workers, pack
from ethbrake_marl.studies.sweep.job import RESULTS, do_job
from ethbrake_marl.studies.sweep.journal import Failure, Journal, Results, last_lines, read_journal, reason_of
from ethbrake_marl.studies.sweep.plan import Row, SweepPlan
from ethbrake_marl.studies.sweep.table import TableFormat, write_tables

RUNS, LOGS = "runs", "logs"  # inside the sweep's folder
_LOCK = "sweep.lock"

CallOf = Callable[[SweepPlan, Row, Path], bytes]


@dataclass(frozen=True, slots=True)
class SweepState:
    """How far a sweep is, for who is told."""

    done: int  # jobs that have ended, finished or failed
    total: int
    left_s: float | None  # s until the end; None while nothing is known of it
    note: str = ""  # to be told once


@dataclass(frozen=True, slots=True)
class SweepResult:
    """What a sweep left behind."""

    table: Path
    finished: int
    failures: tuple[Failure, ...]
    jobs: int
    interrupted: bool


def training_call(plan: SweepPlan, row: Row, folder: Path) -> bytes:
    """What trains the job of a row."""
    job = TrainingJob(plan.training(row), folder / RUNS / row.name, row.asked.settings)
    return pack(do_job, job, _log(folder, row))


def run_sweep(
    plan: SweepPlan,
    folder: Path,
    workers: Workers,
    *,
    retries: int = RETRIES,
    form: TableFormat = "csv",
    tell: Callable[[SweepState], None] | None = None,
    call_of: CallOf = training_call,
) -> SweepResult:
    """Run what is left of a sweep and write its tables, after Ctrl-C too.

    Args:
        plan: all jobs.
        folder: of everything; made if it is not there.
        workers: where jobs run; not closed here.
        retries: further attempts at a job that was lost.
        form: of the table.
        tell: is told how far it is.
        call_of: makes the call of a row.

    Raises ``InvalidInput`` where another process runs a sweep in this folder.

    """
    folder = folder.absolute()  # a worker may stand elsewhere
    for name in (RUNS, LOGS):
        (folder / name).mkdir(parents=True, exist_ok=True)
    with hold_lock(folder / _LOCK, "another process runs a sweep here"):
        for place in (folder, folder / RUNS):
            remove_unfinished(place)
        results, left, damaged = kept_results(plan, folder)
        failures: list[Failure] = []
        with Journal(folder) as journal:
            course = _Course(plan, left, tell or (lambda state: None))
            course.start(damaged)

            def note(attempt: Attempt) -> None:
                row = left[attempt.number]
                journal.note(row, attempt)
                if attempt.answer.value is not None:
                    results[row.identity] = attempt.answer.value
                elif attempt.last:
                    failures.append(Failure(row, attempt.attempt, reason_of(attempt), last_lines(_log(folder, row))))
                course.take(row, attempt)

            whole = run_jobs(
                lambda number: call_of(plan, left[number], folder), len(left), workers, note, retries=retries
            )
        order = {row.identity: k for k, row in enumerate(plan.rows)}
        failures.sort(key=lambda failure: order[failure.row.identity])
        table = write_tables(folder, plan, results, failures, form)
    return SweepResult(table, len(results), tuple(failures), len(plan.rows), not whole)


def kept_results(plan: SweepPlan, folder: Path) -> tuple[Results, list[Row], int]:
    """What the finished jobs of this plan found, the others in their order, and the damaged lines of the journal.

    A job whose run's folder was taken away, or the kept policy in it, is to be done again.
    """
    found, damaged = read_journal(folder)
    results: Results = {}
    left = []
    for row in plan.rows:
        values = found.get(row.identity)
        if values is not None and _is_whole(RunDirectory(folder / RUNS / row.name), values):
            results[row.identity] = values
        else:
            left.append(row)
    return results, left, damaged


def _is_whole(run: RunDirectory, values: tuple[str, ...]) -> bool:
    """Whether a run still has its record and every policy whose hash the job gave."""
    hashes = values[RESULTS.index("policy_sha256")].split()
    named = [text.rpartition("=")[0] for text in hashes]  # vehicle_i of several, of one policy nothing
    return run.status.is_file() and all(has_bundle(run.policy / name) for name in named)


class _Course:
    """Tells how far a sweep is, and when it will have come to its end: by the decisions that are left."""

    def __init__(self, plan: SweepPlan, left: list[Row], tell: Callable[[SweepState], None]) -> None:
        self._total, self._tell = len(plan.rows), tell
        self._done = self._total - len(left)
        self._left: Counter[str] = Counter()
        for row in left:
            self._left[row.asked.recipe] += row.steps
        self._steps: Counter[str] = Counter()  # of the jobs that have ended since the start
        self._wall_s: Counter[str] = Counter()
        self._started = time.monotonic()

    def start(self, damaged: int) -> None:
        note = f"{damaged} damaged lines of the journal: their jobs are looked at again" if damaged else ""
        if self._done:
            note = f"{self._done:,} jobs are finished already" + (f"; {note}" if note else "")
        self._tell(SweepState(self._done, self._total, None, note))

    def take(self, row: Row, attempt: Attempt) -> None:
        recipe, answer = row.asked.recipe, attempt.answer
        note = "" if answer.value is not None else f"{row.name}: {reason_of(attempt)}"
        if attempt.last:
            self._done += 1
            self._left[recipe] -= row.steps
            self._steps[recipe] += row.steps
            self._wall_s[recipe] += answer.wall_s  # type: ignore[assignment]  # seconds are counted like anything
        elif note:
            note += f"; tried again after attempt {attempt.attempt}"
        self._tell(SweepState(self._done, self._total, self._left_s(), note))

    def _left_s(self) -> float | None:
        """By each recipe's own speed, by the mean of all where it has none yet, and by how many jobs ran at once."""
        steps, wall_s = sum(self._steps.values()), sum(self._wall_s.values())
        if not steps or not wall_s:
            return None
        at_once = wall_s / (time.monotonic() - self._started)
        work_s = sum(
            left * (self._wall_s[recipe] / self._steps[recipe] if self._steps[recipe] else wall_s / steps)
            for recipe, left in self._left.items()
        )
        return float(work_s / at_once)


def _log(folder: Path, row: Row) -> Path:
    """What the job prints."""
    return folder / LOGS / f"{row.name}.log"
