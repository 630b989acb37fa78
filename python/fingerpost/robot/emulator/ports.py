"""Ports of an emulated controller, a pseudo-terminal or TCP, and the thread that serves them."""

from __future__ import annotations

import os
import pty
import select
import socket
import tempfile
import threading
import time
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

import numpy as np

from fingerpost.checks import in_range
from fingerpost.errors import InvalidInputError
from fingerpost.robot.emulator.faults import LINE_FAULTS, Fault, LineFaults
from fingerpost.robot.errors import RobotTimeoutError
from fingerpost.robot.serial_line import LAST_PORT

READ_SIZE = 4096

TIME_SCALES = (1e-3, 1e6)
"""Range of the ratio of the arm's time to real time, within which its clock keeps its precision."""


class ArmTime:
    """The clock of an arm with accelerated time; the driver must use it as well.

    Parameters
    ----------
    scale : float
        Seconds of the arm per second of real time, in `TIME_SCALES`.

    Raises
    ------
    InvalidInputError
        The scale is out of range.
    """

    def __init__(self, scale: float = 1.0) -> None:
        self.scale = in_range(scale, "time_scale", *TIME_SCALES)

    def __call__(self) -> float:
        """Return the arm's time [s]."""
        return time.monotonic() * self.scale

    def sleep(self, span_s: float) -> None:
        """Wait for a span of the arm's time [s]."""
        time.sleep(span_s / self.scale)


class Controller(Protocol):
    """A controller behind a port: bytes in, bytes out, at given times."""

    def receive(self, data: bytes, now_s: float) -> None:
        """Process received bytes."""

    def poll(self, now_s: float) -> bytes:
        """Return the bytes that it sends by now."""

    def next_due_s(self) -> float | None:
        """Return the time of the next unsolicited transmission [s], or None."""

    def inject(self, fault: Fault, now_s: float) -> None:
        """Simulate a fault."""


class Port(ABC):
    """One end of a line that can be disconnected and reconnected."""

    @property
    @abstractmethod
    def address(self) -> str:
        """Address that a driver opens."""

    @abstractmethod
    def plug(self) -> None:
        """Create the port; harmless if it exists."""

    @abstractmethod
    def unplug(self) -> None:
        """Remove the port; harmless if it does not exist."""

    def close(self) -> None:
        """Remove the port permanently."""
        self.unplug()

    @abstractmethod
    def descriptors(self) -> list[int]:
        """Return the file descriptors to wait for."""

    @abstractmethod
    def read(self, ready: int) -> bytes:
        """Read from a descriptor that is ready."""

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Send; bytes that the line does not accept are lost."""


class PtyPort(Port):
    """A pseudo-terminal behind a link, so that its name persists when it is disconnected.

    Parameters
    ----------
    link : path, optional
        Path of the link, in an existing folder; in a new directory by default.
    """

    def __init__(self, link: str | os.PathLike[str] | None = None) -> None:
        self._directory: tempfile.TemporaryDirectory[str] | None = None
        self._link = None if link is None else Path(link)
        self._master: int | None = None
        self._slave: int | None = None

    @property
    def address(self) -> str:
        """Path of the link; empty before the first connection, unless it was given."""
        return str(self._link or "")

    def plug(self) -> None:
        """Make the pseudo-terminal and the link to it.

        Raises
        ------
        InvalidInputError
            The link cannot be created, or the path is not a link.
        """
        if self._master is not None:
            return
        if self._link is not None and self._link.exists() and not self._link.is_symlink():
            raise InvalidInputError(
                f"{self._link}: no link can be put there: something else is; name a new one"
            )
        if self._link is None:
            self._directory = tempfile.TemporaryDirectory(prefix="fingerpost-")
            self._link = Path(self._directory.name) / "port"
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        try:
            self._link.unlink(missing_ok=True)
            self._link.symlink_to(os.ttyname(self._slave))
        except OSError as error:
            self._close_ends()
            raise InvalidInputError(
                f"{self._link}: no link can be put there: {error.strerror}; name one in an "
                "existing folder"
            ) from error

    def unplug(self) -> None:
        """Close it, as when a USB adapter is disconnected."""
        is_plugged = self._master is not None
        self._close_ends()
        if self._link is not None and is_plugged:
            self._link.unlink(missing_ok=True)

    def _close_ends(self) -> None:
        for descriptor in (self._slave, self._master):
            if descriptor is not None:
                os.close(descriptor)
        self._master = self._slave = None

    def close(self) -> None:
        """Close it and remove its directory."""
        self.unplug()
        if self._directory is not None:
            self._directory.cleanup()
            self._directory = self._link = None

    def descriptors(self) -> list[int]:
        """Return the controller's end."""
        return [] if self._master is None else [self._master]

    def read(self, ready: int) -> bytes:
        """Read bytes from the driver."""
        with suppress(OSError):
            return os.read(ready, READ_SIZE)
        return b""

    def write(self, data: bytes) -> None:
        """Send to the driver."""
        if self._master is not None:
            with suppress(OSError):
                os.write(self._master, data)


