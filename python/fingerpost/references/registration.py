"""Where the working plane has moved in the picture of a camera that moves.

What the first picture shows about its reference points is brought to lie on the present picture by
a homography, directly by its levels: iterated least squares over the eight parameters with the
gradients of the first picture (inverse compositional: Baker & Matthews 2004), from halved pictures,
which tell a shift, a turn and a scale, to whole ones. Squares from all over the picture take part,
however faint, and the strongest ones besides, which may be a mug's or a shadow's. Of every small
square the light is free, a gain and an offset, for the soft shadow of a hand crosses most of them.
Biweights leave out what covers the plane, and squares that seldom fit count ever less: what was no
plane in the first picture is soon gone from its place.
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
"""A part of a picture: what lies no further from a segment between two ends (2,) than a radius
[px]."""

WIDEST_PX = 320
"""The coarsest pictures are halved until they are no wider."""

BLUR_PX = 1.0
"""Sigma of the smoothing, without which a shift by part of a pixel changes what noise does."""

ABOUT = 1.6
"""The outline of the reference points, this many times as large, is what is taken for plane."""

MOST_PX = 1e4
"""Outlines are drawn no further than this from the picture."""

SQUARE_PX = 8
MOST_PIXELS = 6000
LEAST_GRADIENT = 3.0
"""Squares of this side count whose gradients are the strongest, so many pixels at most and from
this root mean square [levels a pixel] on, and those that are spread over the plane. Every other
pixel of each does, the flat ones beside an edge too: without them a shift and a change of the light
are the same."""

NOISE_LEVELS = 3.0
ALIGNED_PX = 0.15
"""What pixels are off by where they fit: levels of noise, and pixels along their gradient."""

GAIN_SIGMA = 0.3
MOST_GAIN = 0.5
"""How much the light of a square may differ, as a part, and how much at most: what is plain now
where there was an edge fits with a gain of -1, and is not the plane."""

BIWEIGHT = 4.685
LEAST_SCALE = 0.3
MOST_SCALE = 2.0
"""Tukey's constant, 95 % efficient for normal errors, and the least scale that it is taken with.
What fits only by a larger scale than the most is not the plane."""

MOST_ITERATIONS = 10
CONVERGED_PX = 0.03
CLOSE_PX = 0.4
LEAST_DETERMINANT = 0.1
"""Iterations at most, and until no reference point moves further, or further in the halved
pictures; a step that nearly folds the plane is none."""

OBLIQUE = np.zeros((4, 8))
OBLIQUE[(0, 0, 1, 1, 2, 3), (0, 4, 1, 3, 6, 7)] = 1.0, -1.0, 1.0, 1.0, 1.0, 1.0
OBLIQUE_PX = 0.5
HALVED_OBLIQUE_PX = 0.001
"""What the entries of a homography are but a shift, a turn and a change of scale, and how much of
that comes about from one look to the next [px, half a picture's width from its middle]. Where too
little is seen to tell there is hardly any; halved pictures, which tell about where the plane is, do
not tell it."""

LEARNED_PART = 0.1
LEAST_TRUST = 0.5
"""How much one picture changes what a pixel counts for, from 1 to 0, and what it must count for to
be expected to fit."""

LEAST_SHARE = 0.5
LEAST_PIXELS = 150
"""What must fit of the pixels that are expected to: which part of all that they tell, and how many.
"""

MOST_SIGMA_PX = 2.0
"""A plane whose reference points are known no better is not known."""

SPREAD_PX = 40
SPREAD_GRADIENT = 1.0
"""Spread squares are the best ones of each larger square of this side, from this root mean square
gradient on. They alone tell whether the plane has moved at all: most are of the table, whatever
stands on it."""

FITS_PART = 0.25
SURE = 3.0
NOISE_FLOOR = 0.3
LEAST_GAIN = 0.3
LIGHT_ITERATIONS = 3
STANDS_SHARE = 0.15
LEAST_TOLD = 8
"""A square tells of a motion that would change it by so many times as much as noise may. It has not
moved if it has changed by no more than this part of that, and by what noise may, which is so many
times what is expected of it, and still has this part of its contrast. Where a camera has moved
hardly any squares have not; an arm leaves more than this share. So many squares must tell."""

ROW = 64
"""Pixels are looked up in rows of so many."""

SOME = 5
"""One pixel in so many of the better half tells whether a picture is unlike the first one."""


@dataclass(frozen=True, eq=False)
class PlaneMotion:
    """How a camera has moved the working plane in its picture.

    Attributes
    ----------
    now_from_first
        (3, 3) Homography from where the pinhole showed a point of the plane in the first picture
        to where it shows it now [px].
    covariance
        (9, 9) Covariance of its entries, row by row.
    """

    now_from_first: Array
    covariance: Array

    def scaled(self, scaled_from_px: Array) -> PlaneMotion:
        """Return the motion as pictures of another size show it.

        Parameters
        ----------
        scaled_from_px
            (3, 3) What takes pixels to theirs.
        """
        px_from_scaled = np.linalg.inv(scaled_from_px)
        by_entries = np.kron(scaled_from_px, px_from_scaled.T)
        now_from_first = scaled_from_px @ self.now_from_first @ px_from_scaled
        return PlaneMotion(now_from_first, by_entries @ self.covariance @ by_entries.T)


class PlaneRegistration:
    """Brings the working plane of the first picture to lie on those of later ones.

    Parameters
    ----------
    first
        (H, W) Grey levels of the first picture.
    reference_points_px
        (N, 2) Where it shows the reference points, or where they lie beside it [px].
    lens
        The view's distortion, if it is known.
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
        # Where points are to be known: no further off than that matters to what is in sight.
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
        """Choose what counts of the first picture and its halves."""
        view = self._lens, self._unit_from_px
        self._levels = [
            _Level(picture, halvings, self._plane, *view)
            for halvings, picture in enumerate(_pyramid(self._first))
        ]
        self._jury = _Level(self._first, 0, self._all, *view, only_spread=True)

    def unlike_px(self, now: Picture) -> float:
        """Return by how much the plane seems to have moved, as a median of its best pixels [px].

        A sign that it has, quick to tell: noise and what covers the plane seem to move it too.

        Parameters
        ----------
        now
            (H, W) Grey levels of a picture of the size of the first.
        """
        return self._levels[0].unlike_px(now)

    def forget(self, hand: Segment) -> None:
        """Take what a part of the first picture shows for no plane.

        Parameters
        ----------
        hand
            Where the hand was in it.
        """
        import cv2

        end_px, other_px, radius_px = hand
        (u, v), (x, y) = np.round([end_px, other_px]).astype(int).tolist()
        for mask in (self._plane, self._all):
            cv2.line(mask, (u, v), (x, y), 0, max(round(2 * radius_px), 1))
        self._choose()

    def stands(self, now: Picture, guess: Array, hand: Segment | None = None) -> bool:
        """Tell whether the plane has not moved, though something has.

        Parts of the picture that would look different, had the camera moved so, look as in the
        first picture: it is an arm that moves, or what it carries, or the light.

        Parameters
        ----------
        now
            (H, W) Grey levels of the present picture, of the size of the first.
        guess
            (3, 3) The homography by which it seems to have moved.
        hand
            Where a hand covers the plane now, if that is known.
        """
        return self._jury.stands(_smooth(now), guess, hand)

    def align(self, now: Picture, guess: Array, hand: Segment | None = None) -> PlaneMotion | None:
        """Tell where the plane is now; None where too little of it is seen to tell.

        Parameters
        ----------
        now
            (H, W) Grey levels of the present picture, of the size of the first.
        guess
            (3, 3) The homography to begin with, right to some pixels.
        hand
            Where a hand covers the plane now, if that is known.
        """
        now_from_first, fit = guess, None
        # How far it has gone from there, in units.
        gone = np.eye(3)
        for level, picture in reversed(list(zip(self._levels, _pyramid(now), strict=True))):
            smooth = _smooth(picture)
            for _ in range(MOST_ITERATIONS):
                fit = level.fit(smooth, now_from_first, gone / gone[2, 2], hand)
                if fit is None or np.linalg.det(fit.step) < LEAST_DETERMINANT:
                    return None
                back = np.linalg.inv(fit.step)
                step, gone = self._px_from_unit @ back @ self._unit_from_px, gone @ back
                now_from_first = now_from_first @ step
                now_from_first = now_from_first / now_from_first[2, 2]
                if not np.isfinite(now_from_first).all():
                    return None
                if self._changes_px(step) < (
                    CONVERGED_PX if level is self._levels[0] else CLOSE_PX
                ):
                    break
            if fit is not None:
                level.learn(fit)
        return None if fit is None else self._judged(now_from_first, fit)

    def _changes_px(self, step: Array) -> float:
        """Return how far a step moves the point that it moves most [px]."""
        off_px = transfer_to_image(step, self._points_px) - self._points_px
        return float(np.abs(off_px).max())

    def _judged(self, now_from_first: Array, fit: _Fit) -> PlaneMotion | None:
        """Return the motion with its covariance, if enough of the plane fits it."""
        if fit.share < LEAST_SHARE or fit.count < LEAST_PIXELS:
            return None
        # Each entry of the step is one of a product: now_from_first · N⁻¹ · step · N.
        by_step = np.kron(now_from_first @ self._px_from_unit, self._unit_from_px.T)[:, :8]
        motion = PlaneMotion(now_from_first, by_step @ fit.covariance @ by_step.T)
        return motion if self._sigma_px(motion) < MOST_SIGMA_PX else None

    def _sigma_px(self, motion: PlaneMotion) -> float:
        """Return the largest standard deviation of a point that has moved so [px]."""
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
        (3, 3) The homography, in units, that the first picture has yet to be moved by.
    covariance
        (8, 8) Covariance of its entries but the last: pixels of a square err together.
    weights
        (N,) What each pixel fits, from 1 to 0; NaN where it is not in sight.
    share, count
        What fits of the pixels that are expected to: the part of all that they tell, the number.
    """

    step: Array
    covariance: Array
    weights: Array
    share: float
    count: int


class _Level:
    """The pixels of one picture of the pyramid that are brought to lie on the present one."""

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
        # Of the difference of two smoothed pictures.
        self._noise_levels = _noise(picture) / np.sqrt(2.0 * np.pi) / BLUR_PX
        self._variances = NOISE_LEVELS**2 + (ALIGNED_PX / self._scale) ** 2 * (by_px**2).sum(1)
        self._information = (by_px**2).sum(axis=1) / self._variances
        self._jacobian = self._by_step(by_px, unit_from_px)
        self._trust = np.ones(len(self._levels))
        oblique_px = OBLIQUE_PX if halvings == 0 else HALVED_OBLIQUE_PX
        self._oblique = OBLIQUE.T @ OBLIQUE / (unit_from_px[0, 0] * oblique_px) ** 2
        better = np.argsort(-self._information, kind="stable")[: len(row) // 2]
        # A level that no motion changes tells of none.
        some = better[self._information[better] > 0.0][::SOME]
        self._some = row[some], column[some]
        self._some_by_px = np.linalg.norm(by_px[some], axis=1)
        self._some_levels = picture[self._some].astype(np.int16)

    def _by_step(self, by_px: Array, unit_from_px: Array) -> Array:
        """Return how each level changes with the entries of a step but the last, (N, 8)."""
        x, y = transfer_to_image(unit_from_px, self._places_px).T
        by_x, by_y = (by_px / unit_from_px[0, 0]).T
        radial = -(by_x * x + by_y * y)
        columns = [by_x * x, by_x * y, by_x, by_y * x, by_y * y, by_y, radial * x, radial * y]
        return np.column_stack(columns)

    def unlike_px(self, now: Picture) -> float:
        """Return the median by which some pixels seem to have moved, but for the light."""
        if len(self._some_levels) == 0:
            return 0.0
        off = now[self._some] - self._some_levels
        return float(np.median(np.abs(off - np.median(off)) / self._some_by_px))

    def stands(self, smooth: NDArray[np.float32], guess: Array, hand: Segment | None) -> bool:
        """Tell whether squares that a motion would change have not changed."""
        if len(self._levels) == 0:
            return False
        here, in_sight = self._seen(smooth, np.eye(3), hand)
        if in_sight.sum() < LEAST_PIXELS:
            return False
        weights = in_sight / self._variances
        off_px = transfer_to_image(guess, self._places_px) - self._places_px
        expected = np.nan_to_num((self._by_px * off_px).sum(axis=1))
        left = here - _lit(self._levels, here, in_sight)
        level, now = self._centred(np.column_stack([self._levels, here]), weights)
        shown = self._sums(weights * level**2)
        # What is far away from where it was differs by no more than two places do.
        told = np.minimum(self._sums(weights * expected**2), shown)
        noise = SURE * (self._noise_levels**2 * self._sums(weights) + NOISE_FLOOR)
        # A light in which most squares are plain may be that of none.
        is_lit = self._sums(weights * level * now) > LEAST_GAIN * shown
        stays = is_lit & (self._sums(weights * left**2) < FITS_PART * told + noise)
        tells = told > SURE * noise
        return bool(tells.sum() >= LEAST_TOLD and stays[tells].mean() > STANDS_SHARE)

    def fit(
        self,
        smooth: NDArray[np.float32],
        now_from_first: Array,
        gone: Array,
        hand: Segment | None,
    ) -> _Fit | None:
        """Solve for the step that brings the levels nearest; None where too few are in sight.

        `gone` is the homography, in units, by which earlier steps have left the guess.
        """
        if len(self._levels) < LEAST_PIXELS * self._scale:
            return None
        here, in_sight = self._seen(smooth, now_from_first, hand)
        expected = in_sight & (self._trust > LEAST_TRUST)
        if expected.sum() < LEAST_PIXELS * self._scale:
            return None
        columns = np.column_stack([self._jacobian, np.where(in_sight, here - self._levels, 0.0)])
        weights = in_sight * self._trust / self._variances
        left, gains = self._unlit(columns[:, 8:], weights)
        z = np.abs(left[:, 0]) / np.sqrt(self._variances)
        scale = max(1.4826 * float(np.median(z[expected])), LEAST_SCALE)
        cut = BIWEIGHT * scale
        is_lit = np.abs(gains[:, 0]) < MOST_GAIN
        fits = np.where(in_sight & is_lit & (z < cut), (1.0 - (z / cut) ** 2) ** 2, 0.0)
        weights = weights * fits
        columns, _ = self._unlit(columns, weights)
        solved = self._solved(columns[:, :8], columns[:, 8], weights, gone)
        if solved is None:
            return None
        step = np.eye(3)
        step.ravel()[:8] += solved[0]
        is_like = is_lit & (z < BIWEIGHT * min(scale, MOST_SCALE))
        is_met = is_like[expected]
        told = self._information[expected]
        return _Fit(
            step,
            solved[1],
            np.where(in_sight, fits, np.nan),
            share=float(told @ is_met / told.sum()),
            count=int(is_met.sum()),
        )

    def _seen(
        self, smooth: NDArray[np.float32], now_from_first: Array, hand: Segment | None
    ) -> tuple[Array, Mask]:
        """Return the levels where the pixels are now, and which of them are in sight."""
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
        # OpenCV takes no side of 32,768 and more.
        rows = np.where(in_sight[:, None], places_px, 0.0).astype(np.float32)
        rows = np.resize(rows, (-(-len(rows) // ROW), ROW, 2))
        here = cv2.remap(smooth, rows[..., 0].copy(), rows[..., 1].copy(), cv2.INTER_LINEAR)
        return np.asarray(here, np.float64).ravel()[: len(places_px)], in_sight

    def _centred(self, columns: Array, weights: Array) -> Array:
        """Return columns less their mean in each square, one after the other."""
        sums = self._sums(np.column_stack([weights, columns * weights[:, None]]))
        means = (sums[:, 1:] / (sums[:, :1] + np.finfo(float).tiny))[self._square_of]
        return np.asarray((columns - means).T)

    def _unlit(self, columns: Array, weights: Array) -> tuple[Array, Array]:
        """Return columns without what the light of each square explains, and the gains in that.

        The light is a gain and an offset.
        """
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
        """Return the least-squares solution and its covariance; None if nothing weighs.

        It leads back from where earlier steps have gone obliquely, unless pixels are against that.
        """
        weighted = jacobian * weights[:, None]
        normal = weighted.T @ jacobian + self._oblique
        scale = np.sqrt(np.diag(normal))
        if not (scale > 0.0).all():
            return None
        scales = np.outer(scale, scale)
        inverse = np.linalg.pinv(normal / scales, rcond=1e-9, hermitian=True) / scales
        solution = inverse @ (weighted.T @ off + self._oblique @ (gone - np.eye(3)).ravel()[:8])
        scores = self._sums(weighted * (off - jacobian @ solution)[:, None])
        return solution, inverse @ (scores.T @ scores + self._oblique) @ inverse

    def _sums(self, columns: Array) -> Array:
        """Return the sums over the pixels of each square."""
        return np.asarray(np.add.reduceat(columns, self._square_starts, axis=0))

    def learn(self, fit: _Fit) -> None:
        """Have pixels that have not fitted count less, and those that have count more."""
        seen = np.isfinite(fit.weights)
        self._trust[seen] += LEARNED_PART * ((fit.weights[seen] > 0.0) - self._trust[seen])


def _noise(picture: Picture) -> float:
    """Return about the standard deviation of a picture's noise (Immerkær 1996, by the median)."""
    import cv2

    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32) / 6.0
    return float(1.4826 * np.median(np.abs(cv2.filter2D(picture, cv2.CV_32F, kernel))))


