"""Run a sweep: what is finished is kept, what is begun goes on, what fails is told at the end."""

from __future__ import annotations

import csv
import io
import json
import os
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

from ethbrake_marl.errors import AlreadyExists, InvalidInput, count_of, describe_error, naming_extras, one_line
from ethbrake_marl.files.store import (
    hold_lock,
    new_file,
    parse_strict_json,
    remove_folder,
    remove_unfinished,
    write_file,
)
from ethbrake_marl.learning.progress import OBJECTIVE, chosen_by
from ethbrake_marl.learning.train import StopAt
from ethbrake_marl.learning.training import (
    RunDirectory,
    Training,
    check_same,
    is_finished,
    progress_rows,
    wait_for_others,
)
from ethbrake_marl.policies.bundle import Policy, has_bundle, read_trained
from ethbrake_marl.studies.jobs import RETRIES, Attempt, Workers, pack, run_jobs
from ethbrake_marl.studies.sweep_file import Row, SweepPlan
from ethbrake_marl.studies.trainings import (
    Timed,
    TrainingJob,
    finish_training,
    time_training,
    told_seconds,
    training_seconds,
)

# One job of a sweep, wherever it runs: train to the end, then read what the run's folder says of it.

_MEASURED = ("first_impact_harm", "total_harm", "collision_rate")
RESULTS = (
    "steps",  # decisions of learners in whole updates
    "policy_steps",  # decisions after which the kept policy was taken: the best one on the recipe's list
    *_MEASURED,  # of the kept policy on that list
    OBJECTIVE,  # likewise, where a learner has another objective than total
    *(f"last_{name}" for name in _MEASURED),  # of the last one
    "policy_sha256",  # of the kept policy's manifest, of several vehicle_i=... each
)
_FREE_S = 60.0  # a worker that has lost its driver may hold the folder for a moment


def do_job(job: TrainingJob, log: Path, stop_at: StopAt | None = None) -> tuple[str, ...] | None:
    """The values of ``RESULTS``, as text; None where the training was stopped before its end, by ``stop_at`` too.

    What is printed goes to ``log``, which is deleted at a good end. Raises what a training raises, ``InvalidInput``
    where the sweep's folder cannot be seen or the run's folder holds another training, and ``BlockingIOError`` where
    another worker has just begun it.
    """
    if not log.parent.is_dir():
        raise InvalidInput(
            f"{log.parent}: is not there on {os.uname().nodename}; every computer of a cluster must see the sweep's"
            " folder"
        )
    with _printing_to(log):
        if RunDirectory(job.folder).status.is_file():
            wait_for_others(job.folder, _FREE_S)
            check_same(job.folder, job.training)
            if is_finished(job.folder) and not _keeps_policies(job):
                remove_folder(job.folder)  # a finished run has no checkpoint: it is trained anew
        try:
            finished = finish_training(job, stop_at=stop_at)
        except AlreadyExists as error:  # begun in this moment by a worker that has lost its driver
            raise BlockingIOError(str(error)) from None
        found = read_results(job.training, job.folder) if finished else None
    if found is not None:
        log.unlink(missing_ok=True)
    return found


def _keeps_policies(job: TrainingJob) -> bool:
    return all(has_bundle(job.folder / place) for place in job.training.drivers.values())


def read_results(training: Training, folder: Path) -> tuple[str, ...]:
    """The values of ``RESULTS`` of a finished training, in the text that its table has."""
    table = [row for row in progress_rows(folder) if row.get(f"eval/{_MEASURED[0]}")]
    if not table:
        raise InvalidInput(f"{RunDirectory(folder).progress}: holds no evaluation; delete its folder to train anew")
    harm = chosen_by(table, training.recipe.reward.harm_count, "eval/")
    kept, last = min(table, key=lambda row: float(row[harm])), table[-1]
    trained = read_trained(RunDirectory(folder).policy)
    if isinstance(trained, Policy):
        sha256 = trained.manifest.manifest_sha256
    else:
        sha256 = " ".join(f"{name}={policy.manifest.manifest_sha256}" for name, policy in trained.members.items())
    measured, later = ([row[f"eval/{name}"] for name in _MEASURED] for row in (kept, last))
    return (last["steps"], kept["steps"], *measured, kept.get(f"eval/{OBJECTIVE}", ""), *later, sha256)


