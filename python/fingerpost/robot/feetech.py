"""Feetech's serial bus servos (STS3215) on one half-duplex line, by `feetech-servo-sdk`.

The library makes and parses packets: 0xFF 0xFF, servo, length, instruction or status, parameters,
checksum; words have the low byte first. Its own port has neither a time-out for writing, nor a
lock, nor a bypass of a waiting exchange, so it is replaced by `_Port` on a `SerialLine`.

Every status packet carries the servo's faults: one bit each for voltage, encoder, temperature,
current and load. A sync write has no answer; only the servos' motion shows whether it arrived.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias, TypeVar

from fingerpost.installation import require
from fingerpost.robot.errors import (
    ConnectionLostError,
    GarbledReplyError,
    RobotFaultError,
    RobotTimeoutError,
)
from fingerpost.robot.serial_line import SerialLine

COUNTS_PER_TURN = 4096
"""Resolution of the servo's encoder."""

# Addresses of the memory table of the STS series.
HOMING_OFFSET, TORQUE_ENABLE, ACCELERATION = 31, 40, 41
TORQUE_LIMIT, PRESENT_POSITION, PRESENT_VOLTAGE = 48, 56, 62

OFFSET_SIGN_BIT, POSITION_SIGN_BIT = 11, 15
"""Sign bits: negative numbers are a magnitude with this bit set."""

TRIES = 3
"""Number of attempts at a reading that is corrupt or missing; repetition has no side effect."""

PADDING = bytes(250)
"""Ends a packet with a corrupt length, during which a servo would ignore further input: as many
bytes as the library's longest packet, none of them a header."""

VOLTAGE, ENCODER, TEMPERATURE, CURRENT, OVERLOAD = 0x01, 0x02, 0x04, 0x08, 0x20
_FAULTS = {
    VOLTAGE: "its supply is out of range ({volts:.1f} V): see to the arm's power supply",
    ENCODER: "its encoder fails: replace the servo",
    TEMPERATURE: "it is overheated ({celsius} °C): let it cool down",
    CURRENT: "it draws too much current: see what blocks it",
    OVERLOAD: "it is overloaded: see what blocks it, or lighten the load",
}

_TIMEOUT, _CORRUPT = -6, -7
"""The library's codes for a missing packet, and for a truncated one or a wrong checksum."""

_Answer = TypeVar("_Answer")

Readings: TypeAlias = dict[int, bytes]
"""Bytes read, by the servo's number."""


def signed(data: bytes, sign_bit: int) -> int:
    """Return the first two bytes as a sign-magnitude number."""
    raw, sign = data[0] | data[1] << 8, 1 << sign_bit
    return -(raw & (sign - 1)) if raw & sign else raw


def two_bytes(value: int) -> tuple[int, int]:
    """Return a number as two bytes, the low one first."""
    return value & 0xFF, value >> 8


class _Port:
    """The library's interface to a port: the line, with a time-out of each reply."""

    def __init__(self, line: SerialLine, clock: Callable[[], float], reply_s: float) -> None:
        self.is_using = False  # the library's own flag, in place of a lock
        self._line = line
        self._clock = clock
        self._reply_s = reply_s
        self._end_s = 0.0
        self._received = b""

    def clearPort(self) -> None:  # noqa: N802 - the library's names
        """Discard unsolicited input."""
        self._received = b""
        self._line.drain()

    def writePort(self, packet: list[int]) -> int:  # noqa: N802
        """Send a packet."""
        self._line.send(bytes(packet))
        return len(packet)

    def readPort(self, length: int) -> bytes:  # noqa: N802
        """Return up to `length` bytes; wait a moment if there are none."""
        if not self._received:
            self._received = self._line.receive()
        data, self._received = self._received[:length], self._received[length:]
        return data

    def setPacketTimeout(self, _length: int) -> None:  # noqa: N802
        """Begin to wait for a reply."""
        self._end_s = self._clock() + self._reply_s

    def isPacketTimeout(self) -> bool:  # noqa: N802
        """Whether the reply is late."""
        return self._clock() > self._end_s


class _UrgentPort(_Port):
    """A port whose packets bypass all waiting ones."""

    def clearPort(self) -> None:  # noqa: N802
        """Do nothing: another thread may wait for the input."""

    def writePort(self, packet: list[int]) -> int:  # noqa: N802
        """Send a packet at once."""
        self._line.send_now(bytes(packet), purge=False)  # a partial packet would block the servos
        return len(packet)