class TcpPort(Port):
    """A TCP port that serves one driver at a time, as serial servers do.

    Parameters
    ----------
    host : str
        Address to listen on.
    port : int
        Port to listen on; 0 picks a free one.

    Raises
    ------
    InvalidInputError
        No such port.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 0) -> None:
        if not 0 <= port <= LAST_PORT:
            raise InvalidInputError(f"TCP port is {port}; 0 to {LAST_PORT} is needed")
        self._wanted = (host, port)
        self._listener: socket.socket | None = None
        self._peer: socket.socket | None = None

    @property
    def address(self) -> str:
        """URL of the port."""
        return f"socket://{self._wanted[0]}:{self._wanted[1]}"

    def plug(self) -> None:
        """Listen.

        Raises
        ------
        InvalidInputError
            Another program uses the port, or permission is denied.
        """
        if self._listener is None:
            try:
                self._listener = socket.create_server(self._wanted)
            except OSError as error:
                raise InvalidInputError(
                    f"{self.address} cannot be served: {os.strerror(error.errno or 0)}; port 0 "
                    "picks a free one"
                ) from error
            self._wanted = self._listener.getsockname()[:2]

    def unplug(self) -> None:
        """Disconnect and stop listening."""
        for end in (self._peer, self._listener):
            if end is not None:
                end.close()
        self._peer = self._listener = None

    def descriptors(self) -> list[int]:
        """Return the listener and the driver's end."""
        return [end.fileno() for end in (self._listener, self._peer) if end is not None]

    def read(self, ready: int) -> bytes:
        """Accept a driver, or read bytes from it."""
        if self._listener is not None and ready == self._listener.fileno():
            if self._peer is not None:
                self._peer.close()
            self._peer, _ = self._listener.accept()
            self._peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return b""
        if self._peer is None or self._peer.fileno() != ready:
            return b""
        data = b""
        with suppress(OSError):
            data = self._peer.recv(READ_SIZE)
        if not data:
            self._peer.close()
            self._peer = None
        return data

    def write(self, data: bytes) -> None:
        """Send to the driver, if there is one."""
        if self._peer is not None:
            with suppress(OSError):
                self._peer.sendall(data)


class HostPort(TcpPort):
    """A TCP port of a server without a serial line: its address is `host:port` alone."""

    @property
    def address(self) -> str:
        """Host and port."""
        return super().address.removeprefix("socket://")


@dataclass(frozen=True, slots=True)
class WireEvent:
    """One transfer at the controller's port.

    Attributes
    ----------
    time_s : float
        Time by `time.monotonic` [s].
    sent : bool
        Whether from the controller to the driver.
    data : bytes
        The bytes.
    """

    time_s: float
    sent: bool
    data: bytes


