"""Uncertainty of the indicated point: covariances from reference points and finger lines to a fix.

Propagation is first order, except where first order underestimates the covariance
(`widened_covariance`). The chain, with ``h`` the entries of a view's homography ``T``:

1. reference points → ``Σ_h = G Σ_points Gᵀ``, ``G`` the derivative of the least-squares estimate;
2. finger line (offset, angle) → ``Σ_l = J Σ Jᵀ`` of the image line ``l``;
3. constraint line ``m = Tᵀ l`` (Cipolla, Hadfield & Hollinghurst 1994, eq. 2):
   ``Σ_m = Tᵀ Σ_l T + (∂m/∂h) Σ_h (∂m/∂h)ᵀ``;
4. maximum-likelihood intersection X of N ≥ 2 constraint lines, which minimises
   ``Σ (m·X~)² / (X~ᵀ Σ_m X~)``, with the variances at X.

Step 4 is the likelihood of the images expressed on the plane: with ``W`` of eq. 1,
``m·X~ / W = l·x~`` is the distance in pixels between the reprojected point and the finger line, and
``X~ᵀ Σ_m X~ / W²`` its variance there, which increases with the distance from finger to point.

The paper draws an ellipse "two standard deviations (95 %)" from the point; in two dimensions two
standard deviations contain 86.5 %. `confidence_ellipse` uses the two-dimensional distribution;
`nsigma_ellipse` is the paper's recipe.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.checks import covariance_array, finite_array, in_range
from fingerpost.errors import InvalidInputError
from fingerpost.homography import entries_from_reference_points
from fingerpost.lines import normalised

# Least standard deviation of a distance [share of the coordinates], from rounding. It applies to
# lines given as exact.
_ROUNDING = 1e-12

Constraint = tuple[float, float, float, float, float, float, float, float, float]
"""A constraint line ``(a, b, c)`` and the coefficients of xx, xy, x, yy, y and 1 in the variance of
the distance of (x, y) from it. For the few lines of a frame, plain floats are many times faster
than arrays. `constraint` makes one."""

# Least ratio of two variances. A larger range would only make the 2 × 2 system ill-conditioned: a
# line with a thousand times the standard deviation has a millionth of the weight in either case.
_LEAST_RATIO = 1e-6
_TINY = float(np.finfo(np.float64).tiny)

# Directions closer than this [rad] are parallel: the 2 × 2 system would be singular to rounding.
_PARALLEL_RAD = 1e-7

UNBOUNDED: NDArray[np.float64] = np.diag([np.inf, np.inf])
"""Covariance of an undetermined point; read-only."""
UNBOUNDED.setflags(write=False)

# Reweighting moves the point of N ≥ 3 views by a share of its standard deviation, and converges in
# two or three steps. Two lines intersect exactly at the first.
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
        """Return points on the ellipse at equal steps of its parameter, for drawing.

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
        """Return the unit vectors of the axes, as rows."""
        c, s = np.cos(self.angle_rad), np.sin(self.angle_rad)
        return np.array([[c, s], [-s, c]])


@dataclass(frozen=True, eq=False)
class Intersection:
    """Intersection of N constraint lines.

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


UNDETERMINED = Intersection(np.full(2, np.nan), UNBOUNDED, 0.0)
"""Intersection of parallel lines; read-only."""
UNDETERMINED.point.setflags(write=False)


def homography_covariance(
    image_from_plane: ArrayLike, plane_points: ArrayLike, covariances_px2: ArrayLike
) -> NDArray[np.float64]:
    """Return the covariance of an estimated homography from those of its reference points.

    Parameters
    ----------
    image_from_plane : (3, 3)
        Result of `fingerpost.homography.estimate_image_from_plane` for the same points and
        covariances.
    plane_points : (N, 2)
        Reference points on the plane, known exactly.
    covariances_px2 : (2, 2), (N, 2, 2) or (2N, 2N)
        Covariance of each image point [px²], positive definite; or the joint covariance of u and v
        of all points, in order, if their errors are correlated.

    Returns
    -------
    (9, 9)
        Covariance of the entries row by row, of rank 8: the scale of a homography is arbitrary, and
        is fixed by the gauge of `fingerpost.homography.entries_from_reference_points`.
    """
    plane = finite_array(plane_points, "plane_points", ("N", 2))
    joint = np.shape(covariances_px2) == (2 * len(plane), 2 * len(plane))
    shape = (2 * len(plane), 2 * len(plane)) if joint else (..., 2, 2)
    covariances = covariance_array(covariances_px2, "covariances_px2", shape)
    each = blocks_of(covariances) if joint else covariances
    gain = entries_from_reference_points(image_from_plane, plane, each)
    if joint:
        return np.asarray(gain @ covariances @ gain.T)
    gain = gain.reshape(9, len(plane), 2)
    each = np.broadcast_to(covariances, (len(plane), 2, 2))
    weighted = (gain[:, :, None] @ each).reshape(9, -1)
    return np.asarray(weighted @ gain.reshape(9, -1).T)


def blocks_of(joint: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariance of each point, (N, 2, 2), from the joint covariance, (2N, 2N)."""
    count = len(joint) // 2
    k = np.arange(count)
    return np.asarray(joint.reshape(count, 2, count, 2)[k, :, k, :])


