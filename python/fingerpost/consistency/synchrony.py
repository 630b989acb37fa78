"""Comparison of the clocks of two views, by one fingertip that both follow.

A point above the plane, transferred from one image to another by the homography through the plane,
lies on a line through the epipole and the point's own image (plane and parallax: Hartley &
Zisserman 2004, §13.3). For a moving tip this holds only between images of one instant. For each lag
the epipole of all pairs of tips is fitted, and the lag with the smallest distances from its lines
is that of the clocks. If none makes them small, the lag may grow with time, because one view's
frame rate is wrong: rate and lag are then searched jointly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

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

RATES = np.geomspace(0.4, 2.5, 61)
"""Tested ratios of the other clock's rate to the first one's. A step of 3 % moves the tips at
either end of `KEPT_S` by a frame or two."""

RATE_TIMES_BETTER = 6.0
"""Least ratio of the distances without and with a growing lag. Clocks of one rate, with contours
biased by 2 px, reach 4; rates of 0.5 to 1.25 reach 11."""

RATE_APART = 0.1
"""Least logarithm of the ratio of another rate that must fit less well: one move alone fits many
rates."""

MOST_RATE_PAIRS = 48
"""Greatest number of pairs that the search over all rates uses: it takes 0.05 s."""

UNEQUAL_RATES = 0.03
"""Least relative difference of two frame rates that are not of one kind: those of live views vary
by less."""

AGREE_WITHIN = 3
"""Number of frames on either side at which a lag is excluded if clocks agree."""

_NEAR = np.arange(-2.0, 3.0)  # frames by which simultaneous ones may be apart
_REFITS = 3
_SPEED_FRAMES = 6  # over which noise is no motion


@dataclass(frozen=True)
class Lag:
    """Lag of one view's clock behind another's.

    Attributes
    ----------
    lag_s
        The other view shows at t + `lag_s` the scene of the first view at t [s]; at the time of the
        latest tip if it grows.
    with_px, without_px
        Median distance of tips from their epipolar lines at that lag, and without [px]. For a
        growing lag the latter is that at the best constant one.
    rate
        Rate of the other view's clock over that of the first; 1 for a constant lag.
    """

    lag_s: float
    with_px: float
    without_px: float
    rate: float = 1.0

    @property
    def why(self) -> str:
        """Reason for a view that lags."""
        if self.rate == 1.0:
            return f"it lags by {self.lag_s:.2f} s"
        return f"its clock runs {self.rate:.2f} times as fast"


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


def lag_between(first: Tips, other: Tips, begun_s: float = -np.inf) -> Lag | None:
    """Estimate the lag of another view's clock behind the first one's; None if there is none.

    None as well where it cannot be estimated: the tip hardly moves or is not followed by both.
    `clocks_agree` distinguishes the two.

    Parameters
    ----------
    first, other
        The tip in both.
    begun_s
        Time of the first frames [s]: clocks of different rates may have agreed then.
    """
    seen = _Seen.of(first, other)
    if seen is None:
        return None
    without_px = seen.distance_px(np.zeros(1))[0]
    if not without_px > BETTER_PX:  # no lag can be so much better, or there are too few pairs
        return None
    lags_s, off_px = seen.distances_px()
    counted = _as_counted(seen, off_px, without_px, begun_s)
    growing = _growing(seen, off_px, without_px, begun_s)
    if counted and growing and not _is_better(growing.with_px, counted.with_px):
        return counted
    return growing or counted or _constant(lags_s, off_px)


def clocks_agree(first: Tips, other: Tips) -> bool:
    """Whether the tips exclude a lag: without one they are near their lines, with any they are not.

    Parameters
    ----------
    first, other
        The tip in both.
    """
    seen = _Seen.of(first, other)
    if seen is None:
        return False
    lags_s, off_px = seen.distances_px()
    none = len(lags_s) // 2
    return all(
        _is_better(float(off_px[none]), float(off_px[none + frames]))
        for frames in (-AGREE_WITHIN, AGREE_WITHIN)
    )


@dataclass(frozen=True)
class _Seen:
    """The moving tips of the first view, and all of the other.

    Attributes
    ----------
    times_s, points
        Of the tips that move, (M,) [s] and (M, 3).
    other_s, there
        Of the other view's tips, (N,) [s] and (N, 3).
    step_s
        The longer one of the views' frame intervals [s].
    interval_ratio
        Ratio of the other view's frame interval to the first one's.
    """

    times_s: Array
    points: Array
    other_s: Array
    there: Array
    step_s: float
    interval_ratio: float

    @classmethod
    def of(cls, first: Tips, other: Tips) -> _Seen | None:
        """Return the tips; None if too few of them move."""
        if min(len(first), len(other)) < LEAST_PAIRS:
            return None
        (times_s, points), (other_s, there) = first.latest(), other.latest()
        if min(len(times_s), len(other_s)) < LEAST_PAIRS:
            return None
        # A tip that moves by less than its error within the shortest lag fits any lag: its pairs
        # would compare biases of the contours alone.
        if np.hypot(*np.ptp(points[:, :2], axis=0)) < _SPEED_FRAMES * BETTER_PX / SHORTEST_LAG:
            return None  # none moves so fast
        first_step_s, other_step_s = (float(np.median(np.diff(s))) for s in (times_s, other_s))
        step_s = max(first_step_s, other_step_s)
        if min(first_step_s, other_step_s) <= 0.0:
            return None
        moves = _speed(times_s, points[:, :2]) * step_s >= BETTER_PX / SHORTEST_LAG
        if np.count_nonzero(moves) < LEAST_PAIRS:
            return None
        middle = slice(_SPEED_FRAMES // 2, -_SPEED_FRAMES // 2)
        ratio = other_step_s / first_step_s
        return cls(times_s[middle][moves], points[middle][moves], other_s, there, step_s, ratio)

    def some(self, which: NDArray[np.intp] | NDArray[np.bool_]) -> _Seen:
        """Return some of the moving tips."""
        return replace(self, times_s=self.times_s[which], points=self.points[which])

    @property
    def middle_s(self) -> float:
        """Middle of the times of the moving tips [s]."""
        return float(self.times_s[0] + self.times_s[-1]) / 2.0

    @property
    def lags_s(self) -> Array:
        """Tested lags, a frame apart [s]."""
        count = int(SPAN_S / self.step_s)
        return np.asarray(self.step_s * np.arange(-count, count + 1), np.float64)

    def distances_px(self) -> tuple[Array, Array]:
        """Return the tested lags [s], and the distances at each [px]; NaN with too few pairs."""
        lags_s = self.lags_s
        off_px, pairs = self._at(self.times_s + lags_s[:, None])
        off_px[pairs < LEAST_SHARE * pairs[len(pairs) // 2]] = np.nan
        return lags_s, off_px

    def distance_px(self, lags_s: Array, rate: Array | float = 1.0) -> Array:
        """Return the distances at lags in the middle and rates, (L,) [px]."""
        return self._at(self.at_rate(lags_s, rate))[0]

    def at_rate(self, lags_s: Array, rate: Array | float) -> Array:
        """Return the other clock's times at the moving tips, by lags in the middle and rates."""
        away_s = self.times_s - self.middle_s
        return self.middle_s + lags_s[:, None] + np.reshape(rate, (-1, 1)) * away_s

    def known_at(self, times_s: Array) -> NDArray[np.bool_]:
        """Whether the other view has a tip at times."""
        return _neighbours(times_s, self.other_s, self.step_s)[2]

    def _at(self, times_s: Array) -> tuple[Array, NDArray[np.intp]]:
        return _distances_px(times_s, self.points, self.other_s, self.there, self.step_s)


