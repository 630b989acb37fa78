"""Emulation of small G-code arms: Marlin with line numbers and checksums, uArm with `#n` and `$n`.

Bytes in, bytes out, at given times, as in `fingerpost.robot.emulator.acl`. The uArm follows the
vendor's protocol 4.2 and firmware 4.10: queries (`P…`) are answered at once, all other commands in
order, when the arm stands. While it plans a long `G1`, it only reads Ctrl-X; an interrupted motion
leaves the number of its answer, without a line's end.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fingerpost.robot.emulator.faults import Fault
from fingerpost.robot.emulator.mechanics import (
    CartesianMechanics,
    DexarmMechanics,
    Mechanics,
    UarmMechanics,
)
from fingerpost.robot.motion import MotionQueue, Vector, straight

PARKED_FROM_HOME_MM = np.array([10.0, 20.0, -30.0])
"""Position of an arm when it is switched on, relative to home."""

BUSY_S = 2.0
"""Interval of Marlin's busy messages [s]."""

MARLIN_BLOCKS, UARM_BLOCKS = 16, 18
"""Blocks that they plan ahead; until the last ones of a move fit, they process nothing else."""

UARM_FIRMWARE = "V4.10.0"

CTRL_X = b"\x18"

COASTING_S = 0.005
"""Time whose travel a motor slips when it is stopped without deceleration [s]."""

_WORD = re.compile(r"([A-Z])(-?\d+(?:\.\d+)?)")
_NUMBERED = re.compile(r"^N(\d+)\s*(\S.*)\*(\d+)$")
_EMERGENCY = re.compile(r"^(?:N\d+ ?)?(M410|M112)(?:\*\d+)?$")


@dataclass(slots=True)
class _Deferred:
    """An answer that is due at the end of the previous motion."""

    due_s: float
    text: str
    finish: Callable[[], None] = lambda: None


@dataclass(frozen=True, slots=True)
class _Planned:
    """Times at which a motion is completely planned, and ended [s]; whether it reaches its goal."""

    planned_s: float
    end_s: float
    whole: bool = True


