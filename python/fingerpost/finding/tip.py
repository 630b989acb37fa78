"""Test whether a finger extends beyond the tip of its contour: painted nails, covers, cut gloves.

A contour that ends at a change of the finger's appearance ends short of the fingertip. Fingers are
curved, so the axis of the rear part has another direction than that of the whole finger.
"""

from __future__ import annotations

import math

from fingerpost._core import Background, FingerLine
from fingerpost.capture import Frame
from fingerpost.finding.body import Body
from fingerpost.finding.foreground import MIN_FOREGROUND, foreground_ahead, places_ahead
from fingerpost.finding.pixel_tests import contrast_ahead

SHORT_SIGMA = 0.1
"""Standard deviation of the axis if the finger extends beyond its contour [half-widths]: 2 degrees
on half the length of a usual template. With dark nails, and with gloves that leave the fingertips
free, the axis is turned by 1.5 to 2.5 degrees in rendered films."""

MIN_CONTRAST = 3.0
"""Contrast ahead of the tip that proves an extension before an unknown background [standard
deviations]: at most 1.5 in 95 % of the frames of ordinary hands, 2 to 7 ahead of dark nails and
cut gloves."""

MEAN_RATE = 0.2
"""Least weight of a frame in the running mean, which begins with the first frame."""


class TipTest:
    """Running mean of the evidence for a finger ahead of the tip.

    Foreground where the background is known, contrast where not.
    """

    def __init__(self) -> None:
        self._ahead, self._frames = 0.0, 0

    @property
    def sigma(self) -> float:
        """Standard deviation of the axis [half-widths], 0 if the finger ends at the contour."""
        return SHORT_SIGMA if self._ahead >= MIN_FOREGROUND else 0.0

    def update(
        self,
        background: Background,
        frame: Frame,
        line: FingerLine,
        half_width_px: float,
        body: Body,
    ) -> None:
        """Test a frame; one without evidence changes nothing.

        There is none where a moving body of the system is ahead of the tip, or covers it: that is
        foreground, but no finger.
        """
        ahead_px = places_ahead(line, half_width_px)
        if body.covers(ahead_px).any():
            return
        ahead = foreground_ahead(background, frame, ahead_px)
        if not math.isfinite(ahead):  # the background is unknown
            ahead = min(contrast_ahead(frame, line, half_width_px) / MIN_CONTRAST, 1.0)
        if math.isfinite(ahead):
            self._frames += 1
            rate = max(MEAN_RATE, 1.0 / self._frames)
            self._ahead += rate * (ahead - self._ahead)
