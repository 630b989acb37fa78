"""Which fingers of two views may be one, by the geometry of the plane.

A finger above the plane that points at it leaves a constraint line for every view: they meet ahead
of its tip, and the rays through the tip meet in one point above the plane.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fingerpost.finding.finger import Array, Sighting
from fingerpost.pointing import PlaneView
from fingerpost.silhouette import Capsule, Silhouette, image_from_space
from fingerpost.uncertainty import Numbers

Direction = tuple[float, float, float]
"""Components (X, Y, height above the plane) of a direction."""

FARTHEST = 20.0
"""The longest focal length [picture widths]."""


@dataclass(frozen=True, eq=False, slots=True)
class Viewpoint:
    """A view of the plane, and about where it is taken from.

    Attributes
    ----------
    plane_view
        How the view sees the plane.
    centre
        Centre of the camera (X, Y, height above the plane), in plane units; NaN if not known.
    """

    plane_view: PlaneView
    centre: Array

    def silhouette(self, bodies: Sequence[Capsule]) -> Silhouette:
        """Return what bodies in plane coordinates cover of the image, in ideal pixels."""
        matrix = image_from_space(self.plane_view.image_from_plane, self.centre)
        return Silhouette.of(bodies, matrix, self.centre)

    @classmethod
    def of(cls, view: PlaneView, size_px: tuple[int, int]) -> Viewpoint:
        """Tell about where a view with pictures of (width, height) is taken from.

        The homography of a plane and square pixels about a known principal point give the focal
        length, and with it the camera's pose: the columns h1, h2 of K⁻¹T are orthogonal and of one
        length. The principal point is the lens's, or the middle of the picture: close enough to
        tell which tips may be one.
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
        if lens is not None:
            f_px = lens.fx
        # Beyond this a view is a parallel projection for what it is needed for.
        f_px = min(f_px, FARTHEST * max(size_px))
        T[:2] /= f_px
        T /= np.sqrt(np.linalg.norm(T[:, 0]) * np.linalg.norm(T[:, 1]))
        rotation = np.column_stack([T[:, 0], T[:, 1], np.cross(T[:, 0], T[:, 1])])
        if abs(np.linalg.det(rotation)) < np.finfo(float).eps:
            return cls(view, np.full(3, np.nan))
        centre = -np.linalg.solve(rotation, T[:, 2])
        return cls(view, np.array([centre[0], centre[1], abs(centre[2])]))


LEAST_ANGLE_RAD = np.radians(2.0)
"""Constraint lines that meet at less than this tell no point, whatever they show."""

TIP_SLACK = 3.0
"""How far behind the tip the target may seem to lie [half-widths]: a fingertip that touches the
plane points at itself."""

FLAT_ANGLE_RAD = np.radians(6.0)
FLAT_OFFSET = 1.5
"""What two views show lies in the plane if its constraint lines meet at less than this angle, and
each passes the other view's tip at less than this [half-widths]."""

LEAST_CROSSING_RAD = math.radians(5.0)
"""Planes through two cameras and a finger that cross at less than this do not tell how it lies: a
degree of either line would turn it by more than ten."""

BACK = 4.0
"""A finger line leads through its tip and a point so far behind it [half-widths]."""

REACH = 1.5
"""How far from the middle of the reference points one may point [plane sizes]."""

OTHER_TIP = 0.8
"""Two tips that are one point with less than this, by `MISS`, are those of two fingers [0 to 1];
one tip reaches 0.96 in every frame of the recordings."""

TIP_POWER = 10.0
"""How well two tips may be one, by `MISS`, counts in a pair's score with this power. Of pairs in
150 runs on rendered films 99 % of one finger have 0.997 and more, half of all others 0.94 and less,
and it is what tells them apart best. Reference points that are off by 3 px, and a lens that is not
corrected as well (k1 = -0.3), leave one finger 0.98 and more in 95 % of its poses."""

REACH_SPREAD = 60.0
"""One points at what is near: at this distance from the tip the indicated point costs a pair 40 %
of its score [half-widths]. A thumb that is not held up leads much farther."""


