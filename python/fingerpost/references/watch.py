"""Whether the camera of a view keeps still, and if not, how it shows the plane now.

A rig file says where the reference points are in the picture. A camera that is bumped or held by
hand shows them elsewhere, and every point told from then on would be off by as much as the table
has moved in the picture, and surely so. The reference points themselves tell, where they are
corners of something, and so does what stands on the table: corners of the first picture are
followed by optical flow (Lucas & Kanade 1981, in pyramids: Bouguet 2001). They count by where they
are in the picture, so that a hand with many corners on it moves no camera.

Corners tell that the camera has moved, and about where to. From then on the registration tells
where the plane is in every frame, until it is where it was at first. Where it cannot, the camera is
adrift: no point is better than a wrong one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fingerpost.lens import Lens
from fingerpost.pointing import PlaneView
from fingerpost.references.reduction import Reduction
from fingerpost.references.registration import PlaneMotion, PlaneRegistration, Segment, is_within

LOOK_EVERY = 5
"""One frame in so many of a camera that keeps still is looked at."""

LARGEST_PX = 1280
"""Pictures with a longer side are watched at a reduced size."""

WIDEST_PX = 320
"""Wider pictures are halved until they are not; all lengths below are of the halved picture."""

CORNERS_A_CELL = 6
LEAST_CORNER = 1.5
CORNERS_APART_PX = 6
"""How many corners of each cell are followed, how much the picture changes about them at least,
along either axis, as a root mean square [levels a pixel], and how far apart they are."""

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
LEAST_OTHERS = 5
LEAST_REFERENCES = 3
"""Votes without which nothing is told, unless there are those of so many reference points: a hand
and its arm have fewer; and votes without those of a hand that is known."""

LEAST_SHARE = 0.75
"""Part of the votes that must agree on one motion: a shift, a turn and a change of scale."""

STANDS_PX = 0.12
STANDING_SHARE = 0.5
"""A vote stands still that is no further from where it was; a camera has not moved if such are
more than this part of all votes: they would agree as well on a small motion of whatever else."""

AGREES_PX = 0.75
AGREES_PART = 0.1
"""Votes agree that are off it by no more, or by no more than this part of their middle motion."""

MOVED_PX = 0.75
STILL_PX = 0.3
"""A plane that has moved by more, on average, is followed until it has moved by less [px of the
whole picture]."""

ADRIFT_PX = 2.0
"""Less motion is hardly more than what reference points are uncertain by: a camera that has moved
by no more is not adrift."""

MET_PX = 1.5
MET_SHARE = 0.7
"""A plane is where the corners say if this part of them are so near to where it puts them."""

FIRST_FRAMES = 10
"""A hand that is followed after so few frames was there in the first one."""

FIRST_UNLIKE_PX = 0.3
UNLIKE = 1.5
UNLIKE_PX = 0.2
"""A picture is looked at, too, that seems to be off the first one by so much more, in part and in
pixels, than the last one whose turn it was; and by how much at first."""

_Picture = NDArray[np.uint8]
_Points = NDArray[np.float32]


class ReferenceWatch:
    """Watches whether a view's camera stands where it stood when the first frame was taken.

    Large pictures are watched at a reduced size (`Reduction`).

    Parameters
    ----------
    reference_points_px
        The view's N ≥ 4 reference points (u, v) [px].
    lens
        The view's distortion, if it is known.
    """

    def __init__(
        self, reference_points_px: Sequence[tuple[float, float]], lens: Lens | None = None
    ) -> None:
        self._reference_points_px = np.array(reference_points_px, np.float64).reshape(-1, 2)
        self._lens = lens
        self._shape: tuple[int, ...] = ()
        self._reduction = Reduction(1)
        self._watch = _Watch(self._reference_points_px, lens)

    @property
    def moved_px(self) -> float:
        """How far what stands on the table has moved in the picture [px].

        On average, by the last look that could tell; 0 while the camera keeps still.
        """
        return self._reduction.factor * self._watch.moved_px

    @property
    def is_adrift(self) -> bool:
        """Whether the camera has moved and it is not known where to."""
        return self._watch.is_adrift

    @property
    def motion(self) -> PlaneMotion | None:
        """How the plane has moved in the picture since the first frame.

        None while the camera keeps still, and where it cannot be told.
        """
        motion = self._watch.motion
        if motion is None or self._reduction.factor == 1:
            return motion
        return motion.scaled(self._reduction.whole_from_reduced)

    def plane_view(self, still: PlaneView) -> PlaneView | None:
        """Return how the view sees the plane; None while that is not known.

        Parameters
        ----------
        still
            How the first frame has shown it.
        """
        if self.is_adrift:
            return None
        motion = self.motion
        return still if motion is None else still.moved(motion.now_from_first, motion.covariance)

    def look(
        self,
        grey: _Picture,
        hand: Segment | None = None,
        picture: _Picture | None = None,  # noqa: ARG002 - of all that watch, some need colours
    ) -> None:
        """Take the next frame.

        One in `LOOK_EVERY` is looked at, one that is unlike the first one, and every one once the
        camera has moved. Where too little is seen to tell, as on a table without texture, nothing
        changes. Pictures of another size than the first one begin anew.

        Parameters
        ----------
        grey
            (H, W) Its grey levels.
        hand
            Where a hand was in the frame before, if one is followed: it moves no camera.
        picture
            The same frame with its colours, which are not needed here.
        """
        if grey.shape != self._shape:
            self._shape, self._reduction = grey.shape, Reduction.of(grey.shape, LARGEST_PX)
            self._watch = _Watch(
                self._reduction.points(self._reference_points_px),
                self._reduction.lens(self._lens),
            )
        if hand is not None and self._reduction.factor > 1:
            end_px, other_px, radius_px = hand
            ends = self._reduction.points([end_px, other_px])
            hand = (*ends, radius_px / self._reduction.factor)
        self._watch.look(self._reduction.picture(grey), hand)


class _Watch:
    """Watches pictures of one size, none of them large.

    Attributes
    ----------
    moved_px, motion
        As of `ReferenceWatch`.
    """

    def __init__(self, reference_points_px: NDArray[np.float64], lens: Lens | None) -> None:
        self.moved_px = 0.0
        self.motion: PlaneMotion | None = None
        self._reference_points_px = reference_points_px
        self._lens = lens
        self._has_begun = False
        self._whole_px = 1.0

    @property
    def is_adrift(self) -> bool:
        """Whether the camera has moved and it is not known where to."""
        return self.motion is None and self.moved_px > ADRIFT_PX

    def look(self, grey: _Picture, hand: Segment | None = None) -> None:
        """Take the next frame, as `ReferenceWatch.look`."""
        if not self._has_begun:
            self._begin(grey)
            return
        self._frames += 1
        if hand is not None and not self._knows_hand and self._frames <= FIRST_FRAMES:
            self._forget(hand)
        if len(self._corners_px) > 0 and self._is_due(grey):
            self._compare(grey, hand)

    def _begin(self, grey: _Picture) -> None:
        """Find the corners of the first picture, the reference points before all others."""
        self._has_begun, self._halves = True, _halves(grey)
        self._first = _halved(grey, self._halves).copy()
        self._whole_px = grey.shape[1] / self._first.shape[1]
        self._frames, self._unlike_px = 0, FIRST_UNLIKE_PX
        self._registration = PlaneRegistration(grey, self._reference_points_px, self._lens)
        self._rest()
        strength = _corner_strength(self._first)
        references = _corners_near(self._reference_points_px / self._whole_px, strength)
        others = _strongest_corners(strength)
        self._references = len(references)
        self._corners_px = np.vstack([references, others]).astype(np.float32)
        self._is_hand, self._knows_hand = np.zeros(len(self._corners_px), np.bool_), False
        self._last_px = self._corners_px
        self._cells = self._sorted_into_cells()

    def _rest(self) -> None:
        """Take the camera for one that keeps still."""
        self.moved_px, self.motion = 0.0, None
        self._now_from_first, self._further = np.eye(3), np.eye(3)

    def _forget(self, hand: Segment) -> None:
        """Leave out what the first picture shows of a hand that has been there from the start."""
        self._knows_hand = True
        self._is_hand = is_within(hand, self._whole(self._corners_px))
        self._registration.forget(hand)

    def _is_due(self, grey: _Picture) -> bool:
        """Tell whether a picture is to be looked at."""
        if self.moved_px > 0.0:
            return True
        unlike_px = self._registration.unlike_px(grey)
        is_unlike = unlike_px > UNLIKE * self._unlike_px + UNLIKE_PX
        is_its_turn = self._frames % LOOK_EVERY == 0
        if is_its_turn:
            self._unlike_px = unlike_px
        return is_its_turn or is_unlike

    def _compare(self, grey: _Picture, hand: Segment | None) -> None:
        """Follow the corners from the first picture to this one, and let them vote."""
        if self.motion is not None:
            self._last_px = self._shown(self._corners_px, self._further @ self._now_from_first)
        here_px, is_sure = self._followed(_halved(grey, self._halves))
        is_sure &= ~self._is_hand
        if hand is not None:
            is_sure &= ~is_within(hand, self._whole(here_px))
        from_px, to_px = self._votes(here_px, is_sure)
        references = int(is_sure[: self._references].sum())
        least = LEAST_VOTES if hand is None else LEAST_OTHERS
        is_told = len(from_px) >= least or references >= LEAST_REFERENCES
        if is_told and _stand_still(from_px, to_px):
            self._rest()
            return
        gone = self._agreed(from_px, to_px) if is_told else None
        if self.moved_px == 0.0:
            return
        before = self._now_from_first
        if gone is not None and self.motion is None and self._stands(grey, gone @ before, hand):
            self._rest()
            return
        guesses = [] if gone is None else [gone @ before]
        guesses += [self._further @ before, before]
        self._register(grey, hand, guesses, (from_px, to_px) if is_told else None)

    def _stands(self, grey: _Picture, guess: NDArray[np.float64], hand: Segment | None) -> bool:
        """Tell whether it is not the plane that has moved, but something with many corners."""
        return self._registration.stands(grey, guess / guess[2, 2], hand)

    def _followed(self, now: _Picture) -> tuple[_Points, NDArray[np.bool_]]:
        """Return where the corners of the first picture are now, and which of them surely so."""
        here_px, is_seen = _flow(self._first, now, self._corners_px, self._last_px)
        back_px, is_back = _flow(now, self._first, here_px, self._corners_px)
        returns = np.linalg.norm(back_px - self._corners_px, axis=1) < RETURNS_PX
        is_sure = is_seen & is_back & returns
        self._last_px = np.where(is_sure[:, None], here_px, self._last_px)
        return here_px, is_sure

    def _agreed(self, from_px: _Points, to_px: _Points) -> NDArray[np.float64] | None:
        """Return the homography by which votes have gone on since the last look, if they agree."""
        import cv2

        away_px = float(np.median(np.linalg.norm(to_px - from_px, axis=1)))
        expected_px = self._shown(from_px, self._now_from_first)
        gone, agrees = cv2.estimateAffinePartial2D(
            expected_px,
            to_px,
            method=cv2.RANSAC,
            ransacReprojThreshold=max(AGREES_PX, AGREES_PART * away_px),
        )
        if gone is None or np.mean(agrees) < LEAST_SHARE:
            return None
        # Not of the reference points, which may lie far outside of the picture.
        there_px = expected_px @ gone[:, :2].T + gone[:, 2]
        moved_px = self._whole_px * float(np.mean(np.linalg.norm(there_px - from_px, axis=1)))
        if self.motion is None:
            self.moved_px = moved_px if moved_px > MOVED_PX else 0.0
        whole_from_half = np.diag([self._whole_px, self._whole_px, 1.0])
        whole_from_half[:2, 2] = 0.5 * self._whole_px - 0.5
        gone = whole_from_half @ np.vstack([gone, (0.0, 0.0, 1.0)])
        return np.asarray(gone @ np.linalg.inv(whole_from_half))

    def _register(
        self,
        grey: _Picture,
        hand: Segment | None,
        guesses: Sequence[NDArray[np.float64]],
        votes: tuple[_Points, _Points] | None,
    ) -> None:
        """Follow the plane from the first guess that leads to where the votes are, if any."""
        before, was_followed = self._now_from_first, self.motion is not None
        self.motion = None
        for guess in guesses:
            motion = self._registration.align(grey, guess / guess[2, 2], hand)
            if motion is None:
                continue
            moved_px = self._moved_px(motion)
            if moved_px < STILL_PX:
                self._rest()
                return
            is_backed = was_followed if votes is None else self._meets(motion, *votes)
            if is_backed:
                self.motion, self.moved_px = motion, moved_px
                self._now_from_first = motion.now_from_first
                self._further = self._gone(before) if was_followed else np.eye(3)
                return

    def _gone(self, before: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the shift, turn and change of scale by which the corners have gone on."""
        from_px = self._whole(self._shown(self._corners_px, before)) @ [1.0, 1j]
        to_px = self._whole(self._shown(self._corners_px, self._now_from_first)) @ [1.0, 1j]
        about = from_px - from_px.mean()
        turn = np.vdot(about, to_px) / np.vdot(about, about).real
        shift = to_px.mean() - turn * from_px.mean()
        return np.array(
            [
                [turn.real, -turn.imag, shift.real],
                [turn.imag, turn.real, shift.imag],
                [0.0, 0.0, 1.0],
            ]
        )

    def _moved_px(self, motion: PlaneMotion) -> float:
        """Return how far a motion takes corners, on average [px of the whole picture]."""
        off_px = self._shown(self._corners_px, motion.now_from_first) - self._corners_px
        return self._whole_px * float(np.mean(np.linalg.norm(off_px, axis=1)))

    def _meets(self, motion: PlaneMotion, from_px: _Points, to_px: _Points) -> bool:
        """Tell whether a motion takes most votes to where they are."""
        off_px = np.linalg.norm(self._shown(from_px, motion.now_from_first) - to_px, axis=1)
        return bool(np.mean(off_px < MET_PX) >= MET_SHARE)

    def _whole(self, half_px: _Points) -> NDArray[np.float64]:
        """Return where points of the halved picture are in the whole one [px]."""
        return np.asarray((half_px.astype(np.float64) + 0.5) * self._whole_px - 0.5)

    def _shown(self, from_px: _Points, now_from_first: NDArray[np.float64]) -> _Points:
        """Return where a motion takes points of the first picture; both halved [px]."""
        px = self._whole(from_px)
        px = px if self._lens is None else self._lens.undistort(px)
        y = np.column_stack([px, np.ones(len(px))]) @ now_from_first.T
        px = y[:, :2] / y[:, 2:]
        px = px if self._lens is None else self._lens.distort(px)
        return np.asarray((px + 0.5) / self._whole_px - 0.5, np.float32)

    def _sorted_into_cells(self) -> list[NDArray[np.intp]]:
        """Return which corners are in each cell of the picture, but for the reference points."""
        cell = _cell_of(self._corners_px, self._first.shape)
        cell[: self._references] = -1
        return [np.flatnonzero(cell == c) for c in range(CELLS[0] * CELLS[1])]

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


