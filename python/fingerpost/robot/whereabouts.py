"""Possible positions of an arm, from its last reading and the goals sent since."""

from __future__ import annotations

from collections import deque

from fingerpost.robot.plane import RobotPlane
from fingerpost.robot.protocol import Pose, Robot
from fingerpost.robot.shape import ArmShape, along
from fingerpost.silhouette import Capsule

GOALS_KEPT = 2
"""Number of goals to which the arm may be moving: a stride is sent before the last one is done."""

READINGS_KEPT = 2
"""Number of the driver's readings of a moving arm of which the oldest counts: a picture may be
older than the newest."""


class Whereabouts:
    """Possible positions of one arm.

    Parameters
    ----------
    robot : Robot
        The robot; its dimensions are `robot.shape`, if it has one, else typical for its limits.
    plane : RobotPlane
        Position of the plane in its frame.
    """

    def __init__(self, robot: Robot, plane: RobotPlane) -> None:
        self._robot = robot
        self._plane = plane
        self._read: Pose | None = None
        self._goals: deque[Pose] = deque(maxlen=GOALS_KEPT)
        # The driver's readings, of which the first one dates from before the motion.
        self._readings: deque[Pose | None] = deque(maxlen=1 + READINGS_KEPT)

    @property
    def pose(self) -> Pose | None:
        """Last reading, or the goal that the arm has reached since; None before any."""
        return self._read

    @property
    def is_doubtful(self) -> bool:
        """Whether the arm may be anywhere on the path to a goal."""
        return bool(self._goals)

    def read(self, pose: Pose, *, moving: bool) -> None:
        """Store a reading; a stopped arm no longer moves to its goals."""
        self._read = pose
        if not moving:
            self._goals.clear()

    def sent(self, goal: Pose) -> None:
        """Add a goal to which the arm is sent."""
        self._readings = deque([self._driver_reading()], maxlen=1 + READINGS_KEPT)
        self._goals.append(goal)

    def arrived(self) -> None:
        """Mark the arm as standing at its last goal."""
        if self._goals:
            self._read = self._goals[-1]
            self._goals.clear()

    def body(self) -> tuple[Capsule, ...]:
        """Return the volume that the arm may occupy, in plane coordinates; empty before a reading.

        It includes the arm with its gripper anywhere on the path from the last reading to goals. A
        driver that waits for an arrival takes readings as well.
        """
        # Copied first: another thread changes the goals.
        goals = tuple(self._goals)
        passed = self._passed() if goals else self._read
        poses = [pose for pose in (passed, *goals) if pose is not None]
        shape = getattr(self._robot, "shape", None) or ArmShape.of_limits(self._robot.limits)
        return self._plane.capsules(part for pose in along(poses) for part in shape.capsules(pose))

    def _passed(self) -> Pose | None:
        """Return the latest pose that a moving arm has certainly passed."""
        readings, newest = self._readings, self._driver_reading()
        if newest is not None and newest != readings[-1]:
            readings.append(newest)
        return readings[1] if len(readings) > READINGS_KEPT else self._read

    def _driver_reading(self) -> Pose | None:
        """Return the driver's last reading; None without one, or from a plug-in that fails."""
        try:
            return self._robot.status().pose
        except Exception:  # the guard's watch reports it
            return None
