"""Replies of other G-code firmwares: parsing, waiting, resending, and errors in their own words.

Each controller is the emulated Marlin with one habit of a real firmware, on a pseudo-terminal.
"""

import itertools
import re
import time

import numpy as np
import pytest
from gcode_rig import BRIEF_REPLY_S, FAR, GOAL, gcode_rig
from robot_rig import TIME_SCALE

from fingerpost.robot.emulator.faults import Fault
from fingerpost.robot.emulator.gcode import MarlinController
from fingerpost.robot.errors import (
    CommandRefusedError,
    GarbledReplyError,
    HomingError,
    NotArrivedError,
    NotHomedError,
    OutOfReachError,
    RobotFaultError,
    RobotTimeoutError,
)
from fingerpost.robot.gcode_dialogue import parse_position
from fingerpost.robot.protocol import RobotState

POSITION = re.compile(r"^X:(\S+) Y:(\S+) Z:(\S+) E:.*$")


class Habit(MarlinController):
    """A Marlin with different replies.

    Parameters
    ----------
    says : callable, optional
        Maps a line of its reply to the one that is sent.
    refuses : int
        Every `refuses`-th numbered line is treated as garbled.
    **options
        As for `MarlinController`.
    """

    def __init__(self, says=None, *, refuses=0, **options):
        super().__init__(homing_s=1.0, **options)
        self.says = says or (lambda line: line)
        self.refuses = refuses
        self.lines = 0

    def _say(self, text):
        for line in text.split("\n"):
            said = self.says(line)
            if said is not None:
                super()._say(said)

    def _carry_out(self, line, now_s):
        self.lines += 1
        if self.refuses and self.lines % self.refuses == 0 and "M110" not in line:
            self._ask_again("checksum mismatch")
        else:
            super()._carry_out(line, now_s)


def position_as(template):
    """Return a mapping that replaces the format of M114 replies."""
    return lambda line: POSITION.sub(lambda found: template.format(*found.groups()), line)


def instead(old, new):
    """Return a mapping that replaces a text."""
    return lambda line: line.replace(old, new)


def go_about(rig):
    """Move back and forth; in arm time, waiting for silence takes long."""
    for goal in (GOAL, FAR, GOAL):
        rig.robot.move_to(goal, timeout_s=100.0)
        rig.assert_at(goal)
        assert rig.robot.pose().distance_m(goal) < 1e-5


@pytest.mark.parametrize(
    "template",
    [
        "X:{}Y:{}Z:{}E:0.00 Count X: 0.00Y:0.00Z:0.00",
        "X:{} Y:{} Z:{}",
        "X:{} Y:{} Z:{} E:0.00 Count X: 0.00 Y:0.00 Z:0.00",
        "X:{} Y:{} Z:{} E:0.000 E0:0.0 Count 0 0 0 Machine 0.000 0.000 0.000 Bed comp 0.000",
        "X:{},Y:{},Z:{},E:0.000",
        "C: X:{} Y:{} Z:{} E:0.0000",
        "X:{} Y:{} Z:{} E:0.00 Count A:0 B:0 C:0\nReal position X:9.00 Y:9.00 Z:9.00 E:0.00\n"
        "DEXARM Theta A:0.00  Theta B:0.00  Theta C:0.00\n",
    ],
)
def test_positions_in_many_forms(template):
    with gcode_rig("marlin", Habit(position_as(template))) as rig:
        go_about(rig)


def test_a_position_after_the_ok():
    """Smoothieware's `ok C: X:…`."""
    held = []

    def says(line):
        if POSITION.match(line):
            held.append(position_as("ok C: X:{} Y:{} Z:{} E:0.0000")(line))
            return None
        return held.pop() if held and line == "ok" else line

    with gcode_rig("marlin", Habit(says)) as rig:
        go_about(rig)


@pytest.mark.parametrize(
    "text",
    [
        "X:1.00 Y:2.00",
        "Y:1.00 X:2.00 Z:3.00",
        "Count X:1.00 Y:2.00 Z:3.00",
        "X:1.00 Y:2.00 Z:3.00\nX:1.00 Y:2.00 Z:4.00",
        "X:nan Y:nan Z:nan",
        "X:1.00 Y:2.00 Z:3.00\x93",
    ],
)
def test_invalid_positions_are_refused(text):
    with pytest.raises(GarbledReplyError):
        parse_position(text)


@pytest.mark.parametrize(
    "ok",
    [
        "ok P15 B3",
        "OK",
        "ok T:20.0 /0.0 B:20.0 /0.0 @:0",
        "ok 5",
        "wait\nok\nwait",
        "T:20.1 /0.0\nok",
    ],
)
def test_an_ok_with_additional_text(ok):
    with gcode_rig("marlin", Habit(lambda line: ok if line == "ok" else line)) as rig:
        go_about(rig)


