"""Strangers and other pages: whoever is not the page itself is told nothing but one clear error as JSON."""

from __future__ import annotations

import pytest

from tests.pages.explorer.conftest import HOST, PAGE, PORT, TOKEN, Client, check_alive, check_refused

HEADERS: list[dict[str, str | None]] = [
    {"host": None},
    {"host": ""},
    {"host": "evil.example"},
    {"host": f"evil.example:{PORT}"},
    {"host": "127.0.0.1"},
    {"host": f"127.0.0.1:{PORT + 1}"},
    {"host": f"127.0.0.1:{PORT}.evil.example"},
    {"host": f"0.0.0.0:{PORT}"},
    {"host": f"[::1]:{PORT}"},
    {"host": f"127.0.0.1:{PORT}@evil.example"},
    {"host": f"LOCALHOST:{PORT}"},
    {"origin": "null"},
    {"origin": ""},
    {"origin": "https://evil.example"},
    {"origin": f"https://{HOST}"},
    {"origin": f"http://127.0.0.1:{PORT + 1}"},
    {"origin": f"http://localhost:{PORT}"},
    {"origin": f"http://{HOST}.evil.example"},
    {"sec-fetch-site": "cross-site"},
    {"sec-fetch-site": "same-site"},
    {"sec-fetch-site": "\xff"},
]


@pytest.mark.parametrize("headers", HEADERS, ids=str)
def test_other_hosts_and_pages_are_refused(client: Client, headers: dict[str, str | None]) -> None:
    check_refused(client.ask("world", {"number": 0}, headers=headers), 403)
    if "origin" not in headers:
        check_refused(client.request("GET", PAGE, headers=headers), 403)
    check_alive(client)


@pytest.mark.parametrize("header", [("host", HOST), ("origin", f"http://{HOST}"), ("sec-fetch-site", "none")])
def test_headers_that_stand_twice_are_refused(client: Client, header: tuple[str, str]) -> None:
    check_refused(client.request("GET", PAGE, twice=header), 403)


PATHS = [
    "/",
    "//",
    "///",
    "",
    "/x/",
    f"/{TOKEN}",
    f"/{TOKEN[:-1]}/",
    f"/{TOKEN}x/",
    f"/{TOKEN.upper()}/",
    f"/x/{TOKEN}/",
    f"/{TOKEN}/../etc/passwd",
    f"/{TOKEN}/answer/",
    f"/{TOKEN}\x00/",
    f"/\u202e{TOKEN}/",
    "/" + "a" * 10_000 + "/",
    "/docs/",
    "/\udcff/",
]


@pytest.mark.parametrize("path", PATHS, ids=ascii)
def test_without_the_token_nothing_is_told(client: Client, path: str) -> None:
    for method in ("GET", "POST"):
        check_refused(client.request(method, path), 403)


@pytest.mark.parametrize(
    ("method", "what", "status"),
    [
        ("GET", "answer", 405),
        ("PUT", "answer", 405),
        ("DELETE", "save", 405),
        ("OPTIONS", "save", 405),
        ("POST", "", 405),
        ("TRACE", "", 405),
        ("POST", "shutdown", 404),
        ("GET", "..", 404),
        ("GET", "explorer.js", 404),
        ("POST", "<script>", 404),
    ],
)
def test_other_methods_and_places_are_refused(client: Client, method: str, what: str, status: int) -> None:
    check_refused(client.request(method, PAGE + what), status)


@pytest.mark.parametrize("kind", [None, "", "text/plain", "application/x-www-form-urlencoded", "multipart/form-data"])
def test_what_a_form_could_send_is_refused(client: Client, kind: str | None) -> None:
    check_refused(client.ask("world", {"number": 1}, headers={"content-type": kind}), 400)


def test_page__is_under_a_strict_policy(client: Client) -> None:
    reply = client.request("GET", PAGE, headers={"origin": None, "sec-fetch-site": "none"})
    assert (reply.status, reply.headers["content-type"]) == (200, "text/html; charset=utf-8")
    policy = reply.headers["content-security-policy"]
    assert "default-src 'none'" in policy and "frame-ancestors 'none'" in policy and "unsafe" not in policy
    assert reply.headers["referrer-policy"] == "no-referrer" and reply.headers["cache-control"] == "no-store"
    text = reply.body.decode()
    assert TOKEN not in text and "http" not in text.replace("http://www.w3.org/2000/svg", "").replace("http-equiv", "")


def test_other_names_of_this_machine_are_the_same_origin_only_for_themselves(client: Client) -> None:
    own = {"host": f"localhost:{PORT}", "origin": f"http://localhost:{PORT}"}
    assert client.ask("world", {"number": 1}, headers=own).status == 200
