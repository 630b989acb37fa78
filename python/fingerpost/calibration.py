"""Calibration of an operator who points at known places in a known order.

The visit to a place is recognised by dwelling, by a key, or by given times. A hand dwells while its
points stay together; it is at the next place once it dwells elsewhere than at the last one.
"""

from __future__ import annotations

import csv
import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fingerpost.checks import in_range
from fingerpost.config import Rig
from fingerpost.errors import InvalidInputError
from fingerpost.habit import MIN_TARGETS, Habit
from fingerpost.selection import GRACE_S

STILL = 1 / 8
"""Largest standard distance of points from their mean that counts as a dwell [share of the least
distance between consecutive places]; a hand on its way between places is faster."""

ELSEWHERE = 1 / 2
"""Least motion of the points from the last place to the next one [share of the way]."""

MIN_FIXES = 3
"""Least number of fixes for a visit."""

_COLUMNS = ("target", "begin_s", "end_s")


@dataclass(frozen=True, eq=False, slots=True)
class Place:
    """A known place to point at: its name and its centre (2,) [plane units]."""

    name: str
    point: NDArray[np.float64]


@dataclass(frozen=True, eq=False, slots=True)
class Visit:
    """A place, and the point (2,) that was indicated for it [plane units]."""

    place: Place
    point: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Stay:
    """Period in which a place was pointed at: its name, begin and end [s]."""

    target: str
    begin_s: float
    end_s: float


def places_of(rig: Rig) -> list[Place]:
    """Return the centres of a rig's targets, in their order, without the places to rest at."""
    return [
        Place(target.name, target.corners.mean(axis=0)) for target in rig.things if not target.rest
    ]


def places_in(text: str) -> list[Place]:
    """Return the places given as "x,y; x,y; ...", named by their number.

    Raises
    ------
    InvalidInputError
        An entry that is not a pair of numbers.
    """
    places = []
    for number, entry in enumerate(filter(str.strip, text.split(";")), 1):
        try:
            x, y = (in_range(float(part), "", -1e300, 1e300) for part in entry.split(","))
        except ValueError as error:
            raise InvalidInputError(
                f'{entry.strip()!r} is no place; "x,y; x,y" in plane units is right'
            ) from error
        places.append(Place(str(number), np.array([x, y])))
    return places


