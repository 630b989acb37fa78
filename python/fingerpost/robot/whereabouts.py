"""Where an arm may be now, from its last reading and from where it has been sent since."""

from __future__ import annotations

from collections import deque

from fingerpost.robot.plane import RobotPlane
from fingerpost.robot.protocol import Pose, Robot
from fingerpost.robot.shape import ArmShape, along
from fingerpost.silhouette import Capsule

GOALS_KEPT = 2
"""The arm is on its way to one of so many goals: a stride is sent before the last one is done."""


class Whereabouts:
    """Where one arm may be.

    Parameters
    ----------
    robot : Robot
        Its build is `robot.shape`, where it has one; else the usual one for its limits.
    plane : RobotPlane
        Where the plane lies for it.
    """

    def __init__(self, robot: Robot, plane: RobotPlane) -> None:
        self._robot = robot
        self._plane = plane
        self._read: Pose | None = None
        self._goals: deque[Pose] = deque(maxlen=GOALS_KEPT)

    @property
    def pose(self) -> Pose | None:
        """The last reading, or the goal at which the arm has arrived since; None before."""
        return self._read

    @property
    def is_doubtful(self) -> bool:
        """Whether the arm may be anywhere on its way to a goal."""
        return bool(self._goals)

    def read(self, pose: Pose, *, moving: bool) -> None:
        """Take a reading; an arm that has been stopped goes to none of its goals."""
        self._read = pose
        if not moving:
            self._goals.clear()

    def sent(self, goal: Pose) -> None:
        """Take it that the arm is being sent to a goal."""
        self._goals.append(goal)

    def arrived(self) -> None:
        """Take it that the arm stands at its last goal."""
        if self._goals:
            self._read = self._goals[-1]
            self._goals.clear()

    def body(self) -> tuple[Capsule, ...]:
        """Return the room that the arm may take up, in plane coordinates; empty before a reading.

        That is the arm with its gripper anywhere on the way from the last reading to its goals.
        """
        # Copied at once: the goals change in another thread.
        poses = [pose for pose in (self._read, *tuple(self._goals)) if pose is not None]
        shape = getattr(self._robot, "shape", None) or ArmShape.of_limits(self._robot.limits)
        return self._plane.capsules(part for pose in along(poses) for part in shape.capsules(pose))
