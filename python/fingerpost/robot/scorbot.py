"""The paper's robot: a Scorbot ER-7 with its Controller-A, through ACL on a serial line.

A goal is a named position: `DEFP` defines the name, `HERE` records a position under it (coordinates
can only be changed in a recorded position), `SETPVC` changes X, Y, Z and then P and R, which change
with the others, and `LISTPV` reads it back before any motion. `MOVEL` queues a straight move and
returns at once, so arrival is detected by reading `LISTPV POSITION` until the arm stands at its
goal. The line has no checksum: a reading is valid only if another agrees.

Units of the controller: 0.1 mm, 0.1°, percent of full speed. The gripper's opening is not
measured: opening and closing take a fixed time.
"""

from __future__ import annotations

import itertools
import logging
import math
import re
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated

import msgspec

from fingerpost.robot.acl import (
    ABORT,
    AXES,
    AclPosition,
    AclTiming,
    Conversation,
    parse_position,
)
from fingerpost.robot.arm import Arm, ArrivalRule, Turn
from fingerpost.robot.errors import (
    CommandRefusedError,
    GarbledReplyError,
    HomingError,
    NotReadyError,
    RobotError,
    RobotTimeoutError,
)
from fingerpost.robot.options import CheckedOptions
from fingerpost.robot.protocol import Angle, GripperKind, Limits, Pose
from fingerpost.robot.readings import Reading, ReadingFilter
from fingerpost.robot.serial_line import Flow, SerialLine, Tap
from fingerpost.robot.shape import ArmShape

logger = logging.getLogger(__name__)

UNIT_M = 1e-4
"""The controller's unit of length [m]."""

UNIT_DEG = 0.1
"""The controller's unit of angle [°]."""

STORED_TOLERANCE = 1
"""Rounding error of a stored position, in the controller's units."""

TRAVEL_SLACK = 20
"""Added to the distance that an arm can move between two readings: 2 mm for their duration, in the
controller's units."""

POSITION_NAMES = 64
"""Number of names, FP00 … FP63, that are used in turn."""

CONNECT_TIMEOUT_S = 10.0
"""Time limit for the first answer of a controller [s]."""

_HOMING_ENDS = re.compile(
    r"HOMING COMPLETE[^\r\n]*[\r\n]|\*\*\*\s*HOME FAILURE[^\r\n]*[\r\n]", re.IGNORECASE
)
_HOMING_FAILED = re.compile(r"HOME FAILURE(?:\s*AXIS\s*(\d+))?", re.IGNORECASE)

SCORBOT_ER7_LIMITS = Limits(
    lower_m=(-0.85, -0.85, 0.0),
    upper_m=(0.85, 0.85, 1.1),
    max_speed_m_s=0.3,
    reach_m=0.85,
    min_reach_m=0.15,
    angles=frozenset({Angle.PITCH, Angle.ROLL}),
    gripper=GripperKind.WIDTH,
    gripper_opening_m=0.07,
)
"""Round figures for an arm of this size, at a third of its speed. Z = 0 is the surface on which its
base stands; declare the height of your own table before the arm moves near it."""


SCORBOT_ER7_SHAPE = ArmShape(
    base_height_m=0.3585,
    shoulder_offset_m=0.05,
    upper_arm_m=0.3,
    forearm_m=0.25,
    tool_m=0.27,
)


