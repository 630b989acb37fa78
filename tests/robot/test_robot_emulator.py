"""Serving of emulated controllers: ports, faults by name, and the command."""

import signal
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import serial
from click.testing import CliRunner

from fingerpost.cli import main
from fingerpost.errors import InvalidInputError
from fingerpost.robot.emulator import EMULATED, Fault, make_emulator, serve
from fingerpost.robot.emulator.acl import IMPACT_RAD, PARKED_JOINTS_RAD, AclController, AclStyle
from fingerpost.robot.emulator.ports import PluggedController, PtyPort


def ask(address, command, wait_s=0.3):
    with serial.serial_for_url(address, timeout=wait_s) as port:
        port.write(command)
        return port.read(200)


def test_rosbridge_is_served_on_a_tcp_port_alone(tmp_path):
    with make_emulator("rosbridge", tcp_port=0) as emulator:
        assert emulator.address.startswith("127.0.0.1:")
    with pytest.raises(InvalidInputError, match="rosbridge has no serial line; tcp_port is right"):
        make_emulator("rosbridge", link=tmp_path / "x")


@pytest.mark.parametrize(
    ("name", "command", "answer"),
    [
        ("acl", b"SPEED 20\r", b"SPEED 20\r\nDone.\r\n>"),
        ("marlin", b"N0 M110 N0*125\n", b"ok\n"),
        ("dexarm", b"N0 M110 N0*125\n", b"ok\n"),
        ("uarm", b"#1 M17\n", b"$1 ok\n"),
        ("so101", b"\xff\xff\x01\x02\x01\xfb", b"\xff\xff\x01\x02\x00\xfc"),
    ],
)
def test_every_controller_answers_on_its_port(name, command, answer):
    with make_emulator(name) as emulator:
        assert ask(emulator.address, command) == answer
    assert name in EMULATED


def test_a_tcp_port_serves_one_driver_after_another():
    with make_emulator("acl", tcp_port=0) as emulator:
        for _ in range(2):
            assert ask(emulator.address, b"\r") == b"\r\n>"


def test_the_link_can_be_chosen_and_vanishes_with_the_cable(tmp_path):
    link = tmp_path / "acl"
    with make_emulator("acl", link=link) as emulator:
        assert emulator.address == str(link)
        assert ask(str(link), b"\r") == b"\r\n>"
        emulator.inject(Fault.UNPLUG)
        assert not link.exists()
        emulator.inject(Fault.PLUG)
        assert ask(str(link), b"\r") == b"\r\n>"
    assert not link.is_symlink()


def test_a_controller_without_echo():
    with make_emulator("acl", echo=False) as emulator:
        assert ask(emulator.address, b"SPEED 20\r") == b"Done.\r\n>"


def test_faults_are_injected_by_name():
    said = []
    stop = threading.Event()
    emulator = make_emulator("acl")
    orders = ["impact\n", "\n", "earthquake\n", " Silent\n"]
    server = threading.Thread(
        target=serve, args=(emulator, said.append, stop), kwargs={"orders": orders}
    )
    server.start()
    end_s = time.monotonic() + 5.0
    while len(said) < 4 and time.monotonic() < end_s:
        time.sleep(0.01)
    stop.set()
    server.join(5.0)
    assert said[0].endswith("/port")
    assert said[1] == "impact"
    assert said[2].startswith("'earthquake' is no fault; there are impact")
    assert said[3] == "silent"


def test_faults_are_injected_at_random():
    said = []
    stop = threading.Event()

    def announce(text):
        said.append(text)
        if len(said) > 10:
            stop.set()

    serve(make_emulator("acl"), announce, stop, faults_per_s=500.0, seed=3)
    assert set(said[1:]) <= set(Fault)
    assert len(set(said[1:])) > 3


@pytest.mark.parametrize(
    "options",
    [
        {"homing_s": 0.0},
        {"homing_s": np.inf},
        {"time_scale": -1.0},
        {"time_scale": 1e308},
        {"seed": -1},
        {"tcp_port": 65536},
        {"tcp_port": -5},
    ],
)
def test_values_out_of_range_are_refused(options):
    with pytest.raises(InvalidInputError):
        make_emulator("acl", **options)


