"""Direct registration of the working plane in the images of a moving camera.

The region of the first image about its reference points is aligned with the present image by a
homography, from reduced pyramid levels, which determine a similarity, to the full resolution; the
core iterates (`fingerpost._core.PlaneRegistration`). The pixels are in small squares: some spread
over the whole image, however weak their gradients, and the strongest ones besides, which may be of
an object or a shadow. A square that is often an outlier loses weight: an object off the plane soon
moves relative to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fingerpost._core import PlaneLevel, RegisteredPlane
from fingerpost._core import PlaneRegistration as CoreRegistration
from fingerpost.homography import (
    kronecker_product,
    transfer_jacobian_by_entries,
    transfer_to_image,
)
from fingerpost.lens import Lens

Picture = NDArray[np.uint8]
Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Segment = tuple[Array, Array, float]
"""Image region: the points within a radius of the segment between two ends (2,) [px]."""

MAX_COARSE_WIDTH_PX = 320
"""Greatest width of the coarsest pyramid level."""

BLUR_PX = 1.0
"""Sigma of the smoothing, without which interpolation changes the noise at subpixel shifts."""

PLANE_OUTLINE_SCALE = 1.6
"""Scale of the reference points' convex hull about their mean that gives the plane's region."""

MAX_OUTLINE_PX = 1e4
"""Greatest coordinate of a drawn outline."""

SQUARE_PX = 8
MAX_PIXELS = 6000
MIN_GRADIENT = 3.0
"""Side of a square, greatest number of pixels in the strongest squares, and their least root mean
square gradient [levels a pixel]. Every other pixel of a square is used, flat ones beside an edge
included: without them a shift and a change of the light are indistinguishable."""

NOISE_LEVELS = 3.0
ALIGNED_PX = 0.15
"""Standard deviations of an inlier's residual: noise [levels], and position along the gradient."""

NON_SIMILARITY_SIGMA_PX = 0.5
COARSE_NON_SIMILARITY_SIGMA_PX = 0.001
"""Standard deviations of the change between two frames of what a homography has beside a similarity
[px at half an image width from its centre], at full resolution and at reduced levels. This prior
keeps its four components where the image does not determine them."""

MIN_INLIER_INFORMATION = 0.5
MIN_INLIERS = 150
"""Least part of the information of the expected pixels that inliers have, and least number of
inliers."""

MAX_SIGMA_PX = 2.0
"""Greatest standard deviation of a reference point for which the motion counts."""

SPREAD_PX = 40
SPREAD_GRADIENT = 1.0
"""Spread squares are the strongest of each larger square of this side, with at least this root mean
square gradient. They alone decide whether the plane has moved at all: most are of the table,
whatever objects are on it."""

MAX_UNCHANGED_PART = 0.25
NOISE_FACTOR = 3.0
NOISE_FLOOR = 0.3
MIN_GAIN = 0.3
LIGHT_ITERATIONS = 3
MIN_STATIC_SHARE = 0.15
MIN_INFORMATIVE_SQUARES = 8
"""Test for a static plane. A square is informative if the motion would change it by more than
`NOISE_FACTOR` times its noise bound. It is static if its change is below `MAX_UNCHANGED_PART` of
that plus the bound, and it has kept `MIN_GAIN` of its contrast. The plane is static if at least
`MIN_INFORMATIVE_SQUARES` are informative and more than `MIN_STATIC_SHARE` of these are static:
after a motion of the camera hardly any are, a moving arm leaves more. It is not tested by fewer
than `MIN_INLIERS`."""

ROW = 64
"""Row length of the array of pixels passed to OpenCV."""

SUBSAMPLING = 5
"""Subsampling of the better half of the pixels for the apparent motion."""


@dataclass(frozen=True, eq=False)
class PlaneMotion:
    """Motion of the working plane in the image since the first frame.

    Attributes
    ----------
    now_from_first
        (3, 3) Homography from the ideal pixels of the first image to those of the present one [px].
    covariance
        (9, 9) Covariance of its entries, row by row.
    """

    now_from_first: Array
    covariance: Array

    def scaled(self, scaled_from_px: Array) -> PlaneMotion:
        """Return the motion in images of another size.

        Parameters
        ----------
        scaled_from_px
            (3, 3) Transform from present pixels to those of the other size.
        """
        px_from_scaled = np.asarray(np.linalg.inv(scaled_from_px), np.float64)
        by_entries = kronecker_product(scaled_from_px, px_from_scaled.T)
        now_from_first = scaled_from_px @ self.now_from_first @ px_from_scaled
        return PlaneMotion(now_from_first, by_entries @ self.covariance @ by_entries.T)


