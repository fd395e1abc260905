"""The explorer's application, asked without a network: every header, path and body is the test's own."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from ethbrake_marl.defaults import DEFAULT
from ethbrake_marl.evaluation.inputs import make_agents
from ethbrake_marl.evaluation.measures import Conditions
from ethbrake_marl.pages.explorer import Explored
from ethbrake_marl.scenario import Scenario, Task, load_scenario

TOKEN, PORT = "the-token-of-this-test", 4711
HOST = f"127.0.0.1:{PORT}"
PAGE = f"/{TOKEN}/"
AGENTS = ("full_brake", "e_v2x_bm", "ppo@shipped")


class Reply(NamedTuple):
    """What a request was answered with."""

    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)


class Client:
    """Asks an ASGI application as a browser would, unless told otherwise."""

    def __init__(self, app: Any) -> None:
        self.app = app

    def ask(self, what: str, content: object, **changes: Any) -> Reply:
        body = content if isinstance(content, bytes) else json.dumps(content).encode()
        return self.request("POST", f"/{TOKEN}/{what}", body, **changes)

    def request(self, method: str, path: str, body: bytes | Iterable[bytes] = b"", **how: Any) -> Reply:
        return asyncio.run(self.asked(method, path, body, **how))

    async def asked(
        self,
        method: str,
        path: str,
        body: bytes | Iterable[bytes] = b"",
        *,
        headers: dict[str, str | None] | None = None,
        twice: tuple[str, str] | None = None,
        receive: Callable[[], Awaitable[Any]] | None = None,
    ) -> Reply:
        usual = {"host": HOST, "origin": f"http://{HOST}", "content-type": "application/json"}
        usual |= {"sec-fetch-site": "same-origin"}
        given = {name: value for name, value in {**usual, **(headers or {})}.items() if value is not None}
        pairs = [(name.encode(), value.encode("latin-1")) for name, value in given.items()]
        if twice is not None:
            pairs.append((twice[0].encode(), twice[1].encode()))
        scope = {
            "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": method, "scheme": "http",
            "path": path, "raw_path": path.encode("utf-8", "replace"), "query_string": b"", "root_path": "",
            "headers": pairs, "client": ("127.0.0.1", 1), "server": ("127.0.0.1", PORT),
        }  # fmt: skip
        sent: list[Any] = []

        async def send(message: Any) -> None:
            sent.append(message)

        await self.app(scope, receive or aiter_parts([body] if isinstance(body, bytes) else body).__anext__, send)
        start, *rest = sent
        kept = {name.decode().lower(): value.decode() for name, value in start["headers"]}
        return Reply(start["status"], kept, b"".join(each.get("body", b"") for each in rest))


async def aiter_parts(body: Iterable[bytes]) -> AsyncIterator[dict[str, Any]]:
    """What a server hands on of a body, part by part; then the other end hangs up."""
    for part in body:
        yield {"type": "http.request", "body": part, "more_body": True}
    yield {"type": "http.request", "body": b"", "more_body": False}
    while True:
        yield {"type": "http.disconnect"}


@pytest.fixture(scope="package")
def scenario() -> Scenario:
    return load_scenario("paper-random")


@pytest.fixture(scope="package")
def explored(scenario: Scenario) -> Explored:
    return Explored(Task(scenario, scenario.learners), make_agents(AGENTS, scenario))


@pytest.fixture
def state(scenario: Scenario) -> dict[str, Any]:
    """World 1 of the list: nobody can avoid contact there."""
    return Conditions.of(scenario.sample(1, DEFAULT.LIST_SEED, first=1).worlds)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "kept").mkdir()
    return tmp_path / "kept"


@pytest.fixture
def client(explored: Explored, folder: Path) -> Iterator[Client]:
    pytest.importorskip("starlette", reason="no Starlette: pip install 'ethbrake-marl[explore]'")
    from ethbrake_marl.pages.explorer import explorer_app

    yield Client(explorer_app(explored, folder, TOKEN, PORT, seed=DEFAULT.LIST_SEED, world=0))


def check_refused(reply: Reply, status: int) -> None:
    assert reply.status == status, reply.body
    told, kept = reply.json["error"], reply.headers
    assert (kept["content-type"], kept["x-content-type-options"]) == ("application/json", "nosniff")
    assert 0 < len(told) <= 1_500 and told.isprintable() and TOKEN not in told


def check_alive(client: Client) -> None:
    assert client.ask("world", {"number": 0}).status == 200
