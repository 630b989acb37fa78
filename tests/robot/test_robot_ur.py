"""Universal Robots: the driver with a stand-in for `ur_rtde` and its controller.

If the vendor's library is installed, the stand-in's methods are compared with it.
"""

import itertools
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from robot_rig import assert_in_time, best_of_three
from scipy.spatial.transform import Rotation
from ur_stand_in import Program, UrController, dashboard, libraries, serve

from fingerpost.errors import InvalidInputError
from fingerpost.robot import ur_dashboard
from fingerpost.robot.errors import (
    CommandRefusedError,
    ConnectionLostError,
    GripperError,
    NotArrivedError,
    NotHomedError,
    NotReadyError,
    OutOfReachError,
    RobotFaultError,
    StoppedError,
)
from fingerpost.robot.protocol import TOOL_DOWN_RAD, Pose, Robot, RobotState
from fingerpost.robot.ur import UniversalRobot, UrOptions

GOAL = Pose(0.3, 0.1, 0.2, pitch_rad=TOOL_DOWN_RAD, roll_rad=0.4, yaw_rad=0.0)
SLOW_M_S = 0.01
"""At this speed the path to `GOAL` takes 14 s."""


@pytest.fixture
def controller(monkeypatch):
    """A controller in this process, with its dashboard on a port."""
    controller = UrController()
    for name, kind in libraries(controller).items():
        module = ModuleType(name)
        setattr(module, kind.__name__, kind)
        monkeypatch.setitem(sys.modules, name, module)
    with dashboard(controller) as port:
        monkeypatch.setattr(ur_dashboard, "PORT", port)
        yield controller


def ur(**options):
    return UniversalRobot("127.0.0.1", UrOptions(stall_s=0.1, gripper_s=0.0, **options))


def wait_until(true):
    end_s = time.monotonic() + 5.0
    while not true():
        assert time.monotonic() < end_s
        time.sleep(0.001)


def start_moving(robot, controller):
    robot.home()
    robot.move_to(GOAL, speed_m_s=SLOW_M_S, wait=False)
    assert controller.arm.is_moving()


def test_it_moves_in_metres_and_rotation_vectors(controller):
    with ur() as robot:
        assert isinstance(robot, Robot)
        robot.home()
        robot.move_to(GOAL, speed_m_s=0.25)
        np.testing.assert_allclose(controller.arm.position(), GOAL.position_m)
        assert controller.arm.speed == 0.25
        approach = controller.arm.rotation.apply([0.0, 0.0, 1.0])
        np.testing.assert_allclose(approach, [0.0, 0.0, -1.0], atol=1e-9)
        pose = robot.pose()
        assert pose.distance_m(GOAL) < 1e-9
        assert pose.roll_rad == pytest.approx(GOAL.roll_rad)


def test_roll_and_yaw_of_a_vertical_gripper_are_one_rotation(controller):
    with ur() as robot:
        robot.home()
        robot.move_to(Pose(0.3, 0.0, 0.2, pitch_rad=TOOL_DOWN_RAD, roll_rad=0.5, yaw_rad=0.9))
        assert robot.pose().yaw_rad == 0.0


def test_it_keeps_its_orientation_when_none_is_given(controller):
    controller.arm.rotation = Rotation.from_rotvec([0.3, 2.0, -0.4])
    with ur() as robot:
        robot.home()
        robot.move_to(Pose(0.3, 0.1, 0.2))
        np.testing.assert_allclose(controller.arm.rotation.as_rotvec(), [0.3, 2.0, -0.4])
        with pytest.raises(InvalidInputError, match="all three"):
            robot.move_to(Pose(0.3, 0.1, 0.2, pitch_rad=0.0))


def test_a_stop_ends_a_waiting_call(controller):
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
        stops = controller.arm.stops
        robot.stop()
        assert controller.arm.stops > stops
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
def test_false_answers_of_the_library_become_errors(controller, change, error):
    with ur() as robot:
        robot.home()
        for name, value in change.items():
            setattr(controller, name, value)
        with pytest.raises(error):
            robot.move_to(GOAL)


def test_a_creeping_arm_does_not_count_as_standing(controller):
    # Between two readings it moves by a tenth of the standstill tolerance.
    with ur(poll_s=0.001) as robot:
        robot.home()
        here = robot.pose()
        goal = replace(here, y_m=here.y_m + 0.005)
        robot.move_to(goal, speed_m_s=0.02)
        assert robot.pose().distance_m(goal) < 1e-3


