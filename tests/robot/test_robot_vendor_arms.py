"""UR and xArm, tested against fakes of their vendors' interfaces.

Where a vendor's library is installed, the fakes' methods are compared with it, too.
"""

# ruff: noqa: ARG002, N802 - the fakes have the vendors' names and parameters

import importlib
import inspect
import itertools
import math
import sys
import threading
import time
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fingerpost.errors import InvalidInputError, MissingExtraError
from fingerpost.robot.errors import (
    CommandRefusedError,
    ConnectionLostError,
    GripperError,
    NotArrivedError,
    NotHomedError,
    NotReadyError,
    OutOfReachError,
    RobotFaultError,
    RobotTimeoutError,
    StoppedError,
)
from fingerpost.robot.protocol import TOOL_DOWN_RAD, Pose, Robot, RobotState
from fingerpost.robot.ur import UniversalRobot, UrOptions
from fingerpost.robot.xarm import GRIPPER_PULSES, Xarm, XarmOptions

GOAL = Pose(0.3, 0.1, 0.2, pitch_rad=TOOL_DOWN_RAD, roll_rad=0.4, yaw_rad=0.0)
TOOL_DOWN = Rotation.from_euler("x", math.pi)


class FakeArm:
    """A pose that follows its goal at a speed, in real time."""

    def __init__(self):
        self.start = self.goal = np.array([0.3, 0.0, 0.3])
        self.rotation = TOOL_DOWN
        self.began_s, self.speed = time.monotonic(), 1.0
        self.stops = 0

    def position(self):
        way = np.linalg.norm(self.goal - self.start)
        gone = self.speed * (time.monotonic() - self.began_s)
        return self.goal if gone >= way else self.start + gone / way * (self.goal - self.start)

    def go(self, position, rotation, speed):
        self.start, self.goal, self.rotation = self.position(), np.array(position), rotation
        self.began_s, self.speed = time.monotonic(), speed

    def stop(self):
        self.stops += 1
        self.start = self.goal = self.position()


# Universal Robots.


class FakeUr:
    """What the three parts of `ur_rtde` share: one arm and its state."""

    def __init__(self):
        self.arm = FakeArm()
        self.mode = 7
        self.connected = True
        self.emergency = self.protective = False
        self.accepts = self.reachable = True
        self.outputs = {}
        self.stuck = False


@pytest.fixture
def fake_ur(monkeypatch):
    state = FakeUr()

    class RTDEControlInterface:
        def __init__(self, hostname):
            if hostname == "nobody":
                raise RuntimeError("connect: No route to host")

        def moveL(self, pose, speed=0.25, acceleration=1.2, asynchronous=False):
            assert asynchronous, "a blocking moveL would keep the stop from the arm"
            assert len(pose) == 6
            if state.accepts and not state.stuck:
                state.arm.go(pose[:3], Rotation.from_rotvec(pose[3:]), speed)
            return state.accepts

        def stopL(self, a=10.0, asynchronous=False):
            state.arm.stop()

        def isPoseWithinSafetyLimits(self, pose):
            return state.reachable

        def disconnect(self):
            pass

    class RTDEReceiveInterface:
        def __init__(self, hostname):
            pass

        def isConnected(self):
            return state.connected

        def isEmergencyStopped(self):
            return state.emergency

        def isProtectiveStopped(self):
            return state.protective

        def getRobotMode(self):
            return state.mode

        def getActualTCPPose(self):
            return [*state.arm.position(), *state.arm.rotation.as_rotvec()]

        def disconnect(self):
            pass

    class RTDEIOInterface:
        def __init__(self, hostname):
            pass

        def setStandardDigitalOut(self, output_id, signal_level):
            state.outputs[output_id] = signal_level
            return state.accepts

        def disconnect(self):
            pass

    for name, kind in (
        ("rtde_control", RTDEControlInterface),
        ("rtde_receive", RTDEReceiveInterface),
        ("rtde_io", RTDEIOInterface),
    ):
        module = ModuleType(name)
        setattr(module, kind.__name__, kind)
        state.__dict__.setdefault("kinds", {})[name] = kind
        monkeypatch.setitem(sys.modules, name, module)
    return state


def ur(**options):
    return UniversalRobot("10.0.0.5", UrOptions(stall_s=0.1, gripper_s=0.0, **options))


def test_ur_goes_in_metres_and_rotation_vectors(fake_ur):
    with ur() as robot:
        assert isinstance(robot, Robot)
        robot.home()
        robot.move_to(GOAL, speed_m_s=0.25)
        np.testing.assert_allclose(fake_ur.arm.position(), GOAL.position_m)
        assert fake_ur.arm.speed == 0.25
        approach = fake_ur.arm.rotation.apply([0.0, 0.0, 1.0])
        np.testing.assert_allclose(approach, [0.0, 0.0, -1.0], atol=1e-9)
        pose = robot.pose()
        assert pose.distance_m(GOAL) < 1e-9
        assert pose.roll_rad == pytest.approx(GOAL.roll_rad)


