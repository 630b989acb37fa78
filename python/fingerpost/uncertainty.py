"""How sure the indicated point is: covariances from reference points and finger lines to a fix.

Everything is first order, with one exception where first order would flatter itself
(`widened_covariance`). The chain, with ``h`` the entries of a view's homography ``T``:

1. reference points → ``Σ_h = G Σ_points Gᵀ``, ``G`` the derivative of the least-squares estimate;
2. finger line (offset, angle) → ``Σ_l = J Σ Jᵀ`` of the image line ``l``;
3. constraint line ``m = Tᵀ l`` (Cipolla, Hadfield & Hollinghurst 1994, eq. 2):
   ``Σ_m = Tᵀ Σ_l T + (∂m/∂h) Σ_h (∂m/∂h)ᵀ``;
4. the point X most likely to lie on N ≥ 2 constraint lines, which minimises
   ``Σ (m·X~)² / (X~ᵀ Σ_m X~)``, the variances being those at X.

Step 4 is the likelihood in the images written on the plane: with ``W`` of eq. 1,
``m·X~ / W = l·x~`` is the distance in pixels between the reprojected point and the finger line, and
``X~ᵀ Σ_m X~ / W²`` its variance there, which grows with the lever from the finger to the point.

The paper draws an ellipse "two standard deviations (95 %)" from the point; in two dimensions two
standard deviations hold 86.5 %. `confidence_ellipse` uses the distribution of two dimensions;
`nsigma_ellipse` is the paper's recipe.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.checks import covariance_array, finite_array, in_range
from fingerpost.errors import InvalidInputError
from fingerpost.homography import entries_from_reference_points
from fingerpost.lines import constraint_line, line_at_angle, line_at_angle_jacobian

# No line is known better than its arithmetic: this share of the coordinates is the least standard
# deviation a distance can have. It stands in for lines given as exact.
_ROUNDING = 1e-12

# Variances further apart than this would only spoil the 2 × 2 system: next to a line a thousand
# times surer the other's share in the weight is a millionth either way.
_LEAST_RATIO = 1e-6
_TINY = float(np.finfo(np.float64).tiny)

# Directions closer than this [rad] are parallel: beyond, the 2 × 2 system is singular to rounding.
_PARALLEL_RAD = 1e-7

UNBOUNDED: NDArray[np.float64] = np.diag([np.inf, np.inf])
"""Covariance of a point that nothing holds; not to be written to."""
UNBOUNDED.setflags(write=False)

# Reweighting moves the point of N ≥ 3 views by a share of its own standard deviation; two or three
# steps settle it. Two views meet exactly at the first.
_MAX_ITERATIONS = 50
_CONVERGED_SHARE = 1e-6


@dataclass(frozen=True, eq=False)
class Ellipse:
    """Ellipse on the working plane.

    Parameters
    ----------
    centre : (2,)
        Plane units.
    semi_axes : (2,)
        Plane units, the larger first.
    angle_rad
        Direction of the larger axis in plane coordinates, from 0 to π [rad].
    """

    centre: NDArray[np.float64]
    semi_axes: NDArray[np.float64]
    angle_rad: float

    @property
    def area(self) -> float:
        """Area [plane units²]."""
        return float(np.pi * self.semi_axes.prod())

    def polygon(self, count: int = 64) -> NDArray[np.float64]:
        """Points on the ellipse at equal steps of its parameter, to be drawn.

        Parameters
        ----------
        count
            Number of points, ≥ 3; the first is not repeated at the end.

        Returns
        -------
        (count, 2)
        """
        if count < 3:
            raise InvalidInputError(f"polygon of {count} points; at least 3 are needed")
        turn = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
        circle = np.column_stack([np.cos(turn), np.sin(turn)])
        return np.asarray(self.centre + (circle * self.semi_axes) @ self._axes())

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether points lie inside or on the ellipse.

        Parameters
        ----------
        points : (..., 2)
            Plane units.

        Returns
        -------
        (...)
        """
        points = finite_array(points, "points", (..., 2))
        along = (points - self.centre) @ self._axes().T
        return np.asarray(np.hypot(*np.moveaxis(along / self.semi_axes, -1, 0)) <= 1.0)

    def _axes(self) -> NDArray[np.float64]:
        """Give the unit vectors of the axes, as rows."""
        c, s = np.cos(self.angle_rad), np.sin(self.angle_rad)
        return np.array([[c, s], [-s, c]])