@contextmanager
def _printing_to(log: Path) -> Iterator[None]:
    """What this process prints inside goes to a file, from every library, and the end of an error with it."""
    sys.stdout.flush()
    sys.stderr.flush()
    before = os.dup(1), os.dup(2)
    with log.open("ab", buffering=0) as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        try:
            yield
        except BaseException:
            traceback.print_exc(file=os.fdopen(os.dup(file.fileno()), "w"))
            raise
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            for descriptor, kept in enumerate(before, 1):
                os.dup2(kept, descriptor)
                os.close(kept)


# The journal of a sweep: a line for every attempt that has ended, with what it found and when.
#
# What a job finds stands in its run's folder. The journal saves reading all of them when the sweep goes on, and holds
# what must not be in the table: times, attempts and where a job ran. A line that is missing or damaged costs a look at
# one folder, and no result.

JOURNAL = "journal.jsonl"
_LAST_LINES, _TAIL_BYTES = 10, 8192  # of what a failed job printed

Results = dict[str, tuple[str, ...]]  # hash -> values of ``RESULTS``


@dataclass(frozen=True, slots=True)
class Failure:
    """A job that has failed for good."""

    row: Row
    attempts: int
    reason: str
    last_lines: str


def read_journal(folder: Path) -> tuple[Results, int]:
    """What the finished jobs of a sweep found, and how many lines are damaged (a writer that was killed leaves one)."""
    found: Results = {}
    damaged = 0
    if not (folder / JOURNAL).is_file():
        return found, damaged
    with (folder / JOURNAL).open("rb") as file:
        for line in file:
            try:
                entry = parse_strict_json(line)
                if entry["status"] == "finished":
                    found[entry["hash"]] = _checked(entry["results"])
            except (ValueError, TypeError, KeyError):
                damaged += 1
    return found, damaged


def _checked(results: Mapping[str, Any]) -> tuple[str, ...]:
    values = tuple(results[name] for name in RESULTS)
    if not all(isinstance(value, str) for value in values):
        raise ValueError("results must be text")
    return values


class Journal:
    """Writes the journal, line by line; a line is on its way to the disk when ``note`` returns."""

    def __init__(self, folder: Path) -> None:
        path = folder / JOURNAL
        torn = _ends_in_a_line(path)
        self._file = path.open("a", encoding="utf-8")
        if torn:
            self._write("\n")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._file.close()

    def note(self, row: Row, attempt: Attempt) -> None:
        """Write down one attempt."""
        answer = attempt.answer
        told: dict[str, Any] = {"results": dict(zip(RESULTS, answer.value or (), strict=False))}
        if answer.value is None:
            told = {"reason": reason_of(attempt)}
        status = "finished" if answer.value is not None else "failed" if attempt.last else "again"
        entry = {
            "hash": row.identity,
            "job": row.name,
            "status": status,
            "attempt": attempt.attempt,
            "ended_utc": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "wall_s": round(answer.wall_s, 3),
            "where": answer.where,
            **told,
        }
        self._write(json.dumps(entry) + "\n")

    def _write(self, text: str) -> None:
        self._file.write(text)
        self._file.flush()


def _ends_in_a_line(path: Path) -> bool:
    """Whether the last line was not written to its end."""
    if not path.is_file() or not path.stat().st_size:
        return False
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read() != b"\n"


def reason_of(attempt: Attempt) -> str:
    """Why an attempt found nothing, in one line."""
    error = attempt.answer.error
    return one_line("was stopped from outside" if error is None else describe_error(error))


def last_lines(log: Path) -> str:
    """The end of what a job printed."""
    if not log.is_file():
        return ""
    with log.open("rb") as file:
        file.seek(max(log.stat().st_size - _TAIL_BYTES, 0))
        return "\n".join(file.read().decode("utf-8", "replace").splitlines()[-_LAST_LINES:])


# The tables of a sweep: one row per finished job in the order of the file, and one per failure.
#
# The first is made of the plan and of what the jobs found alone, so that it is the same, byte for byte, in whatever
# order
# and wherever they ran, and however often they were stopped.

TableFormat = Literal["csv", "parquet"]
TABLE, FAILURES = "results", "failures.csv"  # the table's name without its ending

_ABOUT = ("hash", "scenario", "level", "recipe", "algorithm", "scheme", "seed", "total_steps")
_WHOLE = {"seed", "total_steps", "steps", "policy_steps"}
_TEXT = {"hash", "scenario", "level", "recipe", "algorithm", "scheme", "policy_sha256"}


def table_file(folder: Path, form: TableFormat) -> Path:
    """Where the table stands."""
    return folder / f"{TABLE}.{form}"


