"""Direct registration of the working plane in the images of a moving camera.

The region of the first image about its reference points is aligned with the present image by a
homography: iterated least squares on grey levels over the eight parameters, with the gradients of
the first image (inverse compositional: Baker & Matthews 2004), from reduced pyramid levels, which
determine a similarity, to the full resolution. The pixels are in small squares: some spread over
the whole image, however weak their gradients, and the strongest ones besides, which may be of an
object or a shadow. Each square has a free gain and offset, for the soft shadow of a hand crosses
most of them. Tukey's biweight rejects occluders, and a square that is often an outlier loses
weight: an object off the plane soon moves relative to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerpost.homography import transfer_jacobian_by_entries, transfer_to_image
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

GAIN_SIGMA = 0.3
MAX_GAIN = 0.5
"""Standard deviation of the relative change of a square's gain, and its greatest value: a plain
area in place of an edge fits with a change of -1 and is not the plane."""

BIWEIGHT = 4.685
MIN_SCALE = 0.3
MAX_SCALE = 2.0
"""Tukey's constant, 95 % efficient for normal errors, and the range of the residual scale. A square
that is an inlier only at a larger scale is not the plane."""

MAX_ITERATIONS = 10
CONVERGENCE_PX = 0.03
COARSE_CONVERGENCE_PX = 0.4
MIN_DETERMINANT = 0.1
"""Greatest number of iterations; greatest motion of a reference point in the last one, at full
resolution and at reduced levels; least determinant of a step, below which it nearly folds the
plane."""

NON_SIMILARITY = np.zeros((4, 8))
NON_SIMILARITY[(0, 0, 1, 1, 2, 3), (0, 4, 1, 3, 6, 7)] = 1.0, -1.0, 1.0, 1.0, 1.0, 1.0
NON_SIMILARITY_SIGMA_PX = 0.5
COARSE_NON_SIMILARITY_SIGMA_PX = 0.001
"""The four components of a homography's entries beside a similarity, and the standard deviations of
their change between two frames [px at half an image width from its centre], at full resolution and
at reduced levels. This prior keeps them where the image does not determine them."""

TRUST_RATE = 0.1
MIN_TRUST = 0.5
"""Rate of the running mean of a pixel's inlier indicator (its trust, 1 to 0), and the least trust
of a pixel that is expected to be an inlier."""

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
after a motion of the camera hardly any are, a moving arm leaves more."""

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
        px_from_scaled = np.linalg.inv(scaled_from_px)
        by_entries = np.kron(scaled_from_px, px_from_scaled.T)
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
        self._lens = lens
        height_px, width_px = first.shape
        # Accuracy is required at the reference points, clipped to the vicinity of the image.
        near_px = np.clip(references_px, -width_px, 2 * width_px)
        known_px = near_px if lens is None else lens.undistort(near_px)
        self._points_px = known_px[np.isfinite(known_px).all(axis=1)]
        self._px_from_unit = np.array(
            [[width_px / 2, 0, width_px / 2], [0, width_px / 2, height_px / 2], [0, 0, 1]]
        )
        self._unit_from_px = np.linalg.inv(self._px_from_unit)
        self._first = first.copy()
        self._plane, self._all = _about(first.shape, references_px), np.ones(first.shape, np.uint8)
        self._choose()

    def _choose(self) -> None:
        """Choose the pixels of the first image and its pyramid."""
        view = self._lens, self._unit_from_px
        self._levels = [
            _Level(picture, halvings, self._plane, *view)
            for halvings, picture in enumerate(_pyramid(self._first))
        ]
        self._static_test = _Level(self._first, 0, self._all, *view, only_spread=True)

    def apparent_motion_px(self, now: Picture) -> float:
        """Return the apparent motion of the plane, the median over its best pixels [px].

        A fast indicator: noise and occluders increase it as well.

        Parameters
        ----------
        now
            (H, W) Grey levels of an image of the first one's size.
        """
        return self._levels[0].apparent_motion_px(now)

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
        for mask in (self._plane, self._all):
            cv2.line(mask, (u, v), (x, y), 0, max(round(2 * radius_px), 1))
        self._choose()

    def is_static(self, now: Picture, guess: Array, hand: Segment | None = None) -> bool:
        """Whether the plane is static although something else moves.

        It is if squares that the motion would change are as in the first image: an arm, its load or
        the light has changed.

        Parameters
        ----------
        now
            (H, W) Grey levels of the present picture, of the size of the first.
        guess
            (3, 3) Homography of the apparent motion.
        hand
            Region of a hand in the present image, if known.
        """
        return self._static_test.is_static(_smooth(now), guess, hand)

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
        now_from_first, fit = guess, None
        # Accumulated step since the guess, in normalised units.
        gone = np.eye(3)
        for level, picture in reversed(list(zip(self._levels, _pyramid(now), strict=True))):
            smooth = _smooth(picture)
            for _ in range(MAX_ITERATIONS):
                fit = level.fit(smooth, now_from_first, gone / gone[2, 2], hand)
                if fit is None or np.linalg.det(fit.step) < MIN_DETERMINANT:
                    return None
                back = np.linalg.inv(fit.step)
                step, gone = self._px_from_unit @ back @ self._unit_from_px, gone @ back
                now_from_first = now_from_first @ step
                now_from_first = now_from_first / now_from_first[2, 2]
                if not np.isfinite(now_from_first).all():
                    return None
                if self._changes_px(step) < (
                    CONVERGENCE_PX if level is self._levels[0] else COARSE_CONVERGENCE_PX
                ):
                    break
            if fit is not None:
                level.learn(fit)
        return None if fit is None else self._judged(now_from_first, fit)

    def _changes_px(self, step: Array) -> float:
        """Return the greatest motion of a reference point by a step [px]."""
        off_px = transfer_to_image(step, self._points_px) - self._points_px
        return float(np.abs(off_px).max())

    def _judged(self, now_from_first: Array, fit: _Fit) -> PlaneMotion | None:
        """Return the motion with its covariance; None with too few inliers."""
        if fit.share < MIN_INLIER_INFORMATION or fit.count < MIN_INLIERS:
            return None
        # Each entry of the step is one of a product: now_from_first · N⁻¹ · step · N.
        by_step = np.kron(now_from_first @ self._px_from_unit, self._unit_from_px.T)[:, :8]
        motion = PlaneMotion(now_from_first, by_step @ fit.covariance @ by_step.T)
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
class _Fit:
    """One iteration.

    Attributes
    ----------
    step
        (3, 3) Homography of the step, in normalised units.
    covariance
        (8, 8) Covariance of its entries but the last, clustered: errors within a square correlate.
    weights
        (N,) Biweight of each pixel, 1 to 0; NaN where it is not visible.
    share, count
        Inliers among the expected pixels: their part of the information, and their number.
    """

    step: Array
    covariance: Array
    weights: Array
    share: float
    count: int


