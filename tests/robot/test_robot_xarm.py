"""UFACTORY xArm: the driver with a fake of its library, and the library with a control box.

The box is a stand-in on TCP ports that records the received bytes.
"""

# ruff: noqa: ARG002 - the fake has the vendor's parameters

import importlib
import inspect
import os
import socket
import subprocess
import sys
import textwrap
import threading
import time
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from fake_arm import FakeArm
from robot_rig import assert_in_time, best_of_three
from scipy.spatial.transform import Rotation
from xarm_stand_in import GET_TCP_POSE, SET_STATE, STOPPED, ControlBox, Gripper

from fingerpost.robot.errors import (
    ConnectionLostError,
    GarbledReplyError,
    GripperError,
    NotReadyError,
    OutOfReachError,
    RobotError,
    RobotFaultError,
    RobotTimeoutError,
    StoppedError,
)
from fingerpost.robot.protocol import TOOL_DOWN_RAD, Pose, Robot, RobotState
from fingerpost.robot.xarm import GRIPPER_NEAR, GRIPPER_PULSES, Xarm, XarmOptions

GOAL = Pose(0.3, 0.1, 0.2, pitch_rad=TOOL_DOWN_RAD, roll_rad=0.4, yaw_rad=0.0)
STAND_INS = Path(__file__).parent / "stand_ins"


@pytest.fixture
def fake_xarm(monkeypatch):
    class XArmAPI:
        latest = None

        def __init__(self, port=None, is_radian=False):
            if port == "nobody":
                raise Exception("connect socket failed")  # like the library
            assert is_radian
            self.connected, self.error_code = True, 0
            self.arm, self.state = FakeArm(), 0
            self.codes = {}
            self.gripper = Gripper()
            type(self).latest = self

        def _answer(self, call):
            return self.codes.get(call, 0)

        def clean_error(self):
            self.error_code = 0
            return 0

        def get_err_warn_code(self):
            return 0, [self.error_code, 0]

        def clean_warn(self):
            return 0

        def motion_enable(self, enable=True):
            return self._answer("motion_enable")

        def set_mode(self, mode=0):
            return self._answer("set_mode")

        def set_state(self, state=0):
            self.state = state
            if state == 4:
                self.arm.stop()
            return self._answer("set_state")

        def set_position(
            self,
            x=None,
            y=None,
            z=None,
            roll=None,
            pitch=None,
            yaw=None,
            speed=None,
            mvacc=None,
            is_radian=None,
            wait=False,
        ):
            assert is_radian
            assert not wait
            if self.state == 4:
                return 9
            code = self._answer("set_position")
            if code == 0:
                rotation = Rotation.from_euler("xyz", [roll, pitch, yaw])
                self.arm.go(np.array([x, y, z]) / 1000, rotation, speed / 1000)
            return code

        def get_position(self, is_radian=None):
            assert is_radian
            angles = self.arm.rotation.as_euler("xyz")
            return self._answer("get_position"), [*(1000 * self.arm.position()), *angles]

        def set_gripper_enable(self, enable):
            return self._answer("set_gripper_enable")

        def set_gripper_mode(self, mode):
            return self._answer("set_gripper_mode")

        def set_gripper_position(self, pos, wait=False):
            assert not wait
            code = self._answer("set_gripper_position")
            if code == 0:
                self.gripper.go(pos)
            return code

        def get_gripper_position(self):
            return self._answer("get_gripper_position"), round(self.gripper.position())

        def disconnect(self):
            self.connected = False

    module = ModuleType("xarm.wrapper")
    module.XArmAPI = XArmAPI
    monkeypatch.setitem(sys.modules, "xarm", ModuleType("xarm"))
    monkeypatch.setitem(sys.modules, "xarm.wrapper", module)
    return XArmAPI


def xarm(**options):
    return Xarm("192.168.1.185", XarmOptions(stall_s=0.1, **options))


