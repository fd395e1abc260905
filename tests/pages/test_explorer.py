"""The explorer: it answers what an evaluation gives, saves what reads back, and tells strangers nothing."""

import asyncio
import http.client
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import SplitResult, urlsplit

import numpy as np
import pytest

from ethbrake_marl.agents import optimise_coupled
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.defaults import DEFAULT
from ethbrake_marl.errors import AlreadyExists
from ethbrake_marl.evaluation import Conditions, evaluate, make_agents, make_lineup
from ethbrake_marl.limits import prove
from ethbrake_marl.pages.explorer import (
    MOST_BODY,
    Explored,
    explorer_app,
    explorer_page,
    read_state,
    save_state,
    serve_explorer,
    slider_groups,
)
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


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario("paper-random")


@pytest.fixture(scope="module")
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
    yield Client(explorer_app(explored, folder, TOKEN, PORT, seed=DEFAULT.LIST_SEED, world=0))


def check_refused(reply: Reply, status: int) -> None:
    assert reply.status == status, reply.body
    told, kept = reply.json["error"], reply.headers
    assert (kept["content-type"], kept["x-content-type-options"]) == ("application/json", "nosniff")
    assert 0 < len(told) <= 1_500 and told.isprintable() and TOKEN not in told


def check_alive(client: Client) -> None:
    assert client.ask("world", {"number": 0}).status == 200


ROOT = Path(__file__).resolve().parents[2]


COMMAND = [sys.executable, "-m", "ethbrake_marl", "watch", "explore", "--no-browser"]


class Running(NamedTuple):
    process: subprocess.Popen[str]
    address: SplitResult  # of the page, token included
    folder: Path