def test_a_late_answer_does_not_count_as_a_standstill(controller, monkeypatch):
    # The second of two readings is taken at once, but answered only after the stall time.
    with ur(poll_s=0.001) as robot:
        robot.home()
        here, position = robot.pose(), controller.arm.position
        late_s = itertools.cycle([0.0, 0.15])

        def late_position():
            at = position()
            time.sleep(next(late_s))
            return at

        goal = replace(here, y_m=here.y_m + 0.02)
        robot.move_to(goal, speed_m_s=0.02, wait=False)
        monkeypatch.setattr(controller.arm, "position", late_position)
        robot.wait()
        assert robot.pose().distance_m(goal) < 1e-3


def test_an_arm_that_is_switched_off_is_not_ready(controller):
    controller.mode = 3
    with ur() as robot:
        with pytest.raises(RobotFaultError, match="mode 3"):
            robot.home()
        with pytest.raises(NotReadyError):
            robot.move_to(GOAL)


def test_nothing_moves_before_homing(controller):
    with ur() as robot, pytest.raises(NotHomedError):
        robot.move_to(GOAL)


def test_a_missing_arm_is_a_lost_connection(controller):
    with pytest.raises(ConnectionLostError, match="No route"):
        UniversalRobot("nobody").connect()


def test_it_has_no_gripper_unless_an_output_is_named(controller):
    with ur() as robot:
        robot.home()
        with pytest.raises(GripperError, match="no gripper"):
            robot.gripper("close")
    with ur(gripper_output=3) as robot:
        robot.home()
        robot.gripper("close")
        assert controller.outputs == {3: True}
        robot.gripper("open")
        assert controller.outputs == {3: False}
        controller.accepts = False
        with pytest.raises(GripperError, match="output 3"):
            robot.gripper("close")


# Required actions at the pendant.


def refused(robot):
    """Return the message of a refused command."""
    with pytest.raises((RobotFaultError, CommandRefusedError)) as caught:
        robot.move_to(GOAL)
    return str(caught.value)


def test_three_causes_of_a_standstill_have_different_messages(controller):
    said = {}
    with ur() as robot:
        robot.home()
        controller.stop_program()
        said["script"] = refused(robot)
        robot.home()
        controller.protective = True
        said["protective stop"] = refused(robot)
        controller.protective = False
        robot.home()
        controller.stop_program()
        controller.remote_control = False
        said["remote control"] = refused(robot)
    for words, message in said.items():
        assert words in message
        assert "pendant" in message
        assert sum(words in other for other in said.values()) == 1


@pytest.mark.parametrize("happens", [UrController.stop_program, UrController.pause])
def test_a_program_stopped_during_a_move_is_reported(controller, happens):
    with ur() as robot:
        start_moving(robot, controller)
        happens(controller)
        with pytest.raises(RobotFaultError, match="control script has stopped"):
            robot.wait()
        assert robot.status().state is RobotState.FAULT
        with pytest.raises(NotReadyError, match="control script"):
            robot.move_to(GOAL)


@pytest.mark.parametrize("afterwards", [lambda _: None, UrController.stop_program])
def test_homing_after_a_protective_stop_keeps_the_connection(controller, afterwards):
    with ur() as robot:
        start_moving(robot, controller)
        controller.protective = True
        with pytest.raises(RobotFaultError, match="protective stop"):
            robot.wait()
        with pytest.raises(RobotFaultError, match="protective stop"):
            robot.home()
        controller.protective = False
        afterwards(controller)
        robot.home()
        robot.move_to(GOAL)
        np.testing.assert_allclose(controller.arm.position(), GOAL.position_m)
        assert controller.clients == 1
        assert controller.uploads == 2
        assert controller.watchdog_hz is not None


def test_a_move_paused_by_a_protective_stop_does_not_resume_by_itself(controller):
    """Nor on resuming at the pendant, for the driver has ended the program."""
    with ur() as robot:
        start_moving(robot, controller)
        controller.protective = True
        with pytest.raises(RobotFaultError):
            robot.wait()
        controller.protective = False
        controller.resume()
        assert not controller.arm.is_moving()


