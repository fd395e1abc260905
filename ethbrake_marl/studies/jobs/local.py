"""Jobs in processes of this machine, with one thread each."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from ethbrake_marl.errors import EthBrakeError
from ethbrake_marl.files.plugins import Plugin, load_the_same, loaded_plugins
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.studies.jobs.run import Attempt, run_jobs
from ethbrake_marl.studies.jobs.work import ONE_THREAD, Answer, answer, process_name

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
