"""The server of the explorer: its page, and the questions that the page asks. It needs the extra ``explore``."""

from __future__ import annotations

import asyncio
import secrets
import socket
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ethbrake_marl.errors import (
    EthBrakeError,
    InvalidInput,
    PhysicsError,
    check_whole_number,
    describe_error,
    need,
    one_line,
)
from ethbrake_marl.files.durable import check_writable
from ethbrake_marl.files.plain import parse_strict_json
from ethbrake_marl.pages.explorer.answer import Explored
from ethbrake_marl.pages.explorer.connection import patient_connection
from ethbrake_marl.pages.explorer.guard import App, Guard
from ethbrake_marl.pages.explorer.hand import read_profile
from ethbrake_marl.pages.explorer.page import explorer_page
from ethbrake_marl.pages.explorer.saving import save_state
from ethbrake_marl.pages.explorer.state import read_number, read_state, state_of
from ethbrake_marl.pages.explorer.worker import Superseded, Worker
from ethbrake_marl.scenario import Scenario

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

MOST_BODY = 64 * 1024  # bytes of a question
MOST_SECONDS = 30.0  # of a search
PATIENCE_S = 10.0  # until the headers of a question must have come, and then until the rest
MOST_CONNECTIONS = 512
_STOPS = 1  # s that questions get when the server ends
_LAST_WORLD = 10**9

Asked = dict[str, Any]
Answer = Callable[[Asked], Awaitable[Any]]


@dataclass(frozen=True)
class Setting:
    """What a server of the explorer serves."""

    explored: Explored
    folder: Path  # the only one that it writes into
    seed: int  # of the list of worlds
    world: int  # of that list, shown first


