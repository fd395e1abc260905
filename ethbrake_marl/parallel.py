"""Run independent function calls in parallel, in joblib's processes on this machine or on Ray, with one thread each."""

from __future__ import annotations

import os
import pickle
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, redirect_stdout
from functools import cache
from itertools import islice
from typing import Any

from ethbrake_marl.errors import EthBrakeError, InvalidInput, naming_extras

LOCAL = "local"
_WORKERS = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # one thread each
_DRIVER = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_raylet_start_wait_time_s": "300",  # the machine may be busy; by default Ray gives up after 30 s
}
_WATCH_S = 1.0
_AGAIN = 10  # how often Ray restarts a lost worker and repeats its call
_ON_RAY = 16  # calls per core in one batch for Ray

Call = tuple[Callable[..., Any], *tuple[Any, ...]]  # a module-level function and its arguments


class WorkerLost(EthBrakeError):
    """A worker process was killed during a call."""


def run_each(calls: Iterable[Call], jobs: int | None = None, ray: str | None = None) -> Iterator[Any]:
    """Run function calls in parallel and yield their results in the order of the calls.

    Args:
        calls: tuples (function, argument, ...) with module-level functions. From a generator, each tuple is taken
            shortly before the call starts.
        jobs: number of calls that run at once; None: 1 without Ray, and the number of cores with Ray. With one call at
            a time and without Ray, the calls run in this process.
        ray: ``local`` to start Ray on this machine, or the address of a Ray cluster; None: the calls run in processes
            of joblib.

    Raises the error that a call raised, or ``WorkerLost`` if a worker process of joblib is killed (Ray repeats the call
    instead). Raises ``MissingExtra`` if joblib or Ray is not installed, and ``InvalidInput`` if no cluster answers at
    the address ``ray``, or if a call cannot be pickled.

    """
    if ray is None and jobs in (None, 1):
        for function, *arguments in calls:
            yield function(*arguments)
        return
    from cloudpickle import dumps

    with naming_extras():
        from joblib import Parallel, delayed, parallel_config
        from joblib.externals.loky.process_executor import BrokenProcessPool

    def pickled(call: Call) -> bytes:
        try:
            return bytes(dumps(call))
        except Exception as error:
            raise InvalidInput(f"this cannot be sent to another process ({error}); use one process (jobs=1)") from error

    work = (delayed(_answer)(pickled(call)) for call in calls)
    with _backend(ray, jobs) as (backend, at_once), _sigterm_as_ctrl_c():
        with parallel_config(**backend):
            parallel = Parallel(at_once, batch_size=1, return_as="generator" if ray is None else "list")
        if ray is not None:  # joblib's Ray backend returns lists
            while part := list(islice(work, _ON_RAY * at_once)):
                yield from parallel(part)
            return
        results = parallel(work)
        try:
            for result in results:  # noqa: UP028  # `yield from` would close `results` outside the except clause below
                yield result
        except BrokenProcessPool:
            raise WorkerLost(
                "a worker process was killed, perhaps because memory ran out; use fewer processes at once (--jobs)"
            ) from None
        finally:
            with warnings.catch_warnings(action="ignore"):  # warnings about calls that are cancelled
                results.close()


def _answer(call: bytes) -> Any:
    """Run the pickled call ``(function, argument, ...)`` in a worker and return its result; printed text goes to
    stderr.
    """
    _end_with_parent()
    with redirect_stdout(sys.stderr):
        function, *arguments = pickle.loads(call)
        return function(*arguments)


@cache
def _end_with_parent() -> None:
    """Make this worker process exit when its parent process ends, even in the middle of a call."""

    def watch(parent: int) -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH_S)
        os._exit(1)

    threading.Thread(target=watch, args=(os.getppid(),), daemon=True).start()


@contextmanager
def _sigterm_as_ctrl_c() -> Iterator[None]:
    """Context manager: handle SIGTERM like Ctrl-C, so that joblib cleans up, unless SIGTERM already has a handler."""
    before = signal.getsignal(signal.SIGTERM)
    if threading.current_thread() is not threading.main_thread() or before is not signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def _own_signals() -> Iterator[None]:
    """Context manager: restore the caller's handlers of Ctrl-C and SIGTERM after the block, because Ray sets its own.

    Outside the main thread, where no handler can be set, this function does nothing.
    """
    in_main = threading.current_thread() is threading.main_thread()
    numbers = (signal.SIGINT, signal.SIGTERM) if in_main else ()
    before = {number: signal.getsignal(number) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            if handler is not None:  # None: C code set the handler, so Python cannot restore it
                signal.signal(number, handler)  # even if Python sees no change: Ray sets some handlers in C


@contextmanager
def _backend(ray: str | None, jobs: int | None) -> Iterator[tuple[dict[str, Any], int]]:
    """Context manager: start joblib's backend; yield its settings and the number of calls that run at once."""
    if ray is None:
        yield {"backend": "loky", "inner_max_num_threads": 1}, jobs or 1
        return
    with _own_signals():
        connected = _connect_ray(ray, jobs)
        from ray.util.joblib import register_ray

        register_ray()
        try:
            # Ray restarts a lost worker and repeats its call.
            again = {"num_cpus": 1, "max_restarts": _AGAIN, "max_task_retries": _AGAIN}
            yield {"backend": "ray", "ray_remote_args": again}, jobs or int(connected.cluster_resources().get("CPU", 1))
        finally:
            connected.shutdown()


def _connect_ray(address: str, cores: int | None = None) -> Any:
    """Connect to Ray and return the module ``ray``.

    ``address`` is the address of a running cluster in Ray's own format, or ``local`` to start Ray on this machine, on
    loopback sockets and without a dashboard. ``cores`` is the number of cores for ``local``; None: all cores that this
    process may use.

    Raises ``MissingExtra`` if Ray is not installed, and ``InvalidInput`` if Ray cannot be started or no cluster answers
    at the address.
    """
    os.environ |= _DRIVER
    if address == LOCAL:
        # Ray reads this once, when it is imported. With "0" it uses 127.0.0.1 and other machines cannot join. Ray
        # would replace an address that is passed to ray.init by the address of a network card.
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
    with naming_extras():
        import ray
    number = len(os.sched_getaffinity(0)) if cores is None else cores
    own = {"num_cpus": number, "include_dashboard": False} if address == LOCAL else {}
    try:
        with _own_signals():
            ray.init(
                address=address, log_to_driver=False, configure_logging=False, runtime_env={"env_vars": _WORKERS}, **own
            )
    except Exception as error:  # Ray raises a plain Exception if it cannot start
        raise InvalidInput(
            f"ray {address!r}: Ray cannot be started, or no cluster answers at this address ({error})"
        ) from None
    return ray