def test_it_moves_in_millimetres_and_fixed_angles(fake_xarm):
    with xarm() as robot:
        assert isinstance(robot, Robot)
        robot.home()
        robot.move_to(GOAL, speed_m_s=0.15)
        arm = fake_xarm.latest.arm
        np.testing.assert_allclose(arm.position(), GOAL.position_m)
        assert arm.speed == pytest.approx(0.15)
        np.testing.assert_allclose(arm.rotation.apply([0, 0, 1]), [0, 0, -1], atol=1e-9)
        pose = robot.pose()
        assert pose.distance_m(GOAL) < 1e-9
        assert pose.roll_rad == pytest.approx(GOAL.roll_rad)


def test_it_keeps_its_orientation_when_none_is_given(fake_xarm):
    with xarm() as robot:
        robot.home()
        fake_xarm.latest.arm.rotation = Rotation.from_euler("xyz", [3.0, 0.1, -0.5])
        robot.move_to(Pose(0.3, 0.1, 0.2))
        angles = fake_xarm.latest.arm.rotation.as_euler("xyz")
        np.testing.assert_allclose(angles, [3.0, 0.1, -0.5])


def test_it_can_move_again_after_a_stop(fake_xarm):
    with xarm() as robot:
        robot.home()
        robot.move_to(GOAL, speed_m_s=0.001, wait=False)
        robot.stop()
        assert fake_xarm.latest.state == 4
        robot.move_to(GOAL)
        assert fake_xarm.latest.state == 0
        np.testing.assert_allclose(fake_xarm.latest.arm.position(), GOAL.position_m)


@pytest.mark.parametrize(
    ("code", "error"),
    [
        (-1, ConnectionLostError),
        (-2, NotReadyError),
        (-6, OutOfReachError),
        (-8, OutOfReachError),
        (-9, RobotFaultError),
        (1, RobotFaultError),
        (3, RobotTimeoutError),
        (9, NotReadyError),
        (77, RobotFaultError),
    ],
)
def test_return_codes_become_errors(fake_xarm, code, error):
    with xarm() as robot:
        robot.home()
        fake_xarm.latest.codes["set_position"] = code
        with pytest.raises(error, match=str(code)):
            robot.move_to(GOAL)


def test_warnings_are_no_failure(fake_xarm):
    with xarm() as robot:
        fake_xarm.latest.codes["set_mode"] = 2
        robot.home()
        assert robot.status().homed


def test_it_reports_its_own_error_number(fake_xarm):
    with xarm() as robot:
        robot.home()
        robot.move_to(GOAL, speed_m_s=0.001, wait=False)
        fake_xarm.latest.error_code = 31
        with pytest.raises(RobotFaultError, match="C31") as caught:
            robot.wait()
        assert caught.value.number == 31
        assert robot.status().state is RobotState.FAULT


def test_the_gripper_takes_a_width_and_stops_at_an_object(fake_xarm):
    with xarm() as robot:
        robot.home()
        gripper = fake_xarm.latest.gripper
        robot.gripper(0.0425)
        assert gripper.position() == GRIPPER_PULSES // 2
        gripper.obstacle = 300.0
        robot.gripper("close")
        assert gripper.position() == 300.0
        fake_xarm.latest.codes["set_gripper_position"] = 102
        with pytest.raises(GripperError):
            robot.gripper("open")


def test_an_arm_without_gripper(fake_xarm):
    with xarm(gripper=False) as robot:
        robot.home()
        with pytest.raises(GripperError):
            robot.gripper("open")


def test_a_missing_arm_is_a_lost_connection(fake_xarm):
    with pytest.raises(ConnectionLostError, match="socket failed"):
        Xarm("nobody").connect()


def test_a_closed_connection_is_an_error(fake_xarm):
    with xarm() as robot:
        robot.home()
        fake_xarm.latest.connected = False
        with pytest.raises(ConnectionLostError):
            robot.move_to(GOAL)
        assert robot.status().state is RobotState.DISCONNECTED


# Its gripper.


def gripping(fake_xarm, robot, **changes):
    robot.home()
    gripper = fake_xarm.latest.gripper
    for name, value in changes.items():
        setattr(gripper, name, value)
    return gripper


