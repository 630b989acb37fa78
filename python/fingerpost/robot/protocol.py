"""Common protocol of all robots, in metres, radians and seconds.

Arms differ in their units, in the angles of the gripper that they can set, and in how they report
arrival. `Robot` hides these differences. Any object with these methods is a robot; the drivers of
this package share their bookkeeping in `fingerpost.robot.arm.Arm`.

Frames and angles. Positions are in the robot's own base frame, z up. The gripper's approach
direction has elevation `pitch_rad` above the horizontal (−π/2 points straight down) and azimuth
`yaw_rad` about z; `roll_rad` turns the gripper about its approach direction:
R = Rz(yaw) · Ry(−pitch) · Rx(roll), with the approach direction as the gripper's own x axis. An
arm with fewer axes sets only some of them (`Limits.angles`); the others are None.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from types import TracebackType
from typing import Literal, Protocol, Self, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from fingerpost.errors import InvalidInputError
from fingerpost.robot.errors import GripperError, OutOfReachError

TOOL_DOWN_RAD = -math.pi / 2
"""The pitch of a gripper that points straight down [rad]."""


class Angle(StrEnum):
    """An angle of a gripper's orientation; the value is the name of its field in `Pose`."""

    PITCH = "pitch_rad"
    ROLL = "roll_rad"
    YAW = "yaw_rad"


@dataclass(frozen=True, slots=True)
class Pose:
    """Actual or commanded pose of the gripper in the robot's frame.

    Parameters
    ----------
    x_m, y_m, z_m : float
        Position of the gripper's working point [m]; finite.
    pitch_rad, roll_rad, yaw_rad : float, optional
        Angles as defined in this module's docstring [rad]. None in a command keeps the angle; None
        in a reading means that this arm does not set it.

    Raises
    ------
    InvalidInputError
        A value is not finite.
    """

    x_m: float
    y_m: float
    z_m: float
    pitch_rad: float | None = None
    roll_rad: float | None = None
    yaw_rad: float | None = None

    def __post_init__(self) -> None:
        for name in ("x_m", "y_m", "z_m", *Angle):
            value = getattr(self, name)
            if value is not None and not math.isfinite(value):
                raise InvalidInputError(f"pose: {name} is {value}; a finite number is needed")

    @property
    def position_m(self) -> NDArray[np.float64]:
        """Position as an array (3,) [m]."""
        return np.array([self.x_m, self.y_m, self.z_m])

    def distance_m(self, other: Pose) -> float:
        """Distance between the positions of two poses [m], without regard to angles."""
        return math.dist((self.x_m, self.y_m, self.z_m), (other.x_m, other.y_m, other.z_m))

    def at_height(self, z_m: float) -> Pose:
        """Return the same pose at another height [m]."""
        return replace(self, z_m=z_m)

    def angles(self) -> tuple[float, float, float] | None:
        """Return pitch, roll and yaw [rad] for an arm that sets them together; None keeps them.

        Raises
        ------
        InvalidInputError
            Only some of the three are given.
        """
        pitch, roll, yaw = self.pitch_rad, self.roll_rad, self.yaw_rad
        if pitch is not None and roll is not None and yaw is not None:
            return pitch, roll, yaw
        missing = [angle.value for angle in Angle if getattr(self, angle) is None]
        if len(missing) < len(Angle):
            raise InvalidInputError(
                f"pose: {', '.join(missing)} not given; this arm needs all three angles, or none "
                "to keep them"
            )
        return None

    def __str__(self) -> str:
        text = f"({self.x_m:.4f}, {self.y_m:.4f}, {self.z_m:.4f}) m"
        angles = [
            f"{angle.name.lower()} {math.degrees(value):.1f}°"
            for angle in Angle
            if (value := getattr(self, angle)) is not None
        ]
        return " ".join([text, *angles])


class GripperKind(StrEnum):
    """Commands of a gripper."""

    NONE = "none"
    OPEN_CLOSE = "open_close"
    WIDTH = "width"