class GcodeController:
    """Common part of the dialects: an arm, queued lines and deferred answers.

    Parameters
    ----------
    mechanics : Mechanics
        The arm.
    blocks : int
        Blocks that its controller plans ahead.

    Attributes
    ----------
    closed : bool
        Whether the tool is closed.
    homed : bool
        Whether homing has been done.
    moves : int
        Number of accepted moves.
    stops : int
        Number of executed stops.
    """

    def __init__(self, mechanics: Mechanics, blocks: int) -> None:
        self.closed = False
        self.homed = False
        self.moves = 0
        self.stops = 0
        self._mechanics = mechanics
        self._blocks = blocks
        self._arm = MotionQueue(mechanics.home_mm + PARKED_FROM_HOME_MM)
        self._slipped_mm = np.zeros(3)
        self._input = bytearray()
        self._output = bytearray()
        self._deferred: list[_Deferred] = []
        self._lines: list[str] = []
        self._due: list[Fault] = []
        self._feed = 3000.0
        self._ran_s = -math.inf

    def receive(self, data: bytes, now_s: float) -> None:
        """Process bytes received at a time [s]."""
        self._run_events(now_s)
        for byte in data:
            if self._urgent_byte(byte, now_s):
                continue
            if byte not in b"\r\n":
                self._input.append(byte)
            elif self._input:
                line = self._input.decode("latin-1")
                self._input.clear()
                self._look_ahead(line, now_s)
                self._lines.append(line)
        self._run_events(now_s)

    def poll(self, now_s: float) -> bytes:
        """Return the bytes that the controller sends by now."""
        self._run_events(now_s)
        data = bytes(self._output)
        self._output.clear()
        return data

    def next_due_s(self) -> float | None:
        """Return the time of the next unsolicited transmission [s], or None."""
        return min((answer.due_s for answer in self._deferred), default=None)

    def inject(self, fault: Fault, now_s: float) -> None:
        """Simulate a fault: `IMPACT` restarts the controller, others concern the next move."""
        if fault is Fault.IMPACT:
            self._arm.abort(now_s)
            self._forget()
            self.homed = False
            self._say("start")
        else:
            self._due.append(fault)

    def position_mm(self, now_s: float) -> Vector:
        """Return the true position of the hand: X, Y, Z [mm]."""
        return self._arm.position(now_s) + self._slipped_mm

    def is_moving(self, now_s: float) -> bool:
        """Whether the arm moves."""
        return self._arm.is_moving(now_s)

    # Hooks of the dialects.

    def _urgent_byte(self, byte: int, now_s: float) -> bool:
        """Execute an urgent byte; return whether it was one."""
        del byte, now_s
        return False

    def _look_ahead(self, line: str, now_s: float) -> None:
        """Execute an urgent line ahead of the queue; it is also executed in turn."""

    def _carry_out(self, line: str, now_s: float) -> None:
        raise NotImplementedError

    def _blocked(self, now_s: float) -> bool:
        """Whether the controller is too busy to read."""
        raise NotImplementedError

    # Common part.

    def _run_events(self, now_s: float) -> None:
        """Process due events in order of time."""
        while (due_s := self.next_due_s()) is not None and due_s <= now_s:
            self._run_moment(max(due_s, self._ran_s))
        self._run_moment(now_s)

    def _run_moment(self, now_s: float) -> None:
        self._ran_s = now_s
        for answer in sorted(self._deferred, key=lambda one: one.due_s):
            if answer.due_s <= now_s:
                self._deferred.remove(answer)
                answer.finish()
                self._say(answer.text)
        while self._lines and not self._blocked(now_s):
            self._carry_out(self._lines.pop(0), now_s)

    def _forget(self) -> None:
        """Drop everything that waits."""
        self._deferred.clear()
        self._lines.clear()
        self._input.clear()

    def _go(self, word: str, command: str, now_s: float) -> _Planned | None:
        """Queue a G0 or G1; return None out of reach."""
        words = dict(_WORD.findall(command))
        goal_mm = self._arm.end.copy()
        for place, letter in enumerate("XYZ"):
            if letter in words:
                goal_mm[place] = float(words[letter])
        self._feed = float(words.get("F", self._feed))
        if not self._mechanics.reaches(goal_mm) or self._take_due(Fault.OUT_OF_RANGE):
            return None
        self.moves += 1
        if self._take_due(Fault.STICK):
            return _Planned(now_s, now_s)
        way = self._mechanics.line if word == "G1" else self._mechanics.rapid
        run = way(self._arm.end, goal_mm, self._feed)
        start_s = self._end_s(now_s)
        end_s = self._arm.add(run.path, run.speed, run.acceleration, now_s)
        ahead = max(0.0, 1.0 - self._blocks / run.pieces)
        return _Planned(start_s + ahead * (end_s - start_s), end_s, run.whole)

    def _end_s(self, now_s: float) -> float:
        """Return the end of all queued motion [s]."""
        still = straight(self._arm.end, self._arm.end, lengths=slice(0, 3))
        return self._arm.add(still, 1.0, 1.0, now_s)

    def _say(self, text: str) -> None:
        if text:
            self._output += f"{text}\n".encode("latin-1")

    def _take_due(self, fault: Fault) -> bool:
        if fault in self._due:
            self._due.remove(fault)
            return True
        return False