def test_an_ok_with_a_line_number():
    """`ADVANCED_OK`; an `ok` of another line, such as a stop's, is ignored."""

    class Advanced(Habit):
        def _command(self, command, now_s):
            if command.startswith("G01"):
                self._output += b"ok N0 P15 B3\n"
            super()._command(command, now_s)

    controller = Advanced()
    controller.says = lambda line: f"ok N{controller._last} P15 B3" if line == "ok" else line
    with gcode_rig("marlin", controller) as rig:
        go_about(rig)


@pytest.mark.parametrize("resend", ["Resend: {}", "Resend:{}", "resend: {}", "rs {}", "rs N{}"])
@pytest.mark.parametrize("resend_ok", [True, False])
@pytest.mark.parametrize("refuses", [2, 3, 4])
def test_a_requested_line_is_resent(resend, resend_ok, refuses):
    def says(line):
        found = re.fullmatch(r"Resend: (\d+)", line)
        return resend.format(found[1]) if found else line

    controller = Habit(says, refuses=refuses, resend_ok=resend_ok)
    with gcode_rig("marlin", controller) as rig:
        go_about(rig)
        lines = "".join(rig.sent()).split("\n")
    assert any(one == again and one.startswith("N") for one, again in itertools.pairwise(lines))


@pytest.mark.parametrize(
    ("error", "resend"),
    [
        ("Error:expected line {} got 99", "Resend:{}"),  # Repetier
        ("Error:Wrong checksum", "Resend:{}"),
        ("Error:checksum mismatch, Last Line: 0", "Resend: {}"),  # only the resend request counts
    ],
)
def test_the_error_before_a_resend_request_is_not_the_commands(error, resend):
    wanted = []

    def says(line):
        if line.startswith("Error:checksum"):
            wanted[:] = re.findall(r"Last Line: (\d+)", line)
            return error.format(int(wanted[0]) + 1)
        return resend.format(line.split()[-1]) if line.startswith("Resend") else line

    with gcode_rig("marlin", Habit(says, refuses=4)) as rig:
        go_about(rig)


def test_a_reset_line_count_is_a_restart():
    """Only its resend request shows the restart: its first message was lost."""
    with gcode_rig("marlin") as rig:
        rig.robot.move_to(GOAL)
        rig.controller._last = 0
        with pytest.raises(RobotFaultError, match=r"asks for line 1.*restarted"):
            rig.robot.move_to(FAR)
        assert rig.robot.status().state is RobotState.FAULT


def test_a_restart_between_two_commands_is_noticed():
    with gcode_rig("marlin") as rig:
        rig.robot.move_to(GOAL)
        rig.emulator.inject(Fault.IMPACT)
        time.sleep(0.02)
        rig.robot.stop()
        with pytest.raises(RobotFaultError, match="restarted"):
            rig.robot.move_to(FAR)


@pytest.mark.parametrize("busy", ["echo:busy: processing", "busy: processing", "// busy"])
def test_busy_extends_the_wait(busy):
    class Slow(Habit):
        def _move(self, word, command, now_s):
            self._go(word, command, now_s)
            self._defer(self._end_s(now_s), now_s)  # like a board with a full planner

    controller = Slow(instead("echo:busy: processing", busy))
    with gcode_rig("marlin", controller, reply_s=BRIEF_REPLY_S * TIME_SCALE) as rig:
        rig.robot.move_to(GOAL)
        begin_s = time.monotonic()
        rig.robot.move_to(FAR, speed_m_s=0.004)  # 55 s, four time-outs
        assert time.monotonic() - begin_s > 3 * BRIEF_REPLY_S
        rig.assert_at(FAR)


# Refusals by the board.


def refusing(words, *, ok=True):
    """Return a board that refuses every motion while `refusing` is set."""

    class Refusing(Habit):
        refusing = False

        def _move(self, word, command, now_s):
            if not self.refusing:
                super()._move(word, command, now_s)
                return
            self._say(words)
            if ok:
                self._say("ok")

    return Refusing()


