"""Runs independent function calls in parallel processes with one thread each, by joblib."""

from __future__ import annotations

import os
import pickle
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import redirect_stdout
from functools import cache
from itertools import islice
from typing import Any

from ethbrake_marl.errors import EthBrakeError, InvalidInput, naming_extras

WATCH_S = 1.0
PER_PROCESS = 16  # calls in one batch for a backend that returns the results of a batch all at once

Call = tuple[Callable[..., Any], *tuple[Any, ...]]  # a module-level function and its arguments


class WorkerLost(EthBrakeError):
    """A worker process was killed during a call."""


def run_each(calls: Iterable[Call], jobs: int | None = None) -> Iterator[Any]:
    """Run function calls in parallel; yield their results in the order of the calls.

    Inside ``joblib.parallel_config(backend=...)`` that backend runs them, for instance on a Ray cluster.

    Args:
        calls: tuples (function, argument, ...) with module-level functions. A generator is read shortly before the
            calls start.
        jobs: number of calls that run at once; None or 1: one after the other, in this process.

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
    one_thread = {"backend": backend, "inner_max_num_threads": 1} if backend.supports_inner_max_num_threads else {}
    with parallel_config(**one_thread):
        parallel = Parallel(jobs, batch_size=1, return_as="generator" if streams else "list")
    work = (delayed(_answer)(os.getpid(), _pickle_call(call)) for call in calls)
    batches = [work] if streams else iter(lambda: list(islice(work, PER_PROCESS * jobs)), [])
    for batch in batches:
        results: Any = ()
        try:
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


def _pickle_call(call: Call) -> bytes:
    from cloudpickle import dumps  # which also takes what a user's file or a notebook defines

    try:
        return bytes(dumps(call))
    except Exception as error:
        raise InvalidInput(f"this cannot be sent to another process ({error}); use one process (jobs=1)") from error


def _answer(caller: int, call: bytes) -> Any:
    """Result of a pickled call, whose prints go to stderr. A process other than ``caller`` (an id) becomes a worker."""
    if os.getpid() != caller:
        _become_worker()
    with redirect_stdout(sys.stderr):
        function, *arguments = pickle.loads(call)
        return function(*arguments)


@cache
def _become_worker() -> None:
    """Make this process a worker: ignore Ctrl-C (calls may still listen to it), and exit when the parent ends."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        if hasattr(signal, "pthread_sigmask"):
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})

    def watch(parent: int) -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_S)
        os._exit(1)

    threading.Thread(target=watch, args=(os.getppid(),), daemon=True).start()
