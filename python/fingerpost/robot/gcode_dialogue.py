"""Commands and answers of G-code controllers on a serial line, one at a time.

Marlin and related firmware number lines and add a checksum to each (`N7 G1 X10*92`). They answer
with `ok`, with or without further fields, after any number of other lines: `echo:busy: processing`
while they need more time, reports, remarks. A corrupt line is requested again (`Resend: 7`, `rs
N7`), with or without an `ok` after the request. A refused command is reported by a line that begins
with `Error:`, `ALARM:`, `fatal:` or `!!`, before its `ok` or instead of it; some controllers only
send a remark (`echo:Home XYZ First`). uArm answers by number (`$7 ok`, `$7 E22`).

Every error contains the text of the controller.
"""

from __future__ import annotations

import itertools
import math
import re
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from fingerpost.robot.errors import (
    CommandRefusedError,
    GarbledReplyError,
    HomingError,
    NotHomedError,
    OutOfReachError,
    RobotError,
    RobotFaultError,
    RobotTimeoutError,
)
from fingerpost.robot.serial_line import SerialLine

Position: TypeAlias = tuple[float, float, float]

RECOVERIES = 3
"""Number of attempts to resynchronise with the controller before giving up."""

RESENDS = 5
"""Number of repetitions of a line before the connection counts as broken."""

REMARKS_KEPT = 3
"""Number of last remarks of a controller that are added to an error; a message is one line."""

_NUMBER = r"([-+]?\d+(?:\.\d+)?)"
_COORDINATES = re.compile(
    # "X:1.00 Y:2.00 Z:3.00 E:…", also without the colons or the blanks, and "C: X:…".
    rf"^\s*(?:[A-Z]:\s+)?X:?\s*{_NUMBER}[\s,]*Y:?\s*{_NUMBER}[\s,]*Z:?\s*{_NUMBER}(?=[\s,A-Z]|$)",
    re.MULTILINE,
)
_OK = re.compile(r"^ok\b(?:\s*N(\d+)\b)?", re.IGNORECASE)
_BUSY = re.compile(r"^(?:echo:|//)?\s*busy\b", re.IGNORECASE)
_RESEND = re.compile(r"^(?:resend|rs)\b\s*:?\s*N?\s*(\d+)", re.IGNORECASE)
_LAST_LINE = re.compile(r"last line:?\s*(\d+)", re.IGNORECASE)
_ERROR = re.compile(r"^(?:(?:error|alarm|fatal)\b|!!)", re.IGNORECASE)
_QUOTED = re.compile(r"unknown command:?\s*\"(.*)\"", re.IGNORECASE)
_UNKNOWN = re.compile(r"unknown command|not supported|unsupported", re.IGNORECASE)
_UNHOMED = re.compile(r"\bhom(?:e|ing)\b.*\bfirst\b|\bhomed\b|\bmust home\b", re.IGNORECASE)
_HOMING_FAILED = re.compile(r"(?:hom|prob)ing fail|no trigger|still triggered", re.IGNORECASE)
_BEYOND = re.compile(
    r"beyond limit|out of (?:range|reach)|outside|unreachable|not reachable", re.IGNORECASE
)
_REACH_IN_ERROR = re.compile(r"reach|range|limit|outside|soft endstop", re.IGNORECASE)
_HALTED = re.compile(r"halt|kill|stopp?ed|stop called|shutdown|^alarm|^fatal|^!!$", re.IGNORECASE)
_RESTARTED = re.compile(r"^(?:start|(?:echo:)?(?:grbl|marlin|smoothie)\b.*|@1)$", re.IGNORECASE)
_REPORT = re.compile(r"^(?:wait$|Cap:|FIRMWARE_NAME:|(?:\w+ ){0,2}[A-Z]\d?:\s*[-+\d])")
_HASH_REPLY = re.compile(
    # An interrupted motion leaves its number in the output, without an answer or a line's end.
    r"^(?:\$\d+)*\$(\d+)\s+(ok|E\d+)\b(.*)$",
    re.IGNORECASE,
)
_HASH_ERROR = re.compile(r"^E(\d+)\b")
_UARM_ERRORS = {
    20: "no such command",
    21: "bad parameter",
    22: "address out of range",
    23: "command buffer full",
    24: "power not connected",
    25: "operation failed",
    26: "an encoder does not answer",
    27: "its motors are switched off",
}
_UARM_FAULTS = frozenset({24, 25, 26, 27})
_UNREACHABLE = 22


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """A command, and parameters of the wait for its answer.

    Attributes
    ----------
    command : str
        The command.
    check : callable
        Raises to end the wait.
    send : callable
        Sends its bytes.
    moves : bool
        Whether it moves the arm or the gripper; a remark then counts as a refusal.
    extra_s : float
        Additional time for the answer [s]; infinity waits until `check` raises.
    on_line : callable
        Called with every line received meanwhile.
    """

    command: str
    check: Callable[[], None]
    send: Callable[[bytes], None]
    moves: bool = False
    extra_s: float = 0.0
    on_line: Callable[[str], None] = lambda _: None


