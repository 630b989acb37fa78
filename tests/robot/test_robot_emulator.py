"""Serving emulated controllers: ports, faults by name, and the command that does it."""

import signal
import subprocess
import sys
import threading
import time

import pytest
import serial

from fingerpost.errors import InvalidInputError
from fingerpost.robot.emulator import EMULATED, Fault, make_emulator, serve


def ask(address, command, wait_s=0.3):
    with serial.serial_for_url(address, timeout=wait_s) as port:
        port.write(command)
        return port.read(200)


@pytest.mark.parametrize(
    ("name", "command", "answer"),
    [
        ("acl", b"SPEED 20\r", b"SPEED 20\r\nDone.\r\n>"),
        ("marlin", b"N0 M110 N0*125\n", b"ok\n"),
        ("dobot", b"N0 M110 N0*125\n", b"ok\n"),
        ("uarm", b"#1 M17\n", b"$1 ok\n"),
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


def test_faults_come_by_name():
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


def test_faults_come_at_random():
    said = []
    stop = threading.Event()

    def announce(text):
        said.append(text)
        if len(said) > 10:
            stop.set()

    serve(make_emulator("acl"), announce, stop, faults_per_s=500.0, seed=3)
    assert set(said[1:]) <= set(Fault)
    assert len(set(said[1:])) > 3


@pytest.mark.parametrize("options", [{"homing_s": 0.0}, {"time_scale": -1.0}])
def test_values_out_of_range_are_refused(options):
    with pytest.raises(InvalidInputError):
        make_emulator("acl", **options)


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
