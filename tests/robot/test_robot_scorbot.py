"""The Scorbot driver, tested through the bytes of an emulated controller."""

import math
import socket
import threading
import time

import numpy as np
import pytest
import serial
import serial.rfc2217
from robot_rig import TIME_SCALE, Tape, fast_options, over_table, random_goal, scorbot_rig

from fingerpost.errors import InvalidInputError
from fingerpost.robot.acl import ABORT
from fingerpost.robot.emulator.acl import AclStyle
from fingerpost.robot.emulator.faults import Fault
from fingerpost.robot.emulator.ports import TcpPort
from fingerpost.robot.errors import (
    ConnectionLostError,
    GarbledReplyError,
    GripperError,
    HomingError,
    NotArrivedError,
    NotHomedError,
    NotReadyError,
    OutOfReachError,
    RobotError,
    RobotFaultError,
    RobotTimeoutError,
    StoppedError,
)
from fingerpost.robot.protocol import Pose, Robot, RobotState
from fingerpost.robot.scorbot import POSITION_NAMES, Scorbot, ScorbotOptions
from fingerpost.robot.serial_line import Flow

INSTANT = AclStyle(homing_s=0.05 * TIME_SCALE, full_speed_mm_s=1e9, acceleration_mm_s2=1e14)
"""An arm that moves instantaneously."""

NEAR_M = 1.2e-3
"""The driver's arrival tolerance, and rounding."""


def test_golden_conversation():
    """Connect, home, move, grip: all bytes in order."""
    with scorbot_rig(INSTANT) as rig:
        rig.robot.move_to(Pose(0.4, -0.02, 0.1, pitch_rad=-math.pi / 2, roll_rad=0.1))
        rig.robot.gripper("close")
        rig.robot.gripper(0.035)
    listing_home = b"1:0 2:0 3:0 4:0 5:0\r\nX: 5197 Y:0 Z: 9963 P: 623 R:-3\r\n>"
    listing_goal = (
        b"1:-400 2:-2541 3:-9462 4:-4631 5: 419\r\nX: 4000 Y:-200 Z: 1000 P:-900 R: 57\r\n>"
    )
    assert rig.tape.transfers == [
        # Two aborts stop any motion; then the driver looks for the prompt and the echo.
        ("out", ABORT + ABORT + b"\r"),
        ("in", b"\r\n>\r\n>A\r\nDone.\r\n>" * 2 + b"\r\n>"),
        ("out", b"lISTPV POSITION\r"),
        ("in", b"lISTPV POSITION\r\n" + listing_home),
        ("out", b"HOME\r"),
        ("in", b"HOME\r\nWAIT!! HOMING...\r\nHOMING COMPLETE (ROBOT)\r\n>"),
        # HOME ends with a text in place of the prompt; the driver finds the prompt again.
        ("out", b"\r"),
        ("in", b"\r\n>"),
        ("out", b"LiSTPV POSITION\r"),
        ("in", b"LiSTPV POSITION\r\n" + listing_home),
        ("out", b"deFP FP00\r"),
        ("in", b"deFP FP00\r\nDone.\r\n>"),
        ("out", b"HErE FP00\r"),
        ("in", b"HErE FP00\r\nDone.\r\n>"),
        ("out", b"sEtPVC FP00 X 4000\r"),
        ("in", b"sEtPVC FP00 X 4000\r\nDone.\r\n>"),
        ("out", b"SetPVC FP00 Y -200\r"),
        ("in", b"SetPVC FP00 Y -200\r\nDone.\r\n>"),
        ("out", b"setPVC FP00 Z 1000\r"),
        ("in", b"setPVC FP00 Z 1000\r\nDone.\r\n>"),
        ("out", b"SETpVC FP00 P -900\r"),
        ("in", b"SETpVC FP00 P -900\r\nDone.\r\n>"),
        ("out", b"sETpVC FP00 R 57\r"),
        ("in", b"sETpVC FP00 R 57\r\nDone.\r\n>"),
        ("out", b"LiStPV FP00\r"),
        ("in", b"LiStPV FP00\r\n" + listing_goal),
        ("out", b"spEeD 30\r"),
        ("in", b"spEeD 30\r\nDone.\r\n>"),
        ("out", b"MOveL FP00\r"),
        ("in", b"MOveL FP00\r\nDone.\r\n>"),
        # Two equal readings are accepted; a third equal one shows a standstill.
        ("out", b"lIstPV POSITION\r"),
        ("in", b"lIstPV POSITION\r\n" + listing_goal),
        ("out", b"ListPV POSITION\r"),
        ("in", b"ListPV POSITION\r\n" + listing_goal),
        ("out", b"listPV POSITION\r"),
        ("in", b"listPV POSITION\r\n" + listing_goal),
        ("out", b"CLOSe\r"),
        ("in", b"CLOSe\r\nDone.\r\n>"),
        ("out", b"jAW 50\r"),
        ("in", b"jAW 50\r\nDone.\r\n>"),
        ("out", ABORT),
    ]


