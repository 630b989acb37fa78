"""Conversion between a `Pose`'s angles and the rotation vectors or fixed angles of six-axis arms.

A `Pose` describes the gripper by its approach direction, R = Rz(yaw) · Ry(−pitch) · Rx(roll) with
the approach along the gripper's own x axis. Six-axis arms have their tool's z axis along the
approach. Both frames share their y axis; `GRIPPER_FROM_TOOL` turns one into the other.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

GRIPPER_FROM_TOOL = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Axes of the tool frame in the gripper frame: the tool's z is the gripper's x."""

GIMBAL_RAD = 1e-6
"""Angle from the vertical below which roll and yaw have the same axis: yaw is set to 0 then."""


def tool_rotation(pitch_rad: float, roll_rad: float, yaw_rad: float) -> NDArray[np.float64]:
    """Return the rotation robot_from_tool (3, 3) of a pose's three angles [rad]."""
    elevation = -pitch_rad
    robot_from_gripper = _about("z", yaw_rad) @ _about("y", elevation) @ _about("x", roll_rad)
    return np.asarray(robot_from_gripper @ GRIPPER_FROM_TOOL)


def pose_angles(robot_from_tool: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return pitch, roll and yaw [rad] of a rotation (3, 3); straight up or down, yaw is 0."""
    R = robot_from_tool @ GRIPPER_FROM_TOOL.T
    pitch = math.asin(max(-1.0, min(1.0, R[2, 0])))
    if math.hypot(R[0, 0], R[1, 0]) < GIMBAL_RAD:
        return pitch, math.atan2(-R[0, 1] * math.copysign(1.0, pitch), R[1, 1]), 0.0
    return pitch, math.atan2(R[2, 1], R[2, 2]), math.atan2(R[1, 0], R[0, 0])


def rotation_vector(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return axis times angle (3,) [rad] of a rotation (3, 3); the angle is in 0 … π."""
    w, x, y, z = quaternion(R)
    sine = math.sqrt(x * x + y * y + z * z)
    if sine < 1e-12:
        return 2 * np.array([x, y, z])
    return 2 * math.atan2(sine, w) / sine * np.array([x, y, z])


def quaternion(R: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Return w ≥ 0, x, y, z of a rotation (3, 3).

    Computed from the largest of the four, so that half a turn is exact as well.
    """
    squares = np.array(
        [
            1 + R[0, 0] + R[1, 1] + R[2, 2],
            1 + R[0, 0] - R[1, 1] - R[2, 2],
            1 - R[0, 0] + R[1, 1] - R[2, 2],
            1 - R[0, 0] - R[1, 1] + R[2, 2],
        ]
    )
    rows = np.array(
        [
            [squares[0], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], squares[1], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]],
            [R[0, 2] - R[2, 0], R[0, 1] + R[1, 0], squares[2], R[1, 2] + R[2, 1]],
            [R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], squares[3]],
        ]
    )
    q = rows[int(np.argmax(squares))]
    q = q / np.linalg.norm(q) * (1.0 if q[0] >= 0 else -1.0)
    return float(q[0]), float(q[1]), float(q[2]), float(q[3])


def rotation_from_quaternion(q: tuple[float, float, float, float]) -> NDArray[np.float64]:
    """Return the rotation (3, 3) of w, x, y, z, of any length but 0; NaN for that."""
    w, *vector = q
    sine = math.sqrt(sum(value * value for value in vector))
    if sine == 0:
        return np.eye(3) if w != 0 else np.full((3, 3), math.nan)
    return rotation_matrix(2 * math.atan2(sine, w) / sine * np.array(vector))


def rotation_matrix(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation (3, 3) about a vector (3,) by its length [rad] (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * K @ K)


def fixed_angles(R: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return roll, pitch, yaw [rad] about the fixed axes: R = Rz(yaw) · Ry(pitch) · Rx(roll)."""
    pitch = -math.asin(max(-1.0, min(1.0, R[2, 0])))
    if math.hypot(R[0, 0], R[1, 0]) < GIMBAL_RAD:
        return math.atan2(R[0, 1] * math.copysign(1.0, pitch), R[1, 1]), pitch, 0.0
    return math.atan2(R[2, 1], R[2, 2]), pitch, math.atan2(R[1, 0], R[0, 0])


def from_fixed_angles(roll_rad: float, pitch_rad: float, yaw_rad: float) -> NDArray[np.float64]:
    """Return Rz(yaw) · Ry(pitch) · Rx(roll) (3, 3)."""
    return _about("z", yaw_rad) @ _about("y", pitch_rad) @ _about("x", roll_rad)


def angle_between(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Return the angle of the turn from one rotation (3, 3) to another [rad], 0 … π."""
    cosine = (float(np.trace(first.T @ second)) - 1) / 2
    return math.acos(max(-1.0, min(1.0, cosine)))


def _about(axis: str, angle: float) -> NDArray[np.float64]:
    return rotation_matrix(angle * np.eye(3)["xyz".index(axis)])
