"""A UFACTORY control box on TCP ports of the loopback, for the vendor's own library.

It implements the part of the private Modbus TCP protocol that the driver uses: frames of a
transaction number, a protocol number, a length, a function code and data, all big-endian except
32-bit numbers. A second port reports the arm's state ten times per second.
"""

import contextlib
import math
import socket
import socketserver
import struct
import threading
import time
from dataclasses import dataclass, field

import numpy as np
from fake_arm import FakeArm
from scipy.spatial.transform import Rotation

VERSION = b"6,6,XI130500,AC130500,v2.5.0"
REPORT_S = 0.1
REPORT_BYTES = 245

GET_VERSION, MOTION_EN, SET_STATE, GET_STATE, GET_CMDNUM, GET_ERROR = 1, 11, 12, 13, 14, 15
CLEAN_ERR, CLEAN_WAR, SET_MODE, MOVE_LINE, GET_TCP_POSE = 16, 17, 19, 21, 41
RS485_RTU, TGPIO_R16B = 124, 128
BAUD_2M = 11
"""Speed code of the tool's port: the index of 2 Mbaud in the library's list."""

STATUS_REGISTER, ERROR_REGISTER, POSITION_REGISTER, TARGET_REGISTER = 0x0000, 0x000F, 0x0702, 0x0700
VERSION_REGISTERS = {0x0801: 3, 0x0802: 4, 0x0803: 3}
READ, WRITE = 3, 16

READY, MOVING, SLEEPING, PAUSED, STOPPED = 0, 1, 2, 3, 4


@dataclass
class Gripper:
    """A gripper that moves after a delay, at a constant speed, up to an obstacle."""

    pulses: float = 850.0
    delay_s: float = 0.0
    speed: float = 2000.0
    obstacle: float = 0.0
    stuck: bool = False
    _from: float = 850.0
    _goal: float = 850.0
    _began_s: float = field(default_factory=time.monotonic)

    def go(self, goal):
        """Start to move to a position."""
        self._from = self.position()
        self._goal = self._from if self.stuck else max(float(goal), min(self.obstacle, self._from))
        self._began_s = time.monotonic() + self.delay_s

    def position(self):
        """Return the position."""
        gone = self.speed * max(0.0, time.monotonic() - self._began_s)
        way = self._goal - self._from
        return self._goal if gone >= abs(way) else self._from + math.copysign(gone, way)

    def is_moving(self):
        """Return whether it moves or is about to move."""
        return self.position() != self._goal


@dataclass
class Frame:
    """A received request."""

    time_s: float
    transaction: int
    function: int
    data: bytes


