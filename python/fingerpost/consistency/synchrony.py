"""Comparison of the clocks of two views, by one fingertip that both follow.

A point above the plane, transferred from one image to another by the homography through the plane,
lies on a line through the epipole and the point's own image (plane and parallax: Hartley &
Zisserman 2004, §13.3). For a moving tip this holds only between images of one instant. For each lag
the epipole of all pairs of tips is fitted, and the lag with the smallest distances from its lines
is that of the clocks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerpost.pointing import FingerLine, PlaneView

Array = NDArray[np.float64]

SPAN_S = 1.0
"""Greatest lag that is tested: views started further apart share no motion."""

KEPT_S = 6.0
MOST_TIPS = 256
"""Duration and greatest number of the tips that are compared."""

LEAST_PAIRS = 24
"""Least number of pairs of moving tips: fewer fit an epipole by chance."""

LEAST_SHARE = 0.6
"""Least ratio of the number of pairs at a lag to that without: fewer are of another motion."""

SHORTEST_LAG = 0.75
"""Least lag [frame intervals]: capture times are known no better."""

TIMES_BETTER = 2.0
BETTER_PX = 0.7
"""Least ratio and least difference of the distances without and with a lag: the difference is the
error of a contour's tip."""

_REFITS = 3
_SPEED_FRAMES = 6  # over which noise is no motion


@dataclass(frozen=True)
class Lag:
    """Lag of one view's clock behind another's.

    Attributes
    ----------
    lag_s
        The other view shows at t + `lag_s` the scene of the first view at t [s].
    with_px, without_px
        Median distance of tips from their epipolar lines at that lag, and at none [px].
    """

    lag_s: float
    with_px: float
    without_px: float


def tip_in_first_view(finger: FingerLine, view: PlaneView, first: PlaneView) -> Array | None:
    """Transfer the tip that another view follows, through the plane, to the first view's image.

    Parameters
    ----------
    finger
        Finger line of the other view.
    view, first
        Homographies of the other view and the first one.

    Returns
    -------
    (3,) array or None
        A homogeneous vector, in pixels without distortion; None if the tip is outside the domain of
        the view's lens model.
    """
    tip_px = finger.tip_px if view.lens is None else view.lens.undistort(finger.tip_px)
    if not np.isfinite(tip_px).all():
        return None
    here = first.image_from_plane @ np.linalg.solve(view.image_from_plane, [*tip_px, 1.0])
    return np.asarray(here, np.float64)


class Tips:
    """Latest positions of one view's fingertip, in pixels of the first view's image."""

    def __init__(self) -> None:
        # Allocated once, so that frames allocate nothing. Each tip is kept twice: the latest ones
        # are always contiguous.
        self._rows = np.empty((2 * MOST_TIPS, 4))
        self._count = 0

    def __len__(self) -> int:
        return min(self._count, MOST_TIPS)

    def add(self, time_s: float, point: Array) -> None:
        """Add the latest position: its time [s], and a homogeneous vector (3,)."""
        rows = self._rows[self._count % MOST_TIPS :: MOST_TIPS]
        rows[:, 0], rows[:, 1:] = time_s, point
        self._count += 1

    def latest(self) -> tuple[Array, Array]:
        """Return the times (M,) [s] and points (M, 3) of the last `KEPT_S`, the oldest first.

        They are valid until the next one is added.
        """
        first = self._count % MOST_TIPS if self._count > MOST_TIPS else 0
        rows = self._rows[first : first + len(self)]
        rows = rows[np.searchsorted(rows[:, 0], rows[-1, 0] - KEPT_S) :]
        return rows[:, 0], rows[:, 1:]


