"""UFACTORY xArm through its vendor's library `xarm-python-sdk` (extra `xarm`).

The library speaks millimetres, and radians if told to; every call answers with a code, 0 when all
is well, and errors of the arm stay until they are cleaned. Moves are sent without waiting, so that
a stop finds the line free. State 4 stops the arm and keeps it from moving until state 0.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from typing import Annotated, Any

import msgspec

from fingerpost.robot.arm import Arm, ArrivalRule, Turn
from fingerpost.robot.errors import (
    ConnectionLostError,
    GripperError,
    NotReadyError,
    OutOfReachError,
    RobotError,
    RobotFaultError,
    RobotTimeoutError,
)
from fingerpost.robot.extras import require
from fingerpost.robot.options import CheckedOptions
from fingerpost.robot.orientation import (
    fixed_angles,
    from_fixed_angles,
    pose_angles,
    tool_rotation,
)
from fingerpost.robot.protocol import Angle, GripperKind, Limits, Pose

MM_PER_M = 1000.0
GRIPPER_PULSES = 850
"""The gripper's position when open; 0 is closed."""

STOPPED_STATE = 4
READY_STATE = 0
POSITION_MODE = 0

_CODES: dict[int, tuple[type[RobotError], str]] = {
    -1: (ConnectionLostError, "not connected"),
    -2: (NotReadyError, "not enabled"),
    -6: (OutOfReachError, "outside the Cartesian limits"),
    -7: (OutOfReachError, "outside a joint's limits"),
    -8: (OutOfReachError, "out of range"),
    -9: (RobotFaultError, "emergency stop"),
    1: (RobotFaultError, "an error is not cleaned"),
    3: (RobotTimeoutError, "no answer"),
    8: (ConnectionLostError, "write failed"),
    9: (NotReadyError, "state not ready to move"),
    100: (RobotTimeoutError, "not finished in time"),
}
"""The library's codes that mean more than a fault, from its `APIState`."""

_WARNING_CODE = 2


