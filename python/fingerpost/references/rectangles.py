"""Detection of a rectangle of the plane in an image; candidates are ordered by score.

Four long straight edges form a quadrilateral. Its score depends on the share of its outline within
the image that has an edge, whether all of it steps the same way from outside to inside, its size,
and whether it can be the image of a rectangle of the given sides for a usual focal length. The
rectangle may be partly covered, and its corners may lie outside the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerpost.lens import Lens
from fingerpost.references.polygons import contains, is_convex, signed_area
from fingerpost.references.reduction import Reduction
from fingerpost.references.segments import Line, find_lines
from fingerpost.references.sides import Sides, refined
from fingerpost.uncertainty import blocks_of, largest_sigma

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

LARGEST_PX = 800
"""Longest side of a picture that is searched at full size [px]; larger ones are reduced."""

MOST_TRIED = 28
"""Greatest number of quadrilaterals whose sides are fitted."""

MOST_KEPT = 6

LEAST_SIDE = 0.12
"""Least share of a side within the image that has an edge."""

SMALLEST = 0.002
"""Least area of a rectangle relative to that of the image."""

BARE_COST = 0.5
"""Cost per length of outline without an edge, relative to the gain per length with one."""

LEAST_SHOWN = 0.1
"""Least sum of this gain and cost, relative to the outline's length: two fifths have an edge."""

BEYOND = 1.0
"""Greatest distance of a corner outside the image, relative to the image's longer side."""

MIXED = 0.75
"""Factor of the score of an outline whose sides step both inwards and outwards."""

EVEN = 0.5
"""Step of a side, relative to the median of the four, below which its score is reduced: the sides
of a sheet have similar contrasts, the grain of wood beside it has less."""

LEAST_LIKENESS = 0.05
UNLIKE = 0.5
ASPECT_SIGMA = 0.1
FOCAL_PARTS = np.geomspace(0.5, 4.0, 13)
"""Likelihood below which a quadrilateral is no image of the rectangle: sheets have 0.93 and more,
0.65 with a wrong one of A4 and Letter, and quadrilaterals of grain often less than 1e-6; least
factor of the score by the likelihood, for a picture may be cut out of a larger one; standard
deviation of the log ratio of its sides and of their angle [rad]; focal lengths, relative to the
longer side of the image."""

MAX_CORNER_SIGMA = 0.02
"""Greatest standard deviation of a corner, relative to the shortest side: 0.001 on wood and 0.01
of a sheet of which half is covered, 0.02 and more of some quadrilaterals without a sheet."""

APART = 0.02
"""Greatest distance of the corners of equal quadrilaterals, relative to their diagonal."""

REACH_PX = 5.0


@dataclass(frozen=True, eq=False)
class Candidate:
    """A quadrilateral that may be the image of the rectangle.

    Attributes
    ----------
    sides
        Its sides and corners, the latter clockwise in the picture.
    score
        Score; a greater one is more likely.
    """

    sides: Sides
    score: float


def find_rectangles(
    picture: Picture,
    size: tuple[float, float],
    lens: Lens | None = None,
    near_px: Array | None = None,
) -> list[Candidate]:
    """Detect the possible images of a rectangle, best score first.

    Parameters
    ----------
    picture
        (H, W) or (H, W, 3), 8 bits.
    size
        Lengths of its sides, in any unit.
    lens
        The view's distortion, if known.
    near_px
        (2,) A point inside it; or (4, 2) approximate corners, in any order, which then dominate
        the score.
    """
    reduction = Reduction.of(picture.shape, LARGEST_PX)
    small = reduction.picture(picture)
    small_near = None if near_px is None else reduction.points(near_px)
    quads, scores = _quadrilaterals(find_lines(small), small.shape, small_near)
    scores = scores * [_likeness(quad, size, small.shape) for quad in quads]
    order = np.argsort(-scores, kind="stable")
    return _fitted(picture, reduction.whole(quads[order]), scores[order], size, lens, near_px)


