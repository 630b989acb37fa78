"""A simulated robot, which moves along straight lines at its speed, on the given clock.

For demonstrations and tests of guidance. It implements the whole protocol, including homing and
limits, but no particular arm; for the dialogue of one, see `fingerpost.robot.emulator`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from fingerpost.robot.arm import Arm, ArrivalRule, Turn
from fingerpost.robot.motion import MotionQueue, straight
from fingerpost.robot.options import CheckedOptions
from fingerpost.robot.protocol import TOOL_DOWN_RAD, Angle, GripperKind, Limits, Pose

HOME = (0.3, 0.0, 0.3, TOOL_DOWN_RAD, 0.0)
"""Pose after homing: x, y, z [m], pitch, roll [rad]."""

SIMULATED_LIMITS = Limits(
    lower_m=(-0.7, -0.7, 0.0),
    upper_m=(0.7, 0.7, 0.6),
    max_speed_m_s=0.5,
    angles=frozenset({Angle.PITCH, Angle.ROLL}),
    gripper=GripperKind.WIDTH,
    gripper_opening_m=0.08,
)


class SimulatedOptions(CheckedOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of a simulated robot.

    Attributes
    ----------
    acceleration_m_s2 : float
        Acceleration of every move [m/s²].
    homing_s, gripper_s : float
        Durations of homing and of the gripper's motion [s].
    """

    acceleration_m_s2: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 2.0
    homing_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 1.0
    gripper_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 0.3


class SimulatedRobot(Arm):
    """A simulated robot.

    Parameters
    ----------
    options : SimulatedOptions
        Its options.
    limits : Limits
        Limits of commands.
    clock, sleep : callable
        Monotonic time [s], and a wait for a time on that clock [s].
    """

    def __init__(
        self,
        options: SimulatedOptions | None = None,
        *,
        limits: Limits = SIMULATED_LIMITS,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        rule = ArrivalRule(poll_s=0.01, still_m=0.0, still_rad=0.0)  # its readings are exact
        super().__init__(limits, arrival=rule, clock=clock, sleep=sleep)
        self._options = options or SimulatedOptions()
        self._motion = MotionQueue(np.array(HOME))
        self._opening = 1.0

    @property
    def opening(self) -> float:
        """Opening of the gripper: 0 closed … 1 open."""
        return self._opening

    @property
    def position(self) -> NDArray[np.float64]:
        """Position of the gripper, homed or not: x, y, z [m], pitch, roll [rad]."""
        return self._motion.position(self._clock())

    def _open(self) -> None:
        self._motion.abort(self._clock())

    def _close(self) -> None:
        pass

    def _home(self, turn: Turn, report: Callable[[str], None]) -> None:
        report("homing")
        self._pause(self._options.homing_s, turn)
        self._motion = MotionQueue(np.array(HOME))

    def _start_move(self, pose: Pose, speed_m_s: float, turn: Turn) -> None:
        goal = self._motion.end.copy()
        goal[:3] = pose.position_m
        for place, angle in ((3, pose.pitch_rad), (4, pose.roll_rad)):
            if angle is not None:
                goal[place] = angle
        path = straight(self._motion.end, goal, lengths=slice(0, 3))
        acceleration = self._options.acceleration_m_s2

        def start() -> None:
            self._motion.add(path, speed_m_s, acceleration, self._clock())

        self._issue(start, turn)

    def _read_pose(self, turn: Turn) -> Pose:
        self._check(turn)
        x, y, z, pitch, roll = (float(value) for value in self.position)
        return Pose(x, y, z, pitch_rad=pitch, roll_rad=math.remainder(roll, 2 * math.pi))

    def _send_stop(self) -> None:
        self._motion.abort(self._clock())

    def _move_gripper(self, opening: float, turn: Turn) -> None:
        self._pause(self._options.gripper_s, turn)
        self._opening = opening
