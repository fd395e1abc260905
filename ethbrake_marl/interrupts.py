"""Ctrl-C and SIGTERM during long computations: a flag to check between steps."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def stop_on_signal() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether Ctrl-C or SIGTERM has arrived during the block.

    A second Ctrl-C has its usual effect. Outside the main thread, where Python receives no signals, the function always
    returns False.
    """
    arrival = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield arrival.is_set
        return
    before = {number: signal.getsignal(number) for number in _SIGNALS}

    def listen(number: int, frame: FrameType | None) -> None:
        arrival.set()
        restore()

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    try:
        for number in _SIGNALS:
            signal.signal(number, listen)
        yield arrival.is_set
    finally:
        restore()