def size_scores(picture: Picture, sizes: Sequence[tuple[float, float]]) -> list[float]:
    """Return the best score of rectangles of each of several sizes, by their sides alone.

    Edges are detected once for all sizes. Sizes of the same aspect ratio have equal scores.

    Parameters
    ----------
    picture
        (H, W) or (H, W, 3), 8 bits.
    sizes
        Lengths of both sides of each, in any unit.

    Returns
    -------
    list of float
        Score of the best quadrilateral for each size; 0 without one.
    """
    small = Reduction.of(picture.shape, LARGEST_PX).picture(picture)
    quads, scores = _quadrilaterals(find_lines(small), small.shape, None)
    return [
        max(
            (
                float(score) * _likeness(quad, size, small.shape)
                for quad, score in zip(quads, scores, strict=True)
            ),
            default=0.0,
        )
        for size in sizes
    ]


def _fitted(
    picture: Picture,
    quads: Array,
    scores: Array,
    size: tuple[float, float],
    lens: Lens | None,
    near_px: Array | None,
) -> list[Candidate]:
    """Fit the sides of the best quadrilaterals, and recompute their scores from the fits."""
    found: list[Candidate] = []
    tried: list[Array] = []
    for quad, score in zip(quads, scores.tolist(), strict=True):
        if len(tried) == MOST_TRIED or score <= 0.0:
            break
        if any(_is_same(quad, other) for other in tried):
            continue
        tried.append(quad)
        levels = tone(picture, channel_of(picture, quad))
        sides = refined(levels, quad, lens, reach_px=REACH_PX)
        if sides is None or sides.shares.min() < LEAST_SIDE:
            continue
        if any(_is_same(sides.corners_px, other.sides.corners_px) for other in found):
            continue
        shortest_px = float(np.linalg.norm(np.diff(quad, axis=0, append=quad[:1]), axis=1).min())
        if max(map(largest_sigma, blocks_of(sides.covariance))) > MAX_CORNER_SIGMA * shortest_px:
            continue
        score = _score(sides, picture.shape, size, near_px)
        if score > 0.0:
            found.append(Candidate(sides, score))
    return sorted(found, key=lambda one: -one.score)[:MOST_KEPT]


def _score(
    sides: Sides, shape: tuple[int, ...], size: tuple[float, float], near_px: Array | None
) -> float:
    steps = np.abs(sides.steps)
    even = np.minimum(steps / (EVEN * max(float(np.median(steps)), 1.0)), 1.0)
    shares = sides.shares * even
    shown = float((shares - BARE_COST * (1.0 - shares)) @ sides.seen_px)
    if shown < LEAST_SHOWN * sides.seen_px.sum():
        return 0.0
    one_way = abs(float(np.sign(sides.steps).sum())) == 4.0
    quads = sides.corners_px[None]
    near = float(_nearness(quads, near_px, shape)[0])
    likeness = _likeness(sides.corners_px, size, shape)
    return shown * (1.0 if one_way else MIXED) * likeness * near


def channel_of(picture: Picture, quad: Array) -> int | None:
    """Return the channel in which an outline has the greatest contrast; None for grey levels."""
    if picture.ndim == 2:
        return None
    grey = abs(_contrast(tone(picture, None), quad))
    steps = [abs(_contrast(picture[..., k], quad)) for k in range(3)]
    best = int(np.argmax(steps))
    # Colours have half the resolution of grey levels, so they must have twice the contrast.
    return None if steps[best] < 2.0 * grey else best


def tone(picture: Picture, channel: int | None) -> Picture:
    """Return a channel of a picture, (H, W), or its grey levels for None."""
    import cv2

    if picture.ndim == 2:
        return picture
    if channel is not None:
        return np.ascontiguousarray(picture[..., channel])
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)


def _contrast(channel: Picture, quad: Array) -> float:
    """Return the median step from outside to inside of an outline."""
    import cv2

    parts = np.linspace(0.1, 0.9, 17)[:, None]
    ends = np.roll(quad, -1, axis=0)
    along = (ends - quad) / np.linalg.norm(ends - quad, axis=1)[:, None]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    middle = quad[:, None] + parts * (ends - quad)[:, None]
    levels = []
    for off_px in (4.0, -4.0):
        u, v = np.moveaxis((middle + off_px * normal[:, None]).astype(np.float32), -1, 0)
        levels.append(cv2.remap(channel, u, v, cv2.INTER_LINEAR, borderValue=-1.0).astype(float))
    return float(np.median(levels[0] - levels[1]))


