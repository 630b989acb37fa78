"""G-code arms, tested through the bytes of emulated controllers."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from gcode_rig import ARMS, FAR, GOAL, gcode_rig, wait_until
from robot_rig import assert_in_time, best_of_three

from fingerpost.errors import InvalidInputError
from fingerpost.robot.emulator.faults import Fault
from fingerpost.robot.emulator.gcode import MarlinController
from fingerpost.robot.errors import (
    CommandRefusedError,
    ConnectionLostError,
    GripperError,
    NotArrivedError,
    NotHomedError,
    NotReadyError,
    OutOfReachError,
    RobotTimeoutError,
    StoppedError,
)
from fingerpost.robot.gcode import MAX_SPEED_M_S, GcodeArm
from fingerpost.robot.gcode_dialects import DEXARM, UARM
from fingerpost.robot.protocol import GripperKind, Pose, Robot, RobotState
from fingerpost.robot.registry import open_robot


@pytest.fixture(params=ARMS)
def name(request):
    return request.param


def test_it_is_a_robot(name):
    assert isinstance(GcodeArm("/dev/null", ARMS[name][0]), Robot)


def test_it_reaches_its_goal_and_reports_its_position(name):
    with gcode_rig(name) as rig:
        assert rig.controller.homed
        for goal in (GOAL, FAR, GOAL):
            rig.robot.move_to(goal)
            rig.assert_at(goal)
            assert rig.robot.pose().distance_m(goal) < 1e-5


def test_a_command_unknown_to_the_controller_is_an_error(monkeypatch):
    monkeypatch.setitem(ARMS, "another", (DEXARM, lambda: MarlinController(homing_s=1.0)))
    with gcode_rig("another", home=False) as rig:
        with pytest.raises(CommandRefusedError, match=r"M1112: .* no such command: .*Unknown"):
            rig.robot.home()
        assert not rig.robot.status().homed
        assert not rig.is_moving()


def test_a_feed_rate_of_zero_is_refused(name):
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
        rig.assert_at(GOAL)


def test_the_pose_during_a_move_is_the_actual_one_not_the_goal(name):
    with gcode_rig(name) as rig:
        rig.robot.move_to(GOAL)
        rig.robot.move_to(FAR, speed_m_s=0.05, wait=False)
        before = rig.true_m()
        pose = rig.robot.pose()
        after = rig.true_m()
        low, high = np.minimum(before, after) - 1e-4, np.maximum(before, after) + 1e-4
        assert ((low <= pose.position_m) & (pose.position_m <= high)).all()


@best_of_three
def test_a_stop_overtakes_every_queue(name):
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
        if name == "marlin":  # its motors may have slipped
            rig.robot.home()
        rig.robot.move_to(GOAL)
        rig.assert_at(GOAL)


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


def test_a_goal_out_of_reach_is_refused(name):
    with gcode_rig(name) as rig:
        with pytest.raises(OutOfReachError):
            rig.robot.move_to(Pose(0.31, 0.31, 0.05))
        rig.robot.move_to(GOAL)


def test_an_arm_that_does_not_move_is_detected():
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
        rig.assert_at(GOAL)


def test_the_cable_is_unplugged_and_plugged_in_again(name):
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


def test_a_dexarm_has_no_roll_angle():
    """Its `G0` and `G1` have no `R`."""
    robot = open_robot("dexarm:///dev/null?lower_m=-0.1,0.2,0&upper_m=0.1,0.3,0.1")
    with pytest.raises(InvalidInputError, match="roll"):
        robot.limits.check(Pose(0.0, 0.25, 0.05, roll_rad=0.5))


def test_a_uarm_has_limits_without_roll_angle():
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
def test_given_limits_override_those_of_a_uarm(options, changes):
    limits = open_robot(f"uarm:///dev/null?{options}").limits
    assert limits == replace(UARM.limits, **changes)


@pytest.mark.parametrize(("given", "missing"), [("lower_m", "upper_m"), ("upper_m", "lower_m")])
def test_a_box_needs_both_corners(given, missing):
    with pytest.raises(InvalidInputError, match=f"{missing} is missing"):
        open_robot(f"marlin:///dev/null?{given}=0.1,0.2,0.3")


def test_the_default_speed_of_a_marlin_is_slow():
    url = "marlin:///dev/null?lower_m=0,0,0&upper_m=0.1,0.1,0.1"
    assert open_robot(url).limits.max_speed_m_s == MAX_SPEED_M_S
    assert open_robot(f"{url}&max_speed_m_s=0.2").limits.max_speed_m_s == 0.2


def test_a_refused_goal_leaves_the_position_known(name):
    with gcode_rig(name) as rig:
        rig.robot.move_to(GOAL)
        rig.emulator.inject(Fault.OUT_OF_RANGE)
        with pytest.raises(OutOfReachError):
            rig.robot.move_to(FAR)
        rig.robot.move_to(FAR)
        rig.assert_at(FAR)


@pytest.mark.parametrize("url", ["dobot:///dev/ttyUSB0", "dobot", "magician://COM3"])
def test_the_address_of_a_dobot_magician_is_refused_with_advice(url):
    with pytest.raises(InvalidInputError, match=r"binary protocol.*dexarm://") as refused:
        open_robot(url)
    assert "\n" not in str(refused.value)