def test_a_script_that_does_not_start_is_reported(controller, monkeypatch):
    monkeypatch.setattr("fingerpost.robot.ur.SCRIPT_START_S", 0.05)
    with ur() as robot:
        controller.stop_program()
        controller.starts = False
        with pytest.raises(RobotFaultError, match="control script does not start"):
            robot.home()
        controller.remote_control = False
        with pytest.raises(RobotFaultError, match="remote control is switched off"):
            robot.home()


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"remote_control": False}, CommandRefusedError, "remote control is switched off"),
        ({"protective": True}, RobotFaultError, "protective stop"),
        ({"emergency": True}, RobotFaultError, "emergency stop"),
        ({"starts": False, "mode": 3}, RobotFaultError, "robot mode 3"),
        ({"starts": False}, ConnectionLostError, "control script"),
    ],
)
def test_a_failed_connection_states_its_cause(controller, change, error, words):
    for name, value in change.items():
        setattr(controller, name, value)
    robot = ur()
    with pytest.raises(error, match=words):
        robot.connect()
    assert robot.status().state is RobotState.DISCONNECTED


def test_an_unanswered_reach_query_is_not_reported_as_out_of_reach(controller):
    with ur() as robot:
        robot.home()
        controller.takes = controller.stop_program  # just before the query
        with pytest.raises(RobotFaultError, match="control script has stopped"):
            robot.move_to(GOAL)


def test_a_move_refused_by_a_running_script(controller):
    with ur() as robot:
        robot.home()
        controller.accepts = False
        with pytest.raises(CommandRefusedError, match="though the control script runs"):
            robot.move_to(GOAL)
        controller.remote_control = False
        with pytest.raises(CommandRefusedError, match="remote control is switched off"):
            robot.move_to(GOAL)


def test_reconnecting_closes_open_connections(controller):
    closed = []
    with ur() as robot:
        for part in (robot._control, robot._receive):
            part.disconnect = lambda part=part: closed.append(part)
        robot.connect()
        assert len(closed) == 2


def test_all_parts_are_closed_although_one_fails(controller):
    closed = []

    def fail():
        raise RuntimeError("disconnect: broken pipe")

    with ur() as robot:
        robot._control.disconnect = fail
        robot._receive.disconnect = lambda: closed.append(1)
    assert closed == [1]


def test_other_errors_of_the_library_become_package_errors(controller):
    def fail():
        raise ValueError("vector::_M_range_check")

    with ur() as robot:
        robot.home()
        robot._receive.getActualTCPPose = fail
        with pytest.raises(CommandRefusedError, match="ValueError: vector"):
            robot.pose()


# Refused stops.


def test_a_refused_stop_stops_the_program_instead(controller):
    """A paused program accepts no stop, and would continue its move when resumed."""
    with ur() as robot:
        start_moving(robot, controller)
        controller.pause()
        robot.stop()
        assert controller.program is Program.STOPPED
        controller.resume()
        assert not controller.arm.is_moving()


@pytest.mark.parametrize("error", [RuntimeError("broken pipe"), ValueError("NaN"), OSError(5, "")])
def test_a_failing_stop_stops_the_program_instead(controller, error):
    with ur() as robot:
        start_moving(robot, controller)
        controller.stop_error = error
        robot.stop()
        assert controller.program is Program.STOPPED
        assert not controller.arm.is_moving()


def test_a_stop_answered_by_false_counts_as_refused(controller):
    with ur() as robot:
        start_moving(robot, controller)
        robot._control.stopL = lambda *_: False  # as some versions of the library do
        robot.stop()
        assert not controller.arm.is_moving()


def test_an_impossible_stop_raises(controller, monkeypatch):
    with ur() as robot:
        start_moving(robot, controller)
        monkeypatch.setattr(ur_dashboard, "ask", lambda *_: "Failed to execute: stop")
        controller.stop_error = RuntimeError("broken pipe")
        with pytest.raises(ConnectionLostError, match=r"broken pipe.*nor could the program"):
            robot.stop()
        controller.stop_error = None
        controller.pause()
        with pytest.raises(CommandRefusedError, match=r"stopL was refused.*Failed to execute"):
            robot.stop()
        monkeypatch.undo()


def test_a_program_that_has_ended_needs_no_stop(controller, monkeypatch):
    with ur() as robot:
        start_moving(robot, controller)
        controller.stop_program()
        monkeypatch.setattr(ur_dashboard, "ask", lambda *_: pytest.fail("asked"))
        robot.stop()


def test_a_missing_dashboard_gives_no_information(monkeypatch):
    monkeypatch.setattr(ur_dashboard, "PORT", 1)
    assert not ur_dashboard.remote_control_is_off("127.0.0.1")
    with pytest.raises(OSError, match="refused"):
        ur_dashboard.stop_program("127.0.0.1")


