"""Find the hand by itself: candidates in every view, tried by the fit, confirmed by another view.

In one image much looks like a finger: pens, cables, other fingers. Three things tell. A fit that
starts at the candidate must hold for some frames. The finger lines of two views, turned into
constraint lines on the plane, must meet at a point that lies ahead of both tips, where one may
point. And what both views show must not lie in the plane: marks, pens and shadows on the table
map to one and the same line, while a finger above it maps to two.

Where a camera keeps still, what was there before is hardly the hand; a hand that waits in the
first frames already is believed if it is a good one, and followed for good once it has moved.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from fingerpost._core import (
    Background,
    Candidate,
    ContourTracker,
    HandFinder,
    StartPose,
    Template,
    Track,
)
from fingerpost._core import FingerLine as CoreFingerLine
from fingerpost.capture import Frame
from fingerpost.pointing import (
    FingerLine,
    PlaneView,
    PointingOptions,
    Status,
    indicated_point,
)

Array = NDArray[np.float64]

MOST_TRIALS = 8
"""Trials at a time in one view; each costs about as much as tracking."""

NEW_TRIALS = 4
"""Pairs of candidates that are tried anew, per frame."""

TRY_AGAIN = 6
"""Frames after which a candidate that the fit has refused is tried again."""

MISSES = 2
"""Frames in a row without an accepted fit that end a trial."""

FORGET = 0.8
"""What a trial's score keeps from frame to frame; the rest is what the finder says of it now."""

IN_FOREGROUND = 0.5
"""A finger that is foreground to at least this part has come into view."""

FRAMES_TO_TRUST = {True: (3.0, 10.0), False: (5.0, 14.0)}
"""Frames that both trials of a pair must have held, if its score is 1 and if it is 0: for a pair
that has come into view, and for one that may have been there all the time."""

LEAST_SCORE = {True: 0.15, False: 0.4}
"""The least score of a pair that is believed, in the same two cases."""

HAND_SEEN = 0.5
"""A pair that may have been there all the time is worth in full from where its fingers widen that
much to a hand in either view [0 to 1]: what stands on the table, as a bottle or a pen, does not."""

SETTLED_FRAMES = 10
"""A trial that starts in the background this many frames after that was known is no hand: that
would have been seen to come."""

STAYS = 1.25
"""How much better another pair must be than the one that is followed already."""

PROVEN_MOTION = 2.0
PROVEN_FRAMES = 10
"""A finger that has moved by so many half-widths, or has been foreground for so many frames, is
followed for good."""

STILL = 0.3
LATELY = 3
"""A finger whose tip has moved by less than so many half-widths in the last frames keeps still."""

UNBELIEVED_FRAMES = 3
"""What has been found in one view is dropped when no other view has shown it for so many frames."""

COME_PART = 0.3
"""A hand may have come to a waiting template if this much of the finger's place is foreground."""

COME_WHOLE = 0.8
"""A finger of which this much is foreground has come into view as a whole."""

BACKGROUND_PART = 0.1
BACKGROUND_FRAMES = 8
"""A finger of which less than this has been foreground for so many frames is none."""

OTHER_TIP = 0.8
"""Two tips that are one point with less than this, by `MISS`, may be those of two fingers [0 to 1].
Rays that pass so far apart are no proof alone: the lines must contradict each other besides."""

DOUBTED_FRAMES = 20
"""Views that have given no point for so many frames follow different things."""

LENGTHS = (10.5, 9.0, 8.0, 7.0, 6.0, 5.0)
"""Templates that may follow a found finger, in its fitted half-widths, the longest first: an
index finger is hardly longer from knuckle to tip."""

MEASURED = 2
"""How often the longest is looked for: a trial's template lies near the tip, where a finger is
slim, and tells too small a width to begin with."""

LOOKS = 3
"""How often each of them looks at the frame: its colours, known from the first look, bring out
flanks that grey hides, and with them the width."""

FAR_END = 0.3
FAR_END_SEEN = 0.7
"""A template is no longer than the finger if on either flank at least this part of the edges agrees
with the fit, over the given part of its length farthest from the tip."""

SAME_TURN_RAD = 0.2
"""It leads nowhere else: a template turned by more has taken other edges for the finger's."""

REACH = 1.5
"""How far from the middle of the reference points one may point [plane sizes]."""

MAY_POINT = PointingOptions(max_sigma=0.12)
"""What a pair of finger lines must tell of their point before it is believed: templates that have
just been started are short, and their lines less sure than those of a hand that is followed."""

POINT_SPREAD = 1.0
"""At this distance from there the indicated point costs a pair 40 % of its score [plane sizes]."""

FOOT_SPREAD = 3.0
"""How far from there a tip above the plane may seem to stand on it: at this distance it costs a
pair 40 % of its score [plane sizes]."""

TIP_SLACK = 3.0
"""How far behind the tip the target may seem to lie [half-widths]: a fingertip that touches the
plane points at itself."""

FLAT_ANGLE_RAD = np.radians(6.0)
FLAT_OFFSET = 1.5
"""What two views show lies in the plane if its constraint lines meet at less than this angle, and
each passes the other view's tip at less than this [half-widths]."""

LEAST_ANGLE_RAD = np.radians(2.0)
"""Constraint lines that meet at less than this tell no point, whatever they show."""

WIDTH_SPREAD = 0.5
"""Logarithm of the ratio of the finger's widths on the plane, as two views see it, that costs a
pair 40 % of its score: the views see it from different heights and sides."""

