"""G-code arms, tested through the bytes of emulated controllers."""

import math
import threading
import time
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from robot_rig import TIME_SCALE, RunningTime, Tape, assert_in_time, best_of_three

from fingerpost.errors import InvalidInputError
from fingerpost.robot.emulator.faults import Fault
from fingerpost.robot.emulator.gcode import HOME_MM, MarlinController, UarmController
from fingerpost.robot.emulator.ports import Emulator, PtyPort
from fingerpost.robot.errors import (
    CommandRefusedError,
    ConnectionLostError,
    GarbledReplyError,
    GripperError,
    NotArrivedError,
    NotHomedError,
    NotReadyError,
    OutOfReachError,
    RobotFaultError,
    RobotTimeoutError,
    StoppedError,
)
from fingerpost.robot.gcode import (
    DOBOT,
    LEAST_SPEED_M_S,
    MARLIN,
    MAX_SPEED_M_S,
    UARM,
    GcodeArm,
    GcodeOptions,
    checksummed,
)
from fingerpost.robot.protocol import GripperKind, Pose, Robot, RobotState
from fingerpost.robot.registry import open_robot

BOX = {"lower_m": (0.0, -0.3, -0.1), "upper_m": (0.32, 0.3, 0.2), "max_speed_m_s": 0.2}
GOAL = Pose(0.2, 0.05, 0.1)
FAR = Pose(0.2, -0.2, 0.1)

ARMS = {
    "marlin": (MARLIN, lambda: MarlinController(homing_s=1.0)),
    "dobot": (DOBOT, lambda: MarlinController(home_command="M1112", homing_s=1.0)),
    "uarm": (UARM, UarmController),
}


class Rig:
    def __init__(self, robot, controller, emulator, tape, clock):
        self.robot = robot
        self.controller = controller
        self.emulator = emulator
        self.tape = tape
        self.clock = clock

    def true_m(self):
        return self.controller.position_mm(self.clock())[:3] / 1000

    def is_moving(self):
        return self.controller.is_moving(self.clock())


@contextmanager
def gcode_rig(name, *, home=True, **options):
    dialect, make = ARMS[name]
    clock, tape, controller = RunningTime(TIME_SCALE), Tape(), make()
    options = GcodeOptions(
        **{
            "reply_s": 0.3 * TIME_SCALE,
            "accept_s": 0.02 * TIME_SCALE,
            "poll_s": 0.0,
            "stall_s": 0.05 * TIME_SCALE,
            "gripper_s": 0.5,
            **BOX,
            **options,
        }
    )
    with Emulator(controller, PtyPort(), clock=clock, slow_s=0.05 * TIME_SCALE) as emulator:
        robot = GcodeArm(
            emulator.address, dialect, options, tap=tape, clock=clock, sleep=clock.sleep
        )
        with robot:
            if home:
                robot.home()
            yield Rig(robot, controller, emulator, tape, clock)


def wait_until(true):
    end_s = time.monotonic() + 5.0
    while not true():
        assert time.monotonic() < end_s
        time.sleep(0.001)


@pytest.fixture(params=ARMS)
def name(request):
    return request.param


def test_it_is_a_robot(name):
    assert isinstance(GcodeArm("/dev/null", ARMS[name][0]), Robot)


def test_it_goes_where_it_is_sent_and_says_where_it_is(name):
    with gcode_rig(name) as rig:
        assert rig.controller.homed
        for goal in (GOAL, FAR, GOAL):
            rig.robot.move_to(goal)
            assert not rig.is_moving()
            np.testing.assert_allclose(rig.true_m(), goal.position_m, atol=1e-5)
            assert rig.robot.pose().distance_m(goal) < 1e-5


def test_a_command_that_the_controller_does_not_know_is_none_that_it_has_done(monkeypatch):
    monkeypatch.setitem(ARMS, "another", (DOBOT, lambda: MarlinController(homing_s=1.0)))
    with gcode_rig("another", home=False) as rig:
        with pytest.raises(CommandRefusedError, match=r"M1112: .* no such command"):
            rig.robot.home()
        assert not rig.robot.status().homed
        assert not rig.is_moving()


def test_an_arm_is_never_sent_a_feed_rate_of_nothing(name):
    with gcode_rig(name) as rig:
        moves = rig.controller.moves
        with pytest.raises(InvalidInputError, match="least speed"):
            rig.robot.move_to(GOAL, speed_m_s=1e-6)
        assert rig.controller.moves == moves