@dataclass(slots=True)
class _Answer:
    """Received part of an answer: its lines, a refusal, and the number of a line to resend."""

    lines: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    wanted: int | None = None


def parse_position(answer: str) -> Position:
    """Parse a position [mm] by its labels.

    Raises
    ------
    GarbledReplyError
        No position, or more than one.
    """
    found = _COORDINATES.findall(answer)
    if len(found) != 1:
        raise GarbledReplyError(f"no position in {answer!r}")
    x, y, z = map(float, found[0])
    return x, y, z


def checksummed(number: int, command: str) -> str:
    """Return a line with Marlin's number and checksum: the XOR of all bytes before the star."""
    body = f"N{number} {command}"
    total = 0
    for byte in body.encode("ascii"):
        total ^= byte
    return f"{body}*{total}"


class Dialogue(ABC):
    """Sends commands, receives answers, and resynchronises after a disturbance.

    Parameters
    ----------
    line : SerialLine
        Line to the controller.
    clock : callable
        Monotonic time [s].
    reply_s : float
        Longest time to an answer [s].
    quiet_s : float
        Silence that ends the output of the controller [s].
    after_stop : sequence of str
        Commands that make it ready again.

    Attributes
    ----------
    remarks : deque of str
        Its last messages other than answers; the reader clears them.
    """

    def __init__(
        self,
        line: SerialLine,
        clock: Callable[[], float],
        *,
        reply_s: float,
        quiet_s: float,
        after_stop: Sequence[str] = (),
    ) -> None:
        self.remarks: deque[str] = deque(maxlen=REMARKS_KEPT)
        self._line = line
        self._clock = clock
        self._reply_s = reply_s
        self._quiet_s = quiet_s
        self._after_stop = after_stop
        self._number = 0
        self._text = ""
        self._last_line = ""
        self._slip_numbers = itertools.count(1)
        self._slips = next(self._slip_numbers)  # number of events that lose synchronisation
        self._in_step_since = 0

    def disturb(self) -> None:
        """Report that unsolicited answers may follow; harmless at any time."""
        self._slips = next(self._slip_numbers)

    def distrust(self) -> None:
        """Report that the last answer may belong to another command."""
        self._in_step_since = 0

    def ask(self, request: Request) -> str:
        """Send a command and return the lines of its answer.

        Raises
        ------
        RobotTimeoutError, GarbledReplyError
            No answer, or none that belongs to the command.
        CommandRefusedError, OutOfReachError, NotHomedError, HomingError, RobotFaultError
            The controller refuses it; the message contains its text.
        """
        if self._in_step_since != self._slips:
            self.recover(request.check)
        in_step_since, self._in_step_since = self._in_step_since, 0  # until the answer is complete
        answer = self._exchange(request)
        self._in_step_since = in_step_since
        return answer

    def recover(self, check: Callable[[], None]) -> None:
        """Resynchronise with a controller, and make it ready again.

        Raises
        ------
        RobotTimeoutError, GarbledReplyError
            There is no valid answer.
        """
        slips = self._slips
        for _ in range(RECOVERIES):
            self._drain(check)
            if self._falls_in_step(check):
                break
        else:
            raise GarbledReplyError(
                "the controller's answers do not belong to what it is asked; the last was "
                f"{self._last_line!r}"
            )
        for command in self._after_stop:
            self._exchange(Request(command=command, check=check, send=self._line.send))
        self._in_step_since = slips

    @abstractmethod
    def _exchange(self, request: Request) -> str:
        """Send a numbered command until it is received; return the lines of its answer."""

    @abstractmethod
    def _falls_in_step(self, check: Callable[[], None]) -> bool:
        """Whether answers are now synchronous with commands."""

    def _drain(self, check: Callable[[], None]) -> None:
        """Read until there is a silence; the text may report a restart."""
        quiet_s = self._clock() + self._quiet_s
        while self._clock() < quiet_s:
            check()
            if data := self._line.receive():
                self._text += data.decode("latin-1")
                quiet_s = self._clock() + self._quiet_s
        answer, self._text = self._text, ""
        for line in answer.splitlines():
            _need_no_restart(line.strip())

    def _next_line(self, check: Callable[[], None]) -> str:
        """Return the next complete line, or an empty one after a short wait."""
        check()
        if "\n" not in self._text:
            self._text += self._line.receive().decode("latin-1")
        line, newline, rest = self._text.partition("\n")
        if not newline:
            return ""
        self._text = rest
        self._last_line = line.strip() or self._last_line
        return line.strip()

    def _notice(self, line: str) -> None:
        """Process a line that is not an answer."""
        _need_no_restart(line)
        if line and not _REPORT.match(line):
            self.remarks.append(line)

    def _silence(self, command: str, limit_s: float) -> RobotTimeoutError:
        last = f"; the last line was {self._last_line!r}" if self._last_line else ""
        return RobotTimeoutError(f"{command}: no answer within {limit_s:g} s{last}")