COLOUR_SPREAD = 0.4
"""The same for the ratio of its colours: cameras differ in exposure and white balance."""

DARK = 16.0
"""Grey levels that are added to colours before their ratio: dark ones are mostly noise."""

MISS = 0.1
MISS_PER_HEIGHT = 0.25
"""How far apart two rays through a tip may pass [plane sizes], and how much further for every plane
size of height, that it costs a pair 40 %: the cameras are known by the reference points alone."""

HIGHEST = 4.0
"""No tip is higher above the plane than this [plane sizes]."""

ODD_MOVER = 0.7
"""What it costs a pair that one view shows foreground where the other shows background."""

ALIKE_IN_PLANE = (0.4, 0.7)
"""How far the contrasts along a finger's outline, each flank and the end for itself, are those that
another view shows at the same place of the plane, from where it begins to look flat, and from
where it is: a print, a pen, a shadow."""

FLAT_WORTH = 0.1
"""What a flat finger is worth."""

IS_FLAT = 0.2
"""What a waiting template follows lies on the table where it has looked this flat of late; a hand,
even with its finger on the table, does not at all."""

FLAT_KEPT = 0.5
"""What that keeps from look to look; the rest is what the present frames show."""

HALF_WIDTH_NAME = "half_width [px]"
"""The component of the band model's shape vector."""

HALF_WIDTH = 0.115
"""Half the width of the usual finger, in visible lengths."""


class Sighting(NamedTuple):
    """A finger that a view may be showing."""

    tip_px: tuple[float, float]
    angle_rad: float
    half_width_px: float
    score: float = 1.0
    """How like a finger it is, 0 to 1."""
    foreground: float = np.nan
    """How like foreground it is, 0 to 1; NaN where no background is known."""
    colour: tuple[float, float, float] = (np.nan, np.nan, np.nan)
    """Mean colour of its inside; NaN where that is not known."""


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


FARTHEST = 20.0
"""The longest focal length [picture widths]."""


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
        Product of the two scores and of how well their widths and colours agree, and whether they
        have come into view; 0 for a pair that cannot be one finger above the plane that points
        at it.
    """
    on_plane = [_OnPlane.of(view, seen) for view, seen in zip(views, fingers, strict=True)]
    # Rows are the first view's, columns the second's.
    first, second = (seen.along(axis) for seen, axis in zip(on_plane, (1, 0), strict=True))
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
    score = first.score * second.score * _alike(first, second)
    score *= np.exp(-0.5 * np.square(away / POINT_SPREAD))
    score *= _same_tip(first, second, plane.plane_size)
    return np.asarray(np.where(possible & (away < REACH) & ~flat, score, 0.0))


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
    ray: Array

    def along(self, axis: int) -> _OnPlane:
        """Return the same with an axis of length one added for the other view's fingers."""
        entries = (getattr(self, name) for name in self.__slots__)
        return _OnPlane(*(np.expand_dims(entry, axis) for entry in entries))

    @classmethod
    def of(cls, viewpoint: Viewpoint, fingers: Sequence[Sighting]) -> _OnPlane:
        """Carry fingers to the plane; NaN where they are not on it."""
        view = viewpoint.plane_view
        columns = np.array(
            [[*f.tip_px, f.angle_rad, f.half_width_px, f.score, f.foreground] for f in fingers]
        ).reshape(-1, 6)
        shown, (angle, w, score, foreground) = columns[:, :2], columns[:, 2:].T
        direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        across = np.stack([-direction[:, 1], direction[:, 0]], axis=-1)
        tip, back = shown, shown - 4.0 * w[:, None] * direction
        if view.lens is not None:
            tip, back = view.lens.undistort(tip), view.lens.undistort(back)
        foot = view.back_project(shown)
        left, right = (view.back_project(shown + s * w[:, None] * across) for s in (-0.5, 0.5))
        # A foot far from where one works costs score; one beyond the horizon, all of it.
        away = np.linalg.norm(foot - view.plane_points.mean(axis=0), axis=-1) / view.plane_size
        near = np.exp(-0.5 * np.square(away / FOOT_SPREAD))
        return cls(
            tip_px=tip,
            direction=direction,
            half_width_px=w,
            colour=np.array([f.colour for f in fingers], dtype=float).reshape(-1, 3),
            foreground=foreground,
            score=score * np.nan_to_num(near),
            line=np.cross(_homogeneous(back), _homogeneous(tip)) @ view.image_from_plane,
            foot=foot,
            width=np.linalg.norm(right - left, axis=-1),
            ray=viewpoint.centre - np.pad(foot, ((0, 0), (0, 1))),
        )


