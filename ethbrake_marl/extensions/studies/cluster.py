"""Connection to Ray, on this machine or on a running cluster, while a study runs."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from ethbrake_marl.parallel import connect_ray, own_signals

_SILENT = ("ray.tune.tune", "ray.tune.analysis.experiment_analysis")  # loggers that advise Tuner.restore, not used here


@contextmanager
def connected(address: str, cores: int | None) -> Iterator[None]:
    """Context manager that connects to Ray while its block runs, and disconnects afterwards, also after an error.

    Inside the block, the signal SIGTERM acts like Ctrl-C; after the block, both signals act as before.

    Args:
        address: address of a running cluster, or ``local``: start Ray on this machine.
        cores: number of cores of a local Ray; None: all cores.

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