class ChecksumDialogue(Dialogue):
    """Marlin's dialogue.

    Parameters
    ----------
    line, clock, reply_s, quiet_s, after_stop
        As for `Dialogue`.
    where : str
        Queries the position, whose answer cannot be mistaken for another.
    """

    def __init__(
        self,
        line: SerialLine,
        clock: Callable[[], float],
        *,
        reply_s: float,
        quiet_s: float,
        after_stop: Sequence[str] = (),
        where: str,
    ) -> None:
        super().__init__(line, clock, reply_s=reply_s, quiet_s=quiet_s, after_stop=after_stop)
        self._where = where
        self._bare_resends = False  # it sends no ok after a request to resend
        self._spare_ok = False  # the ok of such a request may still follow

    def ask(self, request: Request) -> str:
        """As `Dialogue.ask`; an `ok` that may be of a request to resend does not end the wait."""
        answer = self._ask_once(request)
        if self._spare_ok and math.isinf(request.extra_s) and not request.moves:
            answer = self._ask_once(request)
        return answer

    def _ask_once(self, request: Request) -> str:
        self._spare_ok = False
        answer = super().ask(request)
        if self._spare_ok:
            self.distrust()
        return answer

    def _falls_in_step(self, check: Callable[[], None]) -> bool:
        """Restart the line numbers; a position shows whether each `ok` belongs to its line."""
        self._number = -1
        try:
            self._exchange(Request(command="M110 N0", check=check, send=self._line.send))
            answer = self._exchange(Request(command=self._where, check=check, send=self._line.send))
        except GarbledReplyError:
            return False
        return _COORDINATES.search(answer) is not None

    def _exchange(self, request: Request) -> str:
        self._number += 1
        line = f"{checksummed(self._number, request.command)}\n".encode("ascii")
        for _ in range(RESENDS):
            request.send(line)
            if (answer := self._answer(request)) is not None:
                return answer
        raise GarbledReplyError(
            f"{request.command}: asked for again {RESENDS} times; the line is noisy"
        )

    def _answer(self, request: Request) -> str | None:
        """Wait for `ok`; None if the controller requests the line again."""
        answer = _Answer()
        end_s = self._clock() + self._reply_s + request.extra_s
        while self._clock() < end_s:
            line = self._next_line(request.check)
            if not line:
                continue
            request.on_line(line)
            if ok := _OK.match(line):
                if ok[1] and int(ok[1]) != self._number:
                    continue  # it names another line
                self._bare_resends &= answer.wanted is None
                answer.lines.append(line[2:])
                return self._outcome(request, answer)
            if _BUSY.match(line):
                end_s = max(end_s, self._clock() + self._reply_s)
            elif self._objects(line, request, answer):
                end_s = self._clock() + self._quiet_s  # an ok may follow
            else:
                self._notice(line)
                answer.lines.append(line)
        if answer.wanted is not None:
            self._spare_ok |= not self._bare_resends
            self._bare_resends = True
        elif not answer.errors:
            raise self._silence(request.command, self._reply_s + request.extra_s)
        return self._outcome(request, answer)

    def _objects(self, line: str, request: Request, answer: _Answer) -> bool:
        """Store a request to resend or a refusal of the command; return False for other lines."""
        if again := _RESEND.match(line):
            answer.wanted = int(again[1])
        elif again := _LAST_LINE.search(line):
            answer.wanted = int(again[1]) + 1
        elif self._is_of_another_line(line, request.command):
            answer.wanted = self._number  # noise has destroyed even its number
        elif _is_refusal(line, request):
            answer.errors.append(line)
        else:
            return False
        return True

    def _outcome(self, request: Request, answer: _Answer) -> str | None:
        """Return a complete answer, None if it requests the line again, or raise its error."""
        if answer.wanted is not None:
            return None if self._wants_again(answer.wanted) else "\n".join(answer.lines)
        if answer.errors:
            raise _refusal(request.command, "; ".join(answer.errors))
        return "\n".join(answer.lines)

    def _is_of_another_line(self, line: str, command: str) -> bool:
        """Whether a controller refuses a command other than the one that was sent."""
        quoted = _QUOTED.search(line)
        sent = (command, checksummed(self._number, command))
        return quoted is not None and not any(one.startswith(quoted[1]) for one in sent)

    def _wants_again(self, wanted: int) -> bool:
        """Whether a controller requests the last line again, rather than the next one.

        Raises
        ------
        RobotFaultError
            It requests the very first line: it has restarted.
        GarbledReplyError
            It requests another line.
        """
        if self._number == 0:  # this line sets the number
            return True
        if wanted in (self._number, self._number + 1):
            return wanted == self._number
        words = f"the controller asks for line {wanted}; {self._number} is the last that was sent"
        if wanted == 1:
            raise RobotFaultError(f"{words}: it has restarted")
        raise GarbledReplyError(words)