def test_moves_can_be_queued(name):
    with gcode_rig(name) as rig:
        for goal in (FAR, GOAL):
            rig.robot.move_to(goal, wait=False)
        assert rig.robot.status().state is RobotState.MOVING
        rig.robot.wait()
        np.testing.assert_allclose(rig.true_m(), GOAL.position_m, atol=1e-5)


def test_a_pose_is_never_the_goal_of_a_move_that_still_runs(name):
    with gcode_rig(name) as rig:
        rig.robot.move_to(GOAL)
        rig.robot.move_to(FAR, speed_m_s=0.05, wait=False)
        before = rig.true_m()
        pose = rig.robot.pose()
        after = rig.true_m()
        low, high = np.minimum(before, after) - 1e-4, np.maximum(before, after) + 1e-4
        assert ((low <= pose.position_m) & (pose.position_m <= high)).all()


@best_of_three
def test_a_stop_passes_every_queue(name):
    with gcode_rig(name) as rig:
        errors = []

        def move():
            try:
                rig.robot.move_to(FAR, speed_m_s=0.01)
            except StoppedError as error:
                errors.append(error)

        mover = threading.Thread(target=move)
        mover.start()
        wait_until(rig.is_moving)
        seen = len(rig.emulator.wire)
        stops = rig.controller.stops
        called_s = time.monotonic()
        rig.robot.stop()
        wait_until(lambda: rig.controller.stops > stops)
        arrived_s = next(event.time_s for event in rig.emulator.wire[seen:] if not event.sent)
        assert_in_time(called_s, arrived_s)
        mover.join(5.0)
        assert len(errors) == 1
        assert not rig.is_moving()
        rig.robot.move_to(GOAL)
        np.testing.assert_allclose(rig.true_m(), GOAL.position_m, atol=1e-5)


def test_nothing_moves_before_homing(name):
    with gcode_rig(name, home=False) as rig:
        with pytest.raises(NotHomedError):
            rig.robot.move_to(GOAL)
        assert rig.controller.moves == 0


def test_the_gripper(name):
    commands = {"open_gripper": "M1001", "close_gripper": "M1000"} if name == "marlin" else {}
    with gcode_rig(name, **commands) as rig:
        rig.robot.gripper("close")
        assert rig.controller.closed
        rig.robot.gripper("open")
        assert not rig.controller.closed
        with pytest.raises(GripperError, match="width"):
            rig.robot.gripper(0.01)


def test_a_goal_that_the_arm_refuses(name):
    with gcode_rig(name) as rig:
        with pytest.raises(OutOfReachError):
            rig.robot.move_to(Pose(0.31, 0.28, 0.1))
        rig.robot.move_to(GOAL)


def test_an_arm_that_does_not_go_is_found_out():
    with gcode_rig("uarm") as rig:
        rig.emulator.inject(Fault.STICK)
        with pytest.raises(NotArrivedError):
            rig.robot.move_to(GOAL)


def test_silence_is_a_timeout(name):
    with gcode_rig(name) as rig:
        rig.emulator.inject(Fault.SILENT, count=1000)
        with pytest.raises(RobotTimeoutError):
            rig.robot.move_to(GOAL)
        rig.emulator.heal()
        rig.robot.move_to(GOAL)


def test_a_slow_answer_is_waited_for(name):
    with gcode_rig(name) as rig:
        rig.emulator.inject(Fault.SLOW, count=3)
        rig.robot.move_to(GOAL)
        np.testing.assert_allclose(rig.true_m(), GOAL.position_m, atol=1e-5)


def test_the_cable_is_pulled_and_put_back(name):
    with gcode_rig(name) as rig:
        rig.emulator.inject(Fault.UNPLUG)
        with pytest.raises(ConnectionLostError):
            rig.robot.move_to(GOAL)
        rig.emulator.inject(Fault.PLUG)
        rig.robot.reconnect()
        with pytest.raises(NotHomedError):
            rig.robot.move_to(GOAL)
        rig.robot.home()
        rig.robot.move_to(GOAL)


def test_a_marlin_has_no_limits_of_its_own():
    with gcode_rig("marlin", lower_m=None, upper_m=None) as rig:
        with pytest.raises(NotReadyError, match="limits"):
            rig.robot.move_to(GOAL)
        assert rig.controller.moves == 0


