"""A template as long as the finger that a trial has found.

A short template is easier to find; a long one tells the direction better, and cannot hold on to one
shaded flank, as long as it does not reach into the fist.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fingerpost._core import Background, ContourTracker, FingerLine, StartPose, Track
from fingerpost.capture import Frame
from fingerpost.finding.finger import are_near, fitted_half_width_px

TemplateAt = Callable[[StartPose, float], ContourTracker]
"""Makes a tracker that follows a finger from a pose on, of half a width [px]."""

LENGTHS = (10.5, 9.0, 8.0, 7.0, 6.0, 5.0)
"""Templates that may follow a found finger, in its fitted half-widths, the longest first: an
index finger is hardly longer from knuckle to tip."""

LONG = 7.0
"""What a found finger is followed by at least, in half-widths, unless a longer template than what
follows already is seen whole: a stub may have taken one flank for another's."""

SHORT = 5.5
SHORT_FRAMES = {True: 2, False: 6}
"""If so many frames have shown no more of a finger that other views show as well, the rest is
hidden, or something lies along it: then it may be as short as this [half-widths]. Fewer are enough
(True) where another view follows it already, but one is not, or a disc that covers a fingertip is
taken for a finger; with half as many elsewhere, the points of one film were 22 mm off instead of
12."""

AS_LONG = 0.9
"""A template is as long as another one if it is as long as this part of that: one that has found a
hand again need be no longer than the one that had followed it."""

LONGER = 1.1
"""One that is not longer by this factor than what follows already is not worth a change."""

SURER = 0.5
"""A longer template whose direction has at most this part of the variance takes over at once: what
follows already does not follow well beside it."""

LOOKS = 3
"""How often each of them looks at the frame: its colours, known from the first look, bring out
flanks that grey hides, and with them the width."""

SAME_TURN_RAD = 0.2
"""It leads nowhere else: a template turned by more has taken other edges for the finger's."""

AS_WIDE = 0.8, 1.6
"""Nor is the finger so many times as wide as it was: of 101 longer templates on 30 films it is 0.92
to 1.23 times as wide, up to 1.42 where the shorter one had followed half of it, and 0.63 to 0.79
times in four that had taken a fold, a shadow or one lit half for it. A fist is twice as wide."""


