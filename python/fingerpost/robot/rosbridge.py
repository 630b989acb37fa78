"""Arms with ROS 1 or 2 through a rosbridge server: MoveIt Servo, Franka, research arms.

Poses are streamed (`fingerpost.robot.streaming`) as `geometry_msgs/PoseStamped` to one topic; the
arm's pose is received from another, in the same frame. The arm is started and stopped, and the
gripper moved, by services of type `std_srvs/Trigger`. A stop publishes the last measured pose as
the target and calls the stop service, in this order and without waiting for either.

The tool's z axis is its approach direction, as in ROS-Industrial and on a Franka. Headers are sent
without a stamp: the bridge adds its own time, so no clocks are compared.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Annotated

import msgspec
import numpy as np

from fingerpost.errors import InvalidInputError
from fingerpost.robot.arm import ArrivalRule, Turn
from fingerpost.robot.errors import (
    CommandRefusedError,
    GarbledReplyError,
    GripperError,
    RobotError,
    RobotTimeoutError,
)
from fingerpost.robot.motion import Path, Vector
from fingerpost.robot.options import CheckedOptions
from fingerpost.robot.orientation import (
    pose_angles,
    quaternion,
    rotation_from_quaternion,
    rotation_matrix,
    rotation_vector,
    tool_rotation,
)
from fingerpost.robot.protocol import Angle, GripperKind, Limits, Pose
from fingerpost.robot.rosbridge_link import Message, RosbridgeLink
from fingerpost.robot.streaming import StreamedArm

DEFAULT_PORT = 9090
"""Default port of rosbridge_server."""

POSE_TYPE = "geometry_msgs/PoseStamped"

FIRST_POSE_S = 3.0
"""Time limit for the first pose of an arm [s]."""

LEVER_M = 0.2
"""Lever that converts the tool's rate of rotation to a speed [m]: about its length."""


class _Axes(msgspec.Struct):
    x: float
    y: float
    z: float


class _Quaternion(_Axes):
    w: float


class _Pose(msgspec.Struct):
    position: _Axes
    orientation: _Quaternion


class _Header(msgspec.Struct):
    frame_id: str


class _PoseStamped(msgspec.Struct):
    header: _Header
    pose: _Pose


