"""Checks of arguments at the public boundary: a checked array, or a typed error.

All messages about shape, type, NaN and covariance of measurements are worded here; options of the
simulated rig have `fingerpost.simulate.checks`. A message names the value, its place and what would
be right.
"""

import math
import os
from pathlib import Path
from types import EllipsisType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.errors import InvalidInputError

# Largest deviation from symmetry or a zero eigenvalue [share of the largest entry]. Rounding in
# floating point causes far smaller ones.
_COVARIANCE_ROUNDING = 1e-9


def finite_array(
    value: ArrayLike, name: str, shape: tuple[int | str | EllipsisType, ...]
) -> NDArray[np.float64]:
    """Return `value` as an array of finite floats of the required shape.

    Parameters
    ----------
    value
        Anything NumPy can read as integers or real numbers.
    name
        The caller's name of the value; every message begins with it.
    shape
        Required shape: integers, except that the first entry may be a letter for any length, or
        ``...`` for any leading axes, as in ``("N", 2)`` and ``(..., 2)``.

    Returns
    -------
    ndarray of float64
        The value itself if it already is such an array; this package never writes to it.

    Raises
    ------
    InvalidInputError
        Not numbers, another shape, or an entry that is NaN or infinite (the first is named).
    """
    if (
        type(value) is np.ndarray
        and value.dtype == np.float64
        and _fits(value.shape, shape)
        and math.isfinite(np.vdot(value, value))
    ):
        return value  # takes a microsecond: this runs in every frame
    try:
        array = np.asarray(value)
    except ValueError as error:  # rows of different length
        raise InvalidInputError(f"{name}: {error}; an array {_words(shape)} is needed") from error
    if array.dtype.kind not in "iuf":
        raise InvalidInputError(f"{name}: {array.dtype} found; real numbers are needed")
    if not _fits(array.shape, shape):
        raise InvalidInputError(f"{name}: shape {array.shape} found; {_words(shape)} is needed")
    array = array.astype(np.float64, copy=False)
    finite = np.isfinite(array)
    if not finite.all():
        place = tuple(int(i) for i in np.argwhere(~finite)[0])
        where = f"{name}{list(place)}" if place else name
        raise InvalidInputError(f"{where} is {array[place]}; a finite number is needed")
    return array


def covariance_array(
    value: ArrayLike, name: str, shape: tuple[int | str | EllipsisType, ...]
) -> NDArray[np.float64]:
    """Return `value` as covariance matrices over its last two axes, made exactly symmetric.

    Parameters
    ----------
    value, name, shape
        As for `finite_array`; the last two entries of `shape` are equal.

    Returns
    -------
    ndarray of float64
        Symmetric; may be singular or zero, for quantities that are known exactly.

    Raises
    ------
    InvalidInputError
        As `finite_array`; or not symmetric, or with a negative eigenvalue.
    """
    array = finite_array(value, name, shape)
    if array.shape == (2, 2) and (known := _symmetric_2x2(array)) is not None:
        return known
    transposed = np.swapaxes(array, -1, -2)
    slack = _COVARIANCE_ROUNDING * abs(array).max(axis=(-1, -2), initial=0.0)
    if (abs(array - transposed) > slack[..., None, None]).any():
        raise InvalidInputError(f"{name} is not symmetric: {array.tolist()}")
    array = (array + transposed) / 2
    smallest = np.linalg.eigvalsh(array)[..., 0]
    if (smallest < -slack).any():
        raise InvalidInputError(
            f"{name} has the negative eigenvalue {smallest.min():.3g}; a covariance has none"
        )
    return array


def _symmetric_2x2(array: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return one 2 × 2 covariance made symmetric, in a microsecond; None for another matrix."""
    (xx, xy), (yx, yy) = array.tolist()
    slack = _COVARIANCE_ROUNDING * max(abs(xx), abs(xy), abs(yx), abs(yy))
    mixed = (xy + yx) / 2
    smallest = (xx + yy) / 2 - math.hypot((xx - yy) / 2, mixed)
    if abs(xy - yx) > slack or smallest < -slack:
        return None
    return array if xy == yx else np.array([[xx, mixed], [mixed, yy]])


def in_range(value: float, name: str, low: float, high: float = np.inf) -> float:
    """Return `value` as a float if ``low <= value <= high`` (so NaN is refused).

    Raises
    ------
    InvalidInputError
        Not a real number, or outside the range; the message names both.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise InvalidInputError(f"{name}: {value!r} found; a real number is needed")
    if not low <= value <= high:
        raise InvalidInputError(f"{name} is {value}; from {low:g} to {high:g} is right")
    return float(value)


def opencv_path(path: Path, name: str) -> str:
    """Return `path` as the string by which OpenCV finds that file.

    OpenCV passes the UTF-8 of a string to the system, whatever Python's encoding of file names is,
    and terminates the process if a string has no UTF-8.

    Parameters
    ----------
    path
        A file to be read or written.
    name
        The caller's name of the path; every message begins with it.

    Returns
    -------
    str
        Its UTF-8 is the file's name in the system. Under a locale whose file names are not UTF-8
        it may differ from ``str(path)``: pass it to OpenCV only.

    Raises
    ------
    InvalidInputError
        The path is not UTF-8, or the locale's encoding cannot write it.
    """
    try:
        return os.fsencode(path).decode("utf-8")
    except UnicodeError as error:
        shown = str(path).encode("utf-8", errors="backslashreplace").decode("utf-8")
        raise InvalidInputError(
            f"{name}: the path {shown} is not UTF-8, as OpenCV needs it; rename the file or its "
            "folder, or use a UTF-8 locale"
        ) from error


def unused(path: Path) -> Path:
    """Return a path that does not exist yet: the given one, or one with a number in its name.

    Parameters
    ----------
    path
        In an existing folder: `rig.toml` gives `rig.toml`, `rig-2.toml`, `rig-3.toml`, ...
    """
    found, number = path, 1
    while found.exists():
        number += 1
        found = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return found


def part_of(path: Path) -> Path:
    """Return the unique temporary name of a file that is renamed once it is complete."""
    return path.with_name(f"{path.name}.{os.getpid()}.part")


def make_folder(folder: Path) -> Path:
    """Create a folder and its parents if they do not exist; return it.

    Raises
    ------
    InvalidInputError
        It cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InvalidInputError(
            f"{folder}: cannot be made: {reason}; name a folder that may be written into"
        ) from error
    return folder


def _fits(found: tuple[int, ...], shape: tuple[int | str | EllipsisType, ...]) -> bool:
    if not shape:
        return not found
    if shape[0] is ...:
        return len(found) >= len(shape) - 1 and found[len(found) - len(shape) + 1 :] == shape[1:]
    if isinstance(shape[0], str):
        return len(found) == len(shape) and found[1:] == shape[1:]
    return found == shape


def _words(shape: tuple[int | str | EllipsisType, ...]) -> str:
    return "(" + ", ".join("..." if axis is ... else str(axis) for axis in shape) + ")"
