"""The guard in front of the explorer's server: who may ask, before anything that was sent is read.

The server listens on this machine alone, but every web page that is open in a browser here can send requests to it. The
token in the address stops those who do not know it; ``Host`` stops a name of somebody else's that was made to point
here (DNS rebinding); ``Origin`` and ``Sec-Fetch-Site`` stop other pages, whatever they know. See decision 0037.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

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
        if status:
            await _tell(send_guarded, status, why)
        else:
            await self._app(scope, receive, send_guarded)

    def _refusal(self, scope: Scope) -> tuple[int, str]:
        """Status and reason for a request that is not answered; 0 for one that is."""
        hosts, origins, sites = (_values(scope, name) for name in (b"host", b"origin", b"sec-fetch-site"))
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


def _values(scope: Scope, name: bytes) -> list[bytes]:
    return [value for key, value in scope["headers"] if key.lower() == name]


async def _tell(send: Send, status: int, why: str) -> None:
    body = json.dumps({"error": why}).encode()
    headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})
