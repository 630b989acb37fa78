"""Universal Robots through their vendor-neutral library `ur_rtde` (extra `ur`).

`ur_rtde` speaks metres, radians and rotation vectors, and answers with a bool. Moves are always
sent asynchronously: a blocking `moveL` would keep the line from `stopL`. The arm has no gripper of
its own; one that hangs on a digital output can be named.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import msgspec
import numpy as np

from fingerpost.robot.arm import Arm, ArrivalRule, Turn
from fingerpost.robot.errors import (
    CommandRefusedError,
    ConnectionLostError,
    GripperError,
    OutOfReachError,
    RobotError,
    RobotFaultError,
)
from fingerpost.robot.extras import require
from fingerpost.robot.options import CheckedOptions
from fingerpost.robot.orientation import (
    pose_angles,
    rotation_matrix,
    rotation_vector,
    tool_rotation,
)
from fingerpost.robot.protocol import Angle, GripperKind, Limits, Pose

MODE_RUNNING = 7
"""Robot mode of an arm that is switched on with its brakes released."""


class UrOptions(CheckedOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How to use a Universal Robots arm.

    Attributes
    ----------
    reach_m : float
        Reach of the model: 0.5 (UR3), 0.85 (UR5), 1.3 (UR10) [m].
    lower_z_m : float
        The lowest permitted height [m].
    max_speed_m_s, acceleration_m_s2, stop_m_s2 : float
        Greatest speed, acceleration of moves, and deceleration of a stop.
    gripper_output : int or None
        Standard digital output that closes a gripper when high.
    gripper_s : float
        Time the gripper takes [s].
    poll_s, stall_s : float
        How the end of a move is seen [s], as in `ArrivalRule`.
    """

    reach_m: Annotated[float, msgspec.Meta(gt=0, le=10)] = 0.85
    lower_z_m: float = 0.0
    max_speed_m_s: Annotated[float, msgspec.Meta(gt=0, le=10)] = 0.25
    acceleration_m_s2: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 0.5
    stop_m_s2: Annotated[float, msgspec.Meta(ge=0.1, le=1000)] = 5.0
    gripper_output: Annotated[int, msgspec.Meta(ge=0, le=7)] | None = None
    gripper_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 1.0
    poll_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 0.02
    stall_s: Annotated[float, msgspec.Meta(gt=0, le=3600)] = 1.0


class UniversalRobot(Arm):
    """A Universal Robots arm.

    Parameters
    ----------
    host : str
        Its address.
    options : UrOptions
        How to use it.
    limits : Limits, optional
        What it may be asked for; by default a half ball of `reach_m`.
    clock, sleep : callable
        Monotonic time [s], and a wait of so many seconds of it.

    Raises
    ------
    MissingExtraError
        `ur_rtde` is not installed.
    """

    def __init__(
        self,
        host: str,
        options: UrOptions | None = None,
        *,
        limits: Limits | None = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._options = options = options or UrOptions()
        has_gripper = options.gripper_output is not None
        reach = options.reach_m
        super().__init__(
            limits
            or Limits(
                lower_m=(-reach, -reach, options.lower_z_m),
                upper_m=(reach, reach, reach),
                max_speed_m_s=options.max_speed_m_s,
                reach_m=reach,
                angles=frozenset(Angle),
                gripper=GripperKind.OPEN_CLOSE if has_gripper else GripperKind.NONE,
            ),
            arrival=ArrivalRule(poll_s=options.poll_s, stall_s=options.stall_s),
            clock=clock,
            sleep=sleep,
        )
        self._host = host
        self._control_library = require("rtde_control", "ur")
        self._receive_library = require("rtde_receive", "ur")
        self._io_library = require("rtde_io", "ur") if has_gripper else None
        self._control: Any = None
        self._receive: Any = None
        self._io: Any = None

    def _open(self) -> None:
        with self._translated():
            self._receive = self._receive_library.RTDEReceiveInterface(self._host)
            self._control = self._control_library.RTDEControlInterface(self._host)
            if self._io_library is not None:
                self._io = self._io_library.RTDEIOInterface(self._host)
            self._control.stopL(self._options.stop_m_s2, True)

    def _close(self) -> None:
        parts = (self._control, self._receive, self._io)
        self._control = self._receive = self._io = None
        for part in parts:
            if part is not None:
                with self._translated():
                    part.disconnect()

    def _home(self, turn: Turn, report: Callable[[str], None]) -> None:
        """Its encoders are absolute: homing only sees that the arm is ready, and moves nothing."""
        self._check(turn)
        self._see_to_faults()
        with self._translated():
            mode = self._receive.getRobotMode()
        if mode != MODE_RUNNING:
            raise RobotFaultError(
                f"robot mode {mode}: switch the arm on and release its brakes at the pendant",
                number=mode,
            )
        report("absolute encoders: no motion needed")

    def _start_move(self, pose: Pose, speed_m_s: float, turn: Turn) -> None:
        self._see_to_faults()
        with self._translated():
            if (angles := pose.angles()) is not None:
                turned = rotation_vector(tool_rotation(*angles)).tolist()
            else:
                turned = list(self._receive.getActualTCPPose())[3:]
            goal = [*pose.position_m.tolist(), *turned]
            if not self._control.isPoseWithinSafetyLimits(goal):
                raise OutOfReachError(f"{pose} is outside the arm's own safety limits")
            accepted: list[bool] = []
            self._issue(
                lambda: accepted.append(
                    self._control.moveL(goal, speed_m_s, self._options.acceleration_m_s2, True)
                ),
                turn,
            )
        if not accepted[0]:
            self._see_to_faults()
            raise CommandRefusedError("moveL was refused: is the arm in remote control?")

    def _read_pose(self, turn: Turn) -> Pose:
        self._check(turn)
        self._see_to_faults()
        with self._translated():
            x, y, z, *turned = (float(value) for value in self._receive.getActualTCPPose())
        pitch, roll, yaw = pose_angles(rotation_matrix(np.array(turned)))
        return Pose(x, y, z, pitch_rad=pitch, roll_rad=roll, yaw_rad=yaw)

    def _send_stop(self) -> None:
        control = self._control
        if control is None:
            raise ConnectionLostError(f"{self._host}: not connected")
        with self._translated():
            control.stopL(self._options.stop_m_s2, True)

    def _move_gripper(self, opening: float, turn: Turn) -> None:
        self._see_to_faults()
        done: list[bool] = []
        with self._translated():
            self._issue(
                lambda: done.append(
                    self._io.setStandardDigitalOut(self._options.gripper_output, opening < 0.5)
                ),
                turn,
            )
        if not done[0]:
            raise GripperError(f"digital output {self._options.gripper_output} was refused")
        self._pause(self._options.gripper_s, turn)

    def _see_to_faults(self) -> None:
        with self._translated():
            if not self._receive.isConnected():
                raise ConnectionLostError(f"{self._host}: connection lost")
            if self._receive.isEmergencyStopped():
                raise RobotFaultError("emergency stop: release it at the pendant")
            if self._receive.isProtectiveStopped():
                raise RobotFaultError("protective stop: unlock it at the pendant")

    @contextmanager
    def _translated(self) -> Iterator[None]:
        """Turn what the library raises into a lost connection."""
        try:
            yield
        except RobotError:
            raise
        except (RuntimeError, OSError, AttributeError) as error:
            raise ConnectionLostError(f"{self._host}: {error}") from error