def _constant(lags_s: Array, off_px: Array) -> Lag | None:
    """Return the constant lag of least distances; None if it is not significant."""
    none = len(lags_s) // 2
    if not np.isfinite(off_px).any():
        return None
    best = int(np.nanargmin(off_px))
    with_px, without_px, step_s = float(off_px[best]), float(off_px[none]), lags_s[1] - lags_s[0]
    # The minimum must lie between known values, or the lag may be longer.
    about_px = off_px[max(best - 2, 0) : best + 3]
    if len(about_px) < 5 or not np.isfinite(about_px).all():
        return None
    lag_s = float(lags_s[best]) + step_s * _vertex(about_px[1:4])
    if not _is_better(with_px, without_px) or abs(lag_s) < SHORTEST_LAG * step_s:
        return None
    return Lag(lag_s, with_px, without_px)


def _is_better(with_px: float, without_px: float) -> bool:
    return without_px > max(TIMES_BETTER * with_px, with_px + BETTER_PX)


def _as_counted(seen: _Seen, constant_px: Array, without_px: float, begun_s: float) -> Lag | None:
    """Return the growing lag of views whose rates differ although their frames were simultaneous.

    It has no unknown, and therefore precedes all others that explain the tips no better.
    """
    rate = seen.interval_ratio
    if abs(rate - 1.0) < UNEQUAL_RATES or not np.isfinite(begun_s):
        return None
    lags_s = (rate - 1.0) * (seen.middle_s - begun_s) + seen.step_s * _NEAR
    off_px = seen.distance_px(lags_s, rate)
    if not np.isfinite(off_px).any():
        return None
    best = int(np.nanargmin(off_px))
    with_px = float(off_px[best])
    if not _is_better(with_px, without_px) or _is_better(float(np.nanmin(constant_px)), with_px):
        return None
    latest_s = float(seen.times_s[-1])
    lag_s = float(lags_s[best]) + (rate - 1.0) * (latest_s - seen.middle_s)
    return Lag(lag_s, with_px, without_px, rate)