def _stand_still(from_px: _Points, to_px: _Points) -> bool:
    """Tell whether most votes are where they were."""
    stands = np.linalg.norm(to_px - from_px, axis=1) <= STANDS_PX
    return bool(np.mean(stands) > STANDING_SHARE)


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


def _corner_strength(picture: _Picture) -> NDArray[np.float32]:
    """Return how much a picture changes about each place along the axis along which it does least.

    As a root mean square [levels a pixel] (Shi & Tomasi 1994).
    """
    import cv2

    # OpenCV sums 9 squares of a Sobel filter, whose weights add up to 8, over 4 * 3 * 255.
    strength = cv2.cornerMinEigenVal(picture, 3)
    return np.asarray(np.sqrt(np.maximum(strength, 0.0)) * (4 * 3 * 255) / (3 * 8), np.float32)


def _strongest_corners(strength: NDArray[np.float32]) -> _Points:
    """Return the strongest corners of each cell of a picture [px]."""
    import cv2

    about = np.ones((2 * CORNERS_APART_PX + 1,) * 2, np.uint8)
    is_corner = (strength >= LEAST_CORNER) & (strength == cv2.dilate(strength, about))
    row, column = np.nonzero(is_corner)
    order = np.argsort(-strength[row, column], kind="stable")
    corners = np.stack([column, row], axis=1)[order].astype(np.float32)
    cell = _cell_of(corners, strength.shape)
    best = [np.flatnonzero(cell == c)[:CORNERS_A_CELL] for c in range(CELLS[0] * CELLS[1])]
    return corners[np.concatenate(best)]


def _cell_of(corners_px: _Points, shape: tuple[int, ...]) -> NDArray[np.intp]:
    """Return the cell of a picture in which each corner lies."""
    column, row = np.clip(corners_px / np.array(shape[::-1]) * CELLS, 0, np.array(CELLS) - 1).T
    return np.asarray(column.astype(int) + CELLS[0] * row.astype(int), np.intp)


def _corners_near(points_px: NDArray[np.float64], strength: NDArray[np.float32]) -> _Points:
    """Return those of some points that are corners, each where it is strongest [px]."""
    size_px = np.array(strength.shape[::-1])
    in_picture = ((points_px >= 0.0) & (points_px <= size_px - 1)).all(axis=1)
    corners = []
    for u, v in np.round(points_px[in_picture]).astype(int):
        left, top = max(u - NEAR_PX, 0), max(v - NEAR_PX, 0)
        about = strength[top : v + NEAR_PX + 1, left : u + NEAR_PX + 1]
        if float(about.max()) >= LEAST_CORNER:
            row, column = np.unravel_index(int(np.argmax(about)), about.shape)
            corners.append((left + column, top + row))
    return np.array(corners, np.float32).reshape(-1, 2)


def _flow(
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
