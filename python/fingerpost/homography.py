"""Homographies between the working plane and an image.

Paper: Cipolla, Hadfield & Hollinghurst 1994, eq. 1: ``(su, sv, s) = T (X, Y, 1)``. ``T`` is called
`image_from_plane` here; it is estimated from four or more reference points by the normalised DLT
(Hartley 1997) and refined by Gauss-Newton on the image error, which for four points only removes
rounding errors.

**Scale and sign.** The paper fixes ``t33 = 1``. ``t33`` is the value of ``s`` (called ``W`` here)
at the plane's origin, which need not be in front of the camera: a robot's base, the origin of its
coordinates, may lie on the view's horizon (``t33 = 0``) or beyond it (``t33 < 0``). Here ``W = 1``
at the centroid of the reference points, which is in front of the camera because they are. So
``W > 0`` at every visible point of the plane, ``W = 0`` on the horizon and ``W < 0`` behind the
camera, where eq. 1 still yields pixels although nothing is visible.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.checks import covariance_array, finite_array
from fingerpost.errors import DegenerateReferencePointsError, InvalidInputError

MIN_REFERENCE_POINTS = 4

# Points closer to each other, or to one line, than this share of the set's diameter are refused.
# The threshold only separates rounding from geometry (coordinates typed to six digits are this
# exact): the covariance reveals a set that is poor but not degenerate.
DEGENERATE_SHARE = 1e-6

# Sets whose diameter lies outside these bounds are refused in any unit: fourth powers of lengths
# must neither overflow nor underflow.
SPREADS = (1e-30, 1e30)

# A homography that misses its own reference points by more than this share of their spread (both
# root mean squares) is refused: noise and lenses cause a few per cent at most, two points in the
# wrong order exceed it.
MAX_MISFIT_SHARE = 0.1

# Gauss-Newton from the DLT converges to rounding in three to five steps.
_MAX_ITERATIONS = 20
_CONVERGED_STEP = 1e-13


def estimate_image_from_plane(
    plane_points: ArrayLike,
    image_points_px: ArrayLike,
    covariances_px2: ArrayLike | None = None,
) -> NDArray[np.float64]:
    """Estimate a homography from reference points: exact for four, least squares for more.

    Parameters
    ----------
    plane_points : (N, 2)
        Reference points on the working plane, N ≥ 4, any unit and origin.
    image_points_px : (N, 2)
        Their images in the same order; may lie outside the image.
    covariances_px2 : (2, 2) or (N, 2, 2), optional
        Covariance of each image point [px²], positive definite: least squares is weighted by their
        inverses. Only their ratios matter; without them all points have equal weight.

    Returns
    -------
    (3, 3)
        `image_from_plane`, scaled to ``W = 1`` at the centroid of `plane_points`.

    Raises
    ------
    DegenerateReferencePointsError
        A diameter outside `SPREADS`, repeated points, all points but one on a line (three of four;
        on the plane or in the image), points on both sides of the horizon, points that no
        homography fits: the latter two mean that image points are not in the order of the plane
        points.
    InvalidInputError
        Fewer than four points, different numbers, NaN, a covariance that is not positive definite.
    """
    plane = finite_array(plane_points, "plane_points", ("N", 2))
    image = finite_array(image_points_px, "image_points_px", ("N", 2))
    whitening = _whitening(covariances_px2, len(plane))
    if len(plane) != len(image):
        raise InvalidInputError(
            f"{len(plane)} plane_points but {len(image)} image_points_px; one for each is needed"
        )
    if len(plane) < MIN_REFERENCE_POINTS:
        raise InvalidInputError(
            f"{len(plane)} reference points; a homography needs at least {MIN_REFERENCE_POINTS}"
        )
    _refuse_degenerate(plane, "plane_points")
    _refuse_degenerate(image, "image_points_px")

    normalised_from_plane = normalising_similarity(plane)
    normalised_from_image = normalising_similarity(image)
    X = _apply(normalised_from_plane, plane)
    x = _apply(normalised_from_image, image)
    T = _facing(_direct_linear_transform(X, x), X)
    for _ in range(_MAX_ITERATIONS):
        step = _gauss_newton_gain(T, X, whitening) @ (x - _apply(T, X)).ravel()
        T = T + step.reshape(3, 3)
        if np.linalg.norm(step) <= _CONVERGED_STEP * np.linalg.norm(T):
            break
    T = _facing(T, X)
    _refuse_misfit(x - _apply(T, X), x, normalised_from_image[0, 0])
    return np.linalg.solve(normalised_from_image, T) @ normalised_from_plane


def entries_from_reference_points(
    image_from_plane: ArrayLike,
    plane_points: ArrayLike,
    covariances_px2: ArrayLike | None = None,
) -> NDArray[np.float64]:
    """Differentiate the estimated homography's entries by the image reference points.

    The nine entries have eight degrees of freedom. The gauge is chosen for a well-conditioned
    system: in coordinates normalised on the plane and in the image, the change of the entries is
    orthogonal to the entries.

    Parameters
    ----------
    image_from_plane : (3, 3)
        As estimated from these points.
    plane_points : (N, 2)
        Reference points on the plane.
    covariances_px2 : (2, 2) or (N, 2, 2), optional
        As given to `estimate_image_from_plane`.

    Returns
    -------
    (9, 2N)
        Rows: entries of `image_from_plane`, row by row. Columns: u, v of each point.
    """
    T = finite_array(image_from_plane, "image_from_plane", (3, 3))
    plane = finite_array(plane_points, "plane_points", ("N", 2))
    whitening = _whitening(covariances_px2, len(plane))
    normalised_from_plane = normalising_similarity(plane)
    normalised_from_image = normalising_similarity(_apply(T, plane))
    plane_from_normalised = np.linalg.inv(normalised_from_plane)
    gain = _gauss_newton_gain(
        normalised_from_image @ T @ plane_from_normalised,
        _apply(normalised_from_plane, plane),
        whitening,
    )
    # Back to given coordinates: each column of the gain is a change of T; apply both similarities.
    changes = gain.T.reshape(-1, 3, 3)
    changes = np.linalg.inv(normalised_from_image) @ changes @ normalised_from_plane
    return np.asarray(changes.reshape(-1, 9).T * normalised_from_image[0, 0])


def transfer_to_image(image_from_plane: ArrayLike, plane_points: ArrayLike) -> NDArray[np.float64]:
    """Map points of the plane to the image: eq. 1 of the paper.

    Parameters
    ----------
    image_from_plane : (..., 3, 3)
        Signed so that ``W > 0`` is in front (as estimated here).
    plane_points : (..., 2)

    Returns
    -------
    (..., 2)
        Pixels; NaN where ``W ≤ 0``: on or beyond the horizon, a point is not visible.
    """
    T = finite_array(image_from_plane, "image_from_plane", (..., 3, 3))
    plane_points = finite_array(plane_points, "plane_points", (..., 2))
    return _in_front(_multiply(T, plane_points))


def transfer_to_plane(
    image_from_plane: ArrayLike, image_points_px: ArrayLike
) -> NDArray[np.float64]:
    """Map pixels to points of the plane: the inverse of eq. 1.

    Parameters
    ----------
    image_from_plane : (..., 3, 3)
        Signed so that ``W > 0`` is in front (as estimated here), not singular.
    image_points_px : (..., 2)

    Returns
    -------
    (..., 2)
        Plane units; NaN on or above the view's horizon, where the plane is not visible.

    Raises
    ------
    InvalidInputError
        A singular matrix.
    """
    return transfer_by_inverse(inverse(image_from_plane), image_points_px)


def inverse(image_from_plane: ArrayLike) -> NDArray[np.float64]:
    """Invert a homography.

    Parameters
    ----------
    image_from_plane : (..., 3, 3)

    Returns
    -------
    (..., 3, 3)
        `plane_from_image`: maps a point in front to ``X~ / W``, so that its third entry has the
        sign of W.

    Raises
    ------
    InvalidInputError
        A singular matrix.
    """
    T = finite_array(image_from_plane, "image_from_plane", (..., 3, 3))
    try:
        return np.asarray(np.linalg.inv(T), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise InvalidInputError(f"image_from_plane is singular: {T.tolist()}") from error


def transfer_by_inverse(
    plane_from_image: NDArray[np.float64], image_points_px: ArrayLike
) -> NDArray[np.float64]:
    """Map pixels to points of the plane, as `transfer_to_plane`, by the result of `inverse`."""
    image_points_px = finite_array(image_points_px, "image_points_px", (..., 2))
    return _in_front(_multiply(plane_from_image, image_points_px))


def transfer_jacobian_by_entries(
    image_from_plane: ArrayLike, plane_points: ArrayLike
) -> NDArray[np.float64]:
    """Differentiate image points by the nine entries of the homography.

    Parameters
    ----------
    image_from_plane : (..., 3, 3)
    plane_points : (..., 2)
        Points with ``W ≠ 0``.

    Returns
    -------
    (..., 2, 9)
        ``[X~ᵀ 0 −u X~ᵀ; 0 X~ᵀ −v X~ᵀ] / W``; entries row by row.
    """
    T = finite_array(image_from_plane, "image_from_plane", (..., 3, 3))
    plane_points = finite_array(plane_points, "plane_points", (..., 2))
    return _jacobian_by_entries(T, plane_points)


def transfer_jacobian_by_point(
    image_from_plane: ArrayLike, plane_points: ArrayLike
) -> NDArray[np.float64]:
    """Differentiate image points by the points of the plane.

    Parameters
    ----------
    image_from_plane : (..., 3, 3)
    plane_points : (..., 2)
        Points with ``W ≠ 0``.

    Returns
    -------
    (..., 2, 2)
        ``(T₁₂,₁₂ − x t₃ᵀ) / W`` [px per plane unit].
    """
    T = finite_array(image_from_plane, "image_from_plane", (..., 3, 3))
    plane_points = finite_array(plane_points, "plane_points", (..., 2))
    y = _multiply(T, plane_points)
    x = y[..., :2] / y[..., 2:]
    return np.asarray((T[..., :2, :2] - x[..., :, None] * T[..., 2:, :2]) / y[..., 2:, None])


def normalising_similarity(points: ArrayLike) -> NDArray[np.float64]:
    """Return the similarity that maps points to centroid 0 and mean distance √2 (Hartley 1997).

    Parameters
    ----------
    points : (N, 2)
        Not all equal.

    Returns
    -------
    (3, 3)
        `normalised_from_given`.
    """
    points = finite_array(points, "points", ("N", 2))
    centroid = points.mean(axis=0)
    scale = np.sqrt(2.0) / np.hypot(*(points - centroid).T).mean()
    return np.array(
        [[scale, 0.0, -scale * centroid[0]], [0.0, scale, -scale * centroid[1]], [0.0, 0.0, 1.0]]
    )


def _multiply(matrix: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return homogeneous images ``y = matrix·(x, y, 1)``, (..., 3)."""
    y = matrix[..., 0] * points[..., :1]
    y += matrix[..., 1] * points[..., 1:]
    y += matrix[..., 2]
    return np.asarray(y)