class PluggedController:
    """A controller on a port, served on request: `Emulator` does it from a thread.

    Parameters
    ----------
    controller : Controller
        The controller.
    port : Port
        Its port.
    clock : callable, optional
        The arm's time [s]; real time by default.
    rng : numpy.random.Generator, optional
        For the noise of faults; seeded with 0 by default.
    slow_s : float
        Delay of a slow answer, on the arm's clock [s].

    Attributes
    ----------
    wire : list of WireEvent
        All transfers.
    """

    def __init__(
        self,
        controller: Controller,
        port: Port,
        *,
        clock: Callable[[], float] | None = None,
        rng: np.random.Generator | None = None,
        slow_s: float = 0.3,
    ) -> None:
        self._controller = controller
        self._port = port
        self._arm_time = clock or ArmTime()
        self._faults = LineFaults(rng or np.random.default_rng(0), slow_s)
        self._late: list[tuple[float, bytes]] = []
        self.wire: list[WireEvent] = []

    @property
    def address(self) -> str:
        """Address that a driver opens."""
        return self._port.address

    @property
    def now_s(self) -> float:
        """The arm's own time [s]."""
        return self._arm_time()

    def __enter__(self) -> Self:
        self._port.plug()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._port.close()

    def inject(self, fault: Fault, *, count: int = 1) -> None:
        """Simulate a fault.

        Parameters
        ----------
        fault : Fault
            The fault.
        count : int
            Number of transfers or commands affected, if applicable.
        """
        for _ in range(count):
            if fault is Fault.UNPLUG:
                self._port.unplug()
            elif fault is Fault.PLUG:
                self._port.plug()
            elif fault in LINE_FAULTS:
                self._faults.inject(fault, 1)
            else:
                self._controller.inject(fault, self.now_s)

    def heal(self) -> None:
        """Remove the faults of the line."""
        self._faults.clear()

    def serve(self) -> None:
        """Transfer bytes to and from the controller, without waiting."""
        descriptors = self._port.descriptors()
        self._answer(select.select(descriptors, [], [], 0.0)[0] if descriptors else [])

    def _answer(self, ready: Collection[int]) -> None:
        for descriptor in self._port.descriptors():
            if descriptor in ready and (data := self._port.read(descriptor)):
                self.wire.append(WireEvent(time.monotonic(), False, data))
                self._controller.receive(self._faults.on_input(data), self.now_s)
        self._send()

    def _due_s(self) -> float | None:
        """Return the time until the next unsolicited transmission [s of the arm], or None."""
        due_s = [late_s for late_s, _ in self._late]
        if (next_s := self._controller.next_due_s()) is not None:
            due_s.append(next_s)
        return max(0.0, min(due_s) - self.now_s) if due_s else None

    def _send(self) -> None:
        now_s = self.now_s
        for late_s, data in self._late[:]:
            if late_s <= now_s:
                self._late.remove((late_s, data))
                self._write(data)
        if data := self._controller.poll(self.now_s):
            data, delay_s = self._faults.on_output(data)
            if self._late or delay_s:  # nothing overtakes on a line
                last_s = self._late[-1][0] if self._late else now_s
                self._late.append((max(last_s, now_s + delay_s), data))
            else:
                self._write(data)

    def _write(self, data: bytes) -> None:
        if data:
            self.wire.append(WireEvent(time.monotonic(), True, data))
            self._port.write(data)


class Emulator(PluggedController):
    """A controller on a port, served by a thread.

    Parameters
    ----------
    controller, port, rng, slow_s
        As for `PluggedController`.
    clock : ArmTime, optional
        The arm's clock; real time by default.
    """

    def __init__(
        self,
        controller: Controller,
        port: Port,
        *,
        clock: ArmTime | None = None,
        rng: np.random.Generator | None = None,
        slow_s: float = 0.3,
    ) -> None:
        self._clock = clock or ArmTime()
        super().__init__(controller, port, clock=self._clock, rng=rng, slow_s=slow_s)
        self._orders: list[Fault] = []
        self._wake_out, self._wake_in = os.pipe()
        self._changed = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._serve, name="emulator", daemon=True)

    def __enter__(self) -> Self:
        super().__enter__()
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._closing = True
        os.write(self._wake_in, b"x")
        self._thread.join()
        super().__exit__(kind, error, trace)
        os.close(self._wake_out)
        os.close(self._wake_in)

    def inject(self, fault: Fault, *, count: int = 1) -> None:
        """Simulate a fault; return when the controller has it.

        Parameters
        ----------
        fault, count
            As for `PluggedController`.

        Raises
        ------
        RobotTimeoutError
            The emulator's thread does not run.
        """
        with self._changed:
            self._orders += [fault] * count
            os.write(self._wake_in, b"x")
            if not self._changed.wait_for(lambda: not self._orders, timeout=5.0):
                raise RobotTimeoutError("the emulator is not running")

    def _serve(self) -> None:
        while not self._closing:
            due_s = self._due_s()
            wait_s = None if due_s is None else due_s / self._clock.scale
            descriptors = [self._wake_out, *self._port.descriptors()]
            ready, _, _ = select.select(descriptors, [], [], wait_s)
            if self._wake_out in ready:
                os.read(self._wake_out, READ_SIZE)
                self._obey()
            self._answer(ready)

    def _obey(self) -> None:
        with self._changed:
            for fault in self._orders:
                super().inject(fault)
            self._orders.clear()
            self._changed.notify_all()