def explorer_app(setting: Setting, token: str, port: int, *, warm_up: bool = False) -> App:
    """The ASGI application, behind its ``Guard``; raises ``MissingExtra`` where its library is not installed.

    With ``warm_up`` the physics is compiled at once, not at the first question.
    """
    need("starlette")
    from starlette.applications import Starlette
    from starlette.exceptions import HTTPException
    from starlette.responses import HTMLResponse
    from starlette.routing import Route

    page = explorer_page(setting.explored, _first_state(setting), world=setting.world, seed=setting.seed)
    policy = {"content-security-policy": f"{page.policy}; frame-ancestors 'none'"}

    async def show_page(request: Request) -> Response:
        return HTMLResponse(page.html, headers=policy)

    async def refuse(request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        return _reply({"error": f"{request.method} here: {error.detail.lower()}"}, error.status_code)

    answers = _Answers(setting)
    if warm_up:
        answers.warm_up()
    routes = [Route("/{token}/", show_page, methods=["GET"])]
    routes += [Route(f"/{{token}}/{name}", _asked(each), methods=["POST"]) for name, each in answers.by_name.items()]
    app = Starlette(routes=routes, exception_handlers={HTTPException: refuse})
    app.router.redirect_slashes = False
    return Guard(app, token, port)


class _Answers:
    """What each question is answered with; each kind of long work has a thread, in which the newest question wins."""

    def __init__(self, setting: Setting) -> None:
        self._setting, self._explored = setting, setting.explored
        self._drive, self._search, self._repeat = Worker("agents"), Worker("search"), Worker("profile")
        self.by_name: dict[str, Answer] = {
            "answer": self.answer, "best": self.best, "profile": self.profile, "world": self.world, "save": self.save,
        }  # fmt: skip

    @property
    def scenario(self) -> Scenario:
        return self._explored.scenario

    def warm_up(self) -> None:
        """Begin with the first world, before anybody asks."""
        world, profile = _worlds(self._setting, self._setting.world), read_profile([0.0])
        self._drive.start(lambda: self._explored.answer(world, profile))
        self._search.start(lambda: self._explored.search(world, profile, 0.0, lambda: True))

    async def answer(self, asked: Asked) -> Any:
        """Every agent in this world."""
        _check_keys(asked, ("world", "profile"))
        world, profile = read_state(asked["world"], self.scenario), read_profile(asked["profile"])
        return await self._drive.newest(partial(self._explored.answer, world, profile))

    async def best(self, asked: Asked) -> Any:
        """The best profile of a short search."""
        _check_keys(asked, ("world", "profile", "seconds"))
        seconds = read_number(asked["seconds"], "seconds")
        if not 0.0 <= seconds <= MOST_SECONDS:
            raise InvalidInput(f"seconds = {seconds:g}: must be 0 to {MOST_SECONDS:g}")
        world, profile = read_state(asked["world"], self.scenario), read_profile(asked["profile"])
        stop = self._search.is_wanted
        return await self._search.newest(partial(self._explored.search, world, profile, seconds, stop))

    async def profile(self, asked: Asked) -> Any:
        """What an agent commands, decision by decision."""
        _check_keys(asked, ("world", "agent"))
        agent = asked["agent"]
        if not isinstance(agent, str) or agent not in self._explored.lineup:
            raise InvalidInput(f"agent {agent!r:.80}: is not one of those that are shown")
        work = partial(self._explored.commands_of, read_state(asked["world"], self.scenario), agent)
        return {"commands": await self._repeat.newest(work)}

    async def world(self, asked: Asked) -> Any:
        """A world of the scenario's list."""
        _check_keys(asked, ("number",))
        check_whole_number("number", asked["number"], 0, _LAST_WORLD)
        drawn = await asyncio.to_thread(_worlds, self._setting, asked["number"])
        return {"world": state_of(drawn)}

    async def save(self, asked: Asked) -> Any:
        """The state as a new file."""
        _check_keys(asked, ("world", "name", "kind"))
        world = read_state(asked["world"], self.scenario)
        name, kind, folder = asked["name"], asked["kind"], self._setting.folder
        return {"file": await asyncio.to_thread(save_state, folder, name, kind, world, self.scenario)}


def _asked(answer: Answer) -> Callable[[Request], Awaitable[Response]]:
    """What answers a question: it is read, and whatever is wrong becomes one line of JSON."""

    async def reply(request: Request) -> Response:
        try:
            return _reply(await answer(await _read(request)))
        except Superseded:
            return _reply({"error": "a newer question came first", "superseded": True}, HTTPStatus.CONFLICT)
        except _TooLarge:
            return _reply({"error": f"more than {MOST_BODY} bytes"}, HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
        except TimeoutError:
            return _reply({"error": "the question did not come to its end"}, HTTPStatus.REQUEST_TIMEOUT)
        except PhysicsError as error:
            return _reply({"error": f"a defect of the physics: {error}"}, HTTPStatus.INTERNAL_SERVER_ERROR)
        except EthBrakeError as error:
            return _reply({"error": str(error)}, HTTPStatus.BAD_REQUEST)
        except OSError as error:
            return _reply({"error": f"cannot be written: {error.strerror or error}"}, HTTPStatus.INTERNAL_SERVER_ERROR)
        except Exception as error:  # a defect of ours: told, and the server lives on
            return _reply({"error": f"a defect: {one_line(describe_error(error))}"}, HTTPStatus.INTERNAL_SERVER_ERROR)

    return reply


class _TooLarge(Exception):  # becomes an answer
    """More bytes than a question may have."""


async def _read(request: Request) -> Asked:
    """The question: a JSON object in a body of at most ``MOST_BODY`` bytes."""
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/json":
        raise InvalidInput("content-type: must be application/json")
    body = bytearray()
    async with asyncio.timeout(PATIENCE_S):
        async for part in request.stream():
            body += part
            if len(body) > MOST_BODY:
                raise _TooLarge
    try:
        asked = parse_strict_json(bytes(body))
    except ValueError as error:
        raise InvalidInput(f"no JSON: {error}") from None
    if not isinstance(asked, dict):
        raise InvalidInput("must be a JSON object")
    return asked


def _check_keys(asked: Mapping[str, Any], keys: tuple[str, ...]) -> None:
    for key in asked:
        if key not in keys:
            raise InvalidInput(f"unknown key {key!r:.60}; known: {', '.join(keys)}")
    if missing := [key for key in keys if key not in asked]:
        raise InvalidInput(f"{missing[0]} is missing")


def _reply(content: object, status: int = HTTPStatus.OK) -> Response:
    from starlette.responses import JSONResponse

    return JSONResponse(content, int(status))


def _worlds(setting: Setting, number: int) -> Any:
    return setting.explored.scenario.sample(1, setting.seed, first=number).worlds


def _first_state(setting: Setting) -> dict[str, Any]:
    """The state that the page begins with; reading it back refuses scenarios whose channel is drawn."""
    state = state_of(_worlds(setting, setting.world))
    read_state(state, setting.explored.scenario)
    return state


def serve_explorer(setting: Setting, port: int, ready: Callable[[str], None]) -> None:
    """Serve until Ctrl-C.

    Args:
        setting: what is served; its folder is made if it is not there.
        port: on 127.0.0.1; 0 takes a free one.
        ready: is called with the address, token included, when the server listens.

    Raises ``MissingExtra`` where its libraries are not installed, ``OSError`` for a port or folder that cannot be used.

    """
    need("starlette")
    need("uvicorn")
    import uvicorn

    setting.folder.mkdir(parents=True, exist_ok=True)
    check_writable(setting.folder)
    token = secrets.token_urlsafe(24)
    # TCP by name: else asyncio leaves Nagle's algorithm on, and every answer waits 40 ms for an acknowledgement.
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP) as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(("127.0.0.1", port))
        chosen = listening.getsockname()[1]
        app = explorer_app(setting, token, chosen, warm_up=True)
        config = uvicorn.Config(
            app,
            http=patient_connection(PATIENCE_S),
            ws="none",
            lifespan="off",
            access_log=False,
            log_level="error",
            server_header=False,
            proxy_headers=False,
            timeout_keep_alive=30,
            timeout_graceful_shutdown=_STOPS,
            limit_concurrency=MOST_CONNECTIONS,
            h11_max_incomplete_event_size=16 * 1024,
        )
        listening.listen()
        ready(f"http://127.0.0.1:{chosen}/{token}/")
        with suppress(KeyboardInterrupt):
            uvicorn.Server(config).run(sockets=[listening])
