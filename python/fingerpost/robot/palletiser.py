"""Kinematics of desk arms that keep their hand level by parallelograms: uArm Swift Pro and DexArm.

Three motors turn the base about the vertical and two links in a vertical plane, the forearm by a
rod and so independently of the upper arm: all angles are absolute. With upper arm a at elevation
α, forearm b at elevation φ and the hand's own offset (r₀, z₀),

    r = a cos α + b cos φ + r₀,    z = a sin α + b sin φ + z₀,    (x, y) = r (cos θ, sin θ)

A straight line in joint space is a curve of the hand, which deviates from the straight line between
its ends by about a tenth of its length. The controller's interpolation therefore matters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Joints = NDArray[np.float64]
"""Base θ, upper arm α, forearm φ (..., 3) [°]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Palletiser:
    """Lengths and joint ranges of one arm.

    Attributes
    ----------
    upper_mm, fore_mm : float
        Link lengths a and b [mm].
    hand_out_mm, hand_up_mm : float
        Working point relative to the forearm's end, plus the shoulder's position in the robot's
        frame: r₀ and z₀ [mm].
    base_deg, upper_deg, fore_deg, elbow_deg : tuple of 2 floats
        Least and greatest θ, α, φ and α − φ [°].
    """

    upper_mm: float
    fore_mm: float
    hand_out_mm: float
    hand_up_mm: float
    base_deg: tuple[float, float]
    upper_deg: tuple[float, float]
    fore_deg: tuple[float, float]
    elbow_deg: tuple[float, float]

    def position_mm(self, joints_deg: ArrayLike) -> NDArray[np.float64]:
        """Return the position of the hand.

        Parameters
        ----------
        joints_deg : array_like
            θ, α, φ (..., 3) [°].

        Returns
        -------
        ndarray
            X, Y, Z (..., 3) [mm].
        """
        base, upper, fore = np.moveaxis(np.radians(joints_deg), -1, 0)
        r = self.upper_mm * np.cos(upper) + self.fore_mm * np.cos(fore) + self.hand_out_mm
        z = self.upper_mm * np.sin(upper) + self.fore_mm * np.sin(fore) + self.hand_up_mm
        return np.stack([r * np.cos(base), r * np.sin(base), z], axis=-1)

    def joints_deg(self, position_mm: ArrayLike) -> Joints:
        """Return the joint angles for a position of the hand, elbow up.

        Parameters
        ----------
        position_mm : array_like
            X, Y, Z (..., 3) [mm].

        Returns
        -------
        ndarray
            θ, α, φ (..., 3) [°]; NaN out of reach.
        """
        x, y, z = np.moveaxis(np.asarray(position_mm, dtype=np.float64), -1, 0)
        out = np.hypot(x, y) - self.hand_out_mm
        up = z - self.hand_up_mm
        distance = np.maximum(np.hypot(out, up), 1e-9)  # the triangle degenerates at the shoulder
        elevation = np.arctan2(up, out)
        with np.errstate(invalid="ignore"):  # too far or too near: NaN
            above = np.arccos(_cosine(self.upper_mm, distance, self.fore_mm))
            below = np.arccos(_cosine(self.fore_mm, distance, self.upper_mm))
        upper, fore = elevation + above, elevation - below
        joints: Joints = np.degrees(np.stack([np.arctan2(y, x), upper, fore], axis=-1))
        joints[~self._within(joints)] = math.nan
        return joints

    def _within(self, joints: Joints) -> NDArray[np.bool_]:
        base, upper, fore = np.moveaxis(joints, -1, 0)
        ranges = (self.base_deg, self.upper_deg, self.fore_deg, self.elbow_deg)
        within = np.ones(base.shape, dtype=bool)
        for angle, (low, high) in zip((base, upper, fore, upper - fore), ranges, strict=True):
            within &= (angle >= low) & (angle <= high)
        return within


def _cosine(
    beside: float, also_beside: NDArray[np.float64], opposite: float
) -> NDArray[np.float64]:
    """Cosine of a triangle's angle between two sides."""
    return (beside**2 + also_beside**2 - opposite**2) / (2 * beside * also_beside)


UARM_SWIFT_PRO = Palletiser(
    upper_mm=142.07,
    fore_mm=158.81,
    hand_out_mm=13.2 + 56.65,
    hand_up_mm=107.4 - 74.55,
    base_deg=(-90.0, 90.0),
    upper_deg=(-4.0, 135.6),
    fore_deg=(-119.9, 4.0),
    elbow_deg=(29.0, 170.0),
)
"""With suction cup or gripper (`M2400 S0`), as in the vendor's firmware 4.10. X points forward."""

DEXARM = Palletiser(
    upper_mm=150.0,
    fore_mm=150.0,
    hand_out_mm=12.5 + 105.0,
    hand_up_mm=0.0,
    base_deg=(0.0, 180.0),
    upper_deg=(0.0, 106.2),
    fore_deg=(-98.7, 9.0),
    elbow_deg=(2.0, 152.0),
)
"""With the pneumatic module (`M888 P2`): lengths as in the vendor's firmware 2.4, joint ranges from
its table of reaches. Y points forward."""
