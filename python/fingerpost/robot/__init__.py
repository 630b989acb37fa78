"""Robots that go where the hand points.

`open_robot` makes one by name; every one of them is a `Robot`: metres, radians, a typed error for
everything that can go wrong, and a `stop` that nothing delays. `Guard` lets pass only what is safe,
`Follower` follows the hand, and `PickPlace` carries a block. What goes on inside a driver is in
`fingerpost.robot.arm`; emulated controllers to try it on are in `fingerpost.robot.emulator`.
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
