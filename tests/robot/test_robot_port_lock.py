"""Exclusive use of a port, and the advice after bytes of XON/XOFF."""

import fcntl
import os
import pty
import subprocess
import sys
import tty
from contextlib import contextmanager

import pytest
from click.testing import CliRunner
from gcode_rig import FAR, GOAL, gcode_rig
from robot_rig import scorbot_rig

from fingerpost.cli import main
from fingerpost.robot import ConnectionLostError, PortInUseError, open_robot, port_lock
from fingerpost.robot.emulator import make_emulator
from fingerpost.robot.emulator.faults import Fault
from fingerpost.robot.errors import GarbledReplyError, RobotTimeoutError
from fingerpost.robot.serial_line import Flow, SerialLine

TIOCGEXCL = 0x80045440
"""Linux's `ioctl` that reads the flag set by `TIOCEXCL`."""


@contextmanager
def terminal():
    """A pseudo-terminal in place of a controller on a cable."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    try:
        yield os.ttyname(slave)
    finally:
        os.close(slave)
        os.close(master)


@contextmanager
def program(text, *arguments):
    """Run another program; wait until it has opened the port."""
    command = [sys.executable, "-c", text, *arguments]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"open\n"
        try:
            yield process
        finally:
            process.kill()


HOLDS = (
    "import serial, sys; port = serial.Serial(sys.argv[1]{})\n"
    "print('open', flush=True); sys.stdin.read()"
)


@pytest.mark.parametrize("exclusive", [", exclusive=True", ""])
def test_a_port_open_in_another_program_is_refused_and_the_program_named(exclusive):
    with terminal() as device, program(HOLDS.format(exclusive), device, "its-own-word") as other:
        with pytest.raises(PortInUseError) as refused:
            SerialLine(device).open()
        message = str(refused.value)
        assert f"process {other.pid} (" in message
        assert message.startswith(device)
        assert "\n" not in message
        other.kill()
        other.wait()
        SerialLine(device).open()


def test_an_open_port_excludes_another_program():
    tries = (
        "import serial, sys\n"
        "try: serial.Serial(sys.argv[1], exclusive=True)\n"
        "except serial.SerialException: print('kept out')\n"
    )
    with terminal() as device:
        line = SerialLine(device)
        line.open()
        command = [sys.executable, "-c", tries, device]
        assert subprocess.run(command, capture_output=True, check=True).stdout == b"kept out\n"
        line.close()
        assert subprocess.run(command, capture_output=True, check=True).stdout == b""


def test_two_robots_of_one_program_cannot_share_a_port():
    with terminal() as device:
        first, second = SerialLine(device), SerialLine(device)
        first.open()
        with pytest.raises(PortInUseError, match="another robot of this program"):
            second.open()
        first.open()  # anew
        first.close()
        second.open()
        second.close()


def test_the_command_reports_it_in_one_line():
    with (
        make_emulator("marlin") as emulator,
        program(HOLDS.format(", exclusive=True"), emulator.address) as other,
    ):
        ended = CliRunner().invoke(main, ["robot", "stop", f"marlin://{emulator.address}"])
        assert ended.exit_code == 1
        (line,) = ended.output.splitlines()
        assert f"in use by process {other.pid}" in line


def test_an_emulator_in_another_process_does_not_count():
    command = [sys.executable, "-m", "fingerpost", "robot", "emulate", "acl", "--homing-s", "1"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        device = process.stdout.readline().decode().strip()
        try:
            for _ in range(2):
                with open_robot(f"acl://{device}") as robot:
                    robot.stop()
        finally:
            process.terminate()


def test_a_real_device_is_opened_exclusively(monkeypatch):
    """Like on a device that is no pseudo-terminal; the flag must not outlive the line."""
    monkeypatch.setattr(port_lock, "PSEUDO_TERMINAL_MAJORS", range(0))
    with terminal() as device:
        line = SerialLine(device)
        line.open()
        assert _exclusive(line._port.fd)
        descriptor = os.dup(line._port.fd)
        line.close()
        assert not _exclusive(descriptor)
        os.close(descriptor)


def test_a_pseudo_terminal_is_not_locked_exclusively():
    with terminal() as device:
        line = SerialLine(device)
        line.open()
        assert not _exclusive(line._port.fd)
        line.close()


def _exclusive(descriptor):
    flag = bytearray(4)
    fcntl.ioctl(descriptor, TIOCGEXCL, flag)
    return any(flag)


def test_without_proc_the_other_program_is_not_named(monkeypatch, tmp_path):
    monkeypatch.setattr(port_lock, "PROC", tmp_path / "none")
    with (
        terminal() as device,
        program(HOLDS.format(", exclusive=True"), device),
        pytest.raises(PortInUseError, match="in use by another program"),
    ):
        SerialLine(device).open()


@pytest.mark.parametrize("device", ["/dev/none", "/dev/null", "/etc"])
def test_a_device_that_is_no_port_is_not_reported_as_in_use(device):
    with pytest.raises(ConnectionLostError) as refused:
        SerialLine(device).open()
    assert not isinstance(refused.value, PortInUseError)


# XON and XOFF on a line that does not use them.


@pytest.mark.parametrize("name", ["marlin", "uarm"])
def test_xoff_on_a_line_without_flow_control_brings_advice(name, caplog):
    with gcode_rig(name) as rig:
        rig.robot.move_to(GOAL)
        rig.emulator.inject(Fault.XOFF, count=1000)
        with pytest.raises((GarbledReplyError, RobotTimeoutError), match=r"\?flow=xonxoff"):
            rig.robot.move_to(FAR)
    assert caplog.text.count("flow=xonxoff") == 1


def test_xoff_brings_advice_for_a_scorbot_as_well():
    with scorbot_rig() as rig:
        rig.emulator.inject(Fault.XOFF, count=1000)
        with pytest.raises((GarbledReplyError, RobotTimeoutError), match=r"\?flow=xonxoff"):
            rig.robot.pose()


@pytest.mark.parametrize(("flow", "advised"), [(Flow.XON_XOFF, False), (Flow.NONE, True)])
def test_no_advice_on_a_line_with_flow_control(flow, advised):
    with make_emulator("marlin") as emulator:
        line = SerialLine(emulator.address, flow=flow)
        line.open()
        emulator.inject(Fault.XOFF)
        line.send(b"M114\n")
        while line.receive():
            pass
        assert bool(line.advice) is advised
        line.close()


def test_the_advice_for_a_serial_server_differs():
    with make_emulator("marlin", tcp_port=0) as emulator:
        line = SerialLine(emulator.address)
        line.open()
        line._note_received(b"ok\x13")
        assert "at the serial server" in line.advice
        line.open()
        assert line.advice == ""
        line.close()
