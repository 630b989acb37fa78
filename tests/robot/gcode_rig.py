"""G-code arms on emulated controllers in accelerated time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from robot_rig import TIME_SCALE, RunningTime, Tape

from fingerpost.robot.arm import ArrivalRule
from fingerpost.robot.emulator.gcode import (
    GcodeController,
    MarlinController,
    UarmController,
    make_dexarm,
)
from fingerpost.robot.emulator.ports import ArmTime, Emulator, Port, PtyPort
from fingerpost.robot.gcode import GcodeArm, GcodeOptions
from fingerpost.robot.gcode_dialects import DEXARM, MARLIN, UARM, Dialect
from fingerpost.robot.protocol import Pose

REPLY_S, BRIEF_REPLY_S = 1.0, 0.3
"""Time-outs of one answer in real time: longer than a busy machine holds up the emulator, and one
for tests that wait for several."""

BOX = {"lower_m": (-0.3, -0.3, -0.1), "upper_m": (0.32, 0.32, 0.2), "max_speed_m_s": 0.2}
GOAL, FAR = Pose(0.22, 0.1, 0.05), Pose(0.05, 0.24, 0.05)
"""In reach of all arms."""

ARMS: dict[str, tuple[Dialect, Callable[[], GcodeController]]] = {
    "marlin": (MARLIN, lambda: MarlinController(homing_s=1.0)),
    "dexarm": (DEXARM, lambda: make_dexarm(1.0)),
    "uarm": (UARM, UarmController),
}


@dataclass
class Rig:
    """A controller, its port, and the driver on the other end."""

    controller: GcodeController
    port: Port
    emulator: Emulator
    robot: GcodeArm
    tape: Tape
    clock: ArmTime

    @property
    def plugged(self) -> bool:
        """Whether the cable is plugged in."""
        return bool(self.port.descriptors())

    @property
    def stops(self) -> int:
        """Stops that the controller has acted on."""
        return self.controller.stops

    @property
    def stop_bytes(self) -> bytes:
        """The bytes that identify a stop on the line."""
        return b"\x18" if isinstance(self.controller, UarmController) else b"M410"

    def random_goal(self, rng: np.random.Generator) -> Pose:
        """Draw a pose in reach of all arms."""
        return Pose(rng.uniform(0.05, 0.2), rng.uniform(0.2, 0.25), rng.uniform(0.01, 0.08))

    def true_pose(self) -> Pose:
        """Return the true pose of the emulated arm."""
        return Pose(*(float(value) for value in self.true_m()))

    def true_m(self) -> np.ndarray:
        """Return the true position of the emulated arm [m]."""
        return self.controller.position_mm(self.clock()) / 1000

    def assert_at(self, goal: Pose) -> None:
        """Assert arrival within the tolerance of a standstill, and then a standstill there."""
        assert np.linalg.norm(self.true_m() - goal.position_m) <= ArrivalRule().still_m
        wait_until(lambda: not self.is_moving())
        np.testing.assert_allclose(self.true_m(), goal.position_m, atol=1e-5)

    def is_moving(self) -> bool:
        """Return whether the emulated arm moves."""
        return self.controller.is_moving(self.clock())

    def sent(self) -> list[str]:
        """Return the text of every transfer that the driver has sent."""
        return [data.decode("latin-1") for way, data in self.tape.transfers if way == "out"]


@contextmanager
def gcode_rig(
    name: str,
    controller: GcodeController | None = None,
    *,
    connect: bool = True,
    home: bool = True,
    seed: int = 0,
    slow_s: float = 0.05 * TIME_SCALE,
    **options: object,
) -> Iterator[Rig]:
    """Plug a controller in, connect a driver and home the arm."""
    dialect, make = ARMS[name]
    clock, tape, controller = RunningTime(TIME_SCALE), Tape(), controller or make()
    options = GcodeOptions(
        **{
            "reply_s": REPLY_S * TIME_SCALE,
            "accept_s": 0.02 * TIME_SCALE,
            "poll_s": 0.0,
            "stall_s": 0.05 * TIME_SCALE,
            "gripper_s": 0.5,
            **BOX,
            **options,
        }
    )
    port, rng = PtyPort(), np.random.default_rng(seed)
    with Emulator(controller, port, clock=clock, rng=rng, slow_s=slow_s) as emulator:
        robot = GcodeArm(
            emulator.address, dialect, options, tap=tape, clock=clock, sleep=clock.sleep
        )
        try:
            if connect:
                robot.connect()
                if home:
                    robot.home()
            yield Rig(controller, port, emulator, robot, tape, clock)
        finally:
            robot.close()


def wait_until(true: Callable[[], bool]) -> None:
    """Wait for a condition that a loaded machine may delay."""
    end_s = time.monotonic() + 5.0
    while not true():
        assert time.monotonic() < end_s
        time.sleep(0.001)
