"""Detection of radial distortion by the straight sides between reference points.

A sheet, a mat or a screen has straight edges from corner to corner. Along each side the edge is
located across the chord; the radial distortion that makes all edges straightest (plumb lines:
Brown 1971) is the lens's, if it reduces the residuals sufficiently.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from fingerpost.config import LensParameters, View
from fingerpost.lens import Lens
from fingerpost.pointing import PlaneView
from fingerpost.references import Reduction

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

BENT_PX = 0.4
LEAST_BENT_PX = 0.2
"""Least root mean square curvature of the sides that is attributed to the lens [px], and that where
another view's lens bends its image. Edges of straight sides are 0.05 to 0.15 px off a line."""

TIMES_STRAIGHTER = 2.0
"""Least ratio of the residuals without and with the lens."""

LEFT_PART = 0.25
"""Part of the distortion that such a lens leaves."""

LEAST_SIDES = 2
LEAST_SIDE_PX = 60.0
LEAST_SHARE = 0.6
"""Least number of usable sides; least length of one, and least share of its points with an edge."""

_K1 = np.linspace(-1.0, 1.0, 101)
_PLACES = np.linspace(0.08, 0.92, 29)
_REACH = 0.06  # across a side, relative to its length
_STEP_PX = 0.5
_LEAST_EDGE = 3.0  # [levels a pixel]
_TRIPLES = 60  # of edge points
_OFF_PX = 1.0  # greatest distance of an edge from a smooth curve


@dataclass(frozen=True)
class Bend:
    """Radial distortion of an image.

    Attributes
    ----------
    lens
        The lens that makes the sides straightest, with a focal length of the image's width: what
        straight lines determine distortion and focal length only jointly.
    bent_px, left_px
        Root mean square distance of edges from straight lines, without and with it [px].
    off_px
        Root mean square error of the plane between the reference points without it [px].
    """

    lens: Lens
    bent_px: float
    left_px: float
    off_px: float

    @property
    def what(self) -> str:
        """The contradiction."""
        return (
            f"the lens bends its picture: sides that are straight are {self.bent_px:.1f} px off a "
            f"line, and the plane between the reference points is {self.off_px:.1f} px off"
        )

    @property
    def right(self) -> str:
        """The correction."""
        lens = self.lens
        return (
            f"lens = {{ fx = {lens.fx:.0f}, fy = {lens.fy:.0f}, cx = {lens.cx:.1f}, "
            f"cy = {lens.cy:.1f}, k1 = {lens.k1:.2f} }} makes them straight and is used; one that "
            "was calibrated is better"
        )

    def allowed_for(self, view: View, sigma_px: float) -> View:
        """Return a view with this lens, and reference points with its uncertainty added.

        The lens is approximate: a part of the distortion is left (`LEFT_PART`).

        Parameters
        ----------
        view
            The view.
        sigma_px
            Standard deviation of reference points that come without a covariance [px].
        """
        left_px = math.sqrt(0.5) * LEFT_PART * self.off_px
        lens = LensParameters.of(self.lens)
        return structs.replace(view.with_wider_references(sigma_px, left_px), lens_parameters=lens)


def bend_of(
    still: Grey, plane_points: Array, points_px: Array, reduction: Reduction
) -> Bend | None:
    """Estimate the radial distortion from the sides between reference points.

    None if the curvature is below `LEAST_BENT_PX`, or the lens does not straighten the sides.

    None as well without edges along the sides, as between marks on a bare table.

    Parameters
    ----------
    still
        (H, W) Grey levels of a reduced image.
    plane_points, points_px
        (N, 2) Reference points on the plane and in it.
    reduction
        Its reduction; the result is in pixels of the full image.
    """
    import cv2

    hull = cv2.convexHull(points_px.astype(np.float32)).reshape(-1, 2).astype(np.float64)
    smooth = np.asarray(cv2.GaussianBlur(still, (0, 0), 1.0), np.float32)
    ends = zip(hull, np.roll(hull, -1, axis=0), strict=True)
    sides = [side for a, b in ends if (side := _edge_along(smooth, a, b)) is not None]
    if len(sides) < LEAST_SIDES:
        return None
    bent_px = _crookedness_px(sides)
    if bent_px < LEAST_BENT_PX:
        return None
    height, width = still.shape
    lenses = [
        Lens(fx=width, fy=width, cx=(width - 1) / 2, cy=(height - 1) / 2, k1=float(k1))
        for k1 in _K1
    ]
    crooked_px = np.array([_crookedness_px(sides, lens) for lens in lenses])
    best = int(np.nanargmin(crooked_px))
    left_px = float(crooked_px[best])
    if bent_px < TIMES_STRAIGHTER * left_px:
        return None
    off = bent_px, left_px, _off_by_px(lenses[best], plane_points, points_px)
    return Bend(reduction.whole_lens(lenses[best]), *(reduction.factor * px for px in off))