def flatness(
    views: tuple[PlaneView, PlaneView],
    greys: tuple[NDArray[np.uint8], NDArray[np.uint8]],
    fingers: Sequence[Sighting],
) -> Array:
    """Tell which fingers of the first view lie in the plane, by what the second shows there.

    Parameters
    ----------
    views
        How the two views see the plane.
    greys
        What they see.
    fingers
        N fingers of the first view.

    Returns
    -------
    (N,)
        0 for what stands above the plane or is not seen by the second view, 1 for what looks the
        same in both after the map from one to the other through the plane.
    """
    flat = np.zeros(len(fingers))
    for k, finger in enumerate(fingers):
        e = np.array([np.cos(finger.angle_rad), np.sin(finger.angle_rad)])
        n = np.array([-e[1], e[0]])
        # From the tip, in half-widths: inside and outside of left flank, right flank and end.
        places = _OUTLINE[..., :1] * e + _OUTLINE[..., 1:] * n
        here = np.array(finger.tip_px) + finger.half_width_px * places
        on_plane = views[0].back_project(here)
        seen = np.asarray(np.isfinite(on_plane).all(axis=-1))
        there = views[1].project(np.where(seen[..., None], on_plane, 0.0))
        (a_in, a_out), (b_in, b_out) = _shown(greys[0], here), _shown(greys[1], there)
        a, b = a_in - a_out, np.where(seen.all(axis=0), b_in - b_out, np.nan)
        if np.isnan(a).any() or np.isnan(b).any():
            continue
        alike = (a * b).sum(axis=-1) / (np.maximum(a**2, b**2).sum(axis=-1) + NOISE_GREY**2)
        low, high = ALIKE_IN_PLANE
        flat[k] = np.clip((alike.min() - low) / (high - low), 0.0, 1.0)
    return flat


def widening(image: NDArray[np.uint8], line: CoreFingerLine, half_width_px: float) -> float:
    """Tell how far a finger widens behind, as it does to a hand and a pen does not.

    Parameters
    ----------
    image
        (H, W) grey levels or (H, W, 3) colours.
    line, half_width_px
        The finger's axis, and half its width [px].

    Returns
    -------
    float
        The part of what lies behind it and beside its flanks, on the better side, that looks like
        the finger, 0 to 1: an index finger is at the edge of its hand.
    """
    e = np.array([np.cos(line.angle_rad), np.sin(line.angle_rad)])
    n = np.array([-e[1], e[0]])

    def levels(along: Array, across: Array) -> Array:
        places = along[:, None, None] * e + across[:, None] * n
        return _shown(image, line.tip_px + half_width_px * places)

    inside = levels(-np.linspace(1.0, 4.0, 12), np.linspace(-0.5, 0.5, 5))
    inside = inside.reshape(-1, inside.shape[2] if inside.ndim == 3 else 1)
    inside = inside[np.isfinite(inside).all(axis=1)]
    if len(inside) < INSIDE_SEEN:
        return 0.0
    channels = inside.shape[1]
    covariance = np.atleast_2d(np.cov(inside, rowvar=False)) + NOISE_GREY**2 * np.eye(channels)
    rows = -np.linspace(*WIDENS, 12)
    alike = []
    for across in ((-0.6, 0.6), (-3.2, -1.7), (1.7, 3.2)):
        differs = levels(rows, np.linspace(*across, 4)).reshape(len(rows), 4, channels)
        differs -= inside.mean(axis=0)
        square = (differs @ np.linalg.inv(covariance) * differs).sum(axis=-1)
        # NaN, outside of the picture, is not alike.
        part = (square < ALIKE[channels]).mean(axis=1)
        alike.append(np.convolve(part, np.full(4, 0.25), mode="valid"))
    behind, left, right = alike
    return float(np.minimum(behind, np.maximum(left, right)).max())


WIDENS = (4.5, 13.0)
"""How far behind its tip a finger may widen to its hand [half-widths]; foreshortened, sooner."""

INSIDE_SEEN = 20
"""Pixels of a finger that tell its colours."""

ALIKE = {1: 6.6, 3: 11.3}
"""Squared distances from these colours, in standard deviations, below which 99 % of what is of one
colour lies: a grey level and three channels."""


def _outline() -> Array:
    """Return (2, 3, 8, 2) places inside and outside of the three parts of a finger's outline."""
    back = -np.linspace(0.9, 4.0, 8)
    turn = np.linspace(-0.9, 0.9, 8)
    inside_outside = []
    for reach in (0.55, 1.5):
        flanks = [np.stack([back, np.full(8, side * reach)], axis=-1) for side in (-1.0, 1.0)]
        end = np.stack([reach * np.cos(turn) - 1.0, reach * np.sin(turn)], axis=-1)
        inside_outside.append([*flanks, end])
    return np.array(inside_outside)


_OUTLINE = _outline()

NOISE_GREY = 4.0
"""Grey levels that are noise when two pictures are compared."""


def _shown(image: NDArray[np.uint8], places: Array) -> Array:
    """Return the levels of the nearest pixels, NaN outside the picture."""
    x, y = np.moveaxis(np.nan_to_num(np.rint(places), nan=-1.0), -1, 0)
    inside = (x >= 0) & (y >= 0) & (x < image.shape[1]) & (y < image.shape[0])
    rows, columns = (np.where(inside, c, 0).astype(int) for c in (y, x))
    levels = np.asarray(image[rows, columns], dtype=float)
    levels[~inside] = np.nan
    return levels


def _alike(first: _OnPlane, second: _OnPlane) -> Array:
    """Return how well widths, colours and foreground agree, 0 to 1; what is not known agrees."""
    width = np.log(first.width / second.width) / WIDTH_SPREAD
    colour = np.log((first.colour + DARK) / (second.colour + DARK)) / COLOUR_SPREAD
    unlike = np.nan_to_num(width) ** 2 + np.nan_to_num(colour**2).mean(axis=-1)
    odd = np.nan_to_num(np.abs(first.foreground - second.foreground))
    return np.asarray(np.exp(-0.5 * unlike) * (1.0 - ODD_MOVER * odd))