def _lit(levels: Array, here: Array, in_sight: Mask) -> Array:
    """Return levels in the light of what most of them are now: a gain and an offset."""
    counts = in_sight
    for _ in range(LIGHT_ITERATIONS):
        gain, offset = np.polyfit(levels[counts], here[counts], 1)
        off = np.abs(here - gain * levels - offset)
        counts = in_sight & (off <= 2.0 * np.median(off[in_sight]))
    return np.asarray(gain * levels + offset)


def is_within(part: Segment, points_px: Array) -> Mask:
    """Tell which points (N, 2) lie in a part of a picture."""
    end, other, radius_px = part
    along = other - end
    share = (points_px - end) @ along / np.maximum(along @ along, np.finfo(float).tiny)
    off_px = points_px - end - np.clip(share, 0.0, 1.0)[:, None] * along
    return np.asarray((off_px**2).sum(axis=1) <= radius_px**2)


def _about(shape: tuple[int, ...], references_px: Array) -> Picture:
    """Return where a picture shows the plane: about the reference points."""
    import cv2

    points_px = np.clip(references_px, -MOST_PX, MOST_PX)
    points_px = points_px.mean(axis=0) + ABOUT * (points_px - points_px.mean(axis=0))
    outline_px = cv2.convexHull(points_px.astype(np.float32))
    plane = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(plane, np.round(outline_px).astype(np.int32), 1)
    return plane


def _chosen(
    strength: NDArray[np.float32], mask: Mask, only_spread: bool
) -> tuple[NDArray[np.intp], ...]:
    """Return columns and rows of the pixels that count, and the square of each, in order."""
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
    """Return the squares with the strongest gradients, as many as there may be."""
    best = np.argsort(-energy.ravel(), kind="stable")[: 2 * MOST_PIXELS // SQUARE_PX**2]
    return best[energy.ravel()[best] >= LEAST_GRADIENT**2]


def _spread(energy: NDArray[np.float32]) -> NDArray[np.intp]:
    """Return the best square of each larger one."""
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
    """Return a picture and its halves, down to one that is no wider than `WIDEST_PX`."""
    import cv2

    pictures = [picture]
    while pictures[-1].shape[1] > WIDEST_PX and pictures[-1].shape[0] > 1:
        height, width = pictures[-1].shape
        half = cv2.resize(pictures[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        pictures.append(np.asarray(half, np.uint8))
    return pictures


def _smooth(picture: Picture) -> NDArray[np.float32]:
    import cv2

    return np.asarray(cv2.GaussianBlur(picture, (0, 0), BLUR_PX), np.float32)
