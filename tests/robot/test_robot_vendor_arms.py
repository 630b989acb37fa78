"""xArm, tested against a fake of its vendor's interface, and libraries that are not installed.

Where the vendor's library is installed, the fake's methods are compared with it, too.
"""

# ruff: noqa: ARG002 - the fakes have the vendors' names and parameters

import importlib
import inspect
import sys
from types import ModuleType

import numpy as np
import pytest
from fake_arm import FakeArm
from scipy.spatial.transform import Rotation

from fingerpost.errors import MissingExtraError
from fingerpost.robot.errors import (
    ConnectionLostError,
    GripperError,
    NotReadyError,
    OutOfReachError,
    RobotFaultError,
    RobotTimeoutError,
)
from fingerpost.robot.protocol import TOOL_DOWN_RAD, Pose, Robot, RobotState
from fingerpost.robot.ur import UniversalRobot
from fingerpost.robot.xarm import GRIPPER_PULSES, Xarm, XarmOptions

GOAL = Pose(0.3, 0.1, 0.2, pitch_rad=TOOL_DOWN_RAD, roll_rad=0.4, yaw_rad=0.0)

# xArm.


@pytest.fixture
def fake_xarm(monkeypatch):
    class XArmAPI:
        latest = None

        def __init__(self, port=None, is_radian=False):
            if port == "nobody":
                raise Exception("connect socket failed")  # as the library does
            assert is_radian
            self.connected, self.error_code = True, 0
            self.arm, self.state, self.pulses = FakeArm(), 0, 850
            self.codes = {}
            self.obstacle = None
            type(self).latest = self

        def _answer(self, call):
            return self.codes.get(call, 0)

        def clean_error(self):
            self.error_code = 0
            return 0

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
            self.pulses = pos if self.obstacle is None else max(pos, self.obstacle)
            return self._answer("set_gripper_position")

        def get_gripper_position(self):
            return self._answer("get_gripper_position"), self.pulses

        def disconnect(self):
            self.connected = False

    module = ModuleType("xarm.wrapper")
    module.XArmAPI = XArmAPI
    monkeypatch.setitem(sys.modules, "xarm", ModuleType("xarm"))
    monkeypatch.setitem(sys.modules, "xarm.wrapper", module)
    return XArmAPI


def xarm(**options):
    return Xarm("192.168.1.185", XarmOptions(stall_s=0.1, **options))


def test_xarm_goes_in_millimetres_and_fixed_angles(fake_xarm):
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


def test_xarm_keeps_its_orientation_when_none_is_given(fake_xarm):
    with xarm() as robot:
        robot.home()
        fake_xarm.latest.arm.rotation = Rotation.from_euler("xyz", [3.0, 0.1, -0.5])
        robot.move_to(Pose(0.3, 0.1, 0.2))
        angles = fake_xarm.latest.arm.rotation.as_euler("xyz")
        np.testing.assert_allclose(angles, [3.0, 0.1, -0.5])


def test_xarm_can_move_again_after_a_stop(fake_xarm):
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
def test_xarm_codes_become_errors(fake_xarm, code, error):
    with xarm() as robot:
        robot.home()
        fake_xarm.latest.codes["set_position"] = code
        with pytest.raises(error, match=str(code)):
            robot.move_to(GOAL)


def test_xarm_warnings_are_no_failure(fake_xarm):
    with xarm() as robot:
        fake_xarm.latest.codes["set_mode"] = 2
        robot.home()
        assert robot.status().homed


def test_xarm_reports_its_own_error_number(fake_xarm):
    with xarm() as robot:
        robot.home()
        robot.move_to(GOAL, speed_m_s=0.001, wait=False)
        fake_xarm.latest.error_code = 31
        with pytest.raises(RobotFaultError, match="C31") as caught:
            robot.wait()
        assert caught.value.number == 31
        assert robot.status().state is RobotState.FAULT


def test_xarm_gripper_takes_a_width_and_stops_at_what_it_holds(fake_xarm):
    with xarm() as robot:
        robot.home()
        robot.gripper(0.0425)
        assert fake_xarm.latest.pulses == GRIPPER_PULSES // 2
        fake_xarm.latest.obstacle = 300
        robot.gripper("close")
        assert fake_xarm.latest.pulses == 300
        fake_xarm.latest.codes["set_gripper_position"] = 102
        with pytest.raises(GripperError):
            robot.gripper("open")


def test_xarm_without_its_gripper(fake_xarm):
    with xarm(gripper=False) as robot:
        robot.home()
        with pytest.raises(GripperError):
            robot.gripper("open")


def test_xarm_that_is_not_there(fake_xarm):
    with pytest.raises(ConnectionLostError, match="socket failed"):
        Xarm("nobody").connect()


def test_xarm_that_hangs_up(fake_xarm):
    with xarm() as robot:
        robot.home()
        fake_xarm.latest.connected = False
        with pytest.raises(ConnectionLostError):
            robot.move_to(GOAL)
        assert robot.status().state is RobotState.DISCONNECTED


# Libraries.


@pytest.mark.parametrize(
    ("module", "make", "extra"),
    [("rtde_control", UniversalRobot, "ur"), ("xarm.wrapper", Xarm, "xarm")],
)
def test_a_missing_library_is_named_with_the_command_that_installs_it(
    monkeypatch, module, make, extra
):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=rf"pip install 'fingerpost\[{extra}\]'"):
        make("10.0.0.5")


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