def test_it_is_a_robot():
    assert isinstance(Scorbot("/dev/null"), Robot)


def test_it_reaches_its_goal_and_reports_its_position():
    rng = np.random.default_rng(1)
    with scorbot_rig() as rig:
        for _ in range(5):
            goal = random_goal(rng)
            rig.robot.move_to(goal)
            assert not rig.is_moving()
            assert rig.true_pose().distance_m(goal) < NEAR_M
            reported = rig.robot.pose()
            assert reported.distance_m(rig.true_pose()) < 2e-4
            assert reported.pitch_rad == pytest.approx(goal.pitch_rad, abs=2e-3)


def test_omitted_angles_keep_their_values():
    with scorbot_rig() as rig:
        rig.robot.move_to(
            Pose(0.4, 0.0, 0.1, pitch_rad=math.radians(-80), roll_rad=math.radians(30))
        )
        rig.robot.move_to(Pose(0.4, 0.1, 0.1))
        pose = rig.true_pose()
        assert math.degrees(pose.pitch_rad) == pytest.approx(-80, abs=0.1)
        assert math.degrees(pose.roll_rad) == pytest.approx(30, abs=0.1)


def test_speed_is_a_percentage_rounded_down():
    with scorbot_rig() as rig:
        rig.robot.move_to(over_table(0.4, 0.0), speed_m_s=0.099)
        assert rig.controller.speed_percent == 9
        rig.robot.move_to(over_table(0.4, 0.05), speed_m_s=0.01)
        assert rig.controller.speed_percent == 1
        rig.robot.move_to(over_table(0.4, 0.0), speed_m_s=50.0)
        assert rig.controller.speed_percent == 30


def test_a_speed_below_the_least_one_is_refused():
    with scorbot_rig() as rig:
        moves = len(rig.controller.moves)
        with pytest.raises(InvalidInputError, match=r"speed_m_s is 0\.002.* 0\.01 m/s"):
            rig.robot.move_to(over_table(0.4, 0.05), speed_m_s=0.002)
        assert len(rig.controller.moves) == moves


def test_a_wait_after_a_fault_is_an_error():
    with scorbot_rig() as rig:
        rig.robot.move_to(over_table(0.4, 0.2), speed_m_s=0.02, wait=False)
        rig.emulator.inject(Fault.IMPACT)
        with pytest.raises(RobotFaultError):
            rig.robot.pose()
        with pytest.raises(NotReadyError, match="IMPACT"):
            rig.robot.wait()


def test_moves_are_queued_without_waiting():
    with scorbot_rig() as rig:
        goals = [over_table(0.4, y) for y in (-0.1, 0.1, 0.0)]
        for goal in goals:
            rig.robot.move_to(goal, wait=False)
        assert rig.robot.status().state is RobotState.MOVING
        assert rig.is_moving()
        rig.robot.wait()
        assert rig.true_pose().distance_m(goals[-1]) < NEAR_M
        assert [move.goal_units[1] for move in rig.controller.moves] == [-1000, 1000, 0]


def test_slow_queued_moves_do_not_time_out():
    with scorbot_rig() as rig:
        rig.robot.move_to(over_table(0.4, -0.1))
        for y in (0.1, -0.1):  # 20 s of arm time each
            rig.robot.move_to(over_table(0.4, y), speed_m_s=0.01, wait=False)
        rig.robot.wait()
        assert rig.true_pose().distance_m(over_table(0.4, -0.1)) < NEAR_M