@dataclass(frozen=True, eq=False)
class Intersection:
    """Where N constraint lines meet.

    Parameters
    ----------
    point : (2,)
        Most likely point [plane units]; NaN if there is none.
    covariance : (2, 2)
        First order, at `point` [plane units²]; infinite on the diagonal if there is none.
    chi2
        Sum of the squared residuals over their variances; χ² with N − 2 degrees of freedom if the
        covariances are true, 0 for two views.
    """

    point: NDArray[np.float64]
    covariance: NDArray[np.float64]
    chi2: float


def homography_covariance(
    image_from_plane: ArrayLike, plane_points: ArrayLike, covariances_px2: ArrayLike
) -> NDArray[np.float64]:
    """Covariance of an estimated homography from those of its reference points.

    Parameters
    ----------
    image_from_plane : (3, 3)
        As `fingerpost.homography.estimate_image_from_plane` gives it for the same points and
        covariances.
    plane_points : (N, 2)
        Reference points on the plane, known exactly.
    covariances_px2 : (2, 2) or (N, 2, 2)
        Covariance of each image point [px²], positive definite.

    Returns
    -------
    (9, 9)
        Of the entries row by row, of rank 8: the scale of a homography means nothing, and entries
        vary in the gauge of `fingerpost.homography.entries_from_reference_points`.
    """
    plane = finite_array(plane_points, "plane_points", ("N", 2))
    covariances = covariance_array(covariances_px2, "covariances_px2", (..., 2, 2))
    gain = entries_from_reference_points(image_from_plane, plane, covariances)
    gain = gain.reshape(9, len(plane), 2)
    each = np.broadcast_to(covariances, (len(plane), 2, 2))
    weighted = (gain[:, :, None] @ each).reshape(9, -1)
    return np.asarray(weighted @ gain.reshape(9, -1).T)


def image_line_covariance(
    anchor_px: ArrayLike, angle_rad: ArrayLike, covariance: ArrayLike
) -> NDArray[np.float64]:
    """Covariance of the homogeneous line through an anchor at an angle.

    Parameters
    ----------
    anchor_px : (..., 2)
    angle_rad : (...)
    covariance : (..., 2, 2)
        Of (offset along the normal [px], angle [rad]) at the anchor.

    Returns
    -------
    (..., 3, 3)
        Of ``(n, −n·anchor)``, of rank 2.
    """
    covariance = finite_array(covariance, "covariance", (..., 2, 2))
    jacobian = line_at_angle_jacobian(anchor_px, angle_rad)
    return np.asarray(jacobian @ covariance @ np.swapaxes(jacobian, -1, -2))


def constraint_line_covariance(
    image_from_plane: ArrayLike,
    entries_covariance: ArrayLike,
    image_line: ArrayLike,
    line_covariance: ArrayLike,
) -> NDArray[np.float64]:
    """Covariance of `fingerpost.lines.constraint_line`, finger line and homography counted.

    Parameters
    ----------
    image_from_plane : (..., 3, 3)
    entries_covariance : (..., 9, 9)
        Of the homography's entries; zero for one known exactly.
    image_line : (..., 3)
        Normalised to ``a² + b² = 1``.
    line_covariance : (..., 3, 3)
        Of the image line.

    Returns
    -------
    (..., 3, 3)
        Of the constraint line normalised to ``a² + b² = 1``; NaN for the plane's horizon. For a
        point on the line ``X~ᵀ Σ X~`` is the variance of its distance [plane units²].
    """
    T = finite_array(image_from_plane, "image_from_plane", (..., 3, 3))
    entries = finite_array(entries_covariance, "entries_covariance", (..., 9, 9))
    line = finite_array(image_line, "image_line", (..., 3))
    line_covariance = finite_array(line_covariance, "line_covariance", (..., 3, 3))
    from_line = np.swapaxes(T, -1, -2) @ line_covariance @ T
    # ∂m/∂h = [a I, b I, c I]: the entries stand row by row, and l_i multiplies row i of T.
    by_entries = line[..., None, :, None] * np.eye(3)[:, None, :]
    by_entries = by_entries.reshape(*line.shape[:-1], 3, 9)
    from_entries = by_entries @ entries @ np.swapaxes(by_entries, -1, -2)
    normal = line[..., None, :] @ T[..., :2]
    scale = normal @ np.swapaxes(normal, -1, -2)
    return np.asarray((from_line + from_entries) / np.where(scale > 0.0, scale, np.nan))


