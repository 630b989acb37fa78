"""SO-100 and SO-101, 3D-printed arms with six Feetech servos, supported by LeRobot.

Five servos drive the arm's joints and the sixth its gripper. The driver streams joint positions
(`fingerpost.robot.streaming`) by closed-form kinematics (`fingerpost.robot.five_axis`) for a
straight line of the gripper. Lengths are from the arm's own URDF (TheRobotStudio/SO-ARM100,
`so101_new_calib.urdf` and `so100.urdf`), whose zero is the middle of each joint's range, as in
LeRobot's calibration. The frame has its origin on the table under the base's axis, x ahead of the
arm and y to its left.

A stop writes the last measured position as every joint's goal: the arm stands, with its torque on.
Nothing is sent to servos without torque until homing switches it on.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from fingerpost.errors import InvalidInputError
from fingerpost.robot import feetech
from fingerpost.robot.arm import ArrivalRule, Turn
from fingerpost.robot.errors import (
    CommandRefusedError,
    ConnectionLostError,
    GripperError,
    OutOfReachError,
)
from fingerpost.robot.feetech import COUNTS_PER_TURN, ServoBus, signed, two_bytes
from fingerpost.robot.five_axis import FiveAxis
from fingerpost.robot.motion import Path as Way
from fingerpost.robot.motion import Vector
from fingerpost.robot.options import CheckedOptions
from fingerpost.robot.protocol import Angle, GripperKind, Limits, Pose
from fingerpost.robot.serial_line import SerialLine, Tap
from fingerpost.robot.shape import ArmShape
from fingerpost.robot.streaming import StreamedArm

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
GRIPPER = "gripper"

BAUD = 1_000_000
"""The servos' factory setting [bit/s]."""

CHECKED_M, CHECKED_RAD = 0.005, 0.05
"""Interval at which a path is checked before the arm moves along it [m, rad]."""

LEVER_M = 0.1
"""Lever that converts rates of pitch and roll to the gripper's speed [m]: about its length."""

GRIPPER_SPEED = 1000
"""Speed of the gripper's servo [counts/s]: it opens or closes within 1.5 s."""

GRIPPER_STILL_S = 0.2
"""Time without motion after which a gripper stands [s]."""

GRIPPER_NEAR = 20
"""Greatest difference of equal readings of the gripper [counts]: 0.5 mm at its tip."""

GRIPPER_TORQUE = 500
"""The gripper's share of its greatest torque [0.1 %], as LeRobot sets it."""

SERVO_ACCELERATION = 254
"""Steepest ramp of the servo itself: the stream makes the ramps."""

ZERO_FOREARM_M = (0.1349, 0.0052)
ZERO_UPPER_ARM_M = (0.028, 0.11257)
"""Forearm and upper arm at zero of all joints, ahead and up [m]; the same for both arms."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Build:
    """Differences between SO-100 and SO-101.

    Attributes
    ----------
    name : str
        Its name in URLs.
    shoulder_height_m, shoulder_offset_m : float
        Position of the shoulder's axis, above the table and ahead of the base's axis [m].
    tool_m : float
        Distance from the wrist's pitch axis to the point between the tips of the jaws [m].
    """

    name: str
    shoulder_height_m: float
    shoulder_offset_m: float
    tool_m: float


SO101 = Build(
    name="so101", shoulder_height_m=0.1166, shoulder_offset_m=0.0303992, tool_m=0.0611 + 0.0981274
)
SO100 = Build(
    name="so100", shoulder_height_m=0.119, shoulder_offset_m=0.0306, tool_m=0.0601 + 0.0981274
)

_UPPER_RAD = math.atan2(ZERO_UPPER_ARM_M[1], ZERO_UPPER_ARM_M[0])
_FORE_RAD = math.atan2(ZERO_FOREARM_M[1], ZERO_FOREARM_M[0])

ZERO_RAD = np.array([0.0, _UPPER_RAD, _FORE_RAD - _UPPER_RAD, -_FORE_RAD, 0.0])
"""Azimuth, elevations and roll (5,) [rad], as in `FiveAxis`, at zero of all joints; each decreases
as its servo's position increases."""


class ServoCalibration(msgspec.Struct, frozen=True):
    """LeRobot's calibration of one servo.

    Attributes
    ----------
    id : int
        Its number on the bus.
    homing_offset : int
        Offset that it subtracts from its encoder's reading [counts].
    range_min, range_max : int
        The ends of the joint's range, as positions [counts].
    """

    id: Annotated[int, msgspec.Meta(ge=0, le=252)]
    homing_offset: Annotated[int, msgspec.Meta(ge=-2047, le=2047)]
    range_min: Annotated[int, msgspec.Meta(ge=0, lt=COUNTS_PER_TURN)]
    range_max: Annotated[int, msgspec.Meta(ge=0, lt=COUNTS_PER_TURN)]

    @property
    def middle(self) -> float:
        """The middle of its range [counts]."""
        return (self.range_min + self.range_max) / 2


