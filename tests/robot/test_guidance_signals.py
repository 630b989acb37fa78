"""A signal that ends or suspends the program stops the arm: seen at the emulated controller's end.

The command runs as a process of its own; nothing of it is known here but its bytes on the line.
"""

import signal

import pytest
from guided_process import STOPPED_S, Travelling, write_rig


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
        assert "fixes" in run.guided.out  # what was done is reported all the same


def test_suspending_the_process_stops_the_arm_first(rig, tmp_path):
    with Travelling(rig, tmp_path) as run:
        aborts = run.travel()
        run.guided.signal(signal.SIGTSTP)
        run.arm.assert_stopped(aborts, STOPPED_S)
        run.guided.signal(signal.SIGCONT)
        assert run.guided.end() == 1  # without keys there is no arming again
        assert "stopped: signal SIGTSTP" in run.guided.said()