def _quadrilaterals(
    lines: list[Line], shape: tuple[int, ...], near_px: Array | None
) -> tuple[Array, Array]:
    """Return quadrilaterals (N, 4, 2) of four lines, clockwise in the picture, and their scores."""
    count = len(lines)
    if count < 4:
        return np.empty((0, 4, 2)), np.empty(0)
    points = np.array([line.point for line in lines])
    along = np.array([line.along for line in lines])
    t = _crossings(points, along)
    # Pairs of opposite sides: the pairs (a, c) and (b, d) form the corners ab, bc, cd, da.
    a, c = np.triu_indices(count, 1)
    i, j = np.triu_indices(len(a), 1)
    meets = _is_near(points[:, None] + t[..., None] * along[:, None], shape)
    met = meets[a[i], a[j]] & meets[a[j], c[i]] & meets[c[i], c[j]] & meets[c[j], a[i]]
    i, j = i[met], j[met]
    sides = np.stack([a[i], a[j], c[i], c[j]], axis=1)
    scores = _support(lines, t, _extents(points, along, shape), sides)
    sides, scores = sides[scores > 0.0], scores[scores > 0.0]
    corners = _corners(points, along, t, sides)
    fits = _is_possible(corners, shape)
    corners, scores = corners[fits], scores[fits]
    scores *= _nearness(corners, near_px, shape)
    best = np.argsort(-scores, kind="stable")[: 4 * MOST_TRIED]
    corners = corners[best]
    backward = signed_area(corners) < 0.0
    corners[backward] = corners[backward][:, [1, 0, 3, 2]]
    return corners, scores[best]