def test_the_gripper_waits_for_the_arm():
    with scorbot_rig() as rig:
        rig.robot.move_to(over_table(0.4, 0.1), wait=False)
        rig.robot.gripper("close")
        assert rig.true_pose().distance_m(over_table(0.4, 0.1)) < NEAR_M
        assert rig.controller.jaw_percent == 0


def test_no_more_moves_are_queued_than_there_are_names():
    with scorbot_rig() as rig:
        for _ in range(POSITION_NAMES):
            rig.robot.move_to(over_table(0.4, 0.1), speed_m_s=0.01, wait=False)
        with pytest.raises(NotReadyError, match="queued"):
            rig.robot.move_to(over_table(0.4, 0.1), wait=False)
        assert len(rig.controller.moves) == POSITION_NAMES


@pytest.mark.parametrize("spacing", [1, 2, 3])
def test_irregular_spacing_and_case(spacing):
    style = AclStyle(homing_s=1.0, spacing=np.random.default_rng(spacing))
    with scorbot_rig(style) as rig:
        rig.robot.move_to(over_table(0.4, 0.1))
        assert rig.true_pose().distance_m(over_table(0.4, 0.1)) < NEAR_M


def test_a_controller_without_echo_is_sent_the_echo_command():
    with scorbot_rig(AclStyle(homing_s=1.0, echo=False)) as rig:
        rig.robot.move_to(over_table(0.4, 0.1))
        assert rig.true_pose().distance_m(over_table(0.4, 0.1)) < NEAR_M
        assert ("out", b"ECHO\r") in rig.tape.transfers


def test_a_controller_that_cannot_echo_is_supported(monkeypatch):
    monkeypatch.setattr(
        "fingerpost.robot.emulator.acl.AclController._set_echo", lambda _self, _on: ["Done."]
    )
    with scorbot_rig(AclStyle(homing_s=1.0, echo=False)) as rig:
        rig.robot.move_to(over_table(0.4, 0.1))
        assert rig.true_pose().distance_m(over_table(0.4, 0.1)) < NEAR_M


def test_a_paged_listing_is_read_completely():
    with scorbot_rig() as rig:
        rig.emulator.inject(Fault.PAGING, count=3)
        rig.robot.move_to(over_table(0.4, 0.1))
        assert rig.true_pose().distance_m(over_table(0.4, 0.1)) < NEAR_M
        assert any(b"Type <cr>" in data for _, data in rig.tape.transfers)


# Preconditions of motion.


def test_nothing_moves_before_homing():
    with scorbot_rig(home=False) as rig:
        with pytest.raises(NotHomedError):
            rig.robot.move_to(over_table(0.4, 0.0))
        with pytest.raises(NotHomedError):
            rig.robot.pose()  # the counts have no reference yet
        with pytest.raises(NotHomedError):
            rig.robot.gripper("open")
        assert rig.controller.moves == []


def test_nothing_is_done_before_connecting():
    robot = Scorbot("/dev/null")
    for call in (robot.home, robot.pose, robot.stop, lambda: robot.move_to(over_table(0.4, 0.0))):
        with pytest.raises(ConnectionLostError):
            call()
    robot.close()


@pytest.mark.parametrize(
    ("pose", "error"),
    [
        (Pose(0.9, 0.0, 0.1), OutOfReachError),
        (Pose(0.7, 0.7, 0.1), OutOfReachError),
        (Pose(0.1, 0.05, 0.1), OutOfReachError),
        (Pose(0.4, 0.0, -0.01), OutOfReachError),
        (Pose(0.4, 0.0, 0.1, yaw_rad=0.0), InvalidInputError),
    ],
)
def test_nothing_moves_outside_the_limits(pose, error):
    with scorbot_rig(INSTANT) as rig:
        with pytest.raises(error):
            rig.robot.move_to(pose)
        assert rig.controller.moves == []


def test_the_limits_can_be_narrowed_by_options():
    options = fast_options(lower_m=(0.2, -0.3, 0.05), upper_m=(0.6, 0.3, 0.4), max_speed_m_s=0.05)
    with scorbot_rig(INSTANT, options=options) as rig:
        with pytest.raises(OutOfReachError, match=r"z = 0\.0400 m"):
            rig.robot.move_to(over_table(0.4, 0.0, 0.04))
        rig.robot.move_to(over_table(0.4, 0.0, 0.06))
        assert rig.controller.speed_percent == 5


