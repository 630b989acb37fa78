"""Geometric agreement of the fingers of two views.

A finger above the plane that points at it gives a constraint line in every view. The lines meet
ahead of its tip, and the viewing rays through the tip meet in one point above the plane.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerpost.finding.finger import Array, FingerDetection
from fingerpost.pointing import PlaneView
from fingerpost.silhouette import Capsule, Silhouette, image_from_space
from fingerpost.uncertainty import Numbers

Direction = tuple[float, float, float]
"""Components (X, Y, height above the plane) of a direction."""

MAX_FOCAL_LENGTH = 20.0
"""Greatest focal length [image widths]."""


@dataclass(frozen=True, eq=False, slots=True)
class Viewpoint:
    """A view of the plane, and its approximate camera centre.

    Attributes
    ----------
    plane_view
        Homography and lens of the view.
    centre
        Camera centre (X, Y, height above the plane), in plane units; NaN if unknown.
    """

    plane_view: PlaneView
    centre: Array

    def silhouette(self, bodies: Sequence[Capsule]) -> Silhouette:
        """Project bodies in plane coordinates to their silhouette, in ideal pixels."""
        matrix = image_from_space(self.plane_view.image_from_plane, self.centre)
        return Silhouette.of(bodies, matrix, self.centre)

    @classmethod
    def of(cls, view: PlaneView, size_px: tuple[int, int]) -> Viewpoint:
        """Estimate the camera centre of a view with images of (width, height).

        With square pixels and a known principal point, the homography gives the focal length and
        the pose: the columns h1, h2 of K⁻¹T are orthogonal and of equal length. The principal point
        is the lens's, or else the image centre, which is accurate enough to compare tips.
        """
        lens = view.lens
        middle = (lens.cx, lens.cy) if lens else ((size_px[0] - 1) / 2, (size_px[1] - 1) / 2)
        T = view.image_from_plane.copy()
        T[:2] -= np.outer(middle, T[2])
        (h1, h2), z = T[:2, :2].T, T[2, :2]
        a = np.array([h1 @ h2, h1 @ h1 - h2 @ h2])
        b = np.array([z[0] * z[1], z[0] ** 2 - z[1] ** 2])
        inverse_square = -(a @ b) / max(a @ a, np.finfo(float).tiny)
        f_px = 1.0 / np.sqrt(inverse_square) if inverse_square > 0.0 else np.inf
        focal_px = np.array([lens.fx, lens.fy] if lens is not None else [f_px, f_px])
        # Beyond this a parallel projection is accurate enough.
        T[:2] /= np.minimum(focal_px, MAX_FOCAL_LENGTH * max(size_px))[:, None]
        T /= np.sqrt(np.linalg.norm(T[:, 0]) * np.linalg.norm(T[:, 1]))
        rotation = np.column_stack([T[:, 0], T[:, 1], np.cross(T[:, 0], T[:, 1])])
        if abs(np.linalg.det(rotation)) < np.finfo(float).eps:
            return cls(view, np.full(3, np.nan))
        centre = -np.linalg.solve(rotation, T[:, 2])
        return cls(view, np.array([centre[0], centre[1], abs(centre[2])]))


MIN_MEETING_ANGLE_RAD = np.radians(2.0)
"""Least angle between constraint lines that define a point."""

TIP_SLACK = 3.0
"""Greatest distance of the target behind the tip [half-widths]: a fingertip that touches the plane
points at itself."""

FLAT_ANGLE_RAD = np.radians(6.0)
FLAT_OFFSET = 1.5
"""A finger lies in the plane if its constraint lines meet at less than this angle, and each is
within this distance of the other view's tip [half-widths]."""

MIN_PLANE_ANGLE_RAD = math.radians(5.0)
"""Least angle between the planes through the finger and either camera for which the finger's
direction in space is defined: below, a degree of either line turns it by more than ten."""

SECOND_POINT_DISTANCE = 4.0
"""Distance behind the tip of the second point that defines a finger line [half-widths]."""

MAX_TARGET_DISTANCE = 1.5
"""Greatest distance of the target from the mean of the reference points [plane sizes]."""

