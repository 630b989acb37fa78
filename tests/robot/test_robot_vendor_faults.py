"""Moves under every kind of fault: each ends with a correct result or a package error.

A fault is present before a move, or occurs while it is commanded or running. No call hangs, no
wrong position is reported, and afterwards the arm can be used again. With FINGERPOST_FAULT_MOVES=8,
each fault is met by eight moves.
"""

import os
import sys
import threading
import time
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from rosbridge_rig import rosbridge_rig
from so101_rig import so101_rig
from test_robot_rosbridge import FAULTS as ROSBRIDGE_FAULTS
from test_robot_so101 import FAULTS as SO101_FAULTS
from test_robot_xarm import box as xarm_box  # noqa: F401 - a fixture
from ur_stand_in import Program, UrController, dashboard, libraries

from fingerpost.robot import ur_dashboard
from fingerpost.robot.emulator.faults import Fault
from fingerpost.robot.errors import ConnectionLostError, RobotError
from fingerpost.robot.protocol import TOOL_DOWN_RAD, Pose
from fingerpost.robot.ur import UniversalRobot, UrOptions
from fingerpost.robot.xarm import Xarm, XarmOptions

MOVES = int(os.environ.get("FINGERPOST_FAULT_MOVES", "2"))

LIMIT_S = 15.0
"""Limit of every call; xArm's library waits 10 s for the answer to a move."""

NEAR_M = 1.2e-3
"""The arrival tolerance of 1 mm, and rounding."""

GOAL = Pose(0.3, 0.1, 0.2, pitch_rad=TOOL_DOWN_RAD, roll_rad=0.4, yaw_rad=0.0)


def moves(robot, position, fault, mend, *, goal=GOAL, near_m=NEAR_M):
    """Make moves with a fault before the move or at a random time; return the outcomes."""
    first = goal
    outcomes = []
    rng = np.random.default_rng(0)
    for k in range(MOVES):
        goal = replace(first, y_m=first.y_m * (-1) ** k)
        meddler = threading.Timer(float(rng.uniform(0.0, 0.3)), fault)
        if k % 2:
            fault()
        else:
            meddler.start()
        begin_s = time.monotonic()
        try:
            robot.move_to(goal, speed_m_s=0.5)
            assert np.linalg.norm(position() - goal.position_m) < near_m
            outcomes.append("arrived")
        except RobotError as error:
            outcomes.append(type(error).__name__)
        assert time.monotonic() - begin_s < LIMIT_S
        if not k % 2:
            meddler.join()
        mend()
        recover(robot)
        # An arm stopped in motion takes a moment to stand; until then the two readings differ.
        while robot.pose().distance_m(Pose(*position())) >= near_m:
            assert time.monotonic() - begin_s < LIMIT_S
    return outcomes


def recover(robot):
    """Recover from an error as an operator would; the error may be detected only now."""
    for _ in range(3):
        try:
            if robot.status().state == "disconnected":
                robot.reconnect(timeout_s=LIMIT_S)
            if not robot.status().homed:
                robot.home()
            robot.stop()
            robot.pose()
            return
        except ConnectionLostError:
            robot.close()
        except RobotError:
            pass
    pytest.fail("the arm cannot be used again")


# Universal Robots.


def change(**fields):
    def fault(controller):
        for name, value in fields.items():
            setattr(controller, name, value)

    return fault


def raise_from(part, method, error):
    """Return a fault that replaces a method of the library by one that raises."""

    def fault(controller):
        def fail(*_):
            raise error

        setattr(controller.parts[part], method, fail)

    return fault


def answer_from(part, method, answer):
    def fault(controller):
        setattr(controller.parts[part], method, lambda *_: answer)

    return fault


UR_FAULTS = {
    "program stopped": UrController.stop_program,
    "program paused": UrController.pause,
    "protective stop": change(protective=True),
    "emergency stop": change(emergency=True, program=Program.STOPPED),
    "disconnected": change(connected=False),
    "moves refused": change(accepts=False),
    "out of reach": change(reachable=False),
    "stuck": change(stuck=True),
    "stop raises": change(stop_error=RuntimeError("broken pipe")),
    "watchdog": lambda controller: setattr(controller, "_written_s", time.monotonic() - 1.0),
    "receive raises": raise_from("rtde_receive", "getActualTCPPose", RuntimeError("no data")),
    "receive is odd": raise_from("rtde_receive", "getActualTCPPose", ValueError("no key")),
    "status raises": raise_from("rtde_receive", "isProtectiveStopped", RuntimeError("no data")),
    "pose is NaN": answer_from("rtde_receive", "getActualTCPPose", [float("nan")] * 6),
    "pose is short": answer_from("rtde_receive", "getActualTCPPose", [0.1, 0.2]),
    "move raises": raise_from("rtde_control", "moveL", RuntimeError("broken pipe")),
    "script unknown": raise_from("rtde_control", "isProgramRunning", RuntimeError("no data")),
}


