"""The guard before every request, since any web page and any local program can talk to a server on loopback.

A request is accepted on three conditions: its header Host names this server (a foreign name may point here); its
headers Origin and Sec-Fetch-Site, if any, show that no other page sent it; and it has the token of this start, in the
address that the terminal prints or in the cookie that this address sets.  The size of a body is checked as it arrives.
"""

from __future__ import annotations

import contextlib
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

MAX_BODY_SIZE = 4_000_000  # largest size of a body (bytes), enough for a scene file as JSON
POLICY = (  # Content-Security-Policy of the answers
    "default-src 'self'; img-src 'self' data: blob:; object-src 'none'; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'none'"
)
SANDBOX = (  # Content-Security-Policy of the HTML files of a design
    "sandbox allow-scripts; default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:"
)
HEADERS = {  # headers of every answer that does not set them itself
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Content-Security-Policy": POLICY,
}
OWN_SITES = ("same-origin", "none")  # accepted Sec-Fetch-Site: pages of this server, or an address that a person typed
REFUSALS = {  # sentences for the user, by the condition that the request does not meet
    "host": "This address is not the workbench's; open the address that the terminal shows.",
    "origin": "Another web page sent this request; the workbench answers only its own pages.",
    "token": "The workbench was restarted, or this address is incomplete; open the address that the terminal shows. "
    "Nothing is lost: scenes and designs are in their folders.",
    "size": "The request is too large; send a smaller file.",
}


class TooLarge(Exception):
    """The body of a request exceeds its limit."""


class Guard:
    """ASGI middleware that protects the application during one start of the server."""

    def __init__(self, app: Any, port: int, token: str, larger: tuple[str, int] = ("", 0)) -> None:
        """Guard `app`.  larger: regular expression of the paths that allow larger bodies, and the limit in bytes."""
        self._app, self._token, self._larger = app, token, larger
        self.cookie = f"bstcad-{port}"  # name of the cookie, with the port, since browsers share cookies between ports
        self._hosts = {f"{name}:{port}" for name in ("127.0.0.1", "localhost")}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse a request, or pass it to the application."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":  # the workbench uses no web sockets
            await send({"type": "websocket.close", "code": 1008})
            return
        send = _with_headers(send)
        refused = self._refusal(scope)
        if refused is not None:
            await refused(scope, receive, send)
            return
        limit = self._larger[1] if re.fullmatch(self._larger[0], scope["path"]) else MAX_BODY_SIZE
        length = Headers(scope=scope).get("content-length", "")
        if length.isdecimal() and int(length) > limit:
            await _refusal("size", 413)(scope, receive, send)
            return
        body = _Body(receive, send, limit)
        with contextlib.suppress(TooLarge):
            await self._app(scope, body.receive, body.send)
        if body.is_too_large and not body.answered:
            await _refusal("size", 413)(scope, receive, send)

    def _refusal(self, scope: Scope) -> Response | None:
        """Return the refusal of a request, or the redirect of an address with a token; None: it is accepted."""
        headers = Headers(scope=scope)
        if headers.get("host", "") not in self._hosts:
            return _refusal("host", 403)
        origin, site = headers.get("origin"), headers.get("sec-fetch-site", "none")
        if origin is not None and origin.removeprefix("http://") not in self._hosts:
            return _refusal("origin", 403)
        given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        if scope["method"] == "GET" and given and self._is_token(given):  # a link followed from any terminal
            answer = _redirect(scope["path"], from_own=site in OWN_SITES)
            answer.set_cookie(self.cookie, self._token, httponly=True, samesite="strict", path="/")
            return answer
        if site not in OWN_SITES:
            return _refusal("origin", 403)
        if not self._is_token(cookie_parser(headers.get("cookie", "")).get(self.cookie, "")):
            return _refusal("token", 403)
        return None

    def _is_token(self, given: str) -> bool:
        return secrets.compare_digest(given.encode(), self._token.encode())


def _refusal(why: str, code: int) -> Response:
    return PlainTextResponse(REFUSALS[why], status_code=code)


def _redirect(path: str, from_own: bool) -> Response:
    """Return an answer that leads to the same page without the token in its address.

    Browsers count a redirect as a request of the page with the link.  If this page is foreign (not from_own), such as a
    terminal in a browser, they omit the strict cookie; then, a page of this server leads to the address instead.
    """
    address = quote("/" + path.lstrip("/"))  # //name would be another server; `quote` leaves no quotation mark
    if from_own:
        return RedirectResponse(address, status_code=303)
    return HTMLResponse(f'<!doctype html><title>bstcad</title><meta http-equiv="refresh" content="0;url={address}">')


class _Body:
    """The body of a request, with a limit, and the answer, which is dropped once the limit is exceeded."""

    def __init__(self, receive: Receive, send: Send, limit: int) -> None:
        self._receive, self._send, self._left = receive, send, limit
        self.answered = False

    @property
    def is_too_large(self) -> bool:
        """True if the limit is exceeded."""
        return self._left < 0

    async def receive(self) -> MutableMapping[str, Any]:
        """Return the next part of the body.  TooLarge if the limit is exceeded."""
        message = await self._receive()
        self._left -= len(message.get("body", b""))
        if self._left < 0:
            raise TooLarge
        return message

    async def send(self, message: MutableMapping[str, Any]) -> None:
        """Send the answer, unless the body is too large: starlette answers an error before raising it."""
        if self._left >= 0:
            self.answered = True
            await self._send(message)


def _with_headers(send: Send) -> Send:
    async def sent(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in HEADERS.items():
                headers.setdefault(name, value)
        await send(message)

    return sent