MIN_SAME_TIP = 0.8
"""Least likelihood that two tips are one point, by `RAY_DISTANCE_SIGMA` [0 to 1]; below, they are
of two fingers. One tip reaches 0.96 in every frame of the recordings."""

TIP_POWER = 10.0
"""Exponent of that likelihood in the score of a pair. In 150 runs on rendered films 99 % of the
pairs of one finger have 0.997 and more, half of all others 0.94 and less: it separates them best.
With reference points off by 3 px and an uncorrected lens (k1 = -0.3), one finger has 0.98 and more
in 95 % of its poses."""

REACH_SPREAD = 60.0
"""Standard deviation of the distance from the tip to the indicated point [half-widths]; at this
distance a pair loses 40 % of its score. A thumb that is not held up points much farther."""


def pair_scores(
    views: tuple[Viewpoint, Viewpoint],
    fingers: tuple[Sequence[FingerDetection], Sequence[FingerDetection]],
) -> Array:
    """Score the pairs of fingers of two views as one finger that points at the plane.

    Parameters
    ----------
    views
        The two views.
    fingers
        N fingers of the first view, M of the second.

    Returns
    -------
    (N, M)
        Product of the two scores and of the likelihoods of their tips, widths, colours, length and
        foreground; 0 for a pair that cannot be one finger above the plane that points at it.
    """
    one, other = _on_plane(views, fingers)
    first, second = one.along(1), other.along(0)
    point, angle = _meeting(first.line, second.line)
    possible = angle > MIN_MEETING_ANGLE_RAD
    for view, finger in zip(
        (views[0].plane_view, views[1].plane_view), (first, second), strict=True
    ):
        ahead = ((_projected(view, point) - finger.tip_px) * finger.direction).sum(axis=-1)
        possible &= ahead > -TIP_SLACK * finger.half_width_px
    flat = angle < FLAT_ANGLE_RAD
    for here, there in ((first, second), (second, first)):
        flat &= _offset(here.line, there.foot) < FLAT_OFFSET * there.width
    plane = views[0].plane_view
    away = np.linalg.norm(point - plane.plane_points.mean(axis=0), axis=-1) / plane.plane_size
    # Most pairs are excluded by now.
    left = np.nonzero(possible & (away < MAX_TARGET_DISTANCE) & ~flat)
    scores = np.zeros(possible.shape)
    scores[left] = _scores(one.taken(left[0]), other.taken(left[1]), point[left], plane.plane_size)
    return scores


def _scores(first: _OnPlane, second: _OnPlane, point: Array, plane_size: float) -> Array:
    """Score pairs of fingers whose lines meet at a point (N, 2); 0 if their tips are not one."""
    tips = _Tips.of(first, second)
    score = first.score * second.score * _appearance_agreement(first, second, tips)
    score *= np.exp(-0.5 * np.square(tips.reach(point) / REACH_SPREAD))
    same = tips.same(plane_size)
    score *= same**TIP_POWER * _length_likelihood(first, second)
    return np.asarray(np.where(same >= MIN_SAME_TIP, score, 0.0))


FOOT_SPREAD = 3.0
"""Standard deviation of the distance from the reference points' mean to the tip's projection to the
plane [plane sizes]; at this distance a pair loses 40 % of its score."""


