"""One open page: sends no more than it can draw, and receives its commands."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from statistics import median

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from fingerpost.live.commands import Ack, decode
from fingerpost.live.hub import Hub

_log = logging.getLogger(__name__)

WINDOW = 2
"""Greatest number of moments sent but not yet drawn; of the others only the newest is kept."""

_LATENCIES = 30
_NOT_JSON, _NOT_TEXT = 1007, 1003


class Client:
    """A page on the other end of a WebSocket.

    Parameters
    ----------
    websocket
        Its connection, accepted.
    hub
        The hub, which provides moments and executes commands.
    """

    def __init__(self, websocket: WebSocket, hub: Hub) -> None:
        self._websocket, self._hub = websocket, hub
        self._newest: tuple[bytes, float | None] | None = None
        self._has_news = False
        self._refusal = ""
        self._known: tuple[object, int] = (None, 0)
        self._on_way: deque[float | None] = deque()
        self._latencies_ms: deque[float] = deque(maxlen=_LATENCIES)
        self._wake = asyncio.Event()

    def offer(self, message: bytes, begun_s: float | None) -> None:
        """Queue the newest moment, in place of one that has not been sent."""
        self._newest = message, begun_s
        self._wake.set()

    def send_state(self) -> None:
        """Request one transmission of the state."""
        self._has_news = True
        self._wake.set()

    async def run(self) -> None:
        """Serve the page until it disconnects."""
        sender = asyncio.create_task(self._send())
        self._hub.add(self)
        try:
            await self._receive()
        finally:
            self._hub.remove(self)
            sender.cancel()
            await asyncio.gather(sender, return_exceptions=True)

    async def _send(self) -> None:
        try:
            while True:
                await self._wake.wait()
                self._wake.clear()
                await self._send_text()
                if self._newest is not None and len(self._on_way) < WINDOW:
                    (message, begun_s), self._newest = self._newest, None
                    self._on_way.append(begun_s)
                    await self._websocket.send_bytes(message)
        except (WebSocketDisconnect, RuntimeError):  # disconnected; the receiver ends the client
            return

    async def _send_text(self) -> None:
        if self._refusal:
            refusal, self._refusal = self._refusal, ""
            await self._websocket.send_text(msgspec.json.encode({"refused": refusal}).decode())
        if self._has_news:
            self._has_news = False
            state = self._hub.state(self, self._known)
            self._known = self._hub.strip, self._hub.strip.end
            state["latency_ms"] = self._latency_ms()
            await self._websocket.send_text(msgspec.json.encode({"state": state}).decode())

    def _latency_ms(self) -> float | None:
        return round(median(self._latencies_ms), 1) if self._latencies_ms else None

    async def _receive(self) -> None:
        while (message := await self._websocket.receive())["type"] != "websocket.disconnect":
            text = message.get("text")
            if text is None:
                await self._end(_NOT_TEXT, "commands are JSON text, not bytes")
                break
            try:
                command = decode(text)
            except msgspec.MsgspecError as error:
                await self._end(_NOT_JSON, f"no command: {error}")
                break
            if isinstance(command, Ack):
                self._drawn()
            elif refusal := self._hub.obey(command, self):
                self._refusal = refusal
                self._wake.set()

    def _drawn(self) -> None:
        """Count a moment as drawn; ignore an acknowledgement without an outstanding one."""
        if not self._on_way:
            return
        begun_s = self._on_way.popleft()
        if begun_s is not None:
            self._latencies_ms.append(1e3 * (time.monotonic() - begun_s))
        self._wake.set()

    async def _end(self, code: int, words: str) -> None:
        _log.warning("page: %s", words)
        if self._websocket.client_state is WebSocketState.CONNECTED:
            await self._websocket.close(code, words.encode()[:120].decode(errors="ignore"))
