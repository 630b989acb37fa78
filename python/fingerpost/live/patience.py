"""Limits of connections: their number, and the time for a request."""

from __future__ import annotations

import asyncio
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

ASKING_S = 3.0
"""Time limit for a request [s]."""

MOST_CONNECTIONS = 64
"""Greatest number of open connections; more are refused, without effect on open pages."""


class ImpatientProtocol(H11Protocol):
    """HTTP with a limit on the number of connections, and on the time for a request."""

    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        """Start the timer of a new connection, or refuse it."""
        super().connection_made(transport)
        if len(self.connections) > MOST_CONNECTIONS:
            self._refuse(503, f"{MOST_CONNECTIONS} connections are open already")
            return
        self._deadline = self.loop.call_later(ASKING_S, self._end_waiting)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget a connection."""
        self._asked()
        super().connection_lost(exc)

    def handle_events(self) -> None:
        """Handle received data; a complete request stops the timer, its answer restarts it."""
        super().handle_events()
        if self.conn.their_state is not h11.IDLE:
            self._asked()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Hand the connection over."""
        self._asked()
        super().handle_websocket_upgrade(event)

    def _asked(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None

    def _end_waiting(self) -> None:
        self._deadline = None
        self._refuse(408, f"nothing was asked for within {ASKING_S:g} s")

    def _refuse(self, status: int, words: str) -> None:
        body = f"{words}\n".encode()
        head = f"HTTP/1.1 {status} {words}\r\ncontent-type: text/plain\r\n"
        ending = f"content-length: {len(body)}\r\nconnection: close\r\n\r\n"
        self.transport.write(f"{head}{ending}".encode() + body)
        self.transport.close()