def test_a_uarm_has():
    robot = GcodeArm("/dev/null", UARM)
    assert robot.limits.gripper is GripperKind.OPEN_CLOSE
    with pytest.raises(InvalidInputError):
        robot.limits.check(Pose(0.2, 0.0, 0.1, roll_rad=0.0))


@pytest.mark.parametrize(
    ("options", "changes"),
    [
        ("lower_m=0.1,-0.1,0.02", {"lower_m": (0.1, -0.1, 0.02)}),
        ("upper_m=0.3,0.2,0.1", {"upper_m": (0.3, 0.2, 0.1)}),
        ("max_speed_m_s=0.02", {"max_speed_m_s": 0.02}),
    ],
)
def test_every_limit_that_is_given_holds_over_a_uarms_own(options, changes):
    limits = open_robot(f"uarm:///dev/null?{options}").limits
    assert limits == replace(UARM.limits, min_speed_m_s=LEAST_SPEED_M_S, **changes)


@pytest.mark.parametrize(("given", "missing"), [("lower_m", "upper_m"), ("upper_m", "lower_m")])
def test_half_a_box_is_refused_where_there_is_no_other_half(given, missing):
    with pytest.raises(InvalidInputError, match=f"{missing} is missing"):
        open_robot(f"marlin:///dev/null?{given}=0.1,0.2,0.3")


def test_a_box_alone_is_gone_through_slowly():
    url = "marlin:///dev/null?lower_m=0,0,0&upper_m=0.1,0.1,0.1"
    assert open_robot(url).limits.max_speed_m_s == MAX_SPEED_M_S
    assert open_robot(f"{url}&max_speed_m_s=0.2").limits.max_speed_m_s == 0.2


def test_a_dobot_like_arm_turns_its_gripper():
    with gcode_rig("dobot") as rig:
        rig.robot.move_to(Pose(0.2, 0.0, 0.1, roll_rad=math.radians(30)))
        assert rig.controller.position_mm(rig.clock())[3] == pytest.approx(30)
        assert rig.robot.pose().roll_rad == pytest.approx(math.radians(30))


# Marlin's numbered lines.


@given(st.integers(0, 99_999), st.text("GMXYZF0123456789. -", min_size=1, max_size=40))
def test_a_line_and_its_sum_cancel(number, command):
    line = checksummed(number, command)
    body, total = line.rsplit("*", 1)
    assert body == f"N{number} {command}"
    left = int(total)
    for byte in body.encode():
        left ^= byte
    assert left == 0


def test_golden_dialogue_with_marlin():
    controller = MarlinController(homing_s=5.0)
    dialogue = [
        (0.0, checksummed(0, "M110 N0"), "ok\n"),
        (0.0, checksummed(1, "G21"), "ok\n"),
        (0.0, "N2 G90*1", "Error:checksum mismatch, Last Line: 1\nResend: 2\nok\n"),
        (
            0.0,
            checksummed(3, "G90"),
            "Error:Line Number is not Last Line Number+1, Last Line: 1\nResend: 2\nok\n",
        ),
        (0.0, "G90", "Error:No Checksum with line number, Last Line: 1\nResend: 2\nok\n"),
        (0.0, checksummed(2, "G28"), ""),
        (3.0, "", "echo:busy: processing\n"),
        (4.5, "", "echo:busy: processing\n"),
        (6.0, "", "ok\n"),
        (6.0, checksummed(3, "G0 X200 Y50 Z150 F6000"), "ok\n"),
        # The goal, while the arm has hardly left.
        (6.0, checksummed(4, "M114"), "X:200.00 Y:50.00 Z:150.00 R:0.00 Count X:0 Y:0 Z:0\nok\n"),
        (6.0, checksummed(5, "M400"), ""),
        (6.4, "", ""),
        (6.6, "", "ok\n"),
        (6.6, checksummed(6, "M999"), 'echo:Unknown command: "M999"\nok\n'),
        (6.6, checksummed(7, "G0 X900"), "Error:target out of reach\nok\n"),
        (6.6, "M410", "ok\n"),
    ]
    for now_s, line, answer in dialogue:
        if line:
            controller.receive(f"{line}\n".encode(), now_s)
        assert (line, controller.poll(now_s).decode()) == (line, answer)