def test_the_gripper_opens_closes_and_takes_a_width():
    with scorbot_rig(INSTANT) as rig:
        for target, percent in (("close", 0), ("open", 100), (0.0175, 25), (0.0, 0)):
            rig.robot.gripper(target)
            assert rig.controller.jaw_percent == percent
        with pytest.raises(InvalidInputError, match=r"0 to 0\.07"):
            rig.robot.gripper(0.08)
        with pytest.raises(InvalidInputError, match="'ajar'"):
            rig.robot.gripper("ajar")


# Homing.


def test_homing_reports_its_progress():
    reports = []
    with scorbot_rig(AclStyle(homing_s=5.0), home=False) as rig:
        rig.robot.home(reports.append)
        assert rig.robot.status().homed
    messages = [step.message for step in reports]
    assert "WAIT!! HOMING..." in messages
    assert messages[-1] == "HOMING COMPLETE (ROBOT)"
    assert "" in messages  # once a second
    assert [step.elapsed_s for step in reports] == sorted(step.elapsed_s for step in reports)


def test_an_axis_that_fails_to_home_is_named():
    with scorbot_rig(home=False) as rig:
        rig.emulator.inject(Fault.HOME_FAILURE)
        with pytest.raises(HomingError, match="axis 3") as caught:
            rig.robot.home()
        assert caught.value.axis == 3
        assert not rig.robot.status().homed
        rig.robot.home()


def test_homing_that_lasts_too_long_is_stopped():
    with scorbot_rig(AclStyle(homing_s=1e6), home=False) as rig:
        aborts = rig.controller.aborts
        with pytest.raises(RobotTimeoutError):
            rig.robot.home(timeout_s=2.0)
        assert rig.robot.status().state is RobotState.NOT_HOMED
        wait_until(lambda: rig.controller.aborts > aborts)


# Faults.


def wait_until(true, span_s=2.0):
    end_s = time.monotonic() + span_s
    while not true():
        assert time.monotonic() < end_s
        time.sleep(0.001)


@pytest.mark.parametrize(
    ("fault", "error", "number"),
    [
        (Fault.IMPACT, RobotFaultError, 53),
        (Fault.OVERLOAD, RobotFaultError, 55),
    ],
)
def test_a_fault_of_the_arm_is_typed_and_needs_homing(fault, error, number):
    with scorbot_rig() as rig:
        rig.robot.move_to(over_table(0.4, 0.2), speed_m_s=0.02, wait=False)
        rig.emulator.inject(fault)
        with pytest.raises(error) as caught:
            rig.robot.wait()
        assert caught.value.number == number
        assert rig.robot.status().state is RobotState.FAULT
        with pytest.raises(NotReadyError, match="home"):
            rig.robot.move_to(over_table(0.4, 0.1))
        rig.robot.home()
        rig.robot.move_to(over_table(0.4, 0.1))


def test_a_fault_while_the_arm_rests_is_seen_with_the_next_command():
    with scorbot_rig() as rig:
        rig.emulator.inject(Fault.IMPACT)
        with pytest.raises(RobotFaultError, match="impact"):
            rig.robot.pose()
        assert rig.robot.status().state is RobotState.FAULT


def test_a_goal_the_controller_cannot_reach():
    with scorbot_rig() as rig:
        rig.emulator.inject(Fault.OUT_OF_RANGE)
        with pytest.raises(OutOfReachError, match="54"):
            rig.robot.move_to(over_table(0.4, 0.1))
        rig.robot.move_to(over_table(0.4, 0.1))


def test_an_arm_that_does_not_move_is_detected():
    with scorbot_rig() as rig:
        rig.emulator.inject(Fault.STICK)
        with pytest.raises(NotArrivedError, match="sent to"):
            rig.robot.move_to(over_table(0.4, 0.1))
        assert rig.robot.status().state is RobotState.IDLE


def test_silence_is_a_timeout():
    with scorbot_rig() as rig:
        rig.emulator.inject(Fault.SILENT, count=1000)
        start_s = time.monotonic()
        with pytest.raises(RobotTimeoutError):
            rig.robot.pose()
        assert time.monotonic() - start_s < 2.0
        rig.emulator.heal()
        rig.robot.move_to(over_table(0.4, 0.1))