def lag_between(first: Tips, other: Tips) -> Lag | None:
    """Estimate the lag of another view's clock behind the first one's; None if there is none.

    None as well where it cannot be estimated: the tip hardly moves or is not followed by both.

    Parameters
    ----------
    first, other
        The tip in both.
    """
    if min(len(first), len(other)) < LEAST_PAIRS:
        return None
    (times_s, points), (other_s, there) = first.latest(), other.latest()
    if min(len(times_s), len(other_s)) < LEAST_PAIRS:
        return None
    # A tip that moves by less than its error within the shortest lag fits any lag: its pairs would
    # compare biases of the contours alone.
    if np.hypot(*np.ptp(points[:, :2], axis=0)) < _SPEED_FRAMES * BETTER_PX / SHORTEST_LAG:
        return None  # none moves so fast
    step_s = max(float(np.median(np.diff(s))) for s in (times_s, other_s))
    if step_s <= 0.0:
        return None
    none = int(SPAN_S / step_s)
    lags_s = step_s * np.arange(-none, none + 1)
    moves = _speed(times_s, points[:, :2]) * step_s >= BETTER_PX / SHORTEST_LAG
    if np.count_nonzero(moves) < LEAST_PAIRS:
        return None
    middle = slice(_SPEED_FRAMES // 2, -_SPEED_FRAMES // 2)
    times_s, points = times_s[middle][moves], points[middle][moves]
    here_px, _ = _distances_px(times_s[None], points, other_s, there, step_s)
    without_px = float(here_px[0])
    if not without_px > BETTER_PX:  # no lag can be so much better, or there are too few pairs
        return None
    off_px, pairs = _distances_px(times_s + lags_s[:, None], points, other_s, there, step_s)
    off_px[pairs < LEAST_SHARE * pairs[none]] = np.nan
    best = int(np.nanargmin(off_px))
    with_px = float(off_px[best])
    # The minimum must lie between known values, or the lag may be longer.
    about_px = off_px[max(best - 2, 0) : best + 3]
    if len(about_px) < 5 or not np.isfinite(about_px).all():
        return None
    is_better = without_px > max(TIMES_BETTER * with_px, with_px + BETTER_PX)
    lag_s = float(lags_s[best]) + step_s * _vertex(about_px[1:4])
    if not is_better or abs(lag_s) < SHORTEST_LAG * step_s:
        return None
    return Lag(lag_s, with_px, without_px)


def _speed(times_s: Array, places: Array) -> Array:
    """Return the speed of a tip in the middle of all spans of `_SPEED_FRAMES` [px/s]."""
    moved_px = np.hypot(*(places[_SPEED_FRAMES:] - places[:-_SPEED_FRAMES]).T)
    span_s = times_s[_SPEED_FRAMES:] - times_s[:-_SPEED_FRAMES]
    return np.asarray(moved_px / np.maximum(span_s, np.finfo(float).tiny))


def _distances_px(
    times_s: Array, points: Array, other_s: Array, there: Array, step_s: float
) -> tuple[Array, NDArray[np.intp]]:
    """Median distance of tips from their epipolar lines [px], the others' taken at other times.

    A row of `times_s` is a lag. And the number of pairs of each; NaN where they are too few.
    """
    after = np.clip(np.searchsorted(other_s, times_s), 1, len(other_s) - 1)
    gap_s = other_s[after] - other_s[after - 1]
    part = (times_s - other_s[after - 1]) / np.maximum(gap_s, np.finfo(float).tiny)
    known = (part >= 0.0) & (part <= 1.0) & (gap_s < 2.5 * step_s)
    part = part[..., None]
    between = (1.0 - part) * there[after - 1] + part * there[after]
    here = np.broadcast_to(points, between.shape)
    off_px = _median(fit_epipole(here, between, known), known)
    pairs = known.sum(axis=1)
    off_px[pairs < LEAST_PAIRS] = np.nan
    return off_px, pairs


def fit_epipole(here: Array, there: Array, known: NDArray[np.bool_] | None = None) -> Array:
    """Fit the epipole of lines through pairs of points; return the distances from those lines.

    Parameters
    ----------
    here, there : (..., N, 3)
        Homogeneous, in the pixels of one image of the plane; the last entry of `here` is 1. Every
        set of N pairs has an epipole of its own.
    known : (..., N), optional
        Which pairs count; all by default.

    Returns
    -------
    (..., N)
        Of each point `here` from the line through the epipole and its partner [px].
    """
    if known is None:
        known = np.ones(here.shape[:-1], np.bool_)
    here, there, scale = _normalised(here, there, known)
    lines = np.cross(here, there)
    weights = known.astype(np.float64)
    for _ in range(_REFITS):
        weighted = lines * weights[..., None]
        epipole = np.linalg.eigh(np.swapaxes(weighted, -1, -2) @ weighted)[1][..., None, :, 0]
        # The distance of a point from the line through the epipole and its partner.
        normals = np.cross(epipole, there)
        lengths = np.maximum(np.hypot(normals[..., 0], normals[..., 1]), 1e-9)
        off = np.abs(np.sum(lines * epipole, axis=-1)) / lengths
        usual = np.maximum(1.5 * _median(off, known), 1e-9)[..., None]
        weights = known / (lengths * np.hypot(1.0, off / usual))  # Cauchy's
    return np.asarray(off * scale[..., None])


def _normalised(here: Array, there: Array, known: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
    """Return pairs about the middle of `here`, at unit scale and unit length; and the scale."""
    count = np.maximum(known.sum(axis=-1), 1)
    middle = np.sum(here[..., :2] * known[..., None], axis=-2) / count[..., None]
    away = np.abs(here[..., :2] - middle[..., None, :]) * known[..., None]
    scale = np.maximum(away.sum(axis=(-1, -2)) / (2 * count), 1.0)
    moved = []
    for points in (here, there):
        places = points[..., :2] - middle[..., None, :] * points[..., 2:]
        places = places / scale[..., None, None]
        moved.append(np.concatenate([places, points[..., 2:]], axis=-1))
    return moved[0], moved[1] / np.linalg.norm(moved[1], axis=-1, keepdims=True), scale


def _median(values: Array, known: NDArray[np.bool_]) -> Array:
    """Median of the known values of each row; infinite where there are none."""
    ordered = np.sort(np.where(known, values, np.inf), axis=-1)
    count = known.sum(axis=-1)
    middle = np.stack([(count - 1) // 2, count // 2], axis=-1)
    return np.asarray(np.take_along_axis(ordered, np.maximum(middle, 0), axis=-1).mean(axis=-1))


def _vertex(values: Array) -> float:
    """Return the minimum of the parabola through three values at −1, 0, 1, from −1 to 1."""
    before, here, after = values.tolist()
    bend = before - 2.0 * here + after
    return float(np.clip(0.5 * (before - after) / bend, -1.0, 1.0)) if bend > 0.0 else 0.0
