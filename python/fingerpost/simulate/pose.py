"""Pose of a pointing device.

The device's own frame has its origin at the fingertip, x along the pointing direction, z up
towards the thumb and y to the left. A pose puts it into the world.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.checks import finite_array
from fingerpost.simulate import checks

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DevicePose:
    """Position and orientation of a pointing device.

    Azimuth turns the pointing direction about the vertical, anticlockwise seen from above; 0 points
    along negative Y, which is towards cameras placed at azimuth 0. Slant is the angle of the finger
    below the horizontal. At roll 0 the thumb lies in the vertical plane of the finger, above it;
    positive roll turns it clockwise as seen along the pointing direction.
    """

    tip_mm: tuple[float, float, float]  # mm in the world, the point of the tip on the finger's axis
    azimuth_deg: float  # deg, −360…360
    slant_deg: float  # deg below the horizontal, −89…89
    roll_deg: float = 0.0  # deg, −180…180

    def __post_init__(self) -> None:
        tip = finite_array(self.tip_mm, "tip_mm", (3,))
        object.__setattr__(self, "tip_mm", tuple(float(x) for x in tip))
        checks.number("azimuth_deg", self.azimuth_deg, -360, 360)
        checks.number("slant_deg", self.slant_deg, -89, 89)
        checks.number("roll_deg", self.roll_deg, -180, 180)

    @classmethod
    def pointing_at(
        cls,
        target_mm: ArrayLike,
        *,
        hover_mm: float,
        azimuth_deg: float = 0.0,
        slant_deg: float = 45.0,
        roll_deg: float = 0.0,
    ) -> "DevicePose":
        """Return the pose that points at a point of the plane from a given height of the tip.

        Parameters
        ----------
        target_mm
            (2,) point on the plane [mm].
        hover_mm
            Height of the tip above the plane [mm], 0 to 2000.
        azimuth_deg, slant_deg, roll_deg
            As in the class; the slant must be 1 to 89, because the finger must point down.
        """
        target = finite_array(target_mm, "target_mm", (2,))
        hover = checks.number("hover_mm", hover_mm, 0, 2000)
        checks.number("slant_deg", slant_deg, 1, 89)
        direction = cls((0.0, 0.0, 0.0), azimuth_deg, slant_deg).direction
        tip = np.append(target, 0.0) + direction * (hover / direction[2])
        return cls(tuple(tip), azimuth_deg, slant_deg, roll_deg)

    @property
    def direction(self) -> Array:
        """(3,) unit vector of pointing in the world."""
        azimuth, slant = math.radians(self.azimuth_deg), math.radians(self.slant_deg)
        return np.array(
            [
                math.cos(slant) * math.sin(azimuth),
                -math.cos(slant) * math.cos(azimuth),
                -math.sin(slant),
            ]
        )

    @property
    def world_from_device(self) -> Array:
        """(3, 4) rotation and translation [mm]."""
        x = self.direction
        level = np.array([-x[1], x[0], 0.0]) / math.hypot(x[0], x[1])
        above = np.cross(x, level)
        roll = math.radians(self.roll_deg)
        z = math.cos(roll) * above - math.sin(roll) * level
        return np.stack([x, np.cross(z, x), z, np.array(self.tip_mm)], axis=1)

    @property
    def indicated_mm(self) -> Array | None:
        """(2,) Intersection of the finger's axis with the plane ahead of the tip [mm], or None."""
        x, tip = self.direction, np.array(self.tip_mm)
        if x[2] >= 0 or tip[2] < 0:
            return None
        return np.asarray((tip - x * (tip[2] / x[2]))[:2])

    def retreated(self, distance_mm: float) -> "DevicePose":
        """Return the pose withdrawn along the finger, as when an arm leaves."""
        distance = checks.number("distance_mm", distance_mm, 0, 10_000)
        tip = np.array(self.tip_mm) - distance * self.direction
        return DevicePose(tuple(tip), self.azimuth_deg, self.slant_deg, self.roll_deg)

    def pose_at(self, time_s: float) -> "DevicePose":  # noqa: ARG002
        """Return the pose itself: a static device is also a motion."""
        return self
