"""Tests of the reference points.

- *outside*: most of them lie outside the image (`fingerpost.admission.points_outside`); a warning
  if it shows their middle;
- *mirrored*: the homographies of the views do not have the same sense of rotation, although all
  cameras are on one side of the plane (`fingerpost.admission.different_sides`);
- *elsewhere*: rectified to the plane, the views do not show the same table, but would if a common
  mistake were corrected, which is named (`fingerpost.consistency`);
- *weak*: errors of the points grow inside the workspace (`fingerpost.advise.reference_weakness`);
- *inconsistent*: with more than four points, the residual of one is too large;
- *off their corner*: a sharp corner is beside the point rather than at it. Points without any sharp
  corner nearby, such as crossings of lines or round corners, are not tested, and neither are those
  near the start pose of the hand.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from fingerpost.admission import different_sides, other_size, points_outside, shows_middle
from fingerpost.advise import reference_weakness
from fingerpost.config import Rig, View
from fingerpost.consistency import Scenery
from fingerpost.doctor.findings import Check, Finding, Severity
from fingerpost.pipeline import DEFAULT_REFERENCE_SIGMA_PX
from fingerpost.pointing import PlaneView

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

WEAKNESS = (2.0, 8.0)
"""Growth of the points' errors inside the workspace; below 1 between four corners well apart. At
the second, half a pixel becomes four."""

INCONSISTENT_SIGMAS = 5.0
"""Residual of one of N > 4 points, in standard deviations of a point."""

CORNER_PX = (3.0, 8.0)
"""A sharp corner nearer than the first is the point's own; one nearer than the second, without a
nearer one, is probably the intended one. Corners of rendered sheets were within 0.7 px."""

SHARP_CORNER = 0.02
"""Smaller eigenvalue of the structure tensor over the squared local contrast: 0.03 to 0.12 at
sheet corners, below 0.01 at round ones."""

# Radius about the start pose's tip in which the hand may cover points, in finger lengths.
_HAND_LENGTHS = 1.5
_LEAST_CONTRAST = 12.0


def judge_views(
    rig: Rig, plane_views: Sequence[PlaneView], stills: Sequence[Grey]
) -> Iterator[Finding]:
    """Find problems of the reference points of each view.

    Parameters
    ----------
    rig
        The rig.
    plane_views
        Homographies of its views.
    stills
        One picture of each without moving objects.
    """
    for view, plane_view, still in zip(rig.views, plane_views, stills, strict=True):
        points_px = np.array(view.reference_points_px)
        height, width = still.shape
        if (wrong := points_outside(view, (width, height))) is not None:
            is_part = shows_middle(view, (width, height))
            severity = Severity.WARNING if is_part else Severity.ERROR
            yield Finding(severity, Check.REFERENCES, view.name, *wrong)
        yield from _judge_strength(view.name, plane_view)
        if len(points_px) > 4:
            yield from _judge_consistency(view.name, plane_view, points_px)


def judge_together(
    rig: Rig, plane_views: Sequence[PlaneView], stills: Sequence[Grey]
) -> Iterator[Finding]:
    """Find contradictions between the views, and points beside corners that nothing confirms."""
    scenery = None
    if len(rig.views) < 2:
        yield Finding(
            Severity.ERROR,
            Check.REFERENCES,
            "",
            f"the rig has {len(rig.views)} view",
            "two or more are right: one alone shows no point",
        )
    else:
        scenery = Scenery(rig, stills)
        found = list(_judge_scenery(rig, scenery))
        wrong = different_sides(rig, plane_views)
        # Swapped rows and columns and mirrored points also turn the plane over: their name says
        # more, and gives the corrected line.
        if wrong is not None and not any(_is_mistake(finding) for finding in found):
            yield Finding(Severity.ERROR, Check.REFERENCES, "", *wrong)
        yield from found
    yield from _judge_corners(rig.views, stills, scenery)


def _is_mistake(finding: Finding) -> bool:
    return (finding.severity, finding.check) == (Severity.ERROR, Check.REFERENCES)


def judge_sizes(rig: Rig, sizes_px: Sequence[tuple[int, int]]) -> Iterator[Finding]:
    """Find views whose pictures have another size than those in which points were measured."""
    for view, size_px in zip(rig.views, sizes_px, strict=True):
        if (wrong := other_size(view, size_px)) is not None:
            yield Finding(Severity.ERROR, Check.REFERENCES, view.name, *wrong)


def _judge_scenery(rig: Rig, scenery: Scenery) -> Iterator[Finding]:
    """Find contradictions between rig and texture of the plane."""
    for k in scenery.plain():
        yield Finding(
            Severity.ERROR,
            Check.EXPOSURE,
            rig.views[k].name,
            "there is nothing in its pictures",
            "the plane and a hand must be in view: look at the lens cap, the light and the source",
        )
    if (same := scenery.same_pictures()) is not None:
        yield Finding(Severity.ERROR, Check.REFERENCES, "", *same)
    elif (mistake := scenery.mistake()) is not None:
        severity = Severity.ERROR if mistake.is_certain else Severity.WARNING
        what = f"{mistake.what} (the views agree by {mistake.as_given:.2f} on what the plane shows)"
        right = mistake.advice(rig)
        places = list(mistake.points_px)
        name = rig.views[places[0]].name if len(places) == 1 else ""
        yield Finding(severity, Check.REFERENCES, name, what, right)
    for k, bend in scenery.bends().items():
        yield Finding(Severity.WARNING, Check.LENS, rig.views[k].name, bend.what, bend.right)


def _judge_strength(name: str, plane_view: PlaneView) -> Iterator[Finding]:
    weakness = reference_weakness(plane_view, DEFAULT_REFERENCE_SIGMA_PX, plane_view.plane_points)
    if weakness > WEAKNESS[0]:
        yield Finding(
            Severity.ERROR if weakness > WEAKNESS[1] else Severity.WARNING,
            Check.REFERENCES,
            name,
            f"errors of the reference points grow {weakness:.1f} times between them: they lie "
            "nearly on a line, or close together",
            f"below {WEAKNESS[0]:g} is right: spread them, no three near one line",
        )


def _judge_consistency(name: str, plane_view: PlaneView, points_px: Array) -> Iterator[Finding]:
    off = np.hypot(*(plane_view.project(plane_view.plane_points) - points_px).T)
    worst = int(np.argmax(off))
    limit = INCONSISTENT_SIGMAS * DEFAULT_REFERENCE_SIGMA_PX
    if off[worst] > limit:
        yield Finding(
            Severity.WARNING,
            Check.REFERENCES,
            name,
            f"reference_points_px[{worst}] is {off[worst]:.1f} px off what the others say",
            f"below {limit:g} px is right: measure it again, or plane.points[{worst}]",
        )


def _judge_corners(
    views: Sequence[View], stills: Sequence[Grey], scenery: Scenery | None
) -> Iterator[Finding]:
    """Find points beside sharp corners, unless the views agree less with a point at its corner."""
    for j, (view, still) in enumerate(zip(views, stills, strict=True)):
        points_px = np.array(view.reference_points_px)
        for k, corner in _corners_beside(view, still):
            if scenery is not None and _is_contradicted(scenery, j, points_px, k, corner):
                continue  # the corner is another object's
            yield Finding(
                Severity.WARNING,
                Check.REFERENCES,
                view.name,
                f"reference_points_px[{k}] is {math.dist(corner, points_px[k]):.1f} px off the "
                f"corner at ({corner[0]:.1f}, {corner[1]:.1f})",
                f"below {CORNER_PX[0]:g} px is right, if that corner is meant",
            )


def _corners_beside(view: View, still: Grey) -> Iterator[tuple[int, Array]]:
    """Yield the indices of points beside sharp corners, and those corners."""
    for k, point in enumerate(np.array(view.reference_points_px)):
        # A hand's own outline has corners.
        if not _near_hand(view, point) and (corner := _corner_beside(still, point)) is not None:
            yield k, corner


def _is_contradicted(scenery: Scenery, j: int, points_px: Array, k: int, corner: Array) -> bool:
    """Whether a view agrees less with another one if its point k lies at a corner."""
    pair = (0, j) if j else (1, 0)
    moved_px = points_px.copy()
    moved_px[k] = corner
    return scenery.agreement_of({j: moved_px}, pair) < scenery.agreement_of({}, pair)


def _near_hand(view: View, point: Array) -> bool:
    start = view.start
    return start is not None and math.dist(start.tip_px, point) < _HAND_LENGTHS * start.length_px


def _corner_beside(still: Grey, point: Array) -> Array | None:
    """Sharp corner near a point that has none itself; None without one."""
    import cv2

    height, width = still.shape
    reach = math.ceil(CORNER_PX[1])
    margin = reach + 6
    u, v = (round(value) for value in point.tolist())
    if not (margin <= u < width - margin and margin <= v < height - margin):
        return None
    patch = np.ascontiguousarray(still[v - margin : v + margin + 1, u - margin : u + margin + 1])
    low, high = np.percentile(patch, (5, 95)).tolist()
    if high - low < _LEAST_CONTRAST:
        return None
    strength = np.asarray(cv2.cornerMinEigenVal(patch, 5, ksize=3)) * (255.0 / (high - low)) ** 2
    strongest_around = np.asarray(cv2.dilate(strength, np.ones((5, 5), np.uint8)))
    row, column = np.nonzero((strength >= strongest_around) & (strength >= SHARP_CORNER))
    offset = np.stack([column, row], axis=-1) - margin
    near = np.hypot(*offset.T) <= CORNER_PX[1]
    if not near.any():
        return None
    guesses = (offset[near] + margin).astype(np.float32).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 0.01)
    refined = np.asarray(cv2.cornerSubPix(patch, guesses, (4, 4), (-1, -1), criteria))
    corners = refined.reshape(-1, 2).astype(np.float64) - margin + (u, v)
    distances = np.hypot(*(corners - point).T)
    nearest = int(np.argmin(distances))
    if not CORNER_PX[0] < distances[nearest] <= CORNER_PX[1]:
        return None
    return np.asarray(corners[nearest])