def intersect(lines: ArrayLike, covariances: ArrayLike) -> Intersection:
    """Maximum-likelihood intersection of N ≥ 2 constraint lines.

    Gauss-Newton on ``Σ (m·X~)² / (X~ᵀ Σ_m X~)``, the variances taken at the current point: a far
    point weighs a line by what its angle is worth out there. For two lines it is the point where
    they meet.

    Parameters
    ----------
    lines : (N, 3)
        Constraint lines with ``a² + b² = 1``.
    covariances : (N, 3, 3)
        Theirs; zero for a line known exactly.

    Returns
    -------
    Intersection
        With a point of NaN if all lines are parallel to rounding, or so nearly that reweighting
        does not settle.

    Raises
    ------
    InvalidInputError
        Fewer than two lines, other shapes, NaN.
    """
    lines = finite_array(lines, "lines", ("N", 3))
    covariances = finite_array(covariances, "covariances", (len(lines), 3, 3))
    if len(lines) < 2:
        raise InvalidInputError(f"{len(lines)} constraint line; two or more meet in a point")
    normals = lines[:, :2]
    undetermined = Intersection(np.full(2, np.nan), UNBOUNDED, 0.0)
    covariance = _inverse_2x2(normals.T @ normals)  # at first all lines count alike
    if covariance is None:
        return undetermined
    X = -covariance @ (lines[:, 2] @ normals)
    for _ in range(_MAX_ITERATIONS):
        residuals, variances = _distances(lines, covariances, X)
        weighted = normals / variances[:, None]
        covariance = _inverse_2x2(normals.T @ weighted)
        if covariance is None:
            return undetermined
        step = covariance @ (residuals @ weighted)
        X = X - step
        sigma = math.sqrt(covariance[0, 0] + covariance[1, 1])
        rounding = _ROUNDING * max(abs(X).max(), abs(lines[:, 2]).max())
        if abs(step).max() <= max(_CONVERGED_SHARE * sigma, rounding):
            break
    else:
        return undetermined
    residuals, variances = _distances(lines, covariances, X)
    return Intersection(X, covariance, float(residuals @ (residuals / variances)))


def widened_covariance(
    lines: ArrayLike, covariances: ArrayLike, found: Intersection, distance: float
) -> NDArray[np.float64]:
    """Covariance of an intersection that cannot be surer than a look from `distance` away.

    When the lines are nearly parallel the point found is an accident, and so is the first-order
    covariance at it, which looks at the angle between the lines as if it were known: the true
    point may be several standard deviations off. So ask about the two points at `distance` on
    either side along the weakest direction (the major axis), each shifted across it to where it
    is most likely: by how many standard deviations ``z`` do the lines exclude them, with the
    variances that hold out there? If by less than the major axis promises, the axis becomes
    ``distance / z``. For two lines this is Fieller's interval of a quotient, whose ends run to
    infinity when the divisor, the angle, is not significant.

    Parameters
    ----------
    lines, covariances
        As given to `intersect`.
    found
        What it answered.
    distance
        Plane units, > 0.

    Returns
    -------
    (2, 2)
        The minor axis unchanged, the major axis that of `found` or longer; infinite on the
        diagonal if the points at `distance` are not excluded at all, or there is no point.
    """
    lines = finite_array(lines, "lines", ("N", 3))
    covariances = finite_array(covariances, "covariances", (len(lines), 3, 3))
    distance = in_range(distance, "distance", np.finfo(np.float64).tiny)
    if not np.isfinite(found.covariance).all():
        return UNBOUNDED
    (_, major), (across, along) = _principal_axes(found.covariance)
    shift = lines[:, :2] @ across
    widest = major
    for X in (found.point + distance * along, found.point - distance * along):
        residuals, variances = _distances(lines, covariances, X)
        weighted = shift / variances
        chi2 = residuals @ (residuals / variances) - (residuals @ weighted) ** 2 / (
            shift @ weighted
        )
        excluded = chi2 - found.chi2
        if excluded * widest < distance**2:
            widest = distance**2 / excluded if excluded > 0.0 else math.inf
    if not math.isfinite(widest):
        return UNBOUNDED
    return np.asarray(found.covariance + (widest - major) * np.outer(along, along))


def confidence_ellipse(
    point: ArrayLike, covariance: ArrayLike, confidence: float = 0.95
) -> Ellipse:
    """Ellipse that holds the true point with a given probability.

    Parameters
    ----------
    point : (2,)
        Plane units.
    covariance : (2, 2)
        Plane units², finite.
    confidence
        Probability, from 0 to below 1. In two dimensions the squared Mahalanobis distance is χ²
        with 2 degrees of freedom, whose quantile is ``−2 ln(1 − confidence)``: 5.991 at 0.95.

    Returns
    -------
    Ellipse
    """
    point = finite_array(point, "point", (2,))
    covariance = covariance_array(covariance, "covariance", (2, 2))
    if not 0.0 <= confidence < 1.0:
        raise InvalidInputError(f"confidence is {confidence}; from 0 to below 1 is right")
    return _ellipse(point, covariance, np.sqrt(-2.0 * np.log1p(-confidence)))


