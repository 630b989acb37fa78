"""From fixes to events: a hand enters a target, leaves it, and selects it.

A target is selected by dwelling on it, or by a key. Two rules prevent unintended selections (the
Midas touch problem): a selected target is not selected again by continued dwelling; and if the rig
has a place to rest at, the hand must have been there before each selection by dwelling.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import StrEnum

from fingerpost.checks import in_range
from fingerpost.pointing import Fix
from fingerpost.targets import Targets

DEFAULT_DWELL_S = 1.0
"""Time to dwell on a target until it is selected [s]."""

ENTERED, KEPT = 0.5, 0.25
"""Probabilities above which a target is entered and below which it is left: the hysteresis prevents
repeated events at its border."""

GRACE_S = 0.3
"""Longest time without a point, as behind another hand, that does not leave a target [s]."""


class EventKind(StrEnum):
    """Kind of an event."""

    ENTER = "enter"
    LEAVE = "leave"
    SELECT = "select"


@dataclass(frozen=True, slots=True)
class Event:
    """A change of a hand's relation to a target.

    Attributes
    ----------
    time_s
        Time of the fix that causes it [s].
    event
        Kind of the event.
    target
        The target's name.
    probability
        Probability that the target is pointed at.
    by
        Means of selection, "dwell" or "key"; else empty.
    """

    time_s: float
    event: EventKind
    target: str
    probability: float
    by: str = ""

    def as_dict(self) -> dict[str, object]:
        """Return the event for JSON."""
        return asdict(self)


class Selector:
    """Derives events from fixes.

    Parameters
    ----------
    targets
        Targets of the rig.
    dwell_s
        Time to dwell on a target until it is selected [s], above 0; None selects by key alone.

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
        """Process the next fix; return its events in order."""
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
        """Select the current target by key; does nothing without one, or at a place to rest at."""
        return self._select(time_s, "key")

    def _at(self, fix: Fix) -> str | None:
        """Return the target that the hand is at, from a fix and the current target."""
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
            # Without a place to rest at, every newly entered target may be selected.
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