def _same_tip(first: _OnPlane, second: _OnPlane, plane_size: float) -> Array:
    """Return how well two tips may be one point above the plane, 0 to 1; 1 if it is not known.

    The rays lead from where the view shows the tip on the plane to the camera.
    """
    p, q = np.broadcast_arrays(first.ray, second.ray)
    between = np.zeros_like(p)
    between[..., :2] = second.foot - first.foot
    pp, qq, pq = ((x * y).sum(axis=-1) for x, y in ((p, p), (q, q), (p, q)))
    pd, qd = ((x * between).sum(axis=-1) for x in (p, q))
    # The two points of the rays that are nearest to each other.
    determinant = np.maximum(pp * qq - pq**2, np.finfo(float).tiny)
    s, t = (qq * pd - pq * qd) / determinant, (pq * pd - pp * qd) / determinant
    nearest = s[..., None] * p, between + t[..., None] * q
    height = 0.5 * (nearest[0] + nearest[1])[..., 2] / plane_size
    miss = np.linalg.norm(nearest[1] - nearest[0], axis=-1) / plane_size
    allowed = MISS + MISS_PER_HEIGHT * np.abs(height)
    fits = np.exp(-0.5 * np.square(miss / allowed))
    fits = np.where((height > -MISS) & (height < HIGHEST), fits, 0.0)
    return np.where(np.isfinite(height), fits, 1.0)


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


@dataclass(slots=True)
class Trial:
    """A tracker that was started at a candidate, and how it fares.

    Attributes
    ----------
    candidate
        What it was started at.
    tracker, track
        The tracker, and what it made of the last frame.
    score, foreground
        What the finder has said of it lately.
    hand
        How far it has widened to a hand behind the finger lately, 0 to 1.
    is_late
        Whether it was started when the background had long been known.
    frames, misses
        Frames in a row with an accepted fit, and without.
    is_lengthened
        Whether a template as long as its finger has taken over.
    """

    candidate: Candidate
    tracker: ContourTracker
    track: Track
    score: float
    foreground: float
    hand: float
    is_late: bool
    frames: int = 1
    misses: int = 0
    is_lengthened: bool = False

    @property
    def is_over(self) -> bool:
        """Whether it has lost what it followed."""
        return self.misses >= MISSES or self.track.status != "tracking"

    @property
    def has_come(self) -> bool:
        """Whether it is foreground."""
        return self.foreground >= IN_FOREGROUND

    @property
    def half_width_px(self) -> float:
        """Half the finger's width, by the fit if its shape space has one."""
        return _fitted_half_width_px(self.track) or self.candidate.half_width_px

    @property
    def is_proven(self) -> bool:
        """Whether it has moved, or has stood before the background for a while."""
        line = self.track.finger_line
        if line is None:
            return False
        moved = np.hypot(*np.subtract(line.tip_px, self.candidate.start.tip_px))
        return bool(
            moved > PROVEN_MOTION * self.candidate.half_width_px
            or (self.has_come and self.frames >= PROVEN_FRAMES)
        )

    def update(self, frame: Frame, background: Background) -> None:
        """Follow for one frame; before the background, if the finger stands out from it."""
        self.track = self.tracker.update(
            frame.grey(),
            frame.time_s,
            _colour(frame),
            background=background if self.has_come else None,
        )
        if self.track.finger_line is None:
            self.misses, self.frames = self.misses + 1, 0
        else:
            self.misses, self.frames = 0, self.frames + 1
            seen = widening(frame.image, self.track.finger_line, self.half_width_px)
            self.hand += (1.0 - FORGET) * (seen - self.hand)

    def compare(self, candidates: Sequence[Candidate], worth: Array) -> None:
        """Take over what the finder says of the place where it is now.

        `worth` are the factors of the candidates' scores.
        """
        self.score *= FORGET
        for candidate, factor in zip(candidates, worth, strict=True):
            if self.is_at(candidate.start, candidate.half_width_px):
                self.score += (1.0 - FORGET) * candidate.score * float(factor)
                self.foreground += (1.0 - FORGET) * (candidate.foreground - self.foreground)
                return

    def is_at(self, start: StartPose, half_width_px: float) -> bool:
        """Tell whether it follows what a candidate would."""
        line = self.track.finger_line
        if line is None:
            return False
        there = StartPose(line.tip_px, line.angle_rad, start.length_px)
        return _are_near(start, there, 2.0 * half_width_px, 0.5)


@dataclass(slots=True)
class _Refusal:
    """Where a fit has found no hand, and how many frames ago."""

    start: StartPose
    frames: int = 0


