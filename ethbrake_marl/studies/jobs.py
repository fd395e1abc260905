"""Jobs in processes of this machine, with one thread each."""

from __future__ import annotations

import os
import pickle
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Protocol

from ethbrake_marl.errors import EthBrakeError, InvalidInput, OnProgress, Progress, describe_error
from ethbrake_marl.evaluation.inputs import load_runnable
from ethbrake_marl.files.plugins import Plugin, load_the_same, loaded_plugins
from ethbrake_marl.learning.recipe import TrainingRecipe, load_recipe, read_settings
from ethbrake_marl.learning.training import stop_on_signal
from ethbrake_marl.scenario import Scenario, load_scenario

# One job as every place runs it: a function and what it is given, as bytes, and what came of it.

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # of a worker


@dataclass(frozen=True, slots=True)
class Answer:
    """What came of one attempt at a job."""

    value: Any = None  # None: it was stopped before its end, and can go on
    error: BaseException | None = None
    again: bool = False  # whether another attempt may end better
    wall_s: float = 0.0
    where: str = ""  # the process that did it


class Workers(Protocol):
    """Where jobs run, several at a time."""

    def room(self) -> int:
        """How many more jobs can be begun now."""

    def begin(self, number: int, call: bytes) -> None:
        """Begin a job, which is known by its number from then on."""

    def wait(self) -> list[tuple[int, Answer]]:
        """The jobs that have ended since; waits for one, but no longer than about a second."""

    def interrupt(self) -> None:
        """Ask every running job to end soon and to keep what it has; none waits for its turn any more."""

    def close(self) -> None:
        """End all workers, whatever they do."""


def pack(function: Callable[..., Any], *given: Any) -> bytes:
    """A call as bytes; the function stands in a module."""
    return pickle.dumps((function, given))


def answer(call: bytes, plugins: Sequence[Plugin], where: str) -> Answer:
    """Do a job in a worker, after loading the plug-ins of the process that asks for it.

    An error of this package would come again; any other one may be of the machine.
    """
    started = time.monotonic()
    try:
        load_the_same(plugins)
        function, given = pickle.loads(call)
        value = function(*given)
    except (Exception, SystemExit) as error:
        lasting = isinstance(error, EthBrakeError)
        return Answer(None, _sendable(error), not lasting, time.monotonic() - started, where)
    return Answer(value, None, value is None, time.monotonic() - started, where)


def process_name() -> str:
    """Computer and number of this process, for a log."""
    return f"{os.uname().nodename}, process {os.getpid()}"


