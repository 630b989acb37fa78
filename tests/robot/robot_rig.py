"""A Scorbot on an emulated controller whose time runs fast, for the tests of the robot edge."""

import contextlib
import functools
import math
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from unittest import mock

import numpy as np

from fingerpost.robot import arm
from fingerpost.robot.acl import ABORT
from fingerpost.robot.emulator.acl import AclController, AclStyle
from fingerpost.robot.emulator.ports import ArmTime, Emulator, Port, PtyPort
from fingerpost.robot.protocol import TOOL_DOWN_RAD, Pose
from fingerpost.robot.scorbot import UNIT_DEG, UNIT_M, Scorbot, ScorbotOptions

TIME_SCALE = 50.0
"""Seconds of the arm per second of ours."""

STALL_S = 0.05
"""What one pause of ours counts for at most, in our time."""

REPLY_S = 0.2
"""Time-out of one answer, in our time: short, so that silence costs tests little."""


PATIENCE_S = 1.0
"""What a driver adds to the time of a motion, in our time: five seconds of an arm whose time runs
this fast would be less than a crowded machine may leave a thread waiting."""


def patience() -> contextlib.AbstractContextManager[object]:
    """Give a driver `PATIENCE_S` where it gives an arm at its own pace some seconds."""
    span_s = PATIENCE_S * TIME_SCALE
    return mock.patch.multiple(arm, MOVE_MARGIN_S=span_s, READING_TIMEOUT_S=span_s)


def fast_options(**options: object) -> ScorbotOptions:
    """Options whose time-outs, in our time, suit an emulator that answers in a millisecond."""
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
    """An arm's clock that stands while nobody runs.

    A crowded machine may hold a test up for half a second, which at the arm's pace is longer than
    most of its time-outs; between two looks at this clock no more than `STALL_S` pass.
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
"""A stop reaches the controller's port within this."""


class CrowdedError(AssertionError):
    """What has failed may be due to a crowded machine."""


def assert_in_time(called_s: float, arrived_s: float) -> None:
    """Assert that a stop arrived in time."""
    if arrived_s - called_s > STOP_S:
        raise CrowdedError(f"the stop took {1000 * (arrived_s - called_s):.1f} ms")


def best_of_three(test):
    """Let a test fail with `CrowdedError` only if it does so three times.

    A crowded machine may leave any thread waiting for longer than 20 ms now and then; a stop that
    stands behind a lock or a queue is late every time.
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
    """What went over the line, neighbours in the same direction joined."""

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
        """Whether the cable is in."""
        return bool(self.port.descriptors())

    @property
    def stops(self) -> int:
        """Stops that the controller has seen."""
        return self.controller.aborts

    @property
    def stop_bytes(self) -> bytes:
        """What a stop is known by on the line."""
        return ABORT[:1]

    def random_goal(self, rng: np.random.Generator) -> Pose:
        """A pose in reach."""
        return random_goal(rng)

    def true_pose(self) -> Pose:
        """Where the arm really is."""
        return pose_of(self.controller.units(self.clock()))

    def is_moving(self) -> bool:
        """Whether the arm really moves."""
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
                robot.connect()
                if home:
                    robot.home()
            yield Rig(controller, port, emulator, robot, tape, clock)
        finally:
            robot.close()


def pose_of(units: np.ndarray) -> Pose:
    """A controller's X, Y, Z [0.1 mm], P, R [0.1°] as a pose."""
    return Pose(
        *(float(value) * UNIT_M for value in units[:3]),
        pitch_rad=math.radians(float(units[3]) * UNIT_DEG),
        roll_rad=math.radians(float(units[4]) * UNIT_DEG),
    )


def over_table(x_m: float, y_m: float, z_m: float = 0.1) -> Pose:
    """A pose with the gripper pointing down."""
    return Pose(x_m, y_m, z_m, pitch_rad=TOOL_DOWN_RAD, roll_rad=0.0)


def random_goal(rng: np.random.Generator) -> Pose:
    """A pose that the arm can reach, over a table in front of it."""
    return over_table(
        float(rng.uniform(0.36, 0.5)),
        float(rng.uniform(-0.25, 0.25)),
        float(rng.uniform(0.05, 0.2)),
    )


class ManualClock:
    """A clock that only waiting moves, and that does things when their time comes."""

    def __init__(self):
        self.now_s = 1000.0
        self._due = []

    def __call__(self):
        return self.now_s

    def at(self, time_s, act):
        """Do something when this time is reached."""
        self._due.append((time_s, act))

    def sleep(self, span_s):
        """Move on, doing on the way what is due."""
        end_s = self.now_s + span_s
        while self._due and min(time_s for time_s, _ in self._due) <= end_s:
            due = min(self._due, key=lambda one: one[0])
            self._due.remove(due)
            self.now_s = max(self.now_s, due[0])
            due[1]()
        self.now_s = max(self.now_s, end_s)
