"""Connections of browsers: the socket on loopback, and a uvicorn server that shuts down without delay.

A connection is closed if the headers of a request do not end in time; uvicorn alone would wait forever.
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

SHUTDOWN_TIMEOUT = 1  # time (s) in which open requests have to finish when the server ends
HEADERS_TIMEOUT = 10.0  # time (s) from the start of a connection, or of a later request, to the end of the headers


class HeadersInTime(H11Protocol):
    """A connection that closes unless all headers of a request arrive within HEADERS_TIMEOUT.

    Single bytes do not restart the timeout.  uvicorn itself closes idle connections (timeout_keep_alive).
    """

    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the timeout of the first request."""
        super().connection_made(transport)
        self._wait()

    def data_received(self, data: bytes) -> None:
        """Receive data of a request; start its timeout, or cancel it once all headers have arrived."""
        super().data_received(data)
        self._wait()

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel the timeout."""
        super().connection_lost(exc)
        self._stop_waiting()

    def _wait(self) -> None:
        """If headers are missing, start the timeout unless it is running; else cancel it."""
        if self.conn.their_state is not h11.IDLE:
            self._stop_waiting()
        elif self._deadline is None:
            self._deadline = self.loop.call_later(HEADERS_TIMEOUT, self._close)

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
    """Listen on a port of the loopback address; 0: any free port.  SceneError if the port is not available."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as own:
        own.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            own.bind(("127.0.0.1", port))
        except OSError as error:
            raise SceneError(f"--port {port}: not available ({error.strerror}); give another, or omit --port") from None
        own.listen()  # browsers that connect before the server runs are queued
        yield own


def uvicorn_server(app: Any, ends: Callable[[], None] = lambda: None) -> uvicorn.Server:
    """Return a server of `app` that prints nothing; `ends` is called when a signal ends the server."""
    quiet = {"log_level": "critical", "access_log": False, "server_header": False, "lifespan": "off", "ws": "none"}
    config = uvicorn.Config(app, http=HeadersInTime, timeout_graceful_shutdown=SHUTDOWN_TIMEOUT, **quiet)
    return _Server(config, ends)


class _Server(uvicorn.Server):
    """Server that ends waiting requests as soon as a signal ends it."""

    def __init__(self, config: uvicorn.Config, ends: Callable[[], None]) -> None:
        super().__init__(config)
        self._ends = ends

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        self._ends()
        super().handle_exit(sig, frame)
