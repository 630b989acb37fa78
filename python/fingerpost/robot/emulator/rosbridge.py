"""Emulation of a rosbridge server with an arm, as seen from its WebSocket.

Bytes in, bytes out, at given times, as in `fingerpost.robot.emulator.acl`: the handshake and frames
of a WebSocket (`websockets` without input and output), with the operations of rosbridge's protocol
2.0 that the driver uses. The arm moves to each target at one speed, like a Cartesian impedance
controller, and publishes its pose 50 times a second.
"""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np

from fingerpost.installation import require
from fingerpost.robot.emulator.faults import Fault
from fingerpost.robot.motion import Vector

FRAME = "base_link"
TARGET_TOPIC, POSE_TOPIC = "/fingerpost/target", "/fingerpost/pose"
SERVICES = ("/fingerpost/start", "/fingerpost/stop", "/fingerpost/open", "/fingerpost/close")

POSE_S = 0.02
"""Interval of published poses [s]."""

SPEED_M_S = 1.0
"""Speed of motion to a target [m/s]."""

START_M = (0.3, 0.0, 0.3)
START_Q = {"x": 1.0, "y": 0.0, "z": 0.0, "w": 0.0}
"""Initial position [m], with the tool straight down."""

_HANDSHAKE = b"GET "


class RosbridgeServer:
    """The server and its arm.

    Attributes
    ----------
    operations : list of dict
        All operations received, for tests.
    calls : list of str
        All services called.
    frame : str
        The frame of the published poses.
    refuses : dict of str to str
        Services that refuse, with their messages.
    """

    def __init__(self) -> None:
        self._server = require("websockets.server", "ros")
        self._protocol: Any = None
        self.operations: list[dict[str, Any]] = []
        self.calls: list[str] = []
        self.frame = FRAME
        self.refuses: dict[str, str] = {}
        self._start, self._goal = np.array(START_M), np.array(START_M)
        self._turned: dict[str, float] = START_Q
        self._since_s = 0.0
        self._stuck = False
        self._is_published, self._silent = False, False
        self._next_pose_s = 0.0

    # Interface to a port.

    def receive(self, data: bytes, now_s: float) -> None:
        """Process bytes received at a time [s]."""
        if data.startswith(_HANDSHAKE):
            self._protocol = self._server.ServerProtocol()
            self._is_published = False
        if self._protocol is None:
            return
        self._protocol.receive_data(data)
        for event in self._protocol.events_received():
            if hasattr(event, "headers"):
                self._protocol.send_response(self._protocol.accept(event))
            elif event.opcode.name == "TEXT":
                self._carry_out(msgspec.json.decode(event.data), now_s)

    def poll(self, now_s: float) -> bytes:
        """Return the bytes that the server sends by now."""
        if self._protocol is None:
            return b""
        if self._is_published and not self._silent and now_s >= self._next_pose_s:
            self._next_pose_s = now_s + POSE_S
            self._say(op="publish", topic=POSE_TOPIC, msg=self._pose(now_s))
        return b"".join(self._protocol.data_to_send())

    def next_due_s(self) -> float | None:
        """Return the time of the next published pose [s], or None."""
        return self._next_pose_s if self._is_published and not self._silent else None

    def inject(self, fault: Fault, now_s: float) -> None:
        """Simulate a fault of the arm or its nodes; other faults are ignored."""
        if fault is Fault.STICK:
            self._start = self._goal = self.position_m(now_s)
            self._stuck = True
        elif fault is Fault.LOST_SERVO:
            self._silent = True
        elif fault is Fault.IMPACT:
            self._say(op="status", level="error", msg="publish: the controller has been aborted")
        elif fault is Fault.OUT_OF_RANGE:
            self.refuses = dict.fromkeys(SERVICES, "in collision")

    # True state, for tests.

    def position_m(self, now_s: float) -> Vector:
        """Return the position of the tool [m]."""
        way = self._goal - self._start
        length_m = float(np.linalg.norm(way))
        gone_m = SPEED_M_S * max(0.0, now_s - self._since_s)
        if gone_m >= length_m:
            return self._goal
        return np.asarray(self._start + gone_m / length_m * way)

    def is_moving(self, now_s: float) -> bool:
        """Whether it is on its way."""
        return bool((self.position_m(now_s) != self._goal).any())

    def heal(self) -> None:
        """Remove all faults of the arm and its nodes."""
        self._stuck = self._silent = False
        self.refuses = {}
        self.frame = FRAME

    # The dialogue.

    def _carry_out(self, operation: dict[str, Any], now_s: float) -> None:
        self.operations.append(operation)
        kind = operation["op"]
        if kind == "subscribe" and operation["topic"] == POSE_TOPIC:
            self._is_published, self._next_pose_s = True, now_s
        elif kind == "publish" and operation["topic"] == TARGET_TOPIC:
            self._go(operation["msg"], now_s)
        elif kind == "call_service":
            self._serve(operation)

    def _go(self, message: dict[str, Any], now_s: float) -> None:
        if self._stuck:
            return
        at = message["pose"]["position"]
        self._start, self._since_s = self.position_m(now_s), now_s
        self._goal = np.array([at["x"], at["y"], at["z"]])
        self._turned = message["pose"]["orientation"]

    def _serve(self, operation: dict[str, Any]) -> None:
        service = operation["service"]
        self.calls.append(service)
        answer: dict[str, Any] = {"op": "service_response", "service": service}
        answer["id"] = operation["id"]
        if service not in SERVICES:
            answer |= {"values": f"Service {service} does not exist", "result": False}
        else:
            refusal = self.refuses.get(service, "")
            answer |= {"values": {"success": not refusal, "message": refusal}, "result": True}
        self._say(**answer)

    def _pose(self, now_s: float) -> dict[str, Any]:
        x, y, z = map(float, self.position_m(now_s))
        seconds = math.floor(now_s)
        stamp = {"sec": seconds, "nanosec": int(1e9 * (now_s - seconds))}
        return {
            "header": {"stamp": stamp, "frame_id": self.frame},
            "pose": {"position": {"x": x, "y": y, "z": z}, "orientation": self._turned},
        }

    def _say(self, **operation: object) -> None:
        if self._protocol is not None and self._protocol.state.name == "OPEN":
            self._protocol.send_text(msgspec.json.encode(operation))
