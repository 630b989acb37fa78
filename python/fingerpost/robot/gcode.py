"""Arms that speak G-code on a serial line: uArm, Marlin, and Dobot-like arms built on Marlin.

They share the words (`G0 X Y Z F`, millimetres and millimetres per minute, `ok`) and differ in the
rest, which a `Dialect` holds: how lines are numbered, how the arm homes, how it tells where it is,
and which bytes stop it.

* Marlin numbers its lines and checks each by a sum (`N7 G0 X10*93`); it asks for a spoilt one
  again (`Resend: 7`). `M114` tells where the arm is *going*, so it is asked only after `M400`,
  which answers when all motion has ended: reading the pose waits for standstill. `M410` stops the
  motors; Marlin looks for it in the stream ahead of its queue.
* uArm numbers its lines (`#7 G0 X180 …`) and answers by number (`$7 ok`, `$7 E22`), a move perhaps
  only when it has ended. `P2220` tells where the arm is. Ctrl-X resets the motion from the
  controller's interrupt, ahead of everything.
"""

from __future__ import annotations

import itertools
import logging
import math
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Annotated

import msgspec

from fingerpost.errors import InvalidInputError
from fingerpost.robot.arm import Arm, ArrivalRule, Turn
from fingerpost.robot.errors import (
    CommandRefusedError,
    GarbledReplyError,
    GripperError,
    OutOfReachError,
    RobotError,
    RobotFaultError,
    RobotTimeoutError,
)
from fingerpost.robot.options import CheckedOptions
from fingerpost.robot.protocol import Angle, GripperKind, Limits, Pose
from fingerpost.robot.readings import Reading, ReadingFilter
from fingerpost.robot.serial_line import Flow, SerialLine, Tap

logger = logging.getLogger(__name__)

MM_PER_M = 1000.0
MAX_SPEED_M_S = 0.1
"""Greatest speed of an arm that has no limits of its own and is given a box only [m/s]."""

LEAST_SPEED_M_S = 1.0 / (60 * MM_PER_M)
"""A feed rate of `F1`; Marlin takes `F0` for none given, and goes as fast as before [m/s]."""

STARTUP_S = 8.0
"""A board that resets when its port is opened is ready after this [s]."""

TRAVEL_SLACK_MM = 2.0
"""Way an arm may go during one reading of its position [mm]."""

RECOVERIES = 3
"""How often the controller's answers are waited out before it counts as out of its mind."""

RESENDS = 5
"""How often a line is sent again before the line counts as broken."""


class Numbering(StrEnum):
    """How lines are numbered."""

    CHECKSUM = "checksum"
    HASH = "hash"


@dataclass(frozen=True, slots=True, kw_only=True)
class Dialect:
    """What one family of controllers does in its own way.

    Attributes
    ----------
    numbering : Numbering
        How lines are numbered and answers told apart.
    baud : int
        Usual bits per second.
    start, home : tuple of str
        Commands after connecting, and for homing.
    where : str
        Asks for the position; the answer holds `X… Y… Z…`.
    drain : str or None
        Answered when all motion has ended; needed where `where` tells a goal rather than a place.
    stop : bytes
        Stops at once, in the middle of anything.
    after_stop : tuple of str
        Commands that make the controller ready again.
    rotation : str or None
        Letter of the gripper's rotation, in degrees.
    open_gripper, close_gripper : str or None
        Commands of the gripper or pump.
    limits : Limits or None
        Of a known arm; None where only its owner knows.
    """

    numbering: Numbering
    baud: int = 115200
    start: tuple[str, ...] = ()
    home: tuple[str, ...]
    where: str
    drain: str | None = None
    stop: bytes
    after_stop: tuple[str, ...] = ()
    rotation: str | None = None
    open_gripper: str | None = None
    close_gripper: str | None = None
    limits: Limits | None = None


MARLIN = Dialect(
    numbering=Numbering.CHECKSUM,
    start=("G21", "G90"),
    home=("G28",),
    where="M114",
    drain="M400",
    stop=b"\nM410\n",
)
"""Any Marlin machine; limits and gripper are its owner's."""