class MarlinController(GcodeController):
    """Marlin: numbered lines with checksums, `ok`, `Resend`, `M400`, `M114` and `M410`.

    Parameters
    ----------
    mechanics : Mechanics, optional
        The arm; a Cartesian one by default.
    home_command : str
        `G28`, or the arm's own command.
    homing_s : float
        Duration of homing [s].
    emergency_parser : bool
        Whether to detect `M410` in the stream; otherwise it waits until its line is read.
    resend_ok : bool
        Whether to send `ok` after `Resend`, as versions before 2.0.8 do.
    slips : bool
        Whether motors slip, without notice, when `M410` stops them during motion.
    """

    def __init__(
        self,
        mechanics: Mechanics | None = None,
        *,
        home_command: str = "G28",
        homing_s: float = 10.0,
        emergency_parser: bool = True,
        resend_ok: bool = True,
        slips: bool = True,
    ) -> None:
        super().__init__(mechanics or CartesianMechanics(), MARLIN_BLOCKS)
        self._home_command = home_command
        self._homing_s = homing_s
        self._emergency_parser = emergency_parser
        self._resend_ok = resend_ok
        self._slips = slips
        self._last = 0

    def _look_ahead(self, line: str, now_s: float) -> None:
        if self._emergency_parser and _EMERGENCY.match(line.strip()):
            self._quick_stop(now_s)

    def _blocked(self, now_s: float) -> bool:
        del now_s
        return bool(self._deferred)

    def _carry_out(self, line: str, now_s: float) -> None:
        numbered = _NUMBERED.match(line)
        if not line.startswith("N"):
            self._command(line.strip(), now_s)
            return
        if numbered is None:
            self._ask_again("No Checksum with line number")
            return
        number, command, total = int(numbered[1]), numbered[2], int(numbered[3])
        computed = 0
        for byte in line[: line.rindex("*")].encode("latin-1"):
            computed ^= byte
        if not command.startswith("M110") and number != self._last + 1:
            self._ask_again("Line Number is not Last Line Number+1")
        elif computed != total:
            self._ask_again("checksum mismatch")
        else:
            self._last = number
            self._command(command, now_s)

    def _ask_again(self, reason: str) -> None:
        self._say(f"Error:{reason}, Last Line: {self._last}")
        self._say(f"Resend: {self._last + 1}")
        if self._resend_ok:
            self._say("ok")

    def _command(self, command: str, now_s: float) -> None:
        word = (command.split() or [""])[0].replace("G01", "G1")
        if word in ("G0", "G1"):
            self._move(word, command, now_s)
        elif word == self._home_command:
            self._home(now_s)
        elif word == "M400":
            self._defer(self._end_s(now_s), now_s)
        elif word == "M410":
            self._quick_stop(now_s)
            self._say("ok")
        elif word == "M112":
            self._quick_stop(now_s)
            self.homed = False
            self._say("Error:Printer halted. kill() called!")
        elif word == "M114":
            x, y, z = self._arm.end  # the goal, as Marlin reports it
            self._say(f"X:{x:.2f} Y:{y:.2f} Z:{z:.2f} E:0.00 Count X:0 Y:0 Z:0\nok")
        elif word == "M115":
            self._say("FIRMWARE_NAME:Marlin (emulated) PROTOCOL_VERSION:1.0 EXTRUDER_COUNT:0")
            self._say(f"Cap:EMERGENCY_PARSER:{self._emergency_parser:d}\nok")
        elif word in ("M1000", "M1001"):
            self.closed = word == "M1000"
            self._say("ok")
        elif word == "M280":  # a servo
            self.closed = not command.endswith("S0")
            self._say("ok")
        elif word in ("G21", "G90", "M110", "M17"):
            self._say("ok")
        else:
            self._say(f'echo:Unknown command: "{command}"\nok')

    def _move(self, word: str, command: str, now_s: float) -> None:
        if not self.homed:
            self._say("echo:Home XYZ First\nok")
        elif (planned := self._go(word, command, now_s)) is None:
            self._say("Error:target out of reach\nok")
        else:
            remark = "" if planned.whole else "XY beyond limit.....\n"
            self._defer(planned.planned_s, now_s, text=f"{remark}ok")

    def _home(self, now_s: float) -> None:
        path = straight(self._arm.end, self._mechanics.home_mm, lengths=slice(0, 3))
        end_s = self._arm.add(path, max(path.length, 1.0) / self._homing_s, math.inf, now_s)

        def finish() -> None:
            self.homed = True
            self._slipped_mm = np.zeros(3)

        self._defer(end_s, now_s, finish)

    def _defer(
        self,
        end_s: float,
        now_s: float,
        finish: Callable[[], None] = lambda: None,
        *,
        text: str = "ok",
    ) -> None:
        """Answer at a later time, with busy messages until then."""
        if end_s <= now_s:
            finish()
            self._say(text)
            return
        beats = np.arange(now_s + BUSY_S, end_s, BUSY_S)
        self._deferred += [_Deferred(float(beat), "echo:busy: processing") for beat in beats]
        self._deferred.append(_Deferred(end_s, text, finish))

    def _quick_stop(self, now_s: float) -> None:
        """Stop all motors at once; lines that waited for their motion continue."""
        self.stops += 1
        if self.is_moving(now_s) and self._slips:
            way_mm = self._arm.position(now_s) - self._arm.position(now_s - COASTING_S)
            self._slipped_mm = self._slipped_mm + way_mm
        self._arm.abort(now_s)
        waited = [answer.text for answer in self._deferred if answer.text.endswith("ok")]
        self._deferred.clear()
        for text in waited:
            self._say(text)