def test_golden_conversation_with_marlin():
    with gcode_rig("marlin") as rig:
        rig.robot.move_to(Pose(0.2, 0.0, 0.15))
    transfers = [data.decode() for way, data in rig.tape.transfers if way == "out"]
    assert transfers == [
        "\nM410\n",
        f"{checksummed(0, 'M110 N0')}\n",
        f"{checksummed(1, 'M114')}\n",
        f"{checksummed(2, 'G21')}\n",
        f"{checksummed(3, 'G90')}\n",
        f"{checksummed(4, 'G28')}\n",
        f"{checksummed(5, 'M400')}\n",
        f"{checksummed(6, 'G0 X200.00 Y0.00 Z150.00 F12000')}\n",
        f"{checksummed(7, 'M400')}\n",
        f"{checksummed(8, 'M114')}\n",
        f"{checksummed(9, 'M114')}\n",
        f"{checksummed(10, 'M400')}\n",
        f"{checksummed(11, 'M114')}\n",
        "\nM410\n",
    ]


def test_a_spoilt_line_is_sent_again():
    with gcode_rig("marlin") as rig:
        for _ in range(5):
            rig.emulator.inject(Fault.GARBLED_INPUT)
            rig.robot.move_to(GOAL)
            np.testing.assert_allclose(rig.true_m(), GOAL.position_m, atol=1e-5)
        assert any(b"Resend" in data for _, data in rig.tape.transfers)


def test_a_line_that_is_always_spoilt_is_given_up():
    with gcode_rig("marlin") as rig:
        rig.emulator.inject(Fault.GARBLED_INPUT, count=1000)
        with pytest.raises((GarbledReplyError, RobotTimeoutError)):
            rig.robot.move_to(GOAL)


def test_a_late_ok_is_not_taken_for_that_of_a_later_line(monkeypatch):
    """A stop's own `ok` comes after the silence that should have held it."""
    with gcode_rig("marlin") as rig:
        drain = rig.robot._drain

        def drain_too_early(turn):
            monkeypatch.setattr(rig.robot, "_drain", drain)

        rig.robot.stop()
        monkeypatch.setattr(rig.robot, "_drain", drain_too_early)
        rig.robot.move_to(FAR, speed_m_s=0.1)
        np.testing.assert_allclose(rig.true_m(), FAR.position_m, atol=1e-5)


def test_a_controller_that_restarts_has_lost_its_home():
    with gcode_rig("marlin") as rig:
        rig.robot.move_to(FAR, speed_m_s=0.01, wait=False)
        rig.emulator.inject(Fault.IMPACT)
        with pytest.raises(RobotFaultError, match="restarted"):
            rig.robot.wait()
        assert rig.robot.status().state is RobotState.FAULT
        rig.robot.home()
        rig.robot.move_to(GOAL)


def test_homing_of_a_marlin_is_waited_for_while_it_says_busy():
    heard = []
    with gcode_rig("marlin", home=False) as rig:
        rig.controller._homing_s = 60.0  # 1.2 s of ours, four time-outs of an answer
        rig.robot.home(lambda progress: heard.append(progress.message))
    assert "echo:busy: processing" in heard


# uArm's numbered lines.


def test_golden_dialogue_with_a_uarm():
    controller = UarmController()
    x, y, z, _ = controller.position_mm(0.0)
    dialogue = [
        ("#1 M17", "$1 ok\n"),
        ("#2 P2220", f"$2 ok X{x:.4f} Y{y:.4f} Z{z:.4f}\n"),
        ("#3 M2232 V1", "$3 ok\n"),
        ("#4 G0 X900 Y0 Z0 F1000", "$4 E22\n"),
        ("#5 Q1", "$5 E20\n"),
        ("#6 G0 X200 Y0 Z150 F6000", ""),
        ("#7 P2220", f"$7 ok X{x:.4f} Y{y:.4f} Z{z:.4f}\n"),
        ("nonsense", ""),
    ]
    for line, answer in dialogue:
        controller.receive(f"{line}\n".encode(), 0.0)
        assert (line, controller.poll(0.0).decode()) == (line, answer)
    assert controller.poll(60.0) == b"$6 ok\n"
    np.testing.assert_allclose(controller.position_mm(60.0)[:3], HOME_MM[:3])


def test_a_command_that_a_uarm_does_not_know():
    with gcode_rig("uarm", close_gripper="M9999") as rig:
        with pytest.raises(CommandRefusedError, match="E20"):
            rig.robot.gripper("close")
        assert rig.robot.status().state is RobotState.IDLE