class PlaneRegistration:
    """Registers the working plane of the first image with later images.

    Parameters
    ----------
    first
        (H, W) Grey levels of the first image.
    reference_points_px
        (N, 2) Reference points in it, perhaps outside its borders [px].
    lens
        The view's distortion, if known.
    """

    def __init__(
        self,
        first: Picture,
        reference_points_px: Sequence[tuple[float, float]] | Array,
        lens: Lens | None = None,
    ) -> None:
        references_px = np.array(reference_points_px, np.float64).reshape(-1, 2)
        height_px, width_px = first.shape
        # Accuracy is required at the reference points, clipped to the vicinity of the image.
        near_px = np.clip(references_px, -width_px, 2 * width_px)
        known_px = near_px if lens is None else lens.undistort(near_px)
        self._points_px = known_px[np.isfinite(known_px).all(axis=1)]
        self._px_from_unit = np.array(
            [[width_px / 2, 0, width_px / 2], [0, width_px / 2, height_px / 2], [0, 0, 1]]
        )
        self._unit_from_px = np.linalg.inv(self._px_from_unit)
        self._chosen = _Chosen(
            first.copy(),
            _about(first.shape, references_px),
            np.ones(first.shape, np.uint8),
            lens,
            self._points_px,
            self._unit_from_px,
        )

    def apparent_motion_px(self, now: Picture) -> float:
        """Return the apparent motion of the plane, the median over its best pixels [px].

        A fast indicator: noise and occluders increase it as well.

        Parameters
        ----------
        now
            (H, W) Grey levels of an image of the first one's size.
        """
        return self._chosen.finest.apparent_motion_px(now)

    def forget(self, hand: Segment) -> None:
        """Exclude a region of the first image from the plane.

        Parameters
        ----------
        hand
            Region of the hand in it.
        """
        import cv2

        end_px, other_px, radius_px = hand
        (u, v), (x, y) = np.round([end_px, other_px]).astype(int).tolist()
        for mask in (self._chosen.plane, self._chosen.everything):
            cv2.line(mask, (u, v), (x, y), 0, max(round(2 * radius_px), 1))
        self._chosen = replace(self._chosen)  # pixels of the hand may have been chosen

    def is_static(self, now: Picture, guess: Array, hand: Segment | None = None) -> bool:
        """Whether the plane is static although something else moves.

        It is if squares that the motion would change are as in the first image: then an arm, its
        load or the light has changed.

        Parameters
        ----------
        now
            (H, W) Grey levels of the present picture, of the size of the first.
        guess
            (3, 3) Homography of the apparent motion.
        hand
            Region of a hand in the present image, if known.
        """
        return self._chosen.static_test.is_static(_smooth(now), guess, hand)

    def align(self, now: Picture, guess: Array, hand: Segment | None = None) -> PlaneMotion | None:
        """Register the present image; None where too little of the plane is visible.

        Parameters
        ----------
        now
            (H, W) Grey levels of the present picture, of the size of the first.
        guess
            (3, 3) Initial homography, accurate to a few pixels.
        hand
            Region of a hand in the present image, if known.
        """
        smooth = [_blurred(picture) for picture in _pyramid(now)]
        registered = self._chosen.registration.align(smooth, guess, hand)
        return None if registered is None else self._judged(registered)

    def _judged(self, registered: RegisteredPlane) -> PlaneMotion | None:
        """Return the motion with its covariance; None with too few inliers."""
        if registered.inlier_share < MIN_INLIER_INFORMATION or registered.inliers < MIN_INLIERS:
            return None
        now_from_first = registered.now_from_first
        # Each entry of the step is one of a product: now_from_first · N⁻¹ · step · N.
        now_from_unit = now_from_first @ self._px_from_unit
        by_step = kronecker_product(now_from_unit, self._unit_from_px.T)[:, :8]
        motion = PlaneMotion(now_from_first, by_step @ registered.step_covariance @ by_step.T)
        return motion if self._sigma_px(motion) < MAX_SIGMA_PX else None

    def _sigma_px(self, motion: PlaneMotion) -> float:
        """Return the greatest standard deviation of a transferred reference point [px]."""
        now_px = transfer_to_image(motion.now_from_first, self._points_px)
        if not np.isfinite(now_px).all():
            return np.inf
        by_entries = transfer_jacobian_by_entries(motion.now_from_first, self._points_px)
        covariances = by_entries @ motion.covariance @ np.swapaxes(by_entries, 1, 2)
        return float(np.sqrt(np.trace(covariances, axis1=1, axis2=2).max()))