@dataclass(frozen=True, eq=False, slots=True)
class _OnPlane:
    """Fingers of one view, with their transfer to the plane."""

    tip_px: Array
    direction: Array
    half_width_px: Array
    colour: Array
    foreground: Array
    score: Array
    line: Array
    foot: Array
    width: Array
    breadth: Array
    length: Array
    ray: Array
    normal: Array

    def along(self, axis: int) -> _OnPlane:
        """Return a copy with an axis of length one for the other view's fingers."""
        return self._each(lambda entries: np.expand_dims(entries, axis))

    def taken(self, rows: NDArray[np.intp]) -> _OnPlane:
        """Return the fingers of these indices."""
        return self._each(lambda entries: entries[rows])

    def _each(self, change: Callable[[Array], Array]) -> _OnPlane:
        return _OnPlane(*(change(getattr(self, name)) for name in self.__slots__))

    @classmethod
    def of(cls, viewpoint: Viewpoint, fingers: Sequence[FingerDetection]) -> _OnPlane:
        """Transfer fingers to the plane; NaN beyond the horizon."""
        view = viewpoint.plane_view
        columns = np.array(
            [
                [*f.tip_px, f.angle_rad, f.half_width_px, f.score, f.foreground, f.length]
                for f in fingers
            ]
        ).reshape(-1, 7)
        shown, (angle, w, score, foreground, length) = columns[:, :2], columns[:, 2:].T
        direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        across = np.stack([-direction[:, 1], direction[:, 0]], axis=-1)
        tip, back = shown, shown - SECOND_POINT_DISTANCE * w[:, None] * direction
        if view.lens is not None:
            tip, back = view.lens.undistort(tip), view.lens.undistort(back)
        foot = view.back_project(shown)
        left, right = (view.back_project(shown + s * w[:, None] * across) for s in (-0.5, 0.5))
        # A tip that projects far from the reference points loses score; beyond the horizon, all.
        away = np.linalg.norm(foot - view.plane_points.mean(axis=0), axis=-1) / view.plane_size
        near = np.exp(-0.5 * np.square(away / FOOT_SPREAD))
        line = np.cross(_homogeneous(back), _homogeneous(tip)) @ view.image_from_plane
        x, y, height = viewpoint.centre
        # The plane through the line and the camera.
        normal = np.column_stack([line[:, :2], -(line @ [x, y, 1.0]) / height])
        ray = viewpoint.centre - _in_space(foot)
        return cls(
            tip_px=tip,
            direction=direction,
            half_width_px=w,
            colour=np.array([f.colour for f in fingers], dtype=float).reshape(-1, 3),
            foreground=foreground,
            score=score * np.nan_to_num(near),
            line=line,
            foot=foot,
            width=np.linalg.norm(right - left, axis=-1),
            breadth=_breadth(*(right - left).T, *ray.T),
            length=length,
            ray=ray,
            normal=normal,
        )


def _on_plane(
    views: tuple[Viewpoint, Viewpoint],
    fingers: tuple[Sequence[FingerDetection], Sequence[FingerDetection]],
) -> tuple[_OnPlane, _OnPlane]:
    """Transfer two views' fingers to the plane."""
    first, second = (_OnPlane.of(view, seen) for view, seen in zip(views, fingers, strict=True))
    return first, second


WIDTH_SPREAD = 0.5
"""Standard deviation of the logarithm of the ratio of the finger's widths in two views, seen from
different heights and sides."""

COLOUR_SPREAD = 0.4
"""The same for the ratio of its colours: cameras differ in exposure and white balance."""

DARK = 16.0
"""Grey levels added to colours before their ratio: dark levels are mostly noise."""

FOREGROUND_MISMATCH_PENALTY = 0.7
"""Part of its score that a pair of a foreground and a background finger loses."""


def _appearance_agreement(first: _OnPlane, second: _OnPlane, tips: _Tips) -> Array:
    """Return the likelihood of the widths, colours and foreground, 0 to 1; unknown ones count 1."""
    width = np.log(tips.widths[0] / tips.widths[1]) / WIDTH_SPREAD
    colour = np.log((first.colour + DARK) / (second.colour + DARK)) / COLOUR_SPREAD
    squared_distance = np.nan_to_num(width) ** 2 + np.nan_to_num(colour**2).mean(axis=-1)
    odd = np.nan_to_num(np.abs(first.foreground - second.foreground))
    return np.asarray(np.exp(-0.5 * squared_distance) * (1.0 - FOREGROUND_MISMATCH_PENALTY * odd))


MAX_LENGTH = 16.0
LENGTH_SPREAD = 0.2
"""Greatest length of a finger [half-widths], and the standard deviation of the logarithm of the
excess over it. In 150 runs on rendered films no pair of one finger is longer than 18, and 47 % of
all others are: a fold of a fist and another view's finger would be a finger seen nearly end-on, and
far too long."""


