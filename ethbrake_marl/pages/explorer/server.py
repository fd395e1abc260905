"""The server of the explorer: its page, and the questions that the page asks. It needs the extra ``explore``."""

from __future__ import annotations

import asyncio
import csv
import io
import json
import os
import re
import secrets
import socket
from collections.abc import Awaitable, Callable, MutableMapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from pathlib import Path
from threading import Condition, Thread
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

from ethbrake_marl.errors import (
    AlreadyExists,
    EthBrakeError,
    InvalidInput,
    PhysicsError,
    check_whole_number,
    describe_error,
    need,
    one_line,
)
from ethbrake_marl.files.store import check_writable, parse_strict_json
from ethbrake_marl.files.yaml import flow_text
from ethbrake_marl.pages.explorer.answer import (
    Explored,
    State,
    read_number,
    read_profile,
    read_state,
    slider_groups,
    state_of,
)
from ethbrake_marl.pages.frame import Part, Section, data, page, page_policy, render, shown
from ethbrake_marl.pages.player import live_player
from ethbrake_marl.physics import Floats, Worlds
from ethbrake_marl.policies.bundle import Policy
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.scenario.fields import OTHERWISE
from ethbrake_marl.scenario.sampling import table_columns
from ethbrake_marl.shield import HybridAgent, ShieldedDriver

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response


# A connection of the explorer's server that waits for the headers of a question as long as for the rest, no longer.


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


# The guard in front of the explorer's server: who may ask, before anything that was sent is read.
#
# The server listens on this machine alone, but every web page that is open in a browser here can send requests to it.
# The
# token in the address stops those who do not know it; ``Host`` stops a name of somebody else's that was made to point
# here (DNS rebinding); ``Origin`` and ``Sec-Fetch-Site`` stop other pages, whatever they know. See decision 0037.

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

_FETCHED_FROM = ("same-origin", "none")  # the page itself, or an address that somebody typed or opened
# Of every answer that does not say otherwise; the page brings a policy that lets its own script and style run.
HEADERS = {
    "content-security-policy": "default-src 'none'; frame-ancestors 'none'",
    "x-frame-options": "DENY",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}


class Guard:
    """An ASGI application around another one: it answers strangers itself, and adds ``HEADERS`` to all answers."""

    def __init__(self, app: App, token: str, port: int) -> None:
        self._app = app
        self._token = token.encode()
        self._hosts = {f"127.0.0.1:{port}".encode(), f"localhost:{port}".encode()}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http":
            return  # no web sockets; the server closes them

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                said = {name.lower() for name, _ in message.get("headers", [])}
                ours = [(name.encode(), value.encode()) for name, value in HEADERS.items()]
                headers = [*message.get("headers", []), *(each for each in ours if each[0] not in said)]
                message = {**message, "headers": headers}
            await send(message)

        status, why = self._refusal(scope)
        if not status:
            await self._app(scope, receive, send_guarded)
            return
        body = json.dumps({"error": why}).encode()
        told = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
        await send_guarded({"type": "http.response.start", "status": status, "headers": told})
        await send_guarded({"type": "http.response.body", "body": body})

    def _refusal(self, scope: Scope) -> tuple[int, str]:
        """Status and reason for a request that is not answered; 0 for one that is."""
        hosts, origins, sites = (
            [value for key, value in scope["headers"] if key.lower() == name]
            for name in (b"host", b"origin", b"sec-fetch-site")
        )
        if len(hosts) != 1 or hosts[0] not in self._hosts:
            return 403, "another host; open the address that ethbrake printed"
        if len(origins) > 1 or any(origin != b"http://" + hosts[0] for origin in origins):
            return 403, "asked by another page; open the address that ethbrake printed"
        if len(sites) > 1 or any(site.decode("latin-1") not in _FETCHED_FROM for site in sites):
            return 403, "asked by another site; open the address that ethbrake printed"
        given = scope["path"].encode("utf-8", "surrogatepass").split(b"/")
        if len(given) != 3 or given[0] or not secrets.compare_digest(given[1], self._token):
            return 403, "no token, or another one; open the address that ethbrake printed"
        return 0, ""


