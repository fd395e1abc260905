"""A connection of the explorer's server that waits for the headers of a question as long as for the rest, no longer."""

from __future__ import annotations

import asyncio
from typing import Any


def patient_connection(patience_s: float) -> type[asyncio.Protocol]:
    """The class of uvicorn's HTTP connections, closed where the headers of a question take longer than this."""
    from uvicorn.protocols.http.h11_impl import H11Protocol

    class Connection(H11Protocol):
        waiting: asyncio.TimerHandle | None = None

        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            self._wait()

        def data_received(self, data: bytes) -> None:
            super().data_received(data)
            self._wait()

        def _wait(self) -> None:
            """Begin to wait where nothing is being answered; a wait that has begun goes on."""
            answering = self.cycle is not None and not self.cycle.response_complete
            if answering and self.waiting is not None:
                self.waiting.cancel()
                self.waiting = None
            if not answering and self.waiting is None:
                self.waiting = self.loop.call_later(patience_s, self.transport.close)

        def connection_lost(self, exc: Exception | None) -> None:
            super().connection_lost(exc)
            if self.waiting is not None:
                self.waiting.cancel()

    return Connection
