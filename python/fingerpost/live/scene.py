"""Scenes that the page draws, of a rig and of every moment: coordinates, not pixels.

The page only scales and shifts them. Numbers are rounded to the resolution of a screen; a shape is
a list of polylines, each a flat list x, y, x, y, ...
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fingerpost.lines import clip_to_rectangle
from fingerpost.live.moment import Moment, ViewMoment
from fingerpost.live.words import digits_of, headline
from fingerpost.pointing import ConstraintLine, Fix, PlaneView
from fingerpost.recording.picture import SearchMarks
from fingerpost.recording.picture.plan import Plan
from fingerpost.recording.picture.shapes import (
    ahead,
    between,
    hull,
    near_references,
    outline,
    with_gaps,
)
from fingerpost.targets import Target

CONFIDENCE = 0.95
"""Probability that the ellipse contains the indicated point."""

Points = NDArray[np.float64]
Polylines = list[list[float]]

_PX_DIGITS = 1
# Decimals of coordinates beyond those of displayed numbers.
_FINER = 2
# Extension of the plan's lines beyond the reference points, in extents of the latter.
_REACH = 4.0
# Size of a picture whose plan gives the plane's orientation; any size will do.
_ANY_SIZE_PX = (600, 600)
_FARTHEST_PX = 1e6


@dataclass(frozen=True, slots=True)
class RigScene:
    """Scene of a rig, known before its first frame.

    Attributes
    ----------
    title
        Name of the rig on the page.
    unit
        Unit of the plane.
    plane_points : (N, 2)
        The reference points.
    hull
        Indices of their convex hull, in order.
    plan_from_plane : (2, 2)
        Rotates and mirrors the plane to the views' orientation: entries −1, 0 or 1, y down.
    plane_size
        Side of the working plane, as `PlaneView.plane_size`.
    digits
        Decimals of displayed numbers.
    targets
        The targets on the plane.
    views
        Names of the views, in the rig's order.
    is_live
        Whether cameras set the pace.
    frames
        Expected number of frames of a recording; None if unknown.
    awaits_page
        Whether a recording is played from the first open page on, because nobody else uses it.
    """

    title: str
    unit: str
    plane_points: Points
    hull: Sequence[int]
    plan_from_plane: Points
    plane_size: float
    digits: int
    targets: tuple[Target, ...]
    views: tuple[str, ...]
    is_live: bool
    frames: int | None
    awaits_page: bool = False

    @classmethod
    def of(
        cls,
        title: str,
        unit: str,
        plane_views: Sequence[PlaneView],
        names: Iterable[str],
        *,
        targets: Iterable[Target] = (),
        is_live: bool,
        frames: int | None,
        awaits_page: bool = False,
    ) -> RigScene:
        """Return the scene of a rig whose views have the given homographies."""
        first = plane_views[0]
        turn = Plan.of(first, _ANY_SIZE_PX).window_from_plane[:, :2]
        return cls(
            title=title,
            unit=unit,
            plane_points=first.plane_points,
            hull=hull(first.plane_points).tolist(),
            plan_from_plane=np.sign(turn),
            plane_size=first.plane_size,
            digits=digits_of(first.plane_size),
            targets=tuple(targets),
            views=tuple(names),
            is_live=is_live,
            frames=frames,
            awaits_page=awaits_page,
        )

    def as_dict(self) -> dict[str, Any]:
        """Return it as JSON values."""
        return {
            "title": self.title,
            "unit": self.unit,
            "points": self.plane_points.tolist(),
            "hull": list(self.hull),
            "turn": self.plan_from_plane.tolist(),
            "digits": self.digits,
            "targets": [
                {
                    "name": target.name,
                    "corners": target.corners.tolist(),
                    "radius": target.radius,
                    "rest": target.rest,
                }
                for target in self.targets
            ],
            "views": list(self.views),
            "live": self.is_live,
            "frames": self.frames,
        }


def scene_of(moment: Moment, rig: RigScene, trail: Iterable[Sequence[float]]) -> dict[str, Any]:
    """Return all shapes and texts of a moment, as JSON values.

    Parameters
    ----------
    moment
        One step of the main loop.
    rig
        Its rig.
    trail
        Earlier indicated points, oldest first [plane units].
    """
    fix, digits = moment.fix, rig.digits + _FINER
    ellipse = fix.ellipse(CONFIDENCE)
    plan: dict[str, Any] = {
        "lines": [_band(line, rig.plane_points, digits) for line in fix.constraint_lines],
        "trail": [round(float(value), digits) for point in trail for value in point],
    }
    if fix.point is not None:
        plan["point"] = np.round(fix.point, digits).tolist()
        plan["targets"] = [round(fix.targets.get(target.name, 0.0), 3) for target in rig.targets]
    if ellipse is not None:
        plan["ellipse"] = _flat(ellipse.polygon(72), digits)
        plan["axes"] = [f"{axis:.{rig.digits}f}" for axis in sorted(ellipse.semi_axes)[::-1]]
    return {
        "number": moment.number,
        "frame": moment.frame,
        "time": round(fix.time_s, 4),
        "work": round(1e3 * (moment.reported_s - moment.begun_s), 2),
        "head": headline(moment, rig.digits).as_dict(),
        "plan": plan,
        "views": [_view(view, k, fix) for k, view in enumerate(moment.views)],
        "pictures": [len(view.jpeg) for view in moment.views],
    }


def _view(view: ViewMoment, index: int, fix: Fix) -> dict[str, Any]:
    """Return the shapes drawn over a view's picture, and the texts below it."""
    said: dict[str, Any] = {
        "status": view.status,
        "reasons": list(view.reasons[:2]),
        "size": list(view.size_px),
    }
    if view.time_s is not None:
        said["skew"] = round(1e3 * (view.time_s - fix.time_s), 1)
    if not view.jpeg:
        return said
    said["contour"] = _polylines(with_gaps(view.contour_px))
    said["search"] = _search(view.search)
    if view.finger is not None:
        corners = np.array([[-0.5, -0.5], np.array(view.size_px) - 0.5])
        said["finger"] = _polylines(ahead(view.finger, corners))
    if view.plane_view is not None:
        _add_plane(said, view.plane_view, index, fix)
    return said