def _length_likelihood(first: _OnPlane, second: _OnPlane) -> Array:
    """Return the likelihood of the finger's length in space, 0 to 1; 1 if unknown.

    The finger is the intersection of the planes through either camera and its image line. A view
    foreshortens it by the sine of the angle between it and the ray to its tip.
    """
    finger = np.cross(first.normal, second.normal)
    seen = (one.length / _sines(finger, one.ray) for one in (first, second))
    too_long = np.log(np.fmax(np.fmax(*seen) / MAX_LENGTH, 1.0)) / LENGTH_SPREAD
    is_known = _sines(first.normal, second.normal) > math.sin(MIN_PLANE_ANGLE_RAD)
    return np.asarray(np.where(is_known, np.exp(-0.5 * np.square(too_long)), 1.0))


MIN_SINE = 1e-6
"""Smaller sines are rounding errors."""


def _sines(one: Array, other: Array) -> Array:
    """Return the sines of angles, at least `MIN_SINE`; NaN where a direction has no length."""
    across = np.linalg.norm(np.cross(one, other), axis=-1)
    product = np.linalg.norm(one, axis=-1) * np.linalg.norm(other, axis=-1)
    return np.asarray(np.maximum(across / np.where(product > 0.0, product, np.nan), MIN_SINE))


RAY_DISTANCE_SIGMA = 0.1
RAY_DISTANCE_SIGMA_PER_HEIGHT = 0.25
"""Standard deviation of the distance between the two rays through a tip [plane sizes], and its
increase per plane size of height: the cameras are known from the reference points alone."""

SAME_DIRECTION = 1e-12
"""Squared sine of the angle of two rays below which they are parallel."""

MAX_HEIGHT = 4.0
"""Greatest height of a tip above the plane [plane sizes]."""


@dataclass(frozen=True, eq=False, slots=True)
class _Tips:
    """Triangulated tips of the fingers of two views.

    Attributes
    ----------
    places
        Midpoints of the shortest segments between the rays (X, Y, height above the plane); NaN for
        unknown cameras and parallel rays.
    misses
        Lengths of these segments.
    widths
        Width of the finger at the tip by either view; NaN at a camera centre.
    """

    places: Array
    misses: Array
    widths: tuple[Array, Array]

    @classmethod
    def of(cls, first: _OnPlane, second: _OnPlane) -> _Tips:
        """Triangulate along the rays from the tips' projections on the plane to the cameras."""
        p, q = np.broadcast_arrays(first.ray, second.ray)
        between = np.zeros_like(p)
        between[..., :2] = second.foot - first.foot
        components = (np.moveaxis(x, -1, 0) for x in (p, q, between))
        s, t = _nearest(*(tuple(x) for x in components))
        nearest = s[..., None] * p, between + t[..., None] * q
        foot = _in_space(first.foot)
        return cls(
            places=foot + 0.5 * (nearest[0] + nearest[1]),
            misses=np.linalg.norm(nearest[1] - nearest[0], axis=-1),
            # A finger above the plane covers more of the plane than its width.
            widths=(_positive(first.breadth * (1.0 - s)), _positive(second.breadth * (1.0 - t))),
        )

    def same(self, plane_size: float) -> Array:
        """Return the likelihood that two tips are one point above the plane; 1 if unknown."""
        return np.asarray(_is_one(self.places[..., 2] / plane_size, self.misses / plane_size))

    def reach(self, point: Array) -> Array:
        """Return the distance of points of the plane from the tips [half-widths]; 0 if unknown."""
        away = np.linalg.norm(self.places - _in_space(point), axis=-1)
        return np.asarray(np.nan_to_num(away / np.sqrt(self.widths[0] * self.widths[1])))


MIN_REACH_LEAD = 2.0
MAX_DIGIT_DISTANCE = 20.0
"""Least lead of the digit of a hand that reaches farther, and greatest distance between the tips of
two digits [half-widths]."""

