"""The explorer: a local page whose sliders set one world, and the server that lets every agent drive in it.

The server needs the extra ``explore``.
"""

from __future__ import annotations

import asyncio
import os
import re
import secrets
import socket
import time
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from pathlib import Path
from threading import Lock, Thread
from typing import TYPE_CHECKING, Any

import numpy as np

from ethbrake_marl.agents import Agent, Source, optimise_coupled
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
from ethbrake_marl.evaluation import Conditions, EpisodeMotion, follow_episodes
from ethbrake_marl.files.sheet import csv_text
from ethbrake_marl.files.store import check_writable, parse_strict_json
from ethbrake_marl.files.yaml import flow_text
from ethbrake_marl.limits import Unproven, driven_profiles, prove, scripted_commands, task_problem
from ethbrake_marl.pages.page import Page, Part, Played, Section, shown
from ethbrake_marl.physics import Decisions, Floats, Worlds
from ethbrake_marl.policies import Policy
from ethbrake_marl.scenario import QUANTITY, Scenario, Task
from ethbrake_marl.search import Profiles
from ethbrake_marl.shield import HybridAgent, ShieldedDriver

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

# The state that the sliders set: its sliders, and the strict reading of what a page sends.
#
# A state is plain data: a quantity of every vehicle or pair is a list, one of the whole world a number.

State = dict[str, Any]
_RULES = {**QUANTITY.usual, **QUANTITY.optional}


# title, least, greatest and step of a slider, and whether it is shown at once
_SLIDERS: dict[str, tuple[str, float, float, float, bool]] = {
    "gaps_m": ("Gap", 0.0, 30.0, 0.1, True),
    "speeds_mps": ("Speed", 0.0, 40.0, 0.1, True),
    "latency_s": ("Delay until it may act", 0.0, 2.0, 0.05, True),
    "braking_capacity_mps2": ("Braking capacity", 0.5, 12.0, 0.1, True),
    "driving_capacity_mps2": ("Driving capacity", 0.0, 12.0, 0.1, False),
    "mass_t": ("Mass", 0.5, 40.0, 0.1, False),
    "restitution": ("Restitution", 0.0, 1.0, 0.01, False),
    "obstacle_gap_m": ("Obstacle ahead of Vehicle 1 at", 1.0, 150.0, 0.5, True),
    "speed_limit_mps": ("Speed limit of driving", 1.0, 60.0, 0.5, False),
    "friction": ("Friction of the road", 0.1, 1.0, 0.01, True),
    "brake_rate_mps3": ("Brakes build up at", 1.0, 60.0, 0.5, True),
    "release_rate_mps3": ("Brakes are released at", 1.0, 60.0, 0.5, False),
}


def slider_groups(scenario: Scenario, state: State) -> list[dict[str, Any]]:
    """The sliders of each quantity of a scenario's worlds, as the page takes them.

    They reach as far as the scenario draws, and as the state is (``low``, ``high``); the numbers beside them reach to
    ``most``. What is not ``usual`` opens when it is asked for.
    """
    found = []
    for field, (title, low, high, step, usual) in _SLIDERS.items():
        if field not in state:
            continue
        rule = _RULES[field]
        values = state[field] if isinstance(state[field], list) else [state[field]]
        bounds = [] if field in QUANTITY.optional else scenario.bounds(field, dry=True)
        number = range(1, rule.count(scenario.vehicles) + 1)
        names = {"vehicle": [f"Vehicle {i}" for i in number], "pair": [f"{i} to {i + 1}" for i in number]}
        found.append({
            "field": field,
            "title": title,
            "unit": rule.symbol.translate({50: "²", 51: "³"}),
            "low": min(low, *values, *(least for least, _ in bounds)),
            "high": min(max(high, *values, *(most for _, most in bounds)), rule.high),
            "step": step,
            "most": rule.high,
            "names": names.get(rule.per, [""]),
            "usual": usual,
        })  # fmt: skip
    return found


