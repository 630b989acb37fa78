"""Layout of the robot cell: workspace, cameras, and direction of the hand.

The world is the robot's own frame in millimetres: the robot's base is at the origin, x points away
from it over the table, z up, and the table's top is z = 0. The cameras are opposite the robot, the
operator is at its right, so that neither arm nor hand hides the other from the cameras.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerpost.simulate import Camera, DevicePose, checks

Array = NDArray[np.float64]

AIM_MM = (375.0, -75.0, 85.0)
"""Point at which both cameras aim: the middle of the workspace, slightly towards the hand."""

WORKSPACE_MM = np.array([[330.0, -120.0], [520.0, -120.0], [520.0, 130.0], [330.0, 130.0]])
"""Corners of the part of the table used for pointing; the arm reaches all of it, and 0.2 m up."""


@dataclass(frozen=True)
class CameraPlacement:
    """Two cameras on a circle around the workspace."""

    distance_mm: float = 1500.0  # mm from the aim, 500…5000
    elevation_deg: float = 42.0  # deg above the table, 10…80
    half_vergence_deg: float = 20.0  # deg, each camera to its side of the x axis, 2…60
    width_px: int = 640  # px, 64…4096
    height_px: int = 480  # px, 64…4096
    field_mm: float = 605.0  # mm, width of the field of view at the aim, 100…3000

    def __post_init__(self) -> None:
        checks.number("distance_mm", self.distance_mm, 500, 5000)
        checks.number("elevation_deg", self.elevation_deg, 10, 80)
        checks.number("half_vergence_deg", self.half_vergence_deg, 2, 60)
        checks.whole("width_px", self.width_px, 64, 4096)
        checks.whole("height_px", self.height_px, 64, 4096)
        checks.number("field_mm", self.field_mm, 100, 3000)

    def cameras(self) -> tuple[Camera, Camera]:
        """Return the cameras, ``left`` and ``right`` as seen from them."""
        return self._camera("left", -1.0), self._camera("right", 1.0)

    def _camera(self, name: str, side: float) -> Camera:
        azimuth = side * math.radians(self.half_vergence_deg)
        elevation = math.radians(self.elevation_deg)
        outwards = np.array(
            [
                math.cos(elevation) * math.cos(azimuth),
                math.cos(elevation) * math.sin(azimuth),
                math.sin(elevation),
            ]
        )
        right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
        rotation = np.stack([right, np.cross(-outwards, right), -outwards])
        centre = np.array(AIM_MM) + self.distance_mm * outwards
        return Camera(
            name=name,
            width_px=self.width_px,
            height_px=self.height_px,
            f_px=self.width_px * self.distance_mm / self.field_mm,
            camera_from_world=np.hstack([rotation, (-rotation @ centre)[:, None]]),
        )


@dataclass(frozen=True)
class Aim:
    """Pose of the hand relative to the point that it indicates, on a plane of a given height."""

    point_mm: tuple[float, float]  # robot's X, Y of the indicated point [mm]
    plane_mm: float = 0.0  # height of the plane [mm]
    hover_mm: float = 80.0  # height of the fingertip above that plane [mm], 0…2000
    azimuth_deg: float = 155.0  # 90 points along +x, away from the robot, 180 along +y
    slant_deg: float = 40.0  # below the horizontal, 1…89
    roll_deg: float = 0.0

    def pose(self) -> DevicePose:
        """Return the hand's pose."""
        pose = DevicePose.pointing_at(
            self.point_mm,
            hover_mm=self.hover_mm,
            azimuth_deg=self.azimuth_deg,
            slant_deg=self.slant_deg,
            roll_deg=self.roll_deg,
        )
        x, y, z = pose.tip_mm
        tip = (x, y, z + self.plane_mm)
        return DevicePose(tip, pose.azimuth_deg, pose.slant_deg, pose.roll_deg)


def indicated_mm(pose: DevicePose, plane_mm: float) -> Array | None:
    """Return the point (2,) that a hand indicates on the plane at a height [mm], or None."""
    x, y, z = pose.tip_mm
    lowered = DevicePose((x, y, z - plane_mm), pose.azimuth_deg, pose.slant_deg, pose.roll_deg)
    return lowered.indicated_mm