def test_ur_roll_and_yaw_of_a_vertical_gripper_are_one_turn(fake_ur):
    with ur() as robot:
        robot.home()
        robot.move_to(Pose(0.3, 0.0, 0.2, pitch_rad=TOOL_DOWN_RAD, roll_rad=0.5, yaw_rad=0.9))
        assert robot.pose().yaw_rad == 0.0


def test_ur_keeps_its_orientation_when_none_is_given(fake_ur):
    fake_ur.arm.rotation = Rotation.from_rotvec([0.3, 2.0, -0.4])
    with ur() as robot:
        robot.home()
        robot.move_to(Pose(0.3, 0.1, 0.2))
        np.testing.assert_allclose(fake_ur.arm.rotation.as_rotvec(), [0.3, 2.0, -0.4])
        with pytest.raises(InvalidInputError, match="all three"):
            robot.move_to(Pose(0.3, 0.1, 0.2, pitch_rad=0.0))


def test_ur_stops_and_voids_what_waits(fake_ur):
    errors = []
    with ur() as robot:
        robot.home()

        def move():
            try:
                robot.move_to(GOAL, speed_m_s=0.001)
            except StoppedError as error:
                errors.append(error)

        mover = threading.Thread(target=move)
        mover.start()
        while robot.status().state is not RobotState.MOVING:
            time.sleep(0.001)
        stops = fake_ur.arm.stops
        robot.stop()
        assert fake_ur.arm.stops > stops
        mover.join(2.0)
    assert len(errors) == 1


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"accepts": False}, CommandRefusedError),
        ({"reachable": False}, OutOfReachError),
        ({"emergency": True}, RobotFaultError),
        ({"protective": True}, RobotFaultError),
        ({"connected": False}, ConnectionLostError),
        ({"stuck": True}, NotArrivedError),
    ],
)
def test_ur_bools_become_errors(fake_ur, change, error):
    with ur() as robot:
        robot.home()
        vars(fake_ur).update(change)
        with pytest.raises(error):
            robot.move_to(GOAL)


def test_an_arm_that_creeps_does_not_stand(fake_ur):
    # From one reading to the next it moves by a tenth of what is no motion.
    with ur(poll_s=0.001) as robot:
        robot.home()
        here = robot.pose()
        goal = replace(here, y_m=here.y_m + 0.005)
        robot.move_to(goal, speed_m_s=0.02)
        assert robot.pose().distance_m(goal) < 1e-3


def test_an_arm_whose_answer_is_late_does_not_stand(fake_ur, monkeypatch):
    # The second of two readings is as good as at once, but told when the stall time is over.
    with ur(poll_s=0.001) as robot:
        robot.home()
        here, position = robot.pose(), fake_ur.arm.position
        late_s = itertools.cycle([0.0, 0.15])

        def told_late():
            at = position()
            time.sleep(next(late_s))
            return at

        goal = replace(here, y_m=here.y_m + 0.02)
        robot.move_to(goal, speed_m_s=0.02, wait=False)
        monkeypatch.setattr(fake_ur.arm, "position", told_late)
        robot.wait()
        assert robot.pose().distance_m(goal) < 1e-3


def test_ur_that_is_switched_off_is_not_ready(fake_ur):
    fake_ur.mode = 3
    with ur() as robot:
        with pytest.raises(RobotFaultError, match="mode 3"):
            robot.home()
        with pytest.raises(NotReadyError):
            robot.move_to(GOAL)


def test_ur_needs_homing_too(fake_ur):
    with ur() as robot, pytest.raises(NotHomedError):
        robot.move_to(GOAL)


def test_ur_that_is_not_there(fake_ur):
    with pytest.raises(ConnectionLostError, match="No route"):
        UniversalRobot("nobody").connect()


def test_ur_has_no_gripper_unless_an_output_is_named(fake_ur):
    with ur() as robot:
        robot.home()
        with pytest.raises(GripperError, match="no gripper"):
            robot.gripper("close")
    with ur(gripper_output=3) as robot:
        robot.home()
        robot.gripper("close")
        assert fake_ur.outputs == {3: True}
        robot.gripper("open")
        assert fake_ur.outputs == {3: False}
        fake_ur.accepts = False
        with pytest.raises(GripperError, match="output 3"):
            robot.gripper("close")


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


@pytest.mark.parametrize("name", ["rtde_control", "rtde_receive", "rtde_io"])
def test_the_fake_has_what_ur_rtde_has(fake_ur, monkeypatch, name):
    kind = fake_ur.kinds[name]
    monkeypatch.delitem(sys.modules, name)
    real = getattr(pytest.importorskip(name), kind.__name__)
    for method in (method for method in vars(kind) if not method.startswith("_")):
        assert hasattr(real, method), method


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
