"""Log of the commands sent to the robot, with their times and the fixes that caused them."""

from __future__ import annotations

import csv
import io
import os
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from fingerpost.errors import RecordingError
from fingerpost.robot import CommandRecord


@dataclass(frozen=True, slots=True)
class CommandRow:
    """One command: a row of the log.

    Attributes
    ----------
    time_s
        Time on the guard's clock [s].
    command, detail, outcome
        As in `CommandRecord`.
    x_m, y_m, z_m
        The goal of a motion, in the robot's frame [m]; None for other commands.
    fix_time_s, fix_status, fix_x, fix_y, fix_cov_xx, fix_cov_xy, fix_cov_yy
        The fix that caused it, in seconds and plane units; None without a fix or a point.
    """

    time_s: float
    command: str
    detail: str
    outcome: str
    x_m: float | None = None
    y_m: float | None = None
    z_m: float | None = None
    fix_time_s: float | None = None
    fix_status: str | None = None
    fix_x: float | None = None
    fix_y: float | None = None
    fix_cov_xx: float | None = None
    fix_cov_xy: float | None = None
    fix_cov_yy: float | None = None

    @classmethod
    def of(cls, record: CommandRecord) -> Self:
        """Return the row of a record."""
        pose, fix = record.pose, record.fix
        goal = (None,) * 3 if pose is None else (pose.x_m, pose.y_m, pose.z_m)
        cause: tuple[Any, ...] = ()
        if fix is not None:
            point = (None, None) if fix.point is None else fix.point.tolist()
            Σ = fix.covariance
            covariance = (None,) * 3 if Σ is None else (Σ.item(0, 0), Σ.item(0, 1), Σ.item(1, 1))
            cause = (fix.time_s, fix.status.value, *point, *covariance)
        return cls(record.time_s, record.command, record.detail, record.outcome, *goal, *cause)


class CommandLog:
    """A CSV file with one row per `CommandRecord`; a context manager.

    Call it with the records, from any thread, and from a signal handler that has interrupted such a
    call. Each row is written to the operating system in one piece and at once. Cells are empty
    without a goal, a fix or a point; the fix is in plane units.

    Parameters
    ----------
    path
        The file; an existing one is replaced.

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
        self._write(tuple(column.name for column in fields(CommandRow)))

    def __call__(self, record: CommandRecord) -> None:
        """Write a record."""
        self._write(astuple(CommandRow.of(record)))

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
