"""Volume of an arm: capsules along its links, from the pose of its gripper.

The wrist is a tool's length behind the working point, the shoulder is above the base, and the elbow
between them is up: two links in the vertical plane through base axis and wrist. This is exact for
arms built like the Scorbot and approximate for most others; the radii allow for the difference.
Detections within the silhouette of this volume are not accepted as a hand.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fingerpost.robot.protocol import TOOL_DOWN_RAD, Limits, Pose
from fingerpost.silhouette import Capsule

Array = NDArray[np.float64]

CARRIED_M = 0.04
"""Extent of a gripped block beyond the working point [m]; the paper's is 30 mm."""

STEP_M = 0.03
"""Interval between the poses at which a moving arm is modelled [m]: half a gripper's radius."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmShape:
    """Dimensions of an arm.

    Attributes
    ----------
    base_height_m : float
        Height of the shoulder's axis above the robot's Z = 0 [m].
    shoulder_offset_m : float
        Distance from the base's axis to the shoulder's [m].
    upper_arm_m, forearm_m : float
        Distances from shoulder to elbow, and from there to the wrist [m].
    tool_m : float
        Distance from the wrist to the gripper's working point [m].
    hand_m : float
        Length of the gripper itself, from the working point [m].
    gripper_radius_m : float
        Radius around the gripper with its jaws open [m].
    link_radius_m, base_radius_m : float
        Radii around each link, and around the column that carries the shoulder [m].
    """

    base_height_m: float
    shoulder_offset_m: float
    upper_arm_m: float
    forearm_m: float
    tool_m: float
    hand_m: float = 0.12
    gripper_radius_m: float = 0.06
    link_radius_m: float = 0.06
    base_radius_m: float = 0.1

    @classmethod
    def of_limits(cls, limits: Limits | None) -> ArmShape:
        """Return typical dimensions of an arm of which only the limits are known.

        Upper arm and forearm reach the farthest corner of the limits, or `reach_m`.
        """
        reach_m = 0.8
        if limits is not None:
            corners = (math.hypot(x, y) for x in _ends(limits, 0) for y in _ends(limits, 1))
            reach_m = limits.reach_m or max(corners)
        return cls(
            base_height_m=0.15,
            shoulder_offset_m=0.0,
            upper_arm_m=reach_m / 2,
            forearm_m=reach_m / 2,
            tool_m=0.15,
        )

    def capsules(self, pose: Pose) -> tuple[Capsule, ...]:
        """Return the arm with its gripper at a pose, in the robot's frame [m].

        If the wrist is out of reach, the links are stretched; none is left out.
        """
        azimuth_rad = math.atan2(pose.y_m, pose.x_m)
        pitch_rad = TOOL_DOWN_RAD if pose.pitch_rad is None else pose.pitch_rad
        yaw_rad = azimuth_rad if pose.yaw_rad is None else pose.yaw_rad
        approach = np.array(
            [
                math.cos(pitch_rad) * math.cos(yaw_rad),
                math.cos(pitch_rad) * math.sin(yaw_rad),
                math.sin(pitch_rad),
            ]
        )
        point = pose.position_m
        wrist = point - self.tool_m * approach
        behind = point - min(self.hand_m, self.tool_m) * approach
        azimuth_rad = math.atan2(wrist[1], wrist[0])
        outwards = np.array([math.cos(azimuth_rad), math.sin(azimuth_rad), 0.0])
        shoulder = self.shoulder_offset_m * outwards + np.array([0.0, 0.0, self.base_height_m])
        elbow = self._elbow(shoulder, wrist, outwards)
        front = point + (CARRIED_M - self.gripper_radius_m) * approach
        links = [(front, behind, self.gripper_radius_m)]
        links += [
            (*ends, self.link_radius_m) for ends in pairwise((behind, wrist, elbow, shoulder))
        ]
        links += [(shoulder, np.zeros(3), self.base_radius_m)]
        return tuple(Capsule(_triple(start), _triple(end), r) for start, end, r in links)

    def _elbow(self, shoulder: Array, wrist: Array, outwards: Array) -> Array:
        """Return the elbow, up, in the vertical plane of shoulder and wrist."""
        way = wrist - shoulder
        out, up = float(way @ outwards), float(way[2])
        length = math.hypot(out, up)
        if length == 0.0:
            return np.asarray(shoulder + np.array([0.0, 0.0, self.upper_arm_m]))
        a, b = self.upper_arm_m, self.forearm_m
        cosine = (a**2 + length**2 - b**2) / (2 * a * length)
        lift_rad = math.acos(min(max(cosine, -1.0), 1.0))
        elevation_rad = math.atan2(up, out) + lift_rad
        return np.asarray(
            shoulder
            + a * (math.cos(elevation_rad) * outwards + np.array([0, 0, math.sin(elevation_rad)]))
        )


def along(poses: Sequence[Pose]) -> Iterator[Pose]:
    """Yield poses along straight lines from each given one to the next, `STEP_M` apart.

    Angles are those at the end of each line.
    """
    yield from poses[:1]
    for start, end in pairwise(poses):
        count = math.ceil(start.distance_m(end) / STEP_M)
        for k in range(1, count + 1):
            x, y, z = start.position_m + (k / count) * (end.position_m - start.position_m)
            yield Pose(float(x), float(y), float(z), end.pitch_rad, end.roll_rad, end.yaw_rad)


def _ends(limits: Limits, axis: int) -> tuple[float, float]:
    return limits.lower_m[axis], limits.upper_m[axis]


def _triple(point: Array) -> tuple[float, float, float]:
    x, y, z = point.tolist()
    return x, y, z
