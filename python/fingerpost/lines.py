"""Lines in an image and on the working plane, in homogeneous form.

A line is ``l = (a, b, c)`` with ``a² + b² = 1``; for a point ``x~ = (x, y, 1)`` on it ``l·x~ = 0``,
and elsewhere ``l·x~`` is the signed distance in the unit of the coordinates. A line of direction
``θ`` has the tangent ``e = (cos θ, sin θ)`` and the normal ``n = (−sin θ, cos θ)``; in an image (u
right, v down) the normal points to the right of the direction.

Lines through a homography: Cipolla, Hadfield & Hollinghurst 1994, eq. 2.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.checks import finite_array
from fingerpost.errors import InvalidInputError

# Divisors below this share of the other entries overflow: the point or line is at infinity.
_TINY = float(np.finfo(np.float64).tiny)


def line_at_angle(point: ArrayLike, angle_rad: ArrayLike) -> NDArray[np.float64]:
    """Return the line through a point in a direction.

    Parameters
    ----------
    point : (..., 2)
        A point of the line.
    angle_rad : (...)
        Direction [rad], any value: 0 is along +u, π/2 along +v.

    Returns
    -------
    (..., 3)
        ``(n, −n·point)``.
    """
    point = finite_array(point, "point", (..., 2))
    angle_rad = finite_array(angle_rad, "angle_rad", (...,))
    s, c = np.sin(angle_rad), np.cos(angle_rad)
    offset = s * point[..., 0] - c * point[..., 1]
    line = np.empty((*offset.shape, 3))
    line[..., 0], line[..., 1], line[..., 2] = -s, c, offset
    return line


def line_at_angle_jacobian(point: ArrayLike, angle_rad: ArrayLike) -> NDArray[np.float64]:
    """Differentiate `line_at_angle` by a shift along the normal and a turn about the point.

    Parameters
    ----------
    point : (..., 2)
        A point of the line.
    angle_rad : (...)
        Direction [rad].

    Returns
    -------
    (..., 3, 2)
        Columns ``∂l/∂offset = (0, 0, −1)`` and ``∂l/∂angle = (−e, e·point)``.
    """
    point = finite_array(point, "point", (..., 2))
    angle_rad = finite_array(angle_rad, "angle_rad", (...,))
    s, c = np.sin(angle_rad), np.cos(angle_rad)
    along = c * point[..., 0] + s * point[..., 1]
    jacobian = np.zeros((*along.shape, 3, 2))
    jacobian[..., 2, 0] = -1.0
    jacobian[..., 0, 1], jacobian[..., 1, 1], jacobian[..., 2, 1] = -c, -s, along
    return jacobian


def line_through(first: ArrayLike, second: ArrayLike) -> NDArray[np.float64]:
    """Return the line through two points, directed from the first to the second.

    Parameters
    ----------
    first, second : (..., 2)
        Two different points.

    Returns
    -------
    (..., 3)

    Raises
    ------
    InvalidInputError
        The two points are equal, and determine no line.
    """
    first = finite_array(first, "first", (..., 2))
    second = finite_array(second, "second", (..., 2))
    along = second - first
    if np.any(np.all(along == 0.0, axis=-1)):
        raise InvalidInputError(f"two equal points fix no line: {first.tolist()}")
    return line_at_angle(first, np.arctan2(along[..., 1], along[..., 0]))


def normalised(line: ArrayLike) -> NDArray[np.float64]:
    """Scale homogeneous lines to ``a² + b² = 1``; the sign is kept.

    Parameters
    ----------
    line : (..., 3)
        Any scale.

    Returns
    -------
    (..., 3)
        NaN for the line at infinity (``a = b = 0``), which has no such form.
    """
    line = finite_array(line, "line", (..., 3))
    length = np.hypot(line[..., :1], line[..., 1:2])
    return line / np.where(length > _TINY * np.abs(line[..., 2:]), length, np.nan)


def constraint_line(image_from_plane: ArrayLike, image_line: ArrayLike) -> NDArray[np.float64]:
    """Return the line of the working plane whose image is `image_line`: eq. 2 of the paper.

    There ``l_i = T(l_gp)`` states that the image line is the image of the constraint line. For line
    vectors this is ``l_gp = Tᵀ l_i``: ``x~ ∝ T X~`` implies ``l_i·x~ ∝ (Tᵀ l_i)·X~``, so both
    vanish together.

    Parameters
    ----------
    image_from_plane : (..., 3, 3)
        The homography ``T`` of eq. 1.
    image_line : (..., 3)
        Line in the image; any scale.

    Returns
    -------
    (..., 3)
        Normalised to ``a² + b² = 1`` in plane units; NaN if the image line is the plane's horizon.
    """
    T = finite_array(image_from_plane, "image_from_plane", (..., 3, 3))
    image_line = finite_array(image_line, "image_line", (..., 3))
    return normalised((image_line[..., None, :] @ T)[..., 0, :])


def intersection(first: ArrayLike, second: ArrayLike) -> NDArray[np.float64]:
    """Return the point of intersection of two lines.

    Parameters
    ----------
    first, second : (..., 3)
        Two lines of any scale.

    Returns
    -------
    (..., 2)
        NaN where the lines are parallel or equal.
    """
    first = finite_array(first, "first", (..., 3))
    second = finite_array(second, "second", (..., 3))
    meeting = np.cross(first, second)
    third = meeting[..., 2:]
    largest = np.abs(meeting).max(axis=-1, keepdims=True)
    return meeting[..., :2] / np.where(np.abs(third) > _TINY * largest, third, np.nan)


def crossing_angle_rad(first: ArrayLike, second: ArrayLike) -> NDArray[np.float64]:
    """Return the angle between two undirected lines, accurate for the smallest angles.

    Parameters
    ----------
    first, second : (..., 3)
        Two lines of any scale.

    Returns
    -------
    (...)
        Between 0 (parallel) and π/2 [rad].
    """
    first = finite_array(first, "first", (..., 3))
    second = finite_array(second, "second", (..., 3))
    sine = first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
    cosine = (first[..., :2] * second[..., :2]).sum(axis=-1)
    return np.asarray(np.arctan2(np.abs(sine), np.abs(cosine)))


def distance(line: ArrayLike, point: ArrayLike) -> NDArray[np.float64]:
    """Return the signed distance of points from lines, positive on the side of the normal.

    Parameters
    ----------
    line : (..., 3)
        Normalised to ``a² + b² = 1``.
    point : (..., 2)

    Returns
    -------
    (...)
        In the unit of the coordinates.
    """
    line = finite_array(line, "line", (..., 3))
    point = finite_array(point, "point", (..., 2))
    return np.asarray((line[..., :2] * point).sum(axis=-1) + line[..., 2])


def clip_to_rectangle(
    line: ArrayLike, lower: ArrayLike, upper: ArrayLike
) -> NDArray[np.float64] | None:
    """Return the part of a line inside an axis-aligned rectangle, for drawing.

    Parameters
    ----------
    line : (3,)
        Any scale.
    lower, upper : (2,)
        Corners with the smallest and the largest coordinates.

    Returns
    -------
    (2, 2) or None
        End points in the line's direction ``(b, −a)``; None where the line misses the rectangle
        or only touches a corner.

    Raises
    ------
    InvalidInputError
        An empty rectangle, or the line at infinity.
    """
    line = finite_array(line, "line", (3,))
    lower = finite_array(lower, "lower", (2,))
    upper = finite_array(upper, "upper", (2,))
    if np.any(upper <= lower):
        raise InvalidInputError(f"rectangle from {lower.tolist()} to {upper.tolist()} is empty")
    if not line[:2].any():
        raise InvalidInputError(f"line {line.tolist()} is the line at infinity")
    a, b, c = normalised(line).tolist()
    # Starting from the foot of the rectangle's centre keeps the numbers small.
    centre = (lower + upper) / 2
    foot = centre - (a * centre[0] + b * centre[1] + c) * np.array([a, b])
    enter, leave = -np.inf, np.inf
    for start, step, low, high in zip(
        foot.tolist(), (b, -a), lower.tolist(), upper.tolist(), strict=True
    ):
        if step == 0.0:
            if not low <= start <= high:
                return None
            continue
        near, far = sorted(((low - start) / step, (high - start) / step))
        enter, leave = max(enter, near), min(leave, far)
    if enter >= leave:
        return None
    return np.asarray(np.clip(foot + np.outer([enter, leave], [b, -a]), lower, upper))