def write_tables(
    folder: Path, plan: SweepPlan, results: Results, failures: Sequence[Failure], form: TableFormat
) -> Path:
    """Write the table of the finished jobs, give its path, and write that of the failures where there are any.

    A setting's column is called ``set.KEY``. Parquet has numbers for results and text for settings.
    """
    path = table_file(folder, form)
    {"csv": _write_csv, "parquet": _write_parquet}[form](path, plan, results)
    if failures:
        write_file(folder / FAILURES, _failures_csv(failures).encode())
    else:
        (folder / FAILURES).unlink(missing_ok=True)
    return path


def _columns(plan: SweepPlan) -> list[str]:
    return [*_ABOUT, *(f"set.{key}" for key in plan.keys), *RESULTS]


def _rows(plan: SweepPlan, results: Mapping[str, tuple[str, ...]]) -> Iterator[list[str]]:
    """The finished jobs."""
    keys = plan.keys
    for row in plan.rows:
        found = results.get(row.identity)
        if found is not None:
            settings = row.settings
            yield [*_about(row), *(settings.get(key, "") for key in keys), *found]


def _about(row: Row) -> list[str]:
    asked = row.asked
    return [
        row.identity, asked.scenario, asked.level, asked.recipe, row.algorithm, row.scheme, str(asked.seed),
        str(row.steps),
    ]  # fmt: skip


def _write_csv(path: Path, plan: SweepPlan, results: Results) -> None:
    with new_file(path) as partial, partial.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_columns(plan))
        writer.writerows(_rows(plan, results))


def _write_parquet(path: Path, plan: SweepPlan, results: Results) -> None:
    with naming_extras():
        import pyarrow as pa
        import pyarrow.parquet as pq
    columns = _columns(plan)
    values = list(zip(*_rows(plan, results), strict=True)) or [()] * len(columns)
    arrays = {}
    for name, column in zip(columns, values, strict=True):
        kind, read = _kind(name)
        arrays[name] = pa.array([read(value) if value else None for value in column], getattr(pa, kind)())
    with new_file(path) as partial:
        pq.write_table(pa.table(arrays), partial)


def _kind(column: str) -> tuple[str, Callable[[str], Any]]:
    """Arrow's type of a column, and what makes a value of its text."""
    if column in _WHOLE:
        return "int64", int
    return ("string", str) if column in _TEXT or column.startswith("set.") else ("float64", float)


def _failures_csv(failures: Sequence[Failure]) -> str:
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*_ABOUT, "set", "attempts", "reason", "last_lines"])
    for failure in failures:
        settings = " ".join(failure.row.asked.settings)
        writer.writerow([*_about(failure.row), settings, failure.attempts, failure.reason, failure.last_lines])
    return text.getvalue()


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


# The cost of what is left of a sweep, told before anything is begun.

_TIMED_DRIVES = 50  # worlds that each timed policy drives


@dataclass(frozen=True, slots=True)
class SweepCost:
    """Seconds of one core for what is left to do; begun jobs are reckoned whole."""

    rows: Sequence[Row]  # what is left
    decisions: int
    work_s: float
    processes: int
    recipes: int  # one job of each was timed

    def __str__(self) -> str:
        """The cost in one line."""
        if not self.rows:
            return "to do: nothing"
        return (
            f"to do: {count_of(len(self.rows), 'job')}, {self.decisions:,} decisions: about {told_seconds(self.work_s)}"
            f" of one core, {told_seconds(self.work_s / self.processes)} with {self.processes} at once"
            f" (a few updates of {count_of(self.recipes, 'recipe')} timed on this machine)"
        )


def cost_of(plan: SweepPlan, folder: Path, processes: int) -> SweepCost:
    """Time a short training of the first job of each recipe, and reckon up what is left."""
    left = kept_results(plan, folder)[1]
    steps: Counter[Row] = Counter()
    first: dict[object, Row] = {}
    for row in left:
        steps[first.setdefault(row.asked.kind, row)] += row.steps
    timed: dict[str, Timed] = {}
    work_s = 0.0
    for row, decisions in steps.items():
        training = plan.training(row)
        if row.asked.recipe not in timed:
            timed[row.asked.recipe] = _time(training)
        work_s += training_seconds(training.recipe, training.scenario, timed[row.asked.recipe], decisions)
    return SweepCost(left, sum(steps.values()), work_s, processes, len(timed))


def _time(training: Training) -> Timed:
    sample = training.scenario.sample(_TIMED_DRIVES, training.recipe.evaluation.seed)
    return time_training(training.recipe, training.scenario, sample)


def state_of(folder: Path, row: Row) -> str:
    """How far a job is that is not finished, in a word."""
    return "begun" if RunDirectory(folder / RUNS / row.name).status.is_file() else "new"