def _add_plane(said: dict[str, Any], plane_view: PlaneView, index: int, fix: Fix) -> None:
    """Project results on the plane into a view."""
    points = plane_view.plane_points
    said["outline"] = _polylines(plane_view.project(outline(points)))
    said["references"] = [_place(place) for place in plane_view.project(points)]
    said["others"] = [
        []
        if line is None or k == index
        else _polylines(plane_view.project(near_references(line, points)))
        for k, line in enumerate(fix.constraint_lines)
    ]
    ellipse = fix.ellipse(CONFIDENCE)
    if ellipse is not None:
        ring = plane_view.project(ellipse.polygon(72))
        if np.isfinite(ring).all():
            said["ellipse"] = _polylines(ring)
    if fix.point is not None:
        said["point"] = _place(plane_view.project(fix.point))


def _band(line: ConstraintLine | None, plane_points: Points, digits: int) -> dict[str, Any] | None:
    """Return a constraint line and its band of one standard deviation on the plan."""
    if line is None:
        return None
    lower, upper = plane_points.min(axis=0), plane_points.max(axis=0)
    border = _REACH * (upper - lower)
    ends = clip_to_rectangle(line.line, lower - border, upper + border)
    if ends is None:
        return None
    points = between(ends, 65)
    with np.errstate(invalid="ignore"):  # the variance of an exact line may round to below zero
        away = line.sigma_at(points)[:, None] * line.line[:2]
    band = np.concatenate([points + away, (points - away)[::-1]])
    coordinates = {"ends": _flat(ends, digits)}
    if np.isfinite(band).all():
        coordinates["band"] = _flat(band, digits)
    return coordinates


def _search(search: SearchMarks) -> dict[str, Any]:
    """Return the search lines, and the chosen and rejected edges."""
    found = np.isfinite(search.edges_px).all(axis=1)
    return {
        "lines": _flat(search.lines_px, _PX_DIGITS),
        "chosen": _flat(search.edges_px[found & search.agrees], _PX_DIGITS),
        "rejected": _flat(search.edges_px[found & ~search.agrees], _PX_DIGITS),
    }


def _polylines(points: Points) -> Polylines:
    """Return the parts of a line in pixels that can be drawn."""
    drawn = (np.abs(points) < _FARTHEST_PX).all(axis=1)  # false for NaN
    breaks = np.flatnonzero(np.diff(drawn)) + 1
    parts = zip(np.split(points, breaks), np.split(drawn, breaks), strict=True)
    return [_flat(part, _PX_DIGITS) for part, seen in parts if len(part) > 1 and seen[0]]


def _flat(points: Points, digits: int) -> list[float]:
    numbers: list[float] = np.round(np.asarray(points, np.float64).ravel(), digits).tolist()
    return numbers


def _place(point: Points) -> list[float] | None:
    """Return a point in pixels; None if it cannot be drawn."""
    if not (np.abs(point) < _FARTHEST_PX).all():
        return None
    return _flat(point, _PX_DIGITS)