def read_state(given: object, scenario: Scenario) -> Worlds:
    """The world (n = 1) that a page asks for; every quantity must be there.

    Raises ``InvalidInput`` for an unknown or missing key, what is no number, and as ``Scenario.worlds_from_state``.
    """
    if not isinstance(given, Mapping):
        raise InvalidInput("world: must be an object such as {'gaps_m': [7, 7], ...}")
    for key, rule in {field: _RULES[field] for field, _ in scenario.table_columns.values()}.items():
        if key not in given:
            raise InvalidInput(f"world: {key} is missing; every quantity must be given")
        if rule.per != "world" and not isinstance(given[key], list):
            raise InvalidInput(f"world: {key}: must be a list of {rule.count(scenario.vehicles)} numbers")
        for i, each in enumerate(given[key] if rule.per != "world" else [given[key]]):
            read_number(each, f"world: {key}[{i}]" if rule.per != "world" else f"world: {key}")
    return scenario.worlds_from_state(given)


def read_number(value: object, what: str) -> float:
    """A finite number of JSON; raises ``InvalidInput`` for anything else, truth values too."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e15:
        raise InvalidInput(f"{what} = {value!r:.60}: must be a number")
    return float(value)


# A profile that somebody draws: commands of one vehicle on the grid of decisions, and the agent that drives it.

MOST_COMMANDS = 2_000


def decision_grid(world: Worlds, task: Task) -> dict[str, Any]:
    """Where the commands of a profile of the driven vehicle fall in one world (n = 1), and which are possible."""
    scenario, vehicle = task.scenario, task.vehicle
    first = world.first_decision_s([vehicle])
    steps = Decisions(first, scenario.time_step_s).before(scenario.horizon_s)
    v = world.vehicles
    return {
        "first_s": float(first[0]),
        "step_s": scenario.time_step_s,
        "steps": int(steps[0]),
        "low_mps2": -float(v.braking_capacity_mps2[0, vehicle]),
        "high_mps2": float(v.driving_capacity_mps2[0, vehicle]),
    }


def read_profile(given: object) -> Floats:
    """Commands (m/s2) that a page sends, one per decision; raises ``InvalidInput``."""
    if not isinstance(given, list) or not 1 <= len(given) <= MOST_COMMANDS:
        raise InvalidInput(f"profile: must be a list of 1 to {MOST_COMMANDS} commands in m/s2")
    return np.array([read_number(value, f"profile[{k}]") for k, value in enumerate(given)])


class HandDriven:
    """Drives a profile in every world; the last command goes on, and one beyond a capacity asks for the capacity."""

    knows = Source.UNSTATED

    def __init__(self, commands_mps2: Floats, time_step_s: float, name: str = "by hand") -> None:
        self.name = name
        self.commands_mps2 = commands_mps2
        self._time_step_s = time_step_s

    def begin(self, alert: Worlds, vehicle: int, scripts: object) -> Floats:
        """When the decisions of these episodes begin, [n] s."""
        return alert.first_decision_s([vehicle])

    def act(self, worlds: Worlds, memory: Floats, vehicle: int) -> tuple[Floats, Floats]:
        """The command of the decision at hand, [n] m/s2."""
        step = Decisions(memory, self._time_step_s).latest(worlds.time_s)
        command = self.commands_mps2[np.clip(step, 0, len(self.commands_mps2) - 1)]
        v = worlds.vehicles
        return np.clip(command, -v.braking_capacity_mps2[:, vehicle], v.driving_capacity_mps2[:, vehicle]), memory


SLICE = 4_000  # candidates between two looks at the clock
CONSTANTS = 29  # from which a search starts, beside E-V2X-BM's
MOST_AGENTS = 8
_REASONS = {
    "early": "a pair meets before the driven vehicle may act",
    "front": "even full braking meets the vehicle in front",
    "rear": "whatever spares the vehicle in front is met by the one behind",
}


@dataclass(frozen=True, slots=True)
class Explored:
    """One driven vehicle of a scenario, and who drives it; the task's harm is what agents and the search minimise.

    Raises ``InvalidInput`` for a task of several vehicles, or more than ``MOST_AGENTS`` agents.
    """

    task: Task
    lineup: Mapping[str, Agent]

    def __post_init__(self) -> None:
        if len(self.task.vehicles) != 1:
            raise InvalidInput(f"explore: {len(self.task.vehicles)} vehicles are driven; it takes exactly one")
        if not 1 <= len(self.lineup) <= MOST_AGENTS:
            raise InvalidInput(f"explore: {len(self.lineup)} agents; at least 1 and at most {MOST_AGENTS}")

    def answer(self, world: Worlds, profile: Floats) -> dict[str, Any]:
        """Every agent and the profile ``by hand`` in one world (n = 1), and what is known of it, as plain data."""
        drivers = {**self.lineup, "by hand": HandDriven(profile, self.task.scenario.time_step_s)}
        motions = {name: self.follow(world, driver) for name, driver in drivers.items()}
        episodes = [Played.episode(motion, self.task.vehicles) for motion in motions.values()]
        return {
            "world": {"conditions": Conditions.of(world).quantities, "episodes": episodes},
            "outcomes": [outcome(name, motion) for name, motion in motions.items()],
            "verdict": self.verdict(world),
            "constant": self.best_constant(world),
            "grid": decision_grid(world, self.task),
        }

    def follow(self, world: Worlds, agent: Agent) -> EpisodeMotion:
        """The episode of one agent in one world."""
        return follow_episodes(world, agent, self.task.scenario)[0]

    def verdict(self, world: Worlds) -> dict[str, Any]:
        """Whether contact can be avoided, and the harm that no command undercuts (m2/s2), where that is proven."""
        proof = prove(world, self.task)
        if isinstance(proof, Unproven):
            return {"avoidable": None, "why": shown(proof.because), "proven_harm": None}
        harm = float(proof.harm[0])
        if proof.avoidable is None or proof.reason is None:
            return {"avoidable": None, "why": "not decided for these vehicles", "proven_harm": harm}
        avoidable, reason = bool(proof.avoidable[0]), str(proof.reason[0])
        return {"avoidable": avoidable, "why": _REASONS.get(reason, ""), "proven_harm": harm}

    def best_constant(self, world: Worlds) -> dict[str, Any]:
        """H*: the least harm of one constant deceleration, in the engine's physics; why not, where it is not known."""
        try:
            others = scripted_commands(world, self.task)
        except InvalidInput as error:
            return {"why": shown(error)}
        best = optimise_coupled(
            world, self.task.vehicle, harm_count=self.task.harm_count, horizon_s=self.task.scenario.horizon_s,
            others_mps2=others,
        )  # fmt: skip
        return {
            "deceleration_mps2": float(best.deceleration_mps2[0]),
            "first": float(best.first_impact_harm[0]),
            "total": float(best.total_harm[0]),
        }

    def commands_of(self, world: Worlds, agent: str) -> list[float]:
        """What an agent of the line-up commands in each decision (m/s2), to begin a profile from."""
        steps = decision_grid(world, self.task)["steps"]
        return _step_by_step(driven_profiles(self.lineup[agent], world, self.task, np.array([steps])))

    def search(self, world: Worlds, profile: Floats, seconds: float, stop: Callable[[], bool]) -> dict[str, Any]:
        """The best profile that a search of so many seconds finds; ``stop`` ends it early.

        It starts from constants, H*'s among them, and from the profile by hand if that is better. The harm is that of
        the profile driven again by the engine.
        """
        begin = time.monotonic()
        scenario, harm_count = self.task.scenario, self.task.harm_count
        problem = task_problem(world, self.task)
        constant = np.full((1, 1, 1), -self.best_constant(world)["deceleration_mps2"])
        given = problem.constant(np.concatenate([constant, problem.even_grid(CONSTANTS)], axis=1))
        used = 0
        while used == 0 or not (time.monotonic() - begin >= seconds or stop()):
            given, _ = problem.search(given, budget=SLICE, seed=used // SLICE)
            used += SLICE
        commands = _step_by_step(given)
        both = [HandDriven(np.array(each), scenario.time_step_s) for each in (commands, profile.tolist())]
        motions = [self.follow(world, each) for each in both]
        which = int(np.argmin([motion.ledger.world_harm(harm_count)[0] for motion in motions]))
        best = outcome("best known", motions[which])
        return best | {
            "commands": commands if which == 0 else profile.tolist(),
            "candidates": used,
            "by_hand": which == 1,
            "episode": Played.episode(motions[which], self.task.vehicles),
        }


def outcome(name: str, motion: EpisodeMotion) -> dict[str, Any]:
    """What an episode came to: impacts, harm under both counts (m2/s2), and whether the line came to rest."""
    first, total = motion.harm
    return {
        "agent": shown(name),
        "impacts": int(motion.ledger.impacts[0]),
        "first": first,
        "total": total,
        "at_rest": motion.at_rest,
    }


def _step_by_step(profiles: Profiles) -> list[float]:
    """The commands of the one profile, decision by decision (m/s2)."""
    steps = int(profiles.ends[0, -1])
    return [float(profiles.at(np.array([k]))[0, 0]) for k in range(steps)]


# The guard in front of the explorer's server: who may ask, before anything that was sent is read.
#
# The server listens on this machine alone, but every web page that is open in a browser here can send requests to it.
# The token in the address stops those who do not know it; ``Host`` stops a name of somebody else's that was made to
# point here (DNS rebinding); ``Origin`` and ``Sec-Fetch-Site`` stop other pages, whatever they know.

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

        why = self._refusal(scope)
        answer: Any = _reply({"error": why}, HTTPStatus.FORBIDDEN) if why else self._app
        await answer(scope, receive, send_guarded)

    def _refusal(self, scope: Scope) -> str:
        """Why a request is not answered; empty for one that is."""
        hosts, origins, sites = (
            [value for key, value in scope["headers"] if key.lower() == name]
            for name in (b"host", b"origin", b"sec-fetch-site")
        )
        if len(hosts) != 1 or hosts[0] not in self._hosts:
            return "another host; open the address that ethbrake printed"
        if len(origins) > 1 or any(origin != b"http://" + hosts[0] for origin in origins):
            return "asked by another page; open the address that ethbrake printed"
        if len(sites) > 1 or any(site.decode("latin-1") not in _FETCHED_FROM for site in sites):
            return "asked by another site; open the address that ethbrake printed"
        given = scope["path"].encode("utf-8", "surrogatepass").split(b"/")
        if len(given) != 3 or given[0] or not secrets.compare_digest(given[1], self._token):
            return "no token, or another one; open the address that ethbrake printed"
        return ""


# Work of which only the newest is worth doing: a slider that moves on is answered for where it is now. Each is done in
# a daemon thread, so a compilation does not hold up Ctrl-C.


class Superseded(Exception):  # not an error: nobody needs the answer any more
    """Newer work of the same kind came before this was begun."""


class Newest:
    """Does one piece of work at a time; of those that wait, only the newest is begun."""

    def __init__(self) -> None:
        self._turn = Lock()
        self._asked, self._begun = 0, 0  # number of the newest work, and of that which was begun last

    def warm_up(self, work: Callable[[], Any]) -> None:
        """Do it before all other work, and drop what it raises: whoever asks next meets it again, and is told."""

        def run() -> None:
            with self._turn, suppress(Exception):
                work()

        Thread(target=run, daemon=True).start()

    async def do(self, work: Callable[[], Any]) -> Any:
        """The result of ``work``, or what it raises; raises ``Superseded`` if newer work came before it was begun."""
        self._asked += 1
        number, loop = self._asked, asyncio.get_running_loop()
        future: asyncio.Future[Any] = loop.create_future()

        def run() -> None:
            try:
                with self._turn:
                    if self._asked != number:
                        raise Superseded
                    self._begun = number
                    settle = partial(future.set_result, work())
            except Exception as raised:
                settle = partial(future.set_exception, raised)
            with suppress(RuntimeError):  # the server has ended
                loop.call_soon_threadsafe(lambda: future.done() or settle())  # done: who asked has gone

        Thread(target=run, daemon=True).start()
        return await future

    def is_wanted(self) -> bool:
        """Whether newer work waits, so that what is done now may end."""
        return self._asked != self._begun


# States of the explorer as files in one folder: a scenario as YAML, or a table of initial states with one row.

_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}", re.ASCII)
_DRAWN = {*QUANTITY.otherwise, "vehicle_types", "types", "table"}  # other ways to say what a state says
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
    if kind not in ("yaml", "csv"):
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
        **Conditions.of(world),
    }
    lines = [f"{key}: {flow_text(value)}" for key, value in Scenario(**fixed).declared().items()]
    return "\n".join(["# Saved by ethbrake watch explore.", *lines, ""])


