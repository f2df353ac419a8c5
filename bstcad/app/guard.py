"""The guard before every request: any web page, and any program here, can talk to a server on loopback.

A request is let in if its Host is this server's (or a foreign name has been pointed here), its Origin, where there is
one, is this server's (or another page sends it), and it has the token of this start, from the address that the terminal
prints or from the cookie which that sets.  Bodies are counted while they arrive.
"""

from __future__ import annotations

import re
import secrets
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any
from urllib.parse import parse_qs, quote

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import cookie_parser
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]

LARGEST_BODY = 4_000_000  # bytes: a scene file, as JSON
POLICY = (
    "default-src 'self'; img-src 'self' data: blob:; object-src 'none'; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'none'"
)
SANDBOX = (
    "sandbox allow-scripts; default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:"
)
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Content-Security-Policy": POLICY,
}
OWN = ("same-origin", "none")  # pages, by Sec-Fetch-Site: this server's own, or an address that a person typed
WHY_NOT = {
    "host": "This address is not the workbench's; open the one that the terminal shows.",
    "origin": "Another web page asked for this; the workbench answers its own pages alone.",
    "token": "The workbench was started anew, or this address is incomplete: open the one that the terminal shows. "
    "Nothing is lost: scenes and designs lie in their folders.",
    "size": "This is too large to be sent here.",
}


class TooLarge(Exception):
    """A body holds more bytes than it may."""


class Guard:
    """ASGI middleware around the application of one start."""

    def __init__(self, app: Any, port: int, token: str, larger: tuple[str, int] = ("", 0)) -> None:
        """larger: an expression for the paths to which more may be sent, and how many bytes."""
        self._app, self._token, self._larger = app, token, larger
        self.cookie = f"bstcad-{port}"  # cookies know no ports
        self._hosts = {f"{name}:{port}" for name in ("127.0.0.1", "localhost")}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or hand it on."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":  # the workbench has no sockets
            await send({"type": "websocket.close", "code": 1008})
            return
        send = _with_headers(send)
        refused = self._refusal(scope)
        if refused is not None:
            await refused(scope, receive, send)
            return
        most = self._larger[1] if re.fullmatch(self._larger[0], scope["path"]) else LARGEST_BODY
        length = Headers(scope=scope).get("content-length", "")
        if length.isdecimal() and int(length) > most:
            await _refusal("size", 413)(scope, receive, send)
            return
        body = _Body(receive, send, most)
        try:
            await self._app(scope, body.receive, body.send)
        except TooLarge:
            if not body.answered:
                await _refusal("size", 413)(scope, receive, send)

    def _refusal(self, scope: Scope) -> Response | None:
        """Why a request is not let in; None: it is."""
        headers = Headers(scope=scope)
        if headers.get("host", "") not in self._hosts:
            return _refusal("host", 403)
        origin, site = headers.get("origin"), headers.get("sec-fetch-site", "none")
        if origin is not None and origin.removeprefix("http://") not in self._hosts:
            return _refusal("origin", 403)
        given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        if scope["method"] == "GET" and given and self._is_token(given):  # followed from the terminal, wherever that is
            answer = _onward(scope["path"], from_own=site in OWN)
            answer.set_cookie(self.cookie, self._token, httponly=True, samesite="strict", path="/")
            return answer
        if site not in OWN:
            return _refusal("origin", 403)
        if not self._is_token(cookie_parser(headers.get("cookie", "")).get(self.cookie, "")):
            return _refusal("token", 403)
        return None

    def _is_token(self, given: str) -> bool:
        return secrets.compare_digest(given.encode(), self._token.encode())


def _refusal(why: str, code: int) -> Response:
    return PlainTextResponse(WHY_NOT[why], status_code=code)


def _onward(path: str, from_own: bool) -> Response:
    """To the same page without the token in its address.

    A redirect goes on counting as the first page's: one from a terminal in a web page ends in a page that is asked for
    from elsewhere, and without the strict cookie.  So a page of our own leads on from there.
    """
    place = quote("/" + path.lstrip("/"))  # //name would be another server; no quotation mark is left
    if from_own:
        return RedirectResponse(place, status_code=303)
    return HTMLResponse(f'<!doctype html><title>bstcad</title><meta http-equiv="refresh" content="0;url={place}">')


class _Body:
    """A request and its answer, of which there is none once the body holds more bytes than it may."""

    def __init__(self, receive: Receive, send: Send, most: int) -> None:
        self._receive, self._send, self._left = receive, send, most
        self.answered = False

    async def receive(self) -> MutableMapping[str, Any]:
        """The next part of the body.  TooLarge."""
        message = await self._receive()
        self._left -= len(message.get("body", b""))
        if self._left < 0:
            raise TooLarge
        return message

    async def send(self, message: MutableMapping[str, Any]) -> None:
        """Answer, unless the body is too large: starlette answers every error before it hands it on."""
        if self._left >= 0:
            self.answered = True
            await self._send(message)


def _with_headers(send: Send) -> Send:
    """Answers with the policy of their pages."""

    async def sent(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in HEADERS.items():
                headers.setdefault(name, value)
        await send(message)

    return sent
