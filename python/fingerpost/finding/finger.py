"""A finger in one view: its detection, its finger line with a correction, and its motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerpost import pointing
from fingerpost._core import FingerLine, StartPose, Track

Array = NDArray[np.float64]

HALF_WIDTH = 0.115
"""Half-width of an average finger [visible lengths]."""

HALF_WIDTH_NAME = "half_width [px]"
"""The component of the band model's shape vector."""


class FingerDetection(NamedTuple):
    """A detected or followed finger of one view."""

    tip_px: tuple[float, float]
    angle_rad: float
    half_width_px: float
    score: float = 1.0
    """Finger score, 0 to 1."""
    foreground: float = np.nan
    """Foreground probability of its inside, 0 to 1; NaN without a background model."""
    colour: tuple[float, float, float] = (np.nan, np.nan, np.nan)
    """Mean colour of its inside; NaN if unknown."""
    length: float = np.nan
    """Visible length behind the tip [half-widths]; NaN if unknown."""


def followed(track: Track | None) -> list[FingerDetection]:
    """Return the finger that a view follows; empty without a finger line in this frame.

    The half-width is the fit's, or that of an average finger if the shape space has none.
    """
    line = track.finger_line if track is not None else None
    if track is None or line is None:
        return []
    half_width_px = fitted_half_width_px(track)
    if half_width_px is None:
        half_width_px = HALF_WIDTH * 2.0 * math.dist(line.tip_px, line.anchor_px)
    return [FingerDetection(line.tip_px, line.angle_rad, half_width_px)]


def fitted_half_width_px(track: Track | None) -> float | None:
    """Return the fitted half-width; None without a fit or a half-width in its shape space."""
    shape = track.shape_vector if track is not None else None
    if track is None or shape is None or HALF_WIDTH_NAME not in track.shape_names:
        return None
    return float(shape[track.shape_names.index(HALF_WIDTH_NAME)])


CONSISTENT_LOG_WIDTH_RATIO = 0.25
"""Greatest absolute logarithm of the ratio of a finger's widths in two views that needs no
explanation: a finger is not round, and blur widens it. Real fingers exceed it in 3 % of frames."""


def sigma_from_width_ratio(log_width_ratio: float) -> float:
    """Return the standard deviation of a finger's axis that differing widths in two views imply.

    At least one edge is then not the finger's, but that of a shadow beside it, of the thumb, of the
    table, or a crease of the skin. The axis is off by the error of the half-width.

    Parameters
    ----------
    log_width_ratio
        Logarithm of this view's width over the other's; see `fingerpost.finding.pairs.width_ratio`.

    Returns
    -------
    float
        [half-widths]
    """
    excess = max(abs(log_width_ratio) - CONSISTENT_LOG_WIDTH_RATIO, 0.0)
    return abs(1.0 - math.exp(-math.copysign(excess, log_width_ratio)))


class AxisCorrection(NamedTuple):
    """Systematic correction from the line between the visible edges to the finger's axis."""

    offset: float = 0.0
    """Offset of the axis, positive towards the normal (−sin, cos) [half-widths]."""
    turn_rad: float = 0.0
    """Angle of the axis to that line."""
    log_width_ratio: float = 0.0
    """Logarithm of the finger's width over the distance between those edges."""
    sigma: float = 0.0
    """Standard deviation of the corrected axis [half-widths]: of its offset, and, divided by half
    the length that the line was measured on, of its angle."""


NO_CORRECTION = AxisCorrection()
"""The axis is the line between the edges."""


def measured_line(
    track: Track | None, time_s: float, correction: AxisCorrection = NO_CORRECTION
) -> pointing.FingerLine | None:
    """Return the corrected finger line of a view; None if the frame has none.

    Parameters
    ----------
    track
        The tracker's result for a frame.
    time_s
        The frame's time [s].
    correction
        Correction of the measured line, in half-widths of the fit.
    """
    if track is None or track.finger_line is None:
        return None
    line, half_width_px = track.finger_line, fitted_half_width_px(track) or 0.0
    covariance = line.covariance
    if correction.sigma > 0.0:
        off_px = correction.sigma * half_width_px
        covariance = covariance + np.diag([off_px**2, (off_px / line.half_length_px) ** 2])
    anchor_px, tip_px, angle_rad = np.array(line.anchor_px), np.array(line.tip_px), line.angle_rad
    if correction.offset or correction.turn_rad:
        normal = np.array([-math.sin(angle_rad), math.cos(angle_rad)])
        anchor_px = anchor_px + correction.offset * half_width_px * normal
        angle_rad = math.remainder(angle_rad + correction.turn_rad, 2.0 * math.pi)
        ahead_px = math.dist(line.tip_px, line.anchor_px)
        tip_px = anchor_px + ahead_px * np.array([math.cos(angle_rad), math.sin(angle_rad)])
    return pointing.FingerLine(
        anchor_px,
        angle_rad,
        covariance,
        tip_px,
        time_s,
        line.half_length_px,
        half_width_px * math.exp(correction.log_width_ratio),
        line.stretch_px,
    )