DIGIT_COLOUR = 0.7
"""Greatest mean absolute logarithm of the ratio of the colours of two digits: it is 0.5 at most
between the lit and the shaded side of a hand, and greater for a shadow."""


def reaches_farther(
    views: tuple[Viewpoint, Viewpoint],
    one: tuple[FingerDetection, FingerDetection],
    other: tuple[FingerDetection, FingerDetection],
) -> bool:
    """Whether the second of two digits of a hand reaches farther from the arm than the first.

    The index finger reaches farther than the thumb, whether that is held up, out or along.

    Parameters
    ----------
    views
        The two views.
    one, other
        The digits, each in the two views.

    Returns
    -------
    bool
        Whether it leads by more than `MIN_REACH_LEAD` in space, along the mean of the directions to
        their indicated points. False if they are not of one hand or the cameras are unknown.
    """
    if not all(_colours_agree(*digits) for digits in zip(one, other, strict=True)):
        return False
    first, second = _on_plane(views, ((one[0], other[0]), (one[1], other[1])))
    tips, (point, _) = _Tips.of(first, second), _meeting(first.line, second.line)
    place, widths = tips.places, np.array(tips.widths)
    ahead = _in_space(point) - place
    return _is_farther(place, ahead, float(np.exp(np.log(widths).mean())))


def reaches_farther_in_view(one: FingerDetection, other: FingerDetection) -> bool:
    """Apply the test of `reaches_farther` to the image of a single view."""
    tip_px = np.array([one.tip_px, other.tip_px])
    angle_rad = np.array([one.angle_rad, other.angle_rad])
    ahead = np.column_stack([np.cos(angle_rad), np.sin(angle_rad)])
    half_width_px = math.sqrt(one.half_width_px * other.half_width_px)
    return _colours_agree(one, other) and _is_farther(tip_px, ahead, half_width_px)


def _colours_agree(one: FingerDetection, other: FingerDetection) -> bool:
    """Whether two digits may be of one hand by their colours; True if unknown."""
    ratio = np.log((np.array(one.colour) + DARK) / (np.array(other.colour) + DARK))
    return not np.abs(ratio).mean() > DIGIT_COLOUR


def _is_farther(tips: Array, ahead: Array, half_width: float) -> bool:
    """Whether the second of two digits (2, D) reaches farther from the arm than the first."""
    # A tip that touches the plane at its target has no direction.
    lengths = np.linalg.norm(ahead, axis=-1, keepdims=True)
    ahead = ahead / np.maximum(lengths, np.finfo(float).tiny)
    mean, apart = ahead.sum(axis=0), (tips[1] - tips[0]) / half_width
    lead_one_way = ahead[0] @ ahead[1] > 0.0 and np.linalg.norm(apart) < MAX_DIGIT_DISTANCE
    return bool(lead_one_way and apart @ mean > MIN_REACH_LEAD * np.linalg.norm(mean))


def width_ratio(
    views: tuple[Viewpoint, Viewpoint], fingers: tuple[FingerDetection, FingerDetection]
) -> float:
    """Compare the widths of a finger in two views at its triangulated tip.

    A finger has about the same width from every side.

    Parameters
    ----------
    views, fingers
        The two views, and the finger in each.

    Returns
    -------
    float
        Logarithm of the first view's width over the second's; NaN if unknown.
    """
    (foot, ray, breadth), (other_foot, other_ray, other_breadth) = (
        _ray(view, finger) for view, finger in zip(views, fingers, strict=True)
    )
    s, t = _nearest(ray, other_ray, _between(foot, other_foot))
    width, other_width = abs(breadth * (1.0 - s)), abs(other_breadth * (1.0 - t))
    if not (width > 0.0 and other_width > 0.0):
        return math.nan
    return math.log(width / other_width)


