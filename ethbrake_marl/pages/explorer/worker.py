"""A thread that does one piece of work after another, of which only the newest is worth doing.

While it works at most one piece waits. One that comes later takes its place, and who asked for the older is told so: a
slider that moves on is answered for where it is now. Threads are daemons, so a compilation does not hold up Ctrl-C.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from threading import Condition, Thread
from typing import Any

Work = Callable[[], Any]


class Superseded(Exception):  # not an error: nobody needs the answer any more
    """Newer work of the same kind came before this was begun."""


class Worker:
    """The thread, and the one piece of work that waits for it."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._arrived = Condition()
        self._waiting: tuple[Work, asyncio.Future[Any]] | None = None
        self._thread: Thread | None = None

    def start(self, first: Work | None = None) -> None:
        """Start the thread; ``first`` warms up what all work needs, and what it raises is dropped."""
        if self._thread is None:
            self._thread = Thread(target=self._run, args=(first,), name=self._name, daemon=True)
            self._thread.start()

    async def newest(self, work: Work) -> Any:
        """The result of ``work``, or what it raises; raises ``Superseded`` if newer work came before it was begun."""
        self.start()
        future: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        with self._arrived:
            older, self._waiting = self._waiting, (work, future)
            self._arrived.notify()
        if older is not None and not older[1].done():
            older[1].set_exception(Superseded())
        return await future

    def is_wanted(self) -> bool:
        """Whether newer work waits, so that what is done now may end."""
        return self._waiting is not None

    def _run(self, first: Work | None) -> None:
        with suppress(Exception):  # whoever asks next meets it again, and is told
            if first is not None:
                first()
        while True:
            with self._arrived:
                self._arrived.wait_for(lambda: self._waiting is not None)
                assert self._waiting is not None
                (work, future), self._waiting = self._waiting, None
            try:
                result, error = work(), None
            except Exception as raised:
                result, error = None, raised
            with suppress(RuntimeError):  # the server has ended
                future.get_loop().call_soon_threadsafe(_settle, future, result, error)


def _settle(future: asyncio.Future[Any], result: Any, error: Exception | None) -> None:
    if future.done():  # who asked has gone
        return
    if error is None:
        future.set_result(result)
    else:
        future.set_exception(error)