def pair_scores(
    views: tuple[Viewpoint, Viewpoint],
    fingers: tuple[Sequence[Sighting], Sequence[Sighting]],
) -> Array:
    """Tell which fingers of two views may be one that points at the plane.

    Parameters
    ----------
    views
        How the two views see the plane.
    fingers
        N fingers of the first view, M of the second.

    Returns
    -------
    (N, M)
        Product of the two scores and of how well their tips, widths and colours agree, whether they
        are no longer than a finger, and whether they have come into view; 0 for a pair that cannot
        be one finger above the plane that points at it.
    """
    first, second = _carried(views, fingers)
    point, angle = _meeting(first.line, second.line)
    possible = angle > LEAST_ANGLE_RAD
    for view, finger in zip(
        (views[0].plane_view, views[1].plane_view), (first, second), strict=True
    ):
        ahead = ((_projected(view, point) - finger.tip_px) * finger.direction).sum(axis=-1)
        possible &= ahead > -TIP_SLACK * finger.half_width_px
    flat = angle < FLAT_ANGLE_RAD
    for one, other in ((first, second), (second, first)):
        flat &= _offset(one.line, other.foot) < FLAT_OFFSET * other.width
    plane = views[0].plane_view
    away = np.linalg.norm(point - plane.plane_points.mean(axis=0), axis=-1) / plane.plane_size
    tips = _Tips.of(first, second)
    score = first.score * second.score * _alike(first, second, tips)
    score *= np.exp(-0.5 * np.square(tips.reach(point) / REACH_SPREAD))
    same = tips.same(plane.plane_size)
    possible &= same >= OTHER_TIP
    score *= same**TIP_POWER * _likely_long(first, second)
    return np.asarray(np.where(possible & (away < REACH) & ~flat, score, 0.0))


FOOT_SPREAD = 3.0
"""How far from there a tip above the plane may seem to stand on it: at this distance it costs a
pair 40 % of its score [plane sizes]."""


@dataclass(frozen=True, eq=False, slots=True)
class _OnPlane:
    """Fingers of one view, and what they are on the plane."""

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
        """Return the same with an axis of length one added for the other view's fingers."""
        entries = (getattr(self, name) for name in self.__slots__)
        return _OnPlane(*(np.expand_dims(entry, axis) for entry in entries))

    @classmethod
    def of(cls, viewpoint: Viewpoint, fingers: Sequence[Sighting]) -> _OnPlane:
        """Carry fingers to the plane; NaN where they are not on it."""
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
        tip, back = shown, shown - BACK * w[:, None] * direction
        if view.lens is not None:
            tip, back = view.lens.undistort(tip), view.lens.undistort(back)
        foot = view.back_project(shown)
        left, right = (view.back_project(shown + s * w[:, None] * across) for s in (-0.5, 0.5))
        # A foot far from where one works costs score; one beyond the horizon, all of it.
        away = np.linalg.norm(foot - view.plane_points.mean(axis=0), axis=-1) / view.plane_size
        near = np.exp(-0.5 * np.square(away / FOOT_SPREAD))
        line = np.cross(_homogeneous(back), _homogeneous(tip)) @ view.image_from_plane
        x, y, height = viewpoint.centre
        # The plane through the line and the camera.
        normal = np.column_stack([line[:, :2], -(line @ [x, y, 1.0]) / height])
        ray = viewpoint.centre - np.pad(foot, ((0, 0), (0, 1)))
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


def _carried(
    views: tuple[Viewpoint, Viewpoint],
    fingers: tuple[Sequence[Sighting], Sequence[Sighting]],
) -> tuple[_OnPlane, _OnPlane]:
    """Carry the fingers of two views to the plane: rows are the first's, columns the second's."""
    first, second = (_OnPlane.of(view, seen) for view, seen in zip(views, fingers, strict=True))
    return first.along(1), second.along(0)


WIDTH_SPREAD = 0.5
"""Logarithm of the ratio of the finger's widths on the plane, as two views see it, that costs a
pair 40 % of its score: the views see it from different heights and sides."""

COLOUR_SPREAD = 0.4
"""The same for the ratio of its colours: cameras differ in exposure and white balance."""

DARK = 16.0
"""Grey levels that are added to colours before their ratio: dark ones are mostly noise."""

ODD_MOVER = 0.7
"""What it costs a pair that one view shows foreground where the other shows background."""


def _alike(first: _OnPlane, second: _OnPlane, tips: _Tips) -> Array:
    """Return how well widths, colours and foreground agree, 0 to 1; what is not known agrees."""
    width = np.log(tips.widths[0] / tips.widths[1]) / WIDTH_SPREAD
    colour = np.log((first.colour + DARK) / (second.colour + DARK)) / COLOUR_SPREAD
    unlike = np.nan_to_num(width) ** 2 + np.nan_to_num(colour**2).mean(axis=-1)
    odd = np.nan_to_num(np.abs(first.foreground - second.foreground))
    return np.asarray(np.exp(-0.5 * unlike) * (1.0 - ODD_MOVER * odd))


