"""UFACTORY xArm through its vendor's library `xarm-python-sdk` (extra `xarm`).

The library uses millimetres, and optionally radians. Every call returns a code, 0 for success, and
errors of the arm remain until they are cleared. Moves are sent without waiting. State 4 stops the
arm and prevents motion until state 0.

The library holds a lock from each request to its answer, for up to 2 s on a silent line. A stop
bypasses it: its frame is sent on the same connection, between other frames, with a transaction
number that the library never uses, so that the library skips the answer. Nor does it wait for the
network to acknowledge the previous frame (TCP_NODELAY).
"""

from __future__ import annotations

import logging
import queue
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Annotated, Any

import msgspec

from fingerpost.errors import FingerpostError
from fingerpost.robot.arm import Arm, ArrivalRule, Turn
from fingerpost.robot.errors import (
    ConnectionLostError,
    GarbledReplyError,
    GripperError,
    NotReadyError,
    OutOfReachError,
    RobotError,
    RobotFaultError,
    RobotTimeoutError,
)
from fingerpost.robot.extras import require_silently
from fingerpost.robot.options import CheckedOptions
from fingerpost.robot.orientation import (
    fixed_angles,
    from_fixed_angles,
    pose_angles,
    tool_rotation,
)
from fingerpost.robot.protocol import Angle, GripperKind, Limits, Pose

logger = logging.getLogger(__name__)

DEFAULT_TIMEOUT_S = socket.getdefaulttimeout()
"""The process's own default for sockets [s]."""

MM_PER_M = 1000.0
GRIPPER_PULSES = 850
"""The gripper's position when open; 0 is closed."""

GRIPPER_NEAR = 2
"""Greatest difference of equal positions of the gripper [pulses]: 0.2 mm."""

GRIPPER_POLL_S = 0.1
"""Pause between two readings of the gripper [s]."""

GRIPPER_START_S = 2.0
"""Time limit for the start of the gripper's motion [s], as in the library; after it, the gripper is
blocked."""

GRIPPER_STILL_S = 0.2
"""Time without motion after which a gripper that has moved stands [s]."""

OPEN_S = 10.0
"""Time limit for the control box to answer [s]; the library would try for minutes."""

STOPPED_STATE = 4
PAUSED_STATE = 3
READY_STATE = 0
POSITION_MODE = 0

SET_STATE = 12
"""The function code of `set_state` in the control box's protocol."""

STOP_TRANSACTION = 0
"""The transaction number of a stop; the library counts from 1."""

_CODES: dict[int, tuple[type[RobotError], str]] = {
    -1: (ConnectionLostError, "not connected"),
    -2: (NotReadyError, "not enabled"),
    -6: (OutOfReachError, "outside the Cartesian limits"),
    -7: (OutOfReachError, "outside a joint's limits"),
    -8: (OutOfReachError, "out of range"),
    -9: (RobotFaultError, "emergency stop"),
    1: (RobotFaultError, "an error is not cleaned"),
    3: (RobotTimeoutError, "no answer"),
    8: (ConnectionLostError, "write failed"),
    9: (NotReadyError, "state not ready to move"),
    100: (RobotTimeoutError, "not finished in time"),
}
"""The library's codes with a more specific error than a fault, from its `APIState`."""

_WARNING_CODE = 2


