"""Status line of a live run."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable
from typing import TYPE_CHECKING

from fingerpost.cli.progress import StatusLine, cell_count

if TYPE_CHECKING:
    from fingerpost.pipeline import Step

_SHOWN_EVERY_S = 0.1  # faster than people read, slower than terminals draw
_RATE_OVER_S = 2.0
_BRIEF_S = 1.0  # a text that is shown for less cannot be read
_STATE_COLUMNS = len("acquiring")  # the longest state, so that the next column keeps its place
_GAP = "   "


class LiveStatus:
    """State of every view, the last point and the rate, in one line that is updated.

    Parameters
    ----------
    line
        Line of the terminal.
    unit
        Name of the plane's unit.
    plane_size
        Side of the working plane, in its unit.
    clock
        Returns the time in seconds.
    """

    def __init__(
        self, line: StatusLine, *, unit: str, plane_size: float, clock: Callable[[], float]
    ) -> None:
        self._line = line
        self._unit = unit
        self._plane_size = plane_size
        self._clock = clock
        self._steps_s: deque[float] = deque()
        self._shown_s = -math.inf
        self._point = ""
        self._point_s = -math.inf

    def take(self, step: Step) -> None:
        """Add a step, and show it unless the last one was shown just before."""
        now_s = self._clock()
        self._steps_s.append(now_s)
        while now_s - self._steps_s[0] > _RATE_OVER_S:
            self._steps_s.popleft()
        fix = step.fix
        if fix.point is not None and fix.covariance is not None:
            from fingerpost.recording.picture import point_in_numbers

            self._point_s = now_s
            self._point = point_in_numbers(
                fix.point, fix.covariance, unit=self._unit, plane_size=self._plane_size
            )
        if now_s - self._shown_s >= _SHOWN_EVERY_S:
            self._shown_s = now_s
            self._line.show(self._words(step, now_s))

    def _words(self, step: Step, now_s: float) -> str:
        """Return the line: states and point at the left, the rate at the right."""
        columns = self._line.columns
        states, said = _states(step), self._said(step, now_s)
        each = _GAP.join(f"{name} {state:<{_STATE_COLUMNS}}" for name, state in states)
        if cell_count(each) + len(_GAP) + cell_count(said) > columns:
            counts = Counter(state for _, state in states)
            each = ", ".join(f"{count} {state}" for state, count in counts.items())
        left, right = f"{each}{_GAP}{said}", self._rate()
        room = columns - cell_count(left) - len(right)
        return f"{left}{' ' * room}{right}" if right and room >= len(_GAP) else left

    def _said(self, step: Step, now_s: float) -> str:
        """Return the point, else the reason, or the last point if the states explain its lack."""
        if step.fix.point is not None:
            return self._point
        age_s = now_s - self._point_s
        is_explained = any(state != "tracking" for _, state in _states(step))
        if self._point and (is_explained or age_s < _BRIEF_S):
            return f"{self._point}, {_age(age_s)} ago"
        since = f"no point for {_age(age_s)}" if self._point else "no point yet"
        return since if is_explained else f"{since}: {step.fix.reason}"

    def _rate(self) -> str:
        """Return the rate of the last seconds, if known."""
        lasted_s = self._steps_s[-1] - self._steps_s[0]
        return f"{(len(self._steps_s) - 1) / lasted_s:.1f} fps" if lasted_s > 0.0 else ""


def _states(step: Step) -> list[tuple[str, str]]:
    """Return the name and state of every view."""
    from fingerpost.recording.picture import status_of

    return [
        (seen.view, "moved" if seen.is_adrift else status_of(seen)) for seen in step.observations
    ]


def _age(age_s: float) -> str:
    if age_s < 60.0:
        return f"{age_s:.0f} s" if age_s >= 1.0 else f"{age_s:.1f} s"
    return f"{age_s / 60.0:.0f} min" if age_s < 3600.0 else f"{age_s / 3600.0:.0f} h"