def foreshortenings(
    views: tuple[Viewpoint, Viewpoint], fingers: tuple[FingerDetection, FingerDetection]
) -> tuple[float, float]:
    """Compute the foreshortening of a finger in either view.

    The finger is the intersection of the planes through either camera and its image line.

    Parameters
    ----------
    views, fingers
        As for `width_ratio`.

    Returns
    -------
    (float, float)
        Sines of the angles between the finger and the rays to its tip, 0 to 1; NaN if unknown, as
        for a finger that is nearly coplanar with both cameras.
    """
    (normal, ray), (other_normal, other_ray) = map(_plane_and_ray, views, fingers)
    if not _sine(normal, other_normal) > math.sin(MIN_PLANE_ANGLE_RAD):
        return math.nan, math.nan
    finger = _cross(normal, other_normal)
    return _sine(finger, ray), _sine(finger, other_ray)


def _plane_and_ray(viewpoint: Viewpoint, finger: FingerDetection) -> tuple[Direction, Direction]:
    """Return the normal of the plane through a camera and its finger line, and the tip's ray."""
    (u, v), back_px = finger.tip_px, SECOND_POINT_DISTANCE * finger.half_width_px
    behind = u - back_px * math.cos(finger.angle_rad), v - back_px * math.sin(finger.angle_rad)
    x, y, z = viewpoint.centre.tolist()
    feet = viewpoint.plane_view.back_project([(u, v), behind]).tolist()
    ray, other_ray = ((x - foot[0], y - foot[1], z) for foot in feet)
    return _cross(ray, other_ray), ray


def _cross(one: Direction, other: Direction) -> Direction:
    return (
        one[1] * other[2] - one[2] * other[1],
        one[2] * other[0] - one[0] * other[2],
        one[0] * other[1] - one[1] * other[0],
    )


def _sine(one: Direction, other: Direction) -> float:
    """Return the sine of the angle between two directions; NaN if one has no length."""
    product = math.hypot(*one) * math.hypot(*other)
    return min(math.hypot(*_cross(one, other)) / product, 1.0) if product > 0.0 else math.nan


def same_tip(
    views: tuple[Viewpoint, Viewpoint], fingers: tuple[FingerDetection, FingerDetection]
) -> float:
    """Return the likelihood that the tips of a finger in two views are one point above the plane.

    Parameters
    ----------
    views, fingers
        As for `width_ratio`.

    Returns
    -------
    float
        0 to 1; 1 if unknown.
    """
    return tip_rays(views, fingers).likelihood


class TipRays(NamedTuple):
    """The rays through the tips of two fingers, where they are nearest.

    Attributes
    ----------
    height, distance
        Height above the plane, and distance there [plane sizes]; NaN if unknown.
    """

    height: float
    distance: float

    @property
    def likelihood(self) -> float:
        """Likelihood that both tips are one point above the plane, 0 to 1; 1 if unknown."""
        return float(_is_one(self.height, self.distance))


def tip_rays(
    views: tuple[Viewpoint, Viewpoint], fingers: tuple[FingerDetection, FingerDetection]
) -> TipRays:
    """Return the rays through the tips of two fingers; the parameters are those of `same_tip`."""
    (foot, ray, _), (other_foot, other_ray, _) = (
        _ray(view, finger) for view, finger in zip(views, fingers, strict=True)
    )
    between = _between(foot, other_foot)
    s, t = _nearest(ray, other_ray, between)
    apart = (b + t * q - s * p for b, p, q in zip(between, ray, other_ray, strict=True))
    plane_size = views[0].plane_view.plane_size
    height = 0.5 * (s * ray[2] + t * other_ray[2])
    return TipRays(height / plane_size, math.hypot(*apart) / plane_size)


def _between(
    foot: tuple[float, float], other_foot: tuple[float, float]
) -> tuple[float, float, float]:
    """Return the vector from one point of the plane to another."""
    return other_foot[0] - foot[0], other_foot[1] - foot[1], 0.0


