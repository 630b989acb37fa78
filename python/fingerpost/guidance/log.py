"""The log of commands: what was sent to the robot, when, and the fix that caused it."""

from __future__ import annotations

import csv
import io
import os
from pathlib import Path
from types import TracebackType
from typing import Self

from fingerpost.errors import RecordingError
from fingerpost.robot import CommandRecord

COLUMNS = (
    "time_s",
    "command",
    "detail",
    "outcome",
    "x_m",
    "y_m",
    "z_m",
    "fix_time_s",
    "fix_status",
    "fix_x",
    "fix_y",
    "fix_cov_xx",
    "fix_cov_xy",
    "fix_cov_yy",
)


class CommandLog:
    """A CSV file that grows by a row with every `CommandRecord`; a context manager.

    Call it with the records: from any thread, and from a signal's handler that has interrupted such
    a call. A row is handed to the operating system whole and at once. Cells are empty where there
    is no goal, no fix, or a fix without a point; the fix is in plane units.

    Parameters
    ----------
    path
        The file, which is replaced.

    Raises
    ------
    RecordingError
        It cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND
        try:
            self._descriptor = os.open(self._path, flags, 0o644)
        except OSError as error:
            raise self._failure(error) from error
        self._write(COLUMNS)

    def __call__(self, record: CommandRecord) -> None:
        """Write a record."""
        self._write(_cells(record))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        os.close(self._descriptor)

    def _write(self, cells: tuple[object, ...]) -> None:
        line = io.StringIO()
        csv.writer(line, lineterminator="\n").writerow(cells)
        try:
            os.write(self._descriptor, line.getvalue().encode())
        except OSError as error:
            raise self._failure(error) from error

    def _failure(self, error: OSError) -> RecordingError:
        return RecordingError(f"{self._path}: cannot be written: {error.strerror}")


def _cells(record: CommandRecord) -> tuple[object, ...]:
    pose, fix = record.pose, record.fix
    goal = ("", "", "") if pose is None else (pose.x_m, pose.y_m, pose.z_m)
    cause: tuple[object, ...] = ("",) * 7
    if fix is not None:
        point = ("", "") if fix.point is None else tuple(map(float, fix.point))
        Σ = fix.covariance
        covariance = ("", "", "") if Σ is None else (float(Σ[0, 0]), float(Σ[0, 1]), float(Σ[1, 1]))
        cause = (fix.time_s, fix.status.value, *point, *covariance)
    return (record.time_s, record.command, record.detail, record.outcome, *goal, *cause)