GripperTarget: TypeAlias = float | Literal["open", "close"]
"""An opening [m], or one of the two ends."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Limits of the commands to a robot, which does not move without any.

    Parameters
    ----------
    lower_m, upper_m : tuple of 3 floats
        Corners of the box of permitted positions [m].
    max_speed_m_s : float
        Greatest speed of the gripper [m/s], > 0.
    min_speed_m_s : float
        Least speed that the arm can be set to [m/s], ≥ 0; a slower one is refused, because the arm
        would move faster.
    reach_m : float, optional
        Greatest distance from the base's vertical axis [m], > 0.
    min_reach_m : float
        Least distance from that axis [m], ≥ 0.
    angles : frozenset of Angle
        The angles that this arm can set; a pose with another is refused.
    gripper : GripperKind
        Commands of the gripper.
    gripper_opening_m : float, optional
        Widest opening [m]; needed for `GripperKind.WIDTH`.

    Raises
    ------
    InvalidInputError
        Not finite, lower above upper, a speed or reach that is not positive, or a width gripper
        without its widest opening.
    """

    lower_m: tuple[float, float, float]
    upper_m: tuple[float, float, float]
    max_speed_m_s: float
    min_speed_m_s: float = 0.0
    reach_m: float | None = None
    min_reach_m: float = 0.0
    angles: frozenset[Angle] = frozenset()
    gripper: GripperKind = GripperKind.NONE
    gripper_opening_m: float | None = None

    def __post_init__(self) -> None:
        for axis, low, high in zip("xyz", self.lower_m, self.upper_m, strict=True):
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise InvalidInputError(
                    f"limits: {axis} runs from {low} to {high} m; two finite numbers, the lower "
                    "one first, are needed"
                )
        positive = {"max_speed_m_s": self.max_speed_m_s, "reach_m": self.reach_m}
        if self.gripper is GripperKind.WIDTH and self.gripper_opening_m is None:
            raise InvalidInputError("limits: a width gripper needs gripper_opening_m [m]")
        positive["gripper_opening_m"] = self.gripper_opening_m
        for name, value in positive.items():
            if value is not None and not (math.isfinite(value) and value > 0):
                raise InvalidInputError(f"limits: {name} is {value}; a number above 0 is needed")
        if not 0 <= self.min_speed_m_s <= self.max_speed_m_s:
            raise InvalidInputError(
                f"limits: max_speed_m_s is {self.max_speed_m_s}; at least min_speed_m_s, "
                f"{self.min_speed_m_s}, is needed"
            )
        if not 0 <= self.min_reach_m < (self.reach_m or math.inf):
            raise InvalidInputError(
                f"limits: min_reach_m is {self.min_reach_m}; 0 up to reach_m is needed"
            )

    def check(self, pose: Pose) -> None:
        """Refuse a pose outside these limits.

        Raises
        ------
        OutOfReachError
            The pose lies outside the box or the reach; the message names the axis and the bound.
        InvalidInputError
            The pose sets an angle that this arm does not have.
        """
        for axis, value, low, high in zip(
            "xyz", pose.position_m, self.lower_m, self.upper_m, strict=True
        ):
            if not low <= value <= high:
                raise OutOfReachError(
                    f"{axis} = {value:.4f} m is outside the limits {low:g} to {high:g} m"
                )
        radius_m = math.hypot(pose.x_m, pose.y_m)
        if not self.min_reach_m <= radius_m <= (self.reach_m or math.inf):
            raise OutOfReachError(
                f"({pose.x_m:.4f}, {pose.y_m:.4f}) m lies {radius_m:.4f} m from the base axis; "
                f"from {self.min_reach_m:g} to {self.reach_m} m can be reached"
            )
        for angle in Angle:
            if getattr(pose, angle) is not None and angle not in self.angles:
                raise InvalidInputError(
                    f"pose: this arm cannot set {angle.value}; leave it None "
                    f"(it sets {', '.join(sorted(self.angles)) or 'no angle'})"
                )

    def speed(self, speed_m_s: float | None) -> float:
        """Return a speed reduced to the limit; None gives the limit itself.

        Raises
        ------
        InvalidInputError
            The speed is not a number above 0, or below the least speed of the arm.
        """
        if speed_m_s is None:
            return self.max_speed_m_s
        if not (math.isfinite(speed_m_s) and speed_m_s > 0):
            raise InvalidInputError(f"speed_m_s is {speed_m_s}; a number above 0 is needed")
        if speed_m_s < self.min_speed_m_s:
            raise InvalidInputError(
                f"speed_m_s is {speed_m_s:g}; this arm's least speed is {self.min_speed_m_s:g} m/s"
            )
        return min(speed_m_s, self.max_speed_m_s)

    def opening(self, target: GripperTarget) -> float:
        """Return a target as a share of the full opening: 0 closed … 1 open.

        Raises
        ------
        GripperError
            No gripper, or a width for one that only opens and closes.
        InvalidInputError
            A width outside 0 … `gripper_opening_m`, or another word than open and close.
        """
        if self.gripper is GripperKind.NONE:
            raise GripperError("this robot has no gripper")
        if isinstance(target, str):
            if target not in ("open", "close"):
                raise InvalidInputError(f"gripper: {target!r}; 'open', 'close' or metres is needed")
            return 1.0 if target == "open" else 0.0
        if self.gripper_opening_m is None or self.gripper is not GripperKind.WIDTH:
            raise GripperError("this gripper only opens and closes; it cannot be set to a width")
        if not 0 <= target <= self.gripper_opening_m:
            raise InvalidInputError(
                f"gripper: {target} m; a width from 0 to {self.gripper_opening_m:g} m is needed"
            )
        return target / self.gripper_opening_m