def _ray(
    view: Viewpoint, finger: FingerDetection
) -> tuple[tuple[float, float], tuple[float, float, float], float]:
    """Return the tip's projection on the plane, the ray from it to the camera, and the breadth."""
    (u, v), half_width_px = finger.tip_px, finger.half_width_px
    across = (
        -0.5 * half_width_px * math.sin(finger.angle_rad),
        0.5 * half_width_px * math.cos(finger.angle_rad),
    )
    shown = [(u, v), (u - across[0], v - across[1]), (u + across[0], v + across[1])]
    foot, left, right = view.plane_view.back_project(shown).tolist()
    x, y, z = view.centre.tolist()
    ray = x - foot[0], y - foot[1], z
    return (foot[0], foot[1]), ray, _breadth(right[0] - left[0], right[1] - left[1], *ray)


# The functions below work on components: floats for the one finger of a frame, arrays for the many
# of a search.


def _breadth(across_x: Numbers, across_y: Numbers, x: Numbers, y: Numbers, z: Numbers) -> Numbers:
    """Return the length of a vector of the plane perpendicular to a ray (x, y, z)."""
    along = across_x * x + across_y * y
    # Rounding may make the square negative for a vector along the ray.
    return abs(across_x**2 + across_y**2 - along**2 / (x**2 + y**2 + z**2)) ** 0.5


def _is_one(height: Numbers, miss: Numbers) -> Numbers:
    """Return the likelihood that two rays with this distance meet [plane sizes]; 1 if unknown."""
    fits = np.exp(
        -0.5 * (miss / (RAY_DISTANCE_SIGMA + RAY_DISTANCE_SIGMA_PER_HEIGHT * abs(height))) ** 2
    )
    fits = np.where((height > -RAY_DISTANCE_SIGMA) & (height < MAX_HEIGHT), fits, 0.0)
    return np.where(np.isfinite(height), fits, 1.0)


def _nearest(
    first: Sequence[Numbers], second: Sequence[Numbers], between: Sequence[Numbers]
) -> tuple[Numbers, Numbers]:
    """Return the parameters of the nearest points of two rays; NaN if parallel.

    Parameters
    ----------
    first, second
        The rays' components; the parameters are in units of their lengths.
    between
        Components of the vector from the first's foot to the second's.
    """
    pp, qq, pq, pd, qd = (
        a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
        for a, b in (
            (first, first),
            (second, second),
            (first, second),
            (first, between),
            (second, between),
        )
    )
    determinant = pp * qq - pq**2
    # NaN where the comparison fails, for both floats and arrays.
    determinant = np.where(determinant > SAME_DIRECTION * pp * qq, determinant, np.nan)
    return (qq * pd - pq * qd) / determinant, (pq * pd - pp * qd) / determinant


def _positive(widths: Array) -> Array:
    """Return absolute widths; NaN in place of 0."""
    return np.abs(np.where(widths == 0.0, np.nan, widths))


def _in_space(points: Array) -> Array:
    """Return points of the plane with their height, 0."""
    return np.concatenate([points, np.zeros_like(points[..., :1])], axis=-1)


def _homogeneous(points: Array) -> Array:
    return np.concatenate([points, np.ones_like(points[..., :1])], axis=-1)


def _meeting(first: Array, second: Array) -> tuple[Array, Array]:
    """Return the intersections of constraint lines, NaN for parallels, and their angles."""
    first, second = np.broadcast_arrays(first, second)
    meeting = np.cross(first, second)
    with np.errstate(divide="ignore", invalid="ignore"):
        point = meeting[..., :2] / meeting[..., 2:]
    cosine = (first[..., :2] * second[..., :2]).sum(axis=-1)
    angle = np.arctan2(np.abs(meeting[..., 2]), np.abs(cosine))
    return np.where(np.isfinite(point), point, np.nan), np.asarray(angle)


def _projected(view: PlaneView, point: Array) -> Array:
    """Project points of the plane by the ideal pinhole; NaN beyond the horizon."""
    x = _homogeneous(point) @ view.image_from_plane.T
    return x[..., :2] / np.where(x[..., 2:] > 0.0, x[..., 2:], np.nan)


def _offset(line: Array, point: Array) -> Array:
    """Return the distance of points from lines."""
    across = (line[..., :2] * point).sum(axis=-1) + line[..., 2]
    return np.asarray(np.abs(across) / np.linalg.norm(line[..., :2], axis=-1))
