"""A Ray while a study works: one of this machine alone, or a cluster that runs."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from ethbrake_marl.parallel import connect_ray

_SILENT = ("ray.tune.tune", "ray.tune.analysis.experiment_analysis")  # they advise Tuner.restore


@contextmanager
def connected(address: str, cores: int | None) -> Iterator[None]:
    """Ray, while the block runs, in which SIGTERM is Ctrl-C; see ``connect_ray``."""
    ray = connect_ray(address, cores)
    for name in _SILENT:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    in_main = threading.current_thread() is threading.main_thread()  # no other may set a handler
    before = in_main and signal.signal(signal.SIGTERM, lambda number, frame: signal.raise_signal(signal.SIGINT))
    try:
        yield
    finally:
        if in_main:
            signal.signal(signal.SIGTERM, before)
        ray.shutdown()