class HashDialogue(Dialogue):
    """uArm's dialogue: a motion may be answered only at its end, a query at once."""

    def _drain(self, check: Callable[[], None]) -> None:
        """Read until there is a silence, after ending a possible partial line."""
        self._line.send(b"\n")
        super()._drain(check)

    def _falls_in_step(self, check: Callable[[], None]) -> bool:
        """Return True: answers are numbered."""
        del check
        return True

    def _exchange(self, request: Request) -> str:
        self._number += 1
        request.send(f"#{self._number} {request.command}\n".encode("ascii"))
        accepts = request.moves and not math.isinf(request.extra_s)
        limit_s = self._quiet_s if accepts else self._reply_s + request.extra_s
        end_s = self._clock() + limit_s
        while self._clock() < end_s:
            line = self._next_line(request.check)
            reply = _HASH_REPLY.match(line)
            if reply and reply[2].lower() != "ok":
                raise _uarm_error(request.command, int(reply[2][1:]))
            if reply and int(reply[1]) == self._number:
                return str(reply[3])
            if error := _HASH_ERROR.match(line):
                raise _uarm_error(request.command, int(error[1]))
            if not reply:
                self._notice(line)
        if accepts:  # it has not been refused in time
            return ""
        raise self._silence(request.command, limit_s)


def _need_no_restart(line: str) -> None:
    """Raise for a controller's greeting: one that restarts has lost its home position."""
    if _RESTARTED.match(line):
        raise RobotFaultError(f"the controller has restarted: {line!r}")


def _is_refusal(line: str, request: Request) -> bool:
    """Whether a line refuses a command."""
    if _ERROR.match(line) or _UNKNOWN.search(line):
        return True
    return request.moves and bool(_UNHOMED.search(line) or _BEYOND.search(line))


def _refusal(command: str, words: str) -> RobotError:
    """Return the error for a controller's text."""
    message = f"{command}: the controller says {words!r}"
    if _UNKNOWN.search(words):
        return CommandRefusedError(f"{command}: the controller knows no such command: {words!r}")
    if _UNHOMED.search(words):
        return NotHomedError(f"{message}: call home() first")
    if _HOMING_FAILED.search(words):
        return HomingError(message)
    if _HALTED.search(words):
        return RobotFaultError(message)
    if _REACH_IN_ERROR.search(words):
        return OutOfReachError(message)
    return CommandRefusedError(message)


def _uarm_error(command: str, code: int) -> RobotError:
    message = f"{command}: E{code}, {_UARM_ERRORS.get(code, 'unknown error')}"
    if code == _UNREACHABLE:
        return OutOfReachError(message)
    if code in _UARM_FAULTS:
        return RobotFaultError(message, number=code)
    return CommandRefusedError(message)