DOBOT = Dialect(
    numbering=Numbering.CHECKSUM,
    start=("G21", "G90"),
    home=("M1112",),
    where="M114",
    drain="M400",
    stop=b"\nM410\n",
    rotation="R",
    open_gripper="M1001",
    close_gripper="M1000",
)
"""Desk arms on a Marlin of their own, such as Rotrics' DexArm: homing, pump and rotation differ."""

UARM = Dialect(
    numbering=Numbering.HASH,
    start=("M17",),
    home=("G0 X200 Y0 Z150 F3000",),
    where="P2220",
    stop=b"\x18",
    after_stop=("M17",),
    open_gripper="M2232 V0",
    close_gripper="M2232 V1",
    limits=Limits(
        lower_m=(0.0, -0.32, -0.1),
        upper_m=(0.32, 0.32, 0.15),
        max_speed_m_s=0.1,
        reach_m=0.32,
        min_reach_m=0.12,
        gripper=GripperKind.OPEN_CLOSE,
    ),
)
"""uArm Swift Pro, with round figures for its limits. Its encoders are absolute; homing goes to a
place above its front."""


class GcodeOptions(CheckedOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How to talk to a G-code arm.

    Attributes
    ----------
    baud : int or None
        Bits per second; the dialect's own by default.
    flow : Flow
        Flow control.
    reply_s : float
        Longest time to an answer [s], `busy` messages not counted.
    accept_s : float
        How long a numbered move may be refused; a uArm may answer only when it has ended [s].
    poll_s, stall_s : float
        How the end of a move is seen [s], as in `ArrivalRule`.
    gripper_s : float
        Time the gripper takes [s].
    open_gripper, close_gripper : str or None
        Commands of the gripper, where the dialect knows none.
    lower_m, upper_m : tuple of 3 floats, or None
        Corners of the box of permitted positions [m]; what is not given is the dialect's own, and
        both are needed where the dialect knows no limits.
    max_speed_m_s : float or None
        Greatest speed that may be asked for [m/s]; the dialect's own by default, or
        `MAX_SPEED_M_S`.
    """

    baud: Annotated[int, msgspec.Meta(gt=0, le=10_000_000)] | None = None
    flow: Flow = Flow.NONE
    reply_s: Annotated[float, msgspec.Meta(gt=0, le=3600)] = 2.0
    accept_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 0.1
    poll_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 0.05
    stall_s: Annotated[float, msgspec.Meta(gt=0, le=3600)] = 1.5
    gripper_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 1.0
    open_gripper: str | None = None
    close_gripper: str | None = None
    lower_m: tuple[float, float, float] | None = None
    upper_m: tuple[float, float, float] | None = None
    max_speed_m_s: Annotated[float, msgspec.Meta(gt=0, le=10)] | None = None


_COORDINATES = re.compile(
    r"^\s*X:?\s*(-?\d+(?:\.\d+)?)\s+Y:?\s*(-?\d+(?:\.\d+)?)\s+Z:?\s*(-?\d+(?:\.\d+)?)"
    r"(?:\s+[RE]:?\s*(-?\d+(?:\.\d+)?))?(?!\S)",
    re.MULTILINE,
)
_HASH_REPLY = re.compile(r"^\$(\d+)\s+(ok|E\d+)\b(.*)$", re.IGNORECASE)
_RESEND = re.compile(r"^(?:resend|rs)\s*:?\s*N?(\d+)", re.IGNORECASE)
_ERROR = re.compile(r"^(?:error|!!)\s*:?\s*(.*)$", re.IGNORECASE)
_UNKNOWN = re.compile(r"unknown command", re.IGNORECASE)
_LINE_ERROR = re.compile(r"checksum|line number", re.IGNORECASE)
_RESTARTED = re.compile(r"^(?:start|grbl\b.*|marlin\b.*)$", re.IGNORECASE)
_BUSY = re.compile(r"^(?:echo:)?\s*busy", re.IGNORECASE)
_UARM_ERRORS = {
    20: "no such command",
    21: "bad parameter",
    22: "address out of range",
    23: "command buffer full",
    24: "power not connected",
    25: "operation failed",
}
_UARM_FAULTS = frozenset({24, 25})
_UNREACHABLE = 22
_HALTED = re.compile(r"halt|kill", re.IGNORECASE)


def _need_no_half_box(options: GcodeOptions) -> None:
    """Refuse one corner without the other: a limit that is given must not be passed over."""
    for given, missing in (("lower_m", "upper_m"), ("upper_m", "lower_m")):
        if (corner := getattr(options, given)) is not None:
            raise InvalidInputError(
                f"{given} is {corner}, but {missing} is missing: this arm has no limits of its "
                "own, so both corners of the box are needed"
            )


def checksummed(number: int, command: str) -> str:
    """Return a line with Marlin's number and sum: the exclusive or of all bytes before the star."""
    body = f"N{number} {command}"
    total = 0
    for byte in body.encode("ascii"):
        total ^= byte
    return f"{body}*{total}"


class GcodeArm(Arm):
    """An arm that speaks G-code.

    Parameters
    ----------
    url : str
        Serial device, `socket://host:port` or `rfc2217://host:port`.
    dialect : Dialect
        Its family.
    options : GcodeOptions
        How to talk to it.
    limits : Limits, optional
        What it may be asked for; by default the dialect's own with the box of the options.
    tap : callable, optional
        Sees every transfer, `tap("out" or "in", data)`.
    clock, sleep : callable
        Monotonic time [s], and a wait of so many seconds of it.

    Raises
    ------
    InvalidInputError
        A box that is none, or one corner of a box where the dialect has no limits of its own.
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
        self._grip = (
            options.close_gripper or dialect.close_gripper,
            options.open_gripper or dialect.open_gripper,
        )
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
        self._readings = ReadingFilter(clock, MM_PER_M, TRAVEL_SLACK_MM)
        self._number = 0
        self._text = ""
        self._slip_numbers = itertools.count(1)
        self._slips = next(self._slip_numbers)  # counts what puts answers out of step
        self._in_step_since = 0

    def _declared_limits(self) -> Limits | None:
        """Lay the limits that were given over the dialect's own, if it has any."""
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
            angles=frozenset({Angle.ROLL} if self._dialect.rotation else ()),
            gripper=GripperKind.OPEN_CLOSE if all(self._grip) else GripperKind.NONE,
        )

    def _open(self) -> None:
        self._readings.forget()
        self._line.open()
        self._line.send_now(self._dialect.stop, purge=False)
        self._slips = next(self._slip_numbers)
        turn = Turn(self._stops, self._clock() + STARTUP_S + self._options.reply_s)
        self._await_startup(turn)
        for command in self._dialect.start:
            self._ask(command, turn)

    def _await_startup(self, turn: Turn) -> None:
        """Wait for a first answer: a board may be restarting because its port was opened."""
        while True:
            self._pause(0.0, turn)
            try:
                self._recover(turn)
            except (RobotTimeoutError, GarbledReplyError, RobotFaultError):
                if self._clock() + self._options.reply_s > turn.deadline_s:
                    raise
            else:
                return

    def _close(self) -> None:
        self._line.close()

    def _home(self, turn: Turn, report: Callable[[str], None]) -> None:
        for command in self._dialect.home:
            report(command)
            self._ask(command, turn, moves=True, patient=True, on_line=report)
        if self._dialect.drain:
            self._ask(self._dialect.drain, turn, patient=True, on_line=report)
            return
        previous = self._read_pose(turn)
        while True:  # no word for the end of motion: look until it stands
            self._pause(max(self._options.poll_s, 0.1), turn)
            pose = self._read_pose(turn)
            if pose.distance_m(previous) < self._arrival.still_m:
                return
            previous = pose

    def _start_move(self, pose: Pose, speed_m_s: float, turn: Turn) -> None:
        x, y, z = (MM_PER_M * value for value in pose.position_m)
        words = [f"G0 X{x:.2f} Y{y:.2f} Z{z:.2f}"]
        if self._dialect.rotation and pose.roll_rad is not None:
            words.append(f"{self._dialect.rotation}{math.degrees(pose.roll_rad):.2f}")
        words.append(f"F{60 * MM_PER_M * speed_m_s:.0f}")
        self._ask(" ".join(words), turn, moves=True)

    def _read_pose(self, turn: Turn) -> Pose:
        """Read the position; where the controller knows only its goal, wait for standstill."""
        if self._dialect.drain:
            self._ask(self._dialect.drain, turn, patient=True)
        x, y, z, rotation = self._readings.read(lambda: self._read_position(turn))
        return Pose(
            x / MM_PER_M,
            y / MM_PER_M,
            z / MM_PER_M,
            roll_rad=math.radians(rotation) if self._dialect.rotation else None,
        )

    def _read_position(self, turn: Turn) -> Reading:
        answer = self._ask(self._dialect.where, turn)
        found = _COORDINATES.findall(answer)
        if len(found) != 1:
            self._in_step_since = 0  # this may have been the answer to something else
            raise GarbledReplyError(f"{self._dialect.where}: no position in {answer!r}")
        return tuple(float(value or 0.0) for value in found[0])

    def _send_stop(self) -> None:
        self._slips = next(self._slip_numbers)
        self._line.send_now(self._dialect.stop, purge=False)

    def _move_gripper(self, opening: float, turn: Turn) -> None:
        command = self._grip[round(opening)]
        if command is None:
            raise GripperError("this robot has no command for its gripper")
        self._ask(command, turn, moves=True)
        self._pause(self._options.gripper_s, turn)

    # The dialogue.

    def _recover(self, turn: Turn) -> None:
        """Make a controller ready again whose answers may be out of step."""
        slips = self._slips
        for _ in range(RECOVERIES):
            self._drain(turn)
            if self._dialect.numbering is Numbering.HASH or self._falls_in_step(turn):
                break
        else:
            raise GarbledReplyError("the controller's answers do not belong to what it is asked")
        for command in self._dialect.after_stop:
            self._exchange(command, turn)
        self._in_step_since = slips

    def _drain(self, turn: Turn) -> None:
        """Listen until nothing more comes: it answers nobody."""
        self._text = ""
        quiet_s = self._clock() + self._options.accept_s
        while self._clock() < quiet_s:
            self._check(turn)
            if self._line.receive():
                quiet_s = self._clock() + self._options.accept_s

    def _falls_in_step(self, turn: Turn) -> bool:
        """Begin to count lines anew; whether each `ok` belongs to its line, a position tells."""
        self._number = 0
        self._exchange("M110 N0", turn, number=0)
        return bool(_COORDINATES.search(self._exchange(self._dialect.where, turn)))

    def _ask(
        self,
        command: str,
        turn: Turn,
        *,
        moves: bool = False,
        patient: bool = False,
        on_line: Callable[[str], None] = lambda _: None,
    ) -> str:
        """Send a command and return the lines of its answer."""
        if self._in_step_since != self._slips:
            self._recover(turn)
        in_step_since, self._in_step_since = self._in_step_since, 0  # until the answer is whole
        answer = self._exchange(command, turn, moves=moves, patient=patient, on_line=on_line)
        self._in_step_since = in_step_since
        return answer

    def _exchange(
        self,
        command: str,
        turn: Turn,
        *,
        number: int | None = None,
        moves: bool = False,
        patient: bool = False,
        on_line: Callable[[str], None] = lambda _: None,
    ) -> str:
        """Send a numbered command until it gets through; return the lines of its answer.

        `patient` waits as long as the turn lasts: homing and draining answer when they are done.
        """
        if number is None:
            self._number += 1
            number = self._number
        hashed = self._dialect.numbering is Numbering.HASH
        text = f"#{number} {command}" if hashed else checksummed(number, command)
        for _ in range(RESENDS):
            if moves:
                self._issue(lambda: self._line.send(f"{text}\n".encode("ascii")), turn)
            else:
                self._line.send(f"{text}\n".encode("ascii"))
            if hashed:
                return self._hash_answer(command, number, turn, patient, accept=moves)
            answer = self._marlin_answer(command, number, turn, patient, on_line)
            if answer is not None:
                return answer
        raise GarbledReplyError(f"{command}: asked for again {RESENDS} times; the line is noisy")

    def _hash_answer(
        self, command: str, number: int, turn: Turn, patient: bool, *, accept: bool
    ) -> str:
        """Wait for `$n ok`; a move counts as accepted when it has not been refused in time."""
        limit_s = self._options.accept_s if accept else self._options.reply_s
        end_s = math.inf if patient else self._clock() + limit_s
        while self._clock() < end_s:
            line = self._next_line(turn)
            reply = _HASH_REPLY.match(line)
            if reply and reply[2].lower() != "ok":
                raise _uarm_error(command, int(reply[2][1:]))
            if reply and int(reply[1]) == number:
                return str(reply[3])
            self._notice(line)
        if accept:
            return ""
        raise RobotTimeoutError(f"{command}: no answer within {limit_s:g} s")

    def _marlin_answer(
        self,
        command: str,
        number: int,
        turn: Turn,
        patient: bool,
        on_line: Callable[[str], None],
    ) -> str | None:
        """Wait for `ok`; None when the controller asks for the line again."""
        heard: list[str] = []
        resend = None
        end_s = self._clock() + self._options.reply_s
        while self._clock() < end_s or (patient and resend is None):
            line = self._next_line(turn)
            if not line:
                continue
            on_line(line)
            if line.lower().startswith("ok"):
                if resend is None:
                    return "\n".join([*heard, line[2:]])
                if resend not in (number, number + 1):
                    raise GarbledReplyError(f"asked for line {resend}; {number} is the last sent")
                # It wants the line after the last one it has: number + 1 means that it has this.
                return None if resend == number else "\n".join(heard)
            if _BUSY.match(line):
                end_s = self._clock() + self._options.reply_s
            elif again := _RESEND.match(line):
                resend = int(again[1])
            elif _UNKNOWN.search(line):  # an ok follows that means nothing
                raise CommandRefusedError(f"{command}: the controller knows no such command")
            elif (error := _ERROR.match(line)) and not _LINE_ERROR.search(error[1]):
                raise _marlin_error(command, error[1])
            else:
                self._notice(line)
                heard.append(line)
        raise RobotTimeoutError(f"{command}: no ok within {self._options.reply_s:g} s")

    def _next_line(self, turn: Turn) -> str:
        """Return the next whole line, or an empty one after a short wait."""
        self._check(turn)
        if "\n" not in self._text:
            self._text += self._line.receive().decode("latin-1")
        line, newline, rest = self._text.partition("\n")
        if not newline:
            return ""
        self._text = rest
        return line.strip()

    def _notice(self, line: str) -> None:
        """Look at a line that answers nothing: a controller that restarted has lost its home."""
        if _RESTARTED.match(line):
            raise RobotFaultError(f"the controller has restarted: {line!r}")


def _uarm_error(command: str, code: int) -> RobotError:
    message = f"{command}: E{code}, {_UARM_ERRORS.get(code, 'unknown error')}"
    if code == _UNREACHABLE:
        return OutOfReachError(message)
    if code in _UARM_FAULTS:
        return RobotFaultError(message, number=code)
    return CommandRefusedError(message)


def _marlin_error(command: str, text: str) -> RobotError:
    message = f"{command}: {text}"
    if re.search(r"reach|range|limit", text, re.IGNORECASE):
        return OutOfReachError(message)
    return RobotFaultError(message) if _HALTED.search(text) else CommandRefusedError(message)