# A thread that does one piece of work after another, of which only the newest is worth doing.
#
# While it works at most one piece waits. One that comes later takes its place, and who asked for the older is told so:
# a
# slider that moves on is answered for where it is now. Threads are daemons, so a compilation does not hold up Ctrl-C.

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


# States of the explorer as files in one folder: a scenario as YAML, or a table of initial states with one row.

Kind = Literal["yaml", "csv"]

_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}", re.ASCII)
_DRAWN = {*OTHERWISE, "vehicle_types", "types"}  # other ways to say what a state says
_DEVICES = {"con", "prn", "aux", "nul", *(f"{port}{k}" for port in ("com", "lpt") for k in range(10))}


def save_state(folder: Path, name: object, kind: object, world: Worlds, scenario: Scenario) -> str:
    """Write one world (n = 1) as a new file of the folder, and give the file's name.

    Raises ``InvalidInput`` for a name that is not 1 to 64 lower case letters, digits, - and _ or that some system keeps
    for a device, and for another kind; ``AlreadyExists`` where there is anything of that name; ``OSError``.
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name) or name in _DEVICES:
        raise InvalidInput(
            f"name {name!r:.80}: must be 1 to 64 lower case letters, digits, - and _, beginning with a letter or digit,"
            " and no device (con, nul, ...)"
        )
    if kind not in get_args(Kind):
        raise InvalidInput(f"kind {kind!r:.60}: must be yaml or csv")
    text = scenario_text(name, world, scenario) if kind == "yaml" else table_text(world, scenario)
    file = f"{name}.{kind}"
    _create(folder, file, text.encode())
    return file


def scenario_text(name: str, world: Worlds, scenario: Scenario) -> str:
    """A scenario whose every world is this one; it keeps scripts, time step, horizon and channel of ``scenario``."""
    fixed = {
        **{key: value for key, value in scenario.declared().items() if key not in _DRAWN},
        "name": name,
        "title": f"One world, from {scenario.name}",
        "description": "A state that was saved in the explorer.",
        "source": "ethbrake watch explore",
        "early_impacts": "keep",  # this very world, whatever happens in it
        **state_of(world),
    }
    lines = [f"{key}: {flow_text(value)}" for key, value in Scenario(**fixed).declared().items()]
    return "\n".join(["# Saved by ethbrake watch explore.", *lines, ""])


def table_text(world: Worlds, scenario: Scenario) -> str:
    """A table of initial states with this world as its one row."""
    state: dict[str, Any] = state_of(world)
    columns = {
        column: repr(float(state[field][index] if isinstance(state[field], list) else state[field]))
        for column, (field, index) in table_columns(scenario).items()
    }
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([list(columns), list(columns.values())])
    return text.getvalue()


def _create(folder: Path, file: str, data: bytes) -> None:
    """A new file right in the folder: the name is looked up there, no link is followed, nothing is replaced."""
    place = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        with os.fdopen(os.open(file, flags, 0o666, dir_fd=place), "wb") as stream:
            try:
                stream.write(data)
                stream.flush()
                os.fsync(stream.fileno())
            except OSError:
                os.unlink(file, dir_fd=place)
                raise
    except FileExistsError:
        raise AlreadyExists(f"{file}: is there already; give another name") from None
    finally:
        os.close(place)


# The page of the explorer: sliders, what every agent makes of them, the player, a profile to draw, files to keep.

_STYLES = ("explorer/explorer.css",)
_SCRIPTS = ("explorer/profile.js", "explorer/cards.js", "explorer/explorer.js")


class Page(NamedTuple):
    """A page, and the content security policy that stands in it too."""

    html: str
    policy: str


def explorer_page(explored: Explored, state: State, *, world: int, seed: int) -> Page:
    """The page of a scenario and its agents.

    Args:
        explored: what is explored.
        state: with which the page begins.
        world: number of that state in the list.
        seed: of the list.

    """
    scenario = explored.scenario
    vehicle = f"Vehicle {explored.vehicle + 1}"
    content = _content(explored, state, world)
    shielded = any(isinstance(agent, HybridAgent | ShieldedDriver) for agent in explored.lineup.values())
    sections = [
        Section("The emergency", [_part("sliders", seed=seed)]),
        Section("What came of it", [_part("outcome", harm_count=explored.harm_count)]),
        Section("Drive it yourself", [_part("profile", vehicle=vehicle)]),
        Section("Watch it", [live_player(scenario.vehicles, shielded=shielded)]),
        Section("Keep it", [_part("keep"), Part(data("explorer_data", content), _STYLES, _SCRIPTS)]),
    ]
    title = f"Explorer: {scenario.name}"
    lead = f"Move a slider: {len(explored.lineup)} agents drive {vehicle} in the world that you set, at once."
    return Page(page(title, sections, lead=lead, served=True), page_policy(sections, served=True))


def _part(name: str, **values: object) -> Part:
    return Part(render("explorer/explorer.html.j2", part=name, **values))


def _content(explored: Explored, state: State, world: int) -> dict[str, Any]:
    agents = list(explored.lineup)
    learned = [
        k for k, each in enumerate(explored.lineup.values()) if isinstance(getattr(each, "policy", None), Policy)
    ]
    return {
        "groups": slider_groups(explored.scenario, state),
        "state": state,
        "world": world,
        "agents": [shown(agent) for agent in agents],
        "named": agents,  # as the server knows them
        "rival": [*learned, len(agents) - 1][0],  # whom to beat: the first agent that learned, else the last one
        "worst": agents.index("full_brake") if "full_brake" in agents else 0,
        "driven": [explored.vehicle],
        "vehicles": explored.scenario.vehicles,
        "harm_count": explored.harm_count,
    }


MOST_BODY = 64 * 1024  # bytes of a question
MOST_SECONDS = 30.0  # of a search
PATIENCE_S = 10.0  # until the headers of a question must have come, and then until the rest
MOST_CONNECTIONS = 512
_STOPS = 1  # s that questions get when the server ends
_LAST_WORLD = 10**9

Asked = dict[str, Any]
Answer = Callable[..., Awaitable[Any]]


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

    state = state_of(_worlds(setting, setting.world))
    read_state(state, setting.explored.scenario)  # refuses scenarios whose channel is drawn
    page = explorer_page(setting.explored, state, world=setting.world, seed=setting.seed)
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
    routes += [Route(f"/{{token}}/{name}", each, methods=["POST"]) for name, each in answers.routes().items()]
    app = Starlette(routes=routes, exception_handlers={HTTPException: refuse})
    app.router.redirect_slashes = False
    return Guard(app, token, port)


class _Answers:
    """What each question is answered with; each kind of long work has a thread, in which the newest question wins."""

    def __init__(self, setting: Setting) -> None:
        self._setting, self._explored = setting, setting.explored
        self._drive, self._search, self._repeat = Worker("agents"), Worker("search"), Worker("profile")
        self._questions: dict[str, tuple[Answer, tuple[str, ...]]] = {  # with what must be asked, and nothing else
            "answer": (self.answer, ("world", "profile")),
            "best": (self.best, ("world", "profile", "seconds")),
            "profile": (self.profile, ("world", "agent")),
            "world": (self.world, ("number",)),
            "save": (self.save, ("world", "name", "kind")),
        }

    def routes(self) -> dict[str, Callable[[Request], Awaitable[Response]]]:
        """What answers each question: it is read, and whatever is wrong becomes one line of JSON."""
        return {name: partial(self._reply_to, *question) for name, question in self._questions.items()}

    async def _reply_to(self, answer: Answer, keys: tuple[str, ...], request: Request) -> Response:
        try:
            asked = await _read(request)
            for key in asked:
                if key not in keys:
                    raise InvalidInput(f"unknown key {key!r:.60}; known: {', '.join(keys)}")
            if missing := [key for key in keys if key not in asked]:
                raise InvalidInput(f"{missing[0]} is missing")
            if "world" in asked:
                asked["world"] = read_state(asked["world"], self._explored.scenario)
            if "profile" in asked:
                asked["profile"] = read_profile(asked["profile"])
            return _reply(await answer(**asked))
        except Superseded:
            return _reply({"error": "a newer question came first", "superseded": True}, HTTPStatus.CONFLICT)
        except Exception as error:  # a defect of ours: told, and the server lives on
            status, told = next((status, told) for kind, status, told in _FAULTS if isinstance(error, kind))
            return _reply({"error": told(error)}, status)

    def warm_up(self) -> None:
        """Begin with the first world, before anybody asks."""
        world, profile = _worlds(self._setting, self._setting.world), read_profile([0.0])
        self._drive.start(lambda: self._explored.answer(world, profile))
        self._search.start(lambda: self._explored.search(world, profile, 0.0, lambda: True))

    async def answer(self, world: Worlds, profile: Floats) -> Any:
        """Every agent in this world."""
        return await self._drive.newest(partial(self._explored.answer, world, profile))

    async def best(self, world: Worlds, profile: Floats, seconds: object) -> Any:
        """The best profile of a short search."""
        seconds = read_number(seconds, "seconds")
        if not 0.0 <= seconds <= MOST_SECONDS:
            raise InvalidInput(f"seconds = {seconds:g}: must be 0 to {MOST_SECONDS:g}")
        work = partial(self._explored.search, world, profile, seconds, self._search.is_wanted)
        return await self._search.newest(work)

    async def profile(self, world: Worlds, agent: object) -> Any:
        """What an agent commands, decision by decision."""
        if not isinstance(agent, str) or agent not in self._explored.lineup:
            raise InvalidInput(f"agent {agent!r:.80}: is not one of those that are shown")
        return {"commands": await self._repeat.newest(partial(self._explored.commands_of, world, agent))}

    async def world(self, number: Any) -> Any:
        """A world of the scenario's list."""
        check_whole_number("number", number, 0, _LAST_WORLD)
        return {"world": state_of(await asyncio.to_thread(_worlds, self._setting, number))}

    async def save(self, world: Worlds, name: object, kind: object) -> Any:
        """The state as a new file."""
        scenario, folder = self._explored.scenario, self._setting.folder
        return {"file": await asyncio.to_thread(save_state, folder, name, kind, world, scenario)}


