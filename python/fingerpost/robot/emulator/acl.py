"""Emulation of a Scorbot and its Controller-A, as seen from a serial line.

Bytes in, bytes out, at given times; no port, thread or clock. Texts and units follow the ACL
Reference Guide for Controller-A (catalogue number 100083); where the guide does not define a text,
`AclStyle` does. The arm has five axes like the ER-7; its link lengths and encoder ratios are this
emulator's own. Stored programs are not emulated.

The arm is at its commanded position, unless `encoders` report the true one, for example that of a
physics engine's arm, which follows `commanded_rad` as well as it can.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from fingerpost.robot.emulator.faults import Fault
from fingerpost.robot.five_axis import FiveAxis
from fingerpost.robot.motion import MotionQueue, Path, Vector, straight

BASE_HEIGHT_MM = 358.5
SHOULDER_OFFSET_MM = 50.0
UPPER_ARM_MM = 300.0
FOREARM_MM = 250.0
TOOL_MM = 270.0

COUNTS_PER_RAD = np.array([8000.0, 8000.0, 8000.0, 4000.0, 4000.0])
"""Encoder ratios."""

JOINT_LIMITS_RAD = np.radians([[-125, 125], [-35, 135], [-150, 75], [-110, 110], [-180, 180]])
"""Range of each joint: base, shoulder, elbow, wrist pitch, wrist roll [rad]."""

HOME_UNITS = np.array([5197.0, 0.0, 9963.0, 623.0, -3.0])
"""Position at which all counts are zero: X, Y, Z [0.1 mm], P, R [0.1°]."""

CTRL_A, BACKSPACE, LF, CR, XON, XOFF = 0x01, 0x08, 0x0A, 0x0D, 0x11, 0x13
LINE_LENGTH = 80
_NAME = re.compile(r"[A-Z][A-Z0-9]{0,4}")
_CHECKED_SHARES = np.linspace(0.0, 1.0, 9)


_ARM = FiveAxis(
    shoulder_height=BASE_HEIGHT_MM,
    shoulder_offset=SHOULDER_OFFSET_MM,
    upper_arm=UPPER_ARM_MM,
    forearm=FOREARM_MM,
    tool=TOOL_MM,
    ranges_rad=JOINT_LIMITS_RAD,
)


def forward(joints: Vector) -> Vector:
    """Return X, Y, Z [0.1 mm], P, R [0.1°] of joint angles [rad]."""
    place = _ARM.place(joints)
    return np.concatenate([10 * place[:3], 10 * np.degrees(place[3:])])


def inverse(units: Vector) -> Vector | None:
    """Return the joint angles [rad] of a position, elbow up; None out of reach."""
    return _ARM.joints_rad(np.concatenate([units[:3] / 10, np.radians(units[3:] / 10)]))


def _home_joints() -> Vector:
    joints = inverse(HOME_UNITS)
    if joints is None:
        raise AssertionError("the home position is out of the arm's own reach")
    return joints


HOME_JOINTS_RAD = _home_joints()
IMPACT_RAD = 0.2
"""Deviation of a joint from its commanded angle that means a collision [rad]."""

PARKED_JOINTS_RAD = HOME_JOINTS_RAD + np.radians([20.0, -15.0, -10.0, 5.0, 30.0])
"""Joint angles when the controller is switched on, unknown to it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AclStyle:
    """Variants of an emulated controller.

    Attributes
    ----------
    echo : bool
        Whether to echo every character.
    page_lines : int
        Lines of a listing before it stops at `Type <cr>`.
    homing_s : float
        Duration of homing [s of the arm].
    full_speed_mm_s, acceleration_mm_s2 : float
        Speed of the gripper at `SPEED 100` [mm/s], and its acceleration [mm/s²].
    done : str
        Answer to a command without an answer of its own.
    spacing : numpy.random.Generator, optional
        Draws spacing and case of each listing; without it they follow the guide.
    """

    echo: bool = True
    page_lines: int = 20
    homing_s: float = 60.0
    full_speed_mm_s: float = 1000.0
    acceleration_mm_s2: float = 2000.0
    done: str = "Done."
    spacing: np.random.Generator | None = None


@dataclass(slots=True)
class _Question:
    """One value that the controller requests (`SETPV`, `TEACH`)."""

    prompt: str
    put: Callable[[int], None]


