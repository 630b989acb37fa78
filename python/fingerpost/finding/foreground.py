"""Foreground tests of finger regions against the background model of a static camera."""

from __future__ import annotations

import numpy as np

from fingerpost._core import Background, FingerLine, StartPose
from fingerpost.capture import Frame
from fingerpost.finding.body import Body
from fingerpost.finding.finger import HALF_WIDTH, Array, places_about

MIN_TEMPLATE_PART = 0.3
"""Least foreground probability of an initial template's region for which a hand may be there."""


def template_is_foreground(background: Background, frame: Frame, start: StartPose) -> bool:
    """Whether an initial template's region is foreground."""
    ahead = np.array([np.cos(start.angle_rad), np.sin(start.angle_rad)])
    normal_step = HALF_WIDTH * np.array([-ahead[1], ahead[0]])
    behind = np.linspace(0.1, 1.0, 10)[:, None, None] * ahead
    across = np.array([-0.7, 0.0, 0.7])[:, None] * normal_step
    places = start.tip_px + start.length_px * (across - behind)
    return _likely(background, frame, places.reshape(-1, 2)) > MIN_TEMPLATE_PART


MIN_WHOLE_PART = 0.8
"""Least foreground probability of a finger's whole inside for which all of it is foreground."""


def whole_finger_is_foreground(background: Background, frame: Frame, line: FingerLine) -> bool:
    """Whether the whole inside of a finger is known to be foreground.

    An object laid on the table in front of a hand leaves background between its edges.
    """
    tip, anchor = np.array(line.tip_px), np.array(line.anchor_px)
    back = anchor - tip
    normal_step = HALF_WIDTH * np.array([-back[1], back[0]])
    along = np.linspace(0.2, 1.9, 14)[:, None, None] * back
    places = tip + along + np.array([-1.2, 0.0, 1.2])[:, None] * normal_step
    return _likely(background, frame, places.reshape(-1, 2)) >= MIN_WHOLE_PART


MIN_FOREGROUND = 0.5
"""Least foreground probability of a finger that has come into view."""


GRID = 40, 30
GRID_CELLS = np.indices(GRID).reshape(2, -1).T + 0.5
MIN_FOREGROUND_PLACES = 2
"""Size of a grid over the image (columns, rows), the middles of its cells, and least number of them
in the foreground for which a hand may have come: the smallest hand with its arm covers more."""


def any_foreground(background: Background, frame: Frame, body: Body) -> bool:
    """Whether anything but a moving body is foreground; True while the background is unknown."""
    if not background.is_known:
        return True
    size_px = np.array(frame.image.shape[1::-1])
    places = GRID_CELLS * (size_px / GRID)
    likely = background.foreground(frame.grey(), places, colour=frame.colour())
    foreground = places[likely >= MIN_FOREGROUND]
    return int((~body.covers(foreground)).sum()) >= MIN_FOREGROUND_PLACES


def stands_out(background: Background, frame: Frame, line: FingerLine) -> bool:
    """Whether the inside of a finger is known to be foreground."""
    return foreground_part(background, frame, line) >= MIN_FOREGROUND


MAX_BACKGROUND_PART = 0.1
"""Foreground probability below which a detection is background, not a finger."""


def is_background(background: Background, frame: Frame, line: FingerLine) -> bool:
    """Whether the inside of a finger is known to be background."""
    return foreground_part(background, frame, line) < MAX_BACKGROUND_PART


ALONG_FINGER = np.linspace(0.2, 1.2, 11)[:, None]
"""Sample positions from the tip to beyond the anchor, as a part of their distance."""


def foreground_part(background: Background, frame: Frame, line: FingerLine) -> float:
    """Return the mean foreground probability along a finger; NaN where mostly unknown."""
    tip, anchor = np.array(line.tip_px), np.array(line.anchor_px)
    inside = tip + ALONG_FINGER * (anchor - tip)
    return _likely(background, frame, inside)


AHEAD = np.linspace(0.5, 1.5, 4)
BESIDE_AXIS = np.linspace(-0.4, 0.4, 3)
"""Sample positions ahead of a tip, along and across the axis [half-widths]."""


def places_ahead(line: FingerLine, half_width_px: float) -> Array:
    """Return places just ahead of a finger's tip, (N, 2) [px]."""
    return places_about(line, half_width_px, AHEAD, BESIDE_AXIS).reshape(-1, 2)


def foreground_ahead(background: Background, frame: Frame, ahead_px: Array) -> float:
    """Return the mean foreground probability of places ahead of a tip; NaN if unknown.

    In films it is below 0.1 ahead of nearly every fingertip, and above 0.6 ahead of a contour that
    ends at a dark nail or with a glove.
    """
    return _likely(background, frame, ahead_px)


def _likely(background: Background, frame: Frame, places: Array) -> float:
    """Return the mean foreground probability of points (N, 2); NaN if most are unknown."""
    likely = background.foreground(frame.grey(), places, colour=frame.colour())
    known = likely[np.isfinite(likely)]
    return float(known.mean()) if 2 * len(known) > len(places) else np.nan
