"""Extension of a trial's template to the length of the finger.

A short template is easier to initialise. A long one has a smaller variance of direction and cannot
lock on to one shaded flank, as long as it does not reach into the fist.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fingerpost._core import Background, ContourTracker, FingerLine, StartPose, Track
from fingerpost.capture import Frame
from fingerpost.finding.finger import are_near, fitted_half_width_px

TrackerFactory = Callable[[StartPose, float], ContourTracker]
"""Makes a tracker from a start pose and a half-width [px]."""

TEMPLATE_LENGTHS = (10.5, 9.0, 8.0, 7.0, 6.0, 5.0)
"""Lengths of the templates that are tried, in fitted half-widths, longest first: an index finger is
hardly longer from knuckle to tip."""

MIN_LENGTH = 7.0
"""Least length of the template of a found finger [half-widths], unless a template longer than the
present one is visible in full: a shorter one may have locked on to a wrong flank."""

MIN_OCCLUDED_LENGTH = 5.5
OCCLUDED_FRAMES = {True: 2, False: 6}
"""Least length [half-widths] of a finger that other views support, if more than this number of
frames has shown no longer one: the rest is hidden, or an object lies along it. The number is
smaller (True) where another view follows the finger already, but 1 would accept a disc that covers
a fingertip. With half the number otherwise (False), the points of one film were off by 22 mm
instead of 12."""

MIN_REACQUIRED_RATIO = 0.9
"""Least ratio of the length of a template that has found a hand again to that of the one that had
followed it."""

MIN_EXTENSION_RATIO = 1.1
"""Least ratio of the length of a longer template to that of the present one."""

MAX_VARIANCE_RATIO = 0.5
"""Greatest ratio of the variance of direction of a longer template to that of the present one for
which the longer one replaces it at once: the present one fits badly."""

UPDATES_PER_TEMPLATE = 3
"""Updates of each template with one frame: its colour model, learned by the first one, makes flanks
visible that have no grey contrast, and so the width."""

MAX_TURN_RAD = 0.2
"""Greatest change of direction: a template turned by more has locked on to other edges."""

WIDTH_RATIO_RANGE = 0.8, 1.6
"""Range of the ratio of its width to that of the present one. For 101 longer templates on 30 films
it is 0.92 to 1.23, up to 1.42 where the shorter one had followed half of the finger, and 0.63 to
0.79 for four that had locked on to a fold, a shadow or the lit half. A fist has about 2."""


class TemplateExtension:
    """Replaces the template of a found finger by one as long as the finger.

    Occlusion differs from frame to frame: longer templates are tried in every frame until one is as
    long as a finger, and then at doubling intervals until none can be longer.

    Parameters
    ----------
    template_at
        Makes a tracker from a start pose and a half-width [px].
    half_width_px
        Half-width of the detection [px].
    known_length
        Length of the template that followed the finger before its loss [half-widths], if any.
    """

    def __init__(
        self, template_at: TrackerFactory, half_width_px: float, known_length: float | None = None
    ) -> None:
        self.is_long = False
        """Whether the template is as long as a finger."""
        self._long = (
            MIN_LENGTH
            if known_length is None
            else min(MIN_LENGTH, MIN_REACQUIRED_RATIO * known_length)
        )
        self._template_at = template_at
        self._half_width_px = half_width_px
        self._longer: ContourTracker | None = None
        self._is_longest = False
        self._short_frames = 0
        self._frames, self._interval = 0, 1

    def update(
        self,
        tracker: ContourTracker,
        track: Track,
        frame: Frame,
        background: Background | None = None,
        *,
        is_likely: bool = False,
        is_followed: bool = False,
    ) -> tuple[ContourTracker, Track]:
        """Return a longer template that this frame shows in full, or else the present one.

        One that fits well is replaced after the longer one has followed for another frame; one that
        does not, at once.

        Parameters
        ----------
        tracker, track
            The present tracker, and its result for this frame.
        frame
            The frame.
        background
            Background model, if known.
        is_likely
            Whether other views support it, so that it may be short.
        is_followed
            Whether another view follows it already, not merely as a trial; implies `is_likely`.
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
            has_waited = self._short_frames > OCCLUDED_FRAMES[is_followed]
            is_all = has_waited and (is_likely or is_followed)
            least = min(self._long, MIN_OCCLUDED_LENGTH) if is_all else self._long
            self.is_long, self._interval = length >= least or longest is not None, 1
            return longest or (tracker, track)
        if longest is not None and _has_smaller_variance(longest[1], line):
            return longest
        self._longer = longest[0] if longest is not None else None
        return tracker, track

    def _longest(
        self, tracker: ContourTracker, track: Track, line: FingerLine, frame: Frame
    ) -> tuple[ContourTracker, Track] | None:
        """Return the longest template that a frame shows in full; None unless it is longer."""
        self._half_width_px = fitted_half_width_px(track) or self._half_width_px
        # The width may have changed: a short template lies near the tip, where a finger is slim.
        least = MIN_EXTENSION_RATIO * length_px(tracker, line) / self._half_width_px
        lengths = [length for length in TEMPLATE_LENGTHS if length > least]
        self._is_longest = not lengths
        for length in lengths:
            start = StartPose(line.tip_px, line.angle_rad, length * self._half_width_px)
            longer = self._template_at(start, self._half_width_px)
            for _ in range(UPDATES_PER_TEMPLATE):
                seen = longer.update(frame.grey(), frame.time_s, frame.colour())
            found = seen.finger_line
            if found is None or _far_end_agreement(longer, found) < MIN_FAR_END_AGREEMENT:
                continue
            if self._is_same(line, seen):
                return longer, seen
        return None

    def _is_same(self, line: FingerLine, seen: Track) -> bool:
        """Whether another template follows the same finger."""
        other = seen.finger_line
        if other is None:
            return False
        half_width_px = fitted_half_width_px(seen) or self._half_width_px
        narrowest, widest = WIDTH_RATIO_RANGE
        if not narrowest <= half_width_px / self._half_width_px <= widest:
            return False
        here, there = (
            StartPose(one.tip_px, one.angle_rad, self._half_width_px) for one in (line, other)
        )
        return are_near(here, there, 2.0 * self._half_width_px, MAX_TURN_RAD)


