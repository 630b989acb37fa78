"""Validation of positions that are read over a line without a checksum.

A single reading is never trusted, because noise can change a digit. Two equal readings are. The
readings of a moving arm always differ; then the median of three is used, for each coordinate. It
lies between true positions of the arm even if any one of the three is wrong. Three readings that
are further apart than the arm can have moved are refused.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from typing import TypeAlias

from fingerpost.robot.errors import GarbledReplyError

Reading: TypeAlias = tuple[float, ...]


class ReadingFilter:
    """Confirms readings by the previous ones.

    Parameters
    ----------
    clock : callable
        Monotonic time [s].
    speed : float
        Greatest speed of any of the first three coordinates [unit/s].
    slack : float
        Distance that the arm may move during one reading [unit].
    """

    def __init__(self, clock: Callable[[], float], speed: float, slack: float) -> None:
        self._clock = clock
        self._speed = speed
        self._slack = slack
        self._last: Reading | None = None

    def forget(self) -> None:
        """Discard the previous readings."""
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
            Three readings are further apart than the arm can have moved.
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