def _off_by_px(lens: Lens, plane_points: Array, points_px: Array) -> float:
    """Root mean square error of the plane without a lens [px].

    Over the part of the plane about the reference points, which themselves fit.
    """
    without = PlaneView.from_reference_points(plane_points, points_px, None)
    within = PlaneView.from_reference_points(plane_points, points_px, None, lens)
    lower, upper = plane_points.min(axis=0), plane_points.max(axis=0)
    steps = np.linspace(-0.125, 1.125, 11)
    grid = np.stack(np.meshgrid(*(lower + (upper - lower) * steps[:, None]).T), axis=-1)
    off_px = (without.project(grid) - within.project(grid)).reshape(-1, 2)
    known = np.isfinite(off_px).all(axis=1)
    return float(np.sqrt((off_px[known] ** 2).sum(axis=1).mean()))


def _edge_along(smooth: NDArray[np.float32], a: Array, b: Array) -> Array | None:
    """Locate the edge from one corner to another, (M, 2) [px]; None if there is none."""
    import cv2

    length_px = float(np.linalg.norm(b - a))
    if length_px < LEAST_SIDE_PX:
        return None
    along = (b - a) / length_px
    across = np.array([-along[1], along[0]])
    reach_px = max(_REACH * length_px, 8.0)
    offsets_px = np.arange(-reach_px, reach_px + _STEP_PX, _STEP_PX)
    places = a + _PLACES[:, None] * (b - a)
    u, v = np.moveaxis(places[:, None] + offsets_px[:, None] * across, -1, 0).astype(np.float32)
    height, width = smooth.shape
    inside = (u > 0) & (v > 0) & (u < width - 1) & (v < height - 1)
    profile = np.asarray(cv2.remap(smooth, u, v, cv2.INTER_LINEAR), np.float64)
    slope = np.gradient(profile, _STEP_PX, axis=1) * inside
    best: Array | None = None
    for sign in (1.0, -1.0):
        at, found = _peaks(sign * slope, offsets_px)
        smooth_curve = _curve(_PLACES, at, found)
        if smooth_curve is None:
            continue
        fits = found & (np.abs(at - smooth_curve) < _OFF_PX)
        if fits.mean() >= LEAST_SHARE and (best is None or fits.sum() > len(best)):
            best = (places + at[:, None] * across)[fits]
    return best


def _peaks(slope: Array, offsets_px: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return each profile's steepest position to subpixel accuracy, and whether it is an edge."""
    top = np.clip(slope.argmax(axis=1), 1, slope.shape[1] - 2)
    rows = np.arange(len(slope))
    before, here, after = (slope[rows, top + i] for i in (-1, 0, 1))
    bend = before - 2.0 * here + after
    shift = np.where(bend < 0.0, 0.5 * (before - after) / np.minimum(bend, -1e-9), 0.0)
    return offsets_px[top] + np.clip(shift, -1, 1) * _STEP_PX, here >= _LEAST_EDGE


def _curve(places: Array, at: Array, found: NDArray[np.bool_]) -> Array | None:
    """Fit a parabola to the inliers of the best one through three edge points."""
    if found.sum() < 6:
        return None
    x, y = places[found], at[found]
    rng = np.random.default_rng(0)  # for a reproducible result
    some = np.array([rng.choice(len(x), 3, replace=False) for _ in range(_TRIPLES)])
    parabolas = np.linalg.solve(_powers(x[some]), y[some][..., None])
    near = np.abs((_powers(x) @ parabolas)[..., 0] - y) < _OFF_PX
    counts = near.sum(axis=1)
    best = near[counts.argmax()]
    if counts.max() <= 5:
        return None
    return np.asarray(np.polyval(np.polyfit(x[best], y[best], 2), places), np.float64)


def _powers(x: Array) -> Array:
    """Return 1, x and x² along a last axis of their own."""
    return np.asarray(x[..., None] ** np.arange(3))


def _crookedness_px(sides: Sequence[Array], lens: Lens | None = None) -> float:
    """Root mean square distance of edges from straight lines after undistortion [px]."""
    bent = np.concatenate(sides)
    straight = bent if lens is None else lens.undistort(bent)
    if not np.isfinite(straight).all():
        return float("nan")
    squares, begin = 0.0, 0
    for side in sides:
        ideal = straight[begin : begin + len(side)]
        begin += len(side)
        about = ideal - ideal.mean(axis=0)
        size = float(np.hypot(*np.ptp(ideal, axis=0)) / np.hypot(*np.ptp(side, axis=0)))
        squares += float(np.linalg.svd(about, compute_uv=False)[1] ** 2) / size**2
    return float(np.sqrt(squares / len(bent)))
