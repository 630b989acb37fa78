"""One serial line by URL: a device, `socket://host:port` or `rfc2217://host:port`.

A device is used by one program at a time; see `fingerpost.robot.port_lock`.

Commands and the stop share the line but not its queues: `send_now` first discards unsent output of
the operating system and releases a software hold (XOFF), so that a stop never waits behind a
command; it waits only a moment for a write that another thread has begun.
"""

from __future__ import annotations

import logging
import os
import re
import select
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from enum import StrEnum
from typing import Any, TypeAlias
from urllib.parse import urlsplit

import serial

from fingerpost.errors import InvalidInputError
from fingerpost.robot.errors import ConnectionLostError, RobotTimeoutError
from fingerpost.robot.port_lock import (
    HELD_BY_ANOTHER,
    in_use,
    keep_others_out,
    let_others_in,
    need_free,
)

logger = logging.getLogger(__name__)

Tap: TypeAlias = Callable[[str, bytes], None]
"""Called with every transfer: `tap("out" or "in", data)`."""

WRITE_TIMEOUT_S = 0.25
"""Time limit to write a command of some 30 bytes [s]."""

URGENT_PATIENCE_S = 0.002
"""Time that `send_now` leaves another thread to finish its write [s]."""


SERVERS = ("socket", "rfc2217")
"""Kinds of serial servers, as pyserial's URLs name them."""

LOCAL = ("alt", "cp2110", "hwgrep", "loop", "spy")
"""Its other kinds of URL; what follows them is checked when it is opened."""

LAST_PORT = 65535
"""Greatest number of a TCP port."""

XON, XOFF = 0x11, 0x13
"""Bytes of software flow control (DC1 and DC3 of ASCII)."""

RECEIVE_WAIT_S = 0.02
"""Longest wait of one `receive` [s]; fixed, because a change requires a message to an RFC 2217
server."""


def _port_errors() -> tuple[type[Exception], ...]:
    """Return pyserial's exceptions when a port vanishes or another thread closes it."""
    errors: tuple[type[Exception], ...] = (OSError, TypeError, AttributeError, ValueError)
    with suppress(ImportError):  # not on Windows
        import termios

        errors += (termios.error,)
    return errors


PORT_ERRORS = _port_errors()


def _write_to_device(descriptor: int, data: bytes) -> None:
    """Write without busy waiting, unlike pyserial's own write while the device is blocked.

    A thread in a busy wait holds the interpreter lock for some 5 ms at a time, which would delay a
    stop in another thread.
    """
    end_s = time.monotonic() + WRITE_TIMEOUT_S
    while data:
        try:
            data = data[os.write(descriptor, data) :]
        except BlockingIOError:
            left_s = end_s - time.monotonic()
            if left_s <= 0 or not select.select([], [descriptor], [], left_s)[1]:
                raise serial.SerialTimeoutException("write timeout") from None


def _on_descriptor(port: Any) -> bool:
    """Whether a port is a POSIX device with a file descriptor."""
    return os.name == "posix" and isinstance(port, serial.Serial)


class Flow(StrEnum):
    """Flow control; programs for the same controller disagree, so it is an option."""

    NONE = "none"
    XON_XOFF = "xonxoff"
    RTS_CTS = "rtscts"


def check_address(address: str, robot: str = "") -> None:
    """Check the syntax of an address; nothing is opened.

    Parameters
    ----------
    address : str
        Device, or URL of a serial server.
    robot : str
        Name of the robot in whose URL it is, for the message.

    Raises
    ------
    InvalidInputError
        Empty, a URL without host or port, or one of another kind; the message names the URL, what
        is wrong with it, and a valid one.
    """
    kind, is_url, server = address.partition("://")
    plus, scheme = (f"{robot}+", f"{robot}://") if robot else ("", "")
    if is_url:
        if problem := _server_problem(kind, server):
            example = kind if kind in SERVERS else SERVERS[0]
            raise InvalidInputError(
                f"{plus}{address}: {problem}; {plus}{example}://host:4001 is right"
            )
    elif not address:
        shown = scheme or "serial line"
        raise InvalidInputError(f"{shown}: the address is empty; {scheme}/dev/ttyUSB0 is right")
    elif re.fullmatch(r"[^/]+:\d+", address):
        raise InvalidInputError(
            f"{scheme}{address}: a server, not a device; {plus}{SERVERS[0]}://{address} is right"
        )


def _server_problem(kind: str, server: str) -> str:
    """Return what is wrong with the URL of a serial server; empty if nothing is."""
    if kind in LOCAL:
        return ""
    if kind not in SERVERS:
        return f"{kind!r} is no kind of line, {' and '.join(SERVERS)} are"
    try:
        parts = urlsplit(f"//{server}")
    except ValueError as error:  # brackets that do not match
        return str(error)
    _, has_port, port = parts.netloc.rpartition("]")[2].rpartition(":")
    if not parts.hostname:
        return "the host is missing"
    if not has_port:
        return "the port is missing"
    if not port.isdecimal() or not 0 < int(port) <= LAST_PORT:
        return f"{port!r} is no port, 1 to {LAST_PORT} are"
    return f"nothing belongs after the port, but {parts.path} is there" if parts.path else ""


