"""ACL, the command language of the Scorbot's Controller-A: its vocabulary, and its framing.

Sources: the ACL Reference Guide for Controller-A (Eshed Robotec, catalogue number 100083) and
public programs that use it. In DIRECT mode the controller echoes its input (unless switched off),
executes a command at its CR and ends the answer with a line that contains only the prompt `>`.
Spacing and case of answers vary, long listings stop at `Type <cr>`, and an error is a line that
begins with `***`, at any time.

An answer is only used if it matches as a whole. The echo of the command is the anchor: text before
it belongs to an earlier command. If a controller cannot be made to echo, there is no anchor; the
answer then ends with the prompt and a silence.
"""

from __future__ import annotations

import itertools
import re
import time
from collections.abc import Callable
from dataclasses import dataclass

from fingerpost.robot.errors import (
    CommandRefusedError,
    GarbledReplyError,
    OutOfReachError,
    RobotError,
    RobotFaultError,
    RobotTimeoutError,
)
from fingerpost.robot.serial_line import SerialLine

ABORT = b"\x01\x01A\r"
"""Ctrl-A, which needs no CR and acts in the middle of a line, followed by the command `A`.

Ctrl-A is sent twice, in case noise destroys one byte. If the controller keeps a partial line
nevertheless, the letter invalidates it: no command becomes another valid motion by an A at its end.
"""

AXES = ("X", "Y", "Z", "P", "R")
"""The Cartesian coordinates of a position, in 0.1 mm and 0.1°."""

FAULTS = {
    53: "impact protection",
    54: "out of range",
    55: "thermic overload",
    303: "no position assigned",
    304: "axis disabled",
    312: "bad point coordinate",
    317: "bad Cartesian point",
}
"""Errors by the controller's number."""

ARM_FAULTS = frozenset({53, 55, 304})
"""Errors after which a person must check the arm."""

OUT_OF_REACH = frozenset({54, 312, 317})
"""Errors caused by the goal."""

UNASKED = ARM_FAULTS | {54}
"""Unsolicited errors: of the arm, or of a queued move when it starts."""


CLRCOM_ATTEMPT = 2
"""Attempt to find the prompt from which a silent controller is sent `CLRCOM`."""


@dataclass(frozen=True, slots=True)
class AclError:
    """An error line: its number and axis, if it names them, and its text."""

    number: int | None
    axis: int | None
    text: str

    def exception(self) -> RobotError:
        """Return the corresponding exception."""
        meaning = FAULTS.get(self.number or 0, "error")
        message = f"controller: {meaning}: {self.text!r}"
        if self.number in OUT_OF_REACH:
            return OutOfReachError(message)
        if self.number in ARM_FAULTS:
            return RobotFaultError(message, number=self.number, axis=self.axis)
        return CommandRefusedError(message)


@dataclass(frozen=True, slots=True)
class AclPosition:
    """A position in the controller's representation.

    Attributes
    ----------
    counts : tuple of int
        Encoder counts of joints 1 … 5.
    coordinates : tuple of int
        X, Y, Z [0.1 mm], P, R [0.1°].
    """

    counts: tuple[int, ...]
    coordinates: tuple[int, ...]


_ERROR_LINE = re.compile(r"^[ \t>]*\*\*\*[ \t]*(?P<text>[^\r\n]*)[\r\n]", re.MULTILINE)
_NUMBER = re.compile(r"(?<!\w)\d{1,3}(?!\w)")
_AXIS = re.compile(r"axis\s*:?\s*(\d+)", re.IGNORECASE)
_JOINTS = re.compile(
    r"1\s*:\s*([-+]?\d{1,7})" + "".join(rf"\s+{n}\s*:\s*([-+]?\d{{1,7}})" for n in range(2, 6))
)
_CARTESIAN = re.compile(
    r"X\s*:\s*([-+]?\d{1,5})"
    + "".join(rf"\s+{axis}\s*:\s*([-+]?\d{{1,5}})" for axis in AXES[1:])
    + r"(?!\S)",
    re.IGNORECASE,
)
_PROMPT = re.compile(r"(?:^|[\r\n])[ \t]*>[ \t]*$")
_PAGE = re.compile(r"type\s*<cr>[^\r\n]*$", re.IGNORECASE)
_UNPRINTABLE = re.compile(r"[^\x20-\x7e\r\n\t]")


def find_errors(text: str) -> list[AclError]:
    """Return the complete error lines of a text."""
    return [_error(line["text"].strip()) for line in _ERROR_LINE.finditer(text)]


def _error(words: str) -> AclError:
    axis = _AXIS.search(words)
    number = _NUMBER.search(_AXIS.sub("", words))
    code = int(number[0]) if number else _number_of(words)
    return AclError(code, int(axis[1]) if axis else None, words)


