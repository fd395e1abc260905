"""Jobs: a folder in which each is done once, and where they run: processes of one thread each, here or on Ray."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from itertools import count
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ethbrake_marl.errors import (
    AlreadyExists,
    EthBrakeError,
    InvalidInput,
    OnProgress,
    Progress,
    describe_error,
    naming_extras,
    one_line,
    stop_on_signal,
)
from ethbrake_marl.evaluation import evaluate
from ethbrake_marl.files.plugins import load_the_same, noted_plugins
from ethbrake_marl.files.store import (
    check_writable,
    hold_lock,
    open_plain,
    parse_strict_json,
    read_object,
    remove_unfinished,
    write_file,
)
from ethbrake_marl.learning import RunDirectory, Training
from ethbrake_marl.physics import Worlds
from ethbrake_marl.scenario import Sample

if TYPE_CHECKING:
    from ethbrake_marl.learning import StopAt

# One job as every place runs it: a function and what it is given, as bytes, and what came of it.

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # of a worker


class Job(NamedTuple):
    """A piece of work: what it is called in its folder, a function that stands in a module, and what it is given.

    What the function gives is plain data; None where it was stopped before its end, and can go on.
    """

    name: str
    function: Callable[..., Any]
    given: tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class Answer:
    """What came of one attempt at a job."""

    value: Any = None  # None: it was stopped before its end, and can go on
    error: BaseException | None = None
    again: bool = False  # whether another attempt may end better
    wall_s: float = 0.0
    where: str = ""  # the process that did it


@dataclass(frozen=True, slots=True)
class Attempt:
    """One attempt at a job that has ended, and whether it was the last."""

    job: Job
    attempt: int  # from 1
    answer: Answer
    last: bool  # finished, or failed for good

    @property
    def reason(self) -> str:
        """Why it found nothing, in one line."""
        error = self.answer.error
        return one_line("was stopped from outside" if error is None else describe_error(error))


def answer(call: bytes, plugins: list[dict[str, str]]) -> Answer:
    """Do a job in a worker, after loading the plug-ins of the process that asks for it.

    An error of this package would come again; any other one may be of the machine.
    """
    started = time.monotonic()
    value, told, lasting = None, None, False
    try:
        load_the_same(plugins)
        function, given = pickle.loads(call)
        value = function(*given)
    except (Exception, SystemExit) as error:
        told, lasting = error, isinstance(error, EthBrakeError)
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:
            told = RuntimeError(describe_error(error))
    return Answer(value, told, value is None and not lasting, time.monotonic() - started, _process_name())


def _process_name(number: int | None = None) -> str:
    return f"{os.uname().nodename}, process {number or os.getpid()}"


def run_jobs(
    jobs: Iterable[Job], workers: Workers | int, on_attempt: Callable[[Attempt], None], *, retries: int = 2
) -> bool:
    """Run the jobs, in this order as far as there is room; False when Ctrl-C or SIGTERM stopped it.

    Running jobs are then asked to end and are waited for, and so they are when ``on_attempt`` raises.

    Args:
        jobs: each is taken when its turn has come.
        workers: where they run, not closed here; or how many processes of our own, 1: this one, where what a job raises
            is raised.
        on_attempt: is told every attempt that has ended.
        retries: further attempts at a job that was lost with its worker, or that failed by no error of this package.

    """
    if workers == 1:
        return _run_here(jobs, on_attempt)
    if isinstance(workers, int):
        with closing(LocalWorkers(workers)) as own:
            return run_jobs(jobs, own, on_attempt, retries=retries)
    running: dict[int, tuple[Job, int]] = {}
    try:
        with stop_on_signal() as asked:
            for ended in _attempts(jobs, workers, running, retries, asked):
                on_attempt(ended)
    except BaseException as error:
        workers.interrupt()
        while running:
            for number, answer in workers.wait():
                job, attempt = running.pop(number)
                if answer.value is not None:  # it has come to its end all the same
                    on_attempt(Attempt(job, attempt, answer, True))
        if isinstance(error, KeyboardInterrupt):
            return False
        raise
    return True


def _run_here(jobs: Iterable[Job], on_attempt: Callable[[Attempt], None]) -> bool:
    for job in jobs:
        started = time.monotonic()
        value = job.function(*job.given)
        if value is None:
            return False
        on_attempt(Attempt(job, 1, Answer(value, wall_s=time.monotonic() - started, where=_process_name()), True))
    return True


def _attempts(
    jobs: Iterable[Job], workers: Workers, running: dict[int, tuple[Job, int]], retries: int, asked: Callable[[], bool]
) -> Iterator[Attempt]:
    """Every attempt as it ends; ``running`` says at any time which jobs run, by number, with their attempts."""
    coming = enumerate((job, 1) for job in jobs)
    waiting, more = deque[tuple[int, tuple[Job, int]]](), True
    while more or waiting or running:
        if asked():
            raise KeyboardInterrupt
        while (more or waiting) and workers.room() > 0:
            number, begun = waiting.popleft() if waiting else next(coming, (-1, None))
            if begun is None:
                more = False
                continue
            workers.begin(number, pickle.dumps((begun[0].function, begun[0].given)))
            running[number] = begun
        ended = [(number, *running.pop(number), answer) for number, answer in workers.wait()] if more or running else []
        for number, job, attempt, answer in ended:
            again = answer.again and attempt <= retries
            if again:
                waiting.appendleft((number, (job, attempt + 1)))
            yield Attempt(job, attempt, answer, not again)


def each(take: Callable[[Job, Any], None]) -> Callable[[Attempt], None]:
    """Hands on what every job gives, and raises what one raises that fails for good."""

    def note(attempt: Attempt) -> None:
        if attempt.answer.value is not None:
            take(attempt.job, attempt.answer.value)
        elif attempt.last:
            raise attempt.answer.error or WorkerLost(f"{attempt.job.name}: {attempt.reason}")

    return note


class JobFolder:
    """A folder of jobs: it answers one question, one process at a time works in it, and what is finished is kept.

    Args:
        path: made when work begins.
        kind: what it holds, for messages.
        question: what every result in it depends on, as plain data; None: each job knows its own.
        record: name of the file with the question, and with what ``more`` adds to it when it is written.
        advice: what to do about a folder that answers another question.
        beside: names of what may be in a folder without a record; None: anything.

    """

    def __init__(
        self,
        path: Path,
        kind: str,
        question: Mapping[str, Any] | None = None,
        *,
        record: str = "question.json",
        more: Mapping[str, Any] | None = None,
        advice: str = "give another folder (--output)",
        beside: Collection[str] | None = None,
    ) -> None:
        self.path, self._kind, self._advice, self._beside = path, kind, advice, beside
        self._question: dict[str, Any] | None = None if question is None else json.loads(json.dumps(question))
        self._record, self._more = path / record, dict(more or {})
        self._journal = path / "journal.jsonl"

    def check(self) -> bool:
        """Whether no record of the question is there yet; makes nothing.

        Raises ``InvalidInput`` for what is no folder, cannot be written to, or answers another question, with what
        differs; ``AlreadyExists`` for a folder of something else.
        """
        there = next(each for each in (self.path, *self.path.absolute().parents) if each.exists())
        if not there.is_dir():
            raise InvalidInput(f"{self.path}: {there} is a file; give a folder of its own (--output)")
        try:
            check_writable(there)
        except OSError as error:
            raise InvalidInput(f"{self.path}: cannot be written to ({error.strerror}); {self._advice}") from None
        if self._question is None:
            if self._record.is_file():
                raise AlreadyExists(
                    f"{self.path}: is no folder of {self._kind}: {self._record.name} of another command is there;"
                    f" {self._advice}"
                )
            return True
        if not self._record.is_file():
            if (
                self._beside is not None
                and there == self.path
                and {e.name for e in there.iterdir()} - {*self._beside, _LOCK}
            ):
                raise AlreadyExists(f"{self.path}: is there already, and holds no {self._kind}; give another folder")
            return True
        try:
            kept = read_object(self._record)
        except InvalidInput as error:
            raise InvalidInput(f"{error}; {self._advice}") from None
        other = _differences({key: kept[key] for key in kept if key not in self._more}, self._question)
        if other:
            raise InvalidInput(
                f"{self.path}: holds {self._kind} with other settings ({'; '.join(other)}); {self._advice}"
            )
        return False

    @contextmanager
    def work(self) -> Iterator[None]:
        """Keep others out of the folder while the block runs; what killed writers left goes.

        Raises what ``check`` raises, and ``InvalidInput`` where another process works in it.
        """
        self.check()
        self.path.mkdir(parents=True, exist_ok=True)
        with hold_lock(self.path / _LOCK, "another process works in it; wait for it, or end it"):
            is_new = self.check()
            remove_unfinished(self.path)
            if is_new and self._question is not None:
                write_file(self._record, (json.dumps({**self._more, **self._question}, indent=2) + "\n").encode())
            yield

    def run(
        self, jobs: Iterable[Job], workers: Workers | int, on_attempt: Callable[[Attempt], None], *, retries: int = 2
    ) -> bool:
        """``run_jobs``, with a line of the journal for every attempt that has ended, on its way to the disk at once.

        What a finished job gave is told by ``kept`` from then on.
        """
        with self._journal.open("a+b", buffering=0) as journal:
            if journal.seek(0, os.SEEK_END):
                journal.seek(-1, os.SEEK_END)
                if journal.read() != b"\n":  # a writer was killed in the middle of a line
                    journal.write(b"\n")

            def note(attempt: Attempt) -> None:
                answer = attempt.answer
                status = "finished" if answer.value is not None else "failed" if attempt.last else "again"
                entry = {
                    "job": attempt.job.name,
                    "status": status,
                    "attempt": attempt.attempt,
                    "ended_utc": datetime.now(UTC).isoformat(timespec="milliseconds"),
                    "wall_s": round(answer.wall_s, 3),
                    "where": answer.where,
                }
                if answer.value is None:
                    entry["reason"] = attempt.reason
                else:
                    entry |= {"sha256": _sha256(answer.value), "found": answer.value}
                journal.write(json.dumps(entry).encode() + b"\n")
                on_attempt(attempt)

            return run_jobs(jobs, workers, note, retries=retries)

    def kept(self) -> tuple[dict[str, Any], int]:
        """What each finished job gave, by its name, and how many lines of the journal are damaged."""
        found: dict[str, Any] = {}
        damaged = 0
        if not self._journal.exists():
            return found, damaged
        with open_plain(self._journal, _LIMIT_BYTES, follow_links=False) as journal:
            for line in journal:
                try:
                    entry = parse_strict_json(line)
                    if entry["status"] == "finished":
                        if entry["sha256"] != _sha256(entry["found"]):
                            raise ValueError("is not what was written")
                        found[entry["job"]] = entry["found"]
                except (ValueError, TypeError, KeyError):
                    damaged += 1
        return found, damaged

    def train(self, trainings: Sequence[TrainingJob], processes: int = 1, tell: OnProgress | None = None) -> bool:
        """Bring every training to its end, ``processes`` at a time; False when Ctrl-C stopped it.

        The policies do not depend on ``processes`` or on interruptions. Raises, before any is begun, what
        ``steps_left`` raises, and what the first training raises that fails.
        """
        say, done = tell or (lambda progress: None), count(1)
        left = [training for training in trainings if training.steps_left()]
        if processes == 1 or len(left) < 2:
            jobs = [Job(one.folder.name, one.finish, (say,)) for one in left]
            return self.run(jobs, 1, lambda attempt: None)
        say(Progress("trainings", 0, len(left)))
        jobs = [Job(one.folder.name, one.finish, ()) for one in left]
        return self.run(jobs, processes, each(lambda job, found: say(Progress("trainings", next(done), len(left)))))

    def log(self, name: str) -> Path:
        """Where a job may print; absolute, for a worker may stand elsewhere."""
        (self.path / "logs").mkdir(exist_ok=True)
        return self.path.absolute() / "logs" / f"{name}.log"


_LOCK, _LIMIT_BYTES = ".lock", 4 << 30  # of a journal


def _sha256(found: Any) -> str:
    return hashlib.sha256(json.dumps(found, allow_nan=False).encode()).hexdigest()


def _differences(before: Mapping[str, Any], now: Mapping[str, Any], inside: str = "") -> list[str]:
    """What differs between two questions, in words; of lists and of what stands in one alone the name."""
    found: list[str] = []
    for name in dict.fromkeys([*now, *before]):
        old, new = before.get(name), now.get(name)
        told = f"{inside}{name.replace('_', '-')}"
        if isinstance(old, dict) and isinstance(new, dict):
            found += _differences(old, new, f"{told} ")
        elif old != new:
            plain = not isinstance(old, list | dict) and not isinstance(new, list | dict)
            found.append(f"{told} {old!s:.40}, here {new!s:.40}" if plain else told)
    return found


# Trainings as jobs: one that is finished is kept, one that is begun goes on; what it costs.


@dataclass(frozen=True, slots=True)
class TrainingJob:
    """A training and its folder."""

    training: Training
    folder: Path
    noted: tuple[str, ...] = ()  # by which scenario and recipe differ from their files, for ``config.json``

    @property
    def per_update(self) -> int:
        """Decisions of all learners between two updates."""
        return self.training.recipe.n_envs * len(self.training.scenario.learners) * self.training.recipe.rounds

    def steps_left(self) -> int:
        """Decisions that are still to do; raises ``InvalidInput`` for a folder that holds another training."""
        run, total = RunDirectory(self.folder), self.training.recipe.total_steps
        if not run.status.exists():
            if self.folder.exists():
                raise InvalidInput(f"{self.folder}: is no training; move it away, or give another --output")
            return total
        try:
            status = read_object(run.status)
        except InvalidInput as error:
            raise InvalidInput(f"{error}; delete its folder to train anew") from None
        run.check_same(self.training)
        if status.get("status") == "finished":
            return 0
        steps = status.get("steps", 0)
        return max(total - (steps if isinstance(steps, int) else 0), 1)

    def finish(self, tell: OnProgress | None = None, *, stop_at: StopAt | None = None) -> bool | None:
        """Bring it to its end; None where it was stopped before, by ``stop_at`` too, as ``train`` has it.

        Raises what ``train`` and ``resume`` raise.
        """
        from ethbrake_marl.learning import resume, train  # torch takes seconds to load

        def say(progress: Progress) -> None:
            if tell is not None:
                tell(replace(progress, name=self.folder.name))

        run, asked = RunDirectory(self.folder), self.training
        if run.is_finished:
            return True
        if run.status.is_file():
            ended = resume(self.folder, stop_at=stop_at, on_progress=say)
        else:
            self.folder.parent.mkdir(parents=True, exist_ok=True)
            ended = train(
                asked.recipe, asked.scenario, self.folder, settings=self.noted, stop_at=stop_at, on_progress=say
            )
        return True if ended.status == "finished" else None

    def time(self, sample: Sample | None = None) -> Timed:
        """Time a few updates, and the policy on the first worlds of ``sample``; None: of the recipe's list."""
        from ethbrake_marl.learning import train

        told: list[Progress] = []
        recipe, scenario = self.training.recipe, self.training.scenario
        short = recipe.replace(evaluation={**recipe.evaluation.model_dump(), "worlds": 10, "every_updates": 1000})
        with tempfile.TemporaryDirectory(prefix="ethbrake-") as folder:
            path = Path(folder) / "timed"
            train(short, scenario, path, steps=1)  # compiles and warms up
            train(short, scenario, path, steps=4 * self.per_update, force=True, on_progress=told.append)
            updates = [one for one in told if one.updates >= 1]
            last = updates[-1]
            first = updates[0] if updates[0].done < last.done else Progress("begun", 0, 0)
            decision_s = (last.wall_s - first.wall_s) / (last.done - first.done)
            worlds = scenario.sample(50, recipe.evaluation.seed) if sample is None else sample
            return Timed(self, decision_s, replace(self, folder=path).world_seconds(worlds))

    def world_seconds(self, sample: Sample) -> float:
        """Seconds per world that its team drives."""
        team = {"team": RunDirectory(self.folder).load_team(self.training.scenario)}
        drive = partial(evaluate, agents=team, scenario=self.training.scenario, aftermath=False)
        return Timed.each_s(sample.worlds, drive)


