"""A Ray to work on: one of this machine alone, or a cluster that runs."""

from __future__ import annotations

import logging
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ethbrake_marl.errors import InvalidInput, naming_extras

LOCAL = "local"
_WORKERS = {  # environment of the processes: one thread each, in the folder of the command
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
_SILENT = ("ray.tune.tune", "ray.tune.analysis.experiment_analysis")  # they advise Tuner.restore


@contextmanager
def connected(address: str, cores: int | None) -> Iterator[None]:
    """Ray, while the block runs, in which SIGTERM is Ctrl-C.

    Args:
        address: of a cluster that runs, as Ray takes it, or ``local``: a Ray of this machine on loopback sockets,
            without a dashboard, which ends with the block.
        cores: of the local one; None: all of this machine.

    Raises ``MissingExtra`` without Ray, ``InvalidInput`` where there is no cluster at the address.

    """
    os.environ |= _DRIVER
    if address == LOCAL:
        # What Ray reads, once, when it is loaded: no cluster can be made of this, and 127.0.0.1 is its address. An
        # address that is given to ray.init would be changed to that of a network card.
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
    with naming_extras():
        import ray
    for name in _SILENT:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    more: dict[str, Any] = {"num_cpus": cores, "include_dashboard": False} if address == LOCAL else {}
    try:
        ray.init(
            address=address, log_to_driver=False, configure_logging=False, runtime_env={"env_vars": _WORKERS}, **more
        )
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise InvalidInput(f"ray {address!r}: no cluster can be reached there ({error})") from None
    in_main = threading.current_thread() is threading.main_thread()  # no other may set a handler
    before = in_main and signal.signal(signal.SIGTERM, lambda number, frame: signal.raise_signal(signal.SIGINT))
    try:
        yield
    finally:
        if in_main:
            signal.signal(signal.SIGTERM, before)
        ray.shutdown()