def places_about(
    line: FingerLine, half_width_px: float, along: Array, across: Array
) -> NDArray[np.float64]:
    """Return a grid of places about a finger (A, B, 2) [px].

    Parameters
    ----------
    line, half_width_px
        The finger's axis, and half its width [px].
    along, across
        (A,) and (B,) Coordinates from the tip in the finger's direction, and along its normal
        (−sin, cos) [half-widths].
    """
    e = np.array([np.cos(line.angle_rad), np.sin(line.angle_rad)])
    n = np.array([-e[1], e[0]])
    places = along[:, None, None] * e + across[:, None] * n
    return np.asarray(line.tip_px + half_width_px * places)


def are_near(one: StartPose, other: StartPose, reach_px: float, turn_rad: float) -> bool:
    """Whether two poses have tips within `reach_px` and directions within `turn_rad`."""
    apart = np.hypot(*np.subtract(one.tip_px, other.tip_px))
    return bool(apart < reach_px and _turn_rad(one.angle_rad, other.angle_rad) < turn_rad)


def _turn_rad(one_rad: float, other_rad: float) -> float:
    """Return the angle between two directions, 0 to π."""
    return abs(math.remainder(one_rad - other_rad, 2.0 * math.pi))


DIRECTION_SIGMA_RAD = 0.5
DIRECTION_SIGMA_RATE_RAD_S = 2.0
"""Standard deviation of the change of direction since a finger was last seen: a constant part,
and its growth per second."""


class LastSeen(NamedTuple):
    """Direction of a finger in the last frame that showed it."""

    angle_rad: float
    """Pointing direction in the image."""
    time_s: float
    """Time of that frame [s]."""

    def direction_likelihood(self, angle_rad: float, time_s: float) -> float:
        """Return the likelihood of a direction at another time, relative to its maximum, 0 to 1."""
        sigma_rad = DIRECTION_SIGMA_RAD + DIRECTION_SIGMA_RATE_RAD_S * abs(time_s - self.time_s)
        return math.exp(-0.5 * (_turn_rad(angle_rad, self.angle_rad) / sigma_rad) ** 2)


PROVEN_MOTION = 2.0
"""Least motion that counts as a change of place [half-widths]."""


def has_moved(before: FingerLine, now: FingerLine) -> bool:
    """Whether the tip has moved by more than `PROVEN_MOTION`, which noise never reaches."""
    return _motion(before, now) > PROVEN_MOTION


def has_moved_across(before: FingerLine, now: FingerLine) -> bool:
    """Whether a finger has moved by more than `PROVEN_MOTION` perpendicular to its axis.

    An edge of the table never appears to do so. Motion along the axis proves nothing: a template
    slides along an edge (aperture problem), to the part of it that no hand covers.
    """
    across = np.array([-np.sin(before.angle_rad), np.cos(before.angle_rad)])
    across_px = [
        abs(across @ np.subtract(now.tip_px, before.tip_px)),
        abs(across @ np.subtract(now.anchor_px, before.anchor_px)),
    ]
    return bool(max(across_px) > PROVEN_MOTION * _half_width_px(before))


STILL = 0.3
LATELY = 3
"""A tip is static if it has moved by less than `STILL` half-widths in the last `LATELY` frames."""


def moves(lines: Sequence[FingerLine]) -> bool:
    """Whether the tip is moving at the end of a sequence of finger lines."""
    return _motion(lines[max(len(lines) - LATELY, 0)], lines[-1]) > STILL


KEPT_PLACE = 0.5
MOVED_ON = 3.0
"""A finger is static while another view's moves if its tip has stayed within `KEPT_PLACE`
half-widths and the other's has moved by more than `MOVED_ON`. In the recordings, no real fingertip
does so in 8 consecutive frames."""


def is_left_behind(lines: Sequence[FingerLine], others: Sequence[FingerLine]) -> bool:
    """Whether a finger is static in one view while it moves in another.

    Parameters
    ----------
    lines, others
        Finger lines of the view and of the other one in their latest frames, oldest first.
    """
    has_kept = all(_motion(lines[0], line) < KEPT_PLACE for line in lines)
    return has_kept and _motion(others[0], others[-1]) > MOVED_ON


def _motion(before: FingerLine, now: FingerLine) -> float:
    """Return the motion of the tip [half-widths of an average finger of the line's length]."""
    return math.dist(now.tip_px, before.tip_px) / _half_width_px(before)


def _half_width_px(line: FingerLine) -> float:
    """Return the half-width of an average finger of the line's length."""
    return HALF_WIDTH * 2.0 * math.dist(line.tip_px, line.anchor_px)


def hand_region(line: FingerLine) -> tuple[Array, Array, float]:
    """Return the image region of a finger and its hand: end points of a segment, and a radius."""
    tip, anchor = np.array(line.tip_px), np.array(line.anchor_px)
    # The anchor is about the finger's midpoint; hand and wrist are within three finger lengths.
    finger = 2.0 * (tip - anchor)
    return tip + 0.2 * finger, tip - 3.0 * finger, 0.8 * float(np.hypot(*finger))