LONGEST = 16.0
LENGTH_SPREAD = 0.2
"""A finger is hardly longer than this [half-widths]: what is longer by that logarithm costs a pair
40 % of its score. Of pairs in 150 runs on rendered films none of one finger is longer than 18, and
47 % of all others are: a fold of a fist and another view's finger would be a finger that is seen
nearly end-on, and far too long."""


def _likely_long(first: _OnPlane, second: _OnPlane) -> Array:
    """Return how likely a finger is as long as it must be, 0 to 1; 1 if that is not known.

    The finger is the line that both planes through a camera and its image share: a view shows it
    shorter than it is by the sine of the angle between that and the ray to its tip.
    """
    finger = np.cross(first.normal, second.normal)
    seen = (one.length / _sines(finger, one.ray) for one in (first, second))
    too_long = np.log(np.fmax(np.fmax(*seen) / LONGEST, 1.0)) / LENGTH_SPREAD
    is_known = _sines(first.normal, second.normal) > math.sin(LEAST_CROSSING_RAD)
    return np.asarray(np.where(is_known, np.exp(-0.5 * np.square(too_long)), 1.0))


LEAST_SINE = 1e-6
"""Less is rounding."""


def _sines(one: Array, other: Array) -> Array:
    """Return the sines of the angles between directions, not quite 0; NaN where one is none."""
    across = np.linalg.norm(np.cross(one, other), axis=-1)
    product = np.linalg.norm(one, axis=-1) * np.linalg.norm(other, axis=-1)
    return np.asarray(np.maximum(across / np.where(product > 0.0, product, np.nan), LEAST_SINE))


MISS = 0.1
MISS_PER_HEIGHT = 0.25
"""How far apart two rays through a tip may pass [plane sizes], and how much further for every plane
size of height, that it costs a pair 40 %: the cameras are known by the reference points alone."""

SAME_DIRECTION = 1e-12
"""Rays whose angle has a squared sine below this have one direction."""

HIGHEST = 4.0
"""No tip is higher above the plane than this [plane sizes]."""


@dataclass(frozen=True, eq=False, slots=True)
class _Tips:
    """Where the tips of fingers of two views come nearest to one point above the plane.

    Attributes
    ----------
    places
        Where that is (X, Y, height above the plane); NaN where the cameras are not known, and for
        rays of one direction.
    misses
        How far from each other the rays through the tips pass there.
    widths
        How wide either view shows the finger to be, if its tip is there; NaN where a camera is.
    """

    places: Array
    misses: Array
    widths: tuple[Array, Array]

    @classmethod
    def of(cls, first: _OnPlane, second: _OnPlane) -> _Tips:
        """Intersect the rays, which lead from where the view shows the tip on the plane to it."""
        p, q = np.broadcast_arrays(first.ray, second.ray)
        between = np.zeros_like(p)
        between[..., :2] = second.foot - first.foot
        components = (np.moveaxis(x, -1, 0) for x in (p, q, between))
        s, t = _nearest(*(tuple(x) for x in components))
        nearest = s[..., None] * p, between + t[..., None] * q
        foot = np.pad(first.foot, ((0, 0), (0, 0), (0, 1)))
        return cls(
            places=foot + 0.5 * (nearest[0] + nearest[1]),
            misses=np.linalg.norm(nearest[1] - nearest[0], axis=-1),
            # A finger above the plane covers more of that than it is wide.
            widths=(_positive(first.breadth * (1.0 - s)), _positive(second.breadth * (1.0 - t))),
        )

    def same(self, plane_size: float) -> Array:
        """Return how well two tips may be one point above the plane, 0 to 1; 1 if not known."""
        return np.asarray(_is_one(self.places[..., 2] / plane_size, self.misses / plane_size))

    def reach(self, point: Array) -> Array:
        """Return how far points of the plane are from the tips [half-widths]; 0 if not known."""
        away = np.linalg.norm(self.places - np.pad(point, ((0, 0), (0, 0), (0, 1))), axis=-1)
        return np.asarray(np.nan_to_num(away / np.sqrt(self.widths[0] * self.widths[1])))


FARTHER = 2.0
DIGITS_APART = 20.0
"""A digit reaches farther than another one of its hand by so many half-widths at least, and their
tips are no farther apart than this."""

DIGIT_COLOUR = 0.7
"""The mean logarithm of the ratio of two digits' colours is below this: the sides of a hand in the
light and in the shade are alike, as 0.5 at most, and a shadow is darker."""