class _Level:
    """The chosen pixels of one level of the first image's pyramid."""

    def __init__(
        self,
        picture: Picture,
        halvings: int,
        plane: Picture,
        lens: Lens | None,
        unit_from_px: Array,
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
        # Of the difference of two smoothed images.
        self._noise_levels = _noise(picture) / np.sqrt(2.0 * np.pi) / BLUR_PX
        self._variances = NOISE_LEVELS**2 + (ALIGNED_PX / self._scale) ** 2 * (by_px**2).sum(1)
        self._information = (by_px**2).sum(axis=1) / self._variances
        self._jacobian = self._by_step(by_px, unit_from_px)
        self._trust = np.ones(len(self._levels))
        oblique_px = NON_SIMILARITY_SIGMA_PX if halvings == 0 else COARSE_NON_SIMILARITY_SIGMA_PX
        self._non_similarity_information = (
            NON_SIMILARITY.T @ NON_SIMILARITY / (unit_from_px[0, 0] * oblique_px) ** 2
        )
        better = np.argsort(-self._information, kind="stable")[: len(row) // 2]
        # A pixel without gradient has no information.
        some = better[self._information[better] > 0.0][::SUBSAMPLING]
        self._some = row[some], column[some]
        self._some_by_px = np.linalg.norm(by_px[some], axis=1)
        self._some_levels = picture[self._some].astype(np.int16)

    def _by_step(self, by_px: Array, unit_from_px: Array) -> Array:
        """Return the Jacobian (N, 8) of the levels by a step's entries but the last."""
        x, y = transfer_to_image(unit_from_px, self._places_px).T
        by_x, by_y = (by_px / unit_from_px[0, 0]).T
        radial = -(by_x * x + by_y * y)
        columns = [by_x * x, by_x * y, by_x, by_y * x, by_y * y, by_y, radial * x, radial * y]
        return np.column_stack(columns)

    def apparent_motion_px(self, now: Picture) -> float:
        """Return the median apparent motion of some pixels, less a common change of level."""
        if len(self._some_levels) == 0:
            return 0.0
        off = now[self._some] - self._some_levels
        return float(np.median(np.abs(off - np.median(off)) / self._some_by_px))

    def is_static(self, smooth: NDArray[np.float32], guess: Array, hand: Segment | None) -> bool:
        """Whether squares that a motion would change have not changed."""
        if len(self._levels) == 0:
            return False
        here, in_sight = self._seen(smooth, np.eye(3), hand)
        if in_sight.sum() < MIN_INLIERS:
            return False
        weights = in_sight / self._variances
        off_px = transfer_to_image(guess, self._places_px) - self._places_px
        expected = np.nan_to_num((self._by_px * off_px).sum(axis=1))
        left = here - _relit(self._levels, here, in_sight)
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

    def fit(
        self,
        smooth: NDArray[np.float32],
        now_from_first: Array,
        gone: Array,
        hand: Segment | None,
    ) -> _Fit | None:
        """Solve for the least-squares step; None where too few pixels are visible.

        `gone` is the accumulated step since the guess, in normalised units.
        """
        if len(self._levels) < MIN_INLIERS * self._scale:
            return None
        here, in_sight = self._seen(smooth, now_from_first, hand)
        expected = in_sight & (self._trust > MIN_TRUST)
        if expected.sum() < MIN_INLIERS * self._scale:
            return None
        columns = np.column_stack([self._jacobian, np.where(in_sight, here - self._levels, 0.0)])
        weights = in_sight * self._trust / self._variances
        left, gains = self._without_light(columns[:, 8:], weights)
        z = np.abs(left[:, 0]) / np.sqrt(self._variances)
        scale = max(1.4826 * float(np.median(z[expected])), MIN_SCALE)
        cut = BIWEIGHT * scale
        is_lit = np.abs(gains[:, 0]) < MAX_GAIN
        fits = np.where(in_sight & is_lit & (z < cut), (1.0 - (z / cut) ** 2) ** 2, 0.0)
        weights = weights * fits
        columns, _ = self._without_light(columns, weights)
        solved = self._solved(columns[:, :8], columns[:, 8], weights, gone)
        if solved is None:
            return None
        step = np.eye(3)
        step.ravel()[:8] += solved[0]
        is_like = is_lit & (z < BIWEIGHT * min(scale, MAX_SCALE))
        is_met = is_like[expected]
        information = self._information[expected]
        return _Fit(
            step,
            solved[1],
            np.where(in_sight, fits, np.nan),
            share=float(information @ is_met / information.sum()),
            count=int(is_met.sum()),
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
        in_sight = known if hand is None else known & ~is_within(hand, places_px)
        places_px = (places_px + 0.5) * self._scale - 0.5
        last_px = np.array(self._size_px) - 2.0
        in_sight &= ((places_px >= 1.0) & (places_px <= last_px)).all(axis=1)
        # OpenCV refuses sides of 32,768 and more.
        rows = np.where(in_sight[:, None], places_px, 0.0).astype(np.float32)
        rows = np.resize(rows, (-(-len(rows) // ROW), ROW, 2))
        here = cv2.remap(smooth, rows[..., 0].copy(), rows[..., 1].copy(), cv2.INTER_LINEAR)
        return np.asarray(here, np.float64).ravel()[: len(places_px)], in_sight

    def _centred(self, columns: Array, weights: Array) -> Array:
        """Return columns less their weighted mean in each square, transposed."""
        sums = self._sums(np.column_stack([weights, columns * weights[:, None]]))
        means = (sums[:, 1:] / (sums[:, :1] + np.finfo(float).tiny))[self._square_of]
        return np.asarray((columns - means).T)

    def _without_light(self, columns: Array, weights: Array) -> tuple[Array, Array]:
        """Eliminate each square's light, a gain and an offset; return the columns and the gains."""
        centred = self._centred(np.column_stack([self._levels, columns]), weights)
        level, about = centred[0], centred[1:].T
        both = np.column_stack([level, about]) * (weights * level)[:, None]
        sums = self._sums(both)
        gains = sums[:, 1:] / (sums[:, :1] + 1.0 / GAIN_SIGMA**2)
        gains = gains[self._square_of]
        return np.asarray(about - level[:, None] * gains), np.asarray(gains)

    def _solved(
        self, jacobian: Array, off: Array, weights: Array, gone: Array
    ) -> tuple[Array, Array] | None:
        """Return the least-squares solution and its covariance; None without any weight.

        A prior pulls the accumulated step back to a similarity.
        """
        weighted = jacobian * weights[:, None]
        normal = weighted.T @ jacobian + self._non_similarity_information
        scale = np.sqrt(np.diag(normal))
        if not (scale > 0.0).all():
            return None
        scales = np.outer(scale, scale)
        inverse = np.linalg.pinv(normal / scales, rcond=1e-9, hermitian=True) / scales
        solution = inverse @ (
            weighted.T @ off + self._non_similarity_information @ (gone - np.eye(3)).ravel()[:8]
        )
        scores = self._sums(weighted * (off - jacobian @ solution)[:, None])
        return solution, inverse @ (scores.T @ scores + self._non_similarity_information) @ inverse

    def _sums(self, columns: Array) -> Array:
        """Return the sums over the pixels of each square."""
        return np.asarray(np.add.reduceat(columns, self._square_starts, axis=0))

    def learn(self, fit: _Fit) -> None:
        """Update the trust of the visible pixels by whether they are inliers."""
        seen = np.isfinite(fit.weights)
        self._trust[seen] += TRUST_RATE * ((fit.weights[seen] > 0.0) - self._trust[seen])


def _noise(picture: Picture) -> float:
    """Estimate the standard deviation of an image's noise (Immerkær 1996, by the median)."""
    import cv2

    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32) / 6.0
    return float(1.4826 * np.median(np.abs(cv2.filter2D(picture, cv2.CV_32F, kernel))))


def _relit(levels: Array, here: Array, in_sight: Mask) -> Array:
    """Return levels mapped by the gain and offset of most of their present values."""
    counts = in_sight
    for _ in range(LIGHT_ITERATIONS):
        gain, offset = np.polyfit(levels[counts], here[counts], 1)
        off = np.abs(here - gain * levels - offset)
        counts = in_sight & (off <= 2.0 * np.median(off[in_sight]))
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


def _smooth(picture: Picture) -> NDArray[np.float32]:
    import cv2

    return np.asarray(cv2.GaussianBlur(picture, (0, 0), BLUR_PX), np.float32)