class _TooLarge(Exception):  # becomes an answer
    """More bytes than a question may have."""


_FAULTS: tuple[tuple[type[Exception], HTTPStatus, Callable[[Any], str]], ...] = (  # the first that fits
    (_TooLarge, HTTPStatus.REQUEST_ENTITY_TOO_LARGE, lambda error: f"more than {MOST_BODY} bytes"),
    (TimeoutError, HTTPStatus.REQUEST_TIMEOUT, lambda error: "the question did not come to its end"),
    (PhysicsError, HTTPStatus.INTERNAL_SERVER_ERROR, lambda error: f"a defect of the physics: {error}"),
    (EthBrakeError, HTTPStatus.BAD_REQUEST, str),
    (OSError, HTTPStatus.INTERNAL_SERVER_ERROR, lambda error: f"cannot be written: {error.strerror or error}"),
    (Exception, HTTPStatus.INTERNAL_SERVER_ERROR, lambda error: f"a defect: {one_line(describe_error(error))}"),
)


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


def _reply(content: object, status: int = HTTPStatus.OK) -> Response:
    from starlette.responses import JSONResponse

    return JSONResponse(content, int(status))


def _worlds(setting: Setting, number: int) -> Any:
    return setting.explored.scenario.sample(1, setting.seed, first=number).worlds


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