def _has_smaller_variance(longer: Track, line: FingerLine) -> bool:
    """Whether a longer template has a much smaller variance of direction."""
    other = longer.finger_line
    return other is not None and bool(
        other.covariance[1, 1] <= MAX_VARIANCE_RATIO * line.covariance[1, 1]
    )


OUTLINE_LENGTH_RATIO = 0.85
"""Ratio of the length of a template's outline to its length; the rest is in the fist."""


def length_px(tracker: ContourTracker, line: FingerLine) -> float:
    """Return the length of a tracker's template [px]."""
    ahead = np.array([np.cos(line.angle_rad), np.sin(line.angle_rad)])
    return float(np.ptp(tracker.contour() @ ahead)) / OUTLINE_LENGTH_RATIO


FAR_END_PART = 0.3
MIN_FAR_END_AGREEMENT = 0.95
"""A template is no longer than the finger if at least `MIN_FAR_END_AGREEMENT` of the edges agree
with the fit on either flank, over the `FAR_END_PART` of its length farthest from the tip. With 0.7
it reached the knuckle, where a finger widens: on 38 rendered films the median error was 15.1 mm
instead of 14.0."""


def _far_end_agreement(tracker: ContourTracker, line: FingerLine) -> float:
    """Return the part of the far edges that agree with the fit, on the worse flank."""
    lines = tracker.search_lines()
    e = np.array([np.cos(line.angle_rad), np.sin(line.angle_rad)])
    along = (lines.position_px - line.tip_px) @ e
    is_far = along < (1.0 - FAR_END_PART) * along.min()
    side = lines.normal @ np.array([-e[1], e[0]])
    agrees = np.zeros(len(lines), np.bool_) if lines.agrees is None else lines.agrees
    flanks = [agrees[is_far & (sign * side > 0.0)] for sign in (-1.0, 1.0)]
    return min(float(flank.mean()) if len(flank) else 0.0 for flank in flanks)
