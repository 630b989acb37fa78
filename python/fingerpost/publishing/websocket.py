"""`ws://`: every client receives each fix as one JSON text, unless it is too slow.

Any page in a browser can connect to servers of its own machine. Connections are therefore accepted
only from pages that this machine serves, from those named by `origin`, and from programs, which
have no origin.
"""

from __future__ import annotations

import asyncio
import logging
import re
import threading
from typing import TYPE_CHECKING, Any

from fingerpost.errors import InvalidInputError
from fingerpost.installation import require
from fingerpost.publishing.address import Address
from fingerpost.publishing.fix import Extent, Pictures, PublishedFix

if TYPE_CHECKING:
    from websockets.asyncio.server import Server, ServerConnection

_log = logging.getLogger(__name__)

_PORT = 8765
_MOST_WAITING_BYTES = 1 << 16
"""Size of waiting data above which a receiver is skipped until it has caught up: about 200 fixes.
"""
_LOOKED_AFTER_S = 0.05
"""Interval at which a slow receiver is checked [s]."""
_LONGEST_MESSAGE_BYTES = 1 << 10
_CLOSING_S = 1.0
_OWN_PAGES = re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?")


class WebSockets:
    """Serves fixes; parameters as `registry.Opener`.

    Attributes
    ----------
    port
        Port on which it listens; a free one if 0 was requested.
    """

    wants_pictures = False

    def __init__(self, address: Address, _extent: Extent) -> None:
        address.refuse_others(["origin"])
        self._serve = require("websockets.asyncio.server", "net").serve
        self._address = address
        self.port = address.port_or(_PORT, is_free=True)
        self._newest = ""
        self._behind: dict[ServerConnection, asyncio.Task[None]] = {}
        self._loop = asyncio.new_event_loop()
        try:
            self._server: Server = self._loop.run_until_complete(self._listen())
        except OSError as error:
            self._loop.close()
            raise InvalidInputError(
                f"{address.url}: cannot listen there: {error.strerror}; an address of this machine "
                "and a port that is free are right"
            ) from error
        self.port = self._server.sockets[0].getsockname()[1]
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()

    async def _listen(self) -> Server:
        named = self._address.options.get("origin")
        origins: list[Any] = [None, _OWN_PAGES, *([named] if named else [])]
        server: Server = await self._serve(
            self._stay,
            self._address.host,
            self.port,
            origins=origins,
            compression=None,
            max_size=_LONGEST_MESSAGE_BYTES,
            logger=_QUIET,
        )
        return server

    async def _stay(self, connection: ServerConnection) -> None:
        """Keep a receiver until it disconnects; its messages are ignored."""
        if self._newest:
            await connection.send(self._newest)
        async for _ in connection:
            pass

    def send(self, fix: PublishedFix, _pictures: Pictures) -> None:
        """Send a fix to all clients; having none is not an error."""
        text = fix.as_json().decode()
        self._loop.call_soon_threadsafe(self._send_all, text)

    def _send_all(self, text: str) -> None:
        from websockets.asyncio.server import broadcast

        self._newest = text
        waiting = [one for one in self._server.connections if one not in self._behind]
        broadcast([one for one in waiting if not _is_full(one)], text)
        for one in filter(_is_full, waiting):
            self._behind[one] = self._loop.create_task(self._catch_up(one))

    async def _catch_up(self, one: ServerConnection) -> None:
        """Send the newest fix to a slow receiver once it has received all waiting data."""
        from websockets.asyncio.server import broadcast

        while _is_full(one) and one in self._server.connections:
            await asyncio.sleep(_LOOKED_AFTER_S)
        del self._behind[one]
        broadcast([one], self._newest)

    def close(self) -> None:
        """Finish pending transmissions, close all connections, and stop listening."""
        if self._loop.is_closed():
            return
        ending = asyncio.run_coroutine_threadsafe(self._end(), self._loop)
        try:
            ending.result(_CLOSING_S)
        except TimeoutError:
            _log.debug("%s: a receiver does not take its leave", self._address.url)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(_CLOSING_S)
        if not self._loop.is_running():
            self._loop.close()

    async def _end(self) -> None:
        for task in self._behind.values():
            task.cancel()
        self._server.close(close_connections=True)
        await self._server.wait_closed()


def _is_full(connection: ServerConnection) -> bool:
    return connection.transport.get_write_buffer_size() >= _MOST_WAITING_BYTES


_QUIET = logging.getLogger(f"{__name__}.connections")
"""Silent logger for single connections: browsers connect and disconnect at any time."""
_QUIET.setLevel(logging.CRITICAL)