@pytest.mark.parametrize("delay_s", [0.25, 0.7, 1.3])
def test_a_gripper_that_has_not_started_is_waited_for(fake_xarm, delay_s):
    with xarm() as robot:
        gripper = gripping(fake_xarm, robot, delay_s=delay_s)
        robot.gripper("close")
        assert gripper.position() == 0.0
        gripper.obstacle = 0.0
        robot.gripper("open")
        assert gripper.position() == GRIPPER_PULSES


def test_a_slow_gripper_is_waited_for(fake_xarm):
    with xarm() as robot:
        gripper = gripping(fake_xarm, robot, speed=500.0)
        robot.gripper("close")
        assert gripper.position() == 0.0


def test_a_gripper_that_already_holds_something_may_be_closed_further(fake_xarm):
    with xarm() as robot:
        gripper = gripping(fake_xarm, robot, obstacle=300.0)
        robot.gripper("close")
        assert gripper.position() == 300.0
        robot.gripper("close")
        assert gripper.position() == 300.0


def test_a_gripper_that_does_not_open_is_an_error(fake_xarm):
    with xarm() as robot:
        gripper = gripping(fake_xarm, robot)
        robot.gripper("close")
        gripper.stuck = True
        with pytest.raises(GripperError, match="stands at 0 pulses, sent to 850"):
            robot.gripper("open")


def test_a_gripper_at_its_goal_is_not_waited_for(fake_xarm):
    with xarm() as robot:
        gripping(fake_xarm, robot)
        begin_s = time.monotonic()
        robot.gripper("open")
        assert time.monotonic() - begin_s < 1.0  # of the 2 s that it has to start


def test_a_gripper_that_never_stops_is_an_error(fake_xarm):
    with xarm(gripper_timeout_s=0.5) as robot:
        gripping(fake_xarm, robot, speed=100.0)
        with pytest.raises(GripperError, match="still moves"):
            robot.gripper("close")


def test_a_gripper_whose_position_cannot_be_read_is_an_error(fake_xarm):
    with xarm() as robot:
        robot.home()
        fake_xarm.latest.get_gripper_position = lambda: (0, None)
        with pytest.raises(GripperError, match="cannot be read"):
            robot.gripper("close")


def test_a_stop_ends_the_wait_for_the_gripper(fake_xarm):
    errors = []
    with xarm() as robot:
        gripping(fake_xarm, robot, delay_s=60.0)

        def grip():
            try:
                robot.gripper("close")
            except RobotError as error:
                errors.append(error)

        gripping_thread = threading.Thread(target=grip)
        gripping_thread.start()
        time.sleep(0.2)
        robot.stop()
        gripping_thread.join(2.0)
    assert [type(error) for error in errors] == [StoppedError]


# Answers of the library.


@pytest.mark.parametrize(
    "answer", [lambda **_: (0, None), lambda **_: (0, [1.0]), lambda **_: 1 / 0]
)
def test_a_malformed_answer_becomes_a_package_error(fake_xarm, answer):
    with xarm() as robot:
        robot.home()
        fake_xarm.latest.get_position = answer
        with pytest.raises(GarbledReplyError):
            robot.pose()
        with pytest.raises(GarbledReplyError):
            robot.move_to(Pose(0.3, 0.1, 0.2))


def test_a_nan_reading_is_an_error(fake_xarm):
    with xarm() as robot:
        robot.home()
        fake_xarm.latest.get_position = lambda **_: (0, [np.nan, 0.0, 0.0, 0.0, 0.0, 0.0])
        with pytest.raises(GarbledReplyError, match="nan"):
            robot.pose()


def test_an_outdated_error_report_is_ignored(fake_xarm):
    with xarm() as robot:
        robot.home()
        api = fake_xarm.latest
        api.error_code = 31
        api.get_err_warn_code = lambda: (0, [0, 0])
        robot.pose()
        api.get_err_warn_code = lambda: 1 / 0  # unverifiable, the report counts
        with pytest.raises(RobotFaultError, match="C31"):
            robot.pose()


def test_an_arm_paused_at_its_box_is_not_moved(fake_xarm):
    with xarm() as robot:
        robot.home()
        robot._stopped = False
        fake_xarm.latest.state = 3
        with pytest.raises(NotReadyError, match="paused"):
            robot.move_to(GOAL)