def _apply(matrix: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    y = _multiply(matrix, points)
    return np.asarray(y[..., :2] / y[..., 2:])


def kronecker_product(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the Kronecker product of two small matrices; NumPy's takes several times as long."""
    blocks = one[:, None, :, None] * other[None, :, None, :]
    return blocks.reshape(len(one) * len(other), -1)


def _in_front(y: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(y[..., :2] / np.where(y[..., 2:] > 0.0, y[..., 2:], np.nan))


def _jacobian_by_entries(
    T: NDArray[np.float64], points: NDArray[np.float64]
) -> NDArray[np.float64]:
    y = _multiply(T, points)
    X = np.concatenate([points, np.ones_like(points[..., :1])], axis=-1) / y[..., 2:]
    x = y[..., :2] / y[..., 2:]
    jacobian = np.zeros((*y.shape[:-1], 2, 9))
    jacobian[..., 0, 0:3] = X
    jacobian[..., 1, 3:6] = X
    jacobian[..., 6:9] = -x[..., :, None] * X[..., None, :]
    return jacobian


def _direct_linear_transform(X: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Minimise ``‖A t‖`` with ``‖t‖ = 1`` for the equations ``x × (T X~) = 0``."""
    X = np.column_stack([X, np.ones(len(X))])
    zero = np.zeros_like(X)
    A = np.concatenate(
        [np.hstack([X, zero, -x[:, :1] * X]), np.hstack([zero, X, -x[:, 1:] * X])], axis=0
    )
    return np.asarray(np.linalg.svd(A)[2][-1].reshape(3, 3))


def _gauss_newton_gain(
    T: NDArray[np.float64], X: NDArray[np.float64], whitening: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """Return the weighted least-squares gain from image residuals to the entries, (9, 2N).

    Its product with the residuals is the Gauss-Newton step; at the solution, it is the derivative
    of the estimate. The last equation keeps the step orthogonal to ``T``, because the points do not
    determine the scale.
    """
    jacobian = _jacobian_by_entries(T, X)
    if whitening is not None:
        jacobian = whitening @ jacobian
    Q, R = np.linalg.qr(np.concatenate([jacobian.reshape(-1, 9), T.reshape(1, 9)]))
    gain = np.linalg.solve(R, Q[:-1].T)
    if whitening is not None:
        gain = (gain.reshape(9, -1, 1, 2) @ whitening).reshape(9, -1)
    return np.asarray(gain)


def _whitening(covariances_px2: ArrayLike | None, count: int) -> NDArray[np.float64] | None:
    """Return ``L⁻¹`` of every covariance ``L Lᵀ``, (N, 2, 2); None for points of equal weight."""
    if covariances_px2 is None:
        return None
    covariances = covariance_array(covariances_px2, "covariances_px2", (..., 2, 2))
    if covariances.shape not in ((2, 2), (count, 2, 2)):
        raise InvalidInputError(
            f"covariances_px2: shape {covariances.shape} found; (2, 2) or ({count}, 2, 2) is needed"
        )
    try:
        factors = np.linalg.cholesky(covariances)
    except np.linalg.LinAlgError as error:
        raise InvalidInputError(
            "covariances_px2 holds a singular matrix: a reference point known exactly would "
            "silence all others; give each a positive variance, or no covariances at all"
        ) from error
    return np.broadcast_to(np.linalg.inv(factors), (count, 2, 2))


def _facing(T: NDArray[np.float64], X: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scale `T` to ``W = 1`` at the origin of normalised coordinates, the points' centroid."""
    W = _multiply(T, X)[:, 2]
    front = W > 0.0
    if front.all() or not front.any():
        return np.asarray(T / T[2, 2])
    odd = np.flatnonzero(front if front.sum() <= len(X) / 2 else ~front)
    raise DegenerateReferencePointsError(
        f"image_points_px {_listed(odd)} would lie behind the view, the others in front of it: the "
        "image points are not in the order of the plane points"
    )


def _refuse_degenerate(points: NDArray[np.float64], name: str) -> None:
    """Raise if points spread out of bounds, coincide, or all but one at most lie on a line."""
    with np.errstate(over="ignore"):  # an overflow is out of bounds
        between = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1))
    least, most = SPREADS
    spread = float(between.max())
    if not (spread == 0.0 or least <= spread <= most):
        raise DegenerateReferencePointsError(
            f"{name} spread over {spread:.3g}; from {least:g} to {most:g} is right"
        )
    nearest = DEGENERATE_SHARE * between.max()
    first, second = np.nonzero(np.triu(between <= nearest, k=1))
    if len(first):
        i, j = int(first[0]), int(second[0])
        raise DegenerateReferencePointsError(
            f"{name}[{i}] and {name}[{j}] are the same point, {_coordinates(points[i])}; "
            "each reference point is to be given once"
        )
    # At least two of any three points lie on such a line, so three candidates suffice.
    for i, j in ((0, 1), (0, 2), (1, 2)):
        tangent = (points[j] - points[i]) / between[i, j]
        off_line = np.abs((points - points[i]) @ np.array([-tangent[1], tangent[0]]))
        on_line = np.flatnonzero(off_line <= nearest)
        if len(on_line) >= len(points) - 1:
            shown = ", ".join(_coordinates(points[k]) for k in on_line[:4])
            raise DegenerateReferencePointsError(
                f"{name} {_listed(on_line)} lie on one line: {shown}"
                f"{', …' if len(on_line) > 4 else ''}; "
                "four points are needed of which no three do"
            )


def _refuse_misfit(
    residuals: NDArray[np.float64], x: NDArray[np.float64], normalised_per_px: float
) -> None:
    """Raise if the homography misses its reference points by too much, or is not finite."""
    misfit = np.hypot(*residuals.T)
    if np.sqrt(np.mean(misfit**2)) <= MAX_MISFIT_SHARE * np.sqrt(np.mean((x**2).sum(axis=1))):
        return
    worst = int(np.argmax(misfit))
    raise DegenerateReferencePointsError(
        f"no homography fits: image_points_px[{worst}] is missed by "
        f"{misfit[worst] / normalised_per_px:.3g} px; one of the points is wrong, or they are not "
        "in the order of the plane points"
    )


def _listed(indices: NDArray[np.intp]) -> str:
    return "[" + ", ".join(str(i) for i in indices) + "]"


def _coordinates(point: NDArray[np.float64]) -> str:
    return f"({point[0]:.10g}, {point[1]:.10g})"