def reaches_farther(
    views: tuple[Viewpoint, Viewpoint],
    one: tuple[Sighting, Sighting],
    other: tuple[Sighting, Sighting],
) -> bool:
    """Tell whether of two digits of a hand the other reaches farther from the arm than the one.

    Both lead away from the arm; the index finger does so farther than the thumb, whether that is
    held up, aside or along.

    Parameters
    ----------
    views
        How two views see the plane.
    one, other
        The digits in the two views.

    Returns
    -------
    bool
        Whether it does by `FARTHER` at least, above the plane and along the mean of the directions
        to where both point; not if they are no digits of one hand, or the cameras are not known.
    """
    first, second = _carried(views, ((one[0], other[0]), (one[1], other[1])))
    tips, (point, _) = _Tips.of(first, second), _meeting(first.line, second.line)
    both = [0, 1], [0, 1]
    place = tips.places[both]
    widths = np.array([width[both] for width in tips.widths])
    alike = all(_are_alike(*digits) for digits in zip(one, other, strict=True))
    ahead = np.pad(point[both], ((0, 0), (0, 1))) - place
    return alike and _is_farther(place, ahead, float(np.exp(np.log(widths).mean())))


def reaches_farther_in_view(one: Sighting, other: Sighting) -> bool:
    """Tell the same by what a single view shows; see `reaches_farther`."""
    tip_px = np.array([one.tip_px, other.tip_px])
    angle_rad = np.array([one.angle_rad, other.angle_rad])
    ahead = np.column_stack([np.cos(angle_rad), np.sin(angle_rad)])
    half_width_px = math.sqrt(one.half_width_px * other.half_width_px)
    return _are_alike(one, other) and _is_farther(tip_px, ahead, half_width_px)


def _are_alike(one: Sighting, other: Sighting) -> bool:
    """Tell whether two digits may be of one hand by their colours; so they may if unknown."""
    ratio = np.log((np.array(one.colour) + DARK) / (np.array(other.colour) + DARK))
    return not np.abs(ratio).mean() > DIGIT_COLOUR


def _is_farther(tips: Array, ahead: Array, half_width: float) -> bool:
    """Tell whether the second of two digits (2, D) reaches farther from the arm than the first."""
    # A tip that touches the plane where it points leads nowhere.
    lengths = np.linalg.norm(ahead, axis=-1, keepdims=True)
    ahead = ahead / np.maximum(lengths, np.finfo(float).tiny)
    mean, apart = ahead.sum(axis=0), (tips[1] - tips[0]) / half_width
    lead_one_way = ahead[0] @ ahead[1] > 0.0 and np.linalg.norm(apart) < DIGITS_APART
    return bool(lead_one_way and apart @ mean > FARTHER * np.linalg.norm(mean))


def width_ratio(views: tuple[Viewpoint, Viewpoint], fingers: tuple[Sighting, Sighting]) -> float:
    """Tell how much wider one view shows a finger to be than another one does.

    A finger is about as wide from every side, where it is: at its tip, above the plane.

    Parameters
    ----------
    views, fingers
        How two views see the plane, and the finger in each.

    Returns
    -------
    float
        Logarithm of the ratio of the first's width to the second's; NaN where that is not known.
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
    views: tuple[Viewpoint, Viewpoint], fingers: tuple[Sighting, Sighting]
) -> tuple[float, float]:
    """Tell by how much either view shows a finger shorter than it is.

    The finger is the line that both planes through a camera and its image share.

    Parameters
    ----------
    views, fingers
        As for `width_ratio`.

    Returns
    -------
    (float, float)
        Sines of the angles between the finger and the rays to its tip, 0 to 1; NaN where they are
        not known, as of a finger that lies nearly in one plane with both cameras.
    """
    (normal, ray), (other_normal, other_ray) = map(_plane_and_ray, views, fingers)
    if not _sine(normal, other_normal) > math.sin(LEAST_CROSSING_RAD):
        return math.nan, math.nan
    finger = _cross(normal, other_normal)
    return _sine(finger, ray), _sine(finger, other_ray)


def _plane_and_ray(viewpoint: Viewpoint, finger: Sighting) -> tuple[Direction, Direction]:
    """Return the normal of the plane through a camera and its finger line, and the tip's ray."""
    (u, v), back_px = finger.tip_px, BACK * finger.half_width_px
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
    """Return the sine of the angle between two directions; NaN if one of them is none."""
    product = math.hypot(*one) * math.hypot(*other)
    return min(math.hypot(*_cross(one, other)) / product, 1.0) if product > 0.0 else math.nan


