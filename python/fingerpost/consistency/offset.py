"""The constant offset between the clocks of two recordings, to a part of a millisecond.

As `synchrony`, but for whole recordings and with a standard deviation: at each lag the epipole of
all pairs of tips is fitted, and the tips' distances from its lines give the cost. The cost is
evaluated at all lags, then minimised between frames; the scatter of the minimum when parts of the
recording are left out gives the standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerpost.consistency.synchrony import LEAST_PAIRS, fit_epipole
from fingerpost.errors import InvalidInputError

Array = NDArray[np.float64]

LEAST_SPREAD_PX = 5.0
"""Least median distance of a moving tip from its median position: for a static one any lag fits."""

MOST_LAG_S = 30.0
"""Greatest lag: recordings started further apart are to be aligned to this first."""

LEAST_SHARE = 0.3
"""Least ratio of the number of pairs at a lag to that at the best lag."""

AMBIGUITY = 1.25
"""Cost ratio of another lag to the least one below which the offset is ambiguous: the motion is
periodic."""

MOST_SIGMA_S = 0.01
"""Greatest standard deviation of an offset: a third of a frame."""

STRANGE_PX = 3.0
"""Scale of the robust cost: a tip farther from its line is an outlier."""

_MOST_TIPS = 300  # used over all lags
_WINDOW = 10  # frames that a place is fitted to
_PARTS = 8
_MOST_VALLEYS = 6  # of the costs at frames that are minimised between frames
_GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0
_CLOSE_ENOUGH_S = 2e-5


@dataclass(frozen=True)
class Track:
    """Positions of a tip, in pixels of the first view's image of the plane.

    Attributes
    ----------
    times_s : (N,)
        Ascending [s].
    points : (N, 3)
        Homogeneous.
    """

    times_s: Array
    points: Array

    @property
    def step_s(self) -> float:
        """Median interval between two of them [s]."""
        return float(np.median(np.diff(self.times_s)))

    def at(self, times_s: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Interpolate at other times by a cubic fitted to the neighbours; and which are known.

        An interpolating curve would be smoother between frames than at them, and bias lags towards
        halves of a frame. The fit attenuates a fast motion equally in both views.

        Returns
        -------
        (M, 3), (M,)
        """
        t, p = self.times_s, self.points / self.points[:, 2:]
        after = np.clip(np.searchsorted(t, times_s), 1, len(t) - 1)
        window = np.clip(after - _WINDOW // 2, 0, len(t) - _WINDOW)[:, None] + np.arange(_WINDOW)
        away = (t[window] - times_s[:, None]) / (_WINDOW / 2 * self.step_s)
        known = (times_s >= t[0]) & (times_s <= t[-1]) & (np.abs(away).max(axis=1) < 2.5)
        weight = (
            np.clip(1.0 - np.abs(away) ** 3, 1e-3, 1.0) ** 3
        )  # continuous as neighbours enter and leave
        powers = away[..., None] ** np.arange(4)
        weighted = powers * weight[..., None]
        information = np.swapaxes(weighted, 1, 2) @ powers
        found = np.linalg.solve(information, np.swapaxes(weighted, 1, 2) @ p[window])
        return found[:, 0], known


@dataclass(frozen=True)
class Offset:
    """Offset of one clock behind another.

    Attributes
    ----------
    lag_s
        The other recording shows at t + `lag_s` the scene of the first one at t [s].
    sigma_s
        Its standard deviation [s].
    pairs
        Number of tips of the estimate.
    off_px
        Their median distance from their epipolar lines at that lag [px].
    """

    lag_s: float
    sigma_s: float
    pairs: int
    off_px: float


def offset_between(first: Track, other: Track) -> Offset:
    """Estimate the offset of another recording's clock behind the first one's.

    Parameters
    ----------
    first, other
        The same tip in both.

    Raises
    ------
    InvalidInputError
        It cannot be estimated: too few tips, a tip that hardly moves or moves along the line
        between the cameras, a periodic motion, or no motion common to both recordings.
    """
    if min(len(first.times_s), len(other.times_s)) < LEAST_PAIRS:
        raise InvalidInputError(
            f"the tip was followed in {len(first.times_s)} and {len(other.times_s)} frames; "
            f"{LEAST_PAIRS} of each are needed"
        )
    places = first.points[:, :2] / first.points[:, 2:]
    spread_px = float(np.median(np.hypot(*(places - np.median(places, axis=0)).T)))
    if spread_px < LEAST_SPREAD_PX:
        raise InvalidInputError(
            f"the tip keeps within {spread_px:.1f} px; it is to move, to and fro and across, by "
            f"{LEAST_SPREAD_PX:g} px at least"
        )
    first = Track(first.times_s, first.at(first.times_s)[0])
    lags_s, costs = _costs(first, other)
    step_s = lags_s[1] - lags_s[0]
    _refuse_unbounded(costs)
    every = np.arange(len(first.times_s))
    # Costs between frames decide: those at frames depend on how near to one a lag happens to be.
    candidates_s = np.array(
        [_least(first, other, every, lags_s[k], step_s) for k in _lowest_valleys(costs)]
    )
    candidates_px = np.array([_cost_px(first, other, every, s)[0] for s in candidates_s])
    best = int(np.nanargmin(candidates_px))
    lag_s = float(candidates_s[best])
    is_other = np.abs(candidates_s - lag_s) > 2.0 * step_s
    _refuse_ambiguous(
        lag_s, candidates_s[is_other & (candidates_px < AMBIGUITY * candidates_px[best])]
    )
    cost_px, pairs = _cost_px(first, other, every, lag_s)
    parts = np.array_split(every, _PARTS)
    without = [np.concatenate(parts[:k] + parts[k + 1 :]) for k in range(_PARTS)]
    left = np.array([_least(first, other, rest, lag_s, step_s) for rest in without])
    sigma_s = float(np.sqrt((_PARTS - 1) * np.var(left)))  # the jackknife
    if not sigma_s <= MOST_SIGMA_S:
        raise InvalidInputError(
            f"the offset is {lag_s:.3f} ± {sigma_s:.3f} s, too unsure to be one; the tip is to "
            "move more, and not along the line between the cameras alone"
        )
    return Offset(lag_s, sigma_s, pairs, cost_px)


def _costs(first: Track, other: Track) -> tuple[Array, Array]:
    """Return lags, a step apart, and their costs [px]; NaN where too few pairs overlap."""
    step_s = min(first.step_s, other.step_s)
    reach_s = min(
        MOST_LAG_S,
        max(first.times_s[-1] - other.times_s[0], other.times_s[-1] - first.times_s[0]),
    )
    count = max(3, int(reach_s / step_s))
    lags_s = step_s * np.arange(-count, count + 1, dtype=np.float64)
    stride = max(1, len(first.times_s) // _MOST_TIPS)
    some = np.arange(0, len(first.times_s), stride)
    results = np.array([_cost_px(first, other, some, lag_s) for lag_s in lags_s])
    costs, pairs = results.T
    costs[pairs < LEAST_SHARE * pairs.max()] = np.nan
    if not np.isfinite(costs).any():
        raise InvalidInputError("no frames of both recordings show the tip at one time")
    return lags_s, costs


def _lowest_valleys(costs: Array) -> NDArray[np.intp]:
    """Return where costs are less than beside it, the lowest first and a few alone."""
    inner = (costs[1:-1] <= costs[:-2]) & (costs[1:-1] <= costs[2:])
    valleys = 1 + np.flatnonzero(inner)
    return valleys[np.argsort(costs[valleys])[:_MOST_VALLEYS]]


def _refuse_ambiguous(lag_s: float, others_s: Array) -> None:
    if len(others_s):
        raise InvalidInputError(
            f"the tip's motion fits at {lag_s:.2f} s and at {others_s[0]:.2f} s; it is to "
            "move without repeating itself"
        )


def _refuse_unbounded(costs: Array) -> None:
    """Refuse costs whose least one may be less still where nothing is known."""
    best = int(np.nanargmin(costs))
    neighbours = costs[max(best - 1, 0) : best + 2]
    if len(neighbours) < 3 or not np.isfinite(neighbours).all():
        raise InvalidInputError(
            "the recordings were begun so far apart that too little of them is of one time"
        )


def _cost_px(
    first: Track, other: Track, which: NDArray[np.int64], lag_s: float
) -> tuple[float, int]:
    """Median distance from epipolar lines at a lag [px], and the number of pairs."""
    off_px = _distances_px(first, other, which, lag_s)
    return (float(np.median(off_px)), len(off_px)) if len(off_px) else (np.nan, 0)


def _smooth_cost(first: Track, other: Track, which: NDArray[np.int64], lag_s: float) -> float:
    """Cost of a lag, differentiable unlike a median: Geman and McClure's sum."""
    off_px = _distances_px(first, other, which, lag_s)
    if not len(off_px):
        return np.inf
    return float(np.mean(off_px**2 / (off_px**2 + STRANGE_PX**2)))


def _distances_px(first: Track, other: Track, which: NDArray[np.int64], lag_s: float) -> Array:
    """Distances of tips from the lines through the epipole and the other's tips at that lag."""
    there, known = other.at(first.times_s[which] + lag_s)
    if known.sum() < LEAST_PAIRS:
        return np.empty(0)
    here = first.points[which][known]
    return fit_epipole(here / here[:, 2:], there[known])


def _least(
    first: Track, other: Track, which: NDArray[np.int64], near_s: float, step_s: float
) -> float:
    """Minimise the cost within a step either way by golden sections."""
    low_s, high_s = near_s - step_s, near_s + step_s
    while high_s - low_s > _CLOSE_ENOUGH_S:
        inner_s = high_s - _GOLDEN * (high_s - low_s)
        outer_s = low_s + _GOLDEN * (high_s - low_s)
        if _smooth_cost(first, other, which, inner_s) < _smooth_cost(first, other, which, outer_s):
            high_s = outer_s
        else:
            low_s = inner_s
    return (low_s + high_s) / 2.0
