"""Correction of a followed finger's axis where one of its flanks is not visible.

A tracker measures the line midway between two edges. If one of them is not the finger's outline,
the axis lies beside that line. Two tests detect this: the blur asymmetry of the flanks, which gives
a standard deviation, and a fit of a round finger's shading, which gives the axis itself.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from fingerpost._core import FingerLine, RoundFinger, Track
from fingerpost.capture import Frame
from fingerpost.finding.finger import AxisCorrection, fitted_half_width_px
from fingerpost.finding.pixel_tests import blur_asymmetry

TEST_EVERY = 4
"""Interval between tested frames."""

ASYMMETRY_RATE = 0.5
"""Weight of a tested frame in the running mean of the blur asymmetry."""

ASYMMETRY_RANGE = (0.29, 0.35)
"""Root of the blur asymmetry [half-widths] below which both flanks are the finger's, and above
which one is not. Real and rendered fingers in the shade have mostly less than 0.2 and 0.28 at most.
A hand as bright as the table, whose edge is where it turns from the light and not its outline, has
0.3 to 0.38."""

MEDIAN_FRAMES = 5
"""Number of shading fits in the median: single ones are outliers."""

SPARSE_INTERVAL = 3
"""While no fit in the median has found an invisible flank, one tested frame in this many is
fitted."""

MIN_MISFIT_RATIO = 1.2
"""Least ratio of the misfit of a round finger about the line between the edges to that of the best
round finger, for which the latter counts. The ratio is up to 1.1 where both flanks are visible, and
1.3 to 8 where one is not."""

MIN_OFFSET = 0.15
MIN_LOG_WIDTH_RATIO = 0.1
"""Least offset of the axis [half-widths] and least logarithm of the ratio of widths for which a
flank counts as invisible. Below these the edges of both flanks are more accurate."""

MAX_SHADING_LOG_WIDTH_RATIO = 0.8
MAX_SHADING_TURN_RAD = 0.1
"""A fit that is wider or turned by more is not of the finger that is followed."""

MAX_HIDDEN_RATIO = 1.5
"""Greatest ratio of the hidden part of the width now to that at the time of the fit."""

OFFSET_SIGMA = 0.08
"""Standard deviation of the corrected axis [half-widths]. In films its error is mostly 0.03, up to
0.1, with 1 to 2 degrees of rotation."""


class ShadingFit(NamedTuple):
    """A fit of a round finger's shading, one of whose flanks is not visible."""

    offset_px: float
    """Offset of the axis from the line between the visible edges, positive towards the normal
    (−sin, cos) [px]."""
    turn_rad: float
    """Angle of the axis to that line."""
    half_width_px: float
    """Half the finger's width [px]."""
    shown_px: float
    """Half the distance between those edges [px]."""

    @classmethod
    def of(cls, frame: Frame, line: FingerLine, half_width_px: float) -> ShadingFit | None:
        """Fit the shading across a finger.

        Parameters
        ----------
        frame
            The frame; its colours are used if it has any.
        line, half_width_px
            The line between the visible edges, and half the distance between them [px].

        Returns
        -------
        ShadingFit or None
            None where both flanks are visible, so that the edges are more accurate.
        """
        finger = line.anchor_px, line.tip_px, half_width_px
        seen = RoundFinger.fit(frame.grey(), *finger, frame.colour())
        if seen is None or seen.misfit_about_given <= MIN_MISFIT_RATIO * seen.misfit:
            return None
        offset = seen.offset_px / half_width_px
        log_width_ratio = math.log(seen.half_width_px / half_width_px)
        if abs(offset) < MIN_OFFSET:
            return None
        if not MIN_LOG_WIDTH_RATIO <= log_width_ratio <= MAX_SHADING_LOG_WIDTH_RATIO:
            return None
        if abs(seen.turn_rad) > MAX_SHADING_TURN_RAD:
            return None
        return cls(seen.offset_px, seen.turn_rad, seen.half_width_px, half_width_px)

    def correction_from_edges(self, half_width_px: float) -> AxisCorrection:
        """Return the correction for a later line between edges `half_width_px` from it.

        It is scaled by the hidden part of the width. Once both flanks are visible, the edges are as
        far apart as the finger is wide, the line between them is its axis, and it is 0.
        """
        hidden = (self.half_width_px - half_width_px) / (self.half_width_px - self.shown_px)
        part = min(max(hidden, 0.0), MAX_HIDDEN_RATIO)
        return AxisCorrection(
            part * self.offset_px / half_width_px,
            part * self.turn_rad,
            math.log(self.half_width_px / half_width_px) if part > 0.0 else 0.0,
        )