def _sendable(error: BaseException) -> BaseException:
    """The error, or its text where it cannot be sent."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(describe_error(error))
    return error


# Run jobs wherever there is room, and try again what was lost, so and so often.

RETRIES = 2  # further attempts at a job whose worker was lost


@dataclass(frozen=True, slots=True)
class Attempt:
    """One attempt at a job that has ended, and whether it was the last."""

    number: int  # of the job
    attempt: int  # from 1
    answer: Answer
    last: bool  # finished, or failed for good


def run_jobs(
    call_of: Callable[[int], bytes],
    jobs: int,
    workers: Workers,
    on_attempt: Callable[[Attempt], None],
    *,
    retries: int = RETRIES,
) -> bool:
    """Run the jobs 0 to ``jobs - 1``, in this order as far as there is room; False when Ctrl-C or SIGTERM stopped it.

    Running jobs are then asked to end and are waited for, and so they are when ``on_attempt`` raises.

    Args:
        call_of: makes a job's call, when its turn has come.
        jobs: how many there are.
        workers: where they run; not closed here.
        on_attempt: is told every attempt that has ended.
        retries: further attempts at a job that was lost with its worker, or that failed by no error of this package.

    """
    waiting, running, attempts = deque(range(jobs)), set[int](), dict[int, int]()
    try:
        with stop_on_signal() as asked:
            while waiting or running:
                if asked():
                    raise KeyboardInterrupt
                while waiting and workers.room() > 0:
                    number = waiting.popleft()
                    attempts[number] = attempts.get(number, 0) + 1
                    workers.begin(number, call_of(number))
                    running.add(number)
                for number, answer in workers.wait():
                    running.discard(number)
                    again = answer.again and attempts[number] <= retries
                    if again:
                        waiting.appendleft(number)
                    on_attempt(Attempt(number, attempts[number], answer, not again))
                    if not again:
                        del attempts[number]
    except BaseException as error:
        _stop(running, workers, on_attempt, attempts)
        if isinstance(error, KeyboardInterrupt):
            return False
        raise
    return True


def _stop(running: set[int], workers: Workers, on_attempt: Callable[[Attempt], None], attempts: dict[int, int]) -> None:
    """Ask what runs to end, and wait for it; what has come to its end all the same is told."""
    workers.interrupt()
    while running:
        for number, answer in workers.wait():
            running.discard(number)
            if answer.value is not None:
                on_attempt(Attempt(number, attempts[number], answer, True))


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
        self._number, self._plugins = number, loaded_plugins()
        self._workers: list[_Worker] = []
        self._interrupted = False
        load_the_same(self._plugins)  # a file that was changed since is told here, in one line

    def room(self) -> int:
        """Processes without a job, those that are not begun yet among them."""
        return self._number - sum(worker.job is not None for worker in self._workers)

    def begin(self, number: int, call: bytes) -> None:
        """Give the job to a process; one that has ended in the meantime is told by ``wait``."""
        worker = next((one for one in self._workers if one.job is None), None) or self._add_worker()
        worker.job = number
        try:
            worker.pipe.send_bytes(call)
        except OSError:
            worker.process.join(_WAIT_S)

    def wait(self) -> list[tuple[int, Answer]]:
        """What the processes answer; of one that was lost an answer that says how."""
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
        """Pass Ctrl-C on, once: a training ends after its update, with a checkpoint."""
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
        where = f"{os.uname().nodename}, process {worker.process.pid}"
        return Answer(None, WorkerLost(f"the worker {how} in the middle of the job"), True, 0.0, where)


def run_all(
    call_of: Callable[[int], bytes], jobs: int, processes: int, name: str, tell: OnProgress
) -> list[Any] | None:
    """What every job gives, in their order; None when Ctrl-C stopped it. Raises what the first job raises that fails.

    ``name`` is what they are called together to who is told.
    """
    found: list[Any] = [None] * jobs
    done = 0
    tell(Progress(name, done, jobs))

    def note(attempt: Attempt) -> None:
        nonlocal done
        if not attempt.last:
            return
        if attempt.answer.error is not None:
            raise attempt.answer.error
        found[attempt.number] = attempt.answer.value
        done += 1
        tell(Progress(name, done, jobs))

    with closing(LocalWorkers(processes)) as workers:
        return found if run_jobs(call_of, jobs, workers, note) else None


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


def _serve(pipe: Connection, plugins: Sequence[Plugin]) -> None:
    """Do jobs until nobody asks for any more. Ctrl-C is left to the parent, and the end of the parent is ours."""
    os.setpgrp()
    parent = parent_process()
    assert parent is not None
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    where = process_name()
    while True:
        try:
            call = pipe.recv_bytes()
        except (EOFError, OSError):
            return
        pipe.send(answer(call, plugins, where))


def _end_with(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)


# Scenario and recipe of a job that a file asks for, and which part of it a refusal is about.


def load_parts(scenario: str, recipe: str, settings: Sequence[str]) -> tuple[Scenario, TrainingRecipe]:
    """Scenario and recipe, each a name or a path, with the settings ``KEY=VALUE`` in them.

    Raises ``InvalidInput`` for what is not known, and for a value that is not allowed.
    """
    loaded = load_recipe(recipe)
    given = read_settings(settings, [loaded])
    return load_runnable(scenario, given.scenario), given.change(loaded)


def refused_part(scenario: str, recipe: str, settings: Sequence[str]) -> str:
    """The part that is refused by itself where ``load_parts`` refuses: ``recipe``, ``scenario`` or a setting's key.

    Empty where each by itself is in order.
    """
    tried: dict[str, Callable[[], object]] = {
        "recipe": partial(load_recipe, recipe),
        "scenario": partial(load_scenario, scenario),
        **{text.partition("=")[0]: partial(load_parts, scenario, recipe, (text,)) for text in settings},
    }
    for part, load in tried.items():
        try:
            load()
        except InvalidInput:
            return part
    return ""