def test_a_move_that_lasts_too_long_is_stopped():
    with scorbot_rig() as rig:
        with pytest.raises(RobotTimeoutError):
            rig.robot.move_to(over_table(0.4, 0.2), speed_m_s=0.01, timeout_s=5.0)
        wait_until(lambda: not rig.is_moving())
        assert rig.true_pose().distance_m(over_table(0.4, 0.2)) > 0.1


@pytest.mark.parametrize("fault", [Fault.GARBAGE, Fault.CUT, Fault.GARBLED_INPUT, Fault.SLOW])
def test_occasional_noise_causes_no_wrong_position(fault):
    rng = np.random.default_rng(2)
    with scorbot_rig(slow_s=0.3 * TIME_SCALE) as rig:
        for _ in range(6):
            goal = random_goal(rng)
            rig.emulator.inject(fault)
            try:
                rig.robot.move_to(goal)
            except RobotError:
                rig.emulator.heal()
                continue
            assert rig.true_pose().distance_m(goal) < NEAR_M
            assert not rig.is_moving()


def test_a_late_answer_is_not_mistaken_for_a_later_one():
    with scorbot_rig(slow_s=0.3 * TIME_SCALE) as rig:  # longer than the time-out of 0.2 s
        rig.robot.move_to(over_table(0.4, -0.2))
        rig.robot.move_to(over_table(0.4, 0.2), speed_m_s=0.05, wait=False)
        for _ in range(10):
            rig.emulator.inject(Fault.SLOW)
            before = rig.true_pose()
            try:
                pose = rig.robot.pose()
            except RobotError:
                continue
            after = rig.true_pose()
            assert before.y_m - 2.5e-4 <= pose.y_m <= after.y_m + 2.5e-4


def test_continuous_noise_is_an_error():
    with scorbot_rig() as rig:
        rig.emulator.inject(Fault.CUT, count=10_000)
        with pytest.raises((GarbledReplyError, RobotTimeoutError)):
            rig.robot.move_to(over_table(0.4, 0.1))


def test_the_cable_is_unplugged_and_plugged_in_again():
    with scorbot_rig() as rig:
        rig.robot.move_to(over_table(0.4, 0.2), speed_m_s=0.02, wait=False)
        rig.emulator.inject(Fault.UNPLUG)
        with pytest.raises(ConnectionLostError):
            rig.robot.wait()
        assert rig.robot.status().state is RobotState.DISCONNECTED
        with pytest.raises(ConnectionLostError):
            rig.robot.reconnect(timeout_s=0.1 * TIME_SCALE)
        assert rig.is_moving()  # without a connection, no stop was possible
        rig.emulator.inject(Fault.PLUG)
        rig.robot.reconnect()
        wait_until(lambda: not rig.is_moving())  # connecting stops the arm
        with pytest.raises(NotHomedError):
            rig.robot.move_to(over_table(0.4, 0.1))
        rig.robot.home()
        rig.robot.move_to(over_table(0.4, 0.1))


def test_a_stop_releases_a_port_held_by_xoff():
    with scorbot_rig(options=fast_options(flow=Flow.XON_XOFF)) as rig:
        rig.robot.move_to(over_table(0.4, 0.2), speed_m_s=0.02, wait=False)
        rig.emulator.inject(Fault.XOFF)
        with pytest.raises(RobotTimeoutError):
            rig.robot.wait(timeout_s=0.5 * TIME_SCALE)
        wait_until(lambda: not rig.is_moving())
        rig.robot.move_to(over_table(0.4, 0.1))


def test_a_missing_port_is_a_lost_connection(tmp_path):
    with pytest.raises(ConnectionLostError, match="nowhere"):
        Scorbot(str(tmp_path / "nowhere")).connect()


def test_an_empty_port_is_refused():
    with pytest.raises(InvalidInputError, match="/dev/ttyUSB0"):
        Scorbot("")


def test_a_keyboard_interrupt_stops_the_arm():
    with scorbot_rig() as rig:

        def interrupted(_):
            raise KeyboardInterrupt

        rig.robot.move_to(over_table(0.4, 0.2), speed_m_s=0.02, wait=False)
        rig.robot._sleep_for = interrupted
        rig.robot._arrival = type(rig.robot._arrival)(poll_s=1.0)
        with pytest.raises(KeyboardInterrupt):
            rig.robot.wait()
        wait_until(lambda: not rig.is_moving())