class Flanks:
    """Estimate of a view's axis correction from its latest frames.

    An outline is as sharp as the image. If one flank is blurred where the other is sharp, it is not
    the outline (`blur_asymmetry`), and the axis may be off by as much as half the width. Where the
    shading across the finger gives its width (`fingerpost._core.RoundFinger`), the axis is known.
    """

    def __init__(self) -> None:
        self._frames = 0
        # Running mean of the signed blur asymmetry; None if unknown.
        self._asymmetry: float | None = None
        self._fits: deque[ShadingFit | None] = deque(maxlen=MEDIAN_FRAMES)
        self._half_width_px = 0.0
        # Median of the fits; None while most of them find both flanks visible.
        self._shading: ShadingFit | None = None
        self._spread_px = 0.0

    @property
    def axis_correction(self) -> AxisCorrection:
        """Correction from the line between the visible edges to the axis."""
        if self._shading is None:
            return AxisCorrection(sigma=sigma_from_blur_asymmetry(self._asymmetry or 0.0))
        sigma = math.hypot(OFFSET_SIGMA, self._spread_px / self._half_width_px)
        return self._shading.correction_from_edges(self._half_width_px)._replace(sigma=sigma)

    def update(self, frame: Frame, track: Track | None) -> None:
        """Test a frame, if it is one of those that are tested."""
        self._frames += 1
        line = track.finger_line if track is not None else None
        half_width_px = fitted_half_width_px(track)
        if line is None or half_width_px is None:
            return
        self._half_width_px = half_width_px
        tests, skipped = divmod(self._frames, TEST_EVERY)
        if not skipped or self._asymmetry is None:
            self._compare(blur_asymmetry(frame, line, half_width_px))
        is_rare = len(self._fits) == MEDIAN_FRAMES and not any(self._fits)
        if not self._fits or not (skipped or (is_rare and tests % SPARSE_INTERVAL)):
            self._fits.append(ShadingFit.of(frame, line, half_width_px))
            self._take_median()

    def _take_median(self) -> None:
        """Take the median of the fits, if most frames have one."""
        found = [fit for fit in self._fits if fit is not None]
        if 2 * len(found) <= len(self._fits):
            self._shading = None
            return
        fits = np.array(found)
        self._shading = ShadingFit(*np.median(fits, axis=0).tolist())
        off_px = np.abs(fits[:, 0] - self._shading.offset_px)
        self._spread_px = 1.4826 * float(np.median(off_px))

    def _compare(self, asymmetry: float) -> None:
        """Update the running mean of the blur asymmetry; NaN changes nothing."""
        if np.isfinite(asymmetry):
            before = asymmetry if self._asymmetry is None else self._asymmetry
            self._asymmetry = before + ASYMMETRY_RATE * (asymmetry - before)


def sigma_from_blur_asymmetry(asymmetry: float) -> float:
    """Return the standard deviation of a finger's axis that a blur asymmetry implies.

    Parameters
    ----------
    asymmetry
        See `fingerpost.finding.pixel_tests.blur_asymmetry` [half-widths²].

    Returns
    -------
    float
        [half-widths], 0 to 1: linear in the root of the asymmetry over `ASYMMETRY_RANGE`.
    """
    low, high = ASYMMETRY_RANGE
    return min(max((math.sqrt(abs(asymmetry)) - low) / (high - low), 0.0), 1.0)
