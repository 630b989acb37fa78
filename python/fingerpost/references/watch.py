"""Detection of a camera's motion, and the view's homography after it.

A rig file gives the image positions of the reference points. After a bump, or with a hand-held
camera, they are elsewhere, and every indicated point would have a bias as large as the motion of
the table in the image. Corners of the first image, the reference points among them where they are
corners, are tracked by optical flow (Lucas & Kanade 1981; pyramids: Bouguet 2001). One corner per
cell of the image is sampled, so that a hand with many corners cannot pass for a camera motion.

The corners detect the motion and give an initial estimate. From then on every frame is registered
(`registration`), until the plane is back at its first position. If registration fails, the camera
is adrift and its view gives no line: no point is better than a wrong one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fingerpost.lens import Lens
from fingerpost.pointing import PlaneView
from fingerpost.references.reduction import Reduction
from fingerpost.references.registration import PlaneMotion, PlaneRegistration, Segment, is_within

TEST_EVERY = 5
"""Interval between tested frames of a static camera."""

LARGEST_PX = 1280
"""Images with a longer side are tested at a reduced size."""

MAX_WIDTH_PX = 320
"""Images are halved until they are no wider; all lengths below are of the reduced image."""

MAX_CORNERS_PER_CELL = 6
MIN_CORNER_STRENGTH = 1.5
MIN_CORNER_DISTANCE_PX = 6
"""Greatest number of corners in a cell, their least strength, the root mean square gradient along
the weaker axis [levels a pixel], and their least distance."""

NEAR_PX = 2
"""Greatest distance of a corner from a reference point that it represents."""

WINDOW_PX = 11
LEVELS = 3
"""Side of the optical flow's window, and number of its further pyramid levels."""

MAX_ROUND_TRIP_PX = 0.3
"""Greatest error of a corner tracked forwards and backwards, beyond which it is lost."""

CELLS = (4, 3)
"""Columns and rows of the cells that give one sample each; each reference point gives one, too."""

MIN_CORNERS = 2
"""Least number of tracked corners in a sampled cell."""

MIN_SAMPLES = 7
MIN_SAMPLES_BESIDE_HAND = 5
MIN_REFERENCES = 3
"""Least numbers of samples for a decision: a hand and its arm give fewer; the same where the region
of the hand is known and excluded; least number of reference points, which suffices alone."""

MIN_INLIER_SHARE = 0.75
"""Least share of samples that are inliers of one similarity."""

STATIC_PX = 0.12
MIN_STATIC_SHARE = 0.5
"""Greatest motion of a static sample, and the share of static samples above which the camera has
not moved: they would also be inliers of a small motion of something else."""

INLIER_PX = 0.75
INLIER_PART = 0.1
"""Greatest residual of an inlier: absolute, or as a part of the median motion."""

MOVED_PX = 0.75
STILL_PX = 0.3
"""Mean motion above which the plane is registered, until it is below the second value [px of the
full image]."""

ADRIFT_PX = 2.0
"""Least motion of a camera that is adrift: below, it is comparable to the uncertainty of the
reference points."""

CONSISTENT_PX = 1.5
MIN_CONSISTENT_SHARE = 0.7
"""A registration is consistent if this share of the samples is within this distance of it."""

FIRST_FRAMES = 10
"""Number of frames within which a followed hand was present in the first one."""

INITIAL_APPARENT_MOTION_PX = 0.3
APPARENT_MOTION_FACTOR = 1.5
APPARENT_MOTION_MARGIN_PX = 0.2
"""A frame out of turn is tested if its apparent motion exceeds that of the last regular one by this
factor and margin; and the initial value of the latter."""

_Picture = NDArray[np.uint8]
_Points = NDArray[np.float32]


