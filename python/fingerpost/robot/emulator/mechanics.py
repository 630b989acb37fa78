"""Interpolation of an emulated G-code arm.

`G0` of an arm with joints is one straight line in joint space, and a curve of the hand. `G1` is a
chain of such lines between points on a straight line of the hand.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fingerpost.robot.motion import Path, Vector, straight
from fingerpost.robot.palletiser import DEXARM, UARM_SWIFT_PRO, Joints, Palletiser


@dataclass(frozen=True, slots=True)
class Run:
    """One motion.

    Attributes
    ----------
    path : Path
        Path of the hand [mm]; its length may be in another unit.
    speed, acceleration : float
        Speed and acceleration, in the unit of the path's length, per second and per second².
    pieces : int
        Number of blocks of the planner.
    whole : bool
        Whether it ends at its goal.
    """

    path: Path
    speed: float
    acceleration: float
    pieces: int = 1
    whole: bool = True


class Mechanics(Protocol):
    """An arm, and the interpolation of its controller."""

    home_mm: Vector
    """Home position: X, Y, Z [mm]."""

    def reaches(self, position_mm: Vector) -> bool:
        """Whether the hand can reach a position."""

    def rapid(self, start_mm: Vector, goal_mm: Vector, feed: float) -> Run:
        """Return the motion of `G0`."""

    def line(self, start_mm: Vector, goal_mm: Vector, feed: float) -> Run:
        """Return the motion of `G1`."""


class CartesianMechanics:
    """A machine with an axis for each of X, Y and Z; `F` is in mm/min, and `G0` is `G1`."""

    home_mm = np.array([200.0, 0.0, 150.0])
    REACH_MM = 320.0
    ACCELERATION_MM_S2 = 2000.0

    def reaches(self, position_mm: Vector) -> bool:
        """Whether a place is near enough."""
        return math.hypot(position_mm[0], position_mm[1]) <= self.REACH_MM

    def rapid(self, start_mm: Vector, goal_mm: Vector, feed: float) -> Run:
        """Go straight."""
        return self.line(start_mm, goal_mm, feed)

    def line(self, start_mm: Vector, goal_mm: Vector, feed: float) -> Run:
        """Go straight."""
        path = straight(start_mm, goal_mm, lengths=slice(0, 3))
        return Run(path, feed / 60, self.ACCELERATION_MM_S2)


class _Palletising:
    """An arm with joints; the meaning of `F` depends on its firmware."""

    def __init__(self, arm: Palletiser, home_mm: Vector) -> None:
        self.home_mm = home_mm
        self._arm = arm

    def reaches(self, position_mm: Vector) -> bool:
        """Whether the joints reach a place."""
        return not np.isnan(self._arm.joints_deg(position_mm)).any()

    def _joints_along(self, start_mm: Vector, goal_mm: Vector, pieces: int) -> Joints:
        """Return the joints at the ends of the pieces of a straight line of the hand.

        They are NaN out of reach.
        """
        shares = np.linspace(0.0, 1.0, pieces + 1)[:, None]
        return self._arm.joints_deg(start_mm + shares * (goal_mm - start_mm))

    def _chain(self, joints: Joints, lengths: Vector) -> Path:
        """Return the path through joint angles (N, 3), with linear interpolation.

        The lengths (N,) are measured from its start, in any unit.
        """

        def at(share: float) -> Vector:
            place = share * lengths[-1]
            now = [float(np.interp(place, lengths, joint)) for joint in joints.T]
            return self._arm.position_mm(now)

        return Path(at, self._arm.position_mm(joints[-1]), float(lengths[-1]))


def _turned_deg(joints: Joints) -> Vector:
    """Return the total rotation of the joints at each of a chain's points [°]."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(joints, axis=0), axis=1))])


class UarmMechanics(_Palletising):
    """uArm Swift Pro: `F` has the unit 80° of the joints per minute, at most 100 for `G1`."""

    UNIT_DEG = 80.0
    GREATEST_FEED = 100.0
    ACCELERATION_DEG_S2 = 1.3 * UNIT_DEG
    LEAST_PIECES = 10
    PIECES_PER_MM = 30.0
    """At `F1`; fewer in proportion when it is faster."""

    def __init__(self) -> None:
        super().__init__(UARM_SWIFT_PRO, np.array([200.0, 0.0, 150.0]))

    def rapid(self, start_mm: Vector, goal_mm: Vector, feed: float) -> Run:
        """Turn the joints from one end to the other."""
        return self._run(self._joints_along(start_mm, goal_mm, 1), feed)

    def line(self, start_mm: Vector, goal_mm: Vector, feed: float) -> Run:
        """Move straight, at a constant speed of the joints; parts out of reach are left out."""
        feed = min(feed, self.GREATEST_FEED)
        length_mm = math.dist(start_mm, goal_mm)
        pieces = max(self.LEAST_PIECES, int(length_mm * self.PIECES_PER_MM / feed))
        joints = self._joints_along(start_mm, goal_mm, pieces)
        return self._run(joints[~np.isnan(joints).any(axis=1)], feed)

    def _run(self, joints: Joints, feed: float) -> Run:
        path = self._chain(joints, _turned_deg(joints))
        return Run(path, feed * self.UNIT_DEG / 60, self.ACCELERATION_DEG_S2, len(joints) - 1)


class DexarmMechanics(_Palletising):
    """DexArm: `F` is in mm/min of the hand for `G1`, and in °/min of the joints for `G0`."""

    PIECES_PER_S = 200.0
    LEAST_PIECE_MM = 0.5
    ACCELERATION = 400.0
    """Acceleration of the hand and of the joints [mm/s², °/s²]."""

    def __init__(self) -> None:
        super().__init__(DEXARM, np.array([0.0, 300.0, 0.0]))

    def rapid(self, start_mm: Vector, goal_mm: Vector, feed: float) -> Run:
        """Turn the joints from one end to the other."""
        joints = self._joints_along(start_mm, goal_mm, 1)
        return Run(self._chain(joints, _turned_deg(joints)), feed / 60, self.ACCELERATION)

    def line(self, start_mm: Vector, goal_mm: Vector, feed: float) -> Run:
        """Move straight, at a constant speed of the hand, as far as the joints reach."""
        length_mm = math.dist(start_mm, goal_mm)
        pieces = min(self.PIECES_PER_S * length_mm * 60 / feed, length_mm / self.LEAST_PIECE_MM)
        joints = self._joints_along(start_mm, goal_mm, max(1, int(pieces)))
        lengths = np.linspace(0.0, length_mm, len(joints))
        beyond = np.isnan(joints).any(axis=1)
        count = int(np.argmax(beyond)) if beyond.any() else len(joints)
        path = self._chain(joints[:count], lengths[:count])
        return Run(path, feed / 60, self.ACCELERATION, len(joints) - 1, count == len(joints))