class HandSearch:
    """The search for a hand in one view.

    Parameters
    ----------
    tracker_options
        What differs from the tracker's defaults.

    Attributes
    ----------
    candidates, trials
        Those of the last frame.
    found
        The trial that is believed to be the hand, if any.
    """

    def __init__(self, tracker_options: Mapping[str, Any] | None = None) -> None:
        self.background = Background()
        self.candidates: list[Candidate] = []
        self.trials: list[Trial] = []
        self.found: Trial | None = None
        self._tracker_options = dict(tracker_options or {})
        self._finder = HandFinder()
        self._refused: list[_Refusal] = []
        self._worth = np.empty(0)
        self._known_frames = 0
        self._unbelieved_frames = 0
        self._background_frames = 0

    def look_behind(self, frame: Frame) -> Background:
        """Return what is behind the hand, as this frame shows it."""
        self.background.look(frame.grey(), _colour(frame))
        return self.background

    def learn(self, frame: Frame, track: Track | None) -> None:
        """Learn what is behind the hand; a hand that is tracked is kept out of it.

        The frame is the one that `look_behind` has seen last.
        """
        line = track.finger_line if track is not None else None
        keep_out = None if line is None else _hand_region(line)
        self.background.learn(frame.grey(), _colour(frame), keep_out=keep_out)
        self._known_frames = self._known_frames + 1 if self.background.is_known else 0

    def shows_background(self, frame: Frame, track: Track | None) -> bool:
        """Tell whether what is followed has turned out to be the background.

        A tracker that has lost a hand may hold on to an edge of the table.
        """
        line = track.finger_line if track is not None else None
        if line is None:
            return False
        self._background_frames += 1
        if not self._is_background(frame, line):
            self._background_frames = 0
        return self._background_frames >= BACKGROUND_FRAMES

    def has_come(self, frame: Frame, start: StartPose) -> bool:
        """Tell whether something stands before the background where a template waits."""
        ahead = np.array([np.cos(start.angle_rad), np.sin(start.angle_rad)])
        aside = HALF_WIDTH * np.array([-ahead[1], ahead[0]])
        behind = np.linspace(0.1, 1.0, 10)[:, None, None] * ahead
        across = np.array([-0.7, 0.0, 0.7])[:, None] * aside
        places = start.tip_px + start.length_px * (across - behind)
        return self._likely(frame, places.reshape(-1, 2)) > COME_PART

    def forget(self, line: CoreFingerLine) -> None:
        """Forget what was learned where a hand turns out to have been."""
        self.background.forget(_hand_region(line))

    def stands_out(self, frame: Frame, line: CoreFingerLine) -> bool:
        """Tell whether the inside of a finger is known to be foreground."""
        return self._foreground(frame, line) >= IN_FOREGROUND

    def has_come_whole(self, frame: Frame, line: CoreFingerLine) -> bool:
        """Tell whether all the inside of a finger is known to be foreground.

        What is put down before a hand leaves parts of that between its edges.
        """
        tip, anchor = np.array(line.tip_px), np.array(line.anchor_px)
        back = anchor - tip
        aside = HALF_WIDTH * np.array([-back[1], back[0]])
        along = np.linspace(0.2, 1.9, 14)[:, None, None] * back
        places = tip + along + np.array([-1.2, 0.0, 1.2])[:, None] * aside
        return self._likely(frame, places.reshape(-1, 2)) >= COME_WHOLE

    def _is_background(self, frame: Frame, line: CoreFingerLine) -> bool:
        """Tell whether the inside of a finger is known to be background."""
        return self._foreground(frame, line) < BACKGROUND_PART

    def _foreground(self, frame: Frame, line: CoreFingerLine) -> float:
        """Return how like foreground the inside of a finger is; NaN where little is known of it."""
        tip, anchor = np.array(line.tip_px), np.array(line.anchor_px)
        return self._likely(frame, tip + np.linspace(0.2, 1.2, 11)[:, None] * (anchor - tip))

    def _likely(self, frame: Frame, places: Array) -> float:
        """Return how like foreground places (N, 2) are; NaN where most are not known."""
        likely = self.background.foreground(frame.grey(), places, colour=_colour(frame))
        known = likely[np.isfinite(likely)]
        return float(known.mean()) if 2 * len(known) > len(places) else np.nan

    def look(self, frame: Frame) -> None:
        """Go on with the trials, and find what else could be tried."""
        for trial in self.trials:
            trial.update(frame, self.background)
        self.candidates = self._finder.find(
            frame.grey(), _colour(frame), background=self.background
        )
        for refusal in self._refused:
            refusal.frames += 1
        self._refused = [refusal for refusal in self._refused if refusal.frames < TRY_AGAIN]
        self.trials = _distinct(trial for trial in self.trials if not trial.is_over)
        if self.found not in self.trials:
            self.found = None

    def judge(self, flat: Array) -> None:
        """Take over how flat each candidate is, and what that and the finder say of the trials."""
        self._worth = 1.0 - (1.0 - FLAT_WORTH) * flat
        for trial in self.trials:
            trial.compare(self.candidates, self._worth)

    def rest(self) -> None:
        """Give up the search: the hand is followed for good, or nothing is seen."""
        self.candidates, self.trials, self.found = [], [], None
        self._worth = np.empty(0)

    def is_refused(self, candidate: Candidate) -> bool:
        """Tell whether a fit has refused a candidate in the last frames."""
        start, reach_px = candidate.start, candidate.half_width_px
        return any(_are_near(start, r.start, reach_px, 0.25) for r in self._refused)

    def try_out(self, candidate: Candidate, frame: Frame) -> bool:
        """Start a trial at a candidate of this frame; tell if there was none there already."""
        start, half_width_px = candidate.start, candidate.half_width_px
        if any(trial.is_at(start, half_width_px) for trial in self.trials):
            return False
        if len(self.trials) >= MOST_TRIALS:
            worst = min(self.trials, key=lambda trial: (trial is self.found, trial.score))
            if worst.score >= candidate.score:
                return False
            self.trials.remove(worst)
        tracker = self._tracker_at(start, half_width_px)
        track = tracker.update(frame.grey(), frame.time_s, _colour(frame))
        if track.finger_line is None:
            self._refused.append(_Refusal(start))
            return True
        place = self.candidates.index(candidate)
        score, is_late = candidate.score * self._worth[place], self._known_frames > SETTLED_FRAMES
        self.trials.append(
            Trial(
                candidate,
                tracker,
                track,
                score=float(score),
                foreground=candidate.foreground,
                hand=widening(frame.image, track.finger_line, candidate.half_width_px),
                is_late=is_late,
            )
        )
        return True

    def believe(self, trial: Trial | None, frame: Frame) -> None:
        """Take a trial, if any, for the hand, with a template as long as its finger.

        A short template is easier to find; a long one tells the direction better, and cannot hold
        on to one shaded flank, as long as it does not reach into the fist.
        """
        if trial is None:
            self._unbelieved_frames += 1
            if self._unbelieved_frames >= UNBELIEVED_FRAMES:
                self.found = None
            return
        self._unbelieved_frames = 0
        line = trial.track.finger_line
        if trial is not self.found and line is not None and not trial.has_come:
            # It was there from the start: what was learned there is the hand.
            self.background.forget(_hand_region(line))
        self.found = trial
        if not trial.is_lengthened and line is not None:
            self._lengthen(trial, line, frame)

    def _lengthen(self, trial: Trial, line: CoreFingerLine, frame: Frame) -> None:
        """Follow with the longest template that this frame shows all of, if there is one."""
        half_width_px = trial.half_width_px
        for _ in range(MEASURED):
            longest = self._longest(line, half_width_px, frame)
            if longest is None:
                return
            trial.tracker, trial.track = longest
            trial.is_lengthened = True
            half_width_px = trial.half_width_px

    def _longest(
        self, line: CoreFingerLine, half_width_px: float, frame: Frame
    ) -> tuple[ContourTracker, Track] | None:
        """Return the longest template on a finger of a width that the frame shows all of."""
        here = StartPose(line.tip_px, line.angle_rad, half_width_px)
        for length in LENGTHS:
            start = StartPose(line.tip_px, line.angle_rad, length * half_width_px)
            tracker = self._tracker_at(start, half_width_px)
            for _ in range(LOOKS):
                track = tracker.update(frame.grey(), frame.time_s, _colour(frame))
            found = track.finger_line
            if found is None or _far_ends_seen(tracker, found) < FAR_END_SEEN:
                continue
            there = StartPose(found.tip_px, found.angle_rad, half_width_px)
            if _are_near(here, there, 2.0 * half_width_px, SAME_TURN_RAD):
                return tracker, track
        return None

    def candidate_sightings(self) -> list[Sighting]:
        """Return what is seen of the candidates, one for each."""
        return [
            Sighting(
                c.start.tip_px,
                c.start.angle_rad,
                c.half_width_px,
                c.score * float(worth),
                self._if_known(c.foreground),
                c.colour,
            )
            for c, worth in zip(self.candidates, self._worth, strict=True)
        ]

    def trial_sightings(self) -> tuple[list[Trial], list[Sighting]]:
        """Return the trials that hold in this frame, and what is seen of each."""
        held, seen = [], []
        for trial in self.trials:
            line = trial.track.finger_line
            if line is None:
                continue
            width, colour = trial.candidate.half_width_px, trial.candidate.colour
            foreground = self._if_known(trial.foreground)
            held.append(trial)
            seen.append(
                Sighting(line.tip_px, line.angle_rad, width, trial.score, foreground, colour)
            )
        return held, seen

    def _if_known(self, foreground: float) -> float:
        return foreground if self.background.is_known else np.nan

    def _tracker_at(self, start: StartPose, half_width_px: float) -> ContourTracker:
        # The range that a template's proportions may have.
        half_width = min(max(half_width_px / start.length_px, 0.03), 0.4)
        template = Template.pistol("none", proportions={"half_width": half_width})
        acquire = {**self._tracker_options.get("acquire", {}), "settle_frames": 1}
        return ContourTracker.at_hand(
            template, start, {**self._tracker_options, "acquire": acquire}
        )


