"""A person's habit of pointing: the systematic error between indicated and intended points.

People point along the line from eye to fingertip, not along the finger. Their indicated points
therefore miss the target by some centimetres, with an error that is repeatable for each person. It
is estimated from indicated points of known targets: the error ``e = p − t`` of an indicated point p
of target t is a polynomial of p plus the scatter r of the hand,

    e = Bᵀ φ(p) + r,    φ = 1 (offset), (1, x, y) (affine), (1, x, y, x², xy, y²) (quadratic),

fitted by least squares; ``p − Bᵀ φ(p)`` is the intended point. The model is chosen by leave-one-out
cross-validation over the targets (M. Stone, "Cross-validatory choice and assessment of statistical
predictions", JRSS B 36, 1974). The covariance includes the scatter, its own uncertainty, and that
of B (G. A. F. Seber, A. J. Lee, *Linear Regression Analysis*, 2nd ed., section 5.3).

The polynomial is not extrapolated: outside the hull of the points at calibration, the correction is
that of the hull's nearest point, and its standard deviation grows with the distance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.checks import covariance_array, finite_array
from fingerpost.errors import InvalidInputError

Array = NDArray[np.float64]

MIN_TARGETS = 5
"""With fewer, scatter and habit cannot be separated: at 5, an offset leaves 8 degrees of freedom
for the scatter, and an affine habit 4."""

CONFIDENCE = 0.95
"""Confidence at which the ellipse has its nominal coverage for any number of targets; see
`_widening`."""

STANDARD_ERRORS = 1.5
"""Least advantage of a richer model [standard errors]. If the habit is an offset and its scatter a
third of it, five targets select another model in 9 % of cases at 1, in 6 % at 1.5, in 3 % at 2; if
it varies by a tenth of the distance, nine targets miss the affine model in 21 %, 28 % and 41 %."""


class HabitModel(StrEnum):
    """Dependence of a habit on the place that is pointed at."""

    OFFSET = "offset"
    AFFINE = "affine"
    QUADRATIC = "quadratic"


_TERMS = {HabitModel.OFFSET: 1, HabitModel.AFFINE: 3, HabitModel.QUADRATIC: 6}


@dataclass(frozen=True, eq=False, slots=True)
class Meant:
    """The intended point for an indicated one.

    Attributes
    ----------
    point : (2,)
        [plane units]
    covariance : (2, 2)
        [plane units²]
    beyond
        Distance of the indicated point from the hull of those at calibration [plane units]; 0
        inside.
    """

    point: Array
    covariance: Array
    beyond: float


@dataclass(frozen=True, eq=False)
class Habit:
    """A person's habit; `Habit.of` estimates it from indicated points of known targets.

    Attributes
    ----------
    targets : (N, 2)
        Targets [plane units].
    points : (N, 2)
        Points indicated for them [plane units].
    model
        Dependence of the habit on the place.
    left_out
        Root mean square leave-one-out error of each model with enough targets [plane units].
    coefficients : (M, 2)
        B, for the terms of `model` in centred and scaled points.
    scatter
        Standard deviation of the residuals in each coordinate [plane units].
    """

    targets: Array
    points: Array
    model: HabitModel
    left_out: Mapping[HabitModel, float]
    coefficients: Array
    scatter: float
    _terms_covariance: Array
    _rate: float
    _hull: Array

    @classmethod
    def of(cls, targets: ArrayLike, points: ArrayLike) -> Habit:
        """Estimate a habit from indicated points of known targets.

        Parameters
        ----------
        targets : (N, 2)
            At least `MIN_TARGETS` different targets [plane units].
        points : (N, 2)
            Points indicated for them, in the same order.

        Raises
        ------
        InvalidInputError
            Wrong shapes, NaN, too few targets, targets on a line, or points that do not match the
            targets: their error varies at least half as much as the targets do.
        """
        targets = finite_array(targets, "targets", ("N", 2))
        points = finite_array(points, "points", ("N", 2))
        _refuse_unfit(targets, points)
        left_out = {model: _left_out(model, targets, points) for model in HabitModel}
        model = _chosen(left_out)
        Φ = _terms(model, _scaled(points, points))
        errors = points - targets
        B = np.asarray(np.linalg.lstsq(Φ, errors, rcond=None)[0], np.float64)
        freedom = errors.size - B.size
        scatter = math.sqrt(float(np.sum((errors - Φ @ B) ** 2)) / freedom)
        variance = _widening(freedom) * scatter**2
        # The habit beyond the targets is not measured: at a distance equal to their spread, its
        # standard deviation is taken to be as large as the habit itself.
        usual = math.sqrt(float(np.mean(np.sum(errors**2, axis=1))))
        return cls(
            targets,
            points,
            model,
            {known: _root_mean(each) for known, each in left_out.items() if each is not None},
            B,
            scatter,
            np.asarray(variance * np.linalg.inv(Φ.T @ Φ), np.float64),
            usual / _spread(points),
            points[_hull(points)],
        )

    def error(self, points: ArrayLike) -> Array:
        """Predict the error of a person's indicated points.

        Parameters
        ----------
        points : (K, 2)
            Indicated points [plane units].

        Returns
        -------
        (K, 2)
            To be subtracted from the points [plane units]; outside the hull, the error at its
            nearest point.
        """
        points = finite_array(points, "points", ("K", 2))
        nearest = np.array([_nearest(self._hull, point)[0] for point in points]).reshape(-1, 2)
        return _terms(self.model, _scaled(nearest, self.points)) @ self.coefficients

    def meant(self, point: ArrayLike, covariance: ArrayLike) -> Meant:
        """Estimate the intended point for an indicated one.

        Parameters
        ----------
        point : (2,)
            The indicated point [plane units].
        covariance : (2, 2)
            Its covariance [plane units²].

        Raises
        ------
        InvalidInputError
            Wrong shapes, NaN, or a matrix that is not a covariance.
        """
        p = finite_array(point, "point", (2,))
        Σ_p = covariance_array(covariance, "covariance", (2, 2))
        nearest, by_point = _nearest(self._hull, p)
        beyond = math.hypot(*(p - nearest))
        z = _scaled(nearest[None], self.points)
        φ = _terms(self.model, z)[0]
        by_z = _terms_jacobian(self.model, z[0]) / _spread(self.points)
        J = np.eye(2) - self.coefficients.T @ by_z @ by_point
        # The scatter at calibration contains the noise of those points. It is not subtracted: the
        # part that all frames of a visit share is unknown.
        own = self._scatter_variance + φ @ self._terms_covariance @ φ + (self._rate * beyond) ** 2
        Σ = J @ Σ_p @ J.T + own * np.eye(2)
        return Meant(p - φ @ self.coefficients, (Σ + Σ.T) / 2.0, beyond)

    @property
    def _scatter_variance(self) -> float:
        return _widening(self.points.size - self.coefficients.size) * self.scatter**2


def _widening(freedom: int) -> float:
    """Return the inflation factor of a variance that is estimated with ν degrees of freedom.

    The squared distance of a point over an estimated variance is distributed as 2 F(2, ν), not
    χ²(2): the factor is the quotient of their quantiles at `CONFIDENCE`, and 1 for ν → ∞. F(2, ν)
    has closed-form quantiles, ``(ν/2) ((1 − q)^(−2/ν) − 1)``.
    """
    outside = 1.0 - CONFIDENCE
    return freedom * (math.pow(outside, -2.0 / freedom) - 1.0) / (-2.0 * math.log(outside))


def _refuse_unfit(targets: Array, points: Array) -> None:
    """Refuse targets and points from which no habit can be estimated.

    Raises
    ------
    InvalidInputError
    """
    if len(targets) != len(points):
        raise InvalidInputError(
            f"{len(points)} points of {len(targets)} targets; one each is right"
        )
    different = len(np.unique(targets, axis=0))
    if different < MIN_TARGETS:
        raise InvalidInputError(
            f"{different} different targets; a habit is estimated from {MIN_TARGETS} or more"
        )
    if np.linalg.matrix_rank(targets - targets.mean(axis=0), tol=0.05 * _spread(targets)) < 2:
        raise InvalidInputError("the targets lie on a line; they are to span an area")
    varies, most = _spread(points - targets), 0.5 * _spread(targets)
    if not varies < most:
        raise InvalidInputError(
            f"the points do not go with the targets: from one to the next their error varies by "
            f"{varies:.3g}, and less than {most:.3g} is a habit; were the targets pointed at in "
            "this order?"
        )


def _spread(points: Array) -> float:
    """Root mean square distance from the centroid."""
    return math.sqrt(float(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1))))


def _scaled(points: Array, among: Array) -> Array:
    return np.asarray((points - among.mean(axis=0)) / _spread(among))


def _terms(model: HabitModel, z: Array) -> Array:
    """Return φ at centred and scaled points (K, 2): (K, M)."""
    x, y = z.T
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)[:, : _TERMS[model]]


def _terms_jacobian(model: HabitModel, z: Array) -> Array:
    """Return ∂φ/∂z at one point: (M, 2)."""
    x, y = z.tolist()
    by_z = np.array([[0, 0], [1, 0], [0, 1], [2 * x, 0], [y, x], [0, 2 * y]], np.float64)
    return by_z[: _TERMS[model]]


def _left_out(model: HabitModel, targets: Array, points: Array) -> Array | None:
    """Return the squared leave-one-out error of each target; None with too few targets."""
    _, group = np.unique(targets, axis=0, return_inverse=True)
    group, count = group.ravel(), int(group.max()) + 1
    if count - 1 <= _TERMS[model]:
        return None
    Φ, errors = _terms(model, _scaled(points, points)), points - targets
    squares = np.empty(count)
    for left in range(count):
        held = group == left
        B, _, rank, _ = np.linalg.lstsq(Φ[~held], errors[~held], rcond=None)
        if rank < _TERMS[model]:
            return None
        squares[left] = np.mean(np.sum((errors[held] - Φ[held] @ B) ** 2, axis=1))
    return squares


def _chosen(left_out: Mapping[HabitModel, Array | None]) -> HabitModel:
    """Choose the simplest model that no richer one beats by `STANDARD_ERRORS`."""
    chosen, best = HabitModel.OFFSET, left_out[HabitModel.OFFSET]
    assert best is not None  # there are enough targets
    for model, squares in left_out.items():
        if squares is None:
            continue
        gain = best - squares
        if gain.mean() > STANDARD_ERRORS * gain.std(ddof=1) / math.sqrt(len(gain)):
            chosen, best = model, squares
    return chosen


def _root_mean(squares: Array) -> float:
    return math.sqrt(float(squares.mean()))


def _hull(points: Array) -> list[int]:
    """Return the indices of the convex hull, in order: A. M. Andrew's monotone chain (1979)."""
    order = np.lexsort(points.T[::-1]).tolist()

    def chain(ranked: list[int]) -> list[int]:
        found: list[int] = []
        for k in ranked:
            while len(found) > 1 and _turn(*points[[found[-2], found[-1], k]]) <= 0.0:
                found.pop()
            found.append(k)
        return found[:-1]

    return chain(order) + chain(order[::-1])


def _turn(a: Array, b: Array, c: Array) -> float:
    """Return a number above 0 if a, b, c turn from +x towards +y."""
    (ux, uy), (vx, vy) = (b - a).tolist(), (c - a).tolist()
    return float(ux * vy - uy * vx)


def _nearest(corners: Array, point: Array) -> tuple[Array, Array]:
    """Return the nearest point of a convex polygon and its derivative by the point (2, 2)."""
    along = np.roll(corners, -1, axis=0) - corners
    away = point - corners
    if (along[:, 0] * away[:, 1] - along[:, 1] * away[:, 0] >= 0.0).all():
        return point, np.eye(2)
    lengths = np.sum(along**2, axis=1)
    share = np.clip(np.sum(away * along, axis=1) / lengths, 0.0, 1.0)
    places = corners + share[:, None] * along
    side = int(np.argmin(np.sum((point - places) ** 2, axis=1)))
    on_side = 0.0 < share[side] < 1.0
    by_point = np.outer(along[side], along[side]) / lengths[side] if on_side else np.zeros((2, 2))
    return places[side], by_point