class ServoBus:
    """The servos of one arm.

    Parameters
    ----------
    line : SerialLine
        The line; 1 Mbaud unless they were set otherwise.
    names : mapping of int to str
        Name of the joint that each servo moves, by its number.
    clock : callable
        Monotonic time [s].
    reply_s : float
        Longest time to one servo's answer [s].
    lenient : mapping of int to int, optional
        Faults of a servo that are ignored, as bits.

    Raises
    ------
    MissingExtraError
        `feetech-servo-sdk` is not installed.
    """

    def __init__(
        self,
        line: SerialLine,
        names: Mapping[int, str],
        clock: Callable[[], float],
        *,
        reply_s: float,
        lenient: Mapping[int, int] | None = None,
    ) -> None:
        self._packets: Any = require("scservo_sdk", "so101").PacketHandler(0)
        self._line = line
        self._names = names
        self._lenient = lenient or {}
        self._port = _Port(line, clock, reply_s)
        self._urgent_port = _UrgentPort(line, clock, reply_s)
        self._lock = threading.Lock()
        self._repeat: Callable[[], None] | None = None  # a write that may have collided

    def open(self) -> None:
        """Open the line and check that every servo answers.

        Raises
        ------
        ConnectionLostError
            The port cannot be opened.
        RobotTimeoutError, GarbledReplyError
            No servo answers, or not all of them.
        """
        self._line.open()
        silent = []
        for servo in self._names:
            try:
                self.read(PRESENT_POSITION, 2, [servo])
            except RobotTimeoutError:
                silent.append(servo)
        if len(silent) == len(self._names):
            raise RobotTimeoutError(
                f"{self._line.url}: no servo answers; plug in the arm's own power supply, and see "
                "that this is the arm's port"
            )
        if silent:
            shown = ", ".join(map(self._named, silent))
            raise RobotTimeoutError(f"{shown}: no answer; see to the cable that leads to it")

    def close(self) -> None:
        """Close the line; harmless when closed."""
        self._line.close()

    def read(self, address: int, length: int, servos: list[int] | None = None) -> Readings:
        """Return bytes of the memory of some servos, or all.

        Raises
        ------
        RobotTimeoutError
            A servo does not answer.
        GarbledReplyError
            Its answer is truncated or its checksum wrong, repeatedly.
        RobotFaultError
            It reports a fault.
        ConnectionLostError
            The line is disconnected.
        """
        wanted = list(self._names) if servos is None else servos
        for left in range(TRIES - 1, -1, -1):
            try:
                return self._exchange(lambda: self._sync_read(address, length, wanted))
            except (RobotTimeoutError, GarbledReplyError):
                if not left:
                    raise
                self._line.send(PADDING)
        raise AssertionError("the last try returns or raises")

    def write(self, address: int, values: Mapping[int, tuple[int, ...]]) -> None:
        """Write bytes to the memory of several servos at once, which do not answer.

        Raises
        ------
        ConnectionLostError, RobotTimeoutError
            The line is disconnected, or does not accept the bytes.
        """
        self._exchange(lambda: self._sync_write(self._port, address, values))

    def write_now(self, address: int, values: Mapping[int, tuple[int, ...]]) -> None:
        """As `write`, but bypass a waiting exchange; the packet is sent again after that.

        The line has one wire for both directions: an answer may corrupt a packet sent meanwhile.

        Raises
        ------
        ConnectionLostError, RobotTimeoutError
            As for `write`.
        """

        def send() -> None:
            self._sync_write(self._urgent_port, address, values)

        if self._lock.locked():
            self._repeat = send
        send()

    def confirm(self, address: int, servo: int, *values: int) -> None:
        """Write bytes to one servo, which acknowledges them.

        Raises
        ------
        RobotError
            As for `read`.
        """

        def write() -> None:
            code, fault = self._packets.writeTxRx(
                self._port, servo, address, len(values), list(values)
            )
            self._need(code, servo)
            self._need_no_fault(servo, fault)

        self._exchange(write)

    def _exchange(self, exchange: Callable[[], _Answer]) -> _Answer:
        with self._lock:
            self._port.is_using = False  # an error may have left it so
            try:
                return exchange()
            finally:
                repeat, self._repeat = self._repeat, None
                if repeat is not None:
                    repeat()

    def _sync_read(self, address: int, length: int, servos: list[int]) -> Readings:
        self._packets.syncReadTx(self._port, address, length, servos, len(servos))
        readings: Readings = {}
        faults: dict[int, int] = {}
        for servo in servos:
            self._port.setPacketTimeout(length)
            data, code, faults[servo] = self._packets.readRx(self._port, servo, length)
            self._need(code, servo)
            if len(data) != length:
                raise GarbledReplyError(
                    f"{self._named(servo)}: {len(data)} bytes came, {length} were asked for"
                )
            readings[servo] = bytes(data)
        for servo, fault in faults.items():
            self._need_no_fault(servo, fault)
        return readings

    def _sync_write(self, port: _Port, address: int, values: Mapping[int, tuple[int, ...]]) -> None:
        length = len(next(iter(values.values())))
        parameters = [byte for servo, data in values.items() for byte in (servo, *data)]
        port.is_using = False
        self._packets.syncWriteTxOnly(port, address, length, parameters, len(parameters))

    def _need(self, code: int, servo: int) -> None:
        """Raise the error for the library's code."""
        if code == _TIMEOUT:
            raise RobotTimeoutError(
                f"{self._named(servo)}: no answer; see to the cable that leads to it"
            )
        if code == _CORRUPT:
            raise GarbledReplyError(
                f"{self._named(servo)}: its answer is cut or its checksum wrong; see to the cables"
            )
        if code != 0:
            raise ConnectionLostError(f"{self._named(servo)}: {self._packets.getTxRxResult(code)}")

    def _need_no_fault(self, servo: int, bits: int) -> None:
        """Raise the faults that a servo reports, with its measurements."""
        bits &= ~self._lenient.get(servo, 0)
        if not bits:
            return
        volts, celsius = self._supply(servo)
        said = [
            text.format(volts=volts, celsius=celsius) for bit, text in _FAULTS.items() if bits & bit
        ]
        raise RobotFaultError(
            f"{self._named(servo)}: {'; '.join(said) or f'fault {bits:#04x}'}; then home again",
            number=bits,
            axis=servo,
        )

    def _supply(self, servo: int) -> tuple[float, int]:
        """Return a servo's voltage [V] and temperature [°C]; NaN and 0 without an answer."""
        data, code, _ = self._packets.readTxRx(self._port, servo, PRESENT_VOLTAGE, 2)
        return (data[0] / 10, data[1]) if code == 0 and len(data) == 2 else (float("nan"), 0)

    def _named(self, servo: int) -> str:
        return f"servo {servo} ({self._names[servo]})"
