"""Detection of repeated images: cameras and drivers deliver the same image again.

An image is a repetition if it differs by no more than a video codec leaves when it encodes an image
twice, although it should change, because the hand was moving just before or moves in another view.
Without motion a repetition is harmless and none is reported: recordings without noise and single
stills always repeat.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fingerpost.capture import Frame

Picture = NDArray[np.uint8]

WIDTH_PX = 80
"""Width at which images are compared: coarse enough for small noise, fine enough for a tip."""

SAME_MEAN_LEVELS = 0.16
SAME_LEVELS = 2.0
"""Greatest mean change of an unchanged image, and its greatest change at any pixel [grey levels]. A
video codec leaves 0.15 and 2 when it encodes an image twice; a moving hand changes a pixel by 30,
and noise of 2 levels changes the mean by 0.25."""

MOVES_LEVELS = 8.0
"""Least change of a pixel by motion."""

STOPS = 3
HELD_FRAMES = 3
"""Number of times that a hand stops in full motion for fewer than `HELD_FRAMES` frames and goes on,
from which the sensor is slower than its driver."""

OTHERS_FRAMES = 5
"""Images of another view with motion since the last change, after which this view's hand has moved,
too; lagging views may show a stop for fewer."""

FROZEN_S = 0.5
"""Time of repetition after which a view is frozen."""


@dataclass(slots=True)
class _View:
    """One view's latest new image, and the counts since."""

    small: Picture | None = None
    spare: Picture = field(default_factory=lambda: np.empty((0, 0), np.uint8))
    change: Picture = field(default_factory=lambda: np.empty((0, 0), np.uint8))
    time_s: float = -np.inf
    moved: bool = False
    others_moved: int = 0
    held: int = 0
    stops: int = 0

    def make_room(self, shape: tuple[int, ...]) -> None:
        """Allocate for images of a size, so that frames allocate nothing."""
        self.small = None
        self.spare, self.change = np.empty(shape, np.uint8), np.empty(shape, np.uint8)


class Freshness:
    """Distinguishes new images of several views from repeated ones.

    Parameters
    ----------
    views
        Number of views.

    Attributes
    ----------
    repeats
        Number of repeated images of each view.
    """

    def __init__(self, views: int) -> None:
        self._views = [_View() for _ in range(views)]
        self.repeats = [0] * views
        self.frames = [0] * views

    def look(self, frames: Sequence[Frame | None]) -> tuple[bool, ...]:
        """Take the next frames of all views; return which are repeated."""
        changed = [
            None if frame is None else self._changed(k, frame) for k, frame in enumerate(frames)
        ]
        for k, moves in enumerate(changed):
            if moves:
                for other in self._views[:k] + self._views[k + 1 :]:
                    other.others_moved += 1
        return tuple(
            frame is not None and self._is_old(k, frame, moves)
            for k, (frame, moves) in enumerate(zip(frames, changed, strict=True))
        )

    def is_frozen(self, view: int, time_s: float) -> bool:
        """Whether a view has repeated its image for `FROZEN_S`."""
        return time_s - self._views[view].time_s >= FROZEN_S

    def _changed(self, k: int, frame: Frame) -> bool | None:
        """Compare an image with the last new one: whether there is motion, None if unchanged."""
        import cv2

        view, grey = self._views[k], frame.grey()
        shape = (max(round(grey.shape[0] * WIDTH_PX / grey.shape[1]), 1), WIDTH_PX)
        if view.spare.shape != shape:
            view.make_room(shape)
        now, before = view.spare, view.small
        cv2.resize(grey, shape[::-1], dst=now, interpolation=cv2.INTER_AREA)
        if before is None:
            view.small, view.spare = now, np.empty_like(now)
            return False
        change = cv2.absdiff(now, before, dst=view.change)
        mean, most = cv2.mean(change)[0], cv2.minMaxLoc(change)[1]
        if mean <= SAME_MEAN_LEVELS and most <= SAME_LEVELS:
            return None
        view.small, view.spare = now, before
        return most >= MOVES_LEVELS

    def _is_old(self, k: int, frame: Frame, moves: bool | None) -> bool:
        view = self._views[k]
        self.frames[k] += 1
        if moves is not None:
            if moves and view.moved and not view.held:
                view.stops = max(view.stops - 1, 0)  # no driver that hands pictures out again
            view.time_s, view.moved, view.others_moved, view.held = frame.time_s, moves, 0, 0
            return False
        view.held += 1
        view.stops += view.moved and view.held == 1
        repeats = view.moved and view.stops >= STOPS and view.held < HELD_FRAMES
        is_old = repeats or view.others_moved >= OTHERS_FRAMES
        self.repeats[k] += is_old
        return is_old
