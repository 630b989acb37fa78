"""`points.csv` and `tracks.csv`: written row by row during a run, read back with checks.

A table is CSV in UTF-8 with a header; its columns are the fields of its row class. A cell without a
value is empty. Numbers are written with as many digits as are needed to read back the same number.
Readers find columns by name, ignore unknown ones, and accept tables of earlier versions without the
columns added since.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import math
import os
import re
import stat
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Generic, Self, TypeAlias, TypeVar, get_args, get_type_hints

from fingerpost.errors import InvalidInputError, RecordingError

_WHOLE = re.compile(r"\d+", re.ASCII)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
# Relative error of a singular covariance's determinant after printing and reading it back.
_ROUNDING = 1e-9


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PointRow:
    """The fix of one frame: a row of `points.csv`.

    Attributes
    ----------
    frame
        Index in the source of the first view.
    time_s
        Time of the fix, in seconds.
    status
        `ok`, `acquiring`, `lost` or `ill_conditioned`.
    x, y
        The indicated point in plane units; None without a point.
    cov_xx, cov_xy, cov_yy
        Its covariance in plane units squared; None if unknown.
    crossing_angle_deg
        Angle at which the constraint lines cross on the plane, in degrees, 0 to 90.
    reason
        Why the status is not `ok`, or which views did not contribute, in one line with the names of
        the views; else empty.
    """

    STATUSES: ClassVar = ("ok", "acquiring", "lost", "ill_conditioned")
    ADDED: ClassVar = ("reason",)
    """Columns that tables of earlier versions lack."""

    frame: int
    time_s: float
    status: str
    x: float | None = None
    y: float | None = None
    cov_xx: float | None = None
    cov_xy: float | None = None
    cov_yy: float | None = None
    crossing_angle_deg: float | None = None
    reason: str = ""

    def __post_init__(self) -> None:
        _check_cells(self)
        _together(self, "x", "y")
        _together(self, "cov_xx", "cov_xy", "cov_yy")
        if self.status == "ok" and self.x is None:
            raise InvalidInputError("x is empty; a fix with status ok has a point")
        if self.cov_xx is None or self.cov_xy is None or self.cov_yy is None:
            return
        product = self.cov_xx * self.cov_yy
        if min(self.cov_xx, self.cov_yy) < 0 or self.cov_xy * self.cov_xy > product * (
            1 + _ROUNDING
        ):
            raise InvalidInputError(
                f"cov_xx, cov_xy, cov_yy = {self.cov_xx}, {self.cov_xy}, {self.cov_yy}: "
                "not a covariance"
            )


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class TrackRow:
    """One frame of one view: a row of `tracks.csv`.

    Attributes
    ----------
    frame
        Index in the view's source.
    time_s
        The frame's capture time, in seconds.
    view
        The view's name.
    status
        `acquiring`, `tracking` or `lost`.
    tip_u, tip_v
        Tip of the finger in px; None unless tracked.
    angle_rad
        Direction of pointing in the image, in radians: 0 is +u (right), pi / 2 is +v (down).
    sigma_angle_rad
        Its standard deviation.
    sigma_offset_px
        Standard deviation of the finger line along its normal, in px.
    """

    STATUSES: ClassVar = ("acquiring", "tracking", "lost")
    ADDED: ClassVar[tuple[str, ...]] = ()
    """Columns that tables of earlier versions lack."""

    frame: int
    time_s: float
    view: str
    status: str
    tip_u: float | None = None
    tip_v: float | None = None
    angle_rad: float | None = None
    sigma_angle_rad: float | None = None
    sigma_offset_px: float | None = None

    def __post_init__(self) -> None:
        _check_cells(self)
        if not self.view:
            raise InvalidInputError("view is empty; the view's name is needed")
        _together(self, "tip_u", "tip_v", "angle_rad")
        if self.status == "tracking" and self.tip_u is None:
            raise InvalidInputError("tip_u is empty; a finger that is tracked has a tip")
        for name in ("sigma_angle_rad", "sigma_offset_px"):
            sigma = getattr(self, name)
            if sigma is not None and sigma < 0:
                raise InvalidInputError(f"{name} is {sigma}; 0 or more is right")


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class BesideRow:
    """One frame's fix and the recorded one: a row of the table of `fingerpost replay --beside`.

    Attributes
    ----------
    frame, time_s, status, x, y
        The present fix, as in `PointRow`.
    recorded_status, recorded_x, recorded_y
        The recorded fix; empty without one for that frame.
    distance
        Distance between both points, in plane units; None unless there are two.
    """

    STATUSES: ClassVar = PointRow.STATUSES
    ADDED: ClassVar[tuple[str, ...]] = ()
    """Columns that tables of earlier versions lack."""

    frame: int
    time_s: float
    status: str
    x: float | None = None
    y: float | None = None
    recorded_status: str = ""
    recorded_x: float | None = None
    recorded_y: float | None = None
    distance: float | None = None

    def __post_init__(self) -> None:
        _check_cells(self)
        _together(self, "x", "y")
        _together(self, "recorded_x", "recorded_y")


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class TargetRow:
    """One target of an experiment with an operator.

    Attributes
    ----------
    frame
        Index in the source of the first view.
    time_s
        Time of the fix, in seconds.
    status
        Status of the fix: `ok`, `acquiring`, `lost` or `ill_conditioned`.
    target_x, target_y
        Position of the target, in plane units.
    x, y
        The indicated point in plane units; None without a point.
    cov_xx, cov_xy, cov_yy
        Its covariance in plane units squared; None without a point.
    error
        Distance from the target to the point, in plane units; None without a point.
    by
        How it was selected: `dwell`, `key`, or `skip` if the operator skipped it.
    """

    STATUSES: ClassVar = PointRow.STATUSES
    ADDED: ClassVar[tuple[str, ...]] = ()
    """Columns that tables of earlier versions lack."""

    frame: int
    time_s: float
    status: str
    target_x: float
    target_y: float
    x: float | None = None
    y: float | None = None
    cov_xx: float | None = None
    cov_xy: float | None = None
    cov_yy: float | None = None
    error: float | None = None
    by: str = ""

    def __post_init__(self) -> None:
        _check_cells(self)
        _together(self, "x", "y", "cov_xx", "cov_xy", "cov_yy", "error")


_AnyRow: TypeAlias = PointRow | TrackRow | BesideRow | TargetRow
Row = TypeVar("Row", PointRow, TrackRow, BesideRow, TargetRow)


class TableWriter(Generic[Row]):
    """A table on disk that grows by one row at a time; best used in a `with` statement.

    Each row is passed to the operating system before `write` returns, so that neither Ctrl-C nor a
    crash loses it. An existing file is kept until the first row, or until a `with` statement ends
    without a row or an error: a run that is refused at the start does not destroy a table.
    """

    def __init__(self, path: str | Path, row_type: type[Row]) -> None:
        self.path = Path(path)
        self._columns = _columns(row_type)
        self._has_begun = False
        try:
            try:
                self._file, self._is_new = self.path.open("xb", buffering=0), True
            except FileExistsError:
                self._file, self._is_new = self.path.open("ab", buffering=0), False
        except (OSError, ValueError) as error:  # ValueError: a name that no file can have
            reason = error.strerror if isinstance(error, OSError) else error
            raise InvalidInputError(
                f"{path}: cannot be written: {reason}; name a file in an existing folder"
            ) from error

    def write(self, row: Row) -> None:
        """Append a row.

        Raises
        ------
        RecordingError
            The file cannot be written any more, for instance because the disk is full.
        """
        self._begin()
        self._write([_cell(getattr(row, column)) for column in self._columns])

    def _begin(self) -> None:
        """Truncate the file and write the header, unless that is done."""
        if self._has_begun:
            return
        self._has_begun = True
        if stat.S_ISREG(os.fstat(self._file.fileno()).st_mode):  # a pipe has nothing to lose
            self._file.truncate(0)
        self._write(self._columns)

    def _write(self, cells: Sequence[str]) -> None:
        line = io.StringIO()
        csv.writer(line, lineterminator="\n").writerow(cells)
        data = line.getvalue().encode()
        try:
            complete = self._file.write(data) == len(data)
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be written: {error.strerror}") from error
        if not complete:
            raise RecordingError(f"{self.path}: cannot be written: the disk is full")

    def close(self) -> None:
        """Close the file; closing twice does nothing. A new file without a header is removed."""
        was_open = not self._file.closed
        self._file.close()
        if was_open and self._is_new and not self._has_begun:
            self.path.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                self._begin()
        finally:
            self.close()


def write_points(path: str | Path) -> TableWriter[PointRow]:
    """Open a `points.csv`; it replaces a file of that name (see `TableWriter` for when).

    Raises
    ------
    InvalidInputError
        The file cannot be created.
    """
    return TableWriter(path, PointRow)


def write_tracks(path: str | Path) -> TableWriter[TrackRow]:
    """Open a `tracks.csv`; it replaces a file of that name (see `TableWriter` for when).

    Raises
    ------
    InvalidInputError
        The file cannot be created.
    """
    return TableWriter(path, TrackRow)


def write_targets(path: str | Path) -> TableWriter[TargetRow]:
    """Open a table of an experiment's targets, as `write_points`.

    Raises
    ------
    InvalidInputError
        The file cannot be created.
    """
    return TableWriter(path, TargetRow)


def read_points(path: str | Path) -> list[PointRow]:
    """Read a `points.csv`.

    Raises
    ------
    InvalidInputError
        The file cannot be read, lacks a column, or has an invalid cell or row; the message names
        file, line, column and value.
    """
    return _read(Path(path), PointRow)


def read_tracks(path: str | Path) -> list[TrackRow]:
    """Read a `tracks.csv`.

    Raises
    ------
    InvalidInputError
        As for `read_points`.
    """
    return _read(Path(path), TrackRow)


def read_targets(path: str | Path) -> list[TargetRow]:
    """Read a table of an experiment's targets.

    Raises
    ------
    InvalidInputError
        As for `read_points`.
    """
    return _read(Path(path), TargetRow)


def _read(path: Path, row_type: type[Row]) -> list[Row]:
    rows = []
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = csv.reader(file, strict=True)
            header = next(lines, [])
            for column in _columns(row_type):
                if column not in header and column not in row_type.ADDED:
                    raise InvalidInputError(f"line 1: the column {column} is missing")
            try:
                rows = [_row(row_type, header, cells) for cells in lines]
            except (InvalidInputError, csv.Error) as error:
                raise InvalidInputError(f"line {lines.line_num}: {error}") from error
    except OSError as error:
        raise InvalidInputError(f"{path}: {error.strerror}; a table is needed") from error
    except UnicodeDecodeError as error:
        raise InvalidInputError(f"{path}: not a text file in UTF-8") from error
    except (InvalidInputError, csv.Error) as error:
        raise InvalidInputError(f"{path}: {error}") from error
    return rows


def _row(row_type: type[Row], header: list[str], cells: list[str]) -> Row:
    if len(cells) != len(header):
        raise InvalidInputError(f"{len(cells)} cells found; the header has {len(header)}")
    named = dict(zip(header, cells, strict=True))
    kinds = get_type_hints(row_type)
    values: dict[str, Any] = {
        column: _value(named[column], column, kinds[column])
        for column in _columns(row_type)
        if column in named
    }
    return row_type(**values)


def _columns(row_type: type[_AnyRow]) -> list[str]:
    return [field.name for field in dataclasses.fields(row_type)]


def _cell(value: float | str | None) -> str:
    """Return a cell's text; `float` removes the type name in the repr of NumPy numbers."""
    if value is None or isinstance(value, str):
        return value or ""
    return repr(value if isinstance(value, int) else float(value))