class SerialLine:
    """A serial line with time-outs on everything.

    Parameters
    ----------
    url : str
        Device (`/dev/ttyUSB0`, `COM3`), `socket://host:port`, `rfc2217://host:port` or another
        URL of pyserial.
    baud : int
        Bits per second; 8 data bits, no parity, 1 stop bit.
    flow : Flow
        Flow control.
    tap : callable, optional
        Called with every transfer, for logs and tests.
    is_text : bool
        Whether the input is text, which does not contain XON and XOFF.

    Raises
    ------
    InvalidInputError
        An invalid address; see `check_address`.
    """

    def __init__(
        self,
        url: str,
        *,
        baud: int = 9600,
        flow: Flow = Flow.NONE,
        tap: Tap | None = None,
        is_text: bool = True,
    ) -> None:
        check_address(url)
        self.url = url
        self._baud = baud
        self._flow = flow
        self._tap = tap or (lambda _way, _data: None)
        self._is_text = is_text
        self._port: Any = None  # pyserial has no types
        self._write_lock = threading.Lock()
        self._purgeable = False
        self._held_back = False

    @property
    def advice(self) -> str:
        """Probable wrong setting of this line, for an error that may be due to it; may be empty.

        Bytes of XON/XOFF on a line without this flow control mean that the other end uses it.
        """
        if not self._held_back:
            return ""
        remedy = (
            "switch it on at the serial server"
            if self.url.startswith("socket:")
            else "try ?flow=xonxoff"
        )
        return f"the controller has sent XON/XOFF, which this line does not use: {remedy}"

    def open(self) -> None:
        """Open the line, closing it first if it is open.

        Raises
        ------
        PortInUseError
            Another program has the device open.
        ConnectionLostError
            There is no such port, or it cannot be opened.
        """
        self.close()
        self._held_back = False
        is_device = "://" not in self.url
        if is_device:
            need_free(self.url)
        try:
            self._port = serial.serial_for_url(
                self.url,
                baudrate=self._baud,
                xonxoff=self._flow is Flow.XON_XOFF,
                rtscts=self._flow is Flow.RTS_CTS,
                timeout=RECEIVE_WAIT_S,
                # An RFC 2217 server takes no write time-out; its socket has one of 5 s.
                write_timeout=None if self.url.startswith("rfc2217:") else WRITE_TIMEOUT_S,
                exclusive=True if is_device else None,
            )
        except (OSError, ValueError) as error:
            if is_device and getattr(error, "errno", None) in HELD_BY_ANOTHER:
                raise in_use(self.url) from error
            raise ConnectionLostError(f"{self.url} cannot be opened: {error}") from error
        if _on_descriptor(self._port):
            keep_others_out(self._port.fd)

    def close(self) -> None:
        """Close the line; harmless when closed."""
        with self._write_lock:
            port, self._port = self._port, None
            if port is not None:
                with suppress(*PORT_ERRORS):
                    if _on_descriptor(port):
                        let_others_in(port.fd)
                    port.close()

    def send(self, data: bytes) -> None:
        """Send a command.

        Raises
        ------
        ConnectionLostError
            The line is closed or disconnected.
        RobotTimeoutError
            The line does not accept the bytes.
        """
        with self._write_lock:
            self._purgeable = True
            self._write(data)

    def send_now(self, data: bytes, *, purge: bool = True) -> None:
        """Send ahead of all waiting output.

        Parameters
        ----------
        data : bytes
            The bytes to send.
        purge : bool
            Whether to discard unsent output of the operating system, unless that is urgent too.
            Only for a controller that understands `data` after any part of a command.

        Raises
        ------
        ConnectionLostError
            The line is closed or disconnected.
        RobotTimeoutError
            The line does not accept the bytes.
        """
        held = self._write_lock.acquire(timeout=URGENT_PATIENCE_S)
        try:
            if purge and self._purgeable and isinstance(self._port, serial.Serial):
                with self._translated():
                    self._port.reset_output_buffer()
            self._purgeable = False  # from now on it only contains an urgent message
            self.release()
            self._write(data)
        finally:
            if held:
                self._write_lock.release()

    def release(self) -> None:
        """Resume output if an XOFF, real or noise, has stopped it.

        Raises
        ------
        ConnectionLostError
            The line is closed or disconnected.
        """
        if self._flow is Flow.XON_XOFF and isinstance(self._port, serial.Serial):
            with self._translated():
                # Linux releases a received XOFF only after its own flow control is set off and on.
                self._port.set_output_flow_control(False)
                self._port.set_output_flow_control(True)

    def receive(self) -> bytes:
        """Return received bytes, waiting up to `RECEIVE_WAIT_S` for the first one.

        Raises
        ------
        ConnectionLostError
            The line is closed or disconnected.
        """
        with self._translated():
            data: bytes = self._port.read(1)
        if data:
            self._note_received(data)
            data += self.drain()
        return data

    def drain(self) -> bytes:
        """Return bytes that have already been received, without waiting.

        Raises
        ------
        ConnectionLostError
            The line is closed or disconnected.
        """
        data = b""
        with self._translated():
            while waiting := self._port.in_waiting:
                data += self._port.read(waiting)
        if data:
            self._note_received(data)
        return data

    def _note_received(self, data: bytes) -> None:
        self._tap("in", data)
        if not self._is_text or self._flow is Flow.XON_XOFF or self._held_back:
            return
        if XON in data or XOFF in data:
            self._held_back = True
            logger.warning("%s: %s", self.url, self.advice)

    def _write(self, data: bytes) -> None:
        with self._translated():
            if _on_descriptor(self._port):
                _write_to_device(self._port.fd, data)
            else:
                self._port.write(data)
        self._tap("out", data)

    @contextmanager
    def _translated(self) -> Iterator[None]:
        try:
            yield
        except serial.SerialTimeoutException as error:
            raise RobotTimeoutError(
                f"{self.url} takes no bytes: held by flow control, or unplugged"
            ) from error
        except PORT_ERRORS as error:
            raise ConnectionLostError(f"{self.url} is closed or unplugged: {error}") from error
