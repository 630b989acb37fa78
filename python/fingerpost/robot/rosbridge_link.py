"""Topics and services of ROS through a rosbridge server: JSON texts on a WebSocket.

The protocol is rosbridge's version 2.0, common to ROS 1 and 2: `advertise`, `publish`, `subscribe`
and `call_service` are sent; `publish`, `service_response` and `status` are received. The WebSocket
is that of `websockets` without its own threads and locks (its `ClientProtocol`), so that an urgent
message waits only a moment for another thread's. `roslibpy` would require Twisted, whose reactor is
global to the process: it cannot be restarted after a stop, and every message waits for its turn in
it.
"""

from __future__ import annotations

import itertools
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeAlias

import msgspec

from fingerpost.installation import require
from fingerpost.robot.errors import ConnectionLostError, RobotError, RobotTimeoutError

OPEN_S = 5.0
"""Time limit for the answer of a server [s]."""

WRITE_TIMEOUT_S = 0.25
"""Time limit to write a message [s]."""

URGENT_PATIENCE_S = 0.002
"""Time that an urgent message leaves another thread to finish its own [s]."""

READ_BYTES = 1 << 16
"""Number of bytes read at a time; a pose has about 300."""

Message: TypeAlias = dict[str, Any]
"""A message of ROS as JSON values."""


class _Incoming(msgspec.Struct):
    """Any operation sent by a server."""

    op: str
    topic: str = ""
    msg: Any = None
    id: str | None = None
    service: str = ""
    values: Any = None
    result: bool | None = None
    level: str = ""


class RosbridgeLink:
    """A connection to a rosbridge server.

    Parameters
    ----------
    host, port
        Its address.
    on_message : callable
        Called from the link's own thread with the topic and message of every `publish`.
    on_trouble : callable
        Called from that thread with the server's error messages, and with the end of the
        connection.

    Raises
    ------
    MissingExtraError
        `websockets` is not installed.
    """

    def __init__(
        self,
        host: str,
        port: int,
        on_message: Callable[[str, Message], None],
        on_trouble: Callable[[RobotError], None],
    ) -> None:
        self.url = f"ws://{host}:{port}"
        self._address = (host, port)
        self._library = require("websockets.client", "ros")
        self._uri = require("websockets.uri", "ros")
        self._on_message = on_message
        self._on_trouble = on_trouble
        self._lock = threading.Lock()  # held while a message is sent
        self._protocol: Any = None
        self._socket: socket.socket | None = None
        self._why_closed = "not connected"
        self._numbers = itertools.count(1)
        self._responses: dict[str, _Incoming] = {}

    def open(self) -> None:
        """Connect, closing the connection first if it is open.

        Raises
        ------
        ConnectionLostError
            There is no server, or not a WebSocket.
        RobotTimeoutError
            The server does not answer.
        """
        self.close()
        try:
            line = socket.create_connection(self._address, OPEN_S)
            line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._socket = line
            self._protocol = protocol = self._library.ClientProtocol(self._uri.parse_uri(self.url))
            protocol.send_request(protocol.connect())
            self._flush()
            while protocol.state.name == "CONNECTING":
                if not (data := line.recv(READ_BYTES)):
                    raise ConnectionError("the connection was closed")
                protocol.receive_data(data)
                if protocol.handshake_exc is not None:
                    raise protocol.handshake_exc
        except TimeoutError as error:
            self.close()
            raise RobotTimeoutError(f"{self.url}: no answer within {OPEN_S:g} s") from error
        except Exception as error:  # the library has kinds of its own
            self.close()
            raise ConnectionLostError(
                f"{self.url}: {error}; see that rosbridge_server runs there"
            ) from error
        line.settimeout(None)
        threading.Thread(target=self._listen, args=(line,), name="rosbridge", daemon=True).start()

    def close(self) -> None:
        """Close the connection; harmless when closed."""
        self._close("not connected")

    def _close(self, why: str) -> None:
        # Set the reason first: other threads report it as soon as there is no socket.
        self._why_closed = why
        line, self._socket = self._socket, None
        self._responses = {}
        if line is not None:
            with suppress(Exception):
                self._protocol.send_close()
                self._write(line)
            with suppress(OSError):
                line.shutdown(socket.SHUT_RDWR)
            line.close()

    def send(self, **operation: object) -> None:
        """Send an operation.

        Raises
        ------
        ConnectionLostError
            The connection is closed or lost, or does not accept the bytes.
        """
        with self._lock:
            self._send(operation)

    def send_now(self, **operation: object) -> None:
        """Send an operation, waiting only a moment for another thread's.

        It may be called from a signal handler that has interrupted a message between any two steps:
        the state is consistent before and after each of them.

        Raises
        ------
        ConnectionLostError
            As for `send`.
        """
        held = self._lock.acquire(timeout=URGENT_PATIENCE_S)
        try:
            self._send(operation)
        finally:
            if held:
                self._lock.release()

    def call(self, service: str, *, urgent: bool = False) -> str:
        """Call a service without arguments; return the number that identifies its answer.

        Raises
        ------
        ConnectionLostError
            As for `send`.
        """
        number = f"fingerpost-{next(self._numbers)}"
        send = self.send_now if urgent else self.send
        send(op="call_service", id=number, service=service, args={})
        return number

    def outcome(self, number: str) -> tuple[bool, str] | None:
        """Return a service's success and message; None while there is no answer."""
        response = self._responses.pop(number, None)
        if response is None:
            return None
        values = response.values
        if isinstance(values, dict):
            done = response.result is not False and values.get("success", True) is True
            return done, str(values.get("message", ""))
        return response.result is not False and values is None, str(values or "")

    def _send(self, operation: dict[str, object]) -> None:
        if self._socket is None:
            raise ConnectionLostError(f"{self.url}: {self._why_closed}")
        try:
            self._protocol.send_text(msgspec.json.encode(operation))
            self._flush()
        except Exception as error:  # the library has kinds of its own
            self._close(f"the connection is gone: {error}")
            raise ConnectionLostError(f"{self.url}: {self._why_closed}") from error

    def _flush(self) -> None:
        if (line := self._socket) is not None:
            self._write(line)

    def _write(self, line: socket.socket) -> None:
        for data in self._protocol.data_to_send():
            if data:
                line.sendall(data)

    def _listen(self, line: socket.socket) -> None:
        """Read until the connection ends, and report that unless it was closed here."""
        protocol, why = self._protocol, "the server has closed it"
        try:
            while data := line.recv(READ_BYTES):
                protocol.receive_data(data)
                for event in protocol.events_received():
                    self._take(event)
                with self._lock:
                    self._flush()  # pongs
                if protocol.state.name != "OPEN":
                    break
        except Exception as error:
            why = str(error)
        if self._socket is line:
            self._close(f"the connection is gone: {why}")
            self._on_trouble(ConnectionLostError(f"{self.url}: {self._why_closed}"))

    def _take(self, frame: Any) -> None:
        if getattr(getattr(frame, "opcode", None), "name", "") != "TEXT":
            return
        message = msgspec.json.decode(frame.data, type=_Incoming)
        if message.op == "publish":
            self._on_message(message.topic, message.msg)
        elif message.op == "service_response" and message.id is not None:
            self._responses[message.id] = message
        elif message.op == "status" and message.level == "error":
            self._on_trouble(RobotError(f"{self.url}: rosbridge says: {message.msg}"))