class Calibration:
    """Collects the points that an operator indicates, and detects the visit to each place.

    Parameters
    ----------
    places
        In the order in which they are pointed at, `MIN_TARGETS` or more.
    dwell_s
        Time to dwell on each [s].

    Raises
    ------
    InvalidInputError
        Too few places, two equal ones in succession, or `dwell_s` out of range.
    """

    def __init__(self, places: Sequence[Place], dwell_s: float) -> None:
        refuse_too_few(places)
        self._dwell_s = in_range(dwell_s, "dwell_s", 0.1, 60.0)
        ways = [math.dist(a.point, b.point) for a, b in pairwise(places)]
        if not min(ways) > 0.0:
            after = places[ways.index(0.0)].name
            raise InvalidInputError(f"the place after {after!r} is the same one; another is right")
        self._places = tuple(places)
        self._still = STILL * min(ways)
        self._elsewhere = [ELSEWHERE * way for way in ways]
        self._latest: deque[tuple[float, NDArray[np.float64]]] = deque()
        self.visits: list[Visit] = []

    @property
    def next(self) -> Place | None:
        """The place to point at now; None after the last one."""
        return self._places[len(self.visits)] if len(self.visits) < len(self._places) else None

    @property
    def stayed(self) -> float:
        """Fraction of the dwell time that the hand has spent at the next place, 0 to 1."""
        if not self._latest or self.next is None:
            return 0.0
        now_s, here = self._latest[-1]
        if not self._is_elsewhere(here[None]):
            return 0.0
        since_s = now_s
        for time_s, point in reversed(self._latest):
            if math.dist(point, here) > 2.0 * self._still:
                break
            since_s = time_s
        return min((now_s - since_s) / self._dwell_s, 1.0)

    def take(self, time_s: float, point: NDArray[np.float64] | None) -> Visit | None:
        """Add the time and point of a fix; return the visit that it completes."""
        if point is None:
            return None
        if self._latest and time_s - self._latest[-1][0] > GRACE_S:
            self._latest.clear()
        self._latest.append((time_s, point))
        # The oldest point stays while those after it span less than the dwell time.
        while len(self._latest) > 1 and time_s - self._latest[1][0] >= self._dwell_s:
            self._latest.popleft()
        if time_s - self._latest[0][0] < self._dwell_s:
            return None
        points = np.array([point for _, point in self._latest])
        is_still = float(np.mean(np.var(points, axis=0))) * 2.0 <= self._still**2
        # The first half of the dwell may contain the end of the way to the place.
        settled = points[len(points) // 2 :]
        return self._visit(settled) if is_still and self._is_elsewhere(settled) else None

    def press(self) -> Visit | None:
        """Take the latest points as the visit to the next place; None if there are too few."""
        since_s = self._latest[-1][0] - GRACE_S if self._latest else 0.0
        return self._visit(np.array([point for time_s, point in self._latest if time_s >= since_s]))

    def _is_elsewhere(self, points: NDArray[np.float64]) -> bool:
        if not self.visits or self.next is None:
            return True
        moved = math.dist(np.median(points, axis=0), self.visits[-1].point)
        return moved > self._elsewhere[len(self.visits) - 1]

    def _visit(self, points: NDArray[np.float64]) -> Visit | None:
        if self.next is None or len(points) < MIN_FIXES:
            return None
        visit = Visit(self.next, np.median(points, axis=0))
        self.visits.append(visit)
        self._latest.clear()
        return visit


def refuse_too_few(places: Sequence[Place]) -> None:
    """Refuse too few places for the estimate of a habit.

    Raises
    ------
    InvalidInputError
    """
    if len({tuple(place.point.tolist()) for place in places}) < MIN_TARGETS:
        raise InvalidInputError(
            f"{len(places)} places to point at; {MIN_TARGETS} different ones or more are needed, "
            'as [[target]] of the rig or as --targets "x,y; x,y; ..."'
        )


def read_stays(path: Path) -> list[Stay]:
    """Read the periods of pointing: a table with the columns target, begin_s and end_s.

    Raises
    ------
    InvalidInputError
        The file cannot be read, lacks a column, or has a row without valid times.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = csv.DictReader(file, restval="")
            missing = [name for name in _COLUMNS if name not in (rows.fieldnames or ())]
            if missing:
                raise InvalidInputError(
                    f"{path}: no column {', '.join(missing)}; {','.join(_COLUMNS)} is needed"
                )
            return [_stay(path, line, row) for line, row in enumerate(rows, 2)]
    except OSError as error:
        raise InvalidInputError(f"{path}: cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InvalidInputError(f"{path}: {error}; a table in UTF-8 is needed") from error


def _stay(path: Path, line: int, row: dict[str, str]) -> Stay:
    target, begin, end = (row[name].strip() for name in _COLUMNS)
    try:
        stay = Stay(target, float(begin), float(end))
    except ValueError as error:
        raise InvalidInputError(
            f"{path}: line {line}: begin_s is {begin!r} and end_s {end!r}; seconds are needed"
        ) from error
    if not -math.inf < stay.begin_s < stay.end_s < math.inf:
        raise InvalidInputError(f"{path}: line {line}: end_s is to be later than begin_s")
    return stay


def visits_of(
    places: Sequence[Place],
    stays: Sequence[Stay],
    fixes: Iterable[tuple[float, NDArray[np.float64] | None]],
) -> list[Visit]:
    """Return the points that were indicated for places.

    Parameters
    ----------
    places
        All of them.
    stays
        Periods in which each was pointed at.
    fixes
        Times and points of the whole session.

    Raises
    ------
    InvalidInputError
        A stay at an unknown place, or with too few fixes.
    """
    known = {place.name: place for place in places}
    for stay in stays:
        if stay.target not in known:
            raise InvalidInputError(
                f"there is no target {stay.target!r}; known: {', '.join(known)}"
            )
    seen = [(time_s, point) for time_s, point in fixes if point is not None]
    visits = []
    for stay in stays:
        points = [point for time_s, point in seen if stay.begin_s <= time_s <= stay.end_s]
        if len(points) < MIN_FIXES:
            raise InvalidInputError(
                f"target {stay.target!r}: {len(points)} fixes from {stay.begin_s:g} to "
                f"{stay.end_s:g} s; {MIN_FIXES} with a point are needed"
            )
        visits.append(Visit(known[stay.target], np.median(points, axis=0)))
    return visits


def habit_of(visits: Sequence[Visit]) -> Habit:
    """Estimate an operator's habit from visits.

    Raises
    ------
    InvalidInputError
        As `Habit.of`.
    """
    return Habit.of(
        np.array([visit.place.point for visit in visits]).reshape(-1, 2),
        np.array([visit.point for visit in visits]).reshape(-1, 2),
    )