def read_calibration(path: str) -> dict[str, ServoCalibration]:
    """Read LeRobot's calibration of an arm.

    Parameters
    ----------
    path : str
        A JSON file, as `lerobot-calibrate` writes it.

    Returns
    -------
    dict
        Calibration of each of the arm's servos, by name.

    Raises
    ------
    InvalidInputError
        No such file, or not of such an arm; the message says what is wrong.
    """
    try:
        text = Path(path).expanduser().read_bytes()
        found = msgspec.json.decode(text, type=dict[str, ServoCalibration])
    except (OSError, msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise InvalidInputError(
            f"calibration={path}: {error}; the JSON file that lerobot-calibrate writes is needed"
        ) from error
    missing = [name for name in (*JOINTS, GRIPPER) if name not in found]
    if missing:
        raise InvalidInputError(
            f"calibration={path}: {', '.join(missing)} missing; the file of an SO-100 or SO-101 "
            "follower is needed"
        )
    servos = {name: found[name] for name in (*JOINTS, GRIPPER)}
    for name, servo in servos.items():
        if servo.range_min >= servo.range_max:
            raise InvalidInputError(
                f"calibration={path}: {name} ranges from {servo.range_min} to {servo.range_max}; "
                "the lower end first, so calibrate anew"
            )
    if len({servo.id for servo in servos.values()}) < len(servos):
        raise InvalidInputError(f"calibration={path}: two servos have one id; calibrate anew")
    return servos


class SoArmOptions(CheckedOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of an SO-100 or SO-101.

    Attributes
    ----------
    calibration : str
        LeRobot's calibration file of this arm.
    lower_z_m : float
        The lowest permitted height [m].
    max_speed_m_s, acceleration_m_s2 : float
        Greatest speed, and acceleration of moves.
    max_joint_rad_s : float
        Greatest speed of a joint [rad/s].
    near_m : float
        Distance from its goal at which the arm has arrived [m]: it sags by its own weight.
    rate_hz : float
        Rate of positions [Hz].
    baud : int
        Bits per second.
    reply_s : float
        Longest time to one servo's answer [s].
    gripper_timeout_s : float
        Time limit of the gripper's motion [s].
    poll_s, stall_s : float
        Parameters of the end of a move [s], as in `ArrivalRule`.
    """

    calibration: str
    lower_z_m: float = 0.0
    max_speed_m_s: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.15
    acceleration_m_s2: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 0.5
    max_joint_rad_s: Annotated[float, msgspec.Meta(gt=0, le=5)] = 2.0
    near_m: Annotated[float, msgspec.Meta(gt=0, le=0.1)] = 0.01
    rate_hz: Annotated[float, msgspec.Meta(ge=5, le=200)] = 50.0
    baud: Annotated[int, msgspec.Meta(ge=38_400, le=BAUD)] = BAUD
    reply_s: Annotated[float, msgspec.Meta(gt=0, le=60)] = 0.1
    gripper_timeout_s: Annotated[float, msgspec.Meta(gt=0, le=3600)] = 5.0
    poll_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 0.02
    stall_s: Annotated[float, msgspec.Meta(gt=0, le=3600)] = 1.5


class SoArm(StreamedArm):
    """An SO-100 or SO-101.

    Parameters
    ----------
    url : str
        Serial device, `socket://host:port` or `rfc2217://host:port`.
    build : Build
        The type of arm.
    options : SoArmOptions
        Its options.
    limits : Limits, optional
        Limits of commands; by default a half ball of its reach.
    tap : callable, optional
        Called with every transfer, `tap("out" or "in", data)`.
    clock, sleep : callable
        Monotonic time [s], and a wait for a time on that clock [s].

    Raises
    ------
    InvalidInputError
        The calibration cannot be read.
    MissingExtraError
        `feetech-servo-sdk` is not installed.
    """

    def __init__(
        self,
        url: str,
        build: Build,
        options: SoArmOptions,
        *,
        limits: Limits | None = None,
        tap: Tap | None = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._options = options
        self._servos = read_calibration(options.calibration)
        self._arm = _kinematics(build, self._servos)
        reach_m = self._arm.shoulder_offset + self._arm.upper_arm + self._arm.forearm + build.tool_m
        super().__init__(
            limits
            or Limits(
                lower_m=(-reach_m, -reach_m, options.lower_z_m),
                upper_m=(reach_m, reach_m, build.shoulder_height_m + reach_m),
                max_speed_m_s=options.max_speed_m_s,
                reach_m=reach_m,
                angles=frozenset({Angle.PITCH, Angle.ROLL}),
                gripper=GripperKind.OPEN_CLOSE,
            ),
            rate_hz=options.rate_hz,
            acceleration_m_s2=options.acceleration_m_s2,
            arrival=ArrivalRule(
                poll_s=options.poll_s,
                still_m=options.near_m / 10,
                still_rad=math.radians(0.5),
                near_m=options.near_m,
                near_rad=math.radians(5.0),
                stall_s=options.stall_s,
            ),
            clock=clock,
            sleep=sleep,
        )
        self.shape = ArmShape(
            base_height_m=build.shoulder_height_m,
            shoulder_offset_m=build.shoulder_offset_m,
            upper_arm_m=self._arm.upper_arm,
            forearm_m=self._arm.forearm,
            tool_m=build.tool_m,
            link_radius_m=0.04,
            base_radius_m=0.07,
        )
        self._bus = ServoBus(
            SerialLine(url, baud=options.baud, tap=tap, is_text=False),
            {servo.id: name for name, servo in self._servos.items()},
            clock,
            reply_s=options.reply_s,
            lenient={self._gripper.id: feetech.OVERLOAD},  # when it holds an object
        )
        self._measured: dict[int, int] = {}  # positions [counts] by servo
        self._sent: dict[int, int] = {}  # and the last goals of the joints
        self._holding: set[int] = set()  # servos whose torque is on
        self._gripper_moves = False

    @property
    def _gripper(self) -> ServoCalibration:
        return self._servos[GRIPPER]

    def _open(self) -> None:
        self._close()
        self._bus.open()
        self._need_this_arms_file()
        self._measure()
        torque = self._bus.read(feetech.TORQUE_ENABLE, 1)
        self._holding = {servo for servo, data in torque.items() if data[0]}
        self._hold(has_arrived=False)

    def _need_this_arms_file(self) -> None:
        """Check that the servos have the offsets of the file, without which positions are wrong."""
        read = self._bus.read(feetech.HOMING_OFFSET, 2)
        for name, servo in self._servos.items():
            offset = signed(read[servo.id], feetech.OFFSET_SIGN_BIT)
            if offset != servo.homing_offset:
                raise CommandRefusedError(
                    f"servo {servo.id} ({name}) has the offset {offset}, and "
                    f"{self._options.calibration} says {servo.homing_offset}: this is another "
                    "arm's file, or an old one; calibrate with lerobot-calibrate"
                )

    def _disconnect(self) -> None:
        self._bus.close()
        self._measured, self._sent, self._holding = {}, {}, set()

    def _make_ready(self, turn: Turn, report: Callable[[str], None]) -> None:
        """Switch the torque on at the arm's present position; its encoders are absolute."""
        self._check(turn)
        report("absolute encoders: no motion needed")
        self._measure()
        self._issue(
            lambda: self._bus.write(feetech.ACCELERATION, self._goals(self._measured)), turn
        )
        self._bus.confirm(feetech.TORQUE_LIMIT, self._gripper.id, *two_bytes(GRIPPER_TORQUE))
        for servo in self._measured:
            self._check(turn)
            self._bus.confirm(feetech.TORQUE_ENABLE, servo, 1)
            self._holding.add(servo)

    def _measure(self) -> Vector:
        read = self._bus.read(feetech.PRESENT_POSITION, 2)
        self._measured = {
            servo: signed(data, feetech.POSITION_SIGN_BIT) for servo, data in read.items()
        }
        counts = np.array([self._measured[self._servos[name].id] for name in JOINTS])
        return self._arm.place(_angles(counts, self._servos))

    def _pose_at(self, place: Vector) -> Pose:
        x, y, z, pitch, roll = map(float, place)
        return Pose(x, y, z, pitch_rad=pitch, roll_rad=math.remainder(roll, 2 * math.pi))

    def _path(self, start: Vector, pose: Pose, speed_m_s: float) -> Way:
        pitch_rad = start[3] if pose.pitch_rad is None else pose.pitch_rad
        roll_rad = start[4] if pose.roll_rad is None else pose.roll_rad
        goal = np.array([*pose.position_m, pitch_rad, roll_rad])
        change = goal - start
        way_m = float(np.linalg.norm(change[:3]))
        turn_rad = float(np.max(np.abs(change[3:])))
        pieces = max(2, math.ceil(way_m / CHECKED_M), math.ceil(turn_rad / CHECKED_RAD))
        shares = np.linspace(0.0, 1.0, pieces + 1)[1:]
        joints = [self._joints(start + share * change) for share in shares]
        fastest_rad = float(np.max(np.abs(np.diff(joints, axis=0)), initial=0.0)) * pieces
        length_m = max(
            way_m, LEVER_M * turn_rad, speed_m_s * fastest_rad / self._options.max_joint_rad_s
        )
        return Way(lambda share: start + share * change, goal, length_m)

    def _joints(self, place: Vector) -> Vector:
        joints = self._arm.joints_rad(place)
        if joints is None:
            raise OutOfReachError(
                f"{self._pose_at(place)} on the way cannot be reached: nearer, another pitch, or "
                "another region"
            )
        return joints

    def _send_place(self, place: Vector) -> None:
        counts = _counts(self._joints(place), self._servos)
        goals = {
            self._servos[name].id: int(count) for name, count in zip(JOINTS, counts, strict=True)
        }
        self._bus.write(feetech.ACCELERATION, self._goals(goals))
        self._sent = goals

    def _hold(self, *, has_arrived: bool) -> None:
        if not self._measured:
            raise ConnectionLostError("not connected: call connect() first")
        # A gripper that stands keeps its grip.
        held = self._holding - (set() if self._gripper_moves else {self._gripper.id})
        counts = {**self._measured, **(self._sent if has_arrived else {})}
        self._sent = {servo: counts[servo] for servo in sorted(held)}
        if held:
            self._bus.write_now(feetech.ACCELERATION, self._goals(self._sent))

    def _goals(self, counts: Mapping[int, int]) -> dict[int, tuple[int, ...]]:
        """Return the values written to each servo: acceleration, goal, no time, greatest speed."""
        joint_speed = round(self._options.max_joint_rad_s * COUNTS_PER_TURN / (2 * math.pi))
        return {
            servo: (
                SERVO_ACCELERATION,
                *two_bytes(count),
                *two_bytes(0),
                *two_bytes(GRIPPER_SPEED if servo == self._gripper.id else joint_speed),
            )
            for servo, count in counts.items()
        }

    def _move_gripper(self, opening: float, turn: Turn) -> None:
        """Open or close until it stands: at its goal, or at an object."""
        gripper = self._gripper
        goal = round(gripper.range_min + opening * (gripper.range_max - gripper.range_min))
        start = self._measured_gripper()
        self._gripper_moves = True
        try:
            goals = self._goals({gripper.id: goal})
            self._issue(lambda: self._bus.write(feetech.ACCELERATION, goals), turn)
            stands_at = self._await_gripper(start, goal, turn)
        finally:
            self._gripper_moves = False
        if opening > 0.5 and abs(stands_at - goal) > GRIPPER_NEAR:
            raise GripperError(f"the gripper stands at {stands_at} counts, sent to {goal} to open")

    def _await_gripper(self, start: int, goal: int, turn: Turn) -> int:
        """Wait until the gripper stands; return its position [counts]."""
        at, since_s = start, self._clock()
        end_s = since_s + self._options.gripper_timeout_s
        while self._clock() - since_s < GRIPPER_STILL_S:
            self._pause(self._options.poll_s, turn)
            now_at = self._measured_gripper()
            if abs(now_at - goal) <= GRIPPER_NEAR:
                return now_at
            if abs(now_at - at) > GRIPPER_NEAR:
                at, since_s = now_at, self._clock()
            if self._clock() > end_s:
                raise GripperError(f"the gripper still moves at {now_at} counts, sent to {goal}")
        return at

    def _measured_gripper(self) -> int:
        self._measure()
        return self._measured[self._gripper.id]


def _kinematics(build: Build, servos: Mapping[str, ServoCalibration]) -> FiveAxis:
    """Return the arm's lengths [m] and its ranges within the calibration."""
    ends = [
        _angles(np.array([getattr(servos[name], end) for name in JOINTS]), servos)
        for end in ("range_max", "range_min")
    ]
    return FiveAxis(
        shoulder_height=build.shoulder_height_m,
        shoulder_offset=build.shoulder_offset_m,
        upper_arm=math.hypot(*ZERO_UPPER_ARM_M),
        forearm=math.hypot(*ZERO_FOREARM_M),
        tool=build.tool_m,
        ranges_rad=np.stack(ends, axis=1),
    )


def _angles(counts: Vector, servos: Mapping[str, ServoCalibration]) -> Vector:
    """Return the angles of `FiveAxis` [rad] of the joints' positions (5,) [counts]."""
    middles = np.array([servos[name].middle for name in JOINTS])
    return np.asarray(ZERO_RAD - (counts - middles) * (2 * math.pi / COUNTS_PER_TURN))


def _counts(joints_rad: Vector, servos: Mapping[str, ServoCalibration]) -> Vector:
    """Return the joints' positions (5,) [counts] of their angles [rad]."""
    middles = np.array([servos[name].middle for name in JOINTS])
    return np.rint(middles + (ZERO_RAD - joints_rad) * (COUNTS_PER_TURN / (2 * math.pi)))
