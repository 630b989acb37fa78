"""A Scorbot on an emulated controller in accelerated time."""

import contextlib
import functools
import math
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from unittest import mock

import numpy as np

from fingerpost.robot import arm, scorbot
from fingerpost.robot.acl import ABORT
from fingerpost.robot.emulator.acl import AclController, AclStyle
from fingerpost.robot.emulator.ports import ArmTime, Emulator, Port, PtyPort
from fingerpost.robot.protocol import TOOL_DOWN_RAD, Pose
from fingerpost.robot.scorbot import UNIT_DEG, UNIT_M, Scorbot, ScorbotOptions

TIME_SCALE = 50.0
"""Seconds of arm time per second of real time."""

STALL_S = 0.05
"""Upper limit of the real time that one pause of the test process counts for."""

REPLY_S = 0.2
"""Time-out of one answer in real time; short, so that tests of silent lines stay fast."""


PATIENCE_S = 1.0
"""Margin that a driver adds to the duration of a motion, in real time. The default of five seconds
of arm time is shorter than a thread may have to wait on a loaded machine."""

PATIENT_S = PATIENCE_S * TIME_SCALE
"""The same in arm time."""


def patience() -> contextlib.AbstractContextManager[object]:
    """Set the drivers' time margins, some seconds of a real arm, to `PATIENCE_S`."""
    return mock.patch.multiple(arm, MOVE_MARGIN_S=PATIENT_S, READING_TIMEOUT_S=PATIENT_S)


def fast_options(**options: object) -> ScorbotOptions:
    """Return options with time-outs for an emulator that answers in a millisecond of real time."""
    return ScorbotOptions(
        **{
            "reply_s": REPLY_S * TIME_SCALE,
            "quiet_s": 0.01 * TIME_SCALE,
            "resync_s": 0.6 * TIME_SCALE,
            "poll_s": 0.0,
            "stall_s": 0.05 * TIME_SCALE,
            "gripper_s": 0.5,
            **options,
        }
    )


class RunningTime(ArmTime):
    """An arm's clock that stands still while the test process does not run.

    A loaded machine may suspend a test for half a second, which in arm time exceeds most time-outs.
    Between two readings of this clock at most `STALL_S` of real time pass.
    """

    def __init__(self, scale: float) -> None:
        super().__init__(scale)
        self._lock = threading.Lock()
        self._looked_s = self._ran_s = time.monotonic()

    def __call__(self) -> float:
        """Return the arm's time [s]."""
        with self._lock:
            now_s = time.monotonic()
            self._ran_s += min(now_s - self._looked_s, STALL_S)
            self._looked_s = now_s
            return self._ran_s * self.scale


STOP_S = 0.020
"""Limit from the call of a stop to its arrival at the controller's port."""


class CrowdedError(AssertionError):
    """A failure that a loaded machine may have caused."""


def assert_in_time(called_s: float, arrived_s: float) -> None:
    """Assert that a stop arrived in time."""
    if arrived_s - called_s > STOP_S:
        raise CrowdedError(f"the stop took {1000 * (arrived_s - called_s):.1f} ms")


def best_of_three(test):
    """Let a test fail with `CrowdedError` only if it does so three times.

    On a loaded machine, any thread may now and then wait longer than 20 ms. A stop that waits for a
    lock or a queue is late every time.
    """

    @functools.wraps(test)
    def repeated(*arguments, **fields):
        for _ in range(2):
            with contextlib.suppress(CrowdedError):
                return test(*arguments, **fields)
        return test(*arguments, **fields)

    return repeated


@dataclass
class Tape:
    """The transfers over the line; consecutive ones in the same direction are joined."""

    transfers: list[tuple[str, bytes]] = field(default_factory=list)

    def __call__(self, way: str, data: bytes) -> None:
        if self.transfers and self.transfers[-1][0] == way:
            data = self.transfers.pop()[1] + data
        self.transfers.append((way, data))


@dataclass
class Rig:
    """A controller, its port, and the driver on the other end."""

    controller: AclController
    port: Port
    emulator: Emulator
    robot: Scorbot
    tape: Tape
    clock: ArmTime

    @property
    def plugged(self) -> bool:
        """Whether the cable is plugged in."""
        return bool(self.port.descriptors())

    @property
    def stops(self) -> int:
        """Stops that the controller has received."""
        return self.controller.aborts

    @property
    def stop_bytes(self) -> bytes:
        """The bytes that identify a stop on the line."""
        return ABORT[:1]

    def random_goal(self, rng: np.random.Generator) -> Pose:
        """Draw a reachable pose."""
        return random_goal(rng)

    def true_pose(self) -> Pose:
        """Return the true pose of the emulated arm."""
        return pose_of(self.controller.units(self.clock()))

    def is_moving(self) -> bool:
        """Return whether the emulated arm moves."""
        return self.controller.is_moving(self.clock())


@contextlib.contextmanager
def scorbot_rig(
    style: AclStyle | None = None,
    *,
    options: ScorbotOptions | None = None,
    port: Port | None = None,
    time_scale: float = TIME_SCALE,
    slow_s: float = 0.05 * TIME_SCALE,
    seed: int = 0,
    connect: bool = True,
    home: bool = True,
) -> Iterator[Rig]:
    """Plug a controller in, connect a driver and home the arm."""
    clock = RunningTime(time_scale)
    controller = AclController(style or AclStyle(homing_s=1.0))
    tape = Tape()
    port = port or PtyPort()
    emulator = Emulator(
        controller,
        port,
        clock=clock,
        rng=np.random.default_rng(seed),
        slow_s=slow_s,
    )
    with emulator:
        robot = Scorbot(
            emulator.address, options or fast_options(), tap=tape, clock=clock, sleep=clock.sleep
        )
        try:
            if connect:
                with mock.patch.object(scorbot, "CONNECT_TIMEOUT_S", PATIENT_S):
                    robot.connect()
                if home:
                    robot.home()
            yield Rig(controller, port, emulator, robot, tape, clock)
        finally:
            robot.close()


def pose_of(units: np.ndarray) -> Pose:
    """Convert a controller's X, Y, Z [0.1 mm], P, R [0.1°] to a pose."""
    return Pose(
        *(float(value) * UNIT_M for value in units[:3]),
        pitch_rad=math.radians(float(units[3]) * UNIT_DEG),
        roll_rad=math.radians(float(units[4]) * UNIT_DEG),
    )


def over_table(x_m: float, y_m: float, z_m: float = 0.1) -> Pose:
    """Return a pose with the gripper pointing down."""
    return Pose(x_m, y_m, z_m, pitch_rad=TOOL_DOWN_RAD, roll_rad=0.0)


def random_goal(rng: np.random.Generator) -> Pose:
    """Draw a reachable pose above a table in front of the arm."""
    return over_table(
        float(rng.uniform(0.36, 0.5)),
        float(rng.uniform(-0.25, 0.25)),
        float(rng.uniform(0.05, 0.2)),
    )


class ManualClock:
    """A simulated clock that only `sleep` advances, with scheduled actions."""

    def __init__(self):
        self.now_s = 1000.0
        self._due = []

    def __call__(self):
        return self.now_s

    def at(self, time_s, act):
        """Schedule an action."""
        self._due.append((time_s, act))

    def sleep(self, span_s):
        """Advance the clock, running due actions in order."""
        end_s = self.now_s + span_s
        while self._due and min(time_s for time_s, _ in self._due) <= end_s:
            due = min(self._due, key=lambda one: one[0])
            self._due.remove(due)
            self.now_s = max(self.now_s, due[0])
            due[1]()
        self.now_s = max(self.now_s, end_s)
