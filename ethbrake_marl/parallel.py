"""How many cores a computation uses; and independent function calls in parallel processes, by joblib.

Everything runs on one core unless the caller asks for more: for processes (``jobs``), or for threads in each of them
(``threads``, or the environment variable ``ETHBRAKE_THREADS``). Both together never use more cores than there are.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext, redirect_stdout
from functools import cache
from itertools import islice
from typing import Any

from ethbrake_marl.errors import EthBrakeError, InvalidInput, check_whole_number, naming_extras

VARIABLE = "ETHBRAKE_THREADS"  # environment variable: number of threads where the caller sets none
MOST_THREADS = 1024
WATCH_S = 1.0
PER_PROCESS = 16  # calls in one batch for a backend that returns the results of a batch all at once

Call = tuple[Callable[..., Any], *tuple[Any, ...]]  # a module-level function and its arguments

PREPARATIONS: dict[str, Call] = {}  # name -> call that a worker process makes before those that it is sent
_SHARES: dict[int, int] = {}  # process -> cores that it may use, if it is a worker


class WorkerLost(EthBrakeError):
    """A worker process was killed during a call."""


def usable_cores() -> int:
    """All that the machine offers, or a worker's share of them."""
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return _SHARES.get(os.getpid(), available)


def chosen_threads(threads: int | None) -> int:
    """None: the environment variable ``ETHBRAKE_THREADS``, or 1.

    At most ``usable_cores``. Raises ``InvalidInput`` unless it is a whole number from 1 to 1024.
    """
    if threads is None:
        text = os.environ.get(VARIABLE, "1")
        if not (text.isascii() and text.isdecimal() and len(text) < 5 and 1 <= int(text) <= MOST_THREADS):
            raise InvalidInput(f"{VARIABLE} = {text!r:.60}: must be a whole number from 1 to {MOST_THREADS}")
        threads = int(text)
    check_whole_number("threads", threads, 1, MOST_THREADS)
    return min(int(threads), usable_cores())


def run_each(calls: Iterable[Call], jobs: int | None = None) -> Iterator[Any]:
    """Run function calls in parallel; yield their results in the order of the calls.

    Inside ``joblib.parallel_config(backend=...)`` that backend runs them, for instance on a Ray cluster.

    Args:
        calls: tuples (function, argument, ...) with module-level functions. A generator is read shortly before the
            calls start.
        jobs: number of calls that run at once, at most ``usable_cores`` on this machine; None or 1: one after the
            other, in this process.

    Raises the error of a call, ``WorkerLost`` if a process is killed, ``InvalidInput`` if a call cannot be pickled, and
    ``MissingExtra`` without joblib.

    """
    if jobs in (None, 1):
        for function, *arguments in calls:
            yield function(*arguments)
        return

    from concurrent.futures.process import BrokenProcessPool

    with naming_extras():
        from joblib import Parallel, delayed, parallel_config
        from joblib.parallel import get_active_backend
    backend = get_active_backend()[0]
    streams = backend.supports_return_generator
    one_thread, share = {}, 1
    if backend.supports_inner_max_num_threads:  # joblib's own processes on this machine
        one_thread = {"backend": backend, "inner_max_num_threads": 1}
        cores = usable_cores()
        jobs = min(jobs, cores)
        share = cores // jobs
    with parallel_config(**one_thread):
        parallel = Parallel(jobs, batch_size=1, return_as="generator" if streams else "list")
    first = [_pickle_call(call) for call in PREPARATIONS.values()]
    work = (delayed(_answer)(os.getpid(), share, first, _pickle_call(call)) for call in calls)
    batches = [work] if streams else iter(lambda: list(islice(work, PER_PROCESS * jobs)), [])
    for batch in batches:
        results: Any = ()
        try:
            with _interrupts_ignored() if streams else nullcontext():  # also by the processes that start
                results = parallel(batch)
            for result in results:  # noqa: UP028  # `yield from` would close `results` outside the clause below
                yield result
        except BrokenProcessPool:
            raise WorkerLost(
                "a worker process was killed, perhaps because memory ran out; use fewer processes at once (--jobs)"
            ) from None
        finally:
            with warnings.catch_warnings(action="ignore"):  # warnings about calls that are cancelled
                getattr(results, "close", list)()


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Context in which Ctrl-C has no effect. Processes that start here ignore it until they end."""
    if threading.current_thread() is not threading.main_thread():  # Python lets only this one choose
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _pickle_call(call: Call) -> bytes:
    from cloudpickle import dumps  # which also takes what a user's file or a notebook defines

    try:
        return bytes(dumps(call))
    except Exception as error:
        raise InvalidInput(f"this cannot be sent to another process ({error}); use one process (jobs=1)") from error


def _answer(caller: int, share: int, first: list[bytes], call: bytes) -> Any:
    """A process other than ``caller`` (an id) becomes a worker, which may use ``share`` cores. It makes the calls
    ``first`` before this one.
    """
    with redirect_stdout(sys.stderr):
        if os.getpid() != caller:
            _become_worker()
            _SHARES[os.getpid()] = share
            for preparation in first:
                _make(preparation)
        return _make(call)


def _make(call: bytes) -> Any:
    function, *arguments = pickle.loads(call)
    return function(*arguments)


@cache
def _become_worker() -> None:
    """Ignore Ctrl-C (calls may still listen to it), and exit when the parent ends."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch(parent: int) -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_S)
        os._exit(1)

    threading.Thread(target=watch, args=(os.getppid(),), daemon=True).start()
