"""Emulation of the six servos of an SO-101, as seen from their bus.

Bytes in, bytes out, at given times, as in `fingerpost.robot.emulator.acl`. Packets follow Feetech's
protocol manual of the SCS and STS series, and the memory is that of an STS3215. A servo moves to
its goal at its goal speed, without ramps; the arm's joints carry no load.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import msgspec

from fingerpost.robot.emulator.faults import Fault

BROADCAST = 0xFE
PING, READ, WRITE, SYNC_READ, SYNC_WRITE = 0x01, 0x02, 0x03, 0x82, 0x83

MODEL, MIN_POSITION, MAX_POSITION, HOMING_OFFSET = 3, 9, 11, 31
TORQUE_ENABLE, GOAL_POSITION, GOAL_SPEED = 40, 42, 46
PRESENT_POSITION, PRESENT_VOLTAGE, PRESENT_TEMPERATURE, MOVING = 56, 62, 63, 66
MEMORY_BYTES = 128

STS3215 = 777
"""The model's own number."""

GREATEST_SPEED = 3400
"""Speed for a goal speed of 0 [counts/s]: 50 rpm."""

NAMES = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")

CALIBRATION = {
    "shoulder_pan": {
        "id": 1,
        "drive_mode": 0,
        "homing_offset": -1470,
        "range_min": 758,
        "range_max": 3292,
    },
    "shoulder_lift": {
        "id": 2,
        "drive_mode": 0,
        "homing_offset": -1126,
        "range_min": 901,
        "range_max": 3245,
    },
    "elbow_flex": {
        "id": 3,
        "drive_mode": 0,
        "homing_offset": 1404,
        "range_min": 870,
        "range_max": 3090,
    },
    "wrist_flex": {
        "id": 4,
        "drive_mode": 0,
        "homing_offset": 318,
        "range_min": 846,
        "range_max": 3250,
    },
    "wrist_roll": {
        "id": 5,
        "drive_mode": 0,
        "homing_offset": 92,
        "range_min": 0,
        "range_max": 4095,
    },
    "gripper": {
        "id": 6,
        "drive_mode": 0,
        "homing_offset": 1191,
        "range_min": 2021,
        "range_max": 3510,
    },
}
"""Calibration of the emulated arm, as `lerobot-calibrate` would write it."""

START = {1: 2025, 2: 1500, 3: 2500, 4: 2600, 5: 2048, 6: 3000}
"""Initial positions of the servos [counts]: the gripper is above the table in front."""

_FAULT_BITS = {
    Fault.UNDERVOLTAGE: (1, 0x01),
    Fault.OVERHEAT: (4, 0x04),
    Fault.IMPACT: (3, 0x08),
    Fault.OVERLOAD: (2, 0x20),
}
"""Servo and bit of each fault."""


def calibration_file() -> bytes:
    """Return the emulated arm's calibration as LeRobot would write it."""
    return msgspec.json.format(msgspec.json.encode(CALIBRATION), indent=4)


@dataclass(slots=True)
class Servo:
    """One servo: its memory, and its position between two goals.

    Attributes
    ----------
    position : float
        Position at the last change of its goal or speed [counts].
    since_s : float
        Time of that change [s].
    blocked_at : float or None
        Position at which it is blocked, from either direction [counts].
    faults : int
        Fault bits, reported until its torque is switched on again.
    """

    position: float
    memory: bytearray = field(default_factory=lambda: bytearray(MEMORY_BYTES))
    since_s: float = 0.0
    stuck: bool = False
    blocked_at: float | None = None
    faults: int = 0

    def at(self, now_s: float) -> float:
        """Return its position [counts]."""
        goal = float(self._word(GOAL_POSITION))
        if not self.memory[TORQUE_ENABLE] or self.stuck:
            return self.position
        if self.blocked_at is not None and goal < self.blocked_at <= self.position:
            goal = self.blocked_at
        gone = (self._word(GOAL_SPEED) or GREATEST_SPEED) * max(0.0, now_s - self.since_s)
        way = goal - self.position
        return goal if gone >= abs(way) else self.position + math.copysign(gone, way)

    def is_moving(self, now_s: float) -> bool:
        """Whether it is on its way."""
        return self.at(now_s) != self.at(now_s + 60.0)

    def write(self, address: int, data: bytes, now_s: float) -> None:
        """Write bytes to its memory."""
        self.position, self.since_s = self.at(now_s), now_s
        self.memory[address : address + len(data)] = data
        if address <= TORQUE_ENABLE < address + len(data) and self.memory[TORQUE_ENABLE]:
            self.faults = 0

    def read(self, address: int, length: int, now_s: float) -> bytes:
        """Return bytes of its memory, with present measurements."""
        self._put(PRESENT_POSITION, round(self.at(now_s)))
        self.memory[MOVING] = self.is_moving(now_s)
        return bytes(self.memory[address : address + length])

    def _word(self, address: int) -> int:
        return int.from_bytes(self.memory[address : address + 2], "little")

    def _put(self, address: int, value: int) -> None:
        self.memory[address : address + 2] = value.to_bytes(2, "little")