@pytest.mark.parametrize("ok", [True, False])
@pytest.mark.parametrize(
    ("words", "error"),
    [
        ("echo:Home XYZ First", NotHomedError),  # Marlin
        ("echo:Home XY first", NotHomedError),
        ("Error: G0/G1: insufficient axes homed", NotHomedError),  # RepRapFirmware
        ("!! Must home axis first: 100.000 50.000 120.000 [0.000]", NotHomedError),  # Klipper
        ("Send M1112 or click HOME to initialize DexArm first before any motion.", NotHomedError),
        ("XY beyond limit.....", OutOfReachError),  # DexArm
        ("!! Move out of range: 400.000 0.000 0.000 [0.000]", OutOfReachError),
        ("Error: G1: target position outside machine limits", OutOfReachError),
        ("error:Soft Endstop X was exceeded - reset or $X or M999 required", OutOfReachError),
        ("Error:Printer stopped due to errors. Fix the error and use M999", RobotFaultError),
        ("Error:Printer halted. kill() called!", RobotFaultError),
        ("!!", RobotFaultError),  # Smoothieware, halted
        ("ALARM: Hard limit +X", RobotFaultError),
        ("ALARM:1", RobotFaultError),  # grbl
        ("fatal:Heater/sensor error", RobotFaultError),  # Repetier
        ("error:20", CommandRefusedError),
        ("error: Unsupported command", CommandRefusedError),
        ("Error:Something of its own", CommandRefusedError),
        ('// Unknown command:"G01"', CommandRefusedError),
    ],
)
def test_the_boards_own_reason_is_passed_on(words, error, ok):
    controller = refusing(words, ok=ok)
    with gcode_rig("marlin", controller) as rig:
        rig.robot.move_to(GOAL)
        controller.refusing = True
        with pytest.raises(error) as refused:
            rig.robot.move_to(FAR)
        assert words in str(refused.value)
        assert "\n" not in str(refused.value)
        rig.assert_at(GOAL)
        needs_homing = error in (NotHomedError, RobotFaultError)
        assert rig.robot.status().homed is not needs_homing
        controller.refusing = False
        if needs_homing:
            rig.robot.home()
        rig.robot.move_to(FAR)
        rig.assert_at(FAR)


@pytest.mark.parametrize(
    "words",
    [
        "Error:Homing Failed\nError:Printer halted. kill() called!",  # Marlin
        "!! No trigger on x after full movement",  # Klipper
        "!! Endstop x still triggered after retract",
    ],
)
def test_an_axis_that_fails_to_home_is_reported(words):
    class Failing(Habit):
        def _home(self, _now_s):
            self._say(f"{words}\nok")

    with gcode_rig("marlin", Failing(), home=False) as rig:
        with pytest.raises(HomingError) as failed:
            rig.robot.home()
        assert all(line in str(failed.value) for line in words.split("\n"))
        assert rig.robot.status().state is RobotState.FAULT


def test_an_unknown_remark_is_passed_on_if_the_arm_has_not_arrived():
    """The remark is unknown and the arm does not move."""
    controller = refusing("echo:Motors are on holiday")
    with gcode_rig("marlin", controller) as rig:
        controller.refusing = True
        with pytest.raises(NotArrivedError, match="has said 'echo:Motors are on holiday'"):
            rig.robot.move_to(GOAL)


def test_a_timeout_quotes_the_last_reply():
    with (
        gcode_rig("marlin", Habit(instead("ok", "huh")), connect=False) as rig,
        pytest.raises((RobotTimeoutError, GarbledReplyError), match="'huh'"),
    ):
        rig.robot.connect()


def test_a_board_without_m410_is_refused():
    class Klipper(Habit):
        def _command(self, command, now_s):
            if command.startswith("M410"):
                self._say('// Unknown command:"M410"\nok')
            else:
                super()._command(command, now_s)

    with gcode_rig("marlin", Klipper(emergency_parser=False), connect=False) as rig:
        with pytest.raises(
            CommandRefusedError, match=r"nothing would stop this arm: M410.*Unknown"
        ):
            rig.robot.connect()
        assert rig.controller.moves == 0


def test_a_board_with_another_protocol_is_refused_in_its_own_words():
    """grbl accepts neither numbered lines with checksums nor M114; an error replaces its `ok`."""

    class Grbl(Habit):
        def _carry_out(self, line, _now_s):
            self._say("error:1" if "*" in line else "error:20")

    with (
        gcode_rig("marlin", Grbl(), connect=False) as rig,
        pytest.raises(CommandRefusedError, match="'error:1'"),
    ):
        rig.robot.connect()


def test_a_dexarm_that_meets_a_joint_limit_on_its_path_is_an_error():
    """`G1` of a DexArm ends at its joint limits; here both end points are in reach."""
    with gcode_rig("dexarm") as rig:
        rig.robot.move_to(GOAL.at_height(0.02))
        rig.robot.move_to(type(GOAL)(0.17, 0.09, 0.02))
        with pytest.raises(OutOfReachError, match="XY beyond limit"):
            rig.robot.move_to(type(GOAL)(-0.17, 0.09, 0.02))
        pose = rig.robot.pose()
        np.testing.assert_allclose(pose.position_m, rig.true_m(), atol=1e-5)
