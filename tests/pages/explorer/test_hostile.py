"""Nonsense from somebody who knows the token: one clear error each, nothing is written, and the server goes on."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from ethbrake_marl.pages.explorer import MOST_BODY
from tests.pages.explorer.conftest import HOST, PAGE, Client, Reply, check_alive, check_refused

BODIES: list[bytes] = [
    b"",
    b"{",
    b"null",
    b"[]",
    b'"world"',
    b"\xff\xfe",
    b"[" * 30_000,
    b'{"number": NaN}',
    b'{"number": Infinity}',
    b'{"number": 1e999}',
    b'{"number": 1, "number": 2}',
    b'{"number": ' + b"9" * 20_000 + b"}",
    b'{"number": true}',
    b'{"number": 1.5}',
    b'{"number": -1}',
    b'{"number": 99999999999}',
    b'{"number": "1"}',
    b'{"number": null}',
    b'{"number": 1, "scenario": "/etc/passwd"}',
    b'{"number": 1, "__proto__": {}}',
    b'{"\\u202enumber": 1}',
    b"{}",
]


@pytest.mark.parametrize("body", BODIES, ids=lambda body: ascii(body[:30]))
def test_what_is_no_question_is_refused(client: Client, body: bytes) -> None:
    check_refused(client.ask("world", body), 400)
    check_alive(client)


STATES: list[tuple[str, Any]] = [
    ("gaps_m", [7]),
    ("gaps_m", 7),
    ("gaps_m", [7, "7"]),
    ("gaps_m", [7, True]),
    ("gaps_m", [7, None]),
    ("gaps_m", [7, [7]]),
    ("gaps_m", [-1, 7]),
    ("gaps_m", [1e300, 7]),
    ("gaps_m", [10**400, 7]),
    ("gaps_m", [7] * 10_000),
    ("speeds_mps", [41, 18, 20]),
    ("speeds_mps", [20, 18]),
    ("mass_t", [0, 5, 5]),
    ("latency_s", [0, 0.5, 8]),
    ("restitution", 1.1),
    ("restitution", [0.1]),
    ("restitution", "0.1"),
    ("obstacle_gap_m", 50),
    ("hazard_gap_m", 50),
    ("roles", {"vehicle_2": "ppo@/etc/passwd"}),
    ("<script>alert(1)</script>", 1),
]


@pytest.mark.parametrize(("key", "value"), STATES, ids=lambda each: ascii(each)[:30])
def test_states_that_are_none_are_refused(
    client: Client, state: dict[str, Any], folder: Path, key: str, value: Any
) -> None:
    question = {"world": state | {key: value}, "name": "a", "kind": "yaml"}
    check_refused(client.ask("save", question), 400)
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("missing", ["gaps_m", "speeds_mps", "restitution", "speed_limit_mps"])
def test_every_quantity_is_asked_for(client: Client, state: dict[str, Any], missing: str) -> None:
    del state[missing]
    reply = client.ask("answer", {"world": state, "profile": [0.0]})
    check_refused(reply, 400)
    assert missing in reply.json["error"]


@pytest.mark.parametrize("profile", [[], [0.0] * 2_001, None, [None], ["-7"], {"0": 1}, 3, [True], [1e200]], ids=str)
def test_profiles_that_are_none_are_refused(client: Client, state: dict[str, Any], profile: object) -> None:
    check_refused(client.ask("answer", {"world": state, "profile": profile}), 400)


@pytest.mark.parametrize("agent", ["sac@shipped", "ppo@/etc/passwd", "../full_brake", "", None, ["full_brake"], 0])
def test_agents_that_are_not_shown_are_never_loaded(client: Client, state: dict[str, Any], agent: object) -> None:
    check_refused(client.ask("profile", {"world": state, "agent": agent}), 400)


@pytest.mark.parametrize("seconds", [-1, 31, 1e9, None, "1", True])
def test_searches_end(client: Client, state: dict[str, Any], seconds: object) -> None:
    check_refused(client.ask("best", {"world": state, "profile": [0.0], "seconds": seconds}), 400)


NAMES: list[object] = [
    "",
    ".",
    "..",
    "../up",
    "/etc/passwd",
    "a/b",
    "a\\b",
    "c:a",
    "a.yaml",
    ".hidden",
    "-rf",
    "_a",
    "A",
    "a b",
    "a\n",
    "a\x00",
    "a\x00.txt",
    "\u202eabc",
    "\uff41",  # a wide letter
    "é",
    "<img>",
    "a'b",
    'a"b',
    "$(id)",
    "con",
    "nul",
    "com1",
    "lpt9",
    "a" * 65,
    "a" * 10_000,
    None,
    7,
    ["a"],
    {"a": 1},
]


@pytest.mark.parametrize("name", NAMES, ids=lambda each: ascii(each)[:20])
def test_names_of_files_are_strict(client: Client, state: dict[str, Any], folder: Path, name: object) -> None:
    for kind in ("yaml", "csv"):
        check_refused(client.ask("save", {"world": state, "name": name, "kind": kind}), 400)
    assert list(folder.parent.iterdir()) == [folder]
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("kind", ["", "json", "yaml/../x", ".yaml", "YAML", None, 1, ["csv"], "py"])
def test_kinds_of_files_are_two(client: Client, state: dict[str, Any], folder: Path, kind: object) -> None:
    check_refused(client.ask("save", {"world": state, "name": "a", "kind": kind}), 400)
    assert list(folder.iterdir()) == []


def test_long_questions_are_cut_off(client: Client, state: dict[str, Any]) -> None:
    check_refused(client.ask("answer", b" " * (MOST_BODY + 1)), 413)
    endless = (b" " * 1_000 for _ in range(10**9))
    check_refused(client.request("POST", PAGE + "answer", endless), 413)
    check_alive(client)
    almost = json.dumps({"world": state, "profile": [0.0]}).encode()
    assert client.ask("answer", almost + b" " * (MOST_BODY - len(almost))).status == 200


def test_questions_that_never_end_are_given_up(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ethbrake_marl.pages.explorer.PATIENCE_S", 0.05)

    async def ask() -> Reply:
        async def silent() -> Any:
            await asyncio.sleep(60)

        sent: list[Any] = []

        async def send(message: Any) -> None:
            sent.append(message)

        headers = [(b"host", HOST.encode()), (b"content-type", b"application/json")]
        scope = {"type": "http", "method": "POST", "path": PAGE + "world", "headers": headers, "query_string": b""}
        scope |= {"root_path": "", "http_version": "1.1", "scheme": "http"}
        await client.app(scope, silent, send)
        told = {name.decode(): value.decode() for name, value in sent[0]["headers"]}
        return Reply(sent[0]["status"], told, sent[1]["body"])

    check_refused(asyncio.run(ask()), 408)


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

    from ethbrake_marl.pages.explorer import Explored

    client.ask("answer", {"world": state, "profile": [0.0]})  # the warm-up is over
    slow, begun = Explored.answer, threading.Event()

    def slower(self: Explored, world: Any, profile: Any) -> Any:
        begun.set()
        time.sleep(0.5)
        return slow(self, world, profile)

    monkeypatch.setattr(Explored, "answer", slower)
    first, second, third = asyncio.run(ask())
    assert (first.status, second.status, third.status) == (200, 409, 200)
    assert second.json["superseded"] is True