class SearchingView(Protocol):
    """What `find_hand` needs of a view."""

    search: HandSearch

    @property
    def viewpoint(self) -> Viewpoint:
        """Where it is taken from, and how it sees the plane."""

    @property
    def is_searching(self) -> bool:
        """Whether the hand may be anywhere in it."""

    @property
    def track(self) -> Track | None:
        """What its tracker made of the last frame."""


def find_hand(views: Sequence[SearchingView], frames: Sequence[Frame | None]) -> None:
    """Go on with the search for the hand in all views that are searching.

    Pairs of trials that have held long enough, and trials that agree with a view that follows the
    hand already, are believed, the best first. Then the likeliest pairs of candidates are tried.

    Parameters
    ----------
    views
        All views, each after it has observed its frame.
    frames
        Their frames, in the same order; None where there is none.
    """
    for k, view in enumerate(views):
        if view.is_searching and frames[k] is not None:
            starts = [(c.start, c.half_width_px) for c in view.search.candidates]
            seen = [Sighting(s.tip_px, s.angle_rad, half_px) for s, half_px in starts]
            view.search.judge(_flatness(views, frames, k, seen))
    _believe(views, frames)
    for i, j in combinations(range(len(views)), 2):
        searching = [k for k in (i, j) if views[k].is_searching and frames[k] is not None]
        if searching:
            _try_out(views, frames, (i, j), searching)


def how_flat(
    views: Sequence[SearchingView], frames: Sequence[Frame | None], k: int
) -> float | None:
    """Tell how flat what a view follows looks to the others; None if it follows nothing.

    See `flatness`, and `find_hand` for the arguments; `k` is the view's place among all.
    """
    track = views[k].track
    followed = _followed(views[k])
    if track is None or not followed:
        return None
    half_width_px = _fitted_half_width_px(track)
    if half_width_px is not None:
        followed = [followed[0]._replace(half_width_px=half_width_px)]
    return float(_flatness(views, frames, k, followed)[0])