class RobotState(StrEnum):
    """State of the robot, by its last answer."""

    DISCONNECTED = "disconnected"
    NOT_HOMED = "not_homed"
    HOMING = "homing"
    IDLE = "idle"
    MOVING = "moving"
    FAULT = "fault"


@dataclass(frozen=True, slots=True)
class RobotStatus:
    """Status of a robot, known without a query.

    Attributes
    ----------
    state : RobotState
        Its state.
    homed : bool
        Whether its positions are valid.
    pose : Pose or None
        The last valid reading.
    fault : str or None
        The last fault, until homing clears it.
    """

    state: RobotState
    homed: bool
    pose: Pose | None
    fault: str | None


@dataclass(frozen=True, slots=True)
class HomingProgress:
    """Progress of homing.

    Attributes
    ----------
    elapsed_s, timeout_s : float
        Time since the command, and time limit [s].
    message : str
        The controller's last line, empty between lines.
    """

    elapsed_s: float
    timeout_s: float
    message: str


HomingCallback: TypeAlias = Callable[[HomingProgress], None]


@runtime_checkable
class Robot(Protocol):
    """A robot that moves to commanded poses.

    All methods except `stop`, `status` and `limits` may wait for the controller. Every wait ends
    with the answer, or with a `RobotError` within its time-out. Methods may be called from any
    thread; commands are executed in the order of the calls, except `stop`.
    """

    def connect(self) -> None:
        """Open the connection; stop any motion."""

    def close(self) -> None:
        """Stop and close the connection; harmless when closed."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...

    @property
    def limits(self) -> Limits | None:
        """Limits of commands; None if they have not been declared."""

    def home(self, progress: HomingCallback | None = None, *, timeout_s: float = 180.0) -> None:
        """Home every axis. The arm moves."""

    def pose(self) -> Pose:
        """Read the pose of the gripper."""

    def move_to(
        self,
        pose: Pose,
        *,
        speed_m_s: float | None = None,
        wait: bool = True,
        timeout_s: float | None = None,
    ) -> None:
        """Move in a straight line; with `wait`, return when the arm stands there."""

    def wait(self, *, timeout_s: float | None = None) -> None:
        """Return when the arm stands at the last commanded pose."""

    def gripper(self, target: GripperTarget) -> None:
        """Open, close, or set the gripper to a width [m]."""

    def stop(self) -> None:
        """Stop all motion at once and void every waiting command. Nothing can delay it."""

    def status(self) -> RobotStatus:
        """Return the known status, without waiting."""
