"""What the system itself moves in front of the views, as a robot's arm: never a hand.

Two things tell. A finger that lies within the body's silhouette in a view may be the body's own: as
long as it is not known for a hand, it is refused. A hand that is followed already may pass in front
of the body; it is told from it by where the fingertip is in space, as two views see it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Protocol

import numpy as np

from fingerpost._core import FingerLine, StartPose
from fingerpost.finding.finger import Array
from fingerpost.finding.pairs import Viewpoint
from fingerpost.lens import Lens
from fingerpost.silhouette import Capsule, Silhouette

COVERED = 0.6
"""A finger of which this part lies within the silhouette is the body's own. A jaw lies in it whole;
of a finger that points past an arm, at most the tip does."""

REACHES = 1.2
"""A fingertip so near the axis of a part of the body is on it [radii]: the margin is for what the
centres of the cameras, known from the reference points alone, leave uncertain."""

LOOKED_AT = 10
"""Places along a finger that are looked at."""


@dataclass(frozen=True, eq=False, slots=True)
class Body:
    """A silhouette, and the lens through which a view shows it."""

    silhouette: Silhouette
    lens: Lens | None = None

    @classmethod
    def none(cls) -> Body:
        """Return that of a system which moves nothing."""
        return cls(Silhouette.none())

    def shows_as(self, line: FingerLine | None) -> bool:
        """Say whether a finger line is the body's own."""
        if line is None:
            return False
        tip_px = np.array(line.tip_px)
        return self._covers(tip_px, 2.0 * (np.array(line.anchor_px) - tip_px))

    def shows_at(self, start: StartPose) -> bool:
        """Say whether a finger with this tip, direction and length is the body's own."""
        direction = np.array([np.cos(start.angle_rad), np.sin(start.angle_rad)])
        return self._covers(np.array(start.tip_px), -start.length_px * direction)

    def _covers(self, tip_px: Array, back_px: Array) -> bool:
        if not len(self.silhouette.radii_px):
            return False
        places_px = tip_px + np.linspace(0.0, 1.0, LOOKED_AT)[:, None] * back_px
        if self.lens is not None:
            places_px = self.lens.undistort(places_px)
        return bool(self.silhouette.covers(places_px).mean() >= COVERED)


class PassingView(Protocol):
    """What is asked here of a view."""

    @property
    def viewpoint(self) -> Viewpoint:
        """Where it is taken from, and how it sees the plane."""

    @property
    def tip_px(self) -> tuple[float, float] | None:
        """Tip of the finger that it follows, if it shows one in this frame."""

    @property
    def may_show_body(self) -> bool:
        """Whether the hand that it follows lies within the body's silhouette."""

    def judge_body(self, *, is_hand: bool | None) -> None:
        """Learn whether what it follows there is a hand; None where nothing tells."""


def tell_from_hands(views: Sequence[PassingView], bodies: Sequence[Capsule]) -> None:
    """Judge every hand that lies within the body's silhouette, by another view's fingertip.

    Parameters
    ----------
    views
        All views, each after it has followed its frame.
    bodies
        Where the body may be, in plane coordinates.
    """
    verdicts: dict[int, bool] = {}
    for k, other in permutations(range(len(views)), 2):
        shown = views[k].tip_px is not None and views[other].tip_px is not None
        if views[k].may_show_body and shown:
            on_body = _is_on_body(views[k], views[other], bodies)
            verdicts[k] = verdicts.get(k, True) and not on_body
    for k, view in enumerate(views):
        if view.may_show_body:
            view.judge_body(is_hand=verdicts.get(k))


def _is_on_body(view: PassingView, other: PassingView, bodies: Sequence[Capsule]) -> bool:
    """Say whether the tip that two views show is a part of the body; what is no point may be."""
    point = meeting_point(view, other)
    if point is None:
        return True
    return any(part.distance(point) <= REACHES * part.radius for part in bodies)


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