class ReferenceWatch:
    """Detects the motion of a view's camera since the first frame.

    Large images are tested at a reduced size (`Reduction`).

    Parameters
    ----------
    reference_points_px
        The view's N ≥ 4 reference points (u, v) [px].
    lens
        The view's distortion, if known.
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
        """Mean motion of the corners in the image, by the last decision [px]; 0 if static."""
        return self._reduction.factor * self._watch.moved_px

    @property
    def is_adrift(self) -> bool:
        """Whether the camera has moved or was disconnected, and its homography is unknown."""
        return self._watch.is_adrift

    def doubt(self) -> None:
        """Treat the camera as adrift until the plane is confirmed: it may have been replaced."""
        self._watch.doubt()

    @property
    def motion(self) -> PlaneMotion | None:
        """Motion of the plane since the first frame; None if static, or if unknown."""
        motion = self._watch.motion
        if motion is None or self._reduction.factor == 1:
            return motion
        return motion.scaled(self._reduction.whole_from_reduced)

    def plane_view(self, still: PlaneView) -> PlaneView | None:
        """Return the view's homography; None while unknown.

        Parameters
        ----------
        still
            That of the first frame.
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

        Tested are one frame in `TEST_EVERY`, frames with a large apparent motion, and every frame
        once the camera has moved. With too few samples, as on a table without texture, nothing
        changes. A frame of another size restarts the test.

        Parameters
        ----------
        grey
            (H, W) Its grey levels.
        hand
            Region of a followed hand in the previous frame: excluded.
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
    """The test for images of one size, not above `LARGEST_PX`.

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
        self._is_doubted = False
        self._whole_px = 1.0

    @property
    def is_adrift(self) -> bool:
        """Whether the camera has moved or was disconnected, and its homography is unknown."""
        return self._is_doubted or (self.motion is None and self.moved_px > ADRIFT_PX)

    def doubt(self) -> None:
        """As `ReferenceWatch.doubt`, unless the first image has too little texture to end it."""
        if self._has_begun:
            samples, _ = self._samples(self._corners_px, ~self._is_hand)
            self._is_doubted = len(samples) >= MIN_SAMPLES

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
        """Find the corners of the first image, those of reference points first."""
        self._has_begun, self._halves = True, _halves(grey)
        self._first = _halved(grey, self._halves).copy()
        self._whole_px = grey.shape[1] / self._first.shape[1]
        self._frames, self._apparent_motion_px = 0, INITIAL_APPARENT_MOTION_PX
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
        """Set the camera to static."""
        self.moved_px, self.motion, self._is_doubted = 0.0, None, False
        self._now_from_first, self._further = np.eye(3), np.eye(3)

    def _forget(self, hand: Segment) -> None:
        """Exclude a hand that was present in the first image."""
        self._knows_hand = True
        self._is_hand = is_within(hand, self._whole(self._corners_px))
        self._registration.forget(hand)

    def _is_due(self, grey: _Picture) -> bool:
        """Whether a frame is to be tested."""
        if self.moved_px > 0.0 or self._is_doubted:
            return True
        apparent_motion_px = self._registration.apparent_motion_px(grey)
        is_unlike = (
            apparent_motion_px
            > APPARENT_MOTION_FACTOR * self._apparent_motion_px + APPARENT_MOTION_MARGIN_PX
        )
        is_its_turn = self._frames % TEST_EVERY == 0
        if is_its_turn:
            self._apparent_motion_px = apparent_motion_px
        return is_its_turn or is_unlike

    def _compare(self, grey: _Picture, hand: Segment | None) -> None:
        """Track the corners from the first image to this one, and decide by their samples."""
        if self.motion is not None:
            self._last_px = self._shown(self._corners_px, self._further @ self._now_from_first)
        now = _halved(grey, self._halves)
        # A reconnected camera may have another exposure, or the light may have changed.
        here_px, is_sure = self._followed(_relit(now, self._first) if self._is_doubted else now)
        is_sure &= ~self._is_hand
        if hand is not None:
            is_sure &= ~is_within(hand, self._whole(here_px))
        from_px, to_px = self._samples(here_px, is_sure)
        references = int(is_sure[: self._references].sum())
        least = MIN_SAMPLES if hand is None else MIN_SAMPLES_BESIDE_HAND
        is_sufficient = len(from_px) >= least or references >= MIN_REFERENCES
        if is_sufficient and _are_static(from_px, to_px):
            self._rest()
            return
        gone = self._estimated_step(from_px, to_px) if is_sufficient else None
        if self.moved_px == 0.0:
            return
        before = self._now_from_first
        if gone is not None and self.motion is None and self._is_static(grey, gone @ before, hand):
            self._rest()
            return
        guesses = [] if gone is None else [gone @ before]
        guesses += [self._further @ before, before]
        self._register(grey, hand, guesses, (from_px, to_px) if is_sufficient else None)

    def _is_static(self, grey: _Picture, guess: NDArray[np.float64], hand: Segment | None) -> bool:
        """Whether the plane is static and an object with many corners has moved."""
        return self._registration.is_static(grey, guess / guess[2, 2], hand)

    def _followed(self, now: _Picture) -> tuple[_Points, NDArray[np.bool_]]:
        """Return the corners' present positions, and which of them are reliable."""
        here_px, is_seen = _flow(self._first, now, self._corners_px, self._last_px)
        back_px, is_back = _flow(now, self._first, here_px, self._corners_px)
        returns = np.linalg.norm(back_px - self._corners_px, axis=1) < MAX_ROUND_TRIP_PX
        is_sure = is_seen & is_back & returns
        self._last_px = np.where(is_sure[:, None], here_px, self._last_px)
        return here_px, is_sure

    def _estimated_step(self, from_px: _Points, to_px: _Points) -> NDArray[np.float64] | None:
        """Return the similarity of the samples' motion since the last frame, if they agree."""
        import cv2

        away_px = float(np.median(np.linalg.norm(to_px - from_px, axis=1)))
        expected_px = self._shown(from_px, self._now_from_first)
        gone, agrees = cv2.estimateAffinePartial2D(
            expected_px,
            to_px,
            method=cv2.RANSAC,
            ransacReprojThreshold=max(INLIER_PX, INLIER_PART * away_px),
        )
        if gone is None or np.mean(agrees) < MIN_INLIER_SHARE:
            return None
        # Not by the reference points, which may lie far outside the image.
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
        samples: tuple[_Points, _Points] | None,
    ) -> None:
        """Register the plane from the first guess whose result agrees with the samples, if any."""
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
            is_backed = was_followed if samples is None else self._is_consistent(motion, *samples)
            if is_backed:
                self.motion, self.moved_px, self._is_doubted = motion, moved_px, False
                self._now_from_first = motion.now_from_first
                self._further = self._similarity_step(before) if was_followed else np.eye(3)
                return

    def _similarity_step(self, before: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the similarity of the corners' motion since the last frame."""
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
        """Return the mean motion of the corners [px of the full image]."""
        off_px = self._shown(self._corners_px, motion.now_from_first) - self._corners_px
        return self._whole_px * float(np.mean(np.linalg.norm(off_px, axis=1)))

    def _is_consistent(self, motion: PlaneMotion, from_px: _Points, to_px: _Points) -> bool:
        """Whether a motion agrees with most samples."""
        off_px = np.linalg.norm(self._shown(from_px, motion.now_from_first) - to_px, axis=1)
        return bool(np.mean(off_px < CONSISTENT_PX) >= MIN_CONSISTENT_SHARE)

    def _whole(self, half_px: _Points) -> NDArray[np.float64]:
        """Return points of the reduced image in pixels of the full one."""
        return np.asarray((half_px.astype(np.float64) + 0.5) * self._whole_px - 0.5)

    def _shown(self, from_px: _Points, now_from_first: NDArray[np.float64]) -> _Points:
        """Transfer points of the first image by a motion; both in pixels of the reduced image."""
        px = self._whole(from_px)
        px = px if self._lens is None else self._lens.undistort(px)
        y = np.column_stack([px, np.ones(len(px))]) @ now_from_first.T
        px = y[:, :2] / y[:, 2:]
        px = px if self._lens is None else self._lens.distort(px)
        return np.asarray((px + 0.5) / self._whole_px - 0.5, np.float32)

    def _sorted_into_cells(self) -> NDArray[np.intp]:
        """Return the indices of each cell's corners (C, N), without references; or -1."""
        cell = _cell_of(self._corners_px, self._first.shape)
        cell[: self._references] = -1
        corners = [np.flatnonzero(cell == c) for c in range(CELLS[0] * CELLS[1])]
        cells = np.full((len(corners), MAX_CORNERS_PER_CELL), -1, np.intp)
        for row, indices in zip(cells, corners, strict=True):
            row[: len(indices)] = indices
        return cells

    def _samples(self, here_px: _Points, is_sure: NDArray[np.bool_]) -> tuple[_Points, _Points]:
        """Return first and present positions (M, 2) of reference points, and of one corner a cell.

        A cell with at least `MIN_CORNERS` gives the corner nearest to its median motion.
        """
        counts = np.append(is_sure, False)[self._cells]
        moved_px = np.full((*counts.shape, 2), np.inf, np.float32)
        moved_px[counts] = (here_px - self._corners_px)[self._cells[counts]]
        number = counts.sum(axis=1)
        sufficient = np.flatnonzero(number >= MIN_CORNERS)
        moved_px, number = moved_px[sufficient], number[sufficient]
        ordered_px, rows = np.sort(moved_px, axis=1), np.arange(len(sufficient))
        low_px, high_px = ordered_px[rows, (number - 1) // 2], ordered_px[rows, number // 2]
        off_px = np.linalg.norm(moved_px - ((low_px + high_px) / 2)[:, None], axis=2)
        nearest = self._cells[sufficient, np.argmin(off_px, axis=1)]
        chosen = np.concatenate([np.flatnonzero(is_sure[: self._references]), nearest])
        return self._corners_px[chosen], here_px[chosen]


def _relit(now: _Picture, first: _Picture) -> _Picture:
    """Return an image with the mean and the contrast of the first one."""
    import cv2

    (mean, contrast), (first_mean, first_contrast) = (cv2.meanStdDev(one) for one in (now, first))
    gain = float(first_contrast[0, 0] / max(contrast[0, 0], 1.0))
    relit = cv2.convertScaleAbs(now, alpha=gain, beta=float(first_mean[0, 0] - gain * mean[0, 0]))
    return np.asarray(relit, np.uint8)


def _are_static(from_px: _Points, to_px: _Points) -> bool:
    """Whether most samples are static."""
    is_static = np.linalg.norm(to_px - from_px, axis=1) <= STATIC_PX
    return bool(np.mean(is_static) > MIN_STATIC_SHARE)


def _halves(grey: _Picture) -> list[_Picture]:
    """Allocate the pyramid of an image, down to a width of `MAX_WIDTH_PX`."""
    halves: list[_Picture] = []
    height, width = grey.shape
    while width > MAX_WIDTH_PX:
        height, width = max(height // 2, 1), width // 2
        halves.append(np.empty((height, width), np.uint8))
    return halves


def _halved(grey: _Picture, halves: list[_Picture]) -> _Picture:
    """Return the coarsest level of an image's pyramid, in the given arrays."""
    import cv2

    for half in halves:
        cv2.resize(grey, half.shape[::-1], dst=half, interpolation=cv2.INTER_AREA)
        grey = half
    return grey


def _corner_strength(picture: _Picture) -> NDArray[np.float32]:
    """Return the root of the smaller eigenvalue of the structure tensor (Shi & Tomasi 1994).

    A root mean square gradient [levels a pixel].
    """
    import cv2

    # OpenCV sums 9 squares of a Sobel filter, whose weights add up to 8, over 4 * 3 * 255.
    strength = cv2.cornerMinEigenVal(picture, 3)
    return np.asarray(np.sqrt(np.maximum(strength, 0.0)) * (4 * 3 * 255) / (3 * 8), np.float32)


def _strongest_corners(strength: NDArray[np.float32]) -> _Points:
    """Return the strongest corners of each cell of an image [px]."""
    import cv2

    about = np.ones((2 * MIN_CORNER_DISTANCE_PX + 1,) * 2, np.uint8)
    is_corner = (strength >= MIN_CORNER_STRENGTH) & (strength == cv2.dilate(strength, about))
    row, column = np.nonzero(is_corner)
    order = np.argsort(-strength[row, column], kind="stable")
    corners = np.stack([column, row], axis=1)[order].astype(np.float32)
    cell = _cell_of(corners, strength.shape)
    best = [np.flatnonzero(cell == c)[:MAX_CORNERS_PER_CELL] for c in range(CELLS[0] * CELLS[1])]
    return corners[np.concatenate(best)]


def _cell_of(corners_px: _Points, shape: tuple[int, ...]) -> NDArray[np.intp]:
    """Return the cell of each corner."""
    column, row = np.clip(corners_px / np.array(shape[::-1]) * CELLS, 0, np.array(CELLS) - 1).T
    return np.asarray(column.astype(int) + CELLS[0] * row.astype(int), np.intp)


def _corners_near(points_px: NDArray[np.float64], strength: NDArray[np.float32]) -> _Points:
    """Return the strongest corners near given points, for points that have one [px]."""
    size_px = np.array(strength.shape[::-1])
    in_picture = ((points_px >= 0.0) & (points_px <= size_px - 1)).all(axis=1)
    corners = []
    for u, v in np.round(points_px[in_picture]).astype(int):
        left, top = max(u - NEAR_PX, 0), max(v - NEAR_PX, 0)
        about = strength[top : v + NEAR_PX + 1, left : u + NEAR_PX + 1]
        if float(about.max()) >= MIN_CORNER_STRENGTH:
            row, column = np.unravel_index(int(np.argmax(about)), about.shape)
            corners.append((left + column, top + row))
    return np.array(corners, np.float32).reshape(-1, 2)


def _flow(
    before: _Picture, after: _Picture, corners_px: _Points, guess_px: _Points
) -> tuple[_Points, NDArray[np.bool_]]:
    """Track corners from one image to another; return positions and which were found."""
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