@contextmanager
def started(folder: Path, *more: str, agents: str = "full_brake,coast") -> Iterator[Running]:
    pytest.importorskip("uvicorn", reason="no uvicorn: pip install 'ethbrake-marl[explore]'")
    with subprocess.Popen(
        [*COMMAND, "--agents", agents, "--folder", str(folder), *more],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        address = urlsplit(process.stdout.readline().strip())  # type: ignore[union-attr]
        assert (address.scheme, address.hostname, bool(address.port)) == ("http", "127.0.0.1", True)
        try:
            yield Running(process, address, folder)
        finally:  # also after a failure, which would wait for it for ever
            process.kill()


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with started(tmp_path_factory.mktemp("explored") / "new") as server:
        yield server


def ask(running: Running, method: str, path: str, body: object = None) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection(running.address.netloc)
    connection.request(method, path, None if body is None else json.dumps(body), {"content-type": "application/json"})
    reply = connection.getresponse()
    told = reply.read()
    assert reply.getheader("server") is None
    connection.close()
    return reply.status, told


BODIES: list[bytes] = [
    b"", b"{", b"null", b"[]", b'"world"', b"\xff\xfe", b"[" * 30_000, b'{"number": NaN}', b'{"number": Infinity}',
    b'{"number": 1e999}', b'{"number": 1, "number": 2}', b'{"number": ' + b"9" * 20_000 + b"}", b'{"number": true}',
    b'{"number": 1.5}', b'{"number": -1}', b'{"number": 99999999999}', b'{"number": "1"}', b'{"number": null}',
    b'{"number": 1, "scenario": "/etc/passwd"}', b'{"number": 1, "__proto__": {}}', b'{"\\u202enumber": 1}', b"{}",
]  # fmt: skip


# What a question may hold that makes it none: each value of a key, in an otherwise good one.
MISSING = "(taken out)"


STATES: list[tuple[str, Any]] = [
    ("gaps_m", [7]), ("gaps_m", 7), ("gaps_m", [7, "7"]), ("gaps_m", [7, True]), ("gaps_m", [7, None]),
    ("gaps_m", [7, [7]]), ("gaps_m", [-1, 7]), ("gaps_m", [1e300, 7]), ("gaps_m", [10**400, 7]),
    ("gaps_m", [7] * 10_000), ("speeds_mps", [41, 18, 20]), ("speeds_mps", [20, 18]), ("mass_t", [0, 5, 5]),
    ("latency_s", [0, 0.5, 8]), ("restitution", 1.1), ("restitution", [0.1]), ("restitution", "0.1"),
    ("obstacle_gap_m", 50), ("hazard_gap_m", 50), ("roles", {"vehicle_2": "ppo@/etc/passwd"}),
    ("<script>alert(1)</script>", 1), ("gaps_m", MISSING), ("speeds_mps", MISSING), ("restitution", MISSING),
    ("speed_limit_mps", MISSING),
]  # fmt: skip


NAMES: list[object] = [
    "", ".", "..", "../up", "/etc/passwd", "a/b", "a\\b", "c:a", "a.yaml", ".hidden", "-rf", "_a", "A", "a b", "a\n",
    "a\x00", "a\x00.txt", "\u202eabc", "\uff41", "é", "<img>", "a'b", 'a"b', "$(id)", "con", "nul", "com1", "lpt9",
    "a" * 65, "a" * 10_000, None, 7, ["a"], {"a": 1},
]  # fmt: skip


NONE: list[tuple[str, str, object]] = [
    *(("answer", "profile", each) for each in ([], [0.0] * 2_001, None, [None], ["-7"], {"0": 1}, 3, [True], [1e200])),
    *(
        ("profile", "agent", each)
        for each in ("sac@shipped", "ppo@/etc/passwd", "../full_brake", "", None, ["full_brake"], 0)
    ),
    *(("best", "seconds", each) for each in (-1, 31, 1e9, None, "1", True)),
    *(("save", "name", each) for each in NAMES),
    *(("save", "kind", each) for each in ("", "json", "yaml/../x", ".yaml", "YAML", None, 1, ["csv"], "py")),
]


GOOD = {
    "answer": {"profile": [0.0]},
    "profile": {"agent": "full_brake"},
    "best": {"profile": [0.0], "seconds": 0.0},
    "save": {"name": "a", "kind": "csv"},
}


def test_answer__is_the_evaluation_of_that_world(client: Client, scenario: Scenario, state: dict[str, Any]) -> None:
    state["gaps_m"][0], state["mass_t"][2], state["restitution"] = 7.25, 11.0, 0.3
    reply = client.ask("answer", {"world": state, "profile": [-100.0]})
    assert reply.status == 200
    worlds = scenario.worlds_from_state(state)
    expected = evaluate(worlds, make_lineup(AGENTS, scenario), scenario=scenario)
    *others, hand = reply.json["outcomes"]
    for told, (name, outcome) in zip(others, expected.outcomes.items(), strict=True):
        found = name, outcome.impacts[0], outcome.first_impact_harm[0], outcome.total_harm[0]
        assert (told["agent"], told["impacts"], told["first"], told["total"]) == found
    assert (hand["agent"], hand["first"]) == ("by hand", others[0]["first"])  # beyond its capacity: full braking
    proof = prove(worlds, Task(scenario, scenario.learners))
    verdict = reply.json["verdict"]
    assert (verdict["avoidable"], verdict["proven_harm"]) == (bool(proof.avoidable[0]), float(proof.harm[0]))
    assert reply.json["constant"]["first"] == float(optimise_coupled(worlds, 1).harm[0])
    assert reply.json["grid"] == {"first_s": 0.5, "step_s": 0.1, "steps": 75, "low_mps2": -7.0, "high_mps2": 7.0}
    assert len(reply.json["world"]["episodes"]) == 4


def test_search__starts_where_h_star_is_is_driven_again_and_never_worse(
    client: Client, explored: Explored, scenario: Scenario, state: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = client.ask("best", {"world": state, "profile": [0.0], "seconds": 0.0}).json
    again = client.ask("answer", {"world": state, "profile": found["commands"]}).json
    hand = again["outcomes"][-1]
    assert (hand["first"], hand["total"], found["candidates"]) == (found["first"], found["total"], 4_000)
    assert again["verdict"]["proven_harm"] <= found["first"] <= again["constant"]["first"] + 1e-9
    monkeypatch.setattr("ethbrake_marl.pages.explorer.SLICE", 1)
    for k in range(5):
        world = scenario.sample(1, DEFAULT.LIST_SEED, first=k).worlds
        found = explored.search(world, np.array([0.0]), 0.0, lambda: True)
        assert found["first"] <= explored.best_constant(world)["first"] + 1e-9
        folded = explored.search(world, np.array(found["commands"]), 0.0, lambda: True)  # the profile by hand
        assert folded["first"] <= found["first"]


def test_profile__of_an_agent_drives_as_the_agent(client: Client, state: dict[str, Any]) -> None:
    commands = client.ask("profile", {"world": state, "agent": "ppo@shipped"}).json["commands"]
    *_, policy, hand = client.ask("answer", {"world": state, "profile": commands}).json["outcomes"]
    assert (hand["first"], hand["total"], hand["impacts"]) == (policy["first"], policy["total"], policy["impacts"])


def test_sliders__are_named_by_vehicle_or_pair(scenario: Scenario) -> None:
    groups = slider_groups(scenario, Conditions.of(scenario.sample(1, DEFAULT.LIST_SEED).worlds))
    named = {group["field"]: group["names"] for group in groups}
    assert (named["gaps_m"], named["restitution"]) == (["1 to 2", "2 to 3"], [""])
    assert named["mass_t"] == ["Vehicle 1", "Vehicle 2", "Vehicle 3"]
    slow = load_scenario("paper-random-buildup")
    state = Conditions.of(slow.sample(1, DEFAULT.LIST_SEED).worlds)
    rates = [(group["field"], group["unit"]) for group in slider_groups(slow, state) if group["field"].endswith("3")]
    assert rates == [("brake_rate_mps3", "m/s³"), ("release_rate_mps3", "m/s³")]


@pytest.mark.parametrize("number", [12, 10**9])
def test_world__is_that_of_the_list(client: Client, scenario: Scenario, number: int) -> None:
    told = client.ask("world", {"number": number}).json["world"]
    world = scenario.sample(1, DEFAULT.LIST_SEED, first=number).worlds
    assert told == Conditions.of(world) == Conditions.of(read_state(json.loads(json.dumps(told)), scenario))


@pytest.mark.parametrize(
    "name", ["paper-random-buildup", "paper-random-obstacle", "realistic-motorway", "realistic-mixed"]
)
def test_saved_state__reads_back_to_the_same_harm(name: str, folder: Path) -> None:
    scenario = load_scenario(name)
    world = scenario.sample(1, DEFAULT.LIST_SEED, first=3).worlds
    state = Conditions.of(world)
    state["speeds_mps"][0] += 0.1 + 0.2
    changed = read_state(state, scenario)
    for kind in ("yaml", "csv"):
        assert save_state(folder, "near-miss", kind, changed, scenario) == f"near-miss.{kind}"
    saved = load_scenario(folder / "near-miss.yaml")
    agents = make_lineup(["full_brake"], scenario)
    harms = set()
    for worlds, where in (
        (changed, scenario),
        (saved.sample(1, 99).worlds, saved),
        (scenario.read_worlds(folder / "near-miss.csv"), scenario),
    ):
        outcome = evaluate(worlds, agents, scenario=where, aftermath=False).outcome("full_brake")
        harms.add((float(outcome.first_impact_harm[0]), float(outcome.total_harm[0])))
    assert len(harms) == 1
    state["gaps_m"][0] = 0.01  # an impact before anybody acts
    save_state(folder, "early", "yaml", read_state(state, scenario), scenario)
    drawn = load_scenario(folder / "early.yaml").sample(1, 5)
    assert (drawn.rejected, drawn.worlds.gaps_m[0, 0]) == (0, 0.01)
    (folder / "a.csv").mkdir()
    with pytest.raises(AlreadyExists, match=r"a\.csv: is there already"):
        save_state(folder, "a", "csv", changed, scenario)


def test_page__shows_hostile_names_as_text(scenario: Scenario, state: dict[str, Any]) -> None:
    hostile = "</script><img src=x onerror=alert(1)>\u202e"
    lineup = make_agents(["full_brake"], scenario)
    changed = scenario.replace(title=hostile)
    text = explorer_page(
        Explored(Task(changed, changed.learners), {hostile: lineup["full_brake"]}), state, world=0, seed=7
    ).html
    assert "<img" not in text and "\u202e" not in text
    content = json.loads(text.partition('id="explorer_data">')[2].partition("</script>")[0])
    assert content["named"] == [hostile] and all(name.isprintable() for name in content["agents"])


def test_server__answers_and_saves(running: Running) -> None:
    status, page = ask(running, "GET", running.address.path)
    assert status == 200 and b"Explorer: paper-random" in page
    assert ask(running, "GET", "/")[0] == 403
    status, told = ask(running, "POST", running.address.path + "world", {"number": 3})
    question = {"world": json.loads(told)["world"], "name": "three", "kind": "csv"}
    assert status == 200 and len(question["world"]["gaps_m"]) == 2
    assert ask(running, "POST", running.address.path + "save", question)[0] == 200
    assert [each.name for each in running.folder.iterdir()] == ["three.csv"]


def test_server__does_not_wait_for_acknowledgements(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Nagle's algorithm, by which an answer waits 40 ms, is off only where a socket is TCP's by name (asyncio)."""
    named: list[int] = []
    monkeypatch.setattr("uvicorn.Server.run", lambda self, sockets: named.extend(each.proto for each in sockets))
    assert run_command(["watch", "explore", "--no-browser", "--agents", "full_brake", "--folder", str(tmp_path)]) == 0
    assert named == [socket.IPPROTO_TCP]


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
    with socket.create_connection(("127.0.0.1", running.address.port), timeout=20) as stream:
        try:
            stream.sendall(garbage)
            stream.shutdown(socket.SHUT_WR)
            told = stream.recv(4_096)
        except OSError:  # it hung up first
            told = b""
    assert b" 200 " not in told and ask(running, "POST", running.address.path + "world", {"number": 1})[0] == 200


def test_server__listens_on_this_machine_alone(running: Running) -> None:
    listening = [line.split()[1] for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    port = f":{running.address.port:04X}"
    assert [each for each in listening if each.endswith(port)][:1] == [f"0100007F{port}"]
    assert "00000000" + port not in listening


def test_server__ends_at_ctrl_c(tmp_path: Path) -> None:
    """A server of its own: which of this file's tests comes last is for the runner to say."""
    with started(tmp_path / "new") as running:
        with socket.create_connection(("127.0.0.1", running.address.port)):  # somebody is still there
            running.process.send_signal(signal.SIGINT)
            assert running.process.wait(timeout=60) == 0
        assert running.process.stderr is not None and running.process.stderr.read().splitlines()[-1] == "ended"


def test_ctrl_c_while_the_address_is_told_ends_it_too(explored: Explored, tmp_path: Path) -> None:
    pytest.importorskip("uvicorn")

    def interrupted(address: str) -> None:
        with suppress(KeyboardInterrupt):  # as Python does in a callback
            signal.raise_signal(signal.SIGINT)

    again = threading.Timer(30.0, os.kill, (os.getpid(), signal.SIGINT))
    again.start()
    serve_explorer(explored.task, explored.lineup, tmp_path, 0, interrupted, seed=DEFAULT.LIST_SEED, world=0)
    assert again.is_alive()
    again.cancel()


def test_long_questions_are_cut_off(client: Client, state: dict[str, Any]) -> None:
    check_refused(client.ask("answer", b" " * (MOST_BODY + 1)), 413)
    endless = (b" " * 1_000 for _ in range(10**9))
    check_refused(client.request("POST", PAGE + "answer", endless), 413)
    check_alive(client)
    almost = json.dumps({"world": state, "profile": [0.0]}).encode()
    assert client.ask("answer", almost + b" " * (MOST_BODY - len(almost))).status == 200


def test_questions_that_never_end_are_given_up(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ethbrake_marl.pages.explorer.PATIENCE_S", 0.05)

    async def silent() -> Any:
        await asyncio.sleep(60)

    check_refused(client.request("POST", PAGE + "world", receive=silent), 408)


def test_a_defect_is_told_and_survived(client: Client, state: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*arguments: object) -> None:
        raise RuntimeError("a\nb")

    with monkeypatch.context() as patched:
        patched.setattr("ethbrake_marl.pages.explorer.Explored.answer", broken)
        check_refused(client.ask("answer", {"world": state, "profile": [0.0]}), 500)
    assert client.ask("answer", {"world": state, "profile": [0.0]}).status == 200


def test_newest_question_wins(client: Client, state: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Three at once: the first is begun, the second is given up when the third comes."""

    async def ask() -> list[Reply]:
        questions = []
        for k in range(3):
            body = json.dumps({"world": state | {"restitution": 0.1 * k}, "profile": [0.0]}).encode()
            questions.append(asyncio.create_task(client.asked("POST", PAGE + "answer", body)))
            await asyncio.to_thread(begun.wait, 20)  # the first; the others find it at work
            await asyncio.sleep(0.02)
        return await asyncio.gather(*questions)

    client.ask("answer", {"world": state, "profile": [0.0]})  # the warm-up is over
    slow, begun = Explored.answer, threading.Event()

    def slower(self: Explored, world: Any, profile: Any) -> Any:
        begun.set()
        time.sleep(0.5)
        return slow(self, world, profile)

    monkeypatch.setattr(Explored, "answer", slower)
    first, second, third = asyncio.run(ask())
    assert (first.status, second.status, third.status, second.json["superseded"]) == (200, 409, 200, True)


def test_page__is_under_a_strict_policy(client: Client) -> None:
    reply = client.request("GET", PAGE, headers={"origin": None, "sec-fetch-site": "none"})
    assert (reply.status, reply.headers["content-type"]) == (200, "text/html; charset=utf-8")
    policy = reply.headers["content-security-policy"]
    assert "default-src 'none'" in policy and "frame-ancestors 'none'" in policy and "unsafe" not in policy
    assert (reply.headers["referrer-policy"], reply.headers["cache-control"]) == ("no-referrer", "no-store")
    text = reply.body.decode()
    assert TOKEN not in text and "http" not in text.replace("http://www.w3.org/2000/svg", "").replace("http-equiv", "")


@pytest.mark.parametrize("body", BODIES, ids=lambda body: ascii(body[:30]))
def test_body__that_is_no_question_is_refused(client: Client, body: bytes) -> None:
    check_refused(client.ask("world", body), 400)
    check_alive(client)


@pytest.mark.parametrize(("key", "value"), STATES, ids=lambda each: ascii(each)[:30])
def test_state__that_is_none_is_refused_by_its_key(client: Client, state, folder: Path, key: str, value: Any) -> None:
    changed = {name: each for name, each in {**state, key: value}.items() if each is not MISSING}
    reply = client.ask("save", {"world": changed, **GOOD["save"]})
    check_refused(reply, 400)
    assert list(folder.iterdir()) == [] and (value is not MISSING or key in reply.json["error"])


@pytest.mark.parametrize(("what", "key", "value"), NONE, ids=lambda each: ascii(each)[:20])
def test_question__with_what_cannot_be_is_refused_and_nothing_is_written(
    client: Client, state: dict[str, Any], folder: Path, what: str, key: str, value: object
) -> None:
    check_refused(client.ask(what, {"world": state, **GOOD[what], key: value}), 400)
    assert list(folder.parent.iterdir()) == [folder] and list(folder.iterdir()) == []


def test_save__never_replaces_and_never_follows_and_tells_that_its_folder_went(client, folder: Path, state) -> None:
    question = {"world": state, "name": "kept", "kind": "yaml"}
    assert client.ask("save", question).json == {"file": "kept.yaml"}
    before = (folder / "kept.yaml").read_bytes()
    reply, outside = client.ask("save", question), folder.parent / "outside"
    assert reply.status == 400 and "is there already" in reply.json["error"]
    (folder / "link.csv").symlink_to(outside)
    assert client.ask("save", question | {"name": "link", "kind": "csv"}).status == 400
    assert (folder / "kept.yaml").read_bytes() == before and not outside.exists()
    shutil.rmtree(folder)
    reply = client.ask("save", question)
    assert reply.status == 500 and reply.json["error"].startswith("cannot be written")


HEADERS: list[dict[str, str | None]] = [
    *(
        {"host": each}
        for each in (
            None, "", "evil.example", f"evil.example:{PORT}", "127.0.0.1", f"127.0.0.1:{PORT + 1}",
            f"127.0.0.1:{PORT}.evil.example", f"0.0.0.0:{PORT}", f"[::1]:{PORT}", f"127.0.0.1:{PORT}@evil.example",
            f"LOCALHOST:{PORT}",
        )
    ),
    *(
        {"origin": each}
        for each in (
            "null", "", "https://evil.example", f"https://{HOST}", f"http://127.0.0.1:{PORT + 1}",
            f"http://localhost:{PORT}", f"http://{HOST}.evil.example",
        )
    ),
    *({"sec-fetch-site": each} for each in ("cross-site", "same-site", "\xff")),
]  # fmt: skip


@pytest.mark.parametrize("headers", HEADERS, ids=str)
def test_stranger__by_its_headers_is_refused(client: Client, headers: dict[str, str | None]) -> None:
    check_refused(client.ask("world", {"number": 0}, headers=headers), 403)
    if "origin" not in headers:
        check_refused(client.request("GET", PAGE, headers=headers), 403)
    check_alive(client)


REQUESTS = [
    *(
        (method, path, 403)
        for method in ("GET", "POST")
        for path in (
            "/", "//", "///", "", "/x/", f"/{TOKEN}", f"/{TOKEN[:-1]}/", f"/{TOKEN}x/", f"/{TOKEN.upper()}/",
            f"/x/{TOKEN}/", f"/{TOKEN}/../etc/passwd", f"/{TOKEN}/answer/", f"/{TOKEN}\x00/", f"/\u202e{TOKEN}/",
            "/" + "a" * 10_000 + "/", "/docs/", "/\udcff/",
        )
    ),
    ("GET", PAGE + "answer", 405), ("PUT", PAGE + "answer", 405), ("DELETE", PAGE + "save", 405),
    ("OPTIONS", PAGE + "save", 405), ("POST", PAGE, 405), ("TRACE", PAGE, 405), ("POST", PAGE + "shutdown", 404),
    ("GET", PAGE + "..", 404), ("GET", PAGE + "explorer.js", 404), ("POST", PAGE + "<script>", 404),
]  # fmt: skip


@pytest.mark.parametrize(("method", "path", "status"), REQUESTS, ids=ascii)
def test_request__of_another_method_or_place_is_refused(client: Client, method: str, path: str, status: int) -> None:
    check_refused(client.request(method, path), status)


def test_request__that_another_page_could_send_is_refused(client: Client) -> None:
    for header in (("host", HOST), ("origin", f"http://{HOST}"), ("sec-fetch-site", "none")):
        check_refused(client.request("GET", PAGE, twice=header), 403)
    for kind in (None, "", "text/plain", "application/x-www-form-urlencoded", "multipart/form-data"):
        check_refused(client.ask("world", {"number": 1}, headers={"content-type": kind}), 400)
    own = {"host": f"localhost:{PORT}", "origin": f"http://localhost:{PORT}"}  # another name of this machine
    assert client.ask("world", {"number": 1}, headers=own).status == 200


def test_command__says_whose_port_it_is_and_names_its_extra(monkeypatch, capsys, tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        options = ["--agents", "full_brake", "--port", str(taken.getsockname()[1]), "--folder", str(tmp_path)]
        assert run_command(["watch", "explore", "--no-browser", *options]) == 2
    assert "Address already in use" in capsys.readouterr().err
    monkeypatch.setattr("ethbrake_marl.errors.find_spec", lambda name: None)
    assert run_command(["watch", "explore", "--no-browser"]) == 2
    assert "-m pip install 'ethbrake-marl[explore]'" in capsys.readouterr().err
