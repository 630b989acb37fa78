"""Tables as Parquet: typed columns whose names hold their units, for pandas, Polars, DuckDB and R.

Columns are those of `points.csv` and `tracks.csv`; names of columns in plane units contain the
plane's unit. The file's metadata describe each column.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args, get_type_hints

from fingerpost.checks import part_of
from fingerpost.errors import InvalidInputError, RecordingError
from fingerpost.installation import require
from fingerpost.recording.tables import Row

SUFFIX = ".parquet"

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EIO)

_UNITS = {
    "x": "{unit}",
    "y": "{unit}",
    "cov_xx": "{unit}2",
    "cov_xy": "{unit}2",
    "cov_yy": "{unit}2",
    "tip_u": "px",
    "tip_v": "px",
}
"""Suffixes of the names of columns that do not already contain their unit."""

_MEANINGS = {
    "frame": "index in the source of the first view; of a track, in the view's own",
    "time_s": "time the row is for [s]",
    "status": "ok, acquiring, lost or ill_conditioned; of a track: acquiring, tracking or lost",
    "x": "indicated point [{unit}]",
    "y": "indicated point [{unit}]",
    "cov_xx": "its covariance [{unit}²]",
    "cov_xy": "its covariance [{unit}²]",
    "cov_yy": "its covariance [{unit}²]",
    "crossing_angle_deg": "angle at which the constraint lines cross, 0 to 90 [°]",
    "reason": "why the status is not ok, or which views were missing",
    "view": "name of the view",
    "tip_u": "tip of the finger, to the right from the centre of the first pixel [px]",
    "tip_v": "tip of the finger, downwards [px]",
    "angle_rad": "direction of pointing in the image, from right towards down [rad]",
    "sigma_angle_rad": "its standard deviation [rad]",
    "sigma_offset_px": "standard deviation of the finger line across itself [px]",
}


def column_names(row_type: type[Row], unit: str) -> dict[str, str]:
    """Return the name of each column, by its name in the CSV table.

    Parameters
    ----------
    row_type
        Row type of the table.
    unit
        Unit of the plane; characters other than letters and digits become `_`.
    """
    word = re.sub(r"\W+", "_", unit).strip("_") or "unit"
    names = [field.name for field in dataclasses.fields(row_type)]
    return {
        name: f"{name}_{_UNITS[name].format(unit=word)}" if name in _UNITS else name
        for name in names
    }


def write_parquet(
    path: Path, rows: Sequence[Row], row_type: type[Row], *, unit: str, about: Mapping[str, str]
) -> None:
    """Write rows to a file, which replaces an existing one once it is complete.

    Parameters
    ----------
    path
        The file.
    rows, row_type
        The table.
    unit
        Unit of the plane.
    about
        Metadata of the file.

    Raises
    ------
    RecordingError
        The file cannot be written to its end, for instance because the disk is full.
    InvalidInputError
        It cannot be created.
    MissingExtraError
        The extra `parquet` is not installed.
    """
    arrow, parquet = require("pyarrow", "parquet"), require("pyarrow.parquet", "parquet")
    schema = _schema(arrow, row_type, unit, about)
    names = column_names(row_type, unit)
    columns = {column: [getattr(row, name) for row in rows] for name, column in names.items()}
    part = part_of(path)
    try:
        with part.open("wb") as file:
            parquet.write_table(arrow.table(columns, schema), file, compression="zstd")
        part.replace(path)
    except OSError as error:
        kind = RecordingError if error.errno in _FULL else InvalidInputError
        raise kind(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink()  # an incomplete file, which nothing can read


def _schema(arrow: Any, row_type: type[Row], unit: str, about: Mapping[str, str]) -> Any:
    hints = get_type_hints(row_type)
    kinds = {int: arrow.int64(), float: arrow.float64(), str: arrow.string()}
    fields = []
    for name, column in column_names(row_type, unit).items():
        kind = next(one for one in (get_args(hints[name]) or (hints[name],)) if one in kinds)
        meaning = {"meaning": _MEANINGS[name].format(unit=unit)}
        is_optional = hints[name] is not kind
        fields.append(arrow.field(column, kinds[kind], nullable=is_optional, metadata=meaning))
    return arrow.schema(fields, metadata=dict(about))
