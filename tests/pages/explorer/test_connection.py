"""Connections that say nothing, or half of something, are closed; a question is answered, however long that takes."""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from collections.abc import Iterator

import pytest

uvicorn = pytest.importorskip("uvicorn", reason="no uvicorn: pip install 'ethbrake-marl[explore]'")

from ethbrake_marl.pages.explorer.server import patient_connection  # noqa: E402

PATIENCE_S, SLOW_S = 0.4, 1.2
ASK = b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"


async def _answer(scope, receive, send):
    await asyncio.sleep(SLOW_S if scope["path"] == "/slow" else 0.0)
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"2")]})
    await send({"type": "http.response.body", "body": b"ok"})


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    config = uvicorn.Config(_answer, http=patient_connection(PATIENCE_S), ws="none", lifespan="off", log_level="error")
    server = uvicorn.Server(config)
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen()
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
        thread.start()
        yield listening.getsockname()[1]
        server.should_exit = True
        thread.join()


@pytest.mark.parametrize("begun", [b"", b"GET / HTTP/1.1\r\nHost: x\r\n", ASK + b"GET / HT"])
def test_headers_that_never_end__are_closed(port: int, begun: bytes) -> None:
    with socket.create_connection(("127.0.0.1", port)) as stream:
        stream.sendall(begun)
        while stream.recv(1_024):
            pass


def test_headers_drop_by_drop__are_closed(port: int) -> None:
    with socket.create_connection(("127.0.0.1", port)) as stream, pytest.raises(OSError):
        stream.sendall(b"GET / HTTP/1.1\r\n")
        for _ in range(200):
            stream.sendall(b"a")
            time.sleep(0.1)


def test_a_slow_answer__comes(port: int) -> None:
    with socket.create_connection(("127.0.0.1", port)) as stream:
        stream.sendall(ASK.replace(b"/ ", b"/slow "))
        assert b"200 OK" in stream.recv(1_024)
        stream.sendall(ASK)  # and the connection lives on
        assert b"200 OK" in stream.recv(1_024) + stream.recv(1_024)