class Lengthening:
    """Has a finger that was found followed by a template as long as it.

    A frame may hide what another shows: a longer template is looked for in every frame until one is
    as long as a finger, and then at ever longer intervals until none may be longer.

    Parameters
    ----------
    template_at
        Makes a tracker that follows a finger from a pose on, of half a width [px].
    half_width_px
        Half the width that the finger was found with.
    known_length
        How long the template was that followed the finger before it was lost [half-widths], if it
        was.
    """

    def __init__(
        self, template_at: TemplateAt, half_width_px: float, known_length: float | None = None
    ) -> None:
        self.is_long = False
        """Whether the template is as long as a finger."""
        self._long = LONG if known_length is None else min(LONG, AS_LONG * known_length)
        self._template_at = template_at
        self._half_width_px = half_width_px
        self._longer: ContourTracker | None = None
        self._is_longest = False
        self._short_frames = 0
        self._frames, self._interval = 0, 1

    def look(
        self,
        tracker: ContourTracker,
        track: Track,
        frame: Frame,
        background: Background | None = None,
        *,
        is_likely: bool = False,
        is_followed: bool = False,
    ) -> tuple[ContourTracker, Track]:
        """Return a longer template that this frame shows all of, or else what follows already.

        What follows well gives way to what has followed for a frame, too; what does not, at once.

        Parameters
        ----------
        tracker, track
            What follows the finger, and what it made of this frame.
        frame
            The frame.
        background
            What is behind the hand, if that is known.
        is_likely
            Whether it is a finger by all that other views show, so that it may be short.
        is_followed
            Whether another view follows it already, and not merely tries it; then it is likely.
        """
        longer, self._longer = self._longer, None
        line = track.finger_line
        if line is None:
            return tracker, track
        if longer is not None:
            seen = longer.update(frame.grey(), frame.time_s, frame.colour(), background=background)
            return (longer, seen) if self._is_same(line, seen) else (tracker, track)
        self._frames += 1
        if self._is_longest or self._frames < self._interval:
            return tracker, track
        longest = self._longest(tracker, track, line, frame)
        self._frames, self._interval = 0, 2 * self._interval if longest is None else 1
        if not self.is_long:
            length = length_px(tracker, line) / self._half_width_px
            self._short_frames += 1
            has_waited = self._short_frames > SHORT_FRAMES[is_followed]
            is_all = has_waited and (is_likely or is_followed)
            least = min(self._long, SHORT) if is_all else self._long
            self.is_long, self._interval = length >= least or longest is not None, 1
            return longest or (tracker, track)
        if longest is not None and _is_surer(longest[1], line):
            return longest
        self._longer = longest[0] if longest is not None else None
        return tracker, track

    def _longest(
        self, tracker: ContourTracker, track: Track, line: FingerLine, frame: Frame
    ) -> tuple[ContourTracker, Track] | None:
        """Return the longest template that a frame shows all of; None unless it is longer."""
        self._half_width_px = fitted_half_width_px(track) or self._half_width_px
        # The width may be another by now: a short template lies near the tip, where it is slim.
        least = LONGER * length_px(tracker, line) / self._half_width_px
        lengths = [length for length in LENGTHS if length > least]
        self._is_longest = not lengths
        for length in lengths:
            start = StartPose(line.tip_px, line.angle_rad, length * self._half_width_px)
            longer = self._template_at(start, self._half_width_px)
            for _ in range(LOOKS):
                seen = longer.update(frame.grey(), frame.time_s, frame.colour())
            found = seen.finger_line
            if found is None or _far_ends_seen(longer, found) < FAR_END_SEEN:
                continue
            if self._is_same(line, seen):
                return longer, seen
        return None

    def _is_same(self, line: FingerLine, seen: Track) -> bool:
        """Tell whether another template follows the same finger."""
        other = seen.finger_line
        if other is None:
            return False
        half_width_px = fitted_half_width_px(seen) or self._half_width_px
        narrowest, widest = AS_WIDE
        if not narrowest <= half_width_px / self._half_width_px <= widest:
            return False
        here, there = (
            StartPose(one.tip_px, one.angle_rad, self._half_width_px) for one in (line, other)
        )
        return are_near(here, there, 2.0 * self._half_width_px, SAME_TURN_RAD)


def _is_surer(longer: Track, line: FingerLine) -> bool:
    """Tell whether a longer template knows the direction much better than the line does."""
    other = longer.finger_line
    return other is not None and bool(other.covariance[1, 1] <= SURER * line.covariance[1, 1])


SEEN_PART = 0.85
"""The part of a template's length that its outline covers; the rest is in the fist."""


def length_px(tracker: ContourTracker, line: FingerLine) -> float:
    """Return the length of the template that follows a finger."""
    ahead = np.array([np.cos(line.angle_rad), np.sin(line.angle_rad)])
    return float(np.ptp(tracker.contour() @ ahead)) / SEEN_PART


FAR_END = 0.3
FAR_END_SEEN = 0.95
"""A template is no longer than the finger if on either flank at least this part of the edges agrees
with the fit, over the given part of its length farthest from the tip. With a part of 0.7 it reached
as far as the knuckle, where a finger widens: on 38 rendered films the median error was 15.1 mm, not
14.0."""


def _far_ends_seen(tracker: ContourTracker, line: FingerLine) -> float:
    """Return the part of the edges far from the tip that agree with the fit, on the worse flank."""
    lines = tracker.search_lines()
    e = np.array([np.cos(line.angle_rad), np.sin(line.angle_rad)])
    along = (lines.position_px - line.tip_px) @ e
    is_far = along < (1.0 - FAR_END) * along.min()
    side = lines.normal @ np.array([-e[1], e[0]])
    agrees = np.zeros(len(lines), np.bool_) if lines.agrees is None else lines.agrees
    flanks = [agrees[is_far & (sign * side > 0.0)] for sign in (-1.0, 1.0)]
    return min(float(flank.mean()) if len(flank) else 0.0 for flank in flanks)