@dataclass(frozen=True, eq=False)
class _Chosen:
    """The chosen pixels of the first image; each level is computed on first use.

    Whether the plane moves is tested in every frame, by the best pixels of the finest level; its
    motion is only estimated once it does.

    Attributes
    ----------
    first
        (H, W) Grey levels of the first image.
    plane, everything
        (H, W) Masks of the plane, and of all pixels that may show a motion of the camera; both
        without hands.
    lens, points_px, unit_from_px
        As in the registration.
    """

    first: Picture
    plane: Picture
    everything: Picture
    lens: Lens | None
    points_px: Array
    unit_from_px: Array

    @cached_property
    def finest(self) -> _Level:
        """The level at full resolution."""
        return _Level(self.first, 0, self.plane, self.lens)

    @cached_property
    def registration(self) -> CoreRegistration:
        """The core's registration of all levels."""
        reduced = enumerate(_pyramid(self.first)[1:], 1)
        others = [_Level(picture, k, self.plane, self.lens) for k, picture in reduced]
        levels = [level.in_core(self.unit_from_px) for level in (self.finest, *others)]
        return CoreRegistration(levels, self.points_px)

    @cached_property
    def static_test(self) -> _Level:
        """Pixels spread over the whole image."""
        return _Level(self.first, 0, self.everything, self.lens, only_spread=True)