class Timed(NamedTuple):
    """Seconds of one core, by the clock, that a training takes."""

    job: TrainingJob
    decision_s: float  # of a learner, its share of the learning included
    world_s: float  # that the policy drives

    def seconds(self, steps: int) -> float:
        """Of ``steps`` decisions, of as many trainings as they make, with what is measured on the way.

        A training measures its policies on the fixed list at first, now and then, and at the end.
        """
        recipe = self.job.training.recipe
        times = recipe.total_steps // self.job.per_update // recipe.evaluation.every_updates + 2
        return steps * self.decision_s + steps / recipe.total_steps * times * recipe.evaluation.worlds * self.world_s

    @staticmethod
    def each_s(worlds: Worlds, work: Callable[[Worlds], object], most: int = 50) -> float:
        """Seconds per world of some work on at most so many, which one world has done before: it compiles."""
        work(worlds.take([0]))
        some, started = worlds.take(range(min(worlds.n, most))), time.monotonic()
        work(some)
        return (time.monotonic() - started) / some.n

    @staticmethod
    def in_words(seconds: float) -> str:
        """Seconds, minutes or hours."""
        if seconds < 90.0:
            return f"{seconds:.0f} s"
        return f"{seconds / 60.0:.0f} min" if seconds < 36_000.0 else f"{seconds / 3600.0:.0f} h"