class RosbridgeOptions(CheckedOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of a ROS arm.

    Attributes
    ----------
    frame : str
        The frame of all poses, the arm's base.
    target_topic, pose_topic : str
        Topics on which targets are published, and poses of the arm received.
    stop_service : str
        Service that stops the arm at once; empty if there is none.
    start_service : str
        Service that makes it ready, at homing and after a stop; empty if not needed.
    open_service, close_service : str
        Services of the gripper; empty if there is none.
    reach_m : float
        Its reach [m].
    lower_z_m : float
        The lowest permitted height [m].
    max_speed_m_s, acceleration_m_s2 : float
        Greatest speed, and acceleration of moves.
    near_m : float
        Distance from its goal at which the arm has arrived [m].
    rate_hz : float
        Rate of targets [Hz].
    max_age_s : float
        Greatest age of a valid pose [s].
    service_s : float
        Longest time to a service's answer [s].
    poll_s, stall_s : float
        Parameters of the end of a move [s], as in `ArrivalRule`.
    """

    frame: str = "base_link"
    target_topic: str = "/fingerpost/target"
    pose_topic: str = "/fingerpost/pose"
    stop_service: str = "/fingerpost/stop"
    start_service: str = ""
    open_service: str = ""
    close_service: str = ""
    reach_m: Annotated[float, msgspec.Meta(gt=0, le=10)] = 0.7
    lower_z_m: float = 0.0
    max_speed_m_s: Annotated[float, msgspec.Meta(gt=0, le=10)] = 0.1
    acceleration_m_s2: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 0.5
    near_m: Annotated[float, msgspec.Meta(gt=0, le=0.1)] = 0.005
    rate_hz: Annotated[float, msgspec.Meta(ge=5, le=1000)] = 50.0
    max_age_s: Annotated[float, msgspec.Meta(gt=0, le=60)] = 0.5
    service_s: Annotated[float, msgspec.Meta(gt=0, le=3600)] = 5.0
    poll_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 0.02
    stall_s: Annotated[float, msgspec.Meta(gt=0, le=3600)] = 1.5


class RosbridgeArm(StreamedArm):
    """An arm with ROS.

    Parameters
    ----------
    host : str
        Host of the rosbridge server.
    port : int
        Its port.
    options : RosbridgeOptions
        Options of the arm.
    limits : Limits, optional
        Limits of commands; by default a half ball of `reach_m`.
    clock, sleep : callable
        Monotonic time [s], and a wait for a time on that clock [s].

    Raises
    ------
    InvalidInputError
        One of the gripper's services without the other.
    MissingExtraError
        `websockets` is not installed.
    """

    def __init__(
        self,
        host: str,
        port: int = DEFAULT_PORT,
        options: RosbridgeOptions | None = None,
        *,
        limits: Limits | None = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._options = options = options or RosbridgeOptions()
        if bool(options.open_service) != bool(options.close_service):
            missing = "close_service" if options.open_service else "open_service"
            raise InvalidInputError(f"{missing} is missing: a gripper needs both of its services")
        reach = options.reach_m
        super().__init__(
            limits
            or Limits(
                lower_m=(-reach, -reach, options.lower_z_m),
                upper_m=(reach, reach, reach),
                max_speed_m_s=options.max_speed_m_s,
                reach_m=reach,
                angles=frozenset(Angle),
                gripper=GripperKind.OPEN_CLOSE if options.open_service else GripperKind.NONE,
            ),
            rate_hz=options.rate_hz,
            acceleration_m_s2=options.acceleration_m_s2,
            arrival=ArrivalRule(
                poll_s=options.poll_s,
                still_m=options.near_m / 10,
                near_m=options.near_m,
                stall_s=options.stall_s,
            ),
            clock=clock,
            sleep=sleep,
        )
        self._link = RosbridgeLink(host, port, self._take_pose, self._take_trouble)
        self._reading: tuple[float, Message] | None = None  # newest pose: arrival time, message
        self._trouble: RobotError | None = None
        self._stop_call = ("", 0.0)  # its number, and the time of sending
        self._needs_start = True

    def _open(self) -> None:
        self._close()
        self._link.open()
        options = self._options
        self._link.send(op="advertise", topic=options.target_topic, type=POSE_TYPE)
        self._link.send(op="subscribe", topic=options.pose_topic, type=POSE_TYPE, queue_length=1)
        self._hold(has_arrived=False)

    def _disconnect(self) -> None:
        self._link.close()
        self._reading = self._trouble = None
        self._stop_call = ("", 0.0)

    def _make_ready(self, turn: Turn, report: Callable[[str], None]) -> None:
        """Wait for the first pose and call the start service; nothing moves."""
        self._reading = self._trouble = None
        end_s = self._clock() + FIRST_POSE_S
        while self._reading is None and self._trouble is None and self._clock() < end_s:
            self._pause(self._options.poll_s, turn)
        self._measure()
        self._start(turn)
        report("no motion needed")

    def _start(self, turn: Turn) -> None:
        self._needs_start = False  # before, so that a stop meanwhile is not forgotten
        if self._options.start_service:
            try:
                self._call(self._options.start_service, turn)
            except RobotError:
                self._needs_start = True
                raise

    def _start_move(self, pose: Pose, speed_m_s: float, turn: Turn) -> None:
        if self._needs_start:
            self._start(turn)
        super()._start_move(pose, speed_m_s, turn)

    def _measure(self) -> Vector:
        self._raise_trouble()
        self._see_to_stop()
        return self._newest_place()

    def _newest_place(self) -> Vector:
        """Return the newest pose received, if it is valid."""
        topic = self._options.pose_topic
        came_s, message = self._reading or (-math.inf, {})
        if self._clock() - came_s > self._options.max_age_s:
            raise RobotTimeoutError(
                f"{topic}: no pose within {self._options.max_age_s:g} s; see that the node that "
                f"publishes {POSE_TYPE} there runs"
            )
        try:
            found = msgspec.convert(message, type=_PoseStamped)
        except msgspec.ValidationError as error:
            raise GarbledReplyError(f"{topic}: no {POSE_TYPE}: {error}") from error
        if found.header.frame_id.strip("/") != self._options.frame.strip("/"):
            raise GarbledReplyError(
                f"{topic}: a pose in the frame {found.header.frame_id!r}, and frame="
                f"{self._options.frame} was given; one of them is to be the other"
            )
        at, turned = found.pose.position, found.pose.orientation
        rotation = rotation_from_quaternion((turned.w, turned.x, turned.y, turned.z))
        place = np.array([at.x, at.y, at.z, *rotation_vector(rotation)])
        if not np.isfinite(place).all():
            raise GarbledReplyError(f"{topic}: a pose that is no number: {message['pose']}")
        return place

    def _pose_at(self, place: Vector) -> Pose:
        pitch, roll, yaw = pose_angles(rotation_matrix(place[3:]))
        x, y, z = map(float, place[:3])
        return Pose(x, y, z, pitch_rad=pitch, roll_rad=roll, yaw_rad=yaw)

    def _path(self, start: Vector, pose: Pose, speed_m_s: float) -> Path:
        del speed_m_s  # the length does not depend on the speed
        first = rotation_matrix(start[3:])
        angles = pose.angles()
        last = first if angles is None else tool_rotation(*angles)
        turn = rotation_vector(first.T @ last)
        way = pose.position_m - start[:3]

        def at(share: float) -> Vector:
            turned = rotation_vector(first @ rotation_matrix(share * turn))
            return np.concatenate([start[:3] + share * way, turned])

        length_m = max(float(np.linalg.norm(way)), LEVER_M * float(np.linalg.norm(turn)))
        return Path(at, at(1.0), length_m)

    def _send_place(self, place: Vector) -> None:
        self._link.send(op="publish", topic=self._options.target_topic, msg=self._message(place))

    def _message(self, place: Vector) -> Message:
        w, qx, qy, qz = quaternion(rotation_matrix(place[3:]))
        x, y, z = map(float, place[:3])
        return {
            "header": {"frame_id": self._options.frame},
            "pose": {
                "position": {"x": x, "y": y, "z": z},
                "orientation": {"x": qx, "y": qy, "z": qz, "w": w},
            },
        }

    def _hold(self, *, has_arrived: bool) -> None:
        self._needs_start = True
        options, link = self._options, self._link
        if not has_arrived:
            with suppress(GarbledReplyError, RobotTimeoutError):  # then the service alone stops it
                message = self._message(self._newest_place())
                link.send_now(op="publish", topic=options.target_topic, msg=message)
        if options.stop_service:
            self._stop_call = link.call(options.stop_service, urgent=True), self._clock()

    def _raise_trouble(self) -> None:
        """Raise the error of the link's thread, once."""
        error, self._trouble = self._trouble, None
        if error is not None:
            raise error

    def _see_to_stop(self) -> None:
        """Raise if the last stop was not answered with success."""
        number, sent_s = self._stop_call
        if not number:
            return
        outcome = self._link.outcome(number)
        if outcome is None and self._clock() - sent_s > self._options.service_s:
            outcome = False, f"no answer within {self._options.service_s:g} s"
        if outcome is not None:
            self._stop_call = ("", 0.0)
            done, said = outcome
            if not done:
                raise CommandRefusedError(
                    f"{self._options.stop_service} has not stopped the arm: {said}; the arm was "
                    "sent where it stood, but see that it stands"
                )

    def _move_gripper(self, opening: float, turn: Turn) -> None:
        options = self._options
        try:
            self._call(options.open_service if opening > 0.5 else options.close_service, turn)
        except CommandRefusedError as error:
            raise GripperError(str(error)) from error

    def _call(self, service: str, turn: Turn) -> None:
        """Call a service and wait for its completion."""
        numbers: list[str] = []
        self._issue(lambda: numbers.append(self._link.call(service)), turn)
        end_s = self._clock() + self._options.service_s
        while (outcome := self._link.outcome(numbers[0])) is None:
            self._raise_trouble()
            if self._clock() > end_s:
                raise RobotTimeoutError(
                    f"{service}: no answer within {self._options.service_s:g} s"
                )
            self._pause(self._options.poll_s, turn)
        done, said = outcome
        if not done:
            raise CommandRefusedError(f"{service}: {said or 'refused without a reason'}")

    # Called by the link's thread.

    def _take_pose(self, topic: str, message: Message) -> None:
        if topic == self._options.pose_topic:
            self._reading = self._clock(), message

    def _take_trouble(self, error: RobotError) -> None:
        self._trouble = error