def make_dexarm(homing_s: float) -> MarlinController:
    """Return a DexArm's controller, which reads its encoders after `M410`.

    Parameters
    ----------
    homing_s : float
        Duration of homing [s].
    """
    return MarlinController(DexarmMechanics(), home_command="M1112", homing_s=homing_s, slips=False)


class UarmController(GcodeController):
    """The controller and its arm.

    Parameters
    ----------
    firmware : str
        Its version. Those before 4 treat Ctrl-X as a character of the next line.
    """

    def __init__(self, firmware: str = UARM_FIRMWARE) -> None:
        super().__init__(UarmMechanics(), UARM_BLOCKS)
        self._firmware = firmware
        self._planning = ("", 0.0)  # tag of the motion being planned, and the end of planning [s]

    def next_due_s(self) -> float | None:
        """Return the time of the next unsolicited transmission [s], or None."""
        due_s = super().next_due_s()
        if not self._lines:
            return due_s
        return self._planning[1] if due_s is None else min(due_s, self._planning[1])

    def _urgent_byte(self, byte: int, now_s: float) -> bool:
        if byte != CTRL_X[0] or int(self._firmware[1:].partition(".")[0]) < 4:
            return False
        self.stops += 1
        tag, until_s = self._planning
        self._arm.abort(now_s)
        planned = [answer.text for answer in self._deferred]
        self._forget()
        self._say("ok")
        for text in planned:
            if now_s < until_s and text.startswith(f"{tag} "):
                self._output += tag.encode("ascii")
            else:
                self._say(text)
        self._planning = ("", 0.0)
        return True

    def _blocked(self, now_s: float) -> bool:
        return now_s < self._planning[1]

    def _carry_out(self, line: str, now_s: float) -> None:
        head, _, command = line.partition(" ")
        if not re.fullmatch(r"#\d+", head) or not command:
            return  # as the firmware does for unknown commands
        tag = f"${head[1:]}"
        word = command.split()[0]
        if word in ("G0", "G1"):
            self._move(tag, word, command, now_s)
        elif word == "P2220":
            x, y, z = self._arm.position(now_s)
            self._say(f"{tag} ok X{x:.4f} Y{y:.4f} Z{z:.4f}")
        elif word == "P2203":
            self._say(f"{tag} ok {self._firmware}")
        elif word in ("M17", "M2231", "M2232"):
            if word != "M17":
                self.closed = command.endswith("V1")
            self._later(f"{tag} ok", now_s)
        else:
            self._later(f"{tag} E20", now_s)

    def _move(self, tag: str, word: str, command: str, now_s: float) -> None:
        planned = self._go(word, command, now_s)
        if planned is None:
            self._later(f"{tag} E22", now_s)
            return
        self.homed = True
        self._planning = (tag, planned.planned_s)
        self._deferred.append(_Deferred(planned.end_s, f"{tag} ok"))

    def _later(self, text: str, now_s: float) -> None:
        """Answer when the arm stands."""
        end_s = self._end_s(now_s)
        if end_s <= now_s:
            self._say(text)
        else:
            self._deferred.append(_Deferred(end_s, text))