def nsigma_ellipse(
    image_from_plane: ArrayLike,
    anchor_px: ArrayLike,
    angle_rad: ArrayLike,
    covariance: ArrayLike,
    nsigma: float = 2.0,
) -> Ellipse:
    """Draw the paper's ellipse: ±2σ perturbations of each finger line, projected onto the plane.

    Position and orientation of each line are perturbed in turn by ``± nsigma`` of their standard
    deviations; the displacements of the intersection add up as independent. Left as the paper has
    it: their correlation and the uncertainty of the reference points are not counted, and at
    ``nsigma = 2`` the ellipse of a normal distribution holds 86.5 %.

    Parameters
    ----------
    image_from_plane : (N, 3, 3)
        Homographies of N ≥ 2 views.
    anchor_px : (N, 2)
    angle_rad : (N,)
    covariance : (N, 2, 2)
        Of (offset [px], angle [rad]) at the anchor.
    nsigma
        Size of the perturbations in standard deviations, > 0.

    Returns
    -------
    Ellipse
        About the intersection of the unperturbed constraint lines.

    Raises
    ------
    InvalidInputError
        Fewer than two views, other shapes, NaN, or lines that are parallel, as measured or when
        perturbed: the recipe has no ellipse for them.
    """
    T = finite_array(image_from_plane, "image_from_plane", ("N", 3, 3))
    anchor = finite_array(anchor_px, "anchor_px", (len(T), 2))
    angle = finite_array(angle_rad, "angle_rad", (len(T),))
    covariance = covariance_array(covariance, "covariance", (len(T), 2, 2))
    nsigma = in_range(nsigma, "nsigma", np.finfo(np.float64).tiny)

    exact = np.zeros((len(T), 9, 9))

    def meeting(anchor: NDArray[np.float64], angle: NDArray[np.float64]) -> NDArray[np.float64]:
        image_lines = line_at_angle(anchor, angle)
        spread = image_line_covariance(anchor, angle, covariance)
        return intersect(
            constraint_line(T, image_lines),
            constraint_line_covariance(T, exact, image_lines, spread),
        ).point

    sigma = nsigma * np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    normal = np.column_stack([-np.sin(angle), np.cos(angle)])
    one_view = np.eye(len(T))
    displacements = [
        (meeting(anchor + shift, angle + turn) - meeting(anchor - shift, angle - turn)) / 2
        for only in one_view
        for shift, turn in (
            ((only * sigma[:, 0])[:, None] * normal, 0.0 * angle),
            (0.0 * anchor, only * sigma[:, 1]),
        )
    ]
    point, spread = meeting(anchor, angle), np.array(displacements)
    if not (np.isfinite(point).all() and np.isfinite(spread).all()):
        raise InvalidInputError("the constraint lines are parallel; no ellipse is that large")
    return _ellipse(point, spread.T @ spread, 1.0)


def _distances(
    lines: NDArray[np.float64], covariances: NDArray[np.float64], X: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distances of a point from lines, and the variances of these distances."""
    homogeneous = np.array([X[0], X[1], 1.0])
    variances = (covariances @ homogeneous) @ homogeneous
    floor = max(_ROUNDING**2 * (X @ X), _LEAST_RATIO * variances.max(), _TINY)
    return lines @ homogeneous, np.maximum(variances, floor)


def _inverse_2x2(matrix: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Inverse of an information matrix; None if its lines are parallel to rounding."""
    (a, b), (_, d) = matrix.tolist()
    determinant = a * d - b * b
    if determinant <= (_PARALLEL_RAD * (a + d)) ** 2:
        return None
    return np.asarray(np.array([[d, -b], [-b, a]]) / determinant)


def _principal_axes(
    covariance: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Variances, the smaller first, and their unit directions as rows."""
    variances, directions = np.linalg.eigh(covariance)
    return np.maximum(variances, 0.0), directions.T


def _ellipse(centre: NDArray[np.float64], covariance: NDArray[np.float64], scale: float) -> Ellipse:
    variances, (_, major) = _principal_axes(covariance)
    angle = float(np.arctan2(major[1], major[0]) % np.pi)
    return Ellipse(centre, scale * np.sqrt(variances[::-1]), angle)
