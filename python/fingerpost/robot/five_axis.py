"""Kinematics of arms with five joints: Scorbot, SO-100, SO-101.

The base turns about the vertical; shoulder, elbow and wrist pitch turn in the vertical plane of its
azimuth, each relative to the link before; the wrist rolls about the approach direction. With upper
arm a at elevation σ, forearm b at σ + ε, and tool c at the pitch φ = σ + ε + ω,

    r = r₀ + a cos σ + b cos(σ + ε) + c cos φ,    z = z₀ + a sin σ + b sin(σ + ε) + c sin φ

and (x, y) = r (cos θ, sin θ). A position with pitch and roll has one solution with the elbow up, in
closed form; one with any yaw has none, as yaw is the azimuth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fingerpost.robot.motion import Vector


@dataclass(frozen=True, slots=True, kw_only=True)
class FiveAxis:
    """Lengths and joint ranges of one arm; lengths have the unit of positions.

    Attributes
    ----------
    shoulder_height, shoulder_offset : float
        Position of the shoulder's axis, above Z = 0 and from the base's axis: z₀ and r₀.
    upper_arm, forearm, tool : float
        Lengths from shoulder to elbow, from there to the wrist's pitch axis, and on to the working
        point, which lies on the roll axis: a, b, c.
    ranges_rad : ndarray
        Least and greatest θ, σ, ε, ω and roll (5, 2) [rad].
    """

    shoulder_height: float
    shoulder_offset: float
    upper_arm: float
    forearm: float
    tool: float
    ranges_rad: Vector

    def place(self, joints_rad: Vector) -> Vector:
        """Return x, y, z, pitch, roll [rad] of joint angles θ, σ, ε, ω and roll [rad]."""
        base, shoulder, elbow, wrist, roll = joints_rad
        pitch = shoulder + elbow + wrist
        radius = (
            self.shoulder_offset
            + self.upper_arm * math.cos(shoulder)
            + self.forearm * math.cos(shoulder + elbow)
            + self.tool * math.cos(pitch)
        )
        height = (
            self.shoulder_height
            + self.upper_arm * math.sin(shoulder)
            + self.forearm * math.sin(shoulder + elbow)
            + self.tool * math.sin(pitch)
        )
        return np.array([radius * math.cos(base), radius * math.sin(base), height, pitch, roll])

    def joints_rad(self, place: Vector) -> Vector | None:
        """Return the joint angles of x, y, z, pitch, roll [rad], elbow up; None out of reach."""
        x, y, z, pitch, roll = place
        out = math.hypot(x, y) - self.tool * math.cos(pitch) - self.shoulder_offset
        up = z - self.tool * math.sin(pitch) - self.shoulder_height
        cosine = (out**2 + up**2 - self.upper_arm**2 - self.forearm**2) / (
            2 * self.upper_arm * self.forearm
        )
        if abs(cosine) > 1:
            return None
        elbow = -math.acos(cosine)
        shoulder = math.atan2(up, out) - math.atan2(
            self.forearm * math.sin(elbow), self.upper_arm + self.forearm * math.cos(elbow)
        )
        joints = np.array([math.atan2(y, x), shoulder, elbow, pitch - shoulder - elbow, roll])
        inside = (joints >= self.ranges_rad[:, 0]) & (joints <= self.ranges_rad[:, 1])
        return joints if bool(inside.all()) else None