class XarmOptions(CheckedOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How to use an xArm.

    Attributes
    ----------
    reach_m : float
        Reach of the model [m].
    lower_z_m : float
        The lowest permitted height [m].
    max_speed_m_s, acceleration_m_s2 : float
        Greatest speed, and acceleration of moves.
    gripper : bool
        UFACTORY's own gripper is mounted.
    gripper_opening_m : float
        Its widest opening [m].
    gripper_timeout_s : float
        Longest time that it may take [s].
    poll_s, stall_s : float
        How the end of a move is seen [s], as in `ArrivalRule`.
    """

    reach_m: Annotated[float, msgspec.Meta(gt=0, le=10)] = 0.7
    lower_z_m: float = 0.0
    max_speed_m_s: Annotated[float, msgspec.Meta(gt=0, le=10)] = 0.2
    acceleration_m_s2: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 1.0
    gripper: bool = True
    gripper_opening_m: Annotated[float, msgspec.Meta(gt=0, le=10)] = 0.085
    gripper_timeout_s: Annotated[float, msgspec.Meta(gt=0, le=3600)] = 5.0
    poll_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 0.02
    stall_s: Annotated[float, msgspec.Meta(gt=0, le=3600)] = 1.0


class Xarm(Arm):
    """An xArm.

    Parameters
    ----------
    host : str
        Its address.
    options : XarmOptions
        How to use it.
    limits : Limits, optional
        What it may be asked for; by default a half ball of `reach_m`.
    clock, sleep : callable
        Monotonic time [s], and a wait of so many seconds of it.

    Raises
    ------
    MissingExtraError
        `xarm-python-sdk` is not installed.
    """

    def __init__(
        self,
        host: str,
        options: XarmOptions | None = None,
        *,
        limits: Limits | None = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._options = options = options or XarmOptions()
        reach = options.reach_m
        super().__init__(
            limits
            or Limits(
                lower_m=(-reach, -reach, options.lower_z_m),
                upper_m=(reach, reach, reach),
                max_speed_m_s=options.max_speed_m_s,
                reach_m=reach,
                angles=frozenset(Angle),
                gripper=GripperKind.WIDTH if options.gripper else GripperKind.NONE,
                gripper_opening_m=options.gripper_opening_m if options.gripper else None,
            ),
            arrival=ArrivalRule(poll_s=options.poll_s, stall_s=options.stall_s),
            clock=clock,
            sleep=sleep,
        )
        self._host = host
        self._library = require("xarm.wrapper", "xarm")
        self._api: Any = None
        self._stopped = False

    def _open(self) -> None:
        try:
            self._api = self._library.XArmAPI(self._host, is_radian=True)
        except Exception as error:  # the library raises plain Exception when it cannot connect
            raise ConnectionLostError(f"{self._host}: {error}") from error
        self._send_stop()

    def _close(self) -> None:
        api, self._api = self._api, None
        if api is not None:
            with suppress(OSError):
                api.disconnect()

    def _home(self, turn: Turn, report: Callable[[str], None]) -> None:
        """Its encoders are absolute: homing enables the motors, and moves nothing."""
        self._check(turn)
        api = self._connected()
        api.clean_error()
        api.clean_warn()
        self._accept(api.motion_enable(True), "motion_enable")
        self._accept(api.set_mode(POSITION_MODE), "set_mode")
        self._accept(api.set_state(READY_STATE), "set_state")
        self._stopped = False
        if self._options.gripper:
            self._accept(api.set_gripper_enable(True), "set_gripper_enable", GripperError)
            self._accept(api.set_gripper_mode(0), "set_gripper_mode", GripperError)
        report("absolute encoders: no motion needed")

    def _start_move(self, pose: Pose, speed_m_s: float, turn: Turn) -> None:
        api = self._ready()
        x, y, z = (MM_PER_M * value for value in pose.position_m)
        if (angles := pose.angles()) is not None:
            roll, pitch, yaw = fixed_angles(tool_rotation(*angles))
        else:
            roll, pitch, yaw = self._position(api)[3:]
        codes: list[int] = []
        self._issue(
            lambda: codes.append(
                api.set_position(
                    x=x,
                    y=y,
                    z=z,
                    roll=roll,
                    pitch=pitch,
                    yaw=yaw,
                    speed=MM_PER_M * speed_m_s,
                    mvacc=MM_PER_M * self._options.acceleration_m_s2,
                    is_radian=True,
                    wait=False,
                )
            ),
            turn,
        )
        self._accept(codes[0], "set_position")

    def _read_pose(self, turn: Turn) -> Pose:
        self._check(turn)
        api = self._connected()
        if api.error_code:
            raise RobotFaultError(f"error C{api.error_code}", number=int(api.error_code))
        x, y, z, roll, pitch, yaw = self._position(api)
        up, about, azimuth = pose_angles(from_fixed_angles(roll, pitch, yaw))
        return Pose(
            x / MM_PER_M,
            y / MM_PER_M,
            z / MM_PER_M,
            pitch_rad=up,
            roll_rad=about,
            yaw_rad=azimuth,
        )

    def _send_stop(self) -> None:
        self._stopped = True
        api = self._connected()
        self._accept(api.set_state(STOPPED_STATE), "set_state")

    def _move_gripper(self, opening: float, turn: Turn) -> None:
        api = self._ready()
        codes: list[int] = []
        pulses = round(GRIPPER_PULSES * opening)
        self._issue(lambda: codes.append(api.set_gripper_position(pulses, wait=False)), turn)
        self._accept(codes[0], "set_gripper_position", GripperError)
        end_s = self._clock() + self._options.gripper_timeout_s
        previous = None
        while True:  # a gripper that holds something never gets to its goal: wait until it stands
            self._pause(0.1, turn)
            code, position = api.get_gripper_position()
            self._accept(code, "get_gripper_position", GripperError)
            if position == previous:
                return
            previous = position
            if self._clock() > end_s:
                raise GripperError(f"the gripper still moves at {position} pulses")

    def _ready(self) -> Any:
        """Return the library's arm, made ready again after a stop."""
        api = self._connected()
        if self._stopped:
            self._accept(api.set_state(READY_STATE), "set_state")
            self._stopped = False
        return api

    def _connected(self) -> Any:
        api = self._api
        if api is None or not api.connected:
            raise ConnectionLostError(f"{self._host}: not connected")
        return api

    def _position(self, api: Any) -> list[float]:
        code, values = api.get_position(is_radian=True)
        self._accept(code, "get_position")
        return [float(value) for value in values]

    def _accept(self, code: int, call: str, kind: type[RobotError] = RobotFaultError) -> None:
        """Raise what a code means; warnings are no failure."""
        if code in (0, _WARNING_CODE):
            return
        known, meaning = _CODES.get(code, (kind, "failed"))
        message = f"{call}: code {code}, {meaning}"
        if known is RobotFaultError:
            number = int(self._api.error_code or code) if self._api is not None else code
            raise RobotFaultError(message, number=number)
        raise known(message)