def _number_of(words: str) -> int | None:
    """Find an error's number by its text, for a controller that prints no numbers."""
    plain = " ".join(words.lower().split())
    return next((number for number, meaning in FAULTS.items() if meaning.lower() in plain), None)


def parse_position(text: str) -> AclPosition:
    """Parse a `LISTPV` answer by its labels.

    Raises
    ------
    GarbledReplyError
        A label is missing, repeated or out of order, or there is other text between the numbers.
    """
    joints, cartesian = _JOINTS.findall(text), _CARTESIAN.findall(text)
    if len(joints) != 1 or len(cartesian) != 1 or _UNPRINTABLE.search(text):
        raise GarbledReplyError(f"the controller's position cannot be read: {text!r}")
    return AclPosition(tuple(map(int, joints[0])), tuple(map(int, cartesian[0])))


@dataclass(frozen=True, slots=True)
class AclTiming:
    """Time limits of the controller.

    Attributes
    ----------
    reply_s : float
        Longest time from a command to the end of its answer [s]. At 9600 baud a listing of 100
        characters alone takes 0.1 s.
    quiet_s : float
        Silence that confirms a prompt without an echo before it [s]; longer than the gap between
        two characters, and than the latency timer of a USB adapter (16 ms).
    resync_s : float
        Longest time to find the prompt again [s].
    """

    reply_s: float = 1.0
    quiet_s: float = 0.06
    resync_s: float = 3.0


