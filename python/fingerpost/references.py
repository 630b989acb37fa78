"""Whether the reference points of a view are still where they were found.

A rig file says where they are in the picture. A camera that is bumped or held by hand shows them
elsewhere, and every point told from then on would be off by as much as the table has moved in the
picture, and surely so. The reference points themselves tell, where they are corners of something,
and so does what stands on the table: corners of the first picture are followed by optical flow
(Lucas and Kanade 1981, in pyramids: Bouguet 2001). They count by where they are in the picture, so
that a hand with many corners on it moves no camera.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

LOOK_EVERY = 5
"""One frame in so many is looked at."""

WIDEST_PX = 320
"""Wider pictures are halved until they are not; all lengths below are of the halved picture."""

MOST_CORNERS = 72
CORNER_QUALITY = 0.01
CORNERS_APART_PX = 6
"""How many corners are followed, how strong they are beside the strongest, and how far apart."""

NEAR_PX = 2
"""A reference point is a corner if there is one this near to it."""

WINDOW_PX = 11
LEVELS = 3
"""Side of the window that is followed, and how often the picture is halved again for that."""

RETURNS_PX = 0.3
"""A corner that is followed there and back ends this near to where it began, or is lost."""

CELLS = (4, 3)
"""Columns and rows of the picture that have a vote each; so has each reference point."""

LEAST_CORNERS = 2
"""Corners that a cell needs for its vote."""

LEAST_VOTES = 7
LEAST_REFERENCES = 3
"""Votes without which nothing is told, unless there are those of so many reference points: a hand
and its arm have fewer."""

LEAST_SHARE = 0.75
"""Part of the votes that must agree on one motion: a shift, a turn and a change of scale."""

AGREES_PX = 0.75
AGREES_PART = 0.1
"""Votes agree that are off it by no more, or by no more than this part of their middle motion."""

MOVED_PX = 2.0
"""Less motion in the whole picture is hardly more than what reference points are uncertain by."""

_Picture = NDArray[np.uint8]
_Points = NDArray[np.float32]


class ReferenceWatch:
    """Watches whether a view's camera stands where it stood when the first frame was taken.

    Parameters
    ----------
    reference_points_px
        The view's N reference points (u, v) [px].
    """

    def __init__(self, reference_points_px: Sequence[tuple[float, float]]) -> None:
        self.moved_px = 0.0
        """How far what was looked at has moved, on average, by the last look that told; 0 if by
        less than `MOVED_PX` [px]."""
        self._reference_points_px = np.array(reference_points_px, np.float64).reshape(-1, 2)
        self._frames = 0
        self._size: tuple[int, ...] = ()
        self._first: _Picture = np.empty((0, 0), np.uint8)
        self._halves: list[_Picture] = []
        self._references = 0
        self._corners_px: _Points = np.empty((0, 2), np.float32)
        self._last_px = self._corners_px
        self._cells: list[NDArray[np.intp]] = []

    def look(self, grey: _Picture) -> None:
        """Take the next frame; one in `LOOK_EVERY` is looked at.

        Where too little is seen to tell, as on a table without texture, nothing changes. Pictures
        of another size than the first one begin anew.

        Parameters
        ----------
        grey
            (H, W) Its grey levels.
        """
        if grey.shape != self._size:
            self._begin(grey)
        elif self._frames % LOOK_EVERY == 0 and len(self._corners_px) > 0:
            self._compare(grey)
        self._frames += 1

    def _begin(self, grey: _Picture) -> None:
        """Find the corners of the first picture, the reference points before all others."""
        import cv2

        self._size, self._halves = grey.shape, _halves(grey)
        self._first = _halved(grey, self._halves).copy()
        self._frames, self.moved_px = 0, 0.0
        strength = cv2.cornerMinEigenVal(self._first, 3)
        part = self._first.shape[1] / grey.shape[1]
        references = _corners_near(self._reference_points_px * part, np.asarray(strength))
        found = cv2.goodFeaturesToTrack(self._first, MOST_CORNERS, CORNER_QUALITY, CORNERS_APART_PX)
        others = np.empty((0, 2)) if found is None else np.asarray(found).reshape(-1, 2)
        self._references = len(references)
        self._corners_px = np.vstack([references, others]).astype(np.float32)
        self._last_px = self._corners_px
        self._cells = self._sorted_into_cells()

    def _sorted_into_cells(self) -> list[NDArray[np.intp]]:
        """Return which corners are in each cell of the picture, but for the reference points."""
        size_px = np.array(self._first.shape[::-1])
        column, row = np.clip(self._corners_px / size_px * CELLS, 0, np.array(CELLS) - 1).T
        cell = column.astype(int) + CELLS[0] * row.astype(int)
        cell[: self._references] = -1
        return [np.flatnonzero(cell == c) for c in range(CELLS[0] * CELLS[1])]

    def _compare(self, grey: _Picture) -> None:
        """Follow the corners from the first picture to this one, and let them vote."""
        import cv2

        now = _halved(grey, self._halves)
        here_px, is_seen = _followed(self._first, now, self._corners_px, self._last_px)
        back_px, is_back = _followed(now, self._first, here_px, self._corners_px)
        returns = np.linalg.norm(back_px - self._corners_px, axis=1) < RETURNS_PX
        is_sure = is_seen & is_back & returns
        self._last_px = np.where(is_sure[:, None], here_px, self._last_px)
        from_px, to_px = self._votes(here_px, is_sure)
        references = int(is_sure[: self._references].sum())
        if len(from_px) < LEAST_VOTES and references < LEAST_REFERENCES:
            return
        away_px = float(np.median(np.linalg.norm(to_px - from_px, axis=1)))
        within_px = max(AGREES_PX, AGREES_PART * away_px)
        motion, agrees = cv2.estimateAffinePartial2D(
            from_px, to_px, method=cv2.RANSAC, ransacReprojThreshold=within_px
        )
        if motion is not None and np.mean(agrees) >= LEAST_SHARE:
            # Not of the reference points, which may lie far outside of the picture.
            off_px = from_px @ motion[:, :2].T + motion[:, 2] - from_px
            moved_px = float(np.mean(np.linalg.norm(off_px, axis=1)))
            moved_px *= self._size[1] / now.shape[1]
            self.moved_px = moved_px if moved_px > MOVED_PX else 0.0

    def _votes(self, here_px: _Points, is_sure: NDArray[np.bool_]) -> tuple[_Points, _Points]:
        """Return (M, 2) where voters were and are: reference points, and a corner for each cell.

        Of those that were followed, and of cells with corners enough; theirs is the one that has
        moved as most of them have.
        """
        voters = list(np.flatnonzero(is_sure[: self._references]))
        for corners in self._cells:
            corners = corners[is_sure[corners]]
            if len(corners) >= LEAST_CORNERS:
                moved_px = here_px[corners] - self._corners_px[corners]
                off_px = np.linalg.norm(moved_px - np.median(moved_px, axis=0), axis=1)
                voters.append(corners[np.argmin(off_px)])
        return self._corners_px[voters], here_px[voters]


def _halves(grey: _Picture) -> list[_Picture]:
    """Return room for a picture and its halves, down to one that is no wider than `WIDEST_PX`."""
    halves: list[_Picture] = []
    height, width = grey.shape
    while width > WIDEST_PX:
        height, width = max(height // 2, 1), width // 2
        halves.append(np.empty((height, width), np.uint8))
    return halves


def _halved(grey: _Picture, halves: list[_Picture]) -> _Picture:
    """Return the last half of a picture, in the room for it; itself if it has none."""
    import cv2

    for half in halves:
        cv2.resize(grey, half.shape[::-1], dst=half, interpolation=cv2.INTER_AREA)
        grey = half
    return grey


def _corners_near(points_px: NDArray[np.float64], strength: NDArray[np.float32]) -> _Points:
    """Return those of some points that are corners, each where it is strongest [px]."""
    least = CORNER_QUALITY * float(strength.max(initial=0.0))
    size_px = np.array(strength.shape[::-1])
    in_picture = ((points_px >= 0.0) & (points_px <= size_px - 1)).all(axis=1)
    corners = []
    for u, v in np.round(points_px[in_picture]).astype(int):
        left, top = max(u - NEAR_PX, 0), max(v - NEAR_PX, 0)
        about = strength[top : v + NEAR_PX + 1, left : u + NEAR_PX + 1]
        if float(about.max()) > least:
            row, column = np.unravel_index(int(np.argmax(about)), about.shape)
            corners.append((left + column, top + row))
    return np.array(corners, np.float32).reshape(-1, 2)


def _followed(
    before: _Picture, after: _Picture, corners_px: _Points, guess_px: _Points
) -> tuple[_Points, NDArray[np.bool_]]:
    """Return where corners of one picture are in another, and which of them were found."""
    import cv2

    there_px, found, _ = cv2.calcOpticalFlowPyrLK(
        before,
        after,
        corners_px,
        guess_px.copy(),
        winSize=(WINDOW_PX, WINDOW_PX),
        maxLevel=LEVELS,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(there_px, np.float32).reshape(-1, 2), np.asarray(found).ravel() > 0
