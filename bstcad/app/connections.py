"""Connections of browsers: the socket on loopback and uvicorn's server, which ends at once when it is to end.

A connection is closed where a request's headers do not come to an end: uvicorn would wait forever.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from bstcad.scene.errors import SceneError

SLOWEST = 1  # seconds that open requests have when the server ends
HEADERS_WITHIN = 10.0  # seconds from the beginning of a connection, or of a further request on it, to the headers' end


class HeadersInTime(H11Protocol):
    """A connection that waits HEADERS_WITHIN for the headers of a request, however many bytes come meanwhile.

    A connection on which no further request begins is closed by uvicorn itself (timeout_keep_alive).
    """

    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for the first request."""
        super().connection_made(transport)
        self._wait()

    def data_received(self, data: bytes) -> None:
        """Go on with a request, or begin to wait for a further one."""
        super().data_received(data)
        self._wait()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no longer."""
        super().connection_lost(exc)
        self._stop_waiting()

    def _wait(self) -> None:
        """Wait where no request has all its headers; begun once, so that a byte now and then gains no time."""
        if self.conn.their_state is not h11.IDLE:
            self._stop_waiting()
        elif self._deadline is None:
            self._deadline = self.loop.call_later(HEADERS_WITHIN, self._close)

    def _stop_waiting(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None

    def _close(self) -> None:
        self._deadline = None
        if self.conn.their_state is h11.IDLE and not self.transport.is_closing():
            self.transport.close()


@contextlib.contextmanager
def bound(port: int) -> Iterator[socket.socket]:
    """A socket on loopback; port 0: a free one.  SceneError if the port is taken."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as own:
        own.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            own.bind(("127.0.0.1", port))
        except OSError as error:
            raise SceneError(f"--port {port}: cannot be had ({error.strerror}); give another one, or none") from None
        own.listen()  # a browser that comes before the server answers waits
        yield own


def uvicorn_server(app: Any, ends: Callable[[], None] = lambda: None) -> uvicorn.Server:
    """The server of an application, which writes nothing to the terminal; ends: called when a signal ends it."""
    config = uvicorn.Config(
        app, log_level="critical", access_log=False, server_header=False, lifespan="off", ws="none",
        http=HeadersInTime, timeout_graceful_shutdown=SLOWEST,
    )  # fmt: skip
    return _Server(config, ends)


class _Server(uvicorn.Server):
    """A server that wakes the requests that wait, as soon as it is to end."""

    def __init__(self, config: uvicorn.Config, ends: Callable[[], None]) -> None:
        super().__init__(config)
        self._ends = ends

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Hear a signal."""
        self._ends()
        super().handle_exit(sig, frame)
