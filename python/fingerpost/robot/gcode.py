"""Arms controlled by G-code on a serial line: uArm, DexArm, and any with Marlin.

They share the basic commands (`G1 X Y Z F`, millimetres) and differ otherwise: a `Dialect` defines
how an arm homes, reports its position and stops, and a `Dialogue` how lines are numbered and
answered.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated

import msgspec

from fingerpost.errors import InvalidInputError
from fingerpost.robot.arm import Arm, ArrivalRule, Turn
from fingerpost.robot.errors import (
    CommandRefusedError,
    GarbledReplyError,
    GripperError,
    NotHomedError,
    OutOfReachError,
    RobotError,
    RobotFaultError,
    RobotTimeoutError,
)
from fingerpost.robot.gcode_dialects import (
    LEAST_SPEED_M_S,
    MM_PER_M,
    QUICK_STOP,
    Dialect,
    Firmware,
    Grip,
    Numbering,
    Tool,
)
from fingerpost.robot.gcode_dialogue import (
    ChecksumDialogue,
    Dialogue,
    HashDialogue,
    Position,
    Request,
    parse_position,
)
from fingerpost.robot.options import CheckedOptions
from fingerpost.robot.protocol import GripperKind, Limits, Pose
from fingerpost.robot.readings import ReadingFilter
from fingerpost.robot.serial_line import Flow, SerialLine, Tap

logger = logging.getLogger(__name__)

MAX_SPEED_M_S = 0.1
"""Greatest speed of an arm without limits of its own, for which only a box is given [m/s]."""

STARTUP_S = 8.0
"""Time after which a board that resets when its port is opened is ready [s]."""

TRAVEL_SLACK_MM = 2.0
"""Distance that an arm may move during one reading of its position [mm]."""


class GcodeOptions(CheckedOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of a G-code arm.

    Attributes
    ----------
    baud : int or None
        Bits per second; the dialect's own by default.
    flow : Flow
        Flow control.
    reply_s : float or None
        Longest time to an answer [s], `busy` messages not counted; the dialect's own by default.
    accept_s : float
        Time within which a numbered move may be refused; a uArm may answer only at its end. A
        silence of this length also ends unsolicited messages of a controller [s].
    poll_s, stall_s : float
        Parameters of the end of a move [s], as in `ArrivalRule`.
    keeps_steps : bool
        Whether the motors lose no steps when they are stopped without deceleration, as closed-loop
        ones do: the arm then stays homed after a stop. Arms with encoders do so in any case.
    tool : Tool or None
        Tool with which the arm holds objects; the dialect's usual one by default.
    gripper_s : float
        Time the gripper takes [s].
    open_gripper, close_gripper : str or None
        Commands of the gripper, if the dialect has none, or of another tool.
    lower_m, upper_m : tuple of 3 floats, or None
        Corners of the box of permitted positions [m]; the dialect's own by default. Both are
        required if the dialect has no limits.
    max_speed_m_s : float or None
        Greatest permitted speed [m/s]; the dialect's own by default, or
        `MAX_SPEED_M_S`.
    """

    baud: Annotated[int, msgspec.Meta(gt=0, le=10_000_000)] | None = None
    flow: Flow = Flow.NONE
    reply_s: Annotated[float, msgspec.Meta(gt=0, le=3600)] | None = None
    accept_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 0.1
    poll_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 0.05
    stall_s: Annotated[float, msgspec.Meta(gt=0, le=3600)] = 1.5
    keeps_steps: bool = False
    tool: Tool | None = None
    gripper_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 1.0
    open_gripper: str | None = None
    close_gripper: str | None = None
    lower_m: tuple[float, float, float] | None = None
    upper_m: tuple[float, float, float] | None = None
    max_speed_m_s: Annotated[float, msgspec.Meta(gt=0, le=10)] | None = None


def _need_no_half_box(options: GcodeOptions) -> None:
    """Refuse one corner without the other: a given limit must not be ignored."""
    for given, missing in (("lower_m", "upper_m"), ("upper_m", "lower_m")):
        if (corner := getattr(options, given)) is not None:
            raise InvalidInputError(
                f"{given} is {corner}, but {missing} is missing: this arm has no limits of its "
                "own, so both corners of the box are needed"
            )


def _grip(dialect: Dialect, options: GcodeOptions) -> Grip | None:
    """Return the commands of the tool; None without one.

    Raises
    ------
    InvalidInputError
        A tool unknown to the dialect, or one command without the other.
    """
    tools = dialect.tools
    if options.tool is not None and options.tool not in tools:
        known = f"{' and '.join(tools)} are right" if tools else "give open_gripper, close_gripper"
        raise InvalidInputError(f"tool is {options.tool}, which this arm does not know; {known}")
    usual = tools[options.tool or next(iter(tools))] if tools else None
    close = options.close_gripper or (usual.close if usual else None)
    open_ = options.open_gripper or (usual.open if usual else None)
    if close is None and open_ is None:
        return None
    if close is None or open_ is None:
        missing = "close_gripper" if close is None else "open_gripper"
        raise InvalidInputError(f"{missing} is missing: a gripper needs both of its commands")
    return Grip(close, open_)