@dataclass(slots=True)
class _Position:
    """A named position: its coordinates, once recorded."""

    units: Vector | None = None


@dataclass(slots=True)
class MoveRecord:
    """One move that the controller accepted, for tests."""

    time_s: float
    goal_units: tuple[float, ...]


@dataclass(slots=True)
class _Homing:
    end_s: float
    fails_at: int | None


class _CommandError(Exception):
    """Carries the text of an error line out of a command."""


@dataclass(slots=True)
class _Output:
    held: bool = False
    waiting: bytearray = field(default_factory=bytearray)


class AclController:
    """The controller and its arm.

    Parameters
    ----------
    style : AclStyle
        Variants that the guide does not define.
    encoders : callable, optional
        Reads the true joint angles (5,) [rad]; by default they are as commanded.

    Attributes
    ----------
    homed, servos : bool
        Whether all axes are homed, and whether the motors are on.
    speed_percent : int
        The set speed.
    jaw_percent : int
        The gripper's opening.
    moves : list of MoveRecord
        All accepted moves.
    aborts : int
        Number of Ctrl-A and A received.
    """

    def __init__(
        self, style: AclStyle | None = None, *, encoders: Callable[[], Vector] | None = None
    ) -> None:
        self.style = style or AclStyle()
        self._encoders = encoders
        self.homed = False
        self.servos = False
        self.speed_percent = 50
        self.jaw_percent = 100
        self.moves: list[MoveRecord] = []
        self.aborts = 0
        self._echo = self.style.echo
        self._zero = PARKED_JOINTS_RAD  # angles at zero counts
        self._arm = MotionQueue(PARKED_JOINTS_RAD)
        self._positions: dict[str, _Position] = {}
        self._line = bytearray()
        self._questions: list[_Question] = []
        self._pages: list[str] = []
        self._homing: _Homing | None = None
        self._output = _Output()
        self._due: list[Fault] = []
        self._commands: dict[str, Callable[[list[str], float], list[str] | None]] = {
            "A": self._abort_command,
            "CLOSE": lambda _words, _now: self._jaw(0),
            "CLRCOM": lambda _words, _now: [],
            "COFF": self._coff,
            "CON": self._con,
            "DEFP": self._defp,
            "DELP": self._delp,
            "ECHO": lambda _words, _now: self._set_echo(True),
            "HERE": self._here,
            "HOME": self._home,
            "JAW": lambda words, _now: self._jaw(_whole(words, 0, 0, 100)),
            "LISTP": self._listp,
            "LISTPV": self._listpv,
            "MOVE": lambda words, now: self._move(words, now, linear=False),
            "MOVEL": lambda words, now: self._move(words, now, linear=True),
            "NOECHO": lambda _words, _now: self._set_echo(False),
            "OPEN": lambda _words, _now: self._jaw(100),
            "SETP": self._setp,
            "SETPV": self._setpv,
            "SETPVC": self._setpvc,
            "SPEED": self._speed,
            "TEACH": self._teach,
        }

    # Interface to a port.

    def receive(self, data: bytes, now_s: float) -> None:
        """Process bytes received at a time [s]."""
        self._run_events(now_s)
        for byte in data:
            self._take(byte, now_s)

    def poll(self, now_s: float) -> bytes:
        """Return the bytes that the controller sends by now."""
        self._run_events(now_s)
        if self._output.held:
            return b""
        data = bytes(self._output.waiting)
        self._output.waiting.clear()
        return data

    def next_due_s(self) -> float | None:
        """Return the time of the next unsolicited transmission [s], or None."""
        return self._homing.end_s if self._homing else None

    def inject(self, fault: Fault, now_s: float) -> None:
        """Simulate a fault of the arm or of the dialogue."""
        if fault is Fault.IMPACT:
            self._fail("53 IMPACT PROTECTION AXIS 2", now_s)
        elif fault is Fault.OVERLOAD:
            self._fail("55 THERMIC OVERLOAD AXIS 3", now_s)
        elif fault is Fault.ECHO_OFF:
            self._echo = False
        else:
            self._due.append(fault)

    # True state, for tests.

    def units(self, now_s: float) -> Vector:
        """Return the true position of the gripper: X, Y, Z [0.1 mm], P, R [0.1°]."""
        return forward(self._joints(now_s))

    def commanded_rad(self, now_s: float) -> Vector:
        """Return the commanded joint angles (5,) [rad], which an arm's motors follow."""
        return self._arm.position(now_s)

    def is_moving(self, now_s: float) -> bool:
        """Whether the arm moves."""
        return self._arm.is_moving(now_s)

    # The dialogue.

    def _take(self, byte: int, now_s: float) -> None:
        if byte == CTRL_A:
            self._line.clear()
            self._abort(now_s)
            self._say("\r\n>")
        elif byte in (XOFF, XON):
            self._output.held = byte == XOFF
        elif byte == CR:
            line = self._line.decode("latin-1")
            self._line.clear()
            if line.strip().upper() == "CLRCOM":
                self._output.held = False
            if self._echo:
                self._say("\r\n")
            self._carry_out(line, now_s)
        elif byte == BACKSPACE:
            del self._line[-1:]
        elif byte != LF and len(self._line) < LINE_LENGTH:
            self._line.append(byte)
            if self._echo:
                self._say(chr(byte))

    def _carry_out(self, line: str, now_s: float) -> None:
        if self._homing:
            if line.strip().upper() == "A":
                self._abort(now_s)
                self._say("\r\n>")
        elif self._questions:
            self._answer(line)
        elif self._pages:
            self._say_page()
        else:
            self._command(line, now_s)

    def _command(self, line: str, now_s: float) -> None:
        words = line.upper().replace("=", " ").split()
        if not words:
            self._say("\r\n>" if not self._echo else ">")
            return
        command = self._commands.get(words[0])
        try:
            if words[0] in ("MOVED", "MOVELD"):
                raise _CommandError(f"{words[0]} IS ALLOWED IN PROGRAMS ONLY")
            if command is None:
                raise _CommandError("UNKNOWN COMMAND")
            answer = command(words[1:], now_s)
        except _CommandError as error:
            answer = [f"*** {error}"]
        if answer is not None:
            self._pages = answer or [self.style.done]
            self._say_page()

    def _say_page(self) -> None:
        """Send the lines of a listing to the end of a page, or to the prompt."""
        size = 1 if self._take_due(Fault.PAGING) else self.style.page_lines
        lines, self._pages = self._pages[:size], self._pages[size:]
        self._say("".join(f"{line}\r\n" for line in lines))
        self._say("Type <cr>" if self._pages else ">")

    def _ask_next(self) -> None:
        self._say(self._questions[0].prompt if self._questions else f"{self.style.done}\r\n>")

    def _answer(self, line: str) -> None:
        question = self._questions.pop(0)
        text = line.strip()
        if text:
            try:
                question.put(int(text))
            except ValueError:
                self._questions.clear()
                self._say("*** 312 BAD POINT COORDINATE\r\n>")
                return
        self._ask_next()

    def _say(self, text: str) -> None:
        self._output.waiting += text.encode("latin-1")

    # Motion.

    def _run_events(self, now_s: float) -> None:
        self._protect(now_s)
        homing = self._homing
        if homing is None or now_s < homing.end_s:
            return
        self._homing = None
        if homing.fails_at is not None:
            self._say(f"*** HOME FAILURE AXIS {homing.fails_at}\r\n>")
            return
        self._zero = HOME_JOINTS_RAD
        self.homed = True
        self._say("HOMING COMPLETE (ROBOT)\r\n>")

    def _protect(self, now_s: float) -> None:
        """Switch off if a joint does not follow its command."""
        if self._encoders is None or not self.servos:
            return
        behind = np.abs(self._encoders() - self._arm.position(now_s))
        if (behind > IMPACT_RAD).any():
            self._fail(f"53 IMPACT PROTECTION AXIS {int(np.argmax(behind)) + 1}", now_s)

    def _abort(self, now_s: float) -> None:
        self.aborts += 1
        self._stand_still(now_s)

    def _stand_still(self, now_s: float) -> None:
        """End motion, homing, questions and listings."""
        self._homing = None
        self._questions.clear()
        self._pages.clear()
        self._arm.abort(now_s)

    def _fail(self, text: str, now_s: float) -> None:
        """Stop, switch the motors off and send the reason, even during input."""
        self._stand_still(now_s)
        if self._encoders is not None:
            self._arm = MotionQueue(self._encoders())  # motion continues from the true angles
        self.servos = False
        self._say(f"\r\n*** {text}\r\n>")

    def _move(self, words: list[str], now_s: float, *, linear: bool) -> list[str]:
        position = self._position(words)
        hundredths = _whole(words, 1, 1, 100_000) if len(words) > 1 else None
        if position.units is None:
            raise _CommandError("303 NO POSITION ASSIGNED")
        if not self.servos or not self.homed:
            raise _CommandError("304 AXIS DISABLED")
        path = self._path(position.units, linear=linear)
        if path is None or self._take_due(Fault.OUT_OF_RANGE):
            raise _CommandError("54 OUT OF RANGE")
        self.moves.append(MoveRecord(now_s, tuple(position.units)))
        if self._take_due(Fault.STICK):
            return []
        speed = self.style.full_speed_mm_s * self.speed_percent / 100
        if hundredths:
            speed = min(speed, path.length / (hundredths / 100)) or speed
        self._arm.add(path, speed, self.style.acceleration_mm_s2, now_s)
        return []

    def _path(self, goal: Vector, *, linear: bool) -> Path | None:
        """Return the path to a position, or None out of reach; its length is in mm."""
        start_joints, goal_joints = self._arm.end, inverse(goal)
        if goal_joints is None:
            return None
        start = forward(start_joints)
        line = straight(start / 10, goal / 10, lengths=slice(0, 3))
        if not linear:
            change = goal_joints - start_joints
            return Path(lambda share: start_joints + share * change, goal_joints, line.length)
        if any(inverse(10 * line.at(share)) is None for share in _CHECKED_SHARES):
            return None

        def on_line(share: float) -> Vector:
            joints = inverse(10 * line.at(share))
            return goal_joints if joints is None else joints

        return Path(on_line, goal_joints, line.length)

    # Commands. Each returns the lines of its answer; empty means done, None that more will follow.

    def _abort_command(self, _words: list[str], now_s: float) -> list[str]:
        self._abort(now_s)
        return []

    def _con(self, _words: list[str], _now_s: float) -> list[str]:
        self.servos = True
        return ["CONTROL ENABLED."]

    def _coff(self, _words: list[str], now_s: float) -> list[str]:
        self._arm.abort(now_s)
        self.servos = False
        return ["CONTROL DISABLED."]

    def _set_echo(self, on: bool) -> list[str]:
        self._echo = on
        return []

    def _home(self, _words: list[str], now_s: float) -> None:
        self._stand_still(now_s)
        self.homed, self.servos = False, True
        fails_at = 3 if self._take_due(Fault.HOME_FAILURE) else None
        start, change = self._arm.end, HOME_JOINTS_RAD - self._arm.end
        way = Path(lambda share: start + share * change, HOME_JOINTS_RAD, 1.0)
        span_s = self.style.homing_s
        end_s = self._arm.add(way, 1.0 / span_s, math.inf, now_s)
        self._homing = _Homing(now_s + span_s / 2 if fails_at else end_s, fails_at)
        self._say("WAIT!! HOMING...\r\n")

    def _speed(self, words: list[str], _now_s: float) -> list[str]:
        self.speed_percent = _whole(words, 0, 1, 100)
        return []

    def _jaw(self, percent: int) -> list[str]:
        if not self.servos:
            raise _CommandError("304 AXIS DISABLED")
        self.jaw_percent = percent
        return []

    def _defp(self, words: list[str], _now_s: float) -> list[str]:
        name = _name(words)
        if name in self._positions:
            raise _CommandError(f"POSITION {name} ALREADY DEFINED")
        self._positions[name] = _Position()
        return []

    def _delp(self, words: list[str], _now_s: float) -> list[str]:
        self._position(words)
        del self._positions[words[0]]
        return []

    def _here(self, words: list[str], now_s: float) -> list[str]:
        self._position(words).units = np.round(self._shown(now_s))
        return []

    def _setp(self, words: list[str], _now_s: float) -> list[str]:
        source = self._position(words[1:])
        if source.units is None:
            raise _CommandError("303 NO POSITION ASSIGNED")
        self._position(words).units = source.units.copy()
        return []

    def _setpvc(self, words: list[str], _now_s: float) -> list[str]:
        position = self._position(words)
        if position.units is None:
            raise _CommandError("303 NO POSITION ASSIGNED")
        if len(words) != 3 or words[1] not in AXIS_INDEX:
            raise _CommandError("312 BAD POINT COORDINATE")
        index = AXIS_INDEX[words[1]]
        position.units[index] = _whole(words, 2, -32768, 32767)
        if index < 3:  # P and R are lost by this, as users have reported
            position.units[3] += 2 + index
            position.units[4] -= 1 + index
        return []

    def _setpv(self, words: list[str], now_s: float) -> None:
        position = self._position(words)
        counts = self._counts_of(
            position.units if position.units is not None else self._shown(now_s)
        )

        def put(axis: int, value: int) -> None:
            counts[axis] = value
            position.units = np.round(forward(counts / COUNTS_PER_RAD + self._zero))

        self._questions = [
            _Question(f"{axis + 1} -- [{counts[axis]:.0f}] >", _bound(put, axis))
            for axis in range(5)
        ]
        self._ask_next()

    def _teach(self, words: list[str], now_s: float) -> None:
        position = self._position(words)
        units = (position.units if position.units is not None else self._shown(now_s)).copy()

        def put(axis: int, value: int) -> None:
            units[axis] = value
            position.units = units

        self._questions = [
            _Question(f"{name} --[{units[axis]:.0f}] >", _bound(put, axis))
            for name, axis in AXIS_INDEX.items()
        ]
        self._ask_next()

    def _listp(self, _words: list[str], _now_s: float) -> list[str]:
        return sorted(self._positions) or ["NO POSITIONS"]

    def _listpv(self, words: list[str], now_s: float) -> list[str]:
        if words[:1] == ["POSITION"]:
            units = self._shown(now_s)
        else:
            stored = self._position(words).units
            if stored is None:
                raise _CommandError("303 NO POSITION ASSIGNED")
            units = stored
        counts = self._counts_of(units)
        return [
            self._listing([f"{axis + 1}" for axis in range(5)], counts),
            self._listing(list(AXIS_INDEX), units),
        ]

    def _listing(self, labels: list[str], values: Vector) -> str:
        """Format labelled numbers as in the guide: with a space before a positive one."""
        numbers = [round(float(value)) for value in values]
        draw = self.style.spacing
        if draw is None:
            return " ".join(
                f"{label}:{' ' if number > 0 else ''}{number}"
                for label, number in zip(labels, numbers, strict=True)
            )
        return "".join(
            f"{' ' * draw.integers(1, 4)}{label.lower() if draw.random() < 0.5 else label}"
            f"{' ' * draw.integers(0, 2)}:{' ' * draw.integers(0, 4)}{number}"
            for label, number in zip(labels, numbers, strict=True)
        )

    # State of the arm as known to the controller.

    def _shown(self, now_s: float) -> Vector:
        """Return the present position according to the controller's counts."""
        joints = self._joints(now_s)
        counts = np.round((joints - self._zero) * COUNTS_PER_RAD)
        if self.homed:
            return forward(counts / COUNTS_PER_RAD + self._zero)
        return forward(counts / COUNTS_PER_RAD + HOME_JOINTS_RAD)

    def _joints(self, now_s: float) -> Vector:
        return self._arm.position(now_s) if self._encoders is None else self._encoders()

    def _counts_of(self, units: Vector) -> Vector:
        """Return a position's counts; zeros for one out of reach, which is stored nevertheless."""
        joints = inverse(units)
        if joints is None:
            return np.zeros(5)
        zero = self._zero if self.homed else HOME_JOINTS_RAD
        return np.asarray(np.round((joints - zero) * COUNTS_PER_RAD))

    def _position(self, words: list[str]) -> _Position:
        name = _name(words)
        if name not in self._positions:
            raise _CommandError(f"UNDEFINED POSITION {name}")
        return self._positions[name]

    def _take_due(self, fault: Fault) -> bool:
        if fault in self._due:
            self._due.remove(fault)
            return True
        return False


AXIS_INDEX = {"X": 0, "Y": 1, "Z": 2, "P": 3, "R": 4}


def _name(words: list[str]) -> str:
    if not words or not _NAME.fullmatch(words[0]):
        raise _CommandError("BAD POSITION NAME")
    return words[0]


def _whole(words: list[str], place: int, low: int, high: int) -> int:
    try:
        value = int(words[place])
    except (IndexError, ValueError):
        raise _CommandError("312 BAD POINT COORDINATE") from None
    if not low <= value <= high:
        raise _CommandError("312 BAD POINT COORDINATE")
    return value


def _bound(put: Callable[[int, int], None], axis: int) -> Callable[[int], None]:
    return lambda value: put(axis, value)
