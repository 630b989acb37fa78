"""What of a frame stands before the background that a still camera has learned."""

from __future__ import annotations

import numpy as np

from fingerpost._core import Background, FingerLine, StartPose
from fingerpost.capture import Frame
from fingerpost.finding.finger import HALF_WIDTH, Array

COME_PART = 0.3
"""A hand may have come to a waiting template if this much of the finger's place is foreground."""


def has_come(background: Background, frame: Frame, start: StartPose) -> bool:
    """Tell whether something stands before the background where a template waits."""
    ahead = np.array([np.cos(start.angle_rad), np.sin(start.angle_rad)])
    aside = HALF_WIDTH * np.array([-ahead[1], ahead[0]])
    behind = np.linspace(0.1, 1.0, 10)[:, None, None] * ahead
    across = np.array([-0.7, 0.0, 0.7])[:, None] * aside
    places = start.tip_px + start.length_px * (across - behind)
    return _likely(background, frame, places.reshape(-1, 2)) > COME_PART


COME_WHOLE = 0.8
"""A finger of which this much is foreground has come into view as a whole."""


def has_come_whole(background: Background, frame: Frame, line: FingerLine) -> bool:
    """Tell whether all the inside of a finger is known to be foreground.

    What is put down before a hand leaves parts of that between its edges.
    """
    tip, anchor = np.array(line.tip_px), np.array(line.anchor_px)
    back = anchor - tip
    aside = HALF_WIDTH * np.array([-back[1], back[0]])
    along = np.linspace(0.2, 1.9, 14)[:, None, None] * back
    places = tip + along + np.array([-1.2, 0.0, 1.2])[:, None] * aside
    return _likely(background, frame, places.reshape(-1, 2)) >= COME_WHOLE


IN_FOREGROUND = 0.5
"""What is foreground to at least this part has come into view."""


GRID = 40, 30
COME_PLACES = 2
"""Something may have come if so many places of a grid over the picture (across, down) are in the
foreground: a hand with its arm covers more, be it ever so small."""


def may_have_come(background: Background, frame: Frame) -> bool:
    """Tell whether anything stands before the background; so it may where that is not known."""
    if not background.is_known:
        return True
    size_px = np.array(frame.image.shape[1::-1])
    places = (np.indices(GRID).reshape(2, -1).T + 0.5) * (size_px / GRID)
    likely = background.foreground(frame.grey(), places, colour=frame.colour())
    return int((likely >= IN_FOREGROUND).sum()) >= COME_PLACES


def stands_out(background: Background, frame: Frame, line: FingerLine) -> bool:
    """Tell whether the inside of a finger is known to be foreground."""
    return foreground_part(background, frame, line) >= IN_FOREGROUND


BACKGROUND_PART = 0.1
"""A finger of which less than this is foreground is none."""


def is_background(background: Background, frame: Frame, line: FingerLine) -> bool:
    """Tell whether the inside of a finger is known to be background."""
    return foreground_part(background, frame, line) < BACKGROUND_PART


def foreground_part(background: Background, frame: Frame, line: FingerLine) -> float:
    """Return how like foreground the inside of a finger is; NaN where little is known of it."""
    tip, anchor = np.array(line.tip_px), np.array(line.anchor_px)
    inside = tip + np.linspace(0.2, 1.2, 11)[:, None] * (anchor - tip)
    return _likely(background, frame, inside)


def _likely(background: Background, frame: Frame, places: Array) -> float:
    """Return how like foreground places (N, 2) are; NaN where most are not known."""
    likely = background.foreground(frame.grey(), places, colour=frame.colour())
    known = likely[np.isfinite(likely)]
    return float(known.mean()) if 2 * len(known) > len(places) else np.nan