def _flatness(
    views: Sequence[SearchingView],
    frames: Sequence[Frame | None],
    k: int,
    seen: Sequence[Sighting],
) -> Array:
    """Return how flat fingers in a view look to the others."""
    one = frames[k]
    flat = np.zeros(len(seen))
    for other, frame in zip(views, frames, strict=True):
        if one is not None and frame is not None and other is not views[k]:
            plane_views = views[k].viewpoint.plane_view, other.viewpoint.plane_view
            flat = np.maximum(flat, flatness(plane_views, (one.grey(), frame.grey()), seen))
    return flat


def _try_out(
    views: Sequence[SearchingView],
    frames: Sequence[Frame | None],
    pair: tuple[int, int],
    searching: Sequence[int],
) -> None:
    """Start trials at the likeliest pairs of candidates of two views."""
    seen = [
        views[k].search.candidate_sightings() if k in searching else _followed(views[k])
        for k in pair
    ]
    i, j = pair
    scores = pair_scores((views[i].viewpoint, views[j].viewpoint), (seen[0], seen[1]))
    worth = scores * _worth(seen[0])[:, None] * _worth(seen[1])
    started = 0
    for places in _best_first(worth):
        chosen = {
            k: views[k].search.candidates[place]
            for k, place in zip(pair, places, strict=True)
            if k in searching
        }
        if any(views[k].search.is_refused(candidate) for k, candidate in chosen.items()):
            continue
        new = False
        for k, candidate in chosen.items():
            frame = frames[k]
            new |= frame is not None and views[k].search.try_out(candidate, frame)
        started += new
        if started == NEW_TRIALS:
            return


def _believe(views: Sequence[SearchingView], frames: Sequence[Frame | None]) -> None:
    """Let views follow the best pairs of trials that have held long enough."""
    pairs: list[tuple[float, dict[int, Trial]]] = []
    for i, j in combinations(range(len(views)), 2):
        if not (views[i].is_searching or views[j].is_searching):
            continue
        (tried_i, seen_i), (tried_j, seen_j) = _tried(views[i]), _tried(views[j])
        scores = pair_scores((views[i].viewpoint, views[j].viewpoint), (seen_i, seen_j))
        for a, b in _best_first(scores):
            both = ((i, tried_i[a]), (j, tried_j[b]))
            trials = {k: trial for k, trial in both if trial is not None}
            stays = all(views[k].search.found is trial for k, trial in trials.items())
            worth = _belief(float(scores[a, b]), list(trials.values()), stays)
            if worth > 0.0 and not stays and not _point_at_plane(views, trials, (i, j)):
                continue
            if worth > 0.0:
                pairs.append((worth, trials))
    believed: dict[int, Trial] = {}
    for _, trials in sorted(pairs, key=lambda pair: -pair[0]):
        if all(believed.get(k, trial) is trial for k, trial in trials.items()):
            believed.update(trials)
    for k, (view, frame) in enumerate(zip(views, frames, strict=True)):
        if frame is not None:
            view.search.believe(believed.get(k), frame)


def _point_at_plane(
    views: Sequence[SearchingView], trials: Mapping[int, Trial], pair: tuple[int, int]
) -> bool:
    """Tell whether the finger lines of two views give a point, with what is known of their errors.

    A thumb leads up and away from the plane: its lines meet behind it, or hardly meet.
    """
    tracks = [trials[k].track if k in trials else views[k].track for k in pair]
    return _gives_point([views[k].viewpoint.plane_view for k in pair], tracks)


def _gives_point(views: Sequence[PlaneView], tracks: Sequence[Track | None]) -> bool:
    """Tell whether tracks of two views give a point; so they do while one shows no finger."""
    lines = [track.finger_line for track in tracks if track is not None]
    fingers = [
        FingerLine(np.array(f.anchor_px), f.angle_rad, f.covariance, np.array(f.tip_px), 0.0)
        for f in lines
        if f is not None
    ]
    if len(fingers) < len(views):
        return True
    return indicated_point(fingers, views, time_s=0.0, options=MAY_POINT).status is Status.OK


def _belief(score: float, trials: Sequence[Trial], stays: bool) -> float:
    """Return how much a pair with these trials is worth; 0 if it is not to be believed yet."""
    has_come = all(trial.has_come for trial in trials)
    if not has_come:
        score *= min(min(trial.hand for trial in trials) / HAND_SEEN, 1.0)
    worth = score if has_come else 0.5 * score
    if stays:
        return STAYS * worth
    least, most = FRAMES_TO_TRUST[has_come]
    too_new = min(trial.frames for trial in trials) < score * least + (1.0 - score) * most
    too_late = not has_come and any(trial.is_late for trial in trials)
    return 0.0 if too_new or too_late or score < LEAST_SCORE[has_come] else worth


def _worth(seen: Sequence[Sighting]) -> Array:
    """Return what fingers are worth trying: those that have come into view go first."""
    return np.array([0.5 + 0.5 * np.nan_to_num(finger.foreground, nan=1.0) for finger in seen])


def _tried(view: SearchingView) -> tuple[Sequence[Trial | None], Sequence[Sighting]]:
    """Return the trials of a view; None for the hand that it follows."""
    if view.is_searching:
        return view.search.trial_sightings()
    followed = _followed(view)
    return [None] * len(followed), followed