def table_text(world: Worlds, scenario: Scenario) -> str:
    """A table of initial states with this world as its one row."""
    state: dict[str, Any] = Conditions.of(world)
    columns = {
        column: repr(float(state[field][index] if isinstance(state[field], list) else state[field]))
        for column, (field, index) in scenario.table_columns.items()
    }
    return csv_text([columns])


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

_PAGE = {"styles": ("explorer.css",), "scripts": ("explorer-profile.js", "explorer-cards.js", "explorer.js")}


def explorer_page(explored: Explored, state: State, *, world: int, seed: int) -> Page:
    """The page of a scenario and its agents.

    Args:
        explored: what is explored.
        state: with which the page begins.
        world: number of that state in the list.
        seed: of the list.

    """
    task, agents, drivers = explored.task, list(explored.lineup), list(explored.lineup.values())
    scenario, vehicle = task.scenario, f"Vehicle {task.vehicle + 1}"
    learned = [k for k, each in enumerate(drivers) if isinstance(getattr(each, "policy", None), Policy)]
    content = {
        "groups": slider_groups(scenario, state),
        "state": state,
        "world": world,
        "agents": [shown(agent) for agent in agents],
        "named": agents,  # as the server knows them
        "rival": [*learned, len(agents) - 1][0],  # whom to beat: the first agent that learned, else the last one
        "worst": agents.index("full_brake") if "full_brake" in agents else 0,
        "driven": list(task.vehicles),
        "vehicles": scenario.vehicles,
        "harm_count": task.harm_count,
    }
    shielded = any(isinstance(agent, HybridAgent | ShieldedDriver) for agent in drivers)
    part = partial(Part.template, "explorer.html.j2")
    sections = [
        Section("The emergency", [part(part="sliders", seed=seed)]),
        Section("What came of it", [part(part="outcome", harm_count=task.harm_count)]),
        Section("Drive it yourself", [part(part="profile", vehicle=vehicle)]),
        Section("Watch it", [Part.live_player(scenario.vehicles, shielded=shielded)]),
        Section("Keep it", [part(part="keep"), Part.data("explorer_data", content, **_PAGE)]),
    ]
    lead = f"Move a slider: {len(agents)} agents drive {vehicle} in the world that you set, at once."
    return Page(f"Explorer: {scenario.name}", sections, lead, served=True)