class XarmOptions(CheckedOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of an xArm.

    Attributes
    ----------
    reach_m : float
        Reach of the model [m].
    lower_z_m : float
        The lowest permitted height [m].
    max_speed_m_s, acceleration_m_s2 : float
        Greatest speed, and acceleration of moves.
    gripper : bool
        Whether UFACTORY's own gripper is mounted.
    gripper_opening_m : float
        Its widest opening [m].
    gripper_timeout_s : float
        Time limit of its motion [s].
    poll_s, stall_s : float
        Parameters of the end of a move [s], as in `ArrivalRule`.
    """

    reach_m: Annotated[float, msgspec.Meta(gt=0, le=10)] = 0.7
    lower_z_m: float = 0.0
    max_speed_m_s: Annotated[float, msgspec.Meta(gt=0, le=10)] = 0.2
    acceleration_m_s2: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 1.0
    gripper: bool = True
    gripper_opening_m: Annotated[float, msgspec.Meta(gt=0, le=10)] = 0.085
    gripper_timeout_s: Annotated[float, msgspec.Meta(gt=0, le=3600)] = 5.0
    poll_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 0.02
    stall_s: Annotated[float, msgspec.Meta(gt=0, le=3600)] = 1.0


class Xarm(Arm):
    """An xArm.

    Parameters
    ----------
    host : str
        Its address.
    options : XarmOptions
        Its options.
    limits : Limits, optional
        Limits of commands; by default a half ball of `reach_m`.
    clock, sleep : callable
        Monotonic time [s], and a wait for a time on that clock [s].

    Raises
    ------
    MissingExtraError
        `xarm-python-sdk` is not installed.
    """

    def __init__(
        self,
        host: str,
        options: XarmOptions | None = None,
        *,
        limits: Limits | None = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._options = options = options or XarmOptions()
        reach = options.reach_m
        super().__init__(
            limits
            or Limits(
                lower_m=(-reach, -reach, options.lower_z_m),
                upper_m=(reach, reach, reach),
                max_speed_m_s=options.max_speed_m_s,
                reach_m=reach,
                angles=frozenset(Angle),
                gripper=GripperKind.WIDTH if options.gripper else GripperKind.NONE,
                gripper_opening_m=options.gripper_opening_m if options.gripper else None,
            ),
            arrival=ArrivalRule(poll_s=options.poll_s, stall_s=options.stall_s),
            clock=clock,
            sleep=sleep,
        )
        self._host = host
        self._library = require_silently("xarm.wrapper", "xarm")
        self._api: Any = None
        self._stopped = False

    def _open(self) -> None:
        self._close()
        self._api = self._connect()
        if (stream := self._stream(self._api)) is not None:
            with suppress(OSError):  # on the control box itself the connection is not TCP
                stream.com.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with self._translated():
            self._stopped = True
            self._accept(self._api.set_state(STOPPED_STATE), "set_state")

    def _connect(self) -> Any:
        """Connect in a thread, which is abandoned after a time limit."""
        result: queue.SimpleQueue[Any] = queue.SimpleQueue()
        wanted = threading.Semaphore()  # acquired by the first: the connection, or the time limit

        def connect() -> None:
            try:
                api = self._library.XArmAPI(self._host, is_radian=True)
            except Exception as error:  # the library raises plain Exception
                result.put(error)
                return
            finally:
                # The library sets one for the whole process, from several threads at a time.
                socket.setdefaulttimeout(DEFAULT_TIMEOUT_S)
            if wanted.acquire(blocking=False):
                result.put(api)
            else:
                api.disconnect()

        threading.Thread(target=connect, name="xarm", daemon=True).start()
        try:
            made = result.get(timeout=OPEN_S)
        except queue.Empty:
            if wanted.acquire(blocking=False):
                raise RobotTimeoutError(
                    f"{self._host}: the control box does not answer within {OPEN_S:g} s"
                ) from None
            made = result.get()
        if isinstance(made, Exception):
            raise ConnectionLostError(f"{self._host}: {made}") from made
        return made

    def _close(self) -> None:
        api, self._api = self._api, None
        if api is not None:
            try:
                api.disconnect()
            except Exception as error:  # the connection is no longer used
                logger.warning("%s: closing the connection: %s", self._host, error)

    def _home(self, turn: Turn, report: Callable[[str], None]) -> None:
        """Enable the motors; the encoders are absolute, so nothing moves."""
        self._check(turn)
        with self._translated():
            api = self._connected()
            api.clean_error()
            api.clean_warn()
            # In the ready state, a paused arm would continue its move.
            self._accept(api.set_state(STOPPED_STATE), "set_state")
            self._accept(api.motion_enable(True), "motion_enable")
            self._accept(api.set_mode(POSITION_MODE), "set_mode")
            self._make_ready(api)
            if self._options.gripper:
                self._accept(api.set_gripper_enable(True), "set_gripper_enable", GripperError)
                self._accept(api.set_gripper_mode(0), "set_gripper_mode", GripperError)
        report("absolute encoders: no motion needed")

    def _start_move(self, pose: Pose, speed_m_s: float, turn: Turn) -> None:
        with self._translated():
            api = self._ready()
            x, y, z = (MM_PER_M * value for value in pose.position_m)
            if (angles := pose.angles()) is not None:
                roll, pitch, yaw = fixed_angles(tool_rotation(*angles))
            else:
                roll, pitch, yaw = self._position(api)[3:]
            codes: list[int] = []
            self._issue(
                lambda: codes.append(
                    api.set_position(
                        x=x,
                        y=y,
                        z=z,
                        roll=roll,
                        pitch=pitch,
                        yaw=yaw,
                        speed=MM_PER_M * speed_m_s,
                        mvacc=MM_PER_M * self._options.acceleration_m_s2,
                        is_radian=True,
                        wait=False,
                    )
                ),
                turn,
            )
            self._accept(codes[0], "set_position")

    def _read_pose(self, turn: Turn) -> Pose:
        self._check(turn)
        with self._translated():
            api = self._connected()
            if number := self._error(api):
                raise RobotFaultError(f"error C{number}", number=number)
            x, y, z, roll, pitch, yaw = self._position(api)
        up, about, azimuth = pose_angles(from_fixed_angles(roll, pitch, yaw))
        return Pose(
            x / MM_PER_M,
            y / MM_PER_M,
            z / MM_PER_M,
            pitch_rad=up,
            roll_rad=about,
            yaw_rad=azimuth,
        )

    def _send_stop(self) -> None:
        self._stopped = True
        with self._translated():
            api = self._connected()
            stream = self._stream(api)
            if stream is None:  # behind the library's other requests
                self._accept(api.set_state(STOPPED_STATE), "set_state")
                return
            protocol = api._arm.arm_cmd.get_protocol_identifier()
            if stream.write(_frame(STOP_TRANSACTION, protocol, SET_STATE, STOPPED_STATE)) != 0:
                raise ConnectionLostError(f"{self._host}: the stop cannot be written")

    @staticmethod
    def _stream(api: Any) -> Any:
        """Return the library's own connection, if this version has it in the known attribute."""
        return getattr(getattr(api, "_arm", None), "_stream", None)

    def _move_gripper(self, opening: float, turn: Turn) -> None:
        with self._translated():
            api = self._ready()
            goal = round(GRIPPER_PULSES * opening)
            start = self._pulses(api)
            codes: list[int] = []
            self._issue(lambda: codes.append(api.set_gripper_position(goal, wait=False)), turn)
            self._accept(codes[0], "set_gripper_position", GripperError)
            self._await_gripper(api, start, goal, turn)

    def _await_gripper(self, api: Any, start: int, goal: int, turn: Turn) -> None:
        """Wait until the gripper is at its goal, or stands after it has moved.

        With an object in its grip, it never reaches its goal, and does not move when commanded to
        close further. Only a fault prevents it from opening.
        """
        begin_s = since_s = self._clock()
        at = start
        while True:
            self._pause(GRIPPER_POLL_S, turn)
            before, at, now_s = at, self._pulses(api), self._clock()
            if abs(at - goal) <= GRIPPER_NEAR:
                return
            has_moved = abs(at - start) > GRIPPER_NEAR
            if abs(at - before) > GRIPPER_NEAR:
                since_s = now_s
            elif has_moved and now_s - since_s >= GRIPPER_STILL_S:
                return
            if not has_moved and now_s - begin_s > GRIPPER_START_S:
                if goal < start:
                    return
                raise GripperError(f"the gripper stands at {at} pulses, sent to {goal}")
            if now_s - begin_s > self._options.gripper_timeout_s:
                raise GripperError(f"the gripper still moves at {at} pulses")

    def _ready(self) -> Any:
        """Return the library's arm, made ready again after a stop."""
        api = self._connected()
        if api.state == PAUSED_STATE:  # the library would wait until it is resumed
            raise NotReadyError("paused in UFACTORY Studio: go on or stop there, then home again")
        if self._stopped:
            self._make_ready(api)
        return api

    def _make_ready(self, api: Any) -> None:
        self._stopped = False  # before, so that a stop meanwhile is not forgotten
        try:
            self._accept(api.set_state(READY_STATE), "set_state")
        except RobotError:
            self._stopped = True
            raise

    def _connected(self) -> Any:
        api = self._api
        if api is None or not api.connected:
            raise ConnectionLostError(f"{self._host}: not connected")
        return api

    def _position(self, api: Any) -> list[float]:
        code, values = api.get_position(is_radian=True)
        self._accept(code, "get_position")
        return [float(value) for value in values]

    def _error(self, api: Any) -> int:
        """Return the number of the arm's error; a report may be older than its clearing."""
        reported = int(api.error_code)
        if reported:
            try:
                code, (number, _) = api.get_err_warn_code()
            except Exception:  # without an answer, the report is used
                return reported
            if code == 0:
                return int(number)
        return reported

    def _pulses(self, api: Any) -> int:
        code, position = api.get_gripper_position()
        self._accept(code, "get_gripper_position", GripperError)
        if position is None:
            raise GripperError("the gripper's position cannot be read")
        return int(position)

    def _accept(self, code: int, call: str, kind: type[RobotError] = RobotFaultError) -> None:
        """Raise the error for a code; warnings are ignored."""
        if code in (0, _WARNING_CODE):
            return
        known, meaning = _CODES.get(code, (kind, "failed"))
        message = f"{call}: code {code}, {meaning}"
        if known is RobotFaultError:
            number = int(self._api.error_code or code) if self._api is not None else code
            raise RobotFaultError(message, number=number)
        raise known(message)

    @contextmanager
    def _translated(self) -> Iterator[None]:
        """Convert the library's exceptions on unreadable answers to a `RobotError`."""
        try:
            yield
        except FingerpostError:
            raise
        except Exception as error:
            raise GarbledReplyError(f"{self._host}: {type(error).__name__}: {error}") from error


def _frame(transaction: int, protocol: int, function: int, value: int) -> bytes:
    """Return the control box's frame that sets one byte."""
    return struct.pack(">HHHBB", transaction, protocol, 2, function, value)
