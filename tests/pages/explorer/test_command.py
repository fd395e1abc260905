"""The command itself, as a process with a real socket: what it prints, whom it answers, how it ends."""

from __future__ import annotations

import http.client
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

import pytest

from ethbrake_marl.cli.app import run_command

ROOT = Path(__file__).resolve().parents[3]
COMMAND = [sys.executable, "-c", "from ethbrake_marl.cli.app import main; main()", "watch", "explore", "--no-browser"]


class Running(NamedTuple):
    process: subprocess.Popen[str]
    port: int
    path: str  # of the page, token included
    folder: Path


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    pytest.importorskip("uvicorn", reason="no uvicorn: pip install 'ethbrake-marl[explore]'")
    folder = tmp_path_factory.mktemp("explored") / "new"
    with subprocess.Popen(
        [*COMMAND, "--agents", "full_brake,coast", "--folder", str(folder)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        address = urlsplit(process.stdout.readline().strip())
        assert (address.scheme, address.hostname) == ("http", "127.0.0.1")
        assert address.port is not None
        yield Running(process, address.port, address.path, folder)
        if process.poll() is None:
            process.kill()


def ask(running: Running, method: str, path: str, body: object = None) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", running.port)
    connection.request(method, path, None if body is None else json.dumps(body), {"content-type": "application/json"})
    reply = connection.getresponse()
    told = reply.read()
    assert reply.getheader("server") is None
    connection.close()
    return reply.status, told


def test_server__answers_and_saves(running: Running) -> None:
    status, page = ask(running, "GET", running.path)
    assert status == 200 and b"Explorer: paper-random" in page
    status, told = ask(running, "POST", running.path + "world", {"number": 3})
    state = json.loads(told)["world"]
    assert status == 200 and len(state["gaps_m"]) == 2
    assert ask(running, "POST", running.path + "save", {"world": state, "name": "three", "kind": "csv"})[0] == 200
    assert [each.name for each in running.folder.iterdir()] == ["three.csv"]


def test_server__does_not_wait_for_acknowledgements(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Nagle's algorithm, by which an answer waits 40 ms, is off only where a socket is TCP's by name (asyncio)."""
    named: list[int] = []
    monkeypatch.setattr("uvicorn.Server.run", lambda self, sockets: named.extend(each.proto for each in sockets))
    assert run_command(["watch", "explore", "--no-browser", "--agents", "full_brake", "--folder", str(tmp_path)]) == 0
    assert named == [socket.IPPROTO_TCP]


@pytest.mark.parametrize("path", ["/", "/favicon.ico", "/%2e%2e/", "/x/answer"])
def test_server__tells_strangers_nothing(running: Running, path: str) -> None:
    status, told = ask(running, "GET", path)
    assert status == 403 and list(json.loads(told)) == ["error"]


GARBAGE = [
    b"\x00" * 1_000,
    b"GET / HTTP/9.9\r\n\r\n",
    b"GET /\r\n\r\n",
    b"POST / HTTP/1.1\r\nContent-Length: -1\r\n\r\n",
    b"POST / HTTP/1.1\r\nHost: a\r\nContent-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
    b"GET / HTTP/1.1\r\n" + b"A: " + b"b" * 200_000 + b"\r\n\r\n",
    b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",  # TLS
    b"",
]


@pytest.mark.parametrize("garbage", GARBAGE, ids=lambda each: ascii(each[:20]))
def test_server__outlives_garbage(running: Running, garbage: bytes) -> None:
    with socket.create_connection(("127.0.0.1", running.port), timeout=20) as stream:
        try:
            stream.sendall(garbage)
            stream.shutdown(socket.SHUT_WR)
            told = stream.recv(4_096)
        except OSError:  # it hung up first
            told = b""
    assert b" 200 " not in told
    assert ask(running, "POST", running.path + "world", {"number": 1})[0] == 200


def test_server__listens_on_this_machine_alone(running: Running) -> None:
    listening = [line.split()[1] for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    port = f":{running.port:04X}"
    assert [each for each in listening if each.endswith(port)][:1] == [f"0100007F{port}"]
    assert "00000000" + port not in listening


def test_server__ends_at_ctrl_c(running: Running) -> None:
    """The last test of this file: the server is gone after it."""
    with socket.create_connection(("127.0.0.1", running.port)):  # somebody is still there
        running.process.send_signal(signal.SIGINT)
        assert running.process.wait(timeout=60) == 0
    assert running.process.stderr is not None
    assert running.process.stderr.read().splitlines()[-1] == "ended"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--agents", "full_brak"], "did you mean 'full_brake'?"),
        (["--agents", ",".join(f"constant:{k}" for k in range(9))], "9 agents; at least 1 and at most 8"),
        (["--scenario", "cooperation-3-pair"], "say which vehicle is driven"),
        (["--port", "65536"], "65535"),
    ],
)
def test_command__refuses_before_it_listens(
    arguments: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(["watch", "explore", "--no-browser", *arguments]) == 2
    assert told in capsys.readouterr().err


def test_command__says_whose_port_it_is(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        options = ["--agents", "full_brake", "--port", port, "--folder", str(tmp_path)]
        assert run_command(["watch", "explore", "--no-browser", *options]) == 2
    assert "Address already in use" in capsys.readouterr().err


def test_command__names_its_extra(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("ethbrake_marl.errors.find_spec", lambda name: None)
    assert run_command(["watch", "explore", "--no-browser"]) == 2
    assert "-m pip install 'ethbrake-marl[explore]'" in capsys.readouterr().err