def _growing(seen: _Seen, constant_px: Array, without_px: float, begun_s: float) -> Lag | None:
    """Return the lag of a clock of another rate, if it explains the tips better than any constant.

    Clocks of different rates share few pairs; the constant lags are compared on those alone.

    Parameters
    ----------
    constant_px
        Distances at the constant lags [px].
    without_px
        That at none [px].
    """
    if not np.nanmin(constant_px, initial=np.inf) > 2.0 * BETTER_PX:
        return None  # a constant lag explains the tips
    some = seen.some(np.unique(np.linspace(0, len(seen.times_s) - 1, MOST_RATE_PAIRS).astype(int)))
    lags_s = seen.lags_s[::2]
    rates, lags_s = np.repeat(RATES, len(lags_s)), np.tile(lags_s, len(RATES))
    if np.isfinite(begun_s):
        lags_s = lags_s + (rates - 1.0) * (some.middle_s - begun_s)
    off_px = some.distance_px(lags_s, rates)
    if not np.isfinite(off_px).any():
        return None
    best = int(np.nanargmin(off_px))
    lag = _refined(seen, float(lags_s[best]), float(rates[best]))
    if lag is None or without_px < RATE_TIMES_BETTER * lag.with_px:
        return None
    others_px = off_px[np.abs(np.log(rates / lag.rate)) > RATE_APART]
    return None if (others_px < TIMES_BETTER * lag.with_px).any() else lag


def _refined(seen: _Seen, lag_s: float, rate: float) -> Lag | None:
    """Refine the lag in the middle and the rate, and compare them with constant lags."""
    fine = np.linspace(-1.0, 1.0, 9)
    rates = rate * (1.0 + np.repeat(fine, len(fine)) * (RATES[1] / RATES[0] - 1.0))
    lags_s = lag_s + 2.0 * np.tile(fine, len(fine)) * seen.step_s
    off_px = seen.distance_px(lags_s, rates)
    if not np.isfinite(off_px).any():
        return None
    best = int(np.nanargmin(off_px))
    lag_s, rate, with_px = float(lags_s[best]), float(rates[best]), float(off_px[best])
    shared = seen.some(seen.known_at(seen.at_rate(np.array([lag_s]), rate))[0])
    without_px = float(np.nanmin(shared.distances_px()[1], initial=np.inf))
    grown_s = abs(rate - 1.0) * float(shared.times_s[-1] - shared.times_s[0])
    if not _is_better(with_px, without_px) or grown_s < 2.0 * SHORTEST_LAG * seen.step_s:
        return None
    latest_s = float(seen.times_s[-1])
    return Lag(lag_s + (rate - 1.0) * (latest_s - seen.middle_s), with_px, without_px, rate)


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
    after, part, known = _neighbours(times_s, other_s, step_s)
    part = part[..., None]
    between = (1.0 - part) * there[after - 1] + part * there[after]
    here = np.broadcast_to(points, between.shape)
    off_px = _median(fit_epipole(here, between, known), known)
    pairs = known.sum(axis=1)
    off_px[pairs < LEAST_PAIRS] = np.nan
    return off_px, pairs


def _neighbours(
    times_s: Array, other_s: Array, step_s: float
) -> tuple[NDArray[np.intp], Array, NDArray[np.bool_]]:
    """Index of the other's tip after each time, the part of its interval, and whether it counts."""
    after = np.clip(np.searchsorted(other_s, times_s), 1, len(other_s) - 1)
    gap_s = other_s[after] - other_s[after - 1]
    part = (times_s - other_s[after - 1]) / np.maximum(gap_s, np.finfo(float).tiny)
    return after, part, (part >= 0.0) & (part <= 1.0) & (gap_s < 2.5 * step_s)


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