def joint_of(blocks: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the joint covariance of independent points, (2N, 2N), from that of each, (N, 2, 2)."""
    count = len(blocks)
    joint = np.zeros((count, 2, count, 2))
    k = np.arange(count)
    joint[k, :, k, :] = blocks
    return joint.reshape(2 * count, 2 * count)


def constraint_lines(
    image_from_plane: ArrayLike,
    entries_covariance: ArrayLike,
    anchor_px: ArrayLike,
    angle_rad: ArrayLike,
    covariance: ArrayLike,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return constraint lines, with covariances that include finger line and homography.

    Parameters
    ----------
    image_from_plane : (..., 3, 3)
    entries_covariance : (..., 9, 9)
        Of the homography's entries; zero if it is known exactly.
    anchor_px : (..., 2)
        A point of the finger line.
    angle_rad : (...)
        Its direction [rad].
    covariance : (..., 2, 2)
        Of (offset along the normal [px], angle [rad]) at the anchor.

    Returns
    -------
    lines : (..., 3)
        As `fingerpost.lines.constraint_line` of `fingerpost.lines.line_at_angle`.
    covariances : (..., 3, 3)
        Of the lines. For a point on a line, ``X~ᵀ Σ X~`` is the variance of its distance [plane
        units²]. NaN, as the line, for the plane's horizon.
    """
    T = finite_array(image_from_plane, "image_from_plane", (..., 3, 3))
    form = entries_form(entries_covariance)
    anchor = finite_array(anchor_px, "anchor_px", (..., 2))
    angle = finite_array(angle_rad, "angle_rad", (...,))
    spread = finite_array(covariance, "covariance", (..., 2, 2))
    (a, b, c), entries = constraint_components(
        list(np.moveaxis(T, (-2, -1), (0, 1))),
        list(np.moveaxis(form, (-2, -1), (0, 1))),
        (anchor[..., 0], anchor[..., 1]),
        (np.cos(angle), np.sin(angle)),
        (spread[..., 0, 0], spread[..., 0, 1], spread[..., 1, 1]),
    )
    lines = np.stack(np.broadcast_arrays(a, b, c), axis=-1)
    scale = np.square(lines[..., :2]).sum(axis=-1)
    covariances = np.stack(np.broadcast_arrays(*entries), axis=-1)[..., _SYMMETRIC]
    return normalised(lines), covariances / np.where(scale > 0.0, scale, np.nan)[..., None, None]


# Index of every entry of a symmetric 3 × 3 matrix in its upper triangle, row by row.
_SYMMETRIC = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


def entries_form(entries_covariance: ArrayLike) -> NDArray[np.float64]:
    """Return the covariance of a homography's entries in the form for `constraint_components`.

    With ``∂m/∂h = [a I, b I, c I]`` (the entries are in row order, and l_i multiplies row i of T)
    the covariance ``(∂m/∂h) Σ_h (∂m/∂h)ᵀ`` is linear in the products of a, b and c.

    Parameters
    ----------
    entries_covariance : (..., 9, 9)

    Returns
    -------
    (..., 6, 6)
        Rows: upper triangle of the 3 × 3 covariance, row by row. Columns: aa, ab, ac, bb, bc, cc.
    """
    Σ_h = finite_array(entries_covariance, "entries_covariance", (..., 9, 9))
    i, j = np.triu_indices(3)
    p, q = i[:, None], j[:, None]
    mixed = Σ_h[..., 3 * j + p, 3 * i + q]
    return np.asarray(Σ_h[..., 3 * i + p, 3 * j + q] + np.where(i < j, mixed, 0.0))


Numbers = Any
"""A float or an array; the arithmetic is the same."""


def constraint_components(
    image_from_plane: Sequence[Iterable[Numbers]],
    entries_form: Sequence[Iterable[Numbers]],
    anchor_px: tuple[Numbers, Numbers],
    direction: tuple[Numbers, Numbers],
    covariance: tuple[Numbers, Numbers, Numbers],
) -> tuple[tuple[Numbers, Numbers, Numbers], list[Numbers]]:
    """Return the constraint line of a finger line and its covariance, entry by entry.

    Steps 2 and 3 of the chain in one. For the few lines of a frame, floats are many times faster
    than arrays.

    Parameters
    ----------
    image_from_plane : 3 × 3
    entries_form : 6 × 6
        See `entries_form`.
    anchor_px
        (u, v)
    direction
        (cos, sin) of the finger line's angle.
    covariance
        Variance of the offset, covariance, variance of the angle.

    Returns
    -------
    line
        ``m = Tᵀ l_i``, of arbitrary scale.
    covariance
        Upper triangle of its covariance at that scale, row by row.
    """
    (t11, t12, t13), (t21, t22, t23), (t31, t32, t33) = image_from_plane
    (u, v), (cos, sin), (offset, both, angle) = anchor_px, direction, covariance
    # l_i = (−sin, cos, c); its derivative is (−cos, −sin, along) by the angle, and (0, 0, −1) by
    # the offset.
    c, along = sin * u - cos * v, cos * u + sin * v
    m1, m2, m3 = (
        cos * t21 - sin * t11 + c * t31,
        cos * t22 - sin * t12 + c * t32,
        cos * t23 - sin * t13 + c * t33,
    )
    g1, g2, g3 = (
        along * t31 - cos * t11 - sin * t21,
        along * t32 - cos * t12 - sin * t22,
        along * t33 - cos * t13 - sin * t23,
    )
    # Covariances of m with the offset and with the angle.
    d1, d2, d3 = both * g1 - offset * t31, both * g2 - offset * t32, both * g3 - offset * t33
    e1, e2, e3 = angle * g1 - both * t31, angle * g2 - both * t32, angle * g3 - both * t33
    from_line = (
        g1 * e1 - t31 * d1,
        g1 * e2 - t31 * d2,
        g1 * e3 - t31 * d3,
        g2 * e2 - t32 * d2,
        g2 * e3 - t32 * d3,
        g3 * e3 - t33 * d3,
    )
    aa, ab, ac, bb, bc, cc = sin * sin, -sin * cos, -sin * c, cos * cos, cos * c, c * c
    return (m1, m2, m3), [
        known + aa * f1 + ab * f2 + ac * f3 + bb * f4 + bc * f5 + cc * f6
        for known, (f1, f2, f3, f4, f5, f6) in zip(from_line, entries_form, strict=True)
    ]


def intersect(lines: ArrayLike, covariances: ArrayLike) -> Intersection:
    """Return the maximum-likelihood intersection of N ≥ 2 constraint lines.

    Gauss-Newton on ``Σ (m·X~)² / (X~ᵀ Σ_m X~)`` with the variances at the current point: for a
    distant point, the uncertainty of the angle reduces a line's weight. Two lines have their exact
    intersection.

    Parameters
    ----------
    lines : (N, 3)
        Constraint lines with ``a² + b² = 1``.
    covariances : (N, 3, 3)
        Of the lines; zero for a line known exactly.

    Returns
    -------
    Intersection
        Its point is NaN if all lines are parallel to rounding, or so nearly parallel that
        reweighting does not converge.

    Raises
    ------
    InvalidInputError
        Fewer than two lines, other shapes, NaN.
    """
    lines = finite_array(lines, "lines", ("N", 3))
    covariances = finite_array(covariances, "covariances", (len(lines), 3, 3))
    if len(lines) < 2:
        raise InvalidInputError(f"{len(lines)} constraint line; two or more meet in a point")
    return meeting_point(_constraints(lines, covariances))


def meeting_point(constraints: Sequence[Constraint]) -> Intersection:
    """Return the result of `intersect` for checked lines.

    Parameters
    ----------
    constraints
        N ≥ 2 lines.

    Returns
    -------
    Intersection
    """
    x = y = 0.0
    # In the first step, from any point to the approximate intersection, the weights are equal.
    residuals, variances = [line[2] for line in constraints], [1.0] * len(constraints)
    for iteration in range(_MAX_ITERATIONS + 1):
        solved = _solved(constraints, residuals, variances)
        if solved is None:
            return UNDETERMINED
        dx, dy, xx, xy, yy = solved
        x, y = x - dx, y - dy
        residuals, variances = _distances(constraints, x, y)
        sigma = math.sqrt(xx + yy)
        rounding = _ROUNDING * max(abs(x), abs(y), *(abs(line[2]) for line in constraints))
        if iteration and max(abs(dx), abs(dy)) <= max(_CONVERGED_SHARE * sigma, rounding):
            break
    else:
        return UNDETERMINED
    chi2 = sum(r * r / s for r, s in zip(residuals, variances, strict=True))
    return Intersection(np.array([x, y]), np.array([[xx, xy], [xy, yy]]), chi2)


def widened_covariance(
    lines: ArrayLike, covariances: ArrayLike, found: Intersection, distance: float
) -> NDArray[np.float64]:
    """Return the covariance of an intersection, widened by the likelihood at `distance` from it.

    Nearly parallel lines intersect at a random point. The first-order covariance at that point
    treats the angle between the lines as known, and the true point may be several standard
    deviations away. Therefore the two points at `distance` on either side along the major axis are
    tested, each shifted across the axis to its most likely position: the lines exclude it by ``z``
    standard deviations, with the variances at that point. If ``z`` is less than the major axis
    implies, the axis becomes ``distance / z``. For two lines this is Fieller's interval of a
    quotient, whose ends diverge if the divisor, the angle, is not significant.

    Parameters
    ----------
    lines, covariances
        As given to `intersect`.
    found
        Result of `intersect`.
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
    return widened(_constraints(lines, covariances), found, distance)


def widened(
    constraints: Sequence[Constraint], found: Intersection, distance: float
) -> NDArray[np.float64]:
    """Return the result of `widened_covariance` for checked lines.

    Parameters
    ----------
    constraints
        N ≥ 2 lines.
    found, distance
        As for `widened_covariance`.

    Returns
    -------
    (2, 2)
    """
    (xx, xy), (_, yy) = found.covariance.tolist()
    if not math.isfinite(xx + yy):
        return UNBOUNDED
    constraints = [_of_unit_normal(line) for line in constraints]
    _, major, along_x, along_y = _principal_axes(xx, xy, yy)
    x, y = found.point.tolist()
    widest = major
    for reach in (distance, -distance):
        residuals, variances = _distances(constraints, x + reach * along_x, y + reach * along_y)
        chi2 = sideways = shift2 = 0.0
        for (a, b, *_), r, s in zip(constraints, residuals, variances, strict=True):
            shift = b * along_x - a * along_y
            chi2 += r * r / s
            sideways += r * shift / s
            shift2 += shift * shift / s
        excluded = chi2 - sideways * sideways / shift2 - found.chi2
        if excluded * widest < distance**2:
            widest = distance**2 / excluded if excluded > 0.0 else math.inf
    if not math.isfinite(widest):
        return UNBOUNDED
    more = widest - major
    xy += more * along_x * along_y
    return np.array([[xx + more * along_x**2, xy], [xy, yy + more * along_y**2]])


def confidence_ellipse(
    point: ArrayLike, covariance: ArrayLike, confidence: float = 0.95
) -> Ellipse:
    """Return the ellipse that contains the true point with a given probability.

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
    """Return the paper's ellipse: ±2σ perturbations of each finger line, projected onto the plane.

    Position and orientation of each line are perturbed in turn by ``± nsigma`` of their standard
    deviations; the displacements of the intersection are added as independent. As in the paper,
    their correlation and the uncertainty of the reference points are neglected, and at
    ``nsigma = 2`` the ellipse of a normal distribution contains 86.5 %.

    Parameters
    ----------
    image_from_plane : (N, 3, 3)
        Homographies of N ≥ 2 views.
    anchor_px : (N, 2)
    angle_rad : (N,)
    covariance : (N, 2, 2)
        Covariance of (offset [px], angle [rad]) at the anchor.
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
        perturbed: the recipe defines no ellipse for them.
    """
    T = finite_array(image_from_plane, "image_from_plane", ("N", 3, 3))
    anchor = finite_array(anchor_px, "anchor_px", (len(T), 2))
    angle = finite_array(angle_rad, "angle_rad", (len(T),))
    covariance = covariance_array(covariance, "covariance", (len(T), 2, 2))
    nsigma = in_range(nsigma, "nsigma", np.finfo(np.float64).tiny)

    exact = np.zeros((len(T), 9, 9))

    def meeting(anchor: NDArray[np.float64], angle: NDArray[np.float64]) -> NDArray[np.float64]:
        return intersect(*constraint_lines(T, exact, anchor, angle, covariance)).point

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


def constraint(line: Sequence[float], covariance: Sequence[float]) -> Constraint | None:
    """Scale the result of `constraint_components` for floats; None for the plane's horizon."""
    a, b, c = line
    length = math.hypot(a, b)
    if not length > _TINY * abs(c):
        return None
    xx, xy, x1, yy, y1, one = (entry / length / length for entry in covariance)
    return a / length, b / length, c / length, xx, 2.0 * xy, 2.0 * x1, yy, 2.0 * y1, one


def line_and_covariance(line: Constraint) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a constraint line, (3,), and its covariance, (3, 3), as arrays."""
    a, b, c, xx, xy, x1, yy, y1, one = line
    xy, x1, y1 = xy / 2, x1 / 2, y1 / 2
    return np.array([a, b, c]), np.array([[xx, xy, x1], [xy, yy, y1], [x1, y1, one]])


def largest_sigma(covariance: NDArray[np.float64]) -> float:
    """Return the largest standard deviation in any direction; infinite for `UNBOUNDED`."""
    (xx, xy), (_, yy) = covariance.tolist()
    return math.sqrt(_principal_axes(xx, xy, yy)[1])


def _constraints(lines: NDArray[np.float64], covariances: NDArray[np.float64]) -> list[Constraint]:
    return [
        (a, b, c, xx, xy + yx, x1 + lx, yy, y1 + ly, one)
        for (a, b, c), ((xx, xy, x1), (yx, yy, y1), (lx, ly, one)) in zip(
            lines.tolist(), covariances.tolist(), strict=True
        )
    ]


def _of_unit_normal(line: Constraint) -> Constraint:
    """Return a line with the covariance of (a, b, c) under the condition a² + b² = 1.

    A change of the scale of (a, b, c) does not move the line. It does not affect the variance of a
    point's distance on the line; off the line, it would be counted as a motion of the line.
    """
    a, b, c, xx, xy, x1, yy, y1, one = line
    xy, x1, y1 = xy / 2.0, x1 / 2.0, y1 / 2.0
    # P Σ Pᵀ with P = I − m (a, b, 0): Σ − m uᵀ − u mᵀ.
    u, v, w = a * xx + b * xy, a * xy + b * yy, a * x1 + b * y1
    half = (a * u + b * v) / 2.0
    u, v, w = u - half * a, v - half * b, w - half * c
    return (
        a,
        b,
        c,
        xx - 2.0 * a * u,
        2.0 * (xy - a * v - b * u),
        2.0 * (x1 - a * w - c * u),
        yy - 2.0 * b * v,
        2.0 * (y1 - b * w - c * v),
        one - 2.0 * c * w,
    )


def _distances(
    constraints: Sequence[Constraint], x: float, y: float
) -> tuple[list[float], list[float]]:
    """Return the distances of a point from lines, and the variances of these distances."""
    residuals = [line[0] * x + line[1] * y + line[2] for line in constraints]
    variances = [
        (xx * x + xy * y + x1) * x + (yy * y + y1) * y + one
        for _, _, _, xx, xy, x1, yy, y1, one in constraints
    ]
    floor = max(_ROUNDING**2 * (x * x + y * y), _LEAST_RATIO * max(variances), _TINY)
    return residuals, [max(variance, floor) for variance in variances]


def _solved(
    constraints: Sequence[Constraint], residuals: Sequence[float], variances: Sequence[float]
) -> tuple[float, float, float, float, float] | None:
    """Return the step (x, y) to subtract from a point, and its covariance (xx, xy, yy).

    None if the lines are parallel to rounding.
    """
    aa = ab = bb = ra = rb = 0.0
    for (a, b, *_), residual, variance in zip(constraints, residuals, variances, strict=True):
        p, q = a / variance, b / variance
        aa, ab, bb = aa + a * p, ab + a * q, bb + b * q
        ra, rb = ra + residual * p, rb + residual * q
    determinant = aa * bb - ab * ab
    if determinant <= (_PARALLEL_RAD * (aa + bb)) ** 2:
        return None
    xx, xy, yy = bb / determinant, -ab / determinant, aa / determinant
    return xx * ra + xy * rb, xy * ra + yy * rb, xx, xy, yy


def _principal_axes(xx: float, xy: float, yy: float) -> tuple[float, float, float, float]:
    """Return the principal variances, the smaller first, and the direction of the larger one."""
    half, mean = math.hypot((xx - yy) / 2, xy), (xx + yy) / 2
    angle = math.atan2(2.0 * xy, xx - yy) / 2
    return max(mean - half, 0.0), mean + half, math.cos(angle), math.sin(angle)


def _ellipse(centre: NDArray[np.float64], covariance: NDArray[np.float64], scale: float) -> Ellipse:
    (xx, xy), (_, yy) = covariance.tolist()
    minor, major, x, y = _principal_axes(xx, xy, yy)
    semi_axes = np.array([scale * math.sqrt(major), scale * math.sqrt(minor)])
    return Ellipse(centre, semi_axes, math.atan2(y, x) % math.pi)