def _value(cell: str, column: str, kind: object) -> float | str | None:
    if kind is str:
        return cell
    if kind is int and _WHOLE.fullmatch(cell):
        return int(cell)
    if kind is not int and _NUMBER.fullmatch(cell):
        return float(cell)
    if not cell and type(None) in get_args(kind):
        return None
    wanted = "a whole number" if kind is int else "a number"
    raise InvalidInputError(f"{column} is {cell!r}; {wanted} is needed")


def _check_cells(row: _AnyRow) -> None:
    if isinstance(row.frame, bool) or not isinstance(row.frame, int) or row.frame < 0:
        raise InvalidInputError(f"frame is {row.frame!r}; a whole number from 0 is needed")
    if row.status not in row.STATUSES:
        raise InvalidInputError(f"status is {row.status!r}; known are {', '.join(row.STATUSES)}")
    for column in _columns(type(row)):
        value = getattr(row, column)
        if isinstance(value, float) and not math.isfinite(value):
            raise InvalidInputError(f"{column} is {value}; a finite number or no value is needed")
        if isinstance(value, str) and not value.isprintable():
            raise InvalidInputError(f"{column} is {value!r}; one line of printable text is needed")


def _together(row: _AnyRow, *columns: str) -> None:
    empty = [getattr(row, column) is None for column in columns]
    if any(empty) and not all(empty):
        raise InvalidInputError(f"{', '.join(columns)} must all be given or all be empty")
