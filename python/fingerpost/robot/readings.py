"""Believing a position that comes over a line without a checksum.

One reading alone is never believed: noise can turn a digit into another. A reading that equals
another one is. A moving arm never repeats itself; there the median of three is taken, coordinate
by coordinate. It lies between positions the arm has really had even if any one of the three is
wrong, and three that are further apart than the arm can have gone are refused.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from typing import TypeAlias

from fingerpost.robot.errors import GarbledReplyError

Reading: TypeAlias = tuple[float, ...]


class ReadingFilter:
    """Confirms readings with those before them.

    Parameters
    ----------
    clock : callable
        Monotonic time [s].
    speed : float
        Greatest speed of any of the first three coordinates [unit/s].
    slack : float
        Way that the arm may go during one reading [unit].
    """

    def __init__(self, clock: Callable[[], float], speed: float, slack: float) -> None:
        self._clock = clock
        self._speed = speed
        self._slack = slack
        self._last: Reading | None = None

    def forget(self) -> None:
        """Confirm nothing with what was read before."""
        self._last = None

    def read(self, raw: Callable[[], Reading]) -> Reading:
        """Read until a reading is confirmed.

        Parameters
        ----------
        raw : callable
            Makes one reading.

        Raises
        ------
        GarbledReplyError
            Three readings are further apart than the arm can have gone.
        """
        start_s = self._clock()
        readings = [raw()]
        while len(readings) < 3 and readings[-1] not in (self._last, *readings[:-1]):
            readings.append(raw())
        last, self._last = self._last, readings[-1]
        if readings[-1] in (last, *readings[:-1]):
            return readings[-1]
        return self._median(readings, self._clock() - start_s)

    def _median(self, readings: Sequence[Reading], span_s: float) -> Reading:
        by_axis = list(zip(*readings, strict=True))
        travel = self._speed * span_s + self._slack
        if any(max(axis) - min(axis) > travel for axis in by_axis[:3]):
            self._last = None
            raise GarbledReplyError(f"three readings of the position disagree: {list(readings)}")
        return tuple(statistics.median(axis) for axis in by_axis)
