"""Faults that can be simulated."""

from __future__ import annotations

from enum import StrEnum

import numpy as np


class Fault(StrEnum):
    """A fault that an emulator can simulate.

    Faults of the arm occur at once or with the next command concerned; those of the line affect the
    next transfer.
    """

    IMPACT = "impact"
    OVERLOAD = "overload"
    OUT_OF_RANGE = "out-of-range"
    HOME_FAILURE = "home-failure"
    ECHO_OFF = "echo-off"
    PAGING = "paging"
    STICK = "stick"
    GARBAGE = "garbage"
    CUT = "cut"
    SILENT = "silent"
    SLOW = "slow"
    GARBLED_INPUT = "garbled-input"
    XOFF = "xoff"
    OVERHEAT = "overheat"
    UNDERVOLTAGE = "undervoltage"
    LOST_SERVO = "lost-servo"
    UNPLUG = "unplug"
    PLUG = "plug"


LINE_FAULTS = frozenset(
    {Fault.GARBAGE, Fault.CUT, Fault.SILENT, Fault.SLOW, Fault.GARBLED_INPUT, Fault.XOFF}
)
"""Faults of the line, independent of the controller."""

GARBAGE_BYTES = 3
"""Number of bytes per burst of noise."""

XOFF = b"\x13"


class LineFaults:
    """Noise and gaps between a controller and its port.

    Parameters
    ----------
    rng : numpy.random.Generator
        Chooses bytes and positions.
    slow_s : float
        Delay of a slow answer [s].
    """

    def __init__(self, rng: np.random.Generator, slow_s: float) -> None:
        self._rng = rng
        self._slow_s = slow_s
        self._due: dict[Fault, int] = {}

    def inject(self, fault: Fault, count: int) -> None:
        """Apply this fault to the next `count` transfers."""
        self._due[fault] = self._due.get(fault, 0) + count

    def clear(self) -> None:
        """Remove all faults."""
        self._due.clear()

    def on_input(self, data: bytes) -> bytes:
        """Return the bytes that the controller receives of those sent."""
        return self._scrambled(data) if self._take(Fault.GARBLED_INPUT) else data

    def on_output(self, data: bytes) -> tuple[bytes, float]:
        """Return the bytes that leave the controller's port, and their delay [s]."""
        if self._take(Fault.SILENT):
            return b"", 0.0
        if self._take(Fault.CUT):
            data = data[: int(self._rng.integers(0, len(data)))]
        if self._take(Fault.GARBAGE):
            place = int(self._rng.integers(0, len(data) + 1))
            noise = self._rng.integers(0, 256, GARBAGE_BYTES, dtype=np.uint8).tobytes()
            data = data[:place] + noise + data[place:]
        if self._take(Fault.XOFF):
            data += XOFF
        return data, self._slow_s if self._take(Fault.SLOW) else 0.0

    def _take(self, fault: Fault) -> bool:
        left = self._due.get(fault, 0)
        if left:
            self._due[fault] = left - 1
        return left > 0

    def _scrambled(self, data: bytes) -> bytes:
        place = int(self._rng.integers(0, len(data)))
        return data[:place] + bytes([int(self._rng.integers(32, 127))]) + data[place + 1 :]