def test_closing_stops_the_arm():
    with scorbot_rig() as rig:
        rig.robot.move_to(over_table(0.4, 0.2), speed_m_s=0.02, wait=False)
        rig.robot.close()
        wait_until(lambda: not rig.is_moving())
        rig.robot.close()


def test_a_pose_can_be_read_while_another_thread_waits_for_arrival():
    with scorbot_rig() as rig:
        mover = threading.Thread(
            target=rig.robot.move_to, args=(over_table(0.4, 0.2),), kwargs={"speed_m_s": 0.01}
        )
        mover.start()
        wait_until(rig.is_moving)
        seen = [rig.robot.pose() for _ in range(5)]
        mover.join()
        assert len({pose.y_m for pose in seen}) > 1


# Network lines.


def test_a_serial_server_by_socket():
    with scorbot_rig(port=TcpPort()) as rig:
        assert rig.emulator.address.startswith("socket://127.0.0.1:")
        rig.robot.move_to(over_table(0.4, 0.1))
        assert rig.true_pose().distance_m(over_table(0.4, 0.1)) < NEAR_M
        rig.emulator.inject(Fault.UNPLUG)
        with pytest.raises(ConnectionLostError):
            rig.robot.move_to(over_table(0.4, 0.0))


class LineWithoutModem(serial.Serial):
    """A pseudo-terminal without modem lines to query or set."""

    cts = dsr = ri = cd = False

    def _update_dtr_state(self):
        pass

    _update_rts_state = _update_dtr_state


class Rfc2217Server:
    """A minimal RFC 2217 server in front of a serial device."""

    def __init__(self, device):
        self._serial = LineWithoutModem(device, timeout=0.01)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"rfc2217://127.0.0.1:{self._listener.getsockname()[1]}"
        self._closing = False
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *error):
        self._closing = True
        self._thread.join()
        self._listener.close()
        self._serial.close()

    def write(self, data):
        self._peer.sendall(data)

    def _serve(self):
        self._peer, _ = self._listener.accept()
        self._peer.settimeout(0.005)
        manager = serial.rfc2217.PortManager(self._serial, self)
        while not self._closing:
            try:
                data = self._peer.recv(1024)
                if not data:
                    break
                self._serial.write(b"".join(manager.filter(data)))
            except TimeoutError:
                pass
            if data := self._serial.read(self._serial.in_waiting):
                self.write(b"".join(manager.escape(data)))
        self._peer.close()


@pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning")  # pyserial
def test_a_serial_server_by_rfc_2217():
    scale = 0.2 * TIME_SCALE  # two more threads forward every byte
    rig_options = {"connect": False, "time_scale": scale}
    with scorbot_rig(**rig_options) as rig, Rfc2217Server(rig.emulator.address) as server:
        clock = rig.clock
        options = fast_options(reply_s=1.0 * scale, quiet_s=0.06 * scale)
        with Scorbot(server.url, options, clock=clock, sleep=clock.sleep) as robot:
            robot.home()
            robot.move_to(over_table(0.4, 0.1))
            assert rig.true_pose().distance_m(over_table(0.4, 0.1)) < NEAR_M


def test_the_defaults_of_baud_rate_and_flow_control():
    assert ScorbotOptions().baud == 9600
    assert ScorbotOptions().flow is Flow.NONE


def test_the_tape_joins_transfers_in_the_same_direction():
    tape = Tape()
    for way, data in (("out", b"a"), ("out", b"b"), ("in", b"c")):
        tape(way, data)
    assert tape.transfers == [("out", b"ab"), ("in", b"c")]


def test_a_stop_ends_a_waiting_call():
    with scorbot_rig() as rig:
        rig.robot.move_to(over_table(0.4, 0.2), speed_m_s=0.02, wait=False)
        waiter_error = []

        def wait():
            try:
                rig.robot.wait()
            except RobotError as error:
                waiter_error.append(error)

        waiter = threading.Thread(target=wait)
        waiter.start()
        time.sleep(0.02)
        rig.robot.stop()
        waiter.join(2.0)
        assert isinstance(waiter_error[0], StoppedError)


def test_an_arm_without_limits_has_no_gripper():
    with scorbot_rig(INSTANT) as rig:
        rig.robot._limits = None
        with pytest.raises(NotReadyError, match="limits"):
            rig.robot.gripper("open")
        assert issubclass(GripperError, RobotError)