class Conversation:
    """Commands and their answers on a line.

    Parameters
    ----------
    line : SerialLine
        An open line.
    timing : AclTiming
        Time-outs.
    tagged : bool
        Whether to number commands by the case of their first word's letters (`lISTPV`, `LiSTPV`,
        …). ACL ignores the case but echoes it, so a late answer to an earlier command cannot be
        mistaken for that to a later, identical one.
    clock : callable
        Monotonic time [s].
    """

    def __init__(
        self,
        line: SerialLine,
        timing: AclTiming,
        *,
        tagged: bool = True,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._line = line
        self._timing = timing
        self._tagged = tagged
        self._clock = clock
        self._echo = True
        self._tag = 0
        self._disturbance_numbers = itertools.count(1)  # another thread's stop disturbs as well
        self._disturbances = next(self._disturbance_numbers)
        self._synchronous_since = 0
        self._abort_again = False

    def disturb(self, *, aborted: bool = False) -> None:
        """Make the next command search for the prompt first.

        Parameters
        ----------
        aborted : bool
            Whether an abort has been sent; it is then repeated, as noise may have destroyed it.
        """
        self._disturbances = next(self._disturbance_numbers)
        self._abort_again |= aborted

    def synchronise(self, check: Callable[[], None]) -> None:
        """Find the prompt again if it has been lost; for exceptions see `ask`.

        Empty lines end a question of the controller (`X --[200] >`) or a listing. If it stays
        silent, `CLRCOM` frees a port that an XOFF has stopped. The echo is also tested, and
        switched on if it is off.
        """
        disturbances = self._disturbances
        if self._synchronous_since == disturbances:
            return
        self._line.release()
        if self._abort_again:
            self._abort_again = False
            self._line.send(ABORT)
        self._raise_unasked(self._find_prompt(check))
        self._echo = self._echoes(check)
        if not self._echo:
            self._line.send(b"ECHO\r")
            self._raise_unasked(self._until_quiet(check))
            self._echo = self._echoes(check)
        self._synchronous_since = disturbances

    def ask(
        self,
        command: str,
        check: Callable[[], None],
        send: Callable[[bytes], None] | None = None,
    ) -> str:
        """Send a command and return its answer, without echo and prompt.

        Parameters
        ----------
        command : str
            The command, without CR.
        check : callable
            Called every few milliseconds; an exception ends the wait.
        send : callable, optional
            Sends the bytes; the line's own `send` by default.

        Raises
        ------
        RobotFaultError, OutOfReachError, CommandRefusedError
            The answer is an error, or the arm has reported one.
        RobotTimeoutError
            No answer.
        GarbledReplyError
            An answer to another command, or with noise.
        """
        self.synchronise(check)
        self._raise_unasked(_text(self._line.drain()))
        disturbances = self._disturbances
        self._synchronous_since = 0  # until the answer is complete
        command = self._with_tag(command)
        (send or self._line.send)(command.encode("ascii") + b"\r")
        answer = self._answer(command, check)
        self._synchronous_since = disturbances
        for error in find_errors(answer):
            raise error.exception()
        if _UNPRINTABLE.search(answer):
            raise GarbledReplyError(f"{command}: noise in the answer {answer!r}")
        return answer

    def await_text(
        self,
        command: str,
        ends: re.Pattern[str],
        check: Callable[[], None],
        send: Callable[[bytes], None],
        on_line: Callable[[str], None],
    ) -> str:
        """Send a command and read until a text is received, without a time limit.

        Parameters
        ----------
        command : str
            The command, without CR.
        ends : pattern
            The text that ends it.
        check : callable
            Called every few milliseconds; an exception (such as a time-out) ends the wait.
        send : callable
            Sends the bytes.
        on_line : callable
            Called with every line received, and once a second with an empty one.

        Raises
        ------
        RobotFaultError, OutOfReachError, CommandRefusedError
            An error line came first.
        """
        self.synchronise(check)
        self._raise_unasked(_text(self._line.drain()))
        self._synchronous_since = 0
        send(command.encode("ascii") + b"\r")
        text, reported, last_reported_s = "", 0, self._clock()
        while True:
            check()
            text += _text(self._line.receive())
            while (newline := text.find("\n", reported)) >= 0:
                on_line(text[reported:newline].strip())
                reported, last_reported_s = newline + 1, self._clock()
            if self._clock() - last_reported_s >= 1.0:
                on_line("")
                last_reported_s = self._clock()
            for error in find_errors(text):
                if not ends.search(f"*** {error.text}\n"):
                    raise error.exception()
            if found := ends.search(text):
                return found[0]

    def _find_prompt(self, check: Callable[[], None]) -> str:
        """Send empty lines until there is a prompt; return all text received."""
        end_s = self._clock() + self._timing.resync_s
        received, attempt = "", 0
        while self._clock() < end_s:
            attempt += 1
            self._line.send(b"\r" if received or attempt < CLRCOM_ATTEMPT else b"CLRCOM\r")
            answer = self._until_quiet(check)
            received += answer
            if _PROMPT.search(answer):
                return received
        self._raise_unasked(received)
        kind = GarbledReplyError if received.strip() else RobotTimeoutError
        raise kind(f"no prompt from the controller; it sent {received[-80:]!r}")

    def _echoes(self, check: Callable[[], None]) -> bool:
        """Test by a harmless command whether the controller echoes its input."""
        probe = self._with_tag("LISTPV POSITION")
        self._line.send(probe.encode("ascii") + b"\r")
        answer = self._until_quiet(check)
        self._raise_unasked(answer)
        return probe in answer

    def _answer(self, command: str, check: Callable[[], None]) -> str:
        """Return the text between a command's echo and the prompt."""
        text = ""
        last_s = self._clock()
        end_s = last_s + self._timing.reply_s
        while True:
            check()
            fresh = _text(self._line.receive())
            now_s = self._clock()
            text = self._paged(text + fresh)
            last_s = now_s if fresh else last_s
            anchor = text.find(command) if self._echo else -1
            if anchor >= 0 and _PROMPT.search(text, anchor + len(command)):
                self._raise_unasked(text[:anchor])
                return text[anchor + len(command) : text.rindex(">")]
            if _PROMPT.search(text) and now_s - last_s >= self._timing.quiet_s:
                self._raise_unasked(text)
                if self._echo:
                    raise GarbledReplyError(f"{command}: not echoed in {text!r}")
                return text[: text.rindex(">")]
            if now_s > end_s:
                self._raise_unasked(text)
                if not text.strip():
                    raise RobotTimeoutError(
                        f"{command}: no answer within {self._timing.reply_s:g} s"
                    )
                raise GarbledReplyError(f"{command}: no prompt after {text!r}")

    def _until_quiet(self, check: Callable[[], None]) -> str:
        """Read until there is a silence, at most for the time of one answer."""
        text, last_s = "", self._clock()
        end_s = last_s + self._timing.reply_s
        while self._clock() < end_s:
            check()
            fresh = _text(self._line.receive())
            if fresh:
                text, last_s = self._paged(text + fresh), self._clock()
            elif text and self._clock() - last_s >= self._timing.quiet_s:
                break
        return text

    def _paged(self, text: str) -> str:
        """Request the next page if a listing stops at the end of one."""
        if not _PAGE.search(text):
            return text
        self._line.send(b"\r")
        return _PAGE.sub("", text)

    def _with_tag(self, command: str) -> str:
        if not self._tagged:
            return command
        word, space, rest = command.partition(" ")
        self._tag += 1  # one bit per letter of the word
        letters = (
            letter.lower() if self._tag >> place & 1 else letter
            for place, letter in enumerate(word)
        )
        return "".join(letters) + space + rest

    def _raise_unasked(self, text: str) -> None:
        """Raise unsolicited errors of the arm in a text that is not an answer."""
        for error in find_errors(text):
            if error.number in UNASKED:
                raise error.exception()


def _text(data: bytes) -> str:
    """Decode each byte separately, so that noise does not affect its neighbours."""
    return data.decode("latin-1")