# Processes of this machine.

_WAIT_S = 1.0


class WorkerLost(EthBrakeError):
    """A worker ended in the middle of a job."""


@dataclass(slots=True)
class _Worker:
    """A process, the pipe to it, and the job it does."""

    process: BaseProcess
    pipe: Connection
    job: int | None = None


class LocalWorkers:
    """Up to ``number`` processes, which are begun when there is work for them; a lost one is replaced."""

    def __init__(self, number: int) -> None:
        self._number, self._plugins = number, noted_plugins()
        self._workers: list[_Worker] = []
        self._interrupted = False
        load_the_same(self._plugins)  # a file that was changed since is told here, in one line

    def room(self) -> int:
        """How many more jobs can be begun now: processes without one, those that are not begun yet among them."""
        return self._number - sum(worker.job is not None for worker in self._workers)

    def begin(self, number: int, call: bytes) -> None:
        """Begin a job, known by its number from then on: its pickled function and what that is given.

        A process that has ended in the meantime is told by ``wait``.
        """
        worker = next((one for one in self._workers if one.job is None), None) or self._add_worker()
        worker.job = number
        try:
            worker.pipe.send_bytes(call)
        except OSError:
            worker.process.join(_WAIT_S)

    def wait(self) -> list[tuple[int, Answer]]:
        """The jobs that have ended since; waits for one, but no longer than about a second.

        Of a process that was lost there is an answer that says how.
        """
        by_pipe = {worker.pipe: worker for worker in self._workers}
        found = []
        for pipe in wait(list(by_pipe), _WAIT_S):
            worker = by_pipe[pipe]  # type: ignore[index]  # only pipes were given
            job = worker.job
            try:
                told, worker.job = worker.pipe.recv(), None
            except (EOFError, OSError):
                told = self._bury(worker)
            if job is not None:
                found.append((job, told))
        return found

    def interrupt(self) -> None:
        """Ask every running job to end soon and to keep what it has, once: a training ends after its update."""
        if not self._interrupted:
            self._interrupted = True
            for worker in self._workers:
                worker.process.terminate()

    def close(self) -> None:
        """End all processes; one that is in the middle of a job is killed."""
        for worker in self._workers:
            if worker.job is not None:
                worker.process.kill()
            worker.pipe.close()  # what an idle one waits for
        for worker in self._workers:
            worker.process.join()
        self._workers = []

    def _add_worker(self) -> _Worker:
        spawn = get_context("spawn")
        ours, theirs = spawn.Pipe()
        process = spawn.Process(target=_serve, args=(theirs, self._plugins), daemon=True)
        with _one_thread():
            process.start()
        theirs.close()  # so that our end is told when the process ends
        worker = _Worker(process, ours)
        self._workers.append(worker)
        return worker

    def _bury(self, worker: _Worker) -> Answer:
        worker.process.join()
        self._workers.remove(worker)
        worker.pipe.close()
        ended = worker.process.exitcode or 0
        how = f"was killed by signal {-ended}" if ended < 0 else f"ended with status {ended}"
        told = WorkerLost(f"the worker {how} in the middle of the job")
        return Answer(None, told, True, 0.0, _process_name(worker.process.pid))