def _crossings(points: Array, along: Array) -> Array:
    """Return positions along each line (row) where the others (columns) cross it; NaN if none."""
    between = points[None] - points[:, None]
    cross = along[:, None, 0] * along[None, :, 1] - along[:, None, 1] * along[None, :, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (between[..., 0] * along[None, :, 1] - between[..., 1] * along[None, :, 0]) / cross
    return np.where(np.abs(cross) > 0.05, t, np.nan)


def _corners(points: Array, along: Array, t: Array, sides: NDArray[np.intp]) -> Array:
    """Return the corners (N, 4, 2); side k runs from corner k to the next one."""
    before = np.roll(sides, 1, axis=1)
    return np.asarray(points[sides] + t[sides, before][..., None] * along[sides])


def _is_near(points: Array, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return which points (..., 2) lie in a picture or close enough to it to be corners."""
    beyond = BEYOND * max(shape[:2])
    last = np.array(shape[1::-1]) + beyond
    with np.errstate(invalid="ignore"):
        return np.asarray(((points > -beyond) & (points < last)).all(axis=-1))


def _is_possible(corners: Array, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return which quadrilaterals are convex, large enough, and near the picture."""
    with np.errstate(invalid="ignore"):
        large = np.abs(signed_area(corners)) > SMALLEST * shape[0] * shape[1]
        middle = corners.mean(axis=1)
        inside = ((middle > 0.0) & (middle < np.array(shape[1::-1]))).all(axis=1)
    return np.asarray(is_convex(corners) & large & inside)


def _support(lines: list[Line], t: Array, extents: Array, sides: NDArray[np.intp]) -> Array:
    """Return scores of outlines: length with edges less the cost of that without [px].

    Parameters
    ----------
    lines
        The K lines.
    t
        (K, K) Positions along each line where the others cross it [px].
    extents
        (K, 2) First and last position along each line within the picture [px].
    sides
        (N, 4) Lines that each outline consists of, in sequence.
    """
    seen = np.clip(t, extents[:, :1], extents[:, 1:])
    covered = np.stack([_covered(line.intervals, at) for line, at in zip(lines, seen, strict=True)])
    # Of all sides: a line (first axis) from where one line crosses it to where another one does.
    total, shown = (np.abs(at[:, None] - at[:, :, None]) for at in (seen, covered))
    counts = (shown > 0.5 * LEAST_SIDE * total) & (total > 5.0)
    before, after = np.roll(sides, 1, axis=1), np.roll(sides, -1, axis=1)
    scores = np.zeros(len(sides))
    some = np.arange(len(sides))
    for k in range(4):
        some = some[counts[sides[some, k], before[some, k], after[some, k]]]
    chosen = sides[some], before[some], after[some]
    shown, total = shown[chosen], total[chosen]
    gains = shown.sum(axis=1) - BARE_COST * (total - shown).sum(axis=1)
    inward = np.sign(t[chosen[0], chosen[2]] - t[chosen[0], chosen[1]]).sum(axis=1)
    scores[some] = np.maximum(gains * np.where(np.abs(inward) == 4.0, 1.0, MIXED), 0.0)
    return scores


def _covered(intervals: Array, t: Array) -> Array:
    """Return the total length of the intervals before each position."""
    begin, end = intervals.T
    return np.asarray((np.clip(t[:, None], begin, end) - begin).sum(axis=1))


def _extents(points: Array, along: Array, shape: tuple[int, ...]) -> Array:
    """Return the first and last position (K, 2) of lines within the picture; equal if none."""
    last = np.array(shape[1::-1]) - 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (np.array([np.zeros(2), last]) - points[:, None]) / along[:, None]
    t = np.sort(np.nan_to_num(t, posinf=1e9, neginf=-1e9), axis=1)
    first = t[:, 0].max(axis=1)
    return np.stack([first, np.maximum(t[:, 1].min(axis=1), first)], axis=1)


def _likeness(quad: Array, size: tuple[float, float], shape: tuple[int, ...]) -> float:
    """Return the factor of the score by the likelihood."""
    best = likeness_in_either_order(quad, size, shape)
    return 0.0 if best < LEAST_LIKENESS else max(UNLIKE, best)


def likeness(quad: Array, size: tuple[float, float], shape: tuple[int, ...]) -> float:
    """Return the likelihood that a quadrilateral is the image of a rectangle, from 0 to 1.

    The first two columns of K⁻¹T are orthogonal and of equal length (Zhang 2000). The focal length
    is the best of `FOCAL_PARTS`; the principal point is the image centre.

    Parameters
    ----------
    quad
        (4, 2) Its corners [px].
    size
        Lengths of the side from the first to the second corner and of the next one.
    shape
        Shape of the picture.
    """
    import cv2

    largest = float(max(shape[:2]))
    centred = (quad - 0.5 * (np.array(shape[1::-1]) - 1.0)) / largest
    plane = np.array([[0, 0], [size[0], 0], size, [0, size[1]]], np.float64) / max(size)
    T = cv2.getPerspectiveTransform(plane.astype(np.float32), centred.astype(np.float32))
    columns = (
        T[:, :2, None] / np.array([FOCAL_PARTS, FOCAL_PARTS, np.ones_like(FOCAL_PARTS)])[:, None]
    )
    lengths = np.linalg.norm(columns, axis=0) + np.finfo(float).tiny
    skew = (columns[:, 0] * columns[:, 1]).sum(axis=0) / (lengths[0] * lengths[1])
    off = np.hypot(skew, np.log(lengths[0] / lengths[1])) / ASPECT_SIGMA
    return float(np.exp(-0.5 * off.min() ** 2)) if np.isfinite(off).any() else 0.0


def likeness_in_either_order(
    quad: Array, size: tuple[float, float], shape: tuple[int, ...]
) -> float:
    """Return the likelihood for the better order of the sides; parameters as of `likeness`."""
    return max(likeness(quad, ordered, shape) for ordered in (size, size[::-1]))


def _nearness(quads: Array, near_px: Array | None, shape: tuple[int, ...]) -> Array:
    """Return the factor of scores by the distance from the given position, from 0 to 1."""
    if near_px is None:
        return np.ones(len(quads))
    near = np.asarray(near_px, np.float64)
    if near.ndim == 1:
        return np.array([1.0 if contains(quad, near) else 0.0 for quad in quads])
    off_px = [
        np.linalg.norm(np.roll(turned, k, axis=1) - near, axis=-1).mean(axis=1)
        for turned in (quads, quads[:, ::-1])
        for k in range(4)
    ]
    return np.asarray(np.exp(-np.min(off_px, axis=0) / (0.02 * max(shape[:2]))))


def _is_same(quad: Array, other: Array) -> bool:
    """Return whether two quadrilaterals, both clockwise, have the same corners."""
    diagonal = float(np.linalg.norm(quad[2] - quad[0]))
    turned = (np.roll(other, k, axis=0) for k in range(4))
    return any(float(np.abs(quad - one).max()) < APART * diagonal for one in turned)


def turned(sides: Sides, *, clockwise: bool) -> list[Sides]:
    """Return a quadrilateral with each of its corners as the first, clockwise or anticlockwise."""
    order = np.arange(4) if clockwise else np.arange(4)[::-1]
    return [sides.ordered(np.roll(order, -k)) for k in range(4)]
