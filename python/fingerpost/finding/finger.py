"""A finger in one view: what is seen of it, where it is, and whether it has moved."""

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
"""Half the width of the usual finger, in visible lengths."""

HALF_WIDTH_NAME = "half_width [px]"
"""The component of the band model's shape vector."""


class Sighting(NamedTuple):
    """A finger that a view may be showing."""

    tip_px: tuple[float, float]
    angle_rad: float
    half_width_px: float
    score: float = 1.0
    """How like a finger it is, 0 to 1."""
    foreground: float = np.nan
    """How like foreground it is, 0 to 1; NaN where no background is known."""
    colour: tuple[float, float, float] = (np.nan, np.nan, np.nan)
    """Mean colour of its inside; NaN where that is not known."""
    length: float = np.nan
    """How far back from its tip it is seen [half-widths]; NaN where that is not known."""


def followed(track: Track | None) -> list[Sighting]:
    """Return the finger that a view follows, if it shows in this frame.

    It is as wide as the fit has it, or as a usual finger where the fit has no width.
    """
    line = track.finger_line if track is not None else None
    if track is None or line is None:
        return []
    half_width_px = fitted_half_width_px(track)
    if half_width_px is None:
        half_width_px = HALF_WIDTH * 2.0 * math.dist(line.tip_px, line.anchor_px)
    return [Sighting(line.tip_px, line.angle_rad, half_width_px)]


def fitted_half_width_px(track: Track) -> float | None:
    """Return half a finger's width; None without a fit in a shape space that has one."""
    shape = track.shape_vector
    if shape is None or HALF_WIDTH_NAME not in track.shape_names:
        return None
    return float(shape[track.shape_names.index(HALF_WIDTH_NAME)])


LIKE_WIDTH = 0.25
"""By what logarithm a finger's width may differ from view to view: a finger is not round, and a
blurred one looks wider. A real finger's differs by more in 3 frames of 100."""


def off_by_width(odd_width: float) -> float:
    """Return how far a finger's axis may be off if another view shows the finger unlike wide.

    One flank at least is not the finger's then, but that of a shadow beside it, of the thumb, of
    the table, or a crease of the skin. The axis is off by as much as half the width is.

    Parameters
    ----------
    odd_width
        Logarithm of how many times as wide the finger is here; see
        `fingerpost.finding.pairs.width_ratio`.

    Returns
    -------
    float
        [half-widths]
    """
    unlike = math.copysign(max(abs(odd_width) - LIKE_WIDTH, 0.0), odd_width)
    return abs(1.0 - math.exp(-unlike))


class Aside(NamedTuple):
    """How a finger's axis lies to the line between the edges that show, for what is no noise."""

    offset: float = 0.0
    """How far it runs beside that line, to the side of the normal (−sin, cos) [half-widths]."""
    turn_rad: float = 0.0
    """By how much it is turned against that line."""
    wider: float = 0.0
    """Logarithm of how many times as wide as between those edges the finger is."""
    off: float = 0.0
    """How far it may still be off [half-widths]: aside by that, and turned by that over half the
    length that the line was measured on."""


BETWEEN_EDGES = Aside()
"""The axis is the line between the edges."""


def measured_line(
    track: Track | None, time_s: float, aside: Aside = BETWEEN_EDGES
) -> pointing.FingerLine | None:
    """Return the line of the finger that a view follows, to point with; None if it shows none.

    Parameters
    ----------
    track
        What the tracker made of a frame.
    time_s
        The frame's time [s].
    aside
        How the axis lies to the line that was measured. Half-widths are those of the fit.
    """
    if track is None or track.finger_line is None:
        return None
    line, half_width_px = track.finger_line, fitted_half_width_px(track) or 0.0
    covariance = line.covariance
    if aside.off > 0.0:
        off_px = aside.off * half_width_px
        covariance = covariance + np.diag([off_px**2, (off_px / line.half_length_px) ** 2])
    anchor_px, tip_px, angle_rad = np.array(line.anchor_px), np.array(line.tip_px), line.angle_rad
    if aside.offset or aside.turn_rad:
        normal = np.array([-math.sin(angle_rad), math.cos(angle_rad)])
        anchor_px = anchor_px + aside.offset * half_width_px * normal
        angle_rad = math.remainder(angle_rad + aside.turn_rad, 2.0 * math.pi)
        ahead_px = math.dist(line.tip_px, line.anchor_px)
        tip_px = anchor_px + ahead_px * np.array([math.cos(angle_rad), math.sin(angle_rad)])
    return pointing.FingerLine(
        anchor_px,
        angle_rad,
        covariance,
        tip_px,
        time_s,
        line.half_length_px,
        half_width_px * math.exp(aside.wider),
        line.stretch_px,
    )