def test_homing_discards_a_paused_move(fake_xarm):
    with xarm() as robot:
        robot.home()
        states = []
        set_state = fake_xarm.latest.set_state
        fake_xarm.latest.set_state = lambda state: states.append(state) or set_state(state)
        robot.home()
        assert states == [4, 0]


# The library itself, and a control box.


@pytest.fixture
def box(monkeypatch):
    pytest.importorskip("xarm")
    monkeypatch.syspath_prepend(STAND_INS)
    ports = importlib.import_module("xarm_ports")
    Xarm("127.0.0.1")  # imports it as the driver does
    module = importlib.import_module("xarm.core.comm.socket_port")
    monkeypatch.setattr(module, "socket", module.socket)
    with ControlBox() as box:
        ports.lead(module, *box.ports)
        yield box


@contextmanager
def homed():
    with Xarm("127.0.0.1", XarmOptions(stall_s=0.1)) as robot:
        robot.home()
        yield robot


def test_the_library_moves_the_arm(box):
    with homed() as robot:
        robot.move_to(GOAL, speed_m_s=0.2)
        np.testing.assert_allclose(box.arm.position(), GOAL.position_m, atol=1e-6)
        assert robot.pose().distance_m(GOAL) < 1e-6
        box.gripper.delay_s = 0.7
        robot.gripper(0.0425)
        assert box.gripper.position() == pytest.approx(GRIPPER_PULSES // 2, abs=GRIPPER_NEAR)


def test_the_library_can_move_again_after_a_stop(box):
    with homed() as robot:
        robot.move_to(GOAL, speed_m_s=0.01, wait=False)
        robot.stop()
        wait_until(lambda: box.state == STOPPED)
        assert not box.arm.is_moving()
        robot.move_to(GOAL, speed_m_s=0.2)
        assert robot.pose().distance_m(GOAL) < 1e-6


def wait_until(true):
    end_s = time.monotonic() + 5.0
    while not true():
        assert time.monotonic() < end_s
        time.sleep(0.001)


@contextmanager
def silent_line(box, robot):
    """A line that no longer answers, and a thread that waits for an answer."""
    asked = len(box.received(GET_TCP_POSE))
    box.silent = True
    errors = []

    def read():
        try:
            robot.pose()
        except RobotError as error:
            errors.append(error)

    reader = threading.Thread(target=read)
    reader.start()
    wait_until(lambda: len(box.received(GET_TCP_POSE)) > asked)  # the library's lock is held now
    try:
        yield errors
    finally:
        reader.join(5.0)
        assert not reader.is_alive()
        box.silent = False


def stop_in_time(box, robot):
    """Stop, and assert that the call returns in time; wait for the frame."""
    seen = len(box.received(SET_STATE, bytes([STOPPED])))
    called_s = time.monotonic()
    robot.stop()
    assert_in_time(called_s, time.monotonic())  # the call does not wait
    wait_until(lambda: len(box.received(SET_STATE, bytes([STOPPED]))) > seen)
    assert_in_time(called_s, box.received(SET_STATE, bytes([STOPPED]))[seen].time_s)


@best_of_three
def test_a_stop_goes_out_while_another_thread_waits_on_a_silent_line(box):
    with homed() as robot:
        robot.move_to(GOAL, speed_m_s=0.01, wait=False)
        assert box.arm.is_moving()
        with silent_line(box, robot) as errors:
            for _ in range(100):
                stop_in_time(box, robot)
            assert not box.arm.is_moving()
        assert errors
        robot.move_to(GOAL, speed_m_s=0.2)  # the line answers again, synchronised
        assert robot.pose().distance_m(GOAL) < 1e-6


@best_of_three
def test_a_stop_goes_out_while_the_line_is_busy(box):
    with homed() as robot:
        done = threading.Event()

        def read():
            while not done.is_set():
                robot.pose()

        reader = threading.Thread(target=read)
        reader.start()
        try:
            for _ in range(20):
                stop_in_time(box, robot)
                time.sleep(0.01)
        finally:
            done.set()
            reader.join()


def test_another_thread_ignores_the_answer_to_a_stop(box):
    with homed() as robot:
        done = threading.Event()
        poses = []

        def read():
            while not done.is_set():
                poses.append(robot.pose())

        here = robot.pose()
        reader = threading.Thread(target=read)
        reader.start()
        for _ in range(200):
            robot.stop()
        done.set()
        reader.join()
        assert all(pose.distance_m(here) < 1e-6 for pose in poses)
        assert {frame.transaction for frame in box.received(SET_STATE, bytes([STOPPED]))} > {0}


def test_a_stop_on_a_cut_line_fails(box):
    with homed() as robot:
        robot._api._arm._stream.com.close()
        with pytest.raises(ConnectionLostError):
            robot.stop()


def test_connecting_to_a_silent_box_times_out(box, monkeypatch):
    monkeypatch.setattr("fingerpost.robot.xarm.OPEN_S", 0.3)
    box.silent = True
    with pytest.raises(RobotTimeoutError, match=r"within 0\.3 s"):
        Xarm("127.0.0.1").connect()
    box.silent = False  # the attempt continues in the background and closes its sockets
    wait_until(lambda: not any(thread.name == "xarm" for thread in threading.enumerate()))


def test_the_library_does_not_affect_other_sockets(box):
    before_s = socket.getdefaulttimeout()
    with homed():
        assert socket.getdefaulttimeout() == before_s


@pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnhandledThreadExceptionWarning"
)  # in its threads
@pytest.mark.parametrize("seed", range(8))
def test_garbage_on_the_line_is_a_typed_error(box, seed):
    rng = np.random.default_rng(seed)

    def garble(reply):
        return bytes(reply[:6]) + rng.bytes(len(reply) - 6)

    with homed() as robot:
        robot._api._arm.arm_cmd.set_timeout(0.05)
        box.garble = garble
        for act in (robot.pose, lambda: robot.move_to(GOAL), lambda: robot.gripper("close")):
            with pytest.raises(RobotError):
                act()
        box.garble = None