@best_of_three
def test_a_stop_goes_out_at_once_while_others_command(controller, monkeypatch):
    monkeypatch.setattr("fingerpost.robot.ur.KICKS", 40)
    with ur() as robot:
        start_moving(robot, controller)
        done = threading.Event()

        def command():
            while not done.is_set():
                with robot._commanding():
                    robot._control.isPoseWithinSafetyLimits([0.0] * 6)

        busy = threading.Thread(target=command)
        busy.start()
        try:
            for _ in range(20):
                controller.arm.go([0.3, 0.5, 0.2], controller.arm.rotation, SLOW_M_S)
                called_s = time.monotonic()
                robot.stop()
                assert_in_time(called_s, time.monotonic())
                assert not controller.arm.is_moving()
        finally:
            done.set()
            busy.join()


# The watchdog.


def test_the_watchdog_is_served_in_motion_and_at_rest(controller):
    with ur() as robot:
        start_moving(robot, controller)
        for _ in range(10):
            time.sleep(0.2)  # its period
            controller.look()
            assert controller.arm.is_moving()
        robot.stop()
        time.sleep(0.5)
        robot.move_to(GOAL, speed_m_s=1.0)
    assert controller.overlaps == 0


def test_homing_restarts_an_expired_watchdog(controller):
    with ur() as robot:
        start_moving(robot, controller)
        controller._written_s -= 1.0  # no message for a second
        with pytest.raises(RobotFaultError, match="control script has stopped"):
            robot.wait()
        robot.home()
        assert controller.watchdog_hz == 5
        time.sleep(0.5)
        robot.move_to(GOAL, speed_m_s=1.0)


def test_the_watchdog_is_not_served_after_closing(controller):
    with ur(watchdog_hz=50) as robot:
        robot.home()
        wait_until(lambda: controller.kicks > 2)
    kicks = controller.kicks
    time.sleep(0.1)
    assert controller.kicks == kicks
    assert not any(thread.name == "ur" for thread in threading.enumerate())


def test_a_library_without_a_watchdog_works_with_a_warning(controller, caplog):
    control = libraries(controller)["rtde_control"]
    del control.setWatchdog
    with ur() as robot:
        robot._control.__class__ = control
        robot.home()
        robot.move_to(GOAL)
    assert "no watchdog" in caplog.text


def test_commands_of_two_threads_never_overlap(controller, monkeypatch):
    monkeypatch.setattr("fingerpost.robot.ur.KICKS", 40)
    with ur() as robot:
        robot.home()
        for k in range(20):
            robot.move_to(replace(GOAL, y_m=0.1 + 0.01 * (k % 2)), speed_m_s=1.0)
    assert controller.overlaps == 0


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_the_arm_stops_when_its_process_is_killed(number):
    """Kill the driver's process with `kill -9`; the controller receives no more messages."""
    controller = UrController()
    program = f"""
        import time
        from fingerpost.robot import Pose, open_robot

        robot = open_robot("ur://127.0.0.1?watchdog_hz=5")
        robot.connect()
        robot.home()
        robot.move_to(Pose(0.3, 0.7, 0.3), speed_m_s={SLOW_M_S}, wait=False)
        print("moving", flush=True)
        time.sleep(60)
    """
    with serve(controller) as port:
        process = subprocess.Popen(
            [sys.executable, "-c", textwrap.dedent(program)],
            env={
                **os.environ,
                "FINGERPOST_TEST_UR_PORT": str(port),
                "PYTHONPATH": os.pathsep.join(
                    [
                        str(Path(__file__).parent / "stand_ins"),
                        os.environ.get("PYTHONPATH", ""),
                    ]
                ),
            },
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            assert process.stdout.readline() == "moving\n"
            time.sleep(1.0)  # five periods
            controller.look()
            assert controller.arm.is_moving()
            process.send_signal(number)
            wait_until(lambda: controller.look() or not controller.arm.is_moving())
            assert controller.program is Program.STOPPED
        finally:
            process.kill()
            process.wait()
            process.stdout.close()


# The library itself.


@pytest.mark.parametrize("name", ["rtde_control", "rtde_receive", "rtde_io"])
def test_the_methods_of_the_stand_in_exist_in_ur_rtde(name):
    kind = libraries(UrController())[name]
    real = getattr(pytest.importorskip(name), kind.__name__)
    for method in (method for method in vars(kind) if not method.startswith("_")):
        assert hasattr(real, method), method
