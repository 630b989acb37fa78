"""Small emulated G-code arms: Marlin with numbered lines and sums, and uArm with `#n` and `$n`.

Bytes in, bytes out, at given times, as in `fingerpost.robot.emulator.acl`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fingerpost.robot.emulator.faults import Fault
from fingerpost.robot.motion import MotionQueue, Vector, straight

MAX_REACH_MM = 320.0
HOME_MM = np.array([200.0, 0.0, 150.0, 0.0])
CTRL_X = b"\x18"
BUSY_S = 2.0
"""Marlin says that it is busy this often [s]."""

_WORD = re.compile(r"([A-Z])(-?\d+(?:\.\d+)?)")
_NUMBERED = re.compile(r"^N(\d+)\s*(\S.*)\*(\d+)$")


@dataclass(slots=True)
class _Deferred:
    """An answer that is due when the motion before it has ended."""

    due_s: float
    text: str
    finish: Callable[[], None] = lambda: None


class GcodeController:
    """The part that the dialects share: an arm, queued lines and answers due later.

    Parameters
    ----------
    acceleration_mm_s2 : float
        Of the arm [mm/s²].

    Attributes
    ----------
    closed : bool
        The gripper's state.
    homed : bool
        Homing has been done.
    moves : int
        Moves accepted.
    stops : int
        Stops received.
    """

    def __init__(self, *, acceleration_mm_s2: float = 2000.0) -> None:
        self.closed = False
        self.homed = False
        self.moves = 0
        self.stops = 0
        self._acceleration = acceleration_mm_s2
        self._arm = MotionQueue(HOME_MM + np.array([10.0, 20.0, -30.0, 0.0]))
        self._input = bytearray()
        self._output = bytearray()
        self._deferred: list[_Deferred] = []
        self._lines: list[str] = []
        self._due: list[Fault] = []
        self._speed_mm_s = 50.0

    def receive(self, data: bytes, now_s: float) -> None:
        """Take bytes from the line at a time [s]."""
        self._run_events(now_s)
        for byte in data:
            if self._urgent_byte(byte, now_s):
                continue
            if byte not in b"\r\n":
                self._input.append(byte)
            elif self._input:
                line = self._input.decode("latin-1")
                self._input.clear()
                if not self._urgent_line(line, now_s):
                    self._lines.append(line)
        self._run_events(now_s)

    def poll(self, now_s: float) -> bytes:
        """Return what the controller has to send by now."""
        self._run_events(now_s)
        data = bytes(self._output)
        self._output.clear()
        return data

    def next_due_s(self) -> float | None:
        """Return when it will next send something by itself [s], or None."""
        return min((answer.due_s for answer in self._deferred), default=None)

    def inject(self, fault: Fault, now_s: float) -> None:
        """Have a fault: `IMPACT` restarts the controller, others concern the next move."""
        if fault is Fault.IMPACT:
            self._stand_still(now_s)
            self.homed = False
            self._say("start")
        else:
            self._due.append(fault)

    def position_mm(self, now_s: float) -> Vector:
        """Return where the arm really is: X, Y, Z [mm], R [°]."""
        return self._arm.position(now_s)

    def is_moving(self, now_s: float) -> bool:
        """Whether the arm moves."""
        return self._arm.is_moving(now_s)

    # What the dialects add.

    def _urgent_byte(self, byte: int, now_s: float) -> bool:
        """Act on a byte that waits for no line; True if it was one."""
        del byte, now_s
        return False

    def _urgent_line(self, line: str, now_s: float) -> bool:
        """Act on a line that waits for no queue; True if it was one."""
        del line, now_s
        return False

    def _carry_out(self, line: str, now_s: float) -> None:
        raise NotImplementedError

    # What they share.

    def _run_events(self, now_s: float) -> None:
        for answer in sorted(self._deferred, key=lambda one: one.due_s):
            if answer.due_s <= now_s:
                self._deferred.remove(answer)
                answer.finish()
                self._say(answer.text)
        while self._lines and not self._blocked():
            self._carry_out(self._lines.pop(0), now_s)

    def _blocked(self) -> bool:
        """Whether lines wait for an answer that is due later."""
        return bool(self._deferred)

    def _stop(self, now_s: float) -> None:
        self.stops += 1
        self._stand_still(now_s)

    def _stand_still(self, now_s: float) -> None:
        """End motion and forget everything that waits."""
        self._arm.abort(now_s)
        self._deferred.clear()
        self._lines.clear()
        self._input.clear()

    def _go(self, command: str, now_s: float) -> float | None:
        """Queue a G0; return when it ends [s], or None where the arm cannot go."""
        words = dict(_WORD.findall(command))
        goal = self._arm.end.copy()
        for place, letter in enumerate("XYZR"):
            if letter in words:
                goal[place] = float(words[letter])
        if "F" in words:
            self._speed_mm_s = float(words["F"]) / 60
        if math.hypot(goal[0], goal[1]) > MAX_REACH_MM or self._take_due(Fault.OUT_OF_RANGE):
            return None
        self.moves += 1
        if self._take_due(Fault.STICK):
            return now_s
        path = straight(self._arm.end, goal, lengths=slice(0, 3))
        return self._arm.add(path, self._speed_mm_s, self._acceleration, now_s)

    def _end_s(self, now_s: float) -> float:
        """Return when everything queued will have ended [s]."""
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
    """Marlin: numbered lines with sums, `ok`, `Resend`, `M400`, `M114`, and an early `M410`.

    Parameters
    ----------
    home_command : str
        `G28`, or `M1112` for a Dobot-like arm.
    homing_s : float
        Time that homing takes [s].
    """

    def __init__(self, *, home_command: str = "G28", homing_s: float = 10.0) -> None:
        super().__init__()
        self._home_command = home_command
        self._homing_s = homing_s
        self._last = 0

    def _urgent_line(self, line: str, now_s: float) -> bool:
        if line.strip() not in ("M410", "M112"):
            return False
        self._stop(now_s)
        if line.strip() == "M112":
            self.homed = False
            self._say("Error:Printer halted. kill() called!")
        else:
            self._say("ok")
        return True

    def _carry_out(self, line: str, now_s: float) -> None:
        numbered = _NUMBERED.match(line)
        if numbered is None:
            self._say(f"Error:No Checksum with line number, Last Line: {self._last}")
            self._ask_again()
            return
        number, command, total = int(numbered[1]), numbered[2], int(numbered[3])
        computed = 0
        for byte in line[: line.rindex("*")].encode("latin-1"):
            computed ^= byte
        if computed != total:
            self._say(f"Error:checksum mismatch, Last Line: {self._last}")
            self._ask_again()
        elif not command.startswith("M110") and number != self._last + 1:
            self._say(f"Error:Line Number is not Last Line Number+1, Last Line: {self._last}")
            self._ask_again()
        else:
            self._last = number
            self._command(command, now_s)

    def _ask_again(self) -> None:
        self._say(f"Resend: {self._last + 1}\nok")

    def _command(self, command: str, now_s: float) -> None:
        word = command.split()[0]
        if word in ("G0", "G1"):
            if self._go(command, now_s) is None:
                self._say("Error:target out of reach")
            self._say("ok")
        elif word == self._home_command:
            self._home(now_s)
        elif word == "M400":
            self._defer(self._end_s(now_s), now_s)
        elif word == "M114":
            x, y, z, rotation = self._arm.end  # where it is going, as Marlin tells it
            self._say(f"X:{x:.2f} Y:{y:.2f} Z:{z:.2f} R:{rotation:.2f} Count X:0 Y:0 Z:0\nok")
        elif word in ("M1000", "M1001"):
            self.closed = word == "M1000"
            self._say("ok")
        elif word in ("G21", "G90", "M110", "M17"):
            self._say("ok")
        else:
            self._say(f'echo:Unknown command: "{command}"\nok')

    def _home(self, now_s: float) -> None:
        path = straight(self._arm.end, HOME_MM, lengths=slice(0, 3))
        end_s = self._arm.add(path, max(path.length, 1.0) / self._homing_s, math.inf, now_s)

        def finish() -> None:
            self.homed = True

        self._defer(end_s, now_s, finish)

    def _defer(self, end_s: float, now_s: float, finish: Callable[[], None] = lambda: None) -> None:
        beats = np.arange(now_s + BUSY_S, end_s, BUSY_S)
        self._deferred += [_Deferred(float(beat), "echo:busy: processing") for beat in beats]
        self._deferred.append(_Deferred(end_s, "ok", finish))


class UarmController(GcodeController):
    """uArm Swift Pro: `#n …` answered by `$n ok`, a move when it has ended, `P…` at once."""

    def _urgent_byte(self, byte: int, now_s: float) -> bool:
        if byte != CTRL_X[0]:
            return False
        self._stop(now_s)
        self._say("ok")
        return True

    def _blocked(self) -> bool:
        return False

    def _carry_out(self, line: str, now_s: float) -> None:
        head, _, command = line.partition(" ")
        if not re.fullmatch(r"#\d+", head) or not command:
            return  # as the firmware does with what it does not know
        tag = f"${head[1:]}"
        word = command.split()[0]
        if word == "G0":
            end_s = self._go(command, now_s)
            if end_s is None:
                self._say(f"{tag} E22")
            else:
                self.homed = True
                self._deferred.append(_Deferred(end_s, f"{tag} ok"))
        elif word == "P2220":
            x, y, z, _ = self._arm.position(now_s)
            self._say(f"{tag} ok X{x:.4f} Y{y:.4f} Z{z:.4f}")
        elif word == "M2232":
            self.closed = command.endswith("V1")
            self._say(f"{tag} ok")
        elif word == "M17":
            self._say(f"{tag} ok")
        else:
            self._say(f"{tag} E20")