MOST_BODY = 64 * 1024  # bytes of a question
MOST_SECONDS = 30.0  # of a search
PATIENCE_S = 10.0  # until all of a question must have come
MOST_CONNECTIONS = 512
_STOPS = 1  # s that questions get when the server ends
_LAST_WORLD = 10**9


def explorer_app(
    explored: Explored, folder: Path, token: str, port: int, *, seed: int, world: int, warm_up: bool = False
) -> App:
    """The ASGI application, behind its ``Guard``; raises ``MissingExtra`` where its library is not installed.

    Args:
        explored: what is explored.
        folder: the only one that it writes into.
        token: in its address.
        port: on which it listens.
        seed: of the list of worlds.
        world: of that list, shown first.
        warm_up: the physics is compiled at once, not at the first question.

    """
    need("starlette")
    from starlette.applications import Starlette
    from starlette.exceptions import HTTPException
    from starlette.responses import HTMLResponse
    from starlette.routing import Route

    answers = _Answers(explored, folder, seed)
    first = answers.world_of_list(world)
    read_state(Conditions.of(first), explored.task.scenario)  # refuses scenarios whose channel is drawn
    page = explorer_page(explored, Conditions.of(first), world=world, seed=seed)
    policy = {"content-security-policy": f"{page.policy}; frame-ancestors 'none'"}

    async def show_page(request: Request) -> Response:
        return HTMLResponse(page.html, headers=policy)

    async def refuse(request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        return _reply({"error": f"{request.method} here: {error.detail.lower()}"}, error.status_code)

    if warm_up:
        answers.warm_up(first)
    asked = [Route(f"/{{token}}/{n}", partial(answers.reply_to, n), methods=["POST"]) for n in answers.questions]
    routes = [Route("/{token}/", show_page, methods=["GET"]), *asked]
    app = Starlette(routes=routes, exception_handlers={HTTPException: refuse})
    app.router.redirect_slashes = False
    return Guard(app, token, port)


class _Answers:
    """What each question is answered with; each kind of long work has a thread, in which the newest question wins."""

    def __init__(self, explored: Explored, folder: Path, seed: int) -> None:
        self._explored, self._folder, self._seed = explored, folder, seed
        self._drive, self._search, self._repeat = Newest(), Newest(), Newest()
        self.questions: dict[
            str, tuple[Callable[..., Awaitable[Any]], tuple[str, ...]]
        ] = {  # with what must be asked, and nothing else
            "answer": (self.answer, ("world", "profile")),
            "best": (self.best, ("world", "profile", "seconds")),
            "profile": (self.profile, ("world", "agent")),
            "world": (self.world, ("number",)),
            "save": (self.save, ("world", "name", "kind")),
        }

    async def reply_to(self, name: str, request: Request) -> Response:
        """Read a question and answer it; whatever is wrong becomes one line of JSON."""
        answer, keys = self.questions[name]
        try:
            asked = await _read(request)
            for key in asked:
                if key not in keys:
                    raise InvalidInput(f"unknown key {key!r:.60}; known: {', '.join(keys)}")
            if missing := [key for key in keys if key not in asked]:
                raise InvalidInput(f"{missing[0]} is missing")
            if "world" in asked:
                asked["world"] = read_state(asked["world"], self._explored.task.scenario)
            if "profile" in asked:
                asked["profile"] = read_profile(asked["profile"])
            return _reply(await answer(**asked))
        except Superseded:
            return _reply({"error": "a newer question came first", "superseded": True}, HTTPStatus.CONFLICT)
        except Exception as error:  # a defect of ours: told, and the server lives on
            status, told = next((status, told) for kind, status, told in _FAULTS if isinstance(error, kind))
            return _reply({"error": told(error)}, status)

    def world_of_list(self, number: int) -> Worlds:
        """One world (n = 1) of the scenario's list."""
        return self._explored.task.scenario.sample(1, self._seed, first=number).worlds

    def warm_up(self, world: Worlds) -> None:
        """Begin with the first world, before anybody asks."""
        profile = read_profile([0.0])
        self._drive.warm_up(lambda: self._explored.answer(world, profile))
        self._search.warm_up(lambda: self._explored.search(world, profile, 0.0, lambda: True))

    async def answer(self, world: Worlds, profile: Floats) -> Any:
        """Every agent in this world."""
        return await self._drive.do(partial(self._explored.answer, world, profile))

    async def best(self, world: Worlds, profile: Floats, seconds: object) -> Any:
        """The best profile of a short search."""
        seconds = read_number(seconds, "seconds")
        if not 0.0 <= seconds <= MOST_SECONDS:
            raise InvalidInput(f"seconds = {seconds:g}: must be 0 to {MOST_SECONDS:g}")
        work = partial(self._explored.search, world, profile, seconds, self._search.is_wanted)
        return await self._search.do(work)

    async def profile(self, world: Worlds, agent: object) -> Any:
        """What an agent commands, decision by decision."""
        if not isinstance(agent, str) or agent not in self._explored.lineup:
            raise InvalidInput(f"agent {agent!r:.80}: is not one of those that are shown")
        return {"commands": await self._repeat.do(partial(self._explored.commands_of, world, agent))}

    async def world(self, number: Any) -> Any:
        """A world of the scenario's list."""
        check_whole_number("number", number, 0, _LAST_WORLD)
        return {"world": Conditions.of(await asyncio.to_thread(self.world_of_list, number))}

    async def save(self, world: Worlds, name: object, kind: object) -> Any:
        """The state as a new file."""
        scenario = self._explored.task.scenario
        return {"file": await asyncio.to_thread(save_state, self._folder, name, kind, world, scenario)}


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


async def _read(request: Request) -> dict[str, Any]:
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


def serve_explorer(
    task: Task,
    lineup: Mapping[str, Agent],
    folder: Path,
    port: int,
    ready: Callable[[str], None],
    *,
    seed: int,
    world: int,
) -> None:
    """Serve until Ctrl-C.

    Args:
        task: as in ``Explored``.
        lineup: who can drive.
        folder: the only one that it writes into; it is made if it is not there.
        port: on 127.0.0.1; 0 takes a free one.
        ready: is called with the address, token included, when the server listens.
        seed: of the list of worlds.
        world: of that list, shown first.

    Raises ``MissingExtra`` where its libraries are not installed, ``OSError`` for a port or folder that cannot be used.

    """
    need("starlette")
    need("uvicorn")
    import uvicorn

    explored = Explored(task, lineup)
    folder.mkdir(parents=True, exist_ok=True)
    check_writable(folder)
    token = secrets.token_urlsafe(24)
    # TCP by name: else asyncio leaves Nagle's algorithm on, and every answer waits 40 ms for an acknowledgement.
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP) as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(("127.0.0.1", port))
        chosen = listening.getsockname()[1]
        app = explorer_app(explored, folder, token, chosen, seed=seed, world=world, warm_up=True)
        config = uvicorn.Config(
            app,
            http="h11",
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
        server = uvicorn.Server(config)
        # Noted from the moment at which the address is told: raised, it would be lost in a callback of an import.
        with suppress(KeyboardInterrupt), server.capture_signals():
            ready(f"http://127.0.0.1:{chosen}/{token}/")
            server.run(sockets=[listening])
