"""From fixes to events: a hand comes to a target, leaves it, and selects it.

A target is selected by staying on it, or by a key. That whatever is passed over is selected as
well, the Midas touch, is kept off in two ways: a target that has been selected is not selected
again by staying on; and where the rig has a place to rest at, each selection by staying needs the
hand to have come from there.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import StrEnum

from fingerpost.checks import in_range
from fingerpost.pointing import Fix
from fingerpost.targets import Targets

DEFAULT_DWELL_S = 1.0
"""How long a hand stays on what it selects [s]."""

ENTERED, KEPT = 0.5, 0.25
"""A target is come to with more than the first probability, and left with less than the second: at
its border it is not come to and left all the time."""

GRACE_S = 0.3
"""So long without a point, as behind another hand, is no leaving [s]."""


class EventKind(StrEnum):
    """What has happened."""

    ENTER = "enter"
    LEAVE = "leave"
    SELECT = "select"


@dataclass(frozen=True, slots=True)
class Event:
    """Something that a hand has done with a target.

    Attributes
    ----------
    time_s
        Of the fix that shows it [s].
    event
        What.
    target
        The target's name.
    probability
        That it is pointed at.
    by
        What has selected it, "dwell" or "key"; else empty.
    """

    time_s: float
    event: EventKind
    target: str
    probability: float
    by: str = ""

    def as_dict(self) -> dict[str, object]:
        """Return it as it is written."""
        return asdict(self)


class Selector:
    """Makes events of fixes.

    Parameters
    ----------
    targets
        Those of the rig.
    dwell_s
        How long a hand stays on what it selects [s], above 0; None selects by key alone.

    Raises
    ------
    InvalidInputError
        `dwell_s` is out of range.
    """

    def __init__(self, targets: Targets, *, dwell_s: float | None = DEFAULT_DWELL_S) -> None:
        if dwell_s is not None:
            in_range(dwell_s, "dwell_s", 1e-3, 3600.0)
        self._dwell_s = dwell_s
        self._rests = {target.name for target in targets if target.rest}
        self._current: str | None = None
        self._probability = 0.0
        self._since_s = self._seen_s = 0.0
        self._is_armed = not self._rests

    @property
    def current(self) -> str | None:
        """The target that the hand is at."""
        return self._current

    def update(self, fix: Fix) -> list[Event]:
        """Take the next fix; return what has happened with it, in its order."""
        events: list[Event] = []
        if fix.point is not None:
            self._seen_s = fix.time_s
            events += self._move(fix.time_s, self._at(fix), fix)
        elif fix.time_s - self._seen_s > GRACE_S:
            events += self._move(fix.time_s, None, fix)
        has_stayed = self._dwell_s is not None and fix.time_s - self._since_s >= self._dwell_s
        if fix.point is not None and has_stayed and self._is_armed:
            events += self._select(fix.time_s, "dwell")
        return events

    def press(self, time_s: float) -> list[Event]:
        """Select what the hand is at, as the key was pressed; nothing at none or at rest."""
        return self._select(time_s, "key")

    def _at(self, fix: Fix) -> str | None:
        """Tell where the hand is by a fix, and where it was."""
        best = fix.target
        if best is not None and fix.targets[best] > ENTERED:
            return best
        return self._current if fix.targets.get(self._current, 0.0) >= KEPT else None

    def _move(self, time_s: float, to: str | None, fix: Fix) -> list[Event]:
        before, self._current = self._current, to
        events = []
        if to != before:
            self._since_s = time_s
            if before is not None:
                events.append(Event(time_s, EventKind.LEAVE, before, self._probability))
            # Where there is no place to rest at, whatever is come to anew may be selected.
            self._is_armed = (self._is_armed or to in self._rests) if self._rests else True
        self._probability = fix.targets.get(to, 0.0)
        if to is not None and to != before:
            events.append(Event(time_s, EventKind.ENTER, to, self._probability))
        return events

    def _select(self, time_s: float, by: str) -> list[Event]:
        if self._current is None or self._current in self._rests:
            return []
        self._is_armed = False
        return [Event(time_s, EventKind.SELECT, self._current, self._probability, by)]