def test_an_unusable_port_is_refused(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("precious")
    for link in (tmp_path / "no" / "such", tmp_path / "folder", tmp_path / "file"):
        emulator = make_emulator("acl", link=link)
        with pytest.raises(InvalidInputError, match=f"{link}: no link can be put there"), emulator:
            pass
    assert (tmp_path / "file").read_text() == "precious"
    with socket.create_server(("127.0.0.1", 0)) as taken:
        emulator = make_emulator("acl", tcp_port=taken.getsockname()[1])
        with pytest.raises(InvalidInputError, match="cannot be served"), emulator:
            pass


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["stop", "acl://[x"], "acl://[x: "),
        (["emulate", "acl", "--tcp-port", "99999"], "99999"),
        (["emulate", "acl", "--tcp-port", "-5"], "-5"),
        (["emulate", "acl", "--link", "/nonexistent/x"], "/nonexistent/x"),
        (["home", "sim://", "--timeout", "nan"], "nan"),
        (["emulate", "acl", "--seed", "-1"], "seed is -1"),
        (["emulate", "acl", "--time-scale", "1e308"], "time_scale"),
        (["emulate", "marlin", "--homing-s", "1e308"], "homing_s"),
        (["emulate", "acl", "--faults-per-s", "1e-300"], "faults_per_s"),
        (["emulate", "acl", "--faults-per-s", "inf"], "faults_per_s"),
    ],
)
def test_unusable_arguments_are_refused_in_one_line(arguments, words):
    ended = CliRunner().invoke(main, ["robot", *arguments])
    assert ended.exit_code == 2
    (line,) = ended.output.splitlines()
    assert words in line


def test_the_command_prints_the_port_and_serves_until_it_is_interrupted():
    command = [sys.executable, "-m", "fingerpost", "robot", "emulate", "acl", "--homing-s", "1"]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        address = process.stdout.readline().strip()
        assert ask(address, b"SPEED 20\r") == b"SPEED 20\r\nDone.\r\n>"
        process.stdin.write("echo-off\n")
        process.stdin.flush()
        assert process.stdout.readline() == "echo-off\n"
        assert ask(address, b"SPEED 20\r") == b"Done.\r\n>"
        process.send_signal(signal.SIGINT)
        assert process.wait(5.0) == 130


@pytest.mark.parametrize(
    ("redirection", "said"),
    [
        ("<&-", []),
        # The sleeping process must not keep the emulator's standard error open.
        (r"< <(printf '\xff\nimpact\n'; exec sleep 60 2>&-)", ["\ufffd", "impact"]),
    ],
)
def test_it_serves_with_closed_or_garbled_standard_input(tmp_path, redirection, said):
    command = f"exec {sys.executable} -m fingerpost robot emulate acl {redirection}"
    with subprocess.Popen(
        ["bash", "-c", command], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        address = process.stdout.readline().strip()
        for words in said:
            assert words in process.stdout.readline()
        assert b"SPEED 20" in ask(address, b"SPEED 20\r")
        process.send_signal(signal.SIGINT)
        assert process.wait(5.0) == 130
        assert "Traceback" not in process.stderr.read()


def test_marlin_survives_a_line_without_a_command():
    with make_emulator("marlin") as emulator:
        for _ in range(2):
            assert b"No Checksum" in ask(emulator.address, b"N1 *94\n")


def test_without_a_thread_it_answers_when_it_is_served():
    now_s = 0.0
    controller = AclController(AclStyle(homing_s=10.0))
    with (
        PluggedController(controller, PtyPort(), clock=lambda: now_s) as plugged,
        serial.serial_for_url(plugged.address, timeout=0) as port,
    ):
        port.write(b"HOME\r")
        assert port.read(100) == b""
        plugged.serve()
        assert port.read(100) == b"HOME\r\nWAIT!! HOMING...\r\n"
        now_s = 9.9
        plugged.serve()
        assert port.read(100) == b""
        now_s = 10.1
        plugged.serve()
        assert port.read(100) == b"HOMING COMPLETE (ROBOT)\r\n>"
        plugged.inject(Fault.IMPACT)
        plugged.serve()
        assert b"*** 53 IMPACT" in port.read(100)


class StuckArm:
    """An arm whose joints the test sets, so that they can lag behind the commands."""

    def __init__(self):
        self.joints = PARKED_JOINTS_RAD.copy()

    def __call__(self):
        return self.joints


def test_the_controller_reports_the_encoders_position():
    arm = StuckArm()
    controller = AclController(AclStyle(homing_s=1.0), encoders=arm)
    controller.receive(b"HOME\r", 0.0)
    arm.joints = controller.commanded_rad(0.99)
    controller.poll(1.1)
    arm.joints = controller.commanded_rad(1.1) + np.array([0.1, 0, 0, 0, 0])
    controller.receive(b"LISTPV POSITION\r", 1.2)
    assert b"1: 800 2:0" in controller.poll(1.2)  # 8000 counts per rad
    assert controller.units(1.2)[1] > 400.0


def test_a_joint_that_does_not_follow_is_an_impact():
    arm = StuckArm()
    controller = AclController(AclStyle(homing_s=1.0), encoders=arm)
    controller.receive(b"HOME\r", 0.0)
    arm.joints = controller.commanded_rad(1.1) + np.array([0, 0, 1.1 * IMPACT_RAD, 0, 0])
    assert b"*** 53 IMPACT PROTECTION AXIS 3" in controller.poll(1.1)
    assert not controller.servos
    # The motors continue from the arm's actual position, not from the commanded one.
    assert controller.commanded_rad(2.0) == pytest.approx(arm.joints)
    controller.receive(b"CON\r", 2.0)
    assert b"***" not in controller.poll(2.0)