def same_tip(views: tuple[Viewpoint, Viewpoint], fingers: tuple[Sighting, Sighting]) -> float:
    """Tell how well the tips of a finger of two views may be one point above the plane.

    Parameters
    ----------
    views, fingers
        As for `width_ratio`.

    Returns
    -------
    float
        0 to 1; 1 where it is not known.
    """
    (foot, ray, _), (other_foot, other_ray, _) = (
        _ray(view, finger) for view, finger in zip(views, fingers, strict=True)
    )
    between = _between(foot, other_foot)
    s, t = _nearest(ray, other_ray, between)
    miss = math.hypot(*(b + t * q - s * p for b, p, q in zip(between, ray, other_ray, strict=True)))
    height = 0.5 * (s * ray[2] + t * other_ray[2])
    plane_size = views[0].plane_view.plane_size
    return float(_is_one(height / plane_size, miss / plane_size))


def _between(
    foot: tuple[float, float], other_foot: tuple[float, float]
) -> tuple[float, float, float]:
    """Return the way from one place on the plane to another."""
    return other_foot[0] - foot[0], other_foot[1] - foot[1], 0.0


def _ray(
    view: Viewpoint, finger: Sighting
) -> tuple[tuple[float, float], tuple[float, float, float], float]:
    """Return where a view shows a tip on the plane, the ray from there, and the breadth."""
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


# What follows is written in components, which are floats for the one finger of a frame and arrays
# for the many of a search.


def _breadth(across_x: Numbers, across_y: Numbers, x: Numbers, y: Numbers, z: Numbers) -> Numbers:
    """Return what a ray sees across, not what that covers of the plane aslant."""
    along = across_x * x + across_y * y
    # Rounding may leave less than nothing of what points at the camera.
    return abs(across_x**2 + across_y**2 - along**2 / (x**2 + y**2 + z**2)) ** 0.5


def _is_one(height: Numbers, miss: Numbers) -> Numbers:
    """Return how well two rays through a tip meet in one [plane sizes]; 1 if that is not known."""
    fits = np.exp(-0.5 * (miss / (MISS + MISS_PER_HEIGHT * abs(height))) ** 2)
    fits = np.where((height > -MISS) & (height < HIGHEST), fits, 0.0)
    return np.where(np.isfinite(height), fits, 1.0)


def _nearest(
    first: Sequence[Numbers], second: Sequence[Numbers], between: Sequence[Numbers]
) -> tuple[Numbers, Numbers]:
    """Return how far along two rays their nearest points are, NaN for those of one direction.

    Parameters
    ----------
    first, second
        The rays' components; their lengths are the unit.
    between
        Components of the way from the first's foot to the second's.
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
    # NaN beyond a comparison that fails, for floats and arrays alike.
    determinant = np.where(determinant > SAME_DIRECTION * pp * qq, determinant, np.nan)
    return (qq * pd - pq * qd) / determinant, (pq * pd - pp * qd) / determinant


def _positive(widths: Array) -> Array:
    """Return widths without their sign; NaN where there is none."""
    return np.abs(np.where(widths == 0.0, np.nan, widths))


def _homogeneous(points: Array) -> Array:
    return np.concatenate([points, np.ones_like(points[..., :1])], axis=-1)


def _meeting(first: Array, second: Array) -> tuple[Array, Array]:
    """Return where constraint lines meet, NaN for parallels, and at what angle."""
    first, second = np.broadcast_arrays(first, second)
    meeting = np.cross(first, second)
    with np.errstate(divide="ignore", invalid="ignore"):
        point = meeting[..., :2] / meeting[..., 2:]
    cosine = (first[..., :2] * second[..., :2]).sum(axis=-1)
    angle = np.arctan2(np.abs(meeting[..., 2]), np.abs(cosine))
    return np.where(np.isfinite(point), point, np.nan), np.asarray(angle)


def _projected(view: PlaneView, point: Array) -> Array:
    """Return where the ideal pinhole shows points of the plane; NaN beyond the horizon."""
    x = _homogeneous(point) @ view.image_from_plane.T
    return x[..., :2] / np.where(x[..., 2:] > 0.0, x[..., 2:], np.nan)


def _offset(line: Array, point: Array) -> Array:
    """Return the distance of points from lines."""
    across = (line[..., :2] * point).sum(axis=-1) + line[..., 2]
    return np.asarray(np.abs(across) / np.linalg.norm(line[..., :2], axis=-1))