def _followed(view: SearchingView) -> list[Sighting]:
    """Return the finger that a view follows, if it shows in this frame."""
    line = view.track.finger_line if view.track is not None else None
    if line is None:
        return []
    length = 2.0 * float(np.hypot(*np.subtract(line.tip_px, line.anchor_px)))
    return [Sighting(line.tip_px, line.angle_rad, HALF_WIDTH * length)]


def can_be_one(views: tuple[SearchingView, SearchingView]) -> bool:
    """Tell whether what two views follow may be one finger; so it is while one follows nothing."""
    return _gives_point([v.viewpoint.plane_view for v in views], [v.track for v in views])


def are_one(views: tuple[SearchingView, SearchingView]) -> bool:
    """Tell whether two views follow one finger: their lines give a point, and they have one tip."""
    same = _same_followed_tip(views)
    return same is not None and same >= OTHER_TIP and can_be_one(views)


def are_two(views: tuple[SearchingView, SearchingView]) -> bool:
    """Tell whether two views follow different fingers.

    Then their lines give no point, and their tips are hardly one; a hand that points nowhere has
    one tip.
    """
    if can_be_one(views):
        return False
    same = _same_followed_tip(views)
    return same is not None and same < OTHER_TIP


def _same_followed_tip(views: tuple[SearchingView, SearchingView]) -> float | None:
    """Return how well the tips that two views follow may be one; None unless both follow one."""
    followed = [_followed(view) for view in views]
    if not all(followed):
        return None
    first, second = (
        _OnPlane.of(view.viewpoint, fingers).along(axis)
        for view, fingers, axis in zip(views, followed, (1, 0), strict=True)
    )
    same = _same_tip(first, second, views[0].viewpoint.plane_view.plane_size)
    return float(same[0, 0])


def _best_first(scores: Array) -> Iterator[tuple[int, int]]:
    """Yield the places of the entries above 0, in falling order."""
    for place in np.argsort(-scores, axis=None, kind="stable"):
        row, column = np.unravel_index(place, scores.shape)
        if scores[row, column] <= 0.0:
            return
        yield int(row), int(column)


def _fitted_half_width_px(track: Track) -> float | None:
    """Return half a finger's width; None without a fit in a shape space that has one."""
    shape = track.shape_vector
    if shape is None or HALF_WIDTH_NAME not in track.shape_names:
        return None
    return float(shape[track.shape_names.index(HALF_WIDTH_NAME)])


def _colour(frame: Frame) -> NDArray[Any] | None:
    return frame.image if frame.image.ndim == 3 else None


def _hand_region(line: CoreFingerLine) -> tuple[Array, Array, float]:
    """Return the part of the image that a finger and its hand cover: a segment and a radius."""
    tip, anchor = np.array(line.tip_px), np.array(line.anchor_px)
    # The anchor is the finger's middle; hand and wrist lie within thrice its length.
    finger = 2.0 * (tip - anchor)
    return tip + 0.2 * finger, tip - 3.0 * finger, 0.8 * float(np.hypot(*finger))


def _far_ends_seen(tracker: ContourTracker, line: CoreFingerLine) -> float:
    """Return the part of the edges far from the tip that agree with the fit, on the worse flank."""
    lines = tracker.search_lines()
    e = np.array([np.cos(line.angle_rad), np.sin(line.angle_rad)])
    along = (lines.position_px - line.tip_px) @ e
    is_far = along < (1.0 - FAR_END) * along.min()
    side = lines.normal @ np.array([-e[1], e[0]])
    agrees = np.zeros(len(lines), np.bool_) if lines.agrees is None else lines.agrees
    flanks = [agrees[is_far & (sign * side > 0.0)] for sign in (-1.0, 1.0)]
    return min(float(flank.mean()) if len(flank) else 0.0 for flank in flanks)


def has_moved(before: CoreFingerLine, now: CoreFingerLine) -> bool:
    """Tell whether a finger has moved by more than an edge of the table ever seems to."""
    return _motion(before, now) > PROVEN_MOTION


def moves(lines: Sequence[CoreFingerLine]) -> bool:
    """Tell whether a finger that was followed through these lines is moving in the end."""
    return _motion(lines[max(len(lines) - LATELY, 0)], lines[-1]) > STILL


def _motion(before: CoreFingerLine, now: CoreFingerLine) -> float:
    """Return how far a tip has moved [half-widths]."""
    length_px = 2.0 * np.hypot(*np.subtract(before.tip_px, before.anchor_px))
    moved_px = np.hypot(*np.subtract(now.tip_px, before.tip_px))
    return float(moved_px / (HALF_WIDTH * length_px))


def _are_near(one: StartPose, other: StartPose, reach_px: float, turn_rad: float) -> bool:
    """Tell whether two poses have about the same tip and direction."""
    turned = (one.angle_rad - other.angle_rad + np.pi) % (2 * np.pi) - np.pi
    apart = np.hypot(*np.subtract(one.tip_px, other.tip_px))
    return bool(apart < reach_px and abs(turned) < turn_rad)


def _distinct(trials: Iterator[Trial]) -> list[Trial]:
    """Return the trials without those that have run into an older one."""
    kept: list[Trial] = []
    for trial in trials:
        line, candidate = trial.track.finger_line, trial.candidate
        here = line and StartPose(line.tip_px, line.angle_rad, candidate.start.length_px)
        if here is None or not any(k.is_at(here, candidate.half_width_px) for k in kept):
            kept.append(trial)
    return kept
