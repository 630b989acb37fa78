"""A signal that ends or suspends the program stops the arm, as measured at the controller.

The command runs in a subprocess; the test sees only its bytes on the line.
"""

import signal

import pytest
from guided_process import STOPPED_S, EmulatedArm, Guided, Travelling, write_rig


@pytest.fixture
def rig(hand_film, tmp_path):
    return write_rig(tmp_path, hand_film, z_m=(0.03, 0.4))


@pytest.mark.parametrize(
    ("number", "code"),
    [
        (signal.SIGINT, 130),
        (signal.SIGTERM, 128 + signal.SIGTERM),
        (signal.SIGHUP, 128 + signal.SIGHUP),
    ],
)
def test_a_signal_stops_the_arm(rig, tmp_path, number, code):
    with Travelling(rig, tmp_path) as run:
        aborts = run.travel()
        run.guided.signal(number)
        run.arm.assert_stopped(aborts, STOPPED_S)
        assert run.guided.end() == code
        assert run.reasons()[0] == f"signal {number.name}"
        assert "fixes" in run.guided.out  # the summary is printed nevertheless


@pytest.mark.parametrize(
    ("number", "code"),
    [
        (signal.SIGINT, 130),
        (signal.SIGTERM, 128 + signal.SIGTERM),
        (signal.SIGHUP, 128 + signal.SIGHUP),
    ],
)
def test_a_signal_stops_homing(number, code):
    with EmulatedArm(1.0, homing_s=30.0) as arm, Guided("home", arm.url) as guided:
        guided.until(arm.is_moving)
        aborts = arm.controller.aborts
        guided.signal(number)
        arm.assert_stopped(aborts, STOPPED_S)
        assert guided.end() == code


def test_suspending_the_process_stops_homing():
    with EmulatedArm(1.0, homing_s=30.0) as arm, Guided("home", arm.url) as guided:
        guided.until(arm.is_moving)
        aborts = arm.controller.aborts
        guided.signal(signal.SIGTSTP)
        arm.assert_stopped(aborts, STOPPED_S)
        guided.signal(signal.SIGCONT)
        assert guided.end() == 1


def test_suspending_the_process_stops_the_arm(rig, tmp_path):
    with Travelling(rig, tmp_path) as run:
        aborts = run.travel()
        run.guided.signal(signal.SIGTSTP)
        run.arm.assert_stopped(aborts, STOPPED_S)
        run.guided.signal(signal.SIGCONT)
        assert run.guided.end() == 1  # without keys, the guard cannot be armed again
        assert "stopped: signal SIGTSTP" in run.guided.said()