class _Level:
    """The chosen pixels of one level of the first image's pyramid."""

    def __init__(
        self,
        picture: Picture,
        halvings: int,
        plane: Picture,
        lens: Lens | None,
        *,
        only_spread: bool = False,
    ) -> None:
        import cv2

        self._lens = lens
        self._size_px = picture.shape[::-1]
        self._scale = 0.5**halvings
        smooth = _smooth(picture)
        gradient = [cv2.Sobel(smooth, cv2.CV_32F, *axis, scale=1 / 8) for axis in ((1, 0), (0, 1))]
        mask = cv2.resize(plane, self._size_px, interpolation=cv2.INTER_NEAREST) > 0
        column, row, square = _chosen(np.hypot(*gradient), np.asarray(mask), only_spread)
        shown_px = (np.stack([column, row], axis=1) + 0.5) / self._scale - 0.5
        places_px = shown_px if lens is None else lens.undistort(shown_px)
        known = np.isfinite(places_px).all(axis=1)
        column, row, square = column[known], row[known], square[known]
        shown_px = shown_px[known]
        self._places_px = np.asarray(places_px[known], np.float64)
        self._square_of = np.unique(square, return_inverse=True)[1]
        self._square_starts = np.flatnonzero(np.diff(self._square_of, prepend=-1))
        self._levels = smooth[row, column].astype(np.float64)
        by_px = self._scale * np.stack([g[row, column] for g in gradient], axis=1).astype(float)
        if lens is not None:
            distort = np.linalg.inv(lens.undistort_jacobian(shown_px))
            by_px = (by_px[:, None] @ distort)[:, 0]
        self._by_px = by_px
        self._picture = picture
        self._variances = NOISE_LEVELS**2 + (ALIGNED_PX / self._scale) ** 2 * (by_px**2).sum(1)
        self._information = (by_px**2).sum(axis=1) / self._variances
        better = np.argsort(-self._information, kind="stable")[: len(row) // 2]
        # A pixel without gradient has no information.
        some = better[self._information[better] > 0.0][::SUBSAMPLING]
        self._some = row[some] * picture.shape[1] + column[some]
        self._some_by_px = np.linalg.norm(by_px[some], axis=1)
        self._some_levels = picture.ravel()[self._some].astype(np.int16)

    @cached_property
    def _noise_levels(self) -> float:
        """Standard deviation of the difference of two smoothed images."""
        return float(_noise(self._picture) / np.sqrt(2.0 * np.pi) / BLUR_PX)

    def in_core(self, unit_from_px: Array) -> PlaneLevel:
        """Return the pixels in the core's representation."""
        is_finest = self._scale == 1.0
        oblique_px = NON_SIMILARITY_SIGMA_PX if is_finest else COARSE_NON_SIMILARITY_SIGMA_PX
        return PlaneLevel(
            self._places_px,
            self._levels,
            self._by_px,
            self._variances,
            self._square_of.tolist(),
            scale=self._scale,
            non_similarity_sigma=unit_from_px[0, 0] * oblique_px,
            unit_from_px=unit_from_px,
            lens=None if self._lens is None else self._lens.radial,
        )

    def apparent_motion_px(self, now: Picture) -> float:
        """Return the median apparent motion of some pixels, less a common change of level."""
        if len(self._some_levels) == 0:
            return 0.0
        off = now.ravel()[self._some] - self._some_levels
        return float(np.median(np.abs(off - np.median(off)) / self._some_by_px))

    def is_static(self, smooth: NDArray[np.float32], guess: Array, hand: Segment | None) -> bool:
        """Whether squares that a motion would change have not changed."""
        if len(self._levels) == 0:
            return False
        here, visible = self._seen(smooth, np.eye(3), hand)
        if visible.sum() < MIN_INLIERS:
            return False
        weights = visible / self._variances
        off_px = transfer_to_image(guess, self._places_px) - self._places_px
        expected = np.nan_to_num((self._by_px * off_px).sum(axis=1))
        left = here - _relit(self._levels, here, visible)
        level, now = self._centred(np.column_stack([self._levels, here]), weights)
        shown = self._sums(weights * level**2)
        # The change by a large motion is bounded by the square's contrast.
        information = np.minimum(self._sums(weights * expected**2), shown)
        noise = NOISE_FACTOR * (self._noise_levels**2 * self._sums(weights) + NOISE_FLOOR)
        # With a gain near 0 the fitted light explains any square.
        is_lit = self._sums(weights * level * now) > MIN_GAIN * shown
        is_unchanged = is_lit & (
            self._sums(weights * left**2) < MAX_UNCHANGED_PART * information + noise
        )
        is_informative = information > NOISE_FACTOR * noise
        return bool(
            is_informative.sum() >= MIN_INFORMATIVE_SQUARES
            and is_unchanged[is_informative].mean() > MIN_STATIC_SHARE
        )

    def _seen(
        self, smooth: NDArray[np.float32], now_from_first: Array, hand: Segment | None
    ) -> tuple[Array, Mask]:
        """Return the levels at the pixels' present positions, and which of these are visible."""
        import cv2

        places_px = transfer_to_image(now_from_first, self._places_px)
        known = np.asarray(np.isfinite(places_px).all(axis=1))
        places_px = np.where(known[:, None], places_px, 0.0)
        if self._lens is not None:
            places_px = self._lens.distort(places_px)
            known &= np.isfinite(places_px).all(axis=1)
        visible = known if hand is None else known & ~is_within(hand, places_px)
        places_px = (places_px + 0.5) * self._scale - 0.5
        last_px = np.array(self._size_px) - 2.0
        visible &= ((places_px >= 1.0) & (places_px <= last_px)).all(axis=1)
        # OpenCV refuses sides of 32,768 and more.
        rows = np.where(visible[:, None], places_px, 0.0).astype(np.float32)
        rows = np.resize(rows, (-(-len(rows) // ROW), ROW, 2))
        here = cv2.remap(smooth, rows[..., 0].copy(), rows[..., 1].copy(), cv2.INTER_LINEAR)
        return np.asarray(here, np.float64).ravel()[: len(places_px)], visible

    def _centred(self, columns: Array, weights: Array) -> Array:
        """Return columns less their weighted mean in each square, transposed."""
        sums = self._sums(np.column_stack([weights, columns * weights[:, None]]))
        means = (sums[:, 1:] / (sums[:, :1] + np.finfo(float).tiny))[self._square_of]
        return np.asarray((columns - means).T)

    def _sums(self, columns: Array) -> Array:
        """Return the sums over the pixels of each square."""
        return np.asarray(np.add.reduceat(columns, self._square_starts, axis=0))


def _noise(picture: Picture) -> float:
    """Estimate the standard deviation of an image's noise (Immerkær 1996, by the median)."""
    import cv2

    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32) / 6.0
    return float(1.4826 * np.median(np.abs(cv2.filter2D(picture, cv2.CV_32F, kernel))))


def _relit(levels: Array, here: Array, visible: Mask) -> Array:
    """Return levels mapped by the gain and offset of most of their present values."""
    counts = visible
    for _ in range(LIGHT_ITERATIONS):
        gain, offset = np.polyfit(levels[counts], here[counts], 1)
        off = np.abs(here - gain * levels - offset)
        counts = visible & (off <= 2.0 * np.median(off[visible]))
    return np.asarray(gain * levels + offset)


def is_within(part: Segment, points_px: Array) -> Mask:
    """Return which points (N, 2) lie in an image region."""
    end, other, radius_px = part
    along = other - end
    share = (points_px - end) @ along / np.maximum(along @ along, np.finfo(float).tiny)
    off_px = points_px - end - np.clip(share, 0.0, 1.0)[:, None] * along
    return np.asarray((off_px**2).sum(axis=1) <= radius_px**2)


def _about(shape: tuple[int, ...], references_px: Array) -> Picture:
    """Return the mask of the plane: the scaled hull of the reference points."""
    import cv2

    points_px = np.clip(references_px, -MAX_OUTLINE_PX, MAX_OUTLINE_PX)
    points_px = points_px.mean(axis=0) + PLANE_OUTLINE_SCALE * (points_px - points_px.mean(axis=0))
    outline_px = cv2.convexHull(points_px.astype(np.float32))
    plane = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(plane, np.round(outline_px).astype(np.int32), 1)
    return plane


def _chosen(
    strength: NDArray[np.float32], mask: Mask, only_spread: bool
) -> tuple[NDArray[np.intp], ...]:
    """Return columns, rows and squares of the chosen pixels, ordered by square."""
    inside = np.zeros(strength.shape, np.bool_)
    inside[2:-2, 2:-2] = mask[2:-2, 2:-2]
    rows, columns = (size // SQUARE_PX for size in strength.shape)
    energy = np.where(inside, strength, 0.0)[: rows * SQUARE_PX, : columns * SQUARE_PX] ** 2
    energy = energy.reshape(rows, SQUARE_PX, columns, SQUARE_PX).mean(axis=(1, 3))
    square = np.sort(_spread(energy))
    if not only_spread:
        square = np.union1d(square, _strongest(energy))
    down, along = np.nonzero(np.indices((SQUARE_PX, SQUARE_PX)).sum(axis=0) % 2 == 0)
    row = (square[:, None] // max(columns, 1) * SQUARE_PX + down).ravel()
    column = (square[:, None] % max(columns, 1) * SQUARE_PX + along).ravel()
    counts = inside[row, column]
    return column[counts], row[counts], np.repeat(square, len(down))[counts]


def _strongest(energy: NDArray[np.float32]) -> NDArray[np.intp]:
    """Return the squares with the strongest gradients, at most `MAX_PIXELS` of pixels."""
    best = np.argsort(-energy.ravel(), kind="stable")[: 2 * MAX_PIXELS // SQUARE_PX**2]
    return best[energy.ravel()[best] >= MIN_GRADIENT**2]


def _spread(energy: NDArray[np.float32]) -> NDArray[np.intp]:
    """Return the strongest square of each larger one."""
    side = SPREAD_PX // SQUARE_PX
    number = np.arange(energy.size).reshape(energy.shape)
    best = []
    for row in range(0, energy.shape[0], side):
        for column in range(0, energy.shape[1], side):
            part = np.s_[row : row + side, column : column + side]
            k = int(np.argmax(energy[part]))
            if energy[part].flat[k] >= SPREAD_GRADIENT**2:
                best.append(number[part].flat[k])
    return np.array(best, np.intp)


def _pyramid(picture: Picture) -> list[Picture]:
    """Return the pyramid of an image, down to a width of `MAX_COARSE_WIDTH_PX`."""
    import cv2

    pictures = [picture]
    while pictures[-1].shape[1] > MAX_COARSE_WIDTH_PX and pictures[-1].shape[0] > 1:
        height, width = pictures[-1].shape
        half = cv2.resize(pictures[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        pictures.append(np.asarray(half, np.uint8))
    return pictures


def _blurred(picture: Picture) -> Picture:
    import cv2

    return np.asarray(cv2.GaussianBlur(picture, (0, 0), BLUR_PX), np.uint8)


def _smooth(picture: Picture) -> NDArray[np.float32]:
    return _blurred(picture).astype(np.float32)
