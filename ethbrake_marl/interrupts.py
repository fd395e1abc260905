"""Ctrl-C and SIGTERM during long computations: a flag to check between steps, and a way to postpone Ctrl-C."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def stop_on_signal() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether Ctrl-C or SIGTERM has arrived during the block.

    A second Ctrl-C has its usual effect. Outside the main thread, where Python receives no signals, the function always
    returns False.
    """
    arrival = threading.Event()
    if not _in_main_thread():
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


class Postponed:
    """Postpones Ctrl-C in the main thread while code runs in which Python would lose an exception."""

    _handler: Any = None  # handler of Ctrl-C that waits; None: nothing is postponed
    _arrived = False

    def begin(self) -> None:
        """Postpone Ctrl-C from now on, unless it is postponed already or has no handler in Python."""
        handler = signal.getsignal(signal.SIGINT)
        if self._handler is None and callable(handler) and _in_main_thread():
            self._arrived = False
            signal.signal(signal.SIGINT, self._listen)
            self._handler = handler

    def _listen(self, number: int, frame: FrameType | None) -> None:
        self._arrived = True

    def end(self, *, only_arrived: bool = False) -> None:
        """Stop postponing, and act on a Ctrl-C that has arrived.

        ``only_arrived``: if no Ctrl-C has arrived, keep postponing.
        """
        if self._handler is not None and _in_main_thread() and (self._arrived or not only_arrived):
            handler, self._handler = self._handler, None
            signal.signal(signal.SIGINT, handler)
            if self._arrived:
                signal.raise_signal(signal.SIGINT)


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()