# Standard output belongs to the program.


def test_no_output_of_the_library_reaches_standard_output(box, capfd):
    with homed() as robot:
        robot.move_to(GOAL, speed_m_s=0.2)
        robot.gripper("close")
        robot.stop()
        box.error = 31
        with pytest.raises(RobotFaultError, match="C31"):
            wait_until(lambda: robot.pose() is None)
        robot.home()
    library = importlib.import_module("xarm.core.utils.log")
    library.logger.error("an error of the library")
    library.origin_logger.error("another")
    library.pretty_print("in colours")
    importlib.import_module("xarm.core.wrapper.uxbus_cmd_tcp").debug_log_datas([1], label="sent")
    assert capfd.readouterr().out == ""


def test_no_output_reaches_a_program_that_has_imported_the_library_itself(box, tmp_path):
    program = """
        import sys
        sys.path.insert(0, {stand_ins!r})
        import xarm.core.comm.socket_port as module
        from xarm.wrapper import XArmAPI
        import xarm_ports

        xarm_ports.lead(module, *{ports})
        print("from here on")
        from fingerpost.robot import open_robot

        with open_robot("xarm://127.0.0.1") as robot:
            robot.home()
            print(robot.pose())
    """
    text = textwrap.dedent(program).format(stand_ins=str(STAND_INS), ports=box.ports)
    done = subprocess.run(
        [sys.executable, "-c", text], capture_output=True, text=True, timeout=60, env=os.environ
    )
    assert done.returncode == 0, done.stderr
    *_, first, pose = done.stdout.splitlines()
    assert first == "from here on"
    assert pose.startswith("(0.3000, 0.0000, 0.3000) m")


def test_the_fake_has_the_signatures_of_xarm_python_sdk(fake_xarm, monkeypatch):
    monkeypatch.delitem(sys.modules, "xarm.wrapper")
    monkeypatch.delitem(sys.modules, "xarm")
    pytest.importorskip("xarm")
    real = importlib.import_module("xarm.wrapper").XArmAPI
    for method, fake in vars(fake_xarm).items():
        if not method.startswith("_") and callable(fake):
            named = set(inspect.signature(fake).parameters)
            assert named <= set(inspect.signature(getattr(real, method)).parameters), method
    assert isinstance(real.connected, property)
    assert isinstance(real.error_code, property)
