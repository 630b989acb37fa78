"""Position of the working plane in the robot's frame.

Section 3.4 of the paper (Cipolla, Hadfield & Hollinghurst 1994): the gripper visits points of a
plane, which registers the plane with the robot's own coordinates. The registration consists of a
homography from plane coordinates to the robot's X and Y, with the covariance of its entries, and
the plane's height.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.checks import covariance_array, finite_array, in_range
from fingerpost.errors import InvalidInputError
from fingerpost.homography import (
    transfer_jacobian_by_entries,
    transfer_jacobian_by_point,
    transfer_to_image,
    transfer_to_plane,
)
from fingerpost.robot.protocol import Pose
from fingerpost.silhouette import Capsule


def _exact() -> NDArray[np.float64]:
    return np.zeros((9, 9))


@dataclass(frozen=True, eq=False)
class RobotPlane:
    """Registration of the working plane with the robot's frame.

    Parameters
    ----------
    robot_from_plane : (3, 3)
        Homography from plane coordinates to the robot's X, Y [m], signed so that ``W > 0`` where
        the robot works (as `fingerpost.homography.estimate_image_from_plane` gives it for gripper
        positions in place of image points).
    height_m : float
        The plane's Z in the robot's frame, at X = Y = 0 [m].
    entries_covariance : (9, 9)
        Covariance of the entries of `robot_from_plane`, row by row; zero if known exactly.
    slope : (2,)
        Gradient of the plane's Z by the robot's X and Y [m per m]; a table is rarely level.
    pitch_rad, roll_rad, yaw_rad : float, optional
        Orientation of the gripper over the plane, as in `Pose` [rad].

    Raises
    ------
    InvalidInputError
        Other shapes, NaN, a singular homography, or a matrix that is not a covariance.
    """

    robot_from_plane: NDArray[np.float64]
    height_m: float
    entries_covariance: NDArray[np.float64] = field(default_factory=_exact)
    slope: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    pitch_rad: float | None = None
    roll_rad: float | None = None
    yaw_rad: float | None = None

    def __post_init__(self) -> None:
        T = finite_array(self.robot_from_plane, "robot_from_plane", (3, 3))
        if np.linalg.matrix_rank(T) < 3:
            raise InvalidInputError(f"robot_from_plane is singular: {T.tolist()}")
        Σ = covariance_array(self.entries_covariance, "entries_covariance", (9, 9))
        object.__setattr__(self, "robot_from_plane", T)
        object.__setattr__(self, "entries_covariance", Σ)
        object.__setattr__(self, "slope", finite_array(self.slope, "slope", (2,)))
        object.__setattr__(self, "height_m", in_range(self.height_m, "height_m", -np.inf, np.inf))

    @classmethod
    def same(cls, height_m: float, *, unit_m: float = 1.0) -> RobotPlane:
        """Registration of a plane whose coordinates are the robot's own X and Y.

        Parameters
        ----------
        height_m : float
            Its height [m].
        unit_m : float
            Its unit of length [m], > 0; 0.001 for millimetres.
        """
        unit_m = in_range(unit_m, "unit_m", np.finfo(np.float64).tiny)
        return cls(np.diag([unit_m, unit_m, 1.0]), height_m)

    def position_m(self, point: ArrayLike) -> NDArray[np.float64]:
        """Return the robot's X, Y [m] of points (..., 2) of the plane.

        Raises
        ------
        InvalidInputError
            A point with ``W ≤ 0``, outside the domain of the homography.
        """
        position = transfer_to_image(self.robot_from_plane, point)
        if np.isnan(position).any():
            raise InvalidInputError(
                f"{np.asarray(point)} is beyond the horizon of robot_from_plane"
            )
        return position

    def point(self, position_m: ArrayLike) -> NDArray[np.float64]:
        """Return the point of the plane (..., 2) under a robot's X, Y [m].

        Raises
        ------
        InvalidInputError
            Beyond the horizon of the homography.
        """
        point = transfer_to_plane(self.robot_from_plane, position_m)
        if np.isnan(point).any():
            raise InvalidInputError(
                f"{np.asarray(position_m)} m is beyond the horizon of robot_from_plane"
            )
        return point

    def covariance_m2(self, point: ArrayLike, covariance: ArrayLike) -> NDArray[np.float64]:
        """Return the covariance of a point's X, Y [m²], including that of the registration.

        Parameters
        ----------
        point : (2,)
            Point of the plane.
        covariance : (2, 2)
            Its covariance [plane units²].
        """
        covariance = covariance_array(covariance, "covariance", (2, 2))
        by_point = transfer_jacobian_by_point(self.robot_from_plane, point)
        by_entries = transfer_jacobian_by_entries(self.robot_from_plane, point)
        return np.asarray(
            by_point @ covariance @ by_point.T + by_entries @ self.entries_covariance @ by_entries.T
        )

    def pose(self, point: ArrayLike, above_m: float) -> Pose:
        """Return the pose of a gripper at a height [m] above a point (2,) of the plane."""
        x, y = self.position_m(finite_array(point, "point", (2,)))
        return Pose(
            float(x),
            float(y),
            self._surface_m(np.array([x, y])) + above_m,
            pitch_rad=self.pitch_rad,
            roll_rad=self.roll_rad,
            yaw_rad=self.yaw_rad,
        )

    def capsules(self, parts: Iterable[Capsule]) -> tuple[Capsule, ...]:
        """Transform capsules from the robot's frame [m] to plane coordinates and units.

        A capsule that ends beyond the horizon is left out: no view of the plane shows it.
        """
        known = []
        for part in parts:
            ends = np.array([part.start, part.end])
            feet = transfer_to_plane(self.robot_from_plane, ends[:, :2])
            if np.isnan(feet).any():
                continue
            stretch = transfer_jacobian_by_point(self.robot_from_plane, feet.mean(axis=0))
            unit_m = math.sqrt(abs(float(np.linalg.det(stretch))))
            heights = (ends[:, 2] - self.height_m - ends[:, :2] @ self.slope) / unit_m
            start, end = ((x, y, z) for (x, y), z in zip(feet.tolist(), heights, strict=True))
            known.append(Capsule(start, end, part.radius / unit_m))
        return tuple(known)

    def above_m(self, pose: Pose) -> float:
        """Return the height of a pose above the plane [m]; negative below."""
        return pose.z_m - self._surface_m(pose.position_m[:2])

    def _surface_m(self, position_m: NDArray[np.float64]) -> float:
        return self.height_m + float(self.slope @ position_m)
