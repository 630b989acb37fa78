"""Moving bodies of the system itself, such as a robot's arm, which are never a hand.

A detection within the projected silhouette of a body is rejected unless it is validated as a hand.
A followed hand may pass in front of the body; its triangulated fingertip distinguishes the two.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fingerpost._core import FingerLine, StartPose
from fingerpost.finding.finger import Array
from fingerpost.finding.pairs import Viewpoint
from fingerpost.lens import Lens
from fingerpost.silhouette import Capsule, Silhouette

MIN_COVERED_PART = 0.6
"""Least part of a finger within the silhouette for which it belongs to the body. A gripper's jaw
lies in it entirely; of a finger that points past an arm, at most the tip does."""

MAX_AXIS_DISTANCE = 1.2
"""Greatest distance of a fingertip on the body from the axis of a capsule [radii]. The margin is
for the camera centres, which are known from the reference points alone."""

SAMPLES = 10
"""Number of points along a finger."""


@dataclass(frozen=True, eq=False, slots=True)
class Body:
    """Silhouette of the bodies in a view, in ideal pixels, and the view's lens."""

    silhouette: Silhouette
    lens: Lens | None = None

    @classmethod
    def none(cls) -> Body:
        """Return the empty silhouette."""
        return cls(Silhouette.none())

    def shows_as(self, line: FingerLine | None) -> bool:
        """Whether a finger line belongs to the body."""
        if line is None:
            return False
        tip_px = np.array(line.tip_px)
        return self._covers(tip_px, 2.0 * (np.array(line.anchor_px) - tip_px))

    def shows_at(self, start: StartPose) -> bool:
        """Whether a finger with this tip, direction and length belongs to the body."""
        direction = np.array([np.cos(start.angle_rad), np.sin(start.angle_rad)])
        return self._covers(np.array(start.tip_px), -start.length_px * direction)

    def _covers(self, tip_px: Array, back_px: Array) -> bool:
        if not len(self.silhouette.radii_px):
            return False
        places_px = tip_px + np.linspace(0.0, 1.0, SAMPLES)[:, None] * back_px
        return bool(self.covers(places_px).mean() >= MIN_COVERED_PART)

    def covers(self, places_px: Array) -> NDArray[np.bool_]:
        """Return which image points (M, 2) [px] lie in the silhouette: (M,)."""
        if self.lens is not None:
            places_px = self.lens.undistort(places_px)
        return self.silhouette.covers(places_px)

    def discs(self) -> list[tuple[Array, Array, float]]:
        """Return the image region as `Background.learn` excludes it: discs, whatever the lens."""
        centres_px = self.silhouette.centres_px
        if self.lens is not None:
            centres_px = self.lens.distort(centres_px)
        return [
            (centre_px, centre_px, float(radius_px))
            for centre_px, radius_px in zip(centres_px, self.silhouette.radii_px, strict=True)
        ]


class PassingView(Protocol):
    """The view's properties and method that the test uses."""

    @property
    def viewpoint(self) -> Viewpoint:
        """Its camera centre and homography."""

    @property
    def tip_px(self) -> tuple[float, float] | None:
        """Tip of its finger line; None without one."""

    @property
    def may_show_body(self) -> bool:
        """Whether its finger lies within the body's silhouette."""

    def judge_body(self, *, is_hand: bool | None) -> None:
        """Take over whether that finger is a hand; None if unknown."""


def distinguish_body_from_hands(views: Sequence[PassingView], bodies: Sequence[Capsule]) -> None:
    """Decide for every finger within the body's silhouette, by its triangulated tip.

    Parameters
    ----------
    views
        All views, after the update of their trackers.
    bodies
        Capsules of the body, in plane coordinates.
    """
    is_hand_of: dict[int, bool] = {}
    for k, other in permutations(range(len(views)), 2):
        shown = views[k].tip_px is not None and views[other].tip_px is not None
        if views[k].may_show_body and shown:
            on_body = _is_on_body(views[k], views[other], bodies)
            is_hand_of[k] = is_hand_of.get(k, True) and not on_body
    for k, view in enumerate(views):
        if view.may_show_body:
            view.judge_body(is_hand=is_hand_of.get(k))


def _is_on_body(view: PassingView, other: PassingView, bodies: Sequence[Capsule]) -> bool:
    """Whether the triangulated tip is on the body; True where it is undefined."""
    point = meeting_point(view, other)
    if point is None:
        return True
    return any(part.distance(point) <= MAX_AXIS_DISTANCE * part.radius for part in bodies)


def meeting_point(view: PassingView, other: PassingView) -> Array | None:
    """Return the point (3,) nearest to the rays through two tips; None where they are parallel."""
    rays = []
    for one in (view, other):
        foot = one.viewpoint.plane_view.back_project(np.array(one.tip_px))
        start = one.viewpoint.centre
        rays.append((start, np.array([*foot, 0.0]) - start))
    (p, u), (q, v) = rays
    # The feet of the common perpendicular: (p + s u − q − t v) is normal to u and to v.
    A = np.array([[u @ u, -(u @ v)], [u @ v, -(v @ v)]])
    if not np.isfinite(A).all() or math.isclose(np.linalg.det(A), 0.0):
        return None
    s, t = np.linalg.solve(A, np.array([u @ (q - p), v @ (q - p)]))
    return np.asarray((p + s * u + q + t * v) / 2)
