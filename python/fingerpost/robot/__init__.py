"""Robots that move to the indicated point.

`open_robot` makes one by name. All of them implement `Robot`: metres, radians, a typed error for
every failure, and a `stop` that nothing delays. `Guard` passes only safe commands, `Follower`
follows the hand, and `PickPlace` carries a block. The common part of the drivers is in
`fingerpost.robot.arm`; emulated controllers for tests are in `fingerpost.robot.emulator`.
"""

from fingerpost.robot.errors import (
    CommandRefusedError,
    ConnectionLostError,
    GarbledReplyError,
    GripperError,
    HomingError,
    NotArmedError,
    NotArrivedError,
    NotHomedError,
    NotReadyError,
    OutOfReachError,
    PortInUseError,
    RefusedError,
    RobotError,
    RobotFaultError,
    RobotTimeoutError,
    StopFailedError,
    StoppedError,
)
from fingerpost.robot.follow import (
    DwellSelector,
    Follower,
    FollowOptions,
    FollowReport,
    FollowState,
    Selection,
)
from fingerpost.robot.guard import CommandRecord, Guard, GuardOptions, Presence
from fingerpost.robot.pick_place import PickPlace, PickPlaceOptions, Step, check_heights
from fingerpost.robot.plane import RobotPlane
from fingerpost.robot.protocol import (
    TOOL_DOWN_RAD,
    Angle,
    GripperKind,
    HomingProgress,
    Limits,
    Pose,
    Robot,
    RobotState,
    RobotStatus,
)
from fingerpost.robot.region import SafeRegion
from fingerpost.robot.registry import ENTRY_POINT_GROUP, open_robot, robot_names
from fingerpost.robot.simulated import SimulatedRobot
from fingerpost.robot.smoothing import OneEuroFilter

__all__ = [
    "ENTRY_POINT_GROUP",
    "TOOL_DOWN_RAD",
    "Angle",
    "CommandRecord",
    "CommandRefusedError",
    "ConnectionLostError",
    "DwellSelector",
    "FollowOptions",
    "FollowReport",
    "FollowState",
    "Follower",
    "GarbledReplyError",
    "GripperError",
    "GripperKind",
    "Guard",
    "GuardOptions",
    "HomingError",
    "HomingProgress",
    "Limits",
    "NotArmedError",
    "NotArrivedError",
    "NotHomedError",
    "NotReadyError",
    "OneEuroFilter",
    "OutOfReachError",
    "PickPlace",
    "PickPlaceOptions",
    "PortInUseError",
    "Pose",
    "Presence",
    "RefusedError",
    "Robot",
    "RobotError",
    "RobotFaultError",
    "RobotPlane",
    "RobotState",
    "RobotStatus",
    "RobotTimeoutError",
    "SafeRegion",
    "Selection",
    "SimulatedRobot",
    "Step",
    "StopFailedError",
    "StoppedError",
    "check_heights",
    "open_robot",
    "robot_names",
]
