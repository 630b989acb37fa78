"""Capture times of still images, by the numbers in their names.

Programs that save a stream number its frames or name them by the clock: as a number, or as date and
time of day (ISO 8601, with any separators). A missing number is a lost frame: the later ones are
dated accordingly, in this view alone. Other numbers, such as those of selected pictures, are
ignored.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

_log = logging.getLogger(__name__)

LEAST_THERE = 0.5
"""Least share of consecutive numbers for which they count frames; with fewer, images were selected.
"""

_NUMBER = re.compile(r"(\d+(?:\.\d+)?)(?!.*\d)")
"""The last number of a name."""

_CALENDAR = re.compile(
    r"(?<!\d)((?:19|20)\d\d)\D?(\d\d)\D?(\d\d)(?:\D{1,2})(\d\d)\D?(\d\d)\D?(\d\d)(?:\D(\d{1,9}))?(?!\d)"
)
"""Date, time of day and decimals of a second: 2026-11-30T18-22-27.125 or 20261130_182227."""

# Digits of seconds, milli-, micro- and nanoseconds since 1970, from 2001 to 2286.
_CLOCKS = {13: 1e-3, 16: 1e-6, 19: 1e-9}
_SECONDS_DIGITS = 10


class Taken(NamedTuple):
    """Position and capture time of one image.

    Attributes
    ----------
    place
        Its position in the stream, from 0; missing images leave a gap.
    time_s
        Its time [s]: since the first image, or by the clock in its name.
    """

    place: int
    time_s: float


def taken(paths: Sequence[Path], fps: float, name: str) -> list[Taken]:
    """Return positions and capture times of images.

    Parameters
    ----------
    paths
        Paths, in order.
    fps
        Frames per second of images whose names are not times.
    name
        Name of the source in messages.
    """
    numbers = _numbers(paths)
    clock_s = _calendar_s(paths) or _clock_s(numbers)
    if clock_s is not None:
        return [Taken(k, time_s) for k, time_s in enumerate(clock_s)]
    indices = _indices(numbers) or list(range(len(paths)))
    missing = indices[-1] + 1 - len(indices)
    if missing:
        k = next(k for k in range(1, len(indices)) if indices[k] > indices[k - 1] + 1)
        _log.warning(
            "%s: %d numbers are missing, the first of them after %s: taken for frames that were "
            "lost",
            name,
            missing,
            paths[k - 1].name,
        )
    return [Taken(index, index / fps) for index in indices]


def _numbers(paths: Sequence[Path]) -> list[str]:
    """Return the last number of each name, if all have one and increase; else nothing."""
    found = [_NUMBER.search(path.stem) for path in paths]
    numbers = [match[1] for match in found if match is not None]
    values = [float(number) for number in numbers]
    increase = all(a < b for a, b in pairwise(values))
    return numbers if len(numbers) == len(paths) > 1 and increase else []


def _calendar_s(paths: Sequence[Path]) -> list[float] | None:
    """Return dates and times of day in names [s]; None if one has none or they do not increase.

    Without decimals several images have the same second: their names are no times.
    """
    found = [_CALENDAR.search(path.stem) for path in paths]
    times_s: list[float] = []
    for match in found:
        if match is None:
            return None
        *whole, decimals = match.groups()
        try:
            moment = datetime(*map(int, whole), tzinfo=UTC)  # type: ignore[misc, arg-type]
        except ValueError:  # no such day or hour
            return None
        times_s.append(moment.timestamp() + float(f"0.{decimals or 0}"))
    increase = all(a < b for a, b in pairwise(times_s))
    return times_s if len(times_s) > 1 and increase else None


def _clock_s(numbers: Sequence[str]) -> list[float] | None:
    """Return numbers as times [s]; None if they are not times."""
    whole = {len(number.split(".")[0]) for number in numbers}
    if len(whole) != 1:
        return None
    (digits,) = whole
    if digits == _SECONDS_DIGITS and all("." in number for number in numbers):
        return [float(number) for number in numbers]
    if digits in _CLOCKS and not any("." in number for number in numbers):
        return [int(number) * _CLOCKS[digits] for number in numbers]
    return None


def _indices(numbers: Sequence[str]) -> list[int] | None:
    """Return positions by numbers that count frames; None if they do not."""
    if not numbers or any("." in number for number in numbers):
        return None
    values = [int(number) for number in numbers]
    steps = sorted(b - a for a, b in pairwise(values))
    usual = steps[(len(steps) - 1) // 2]
    if any(step % usual for step in steps):
        return None
    indices = [(value - values[0]) // usual for value in values]
    return indices if len(indices) >= LEAST_THERE * (indices[-1] + 1) else None
