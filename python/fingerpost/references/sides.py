"""The sides of a quadrilateral in a picture, and its corners as their intersections.

Edges are located along the visible length of each side, a line is fitted to them robustly, and
neighbouring lines are intersected: a corner may be rounded, covered or outside the picture. Edges
are undistorted before lines are fitted, because only then are the sides straight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerpost._core import LineFit, edges_along, fit_line
from fingerpost.lens import Lens
from fingerpost.references.polygons import is_convex, signed_area
from fingerpost.uncertainty import joint_of

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

INSET = 0.04
INSET_PX = 2.0
"""Parts of a side next to its corners that are not used [share of the side, px]: corners may be
rounded, and the other side's edge is near."""

LEAST_CONTRAST = 3.0
"""Least step of an edge [grey levels]; noise above it does not lie on a line."""

SEEN_STEPS = 129
"""Number of points along a side that are tested for lying in the picture."""

BORDER_PX = 1.0
CURVE_POINTS = 9

LEAST_EDGES = 8
"""Least number of edges of a side."""

MODEL_SIGMA_PX = 0.002
"""Additional standard deviation of a corner: blurred edges deviate from the step model."""

SAME_WAY = 0.8
"""Least share of a side's edges with the same sign for which the side has that sign."""


@dataclass(frozen=True, eq=False)
class Sides:
    """A quadrilateral measured by its sides.

    Attributes
    ----------
    corners_px
        (4, 2) Intersections of neighbouring sides, with lens distortion [px].
    covariance
        (8, 8) Joint covariance of u and v of each corner in turn [px²]: neighbours share a side.
    steps
        (4,) Median step of grey levels from outside to inside across each side.
    shares
        (4,) Share of the stretches of each side that lie on its line.
    seen_px
        (4,) Length of each side within the picture [px].
    rms_px
        (4,) Root mean square residual of the edges from their lines [px].
    """

    corners_px: Array
    covariance: Array
    steps: Array
    shares: Array
    seen_px: Array
    rms_px: Array

    @property
    def support(self) -> float:
        """Share of the outline within the picture that has an edge, 0 to 1."""
        return float(self.shares @ self.seen_px / self.seen_px.sum())

    def ordered(self, corners: NDArray[np.intp]) -> Sides:
        """Return the quadrilateral with another first corner or sense of rotation."""
        entries = (2 * corners[:, None] + [0, 1]).ravel()
        # Side k runs from corner k to the next one; in reverse order, to the previous one.
        forward = (corners[1] - corners[0]) % 4 == 1
        sides = corners if forward else np.roll(corners, -1)
        return Sides(
            self.corners_px[corners],
            self.covariance[np.ix_(entries, entries)],
            self.steps[sides],
            self.shares[sides],
            self.seen_px[sides],
            self.rms_px[sides],
        )


@dataclass(frozen=True, eq=False)
class _Side:
    line: LineFit
    step: float
    share: float
    seen_px: float


def fit_sides(
    picture: Picture,
    corners_px: Array,
    lens: Lens | None = None,
    *,
    reach_px: float,
    steps: Array | None = None,
    inset: float = INSET,
) -> Sides | None:
    """Fit lines to the sides of a quadrilateral that is known to a few pixels.

    Parameters
    ----------
    picture
        (H, W) Levels in which its sides are visible.
    corners_px
        (4, 2) Approximate corners, in order; may lie outside the picture.
    lens
        The view's distortion, if known.
    reach_px
        Greatest distance of the sides from there, 0.5 to 100 [px].
    steps
        (4,) Sign of each side's step from outside to inside; 0 if unknown.
    inset
        Share of a side next to each corner that is not used, 0 to 0.4.

    Returns
    -------
    Sides or None
        None if too little of a side is visible, or sides do not intersect.
    """
    ideal = corners_px if lens is None else lens.undistort(corners_px)
    if not np.isfinite(ideal).all():
        return None
    # Normals of `edges_along` point inwards if the corners run clockwise in the picture.
    turn = 1.0 if signed_area(ideal) > 0.0 else -1.0
    signs = np.zeros(4) if steps is None else np.sign(steps) * turn
    found = []
    for k in range(4):
        ends = np.stack([ideal[k], ideal[(k + 1) % 4]])
        side = _fit_side(picture, ends, lens, reach_px, int(signs[k]), inset)
        if side is None:
            return None
        found.append(side)
    return _joined(found, turn, lens)


def refined(
    picture: Picture, corners_px: Array, lens: Lens | None = None, *, reach_px: float
) -> Sides | None:
    """Fit sides from a rough guess: first by the strongest edges, then by those nearest to them."""
    rough = fit_sides(picture, corners_px, lens, reach_px=reach_px)
    if rough is None:
        return None
    return fit_sides(picture, rough.corners_px, lens, reach_px=2.0, steps=rough.steps)