def are_near(one: StartPose, other: StartPose, reach_px: float, turn_rad: float) -> bool:
    """Tell whether two poses have about the same tip and direction."""
    apart = np.hypot(*np.subtract(one.tip_px, other.tip_px))
    return bool(apart < reach_px and _turn_rad(one.angle_rad, other.angle_rad) < turn_rad)


def _turn_rad(one_rad: float, other_rad: float) -> float:
    """Return the angle between two directions, 0 to π."""
    return abs((one_rad - other_rad + math.pi) % (2 * math.pi) - math.pi)


TURN_RAD = 0.5
TURN_RATE_RAD_S = 2.0
"""By how much a finger may lead elsewhere than when it was last seen, and by how much more for
every second since, as a standard deviation."""


class LastSeen(NamedTuple):
    """A finger as it was seen last."""

    angle_rad: float
    """Direction of pointing."""
    time_s: float
    """When that was."""

    def leads_to(self, angle_rad: float, time_s: float) -> float:
        """Return how likely it leads there at another time, beside where it did then, 0 to 1."""
        sigma_rad = TURN_RAD + TURN_RATE_RAD_S * abs(time_s - self.time_s)
        return math.exp(-0.5 * (_turn_rad(angle_rad, self.angle_rad) / sigma_rad) ** 2)


PROVEN_MOTION = 2.0
"""A finger that has moved by so many half-widths is elsewhere."""


def has_moved(before: FingerLine, now: FingerLine) -> bool:
    """Tell whether a finger is farther from where it was than noise ever puts it."""
    return _motion(before, now) > PROVEN_MOTION


def has_moved_across(before: FingerLine, now: FingerLine) -> bool:
    """Tell whether a finger has moved across its length, as no edge of the table ever seems to.

    Along it, a template slides on an edge as far as that goes: where a hand covers the rest, it
    goes where the edge still shows.
    """
    across = np.array([-np.sin(before.angle_rad), np.cos(before.angle_rad)])
    aside_px = [
        abs(across @ np.subtract(now.tip_px, before.tip_px)),
        abs(across @ np.subtract(now.anchor_px, before.anchor_px)),
    ]
    return bool(max(aside_px) > PROVEN_MOTION * _half_width_px(before))


STILL = 0.3
LATELY = 3
"""A finger whose tip has moved by less than so many half-widths in the last frames keeps still."""


def moves(lines: Sequence[FingerLine]) -> bool:
    """Tell whether a finger that was followed through these lines is moving in the end."""
    return _motion(lines[max(len(lines) - LATELY, 0)], lines[-1]) > STILL


KEPT_PLACE = 0.5
MOVED_ON = 3.0
"""A finger that has stayed within so many half-widths of its place while another view showed its
tip move by so many is left behind. Real tips do so in no 8 frames in a row of the recordings."""


def is_left_behind(lines: Sequence[FingerLine], others: Sequence[FingerLine]) -> bool:
    """Tell whether a finger has kept its place while another view showed it move.

    Parameters
    ----------
    lines, others
        The finger in the latest frames of the view and of the other one, oldest first.
    """
    has_kept = all(_motion(lines[0], line) < KEPT_PLACE for line in lines)
    return has_kept and _motion(others[0], others[-1]) > MOVED_ON


def _motion(before: FingerLine, now: FingerLine) -> float:
    """Return how far a tip has moved [half-widths]."""
    return math.dist(now.tip_px, before.tip_px) / _half_width_px(before)


def _half_width_px(line: FingerLine) -> float:
    """Return half the usual width of a finger as long as the line."""
    return HALF_WIDTH * 2.0 * math.dist(line.tip_px, line.anchor_px)


def hand_region(line: FingerLine) -> tuple[Array, Array, float]:
    """Return the part of the image that a finger and its hand cover: a segment and a radius."""
    tip, anchor = np.array(line.tip_px), np.array(line.anchor_px)
    # The anchor is the finger's middle; hand and wrist lie within thrice its length.
    finger = 2.0 * (tip - anchor)
    return tip + 0.2 * finger, tip - 3.0 * finger, 0.8 * float(np.hypot(*finger))
