"""Connect to Ray while a study works: on this machine, or on a running cluster."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from ethbrake_marl.parallel import connect_ray, own_signals

_SILENT = ("ray.tune.tune", "ray.tune.analysis.experiment_analysis")  # they advise Tuner.restore, which is not used


@contextmanager
def connected(address: str, cores: int | None) -> Iterator[None]:
    """Context manager that connects to Ray while its block runs, and disconnects afterwards, also after an error.

    Inside the block the signal SIGTERM acts like Ctrl-C. Afterwards the handlers are those from before.

    Args:
        address: address of a running cluster, or ``local`` for a Ray on this machine.
        cores: number of cores that a local Ray uses; None: all.

    """
    with own_signals():
        ray = connect_ray(address, cores)
        for name in _SILENT:
            logging.getLogger(name).setLevel(logging.CRITICAL)
        if threading.current_thread() is threading.main_thread():  # no other thread may set a handler
            signal.signal(signal.SIGTERM, lambda number, frame: signal.raise_signal(signal.SIGINT))
        try:
            yield
        finally:
            ray.shutdown()