class ControlBox:
    """The box, its arm and its gripper; a context manager that serves both ports."""

    def __init__(self):
        self.arm = FakeArm()
        self.gripper = Gripper()
        self.state = STOPPED
        self.error = 0
        self.silent = False
        self.garble = None
        self.not_a_number = self.stuck = False
        self._lines = []
        self.frames = []
        self._servers = []

    def __enter__(self):
        for handle in (self._control, self._report):
            server = socketserver.ThreadingTCPServer(
                ("127.0.0.1", 0), _handler(handle), bind_and_activate=True
            )
            server.daemon_threads = True
            thread = threading.Thread(target=server.serve_forever, args=(0.02,))
            thread.start()
            self._servers.append((server, thread))
        return self

    def __exit__(self, *error):
        for server, thread in self._servers:
            server.shutdown()
            thread.join()
            server.server_close()
        self._servers = []

    @property
    def ports(self):
        """The ports of control and of reports."""
        return tuple(server.server_address[1] for server, _ in self._servers)

    def hang_up(self):
        """Close every connection."""
        for line in self._lines:
            with contextlib.suppress(OSError):
                line.shutdown(socket.SHUT_RDWR)
        self._lines = []

    def received(self, function, data=None):
        """Return the received requests of a kind."""
        return [
            frame
            for frame in list(self.frames)
            if frame.function == function and data in (None, frame.data)
        ]

    def _control(self, line):
        self._lines.append(line)
        buffer = b""
        while chunk := line.recv(1024):
            buffer += chunk
            while len(buffer) >= 6 and len(buffer) >= (end := 6 + _u16(buffer[4:6])):
                self._take(line, buffer[:end])
                buffer = buffer[end:]

    def _take(self, line, raw):
        frame = Frame(time.monotonic(), _u16(raw[0:2]), raw[6], raw[7:])
        self.frames.append(frame)
        answer = self._answer(frame.function, frame.data)
        if self.silent:
            return
        body = bytes([frame.function, self._status()]) + answer
        reply = raw[0:4] + struct.pack(">H", len(body)) + body
        line.sendall(reply if self.garble is None else self.garble(reply))

    def _status(self):
        return (0x10 if self.state == STOPPED else 0) | (0x40 if self.error else 0)

    def _state_now(self):
        if self.state in (PAUSED, STOPPED):
            return self.state
        return MOVING if self.arm.is_moving() else SLEEPING

    def _answer(self, function, data):
        if function == GET_VERSION:
            return VERSION.ljust(40, b"\0")
        if function == SET_STATE:
            self._set_state(data[0])
        elif function == GET_STATE:
            return bytes([self._state_now()])
        elif function == GET_CMDNUM:
            return struct.pack(">H", int(self.arm.is_moving()))
        elif function == GET_ERROR:
            return bytes([self.error, 0])
        elif function == CLEAN_ERR:
            self.error = 0
        elif function == MOVE_LINE:
            self._move(struct.unpack("<10f", data[:40]))
            return bytes(3)
        elif function == GET_TCP_POSE:
            angles = self.arm.rotation.as_euler("xyz")
            position = 1000 * self.arm.position()
            if self.not_a_number:
                position[1] = math.nan
            return struct.pack("<6f", *position, *angles)
        elif function == RS485_RTU:
            return data[:2] + self._tool(data[2:])
        elif function == TGPIO_R16B:
            return struct.pack(">i", BAUD_2M)
        return b""

    def _set_state(self, state):
        self.state = state
        if state in (STOPPED, PAUSED):
            self.arm.stop()

    def _move(self, values):
        if self.state != STOPPED and not self.error and not self.stuck:
            rotation = Rotation.from_euler("xyz", values[3:6])
            self.arm.go(np.array(values[:3]) / 1000.0, rotation, values[6] / 1000.0)

    def _tool(self, request):
        """Return the gripper's answer on the tool's bus."""
        kind, register, count = struct.unpack(">BHH", request[:5])
        if kind == WRITE:
            if register == TARGET_REGISTER:
                self.gripper.go(struct.unpack(">i", request[6:10])[0])
            return request[:5]
        if register == POSITION_REGISTER:
            value = struct.pack(">i", round(self.gripper.position()))
        elif register == STATUS_REGISTER:
            value = struct.pack(">H", int(self.gripper.is_moving()))
        else:
            value = struct.pack(">H", VERSION_REGISTERS.get(register, 0))
        return bytes([kind, 2 * count]) + value.ljust(2 * count, b"\0")

    def _report(self, line):
        while True:
            report = bytearray(REPORT_BYTES)
            report[0:4] = struct.pack(">I", REPORT_BYTES)
            report[4] = self._state_now()
            report[35:59] = struct.pack("<6f", *(1000 * self.arm.position()), 0.0, 0.0, 0.0)
            report[87:91] = bytes([0xFF, 0xFF, self.error, 0])
            report[145:147] = bytes([6, 6])
            if not self.silent:
                line.sendall(bytes(report))
            time.sleep(REPORT_S)


def _handler(handle):
    class Handler(socketserver.BaseRequestHandler):
        def handle(self):
            self.request.settimeout(None)  # the library sets one for its whole process
            self.request.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with contextlib.suppress(OSError):
                handle(self.request)

    return Handler


def _u16(data):
    return int.from_bytes(data, "big")
