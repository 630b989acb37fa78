"""Expected hand poses over the workspace.

A pose consists of a target on the plane, a height of the fingertip above it, a slant below the
horizontal and an azimuth: the pointing direction on the plane, 0 towards the cameras and positive
anticlockwise seen from above. Poses fill their ranges evenly rather than randomly: an additive
recurrence (Roberts 2018, after Weyl) leaves no gaps, and results are reproducible.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerpost.advise.camera import PlaneCamera
from fingerpost.simulate import PoseLimits

Array = NDArray[np.float64]

_TOO_CLOSE = 1e-6


@dataclass(frozen=True, eq=False)
class Workspace:
    """The part of the plane inside the reference points, and the direction of the cameras.

    Attributes
    ----------
    outline : (H, 2)
        Convex hull of the reference points, in order [plane units].
    towards_rad
        Direction towards the cameras in plane coordinates, from X towards Y [rad].
    anticlockwise
        +1 if X turns to Y anticlockwise as seen from above, else −1.
    """

    outline: Array
    towards_rad: float
    anticlockwise: float

    @classmethod
    def between(cls, plane_points: Array, cameras: Sequence[PlaneCamera]) -> Workspace:
        """Return the workspace of reference points seen by some cameras."""
        import cv2

        # OpenCV uses single precision; the hull is returned by indices.
        lower, extent = plane_points.min(axis=0), np.ptp(plane_points, axis=0)
        unit = ((plane_points - lower) / extent).astype(np.float32)
        hull = cv2.convexHull(unit, returnPoints=False).ravel()
        outline = plane_points[hull]
        standing = np.mean([camera.centre[:2] for camera in cameras], axis=0)
        away = standing - (outline.min(axis=0) + outline.max(axis=0)) / 2
        # With cameras on all sides, or straight above, the direction towards them is undefined.
        far = np.hypot(*away) > _TOO_CLOSE * extent.max()
        towards = math.atan2(away[1], away[0]) if far else -math.pi / 2
        return cls(outline, towards, -1.0 if cameras[0].mirrored else 1.0)

    @property
    def middle(self) -> Array:
        """(2,) middle of the bounding box."""
        return np.asarray((self.outline.min(axis=0) + self.outline.max(axis=0)) / 2)

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Whether points (..., 2) are inside the outline or on it."""
        side = np.roll(self.outline, -1, axis=0) - self.outline
        offset = points[..., None, :] - self.outline
        turn = side[:, 0] * offset[..., 1] - side[:, 1] * offset[..., 0]
        slack = _TOO_CLOSE * np.ptp(self.outline, axis=0).prod()
        return np.asarray((turn >= -slack).all(axis=-1) | (turn <= slack).all(axis=-1))

    def cells(self, count: int) -> tuple[Array, float]:
        """Return centres (N, 2) of the square cells whose centre is inside, and a cell's side.

        There are `count` cells along the longer side of the bounding box.
        """
        lower, upper = self.outline.min(axis=0), self.outline.max(axis=0)
        side = float((upper - lower).max()) / count
        counts = np.maximum(np.round((upper - lower) / side), 1).astype(int)
        first = (lower + upper - (counts - 1) * side) / 2
        columns, rows = (first[i] + side * np.arange(counts[i]) for i in (0, 1))
        middles = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        inside = self.contains(middles)
        return middles[inside], side

    def heading_rad(self, azimuth_deg: Array) -> Array:
        """Direction of pointing in plane coordinates [rad]."""
        return self.towards_rad + self.anticlockwise * np.radians(azimuth_deg)


@dataclass(frozen=True, eq=False)
class Poses:
    """P hand poses.

    Attributes
    ----------
    target : (P, 2)
        Indicated points [plane units].
    azimuth_deg : (P,)
        −180 to 180, 0 towards the cameras.
    tip : (P, 3)
        Fingertip: X, Y and height [plane units].
    direction : (P, 3)
        Unit vector of pointing, in the same axes.
    """

    target: Array
    azimuth_deg: Array
    tip: Array
    direction: Array

    def __len__(self) -> int:
        return len(self.target)

    @classmethod
    def pointing(
        cls,
        workspace: Workspace,
        target: Array,
        azimuth_deg: Array,
        slant_deg: Array,
        hover: Array,
    ) -> Poses:
        """Return poses (P,) that point at targets (P, 2), the tip at a height above the plane."""
        slant, heading = np.radians(slant_deg), workspace.heading_rad(azimuth_deg)
        direction = np.stack(
            [np.cos(slant) * np.cos(heading), np.cos(slant) * np.sin(heading), -np.sin(slant)],
            axis=-1,
        )
        above = np.pad(target, ((0, 0), (0, 1)))
        return cls(
            target, azimuth_deg, above + direction * (hover / direction[:, 2])[:, None], direction
        )

    @classmethod
    def expected(
        cls, workspace: Workspace, limits: PoseLimits, unit_mm: float, count: int
    ) -> Poses:
        """Distribute about `count` poses evenly over the workspace and the limits.

        Parameters
        ----------
        unit_mm
            Length of a plane unit [mm].
        """
        lower, upper = workspace.outline.min(axis=0), workspace.outline.max(axis=0)
        # Of the targets in the bounding box, only those in the outline are kept.
        share = max(
            float(np.mean(workspace.contains(lower + _even(512, 2) * (upper - lower)))), 1e-2
        )
        draws = _even(math.ceil(count / share), 5)
        target = lower + draws[:, :2] * (upper - lower)
        draws, target = (array[workspace.contains(target)] for array in (draws, target))
        azimuth, slant, hover = (
            low + draws[:, 2 + i] * (high - low)
            for i, (low, high) in enumerate((limits.azimuth_deg, limits.slant_deg, limits.hover_mm))
        )
        return cls.pointing(workspace, target, azimuth, slant, hover / unit_mm)

    @classmethod
    def all_round(
        cls,
        workspace: Workspace,
        limits: PoseLimits,
        unit_mm: float,
        cells: tuple[Array, float],
        sectors: int,
        each: int,
    ) -> tuple[Poses, NDArray[np.intp], NDArray[np.intp]]:
        """Return poses for every cell and direction, with the cell and the sector of each.

        `cells` is the result of `Workspace.cells`; sector k is centred on ``k · 360° / sectors``.
        """
        middles, side = cells
        cell, sector = (
            index.ravel()
            for index in np.meshgrid(
                np.repeat(np.arange(len(middles)), each), np.arange(sectors), indexing="ij"
            )
        )
        draws = _even(len(cell), 5)
        target = middles[cell] + side * (draws[:, :2] - 0.5)
        azimuth = (sector + draws[:, 2] - 0.5) * 360.0 / sectors
        slant, hover = (
            low + draws[:, 3 + i] * (high - low)
            for i, (low, high) in enumerate((limits.slant_deg, limits.hover_mm))
        )
        wrapped = (azimuth + 180.0) % 360.0 - 180.0
        return cls.pointing(workspace, target, wrapped, slant, hover / unit_mm), cell, sector


def _even(count: int, dimensions: int) -> Array:
    """(count, dimensions) points that fill the unit cube evenly."""
    ratio = 2.0
    for _ in range(64):  # the root of x^(d+1) = x + 1, which the golden ratio is for d = 1
        ratio = (1.0 + ratio) ** (1.0 / (dimensions + 1))
    steps = ratio ** -np.arange(1.0, dimensions + 1.0)
    return np.asarray((0.5 + np.outer(np.arange(1, count + 1), steps)) % 1.0)