class GcodeArm(Arm):
    """An arm controlled by G-code.

    Parameters
    ----------
    url : str
        Serial device, `socket://host:port` or `rfc2217://host:port`.
    dialect : Dialect
        Its family.
    options : GcodeOptions
        Its options.
    limits : Limits, optional
        Limits of commands; by default the dialect's own with the box of the options.
    tap : callable, optional
        Called with every transfer, `tap("out" or "in", data)`.
    clock, sleep : callable
        Monotonic time [s], and a wait for a time on that clock [s].

    Raises
    ------
    InvalidInputError
        An invalid box, one corner of a box although the dialect has no limits of its own, or a tool
        unknown to the arm.
    """

    def __init__(
        self,
        url: str,
        dialect: Dialect,
        options: GcodeOptions | None = None,
        *,
        limits: Limits | None = None,
        tap: Tap | None = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._options = options = options or GcodeOptions()
        self._dialect = dialect
        self._grip = _grip(dialect, options)
        declared = limits or self._declared_limits()
        if declared is not None:
            least_m_s = max(declared.min_speed_m_s, LEAST_SPEED_M_S)
            declared = replace(declared, min_speed_m_s=least_m_s)
        super().__init__(
            declared,
            arrival=ArrivalRule(poll_s=options.poll_s, stall_s=options.stall_s),
            clock=clock,
            sleep=sleep,
        )
        self._line = SerialLine(url, baud=options.baud or dialect.baud, flow=options.flow, tap=tap)
        self._reply_s = options.reply_s or dialect.reply_s
        self._talk = self._dialogue()
        self._readings = ReadingFilter(clock, MM_PER_M, TRAVEL_SLACK_MM)
        self._firmware: Firmware | None = None
        self._moving = False  # since it was last found to stand
        self._moves_until_s = 0.0  # by the commanded speeds
        self._next_start: tuple[int, Pose] | None = None  # unless it is stopped again

    def _dialogue(self) -> Dialogue:
        dialect, accept_s = self._dialect, self._options.accept_s
        if dialect.numbering is Numbering.HASH:
            return HashDialogue(
                self._line,
                self._clock,
                reply_s=self._reply_s,
                quiet_s=accept_s,
                after_stop=dialect.after_stop,
            )
        return ChecksumDialogue(
            self._line,
            self._clock,
            reply_s=self._reply_s,
            quiet_s=accept_s,
            after_stop=dialect.after_stop,
            where=dialect.where,
        )

    def _declared_limits(self) -> Limits | None:
        """Replace the dialect's own limits, if any, by the given ones."""
        options = self._options
        if self._dialect.limits is not None:
            declared = {
                name: value
                for name in ("lower_m", "upper_m", "max_speed_m_s")
                if (value := getattr(options, name)) is not None
            }
            return replace(self._dialect.limits, **declared)
        if options.lower_m is None or options.upper_m is None:
            _need_no_half_box(options)
            return None
        return Limits(
            lower_m=options.lower_m,
            upper_m=options.upper_m,
            max_speed_m_s=options.max_speed_m_s or MAX_SPEED_M_S,
            gripper=GripperKind.NONE if self._grip is None else GripperKind.OPEN_CLOSE,
        )

    @property
    def firmware(self) -> Firmware | None:
        """Firmware that the controller reported when it was connected; None before."""
        return self._firmware

    def _open(self) -> None:
        self._readings.forget()
        self._next_start = None
        self._line.open()
        self._line.send_now(self._dialect.stop, purge=False)
        self._talk.disturb()
        turn = Turn(self._stops, self._clock() + STARTUP_S + self._reply_s)
        self._await_startup(turn)
        self._firmware = self._read_firmware(turn)
        for command in self._dialect.start:
            self._ask(command, turn)
        self._talk.remarks.clear()

    def _await_startup(self, turn: Turn) -> None:
        """Wait for a first answer: a board may restart because its port was opened."""
        while True:
            self._pause(0.0, turn)
            try:
                self._talk.recover(lambda: self._check(turn))
            except (RobotTimeoutError, GarbledReplyError, RobotFaultError):
                if self._clock() + self._reply_s > turn.deadline_s:
                    raise
            else:
                return

    def _read_firmware(self, turn: Turn) -> Firmware:
        """Query the firmware, and check that it can be stopped.

        Raises
        ------
        CommandRefusedError
            It cannot.
        """
        try:
            answer = self._ask(self._dialect.identify, turn)
        except CommandRefusedError:
            answer = ""  # there is no answer
        firmware = self._dialect.firmware(answer)
        if not firmware.stops_at_once:
            self._need_stop(turn)
            logger.warning(
                "%s: this controller does not report EMERGENCY_PARSER, so a stop waits while it "
                "homes, or plans a move of many pieces: build its firmware with EMERGENCY_PARSER",
                self._line.url,
            )
        return firmware

    def _need_stop(self, turn: Turn) -> None:
        """Check that the controller knows the command that stops it.

        Raises
        ------
        CommandRefusedError
            It does not.
        """
        try:
            self._ask(QUICK_STOP, turn)
        except CommandRefusedError as error:
            raise CommandRefusedError(f"nothing would stop this arm: {error}") from error

    def _close(self) -> None:
        self._line.close()

    def _advice(self, error: RobotError) -> str:
        del error
        remarks = "; ".join(self._talk.remarks)
        said = f"the controller has said {remarks!r}" if remarks else ""
        return "; ".join(filter(None, (said, self._line.advice)))

    def _home(self, turn: Turn, report: Callable[[str], None]) -> None:
        self._next_start = None
        self._talk.remarks.clear()
        for command in self._dialect.home:
            report(command)
            self._moving = True
            self._ask(command, turn, moves=True, extra_s=math.inf, on_line=report)
        if self._dialect.drain:
            self._ask(self._dialect.drain, turn, extra_s=math.inf, on_line=report)
            self._moving = False
            return
        previous = self._read_pose(turn)
        while True:  # the end of motion is not reported: read until it stands
            self._pause(max(self._options.poll_s, 0.1), turn)
            pose = self._read_pose(turn)
            if pose.distance_m(previous) < self._arrival.still_m:
                return
            previous = pose

    def _start_move(self, pose: Pose, speed_m_s: float, turn: Turn) -> None:
        start_mm = MM_PER_M * self._start_of_move(turn).position_m
        goal_mm = MM_PER_M * pose.position_m
        stroke = self._dialect.feed.stroke(start_mm, goal_mm, MM_PER_M * speed_m_s)
        x, y, z = goal_mm
        command = f"{self._dialect.straight} X{x:.2f} Y{y:.2f} Z{z:.2f} F{stroke.feed}"
        until_s = max(self._clock(), self._moves_until_s) + stroke.duration_s
        self._talk.remarks.clear()
        moved, self._moving, self._next_start = self._moving, True, None
        try:
            self._ask(command, turn, moves=True)
        except (CommandRefusedError, OutOfReachError):
            self._moving = moved
            raise
        self._next_start, self._moves_until_s = (turn.stops, pose), until_s

    def _start_of_move(self, turn: Turn) -> Pose:
        """Return the pose of the arm at the end of all commands sent."""
        if self._next_start is not None and self._next_start[0] == turn.stops:
            return self._next_start[1]
        return self._read_pose(turn)

    def _read_pose(self, turn: Turn) -> Pose:
        """Read the position; if the controller only knows its goal, wait for standstill."""
        if self._dialect.drain:
            if self._firmware is not None and not self._firmware.stops_at_once:
                # It reads no stop during `M400`: send that when the motion should have ended.
                self._pause(max(0.0, self._moves_until_s - self._clock()), turn)
            self._ask(self._dialect.drain, turn, extra_s=math.inf)
            self._moving = False
        x, y, z = self._readings.read(lambda: self._read_position(turn))
        pose = Pose(x / MM_PER_M, y / MM_PER_M, z / MM_PER_M)
        if not self._moving:
            self._next_start = turn.stops, pose
        return pose

    def _read_position(self, turn: Turn) -> Position:
        busy_s = max(0.0, self._moves_until_s - self._clock())  # a uArm answers after planning
        answer = self._ask(self._dialect.where, turn, extra_s=busy_s)
        try:
            return parse_position(answer)
        except GarbledReplyError as error:
            self._talk.distrust()
            raise GarbledReplyError(f"{self._dialect.where}: {error}") from error

    def _send_stop(self) -> None:
        self._talk.disturb()
        if self._moving and self._dialect.slips and not self._options.keeps_steps:
            self._lose_home(self._dialect.slips)
        self._moves_until_s = 0.0
        self._line.send_now(self._dialect.stop, purge=False)

    def _move_gripper(self, opening: float, turn: Turn) -> None:
        if self._grip is None:
            raise GripperError("this robot has no command for its gripper")
        self._ask(self._grip.open if round(opening) else self._grip.close, turn, moves=True)
        self._pause(self._options.gripper_s, turn)

    def _ask(
        self,
        command: str,
        turn: Turn,
        *,
        moves: bool = False,
        extra_s: float = 0.0,
        on_line: Callable[[str], None] = lambda _: None,
    ) -> str:
        """Send a command; one that moves the arm never overtakes a stop."""

        def issue(line: bytes) -> None:
            self._issue(lambda: self._line.send(line), turn)

        try:
            return self._talk.ask(
                Request(
                    command=command,
                    check=lambda: self._check(turn),
                    send=issue if moves else self._line.send,
                    moves=moves,
                    extra_s=extra_s,
                    on_line=on_line,
                )
            )
        except NotHomedError:
            self._lose_home("the controller says so")
            raise