class ScorbotOptions(CheckedOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of a Scorbot.

    Attributes
    ----------
    baud : int
        Bits per second.
    flow : Flow
        Flow control.
    reply_s, quiet_s, resync_s : float
        Time-outs of the conversation [s], as in `AclTiming`.
    poll_s, stall_s : float
        Parameters of the end of a move [s], as in `ArrivalRule`.
    lower_m, upper_m : tuple of 3 floats, or None
        Box of permitted positions [m]; the arm's own by default. Set z to stay above your table.
    max_speed_m_s : float or None
        Greatest permitted speed [m/s]; `SCORBOT_ER7_LIMITS`'s by default.
    full_speed_m_s : float
        The gripper's speed at `SPEED 100` [m/s]; measure your arm's.
    gripper_s : float
        Time the gripper takes [s].
    retries : int
        Number of repetitions of a command after noise, if it can be repeated without harm.
    tagged : bool
        Whether to number commands by the case of their letters, as in `Conversation`.
    """

    baud: Annotated[int, msgspec.Meta(gt=0, le=10_000_000)] = 9600
    flow: Flow = Flow.NONE
    reply_s: Annotated[float, msgspec.Meta(gt=0, le=3600)] = 1.0
    quiet_s: Annotated[float, msgspec.Meta(gt=0, le=3600)] = 0.06
    resync_s: Annotated[float, msgspec.Meta(gt=0, le=3600)] = 3.0
    poll_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 0.05
    stall_s: Annotated[float, msgspec.Meta(gt=0, le=3600)] = 1.5
    lower_m: tuple[float, float, float] | None = None
    upper_m: tuple[float, float, float] | None = None
    max_speed_m_s: Annotated[float, msgspec.Meta(gt=0, le=10)] | None = None
    full_speed_m_s: Annotated[float, msgspec.Meta(gt=0, le=10)] = 1.0
    gripper_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 1.0
    retries: Annotated[int, msgspec.Meta(ge=0, le=100)] = 2
    tagged: bool = True


class Scorbot(Arm):
    """A Scorbot controlled by ACL.

    Parameters
    ----------
    url : str
        Serial device, `socket://host:port` or `rfc2217://host:port`.
    options : ScorbotOptions
        Its options.
    limits : Limits, optional
        Limits of commands; by default `SCORBOT_ER7_LIMITS` with the box of the options.
    tap : callable, optional
        Called with every transfer, `tap("out" or "in", data)`.
    clock, sleep : callable
        Monotonic time [s], and a wait for a time on that clock [s].

    Examples
    --------
    >>> from fingerpost.robot import Pose, TOOL_DOWN_RAD, open_robot
    >>> with open_robot("acl:///dev/ttyUSB0") as robot:  # doctest: +SKIP
    ...     robot.home()
    ...     robot.move_to(Pose(0.4, 0.0, 0.1, pitch_rad=TOOL_DOWN_RAD), speed_m_s=0.1)
    """

    shape = SCORBOT_ER7_SHAPE

    def __init__(
        self,
        url: str,
        options: ScorbotOptions | None = None,
        *,
        limits: Limits | None = None,
        tap: Tap | None = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._options = options = options or ScorbotOptions()
        super().__init__(
            _no_slower(limits or _limits(options), options),
            arrival=ArrivalRule(poll_s=options.poll_s, stall_s=options.stall_s),
            clock=clock,
            sleep=sleep,
        )
        self._line = SerialLine(url, baud=options.baud, flow=options.flow, tap=tap)
        self._talk = Conversation(
            self._line,
            AclTiming(options.reply_s, options.quiet_s, options.resync_s),
            tagged=options.tagged,
            clock=clock,
        )
        self._recorded: set[str] = set()
        self._next_name = 0
        self._queued = 0
        self._percent: int | None = None
        self._readings = ReadingFilter(clock, options.full_speed_m_s / UNIT_M, TRAVEL_SLACK)

    def _open(self) -> None:
        self._recorded.clear()
        self._percent = None
        self._readings.forget()
        self._line.open()
        self._line.send_now(ABORT)
        self._talk.disturb(aborted=True)
        turn = Turn(self._stops, self._clock() + CONNECT_TIMEOUT_S)
        self._talk.synchronise(lambda: self._check(turn))

    def _close(self) -> None:
        self._line.close()

    def _advice(self, error: RobotError) -> str:
        del error
        return self._line.advice

    def _home(self, turn: Turn, report: Callable[[str], None]) -> None:
        """HOME answers `WAIT!! HOMING...`, and up to three minutes later with the outcome."""
        self._percent = None  # HOME aborts programs; the speed after it is unknown
        self._readings.forget()
        ending = self._talk.await_text(
            "HOME", _HOMING_ENDS, lambda: self._check(turn), self._issuing(turn), report
        )
        if failure := _HOMING_FAILED.search(ending):
            axis = int(failure[1]) if failure[1] else None
            raise HomingError(f"axis {axis or '?'} did not find its home position", axis=axis)

    def _start_move(self, pose: Pose, speed_m_s: float, turn: Turn) -> None:
        goal = self._coordinates(pose, turn)
        name = self._record(turn)
        self._set_position(name, goal, turn)
        self._set_speed(speed_m_s, turn)
        self._ask_motion(f"MOVEL {name}", turn)

    def _read_pose(self, turn: Turn) -> Pose:
        return _pose(self._readings.read(lambda: self._read_position(turn).coordinates))

    def _send_stop(self) -> None:
        self._talk.disturb(aborted=True)
        self._line.send_now(ABORT)

    def _move_gripper(self, opening: float, turn: Turn) -> None:
        command = {0.0: "CLOSE", 1.0: "OPEN"}.get(opening, f"JAW {round(100 * opening)}")
        self._ask_motion(command, turn)
        self._pause(self._options.gripper_s, turn)

    # Steps of a move.

    def _coordinates(self, pose: Pose, turn: Turn) -> tuple[int, ...]:
        """Return a pose in the controller's units; angles that are None are those of the arm."""
        pitch, roll = pose.pitch_rad, pose.roll_rad
        if pitch is None or roll is None:
            now = self._read_pose(turn)
            pitch = now.pitch_rad if pitch is None else pitch
            roll = now.roll_rad if roll is None else roll
        lengths = (round(value / UNIT_M) for value in pose.position_m)
        angles = (round(math.degrees(angle or 0.0) / UNIT_DEG) for angle in (pitch, roll))
        return (*lengths, *angles)

    def _record(self, turn: Turn) -> str:
        """Return the name of a recorded position that no queued move uses.

        It is not documented whether the controller reads a position when a move is queued or when
        it starts, so a name is not reused while moves are queued.
        """
        self._queued = 0 if self._goal is None else self._queued + 1
        if self._queued >= POSITION_NAMES:
            raise NotReadyError(f"{POSITION_NAMES} moves are queued: wait for them first")
        name = f"FP{self._next_name:02d}"
        self._next_name = (self._next_name + 1) % POSITION_NAMES
        if name not in self._recorded:
            try:
                self._ask(f"DEFP {name}", turn)
            except CommandRefusedError as error:
                logger.debug("%s exists already: %s", name, error)
            self._ask(f"HERE {name}", turn)
            self._recorded.add(name)
        return name

    def _set_position(self, name: str, goal: tuple[int, ...], turn: Turn) -> None:
        """Set all five coordinates, P and R last, and verify them."""
        for _ in range(1 + self._options.retries):
            for axis, value in zip(AXES, goal, strict=True):
                self._ask(f"SETPVC {name} {axis} {value}", turn)
            stored = parse_position(self._ask(f"LISTPV {name}", turn, reads=parse_position))
            if _agree(stored.coordinates, goal):
                return
        raise GarbledReplyError(f"{name} should be {goal}, but the controller lists {stored}")

    def _set_speed(self, speed_m_s: float, turn: Turn) -> None:
        """Set the speed, rounded down, unless it is already set."""
        percent = min(100, int(100 * speed_m_s / self._options.full_speed_m_s + 1e-9))
        if percent != self._percent:
            self._percent = None
            self._ask(f"SPEED {percent}", turn)
            self._percent = percent

    def _read_position(self, turn: Turn) -> AclPosition:
        return parse_position(self._ask("LISTPV POSITION", turn, reads=parse_position))

    def _ask(
        self, command: str, turn: Turn, *, reads: Callable[[str], object] = lambda _: None
    ) -> str:
        """Send a command, repeatedly after noise or silence; only for repeatable commands."""
        for attempt in itertools.count():
            self._talk.synchronise(lambda: self._check(turn))
            try:
                answer = self._talk.ask(command, lambda: self._check(turn))
                reads(answer)
            except (GarbledReplyError, RobotTimeoutError) as error:
                self._check(turn)
                if attempt == self._options.retries:
                    raise
                self._talk.disturb()
                logger.info("asking again: %s", error)
            else:
                return answer
        raise AssertionError  # count() has no end

    def _ask_motion(self, command: str, turn: Turn) -> None:
        """Send a command that moves the arm: once, and never past a stop."""
        self._talk.synchronise(lambda: self._check(turn))
        self._talk.ask(command, lambda: self._check(turn), self._issuing(turn))

    def _issuing(self, turn: Turn) -> Callable[[bytes], None]:
        return lambda data: self._issue(lambda: self._line.send(data), turn)


def _limits(options: ScorbotOptions) -> Limits:
    declared = {
        name: value
        for name in ("lower_m", "upper_m", "max_speed_m_s")
        if (value := getattr(options, name)) is not None
    }
    return replace(SCORBOT_ER7_LIMITS, **declared)


def _no_slower(limits: Limits, options: ScorbotOptions) -> Limits:
    """Return limits with the speed of `SPEED 1` as least speed, unless theirs is greater."""
    least_m_s = max(limits.min_speed_m_s, options.full_speed_m_s / 100)
    return replace(limits, min_speed_m_s=least_m_s)


def _agree(stored: tuple[int, ...], goal: tuple[int, ...]) -> bool:
    return all(abs(a - b) <= STORED_TOLERANCE for a, b in zip(stored, goal, strict=True))


def _pose(coordinates: Reading) -> Pose:
    x, y, z, pitch, roll = coordinates
    return Pose(
        x * UNIT_M,
        y * UNIT_M,
        z * UNIT_M,
        pitch_rad=math.radians(pitch * UNIT_DEG),
        roll_rad=math.radians(roll * UNIT_DEG),
    )
