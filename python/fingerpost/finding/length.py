"""A template as long as the finger that a trial has found.

A short template is easier to find; a long one tells the direction better, and cannot hold on to one
shaded flank, as long as it does not reach into the fist.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fingerpost._core import ContourTracker, FingerLine, StartPose, Track
from fingerpost.capture import Frame
from fingerpost.finding.finger import are_near
from fingerpost.finding.trial import Trial

TemplateAt = Callable[[StartPose, float], ContourTracker]
"""Makes a tracker that follows a finger from a pose on, of half a width [px]."""

MEASURED = 2
"""How often the longest is looked for: a trial's template lies near the tip, where a finger is
slim, and tells too small a width to begin with."""


def lengthen(trial: Trial, line: FingerLine, frame: Frame, template_at: TemplateAt) -> None:
    """Follow with the longest template that this frame shows all of, if there is one."""
    half_width_px = trial.half_width_px
    for _ in range(MEASURED):
        longest = _longest(line, half_width_px, frame, template_at)
        if longest is None:
            return
        trial.tracker, trial.track = longest
        trial.is_lengthened = True
        half_width_px = trial.half_width_px


LENGTHS = (10.5, 9.0, 8.0, 7.0, 6.0, 5.0)
"""Templates that may follow a found finger, in its fitted half-widths, the longest first: an
index finger is hardly longer from knuckle to tip."""

LOOKS = 3
"""How often each of them looks at the frame: its colours, known from the first look, bring out
flanks that grey hides, and with them the width."""

SAME_TURN_RAD = 0.2
"""It leads nowhere else: a template turned by more has taken other edges for the finger's."""


def _longest(
    line: FingerLine, half_width_px: float, frame: Frame, template_at: TemplateAt
) -> tuple[ContourTracker, Track] | None:
    """Return the longest template on a finger of a width that the frame shows all of."""
    here = StartPose(line.tip_px, line.angle_rad, half_width_px)
    for length in LENGTHS:
        start = StartPose(line.tip_px, line.angle_rad, length * half_width_px)
        tracker = template_at(start, half_width_px)
        for _ in range(LOOKS):
            track = tracker.update(frame.grey(), frame.time_s, frame.colour())
        found = track.finger_line
        if found is None or _far_ends_seen(tracker, found) < FAR_END_SEEN:
            continue
        there = StartPose(found.tip_px, found.angle_rad, half_width_px)
        if are_near(here, there, 2.0 * half_width_px, SAME_TURN_RAD):
            return tracker, track
    return None


FAR_END = 0.3
FAR_END_SEEN = 0.7
"""A template is no longer than the finger if on either flank at least this part of the edges agrees
with the fit, over the given part of its length farthest from the tip."""


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