@contextmanager
def _one_thread() -> Iterator[None]:
    """Processes that are begun inside have one thread each: numerical libraries look once, when they are loaded."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _serve(pipe: Connection, plugins: list[dict[str, str]]) -> None:
    """Do jobs until nobody asks for any more. Ctrl-C is left to the parent, and the end of the parent is ours."""
    os.setpgrp()
    parent = parent_process()
    assert parent is not None
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    while True:
        try:
            call = pipe.recv_bytes()
        except (EOFError, OSError):
            return
        pipe.send(answer(call, plugins))


def _end_with(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)


# A Ray cluster, or a Ray of this machine alone that nobody else can reach.

_LOCAL = "local"


class RayWorkers:
    """The cores of a cluster, a job each; Ray itself never repeats one.

    Args:
        address: of a running cluster, as Ray takes it, or ``local``: a Ray of this machine on loopback sockets, without
            a dashboard, which ends with ``close``.
        number: cores of the local one; of a cluster jobs at once at most, None: as many as it has cores.

    Raises ``MissingExtra`` without Ray, ``InvalidInput`` where there is no cluster at the address.

    """

    def __init__(self, address: str, number: int | None = None) -> None:
        plugins = noted_plugins()
        load_the_same(plugins)  # a file that was changed since is told here, in one line
        self._plugins = [  # files by paths that workers elsewhere understand
            {**each, "source": str(Path(each["source"]).absolute())}
            if each["source"].endswith(".py") or os.sep in each["source"]
            else each
            for each in plugins
        ]
        self._ray = _connect(address, number)
        self._most = number if number is not None and address != _LOCAL else None
        self._do = self._ray.remote(num_cpus=1, max_retries=0, max_calls=0)(answer)
        self._running: dict[Any, int] = {}
        self._cores, self._looked = 0, float("-inf")

    def room(self) -> int:
        """So many that no core has to wait for us, however many join the cluster or leave it."""
        if time.monotonic() - self._looked > 10.0:
            self._cores, self._looked = int(self._ray.cluster_resources().get("CPU", 0)), time.monotonic()
        most = 2 * self._cores if self._most is None else self._most  # on each core one runs, one waits
        return most - len(self._running)

    def begin(self, number: int, call: bytes) -> None:
        """Hand a job to Ray, which runs it when a core is free."""
        self._running[self._do.remote(call, self._plugins)] = number

    def wait(self) -> list[tuple[int, Answer]]:
        """What came back; a job that was lost with its worker or computer may be tried again."""
        if not self._running:
            time.sleep(_WAIT_S)  # a cluster without a core: one may join
            return []
        ended, _ = self._ray.wait(list(self._running), num_returns=1, timeout=_WAIT_S)
        return [(self._running.pop(reference), self._take(reference)) for reference in ended]

    def interrupt(self) -> None:
        """Pass Ctrl-C on: a training ends after its update, with a checkpoint; what waits is not begun."""
        for reference in self._running:
            self._ray.cancel(reference, force=False)

    def close(self) -> None:
        """Leave the cluster, which ends what still runs for us; a local one ends."""
        self._ray.shutdown()

    def _take(self, reference: Any) -> Answer:
        lasting = (self._ray.exceptions.RuntimeEnvSetupError, self._ray.exceptions.AuthenticationError)
        try:
            found = self._ray.get(reference)
        except self._ray.exceptions.RayTaskError as error:  # the package could not even be loaded there
            return Answer(None, InvalidInput(f"a worker of the cluster cannot do the job: {error.cause!r}"))
        except lasting as error:
            return Answer(None, InvalidInput(f"the cluster refuses the job: {error}"))
        except self._ray.exceptions.RayError as error:
            return Answer(
                None, WorkerLost(f"the worker was lost in the middle of the job ({type(error).__name__})"), True
            )
        assert isinstance(found, Answer)
        return found


def _connect(address: str, number: int | None) -> Any:
    """Ray itself, connected."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if address == _LOCAL:
        # What Ray reads, once, when it is loaded: no cluster can be made of this, and 127.0.0.1 is its address. An
        # address that is given to ray.init would be changed to that of a network card.
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
    with naming_extras():
        import ray
        import ray.exceptions
    quiet = {"log_to_driver": False, "configure_logging": False, "runtime_env": {"env_vars": ONE_THREAD}}
    if address == _LOCAL:
        ray.init(address=_LOCAL, num_cpus=number, include_dashboard=False, **quiet)
        return ray
    try:
        ray.init(address=address, **quiet)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise InvalidInput(f"ray {address!r}: no cluster can be reached there ({error})") from None
    return ray


Workers = LocalWorkers | RayWorkers  # where jobs run, several at a time


def open_workers(ray: str | None, jobs: int | None) -> Workers:
    """Where jobs run: processes of this machine, or a Ray; ``jobs`` at once, by default on every usable core.

    On a cluster None leaves the number to it.
    """
    number = len(os.sched_getaffinity(0)) if jobs is None else jobs
    if ray is None:
        return LocalWorkers(number)
    return RayWorkers(ray, number if ray == _LOCAL else jobs)