def _fit_side(
    picture: Picture, ends: Array, lens: Lens | None, reach_px: float, sign: int, inset: float
) -> _Side | None:
    path = _visible(picture.shape, ends, lens, inset)
    if path is None:
        return None
    edges = edges_along(picture, path, reach_px, sign, LEAST_CONTRAST)
    if len(edges) < LEAST_EDGES:
        return None
    points_px = edges.position_px if lens is None else lens.undistort(edges.position_px)
    line = fit_line(points_px, edges.sigma_px)
    if line is None:
        return None
    on_line = edges.contrast[line.inliers]
    step = float(np.median(on_line))
    if sign == 0 and np.mean(np.sign(on_line) == np.sign(step)) < SAME_WAY:
        step = 0.0
    seen_px = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    stretch_px = float(np.clip(seen_px / 32.0, 1.0, 8.0))
    share = min(float(np.count_nonzero(line.inliers)) * stretch_px / seen_px, 1.0)
    return _Side(line, step, share, seen_px)


def _visible(shape: tuple[int, ...], ends: Array, lens: Lens | None, inset: float) -> Array | None:
    """Return the ends of a side's part within the picture; None if there is none."""
    along = ends[1] - ends[0]
    length_px = float(np.hypot(*along))
    inset = min(inset + INSET_PX / max(length_px, 1.0), 0.4)
    parts = np.linspace(inset, 1.0 - inset, SEEN_STEPS)
    points = ends[0] + parts[:, None] * along
    shown = points if lens is None else lens.distort(points)
    last = np.array(shape[1::-1]) - 1.0 - BORDER_PX
    with np.errstate(invalid="ignore"):
        seen = np.flatnonzero(((shown >= BORDER_PX) & (shown <= last)).all(axis=1))
    if len(seen) < 2:
        return None
    count = 2 if lens is None else CURVE_POINTS
    path = ends[0] + np.linspace(parts[seen[0]], parts[seen[-1]], count)[:, None] * along
    return path if lens is None else np.asarray(lens.distort(path))


def _joined(sides: list[_Side], turn: float, lens: Lens | None) -> Sides | None:
    """Intersect neighbouring lines; their errors are independent."""
    corners, by_lines = np.empty((4, 2)), np.zeros((8, 8))
    for k in range(4):
        met = _meet(sides[k - 1].line, sides[k].line)
        if met is None:
            return None
        corners[k], by_before, by_after = met
        j = (k - 1) % 4
        by_lines[2 * k : 2 * k + 2, 2 * j : 2 * j + 2] = by_before
        by_lines[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = by_after
    if np.sign(signed_area(corners)) != turn or not is_convex(corners):
        return None
    lines = joint_of(np.stack([side.line.covariance for side in sides]))
    covariance = by_lines @ lines @ by_lines.T
    shown = as_shown(corners, covariance, lens)
    if shown is None:
        return None
    corners, covariance = shown
    return Sides(
        corners,
        covariance + MODEL_SIGMA_PX**2 * np.eye(8),
        steps=turn * np.array([side.step for side in sides]),
        shares=np.array([side.share for side in sides]),
        seen_px=np.array([side.seen_px for side in sides]),
        rms_px=np.array([side.line.rms_px for side in sides]),
    )


def as_shown(ideal_px: Array, covariance: Array, lens: Lens | None) -> tuple[Array, Array] | None:
    """Distort ideal pixels (N, 2) and their covariance (2N, 2N) by a lens.

    None if one of them is outside its domain.
    """
    if lens is None:
        return ideal_px, covariance
    shown_px = np.asarray(lens.distort(ideal_px))
    if not np.isfinite(shown_px).all():
        return None
    by_ideal = joint_of(np.asarray(np.linalg.inv(lens.undistort_jacobian(shown_px)), np.float64))
    return shown_px, by_ideal @ covariance @ by_ideal.T


def _meet(before: LineFit, after: LineFit) -> tuple[Array, Array, Array] | None:
    """Return the intersection of two lines and its Jacobians by offset and angle of each (2, 2)."""
    lines = (before, after)
    directions = np.array([[np.cos(line.angle_rad), np.sin(line.angle_rad)] for line in lines])
    normals = np.stack([-directions[:, 1], directions[:, 0]], axis=1)
    points = np.array([line.point_px for line in lines])
    if abs(np.linalg.det(normals)) < 0.02:
        return None
    inverse = np.linalg.inv(normals)
    corner = inverse @ (normals * points).sum(axis=1)
    lever = ((corner - points) * directions).sum(axis=1)
    by_line = [np.outer(inverse[:, k], [1.0, lever[k]]) for k in range(2)]
    return corner, by_line[0], by_line[1]
