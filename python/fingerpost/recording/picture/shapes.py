"""Shapes that represent a moment on a sheet or on the operator's page."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fingerpost.lines import clip_to_rectangle, line_at_angle
from fingerpost.pointing import ConstraintLine, FingerLine
from fingerpost.recording.sheet import Points

# Distance of points of an outline, in its usual steps, beyond which they belong to two fingers.
_OUTLINE_GAP = 5.0


def outline(plane_points: Points) -> Points:
    """Return the closed outline of the reference points, in small steps, for lens distortion."""
    corners = plane_points[hull(plane_points)]
    along = np.linspace(0.0, 1.0, 16, endpoint=False)[:, None]
    sides = [
        a + along * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
    ]
    return np.concatenate([*sides, corners[:1]])


def hull(points: Points) -> NDArray[np.intp]:
    """Return the indices of the corners of the convex hull, in order."""
    import cv2

    lower, upper = points.min(axis=0), points.max(axis=0)
    unit = ((points - lower) / (upper - lower)).astype(np.float32)
    return np.asarray(cv2.convexHull(unit, returnPoints=False), np.intp).ravel()


def ahead(finger: FingerLine, corners: Points) -> Points:
    """Return the finger line from the tip onwards, clipped to the rectangle of two corners."""
    ends = clip_to_rectangle(line_at_angle(finger.anchor_px, finger.angle_rad), *corners)
    if ends is None:
        return np.empty((0, 2))
    along = np.array([math.cos(finger.angle_rad), math.sin(finger.angle_rad)])
    reach = np.sort((ends - finger.anchor_px) @ along)
    tip = float((finger.tip_px - finger.anchor_px) @ along)
    if reach[1] <= tip:
        return np.empty((0, 2))
    return np.asarray(finger.anchor_px + np.outer([max(tip, reach[0]), reach[1]], along))


def near_references(line: ConstraintLine, plane_points: Points) -> Points:
    """Return the part of a constraint line near the reference points, in small steps."""
    lower, upper = plane_points.min(axis=0), plane_points.max(axis=0)
    border = 0.25 * (upper - lower)
    ends = clip_to_rectangle(line.line, lower - border, upper + border)
    return np.empty((0, 2)) if ends is None else between(ends, 65)


def with_gaps(outline: Points) -> Points:
    """Insert a row of NaN between the fingers of an outline, so that no line joins them."""
    if len(outline) < 3:
        return outline
    steps = np.hypot(*np.diff(outline, axis=0).T)
    jumps = np.flatnonzero(steps > _OUTLINE_GAP * np.median(steps)) + 1
    return np.insert(outline, jumps, np.nan, axis=0)


def between(ends: Points, count: int) -> Points:
    """Return points at equal steps from end to end."""
    return np.asarray(ends[0] + np.linspace(0.0, 1.0, count)[:, None] * (ends[1] - ends[0]))
