"""What the system itself moves in front of a view, as a robot's arm: never a hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fingerpost._core import FingerLine, StartPose
from fingerpost.finding.finger import Array
from fingerpost.lens import Lens
from fingerpost.silhouette import Silhouette

COVERED = 0.6
"""A finger of which this part lies within the silhouette is the body's own. A jaw lies in it whole;
of a finger that points past an arm, at most the tip does."""

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