def make_servo(name: str) -> Servo:
    """Return one of the arm's servos, calibrated, its torque off."""
    known = CALIBRATION[name]
    servo = Servo(float(START[known["id"]]))
    offset = known["homing_offset"]
    for address, value in (
        (MODEL, STS3215),
        (MIN_POSITION, known["range_min"]),
        (MAX_POSITION, known["range_max"]),
        (HOMING_OFFSET, abs(offset) | (0x0800 if offset < 0 else 0)),
    ):
        servo._put(address, value)
    servo.memory[PRESENT_VOLTAGE], servo.memory[PRESENT_TEMPERATURE] = 74, 31
    return servo


class FeetechBus:
    """The servos of an arm.

    Attributes
    ----------
    servos : dict of int to Servo
        The servos, by number.
    lost : set of int
        Numbers of disconnected servos.
    goals : int
        Number of times that goals were written to all joints at once.
    """

    def __init__(self) -> None:
        self.servos = {CALIBRATION[name]["id"]: make_servo(name) for name in NAMES}
        self.lost: set[int] = set()
        self.goals = 0
        self._waiting = bytearray()
        self._received = b""

    # Interface to a port.

    def receive(self, data: bytes, now_s: float) -> None:
        """Process bytes received at a time [s]."""
        self._received += data
        while (packet := self._next_packet()) is not None:
            self._carry_out(packet, now_s)

    def poll(self, now_s: float) -> bytes:
        """Return the bytes that the servos send by now."""
        del now_s  # they answer at once
        data = bytes(self._waiting)
        self._waiting.clear()
        return data

    def next_due_s(self) -> float | None:
        """Return None: servos only answer."""
        return None

    def inject(self, fault: Fault, now_s: float) -> None:
        """Simulate a fault of a servo; other faults are ignored."""
        if fault is Fault.LOST_SERVO:
            self.lost.add(3)
        elif fault is Fault.STICK:
            for servo in self.servos.values():
                servo.write(TORQUE_ENABLE, bytes([servo.memory[TORQUE_ENABLE]]), now_s)
                servo.stuck = True
        elif fault in _FAULT_BITS:
            number, bit = _FAULT_BITS[fault]
            self.servos[number].faults |= bit

    # True state, for tests.

    def positions(self, now_s: float) -> dict[int, float]:
        """Return the true positions of the servos [counts]."""
        return {number: servo.at(now_s) for number, servo in self.servos.items()}

    def is_moving(self, now_s: float) -> bool:
        """Whether the arm moves."""
        return any(servo.is_moving(now_s) for servo in self.servos.values())

    def heal(self) -> None:
        """Remove all faults, and reconnect the servos."""
        self.lost.clear()
        for servo in self.servos.values():
            servo.faults, servo.stuck = 0, False

    # The dialogue.

    def _next_packet(self) -> bytes | None:
        """Return the next packet from its servo's number to its checksum; drop other bytes."""
        while True:
            start = self._received.find(b"\xff\xff")
            if start < 0:
                self._received = self._received[-1:]
                return None
            packet = self._received[start + 2 :]
            if len(packet) < 2 or len(packet) < 2 + packet[1]:
                self._received = self._received[start:]
                return None
            body, self._received = packet[: 2 + packet[1]], packet[2 + packet[1] :]
            if len(body) > 3 and ~sum(body[:-1]) & 0xFF == body[-1]:
                return body

    def _carry_out(self, packet: bytes, now_s: float) -> None:
        target, instruction, parameters = packet[0], packet[2], packet[3:-1]
        if target == BROADCAST:
            if instruction == SYNC_WRITE:
                self._sync_write(parameters, now_s)
            elif instruction == SYNC_READ:
                for number in parameters[2:]:
                    self._say_memory(number, parameters[0], parameters[1], now_s)
        elif instruction == PING:
            self._say(target)
        elif instruction == READ:
            self._say_memory(target, parameters[0], parameters[1], now_s)
        elif instruction == WRITE and self._is_there(target):
            self.servos[target].write(parameters[0], parameters[1:], now_s)
            self._say(target)

    def _sync_write(self, parameters: bytes, now_s: float) -> None:
        address, length, *_ = parameters
        written = parameters[2:]
        for k in range(0, len(written) - length, length + 1):
            if self._is_there(written[k]):
                self.servos[written[k]].write(address, written[k + 1 : k + 1 + length], now_s)
        self.goals += address <= GOAL_POSITION < address + length

    def _say_memory(self, number: int, address: int, length: int, now_s: float) -> None:
        if self._is_there(number):
            self._say(number, self.servos[number].read(address, length, now_s))

    def _say(self, number: int, data: bytes = b"") -> None:
        """Send a servo's status packet."""
        if self._is_there(number):
            body = bytes([number, len(data) + 2, self.servos[number].faults, *data])
            self._waiting += b"\xff\xff" + body + bytes([~sum(body) & 0xFF])

    def _is_there(self, number: int) -> bool:
        return number in self.servos and number not in self.lost
