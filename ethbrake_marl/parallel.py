"""Independent calls, several at a time: joblib's processes of this machine, or a Ray; one thread each."""

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
_WORKERS = {  # environment of a Ray's processes: one thread each, in the folder of the command
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
    "RAY_CHDIR_TO_TRIAL_DIR": "0",
}
_DRIVER = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_raylet_start_wait_time_s": "300",  # much else may run here; Ray gives up after 30 s
    "RAY_AIR_NEW_OUTPUT": "0",
    "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",
    "TUNE_PRINT_ALL_TRIAL_ERRORS": "0",
}
_WATCH_S = 1.0
_AGAIN = 10  # times that a Ray begins a lost worker, and makes its call, anew
_ON_RAY = 16  # calls per core that are handed to a Ray together

Call = tuple[Callable[..., Any], *tuple[Any, ...]]  # a function that stands in a module, and its arguments


class WorkerLost(EthBrakeError):
    """A worker process ended in the middle of a call."""


def run_each(calls: Iterable[Call], jobs: int | None = None, ray: str | None = None) -> Iterator[Any]:
    """Give the result of each call, in the order of the calls, whatever order they end in.

    Args:
        calls: each is taken shortly before its turn.
        jobs: calls at a time; None: one, or as many as a Ray has cores. One call at a time runs in this process.
        ray: ``local``, a Ray of this machine alone, or the address of a cluster.

    Raises what a call raises, ``WorkerLost`` where a process is killed (a call that a node of a cluster loses is made
    again), ``MissingExtra`` without joblib or Ray, and ``InvalidInput`` where no cluster answers at the address.

    """
    if ray is None and jobs in (None, 1):
        for function, *given in calls:
            yield function(*given)
        return
    with naming_extras():
        from joblib import Parallel, delayed, parallel_config
        from joblib.externals.loky.process_executor import BrokenProcessPool
    work = (delayed(_answer)(pickle.dumps(call)) for call in calls)
    with _backend(ray, jobs) as (backend, at_once), _sigterm_as_ctrl_c():
        with parallel_config(**backend):
            parallel = Parallel(at_once, batch_size=1, return_as="generator" if ray is None else "list")
        if ray is not None:  # its backend gives lists
            while part := list(islice(work, _ON_RAY * at_once)):
                yield from parallel(part)
            return
        results = parallel(work)
        try:
            for result in results:  # noqa: UP028  # `yield from` would close them outside of what stands below
                yield result
        except BrokenProcessPool:
            raise WorkerLost("a worker process was killed, perhaps for memory; do fewer at once (--jobs)") from None
        finally:
            with warnings.catch_warnings(action="ignore"):  # of calls whose results nobody wants any more
                results.close()


def _answer(call: bytes) -> Any:
    """Make a call in a worker; what it prints is no result."""
    _end_with_parent()
    with redirect_stdout(sys.stderr):
        function, *given = pickle.loads(call)
        return function(*given)


@cache
def _end_with_parent() -> None:
    """A worker ends with the process that began it, also in the middle of a call."""

    def watch(parent: int) -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH_S)
        os._exit(1)

    threading.Thread(target=watch, args=(os.getppid(),), daemon=True).start()


@contextmanager
def _sigterm_as_ctrl_c() -> Iterator[None]:
    """Nothing of joblib is left behind when a signal ends the process, unless somebody else answers the signal."""
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
def _backend(ray: str | None, jobs: int | None) -> Iterator[tuple[dict[str, Any], int]]:
    """Joblib's backend with its settings, and how many calls are made at once."""
    if ray is None:
        yield {"backend": "loky", "inner_max_num_threads": 1}, jobs or 1
        return
    connected = connect_ray(ray, jobs)
    from ray.util.joblib import register_ray

    register_ray()
    try:
        # A worker that is lost begins anew, and its call is made again.
        again = {"num_cpus": 1, "max_restarts": _AGAIN, "max_task_retries": _AGAIN}
        yield {"backend": "ray", "ray_remote_args": again}, jobs or int(connected.cluster_resources().get("CPU", 1))
    finally:
        connected.shutdown()


def connect_ray(address: str, cores: int | None = None) -> Any:
    """Ray itself, connected.

    Args:
        address: of a cluster that runs, as Ray takes it, or ``local``: a Ray of this machine on loopback sockets,
            without a dashboard.
        cores: of the local one; None: all that this process may use.

    Raises ``MissingExtra`` without Ray, ``InvalidInput`` where there is no cluster at the address.

    """
    os.environ |= _DRIVER
    if address == LOCAL:
        # What Ray reads, once, when it is loaded: no cluster can be made of this, and 127.0.0.1 is its address. An
        # address that is given to ray.init would be changed to that of a network card.
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
    with naming_extras():
        import ray
    number = len(os.sched_getaffinity(0)) if cores is None else cores
    own = {"num_cpus": number, "include_dashboard": False} if address == LOCAL else {}
    try:
        ray.init(
            address=address, log_to_driver=False, configure_logging=False, runtime_env={"env_vars": _WORKERS}, **own
        )
    except Exception as error:  # where a Ray cannot start it raises just that
        raise InvalidInput(
            f"ray {address!r}: cannot be started, or no cluster can be reached there ({error})"
        ) from None
    return ray
