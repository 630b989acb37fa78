"""Whether a picture is a new one: cameras and drivers hand the same one out again.

A picture is an old one if nothing in it has changed, not even by the noise that its view shows from
picture to picture, though something must have: the hand that it showed moved a moment ago, or moves
in another view. Where nothing moves anywhere an old picture does no harm, and none is suspected:
recordings without noise and single stills show the same over and over.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fingerpost.capture import Frame

Picture = NDArray[np.uint8]

WIDTH_PX = 80
"""Pictures are compared at this width: coarse enough for noise to be small, and fine enough for a
fingertip to show."""

SAME_SHARE = 0.03
SAME_LEVELS = 2.0
"""Nothing has changed if the mean change is this part of the usual one, and the largest no more
[grey levels]: a video codec leaves that much when it encodes a picture again."""

MOVES_LEVELS = 8.0
"""Something moves that changes a place by so much."""

KNOWN_CHANGES = 5
"""Changes after which it is known how large they usually are."""

STOPS = 3
HELD_FRAMES = 3
"""A hand that stops so often in full motion, for fewer frames than these, and goes on is seen by a
sensor behind a driver that is faster."""

OTHERS_FRAMES = 5
"""A hand that has moved in so many pictures of another view since has moved: views that lag behind
each other may see it stop in fewer."""

FROZEN_S = 0.5
"""A view whose picture has been old for so long is frozen."""


@dataclass(slots=True)
class _View:
    """What is known of one view's latest new picture, and since."""

    small: Picture | None = None
    spare: Picture = field(default_factory=lambda: np.empty((0, 0), np.uint8))
    change: Picture = field(default_factory=lambda: np.empty((0, 0), np.uint8))
    time_s: float = -np.inf
    moved: bool = False
    others_moved: int = 0
    held: int = 0
    stops: int = 0
    changes: deque[float] = field(default_factory=lambda: deque(maxlen=30))

    @property
    def is_known(self) -> bool:
        """Whether it is known how much its pictures usually change."""
        return len(self.changes) >= KNOWN_CHANGES

    def make_room(self, shape: tuple[int, ...]) -> None:
        """Keep room for pictures of a size: a frame is to borrow no memory."""
        self.small = None
        self.spare, self.change = np.empty(shape, np.uint8), np.empty(shape, np.uint8)


class Freshness:
    """Tells new pictures of several views from old ones that were handed out again.

    Parameters
    ----------
    views
        How many there are.

    Attributes
    ----------
    repeats
        How many pictures of each view were old ones.
    """

    def __init__(self, views: int) -> None:
        self._views = [_View() for _ in range(views)]
        self.repeats = [0] * views
        self.frames = [0] * views

    def look(self, frames: Sequence[Frame | None]) -> tuple[bool, ...]:
        """Take the next frames of all views; tell which of them are old pictures."""
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
        """Tell whether a view, whose picture is old, has shown it for long."""
        return time_s - self._views[view].time_s >= FROZEN_S

    def _changed(self, k: int, frame: Frame) -> bool | None:
        """Compare a picture with the last new one; tell whether something moves, None if same."""
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
        usual = sorted(view.changes)[len(view.changes) // 2] if view.is_known else 0.0
        if mean <= SAME_SHARE * usual and most <= SAME_LEVELS and usual > 0.0:
            return None
        view.changes.append(mean)
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
