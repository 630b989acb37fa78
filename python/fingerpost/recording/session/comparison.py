"""Comparison of the fixes in a recording with those computed from the same frames now."""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from fingerpost.recording.session.export import recorded_points
from fingerpost.recording.tables import BesideRow, PointRow, TableWriter


def write_beside(path: Path) -> TableWriter[BesideRow]:
    """Open a table that compares fixes with recorded ones; it replaces an existing file.

    Raises
    ------
    InvalidInputError
        The file cannot be created.
    """
    return TableWriter(path, BesideRow)


class Comparison:
    """Comparison of fixes with recorded ones.

    Fixes of one frame are compared in their order: while the first view of a live rig sends
    nothing, the number of its next frame is that of several fixes.

    Parameters
    ----------
    recorded
        The recorded fixes, in order.
    """

    def __init__(self, recorded: Iterable[PointRow]) -> None:
        self._recorded: defaultdict[int, deque[PointRow]] = defaultdict(deque)
        for row in recorded:
            self._recorded[row.frame].append(row)
        self._equal = self._compared = 0
        self._before: Counter[str] = Counter()
        self._now: Counter[str] = Counter()
        self._apart: list[float] = []

    @classmethod
    def with_recording(cls, path: Path) -> Comparison:
        """Compare with the fixes of a recording; raises as `recorded_points`."""
        return cls(recorded_points(path))

    def add(self, row: PointRow) -> BesideRow:
        """Compare a fix with the recorded one of its frame, and return both as a row."""
        of_frame = self._recorded.get(row.frame)
        before = of_frame.popleft() if of_frame else None
        if before is None:
            return BesideRow(
                frame=row.frame, time_s=row.time_s, status=row.status, x=row.x, y=row.y
            )
        self._compared += 1
        self._equal += before == row
        self._before[before.status] += 1
        self._now[row.status] += 1
        distance = None
        if None not in (row.x, row.y, before.x, before.y):
            distance = float(np.hypot(row.x - before.x, row.y - before.y))  # type: ignore[operator]
            self._apart.append(distance)
        return BesideRow(
            frame=row.frame,
            time_s=row.time_s,
            status=row.status,
            x=row.x,
            y=row.y,
            recorded_status=before.status,
            recorded_x=before.x,
            recorded_y=before.y,
            distance=distance,
        )

    def lines(self, unit: str) -> list[str]:
        """Return a summary of the comparison, line by line; empty without recorded fixes."""
        if not self._compared:
            return []
        if self._equal == self._compared:
            return [f"all {self._equal} fixes are the recorded ones, to the last bit"]
        others = self._compared - self._equal
        lines = [
            f"{others} of {self._compared} fixes differ from the recorded ones",
            *(
                f"{status:<16} {self._before[status]:5d} -> {self._now[status]:5d}"
                for status in self._before | self._now
            ),
        ]
        if self._apart:
            median, most = np.median(self._apart), max(self._apart)
            lines.append(f"points are {median:.3g} {unit} apart at the median, {most:.3g} at most")
        return lines