@pytest.mark.parametrize("kind", UR_FAULTS)
def test_a_ur_through_faults(kind, monkeypatch):
    controller = UrController(patience=20.0)
    controller.parts = {}
    for name, kind_of in libraries(controller).items():

        def make(hostname, name=name, kind_of=kind_of):
            controller.parts[name] = kind_of(hostname)
            return controller.parts[name]

        module = ModuleType(name)
        setattr(module, kind_of.__name__, make)
        monkeypatch.setitem(sys.modules, name, module)

    def mend():
        change(emergency=False, connected=True, accepts=True, reachable=True)(controller)
        change(protective=False, stuck=False, stop_error=None)(controller)
        for part in controller.parts.values():
            vars(part).clear()

    with dashboard(controller) as port:
        monkeypatch.setattr(ur_dashboard, "PORT", port)
        with UniversalRobot("127.0.0.1", UrOptions(stall_s=0.1)) as robot:
            robot.home()
            outcomes = moves(
                robot, controller.arm.position, lambda: UR_FAULTS[kind](controller), mend
            )
    print(kind, outcomes)  # shown by pytest -s
    assert len(outcomes) == MOVES


# xArm, through its own library.


def cut(box, robot):
    robot._api._arm._stream.com.close()


def garble(box, _robot):
    rng = np.random.default_rng(1)
    box.garble = lambda reply: reply[:6] + rng.bytes(len(reply) - 6)


def shorten(box, _robot):
    def fewer(reply):
        body = reply[6:-2] if len(reply) > 8 else reply[6:]
        return reply[:4] + len(body).to_bytes(2, "big") + body

    box.garble = fewer


def with_error(number):
    return lambda box, _robot: setattr(box, "error", number)


XARM_FAULTS = {
    "silent": lambda box, _robot: setattr(box, "silent", True),
    "cut": cut,
    "garbage": garble,
    "cut short": shorten,
    "error C2": with_error(2),
    "error C22": with_error(22),
    "error C31": with_error(31),
    "stopped in Studio": lambda box, _robot: box._set_state(4),
    "paused in Studio": lambda box, _robot: box._set_state(3),
    "gone off": lambda box, _robot: box.hang_up(),
    "NaN": lambda box, _robot: setattr(box, "not_a_number", True),
    "stuck": lambda box, _robot: setattr(box, "stuck", True),
}


@pytest.mark.filterwarnings(  # garbage ends threads of the library, not those of the driver
    "ignore::pytest.PytestUnhandledThreadExceptionWarning"
)
@pytest.mark.parametrize("kind", XARM_FAULTS)
def test_an_xarm_through_faults(kind, xarm_box):  # noqa: F811
    box = xarm_box

    def mend():
        box.silent, box.garble, box.error = False, None, 0
        box.not_a_number = box.stuck = False

    with Xarm("127.0.0.1", XarmOptions(stall_s=0.1)) as robot:
        robot.home()
        outcomes = moves(robot, box.arm.position, lambda: XARM_FAULTS[kind](box, robot), mend)
    print(kind, outcomes)  # shown by pytest -s
    assert len(outcomes) == MOVES


# SO-101, whose servos have faults of their own in addition to those of the line.


SO101_FAULTS = SO101_FAULTS | {
    fault.value: (lambda rig, fault=fault: rig.emulator.inject(fault, count=2),)
    for fault in (Fault.SILENT, Fault.CUT, Fault.GARBAGE, Fault.GARBLED_INPUT)
}


@pytest.mark.parametrize("kind", SO101_FAULTS)
def test_an_so101_through_faults(kind, tmp_path):
    with so101_rig(tmp_path, stall_s=0.4, near_m=0.002) as rig:
        poll = rig.bus.poll

        def mend():
            rig.bus.poll = poll
            rig.bus.heal()
            rig.emulator.heal()
            rig.emulator.inject(Fault.PLUG)

        outcomes = moves(
            rig.robot,
            rig.true_m,
            lambda: SO101_FAULTS[kind][0](rig),
            mend,
            goal=Pose(0.2, 0.06, 0.06, pitch_rad=TOOL_DOWN_RAD, roll_rad=0.0),
            near_m=0.003,
        )
    print(kind, outcomes)  # shown by pytest -s
    assert len(outcomes) == MOVES


# A ROS arm, whose connection and nodes may fail.


ROSBRIDGE_FAULTS = ROSBRIDGE_FAULTS | {
    "silent for a moment": (lambda rig: rig.emulator.inject(Fault.SILENT, count=3),),
    "cut": (lambda rig: rig.emulator.inject(Fault.CUT),),
    "services say no": (lambda rig: rig.emulator.inject(Fault.OUT_OF_RANGE),),
}


@pytest.mark.parametrize("kind", ROSBRIDGE_FAULTS)
def test_an_arm_of_ros_through_faults(kind):
    with rosbridge_rig(stall_s=0.4, near_m=0.001) as rig:

        def mend():
            rig.server.heal()
            rig.emulator.heal()
            rig.emulator.inject(Fault.PLUG)
            time.sleep(0.05)  # until the next pose has arrived

        outcomes = moves(
            rig.robot, rig.true_m, lambda: ROSBRIDGE_FAULTS[kind][0](rig), mend, near_m=2e-3
        )
    print(kind, outcomes)  # shown by pytest -s
    assert len(outcomes) == MOVES
