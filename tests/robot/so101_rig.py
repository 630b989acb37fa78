"""An SO-101 on emulated servos; the joints of its URDF give the true gripper position."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from robot_rig import Tape
from scipy.spatial.transform import Rotation

from fingerpost.robot.emulator.feetech import CALIBRATION, NAMES, FeetechBus, calibration_file
from fingerpost.robot.emulator.ports import ArmTime, Emulator, Port, PtyPort
from fingerpost.robot.so101 import SO101, SoArm, SoArmOptions

URDF_JOINTS = (
    ((0.0, 0.0, 0.0624), (3.14159, 0.0, -3.14159)),
    ((-0.0303992, -0.0182778, -0.0542), (-1.5708, -1.5708, 0.0)),
    ((-0.11257, -0.028, 0.0), (0.0, 0.0, 1.5708)),
    ((-0.1349, 0.0052, 0.0), (0.0, 0.0, -1.5708)),
    ((0.0, -0.0611, 0.0181), (1.5708, 0.0, 3.14159)),
)
"""Joint origins, xyz [m] and rpy [rad], of `so101_new_calib.urdf` in TheRobotStudio/SO-ARM100. Each
joint rotates about its own z; the origin of the first lies on its axis."""

URDF_TIP = (0.0, 0.0, -0.0981274)
"""Gripper tip on the axis of the last joint [m]."""

URDF_APPROACH, URDF_SIDE = (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)
"""In the last link: the gripper's direction, and the side that points left at zero roll."""


def urdf_tip(angles_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the tip [m] and the last link's rotation by the URDF, at joint angles (5,) [rad]."""
    place, turn = np.zeros(3), Rotation.identity()
    for (xyz, rpy), angle in zip(URDF_JOINTS, angles_rad, strict=True):
        place = place + turn.apply(xyz)
        turn = turn * Rotation.from_euler("xyz", rpy) * Rotation.from_euler("z", angle)
    return place + turn.apply(URDF_TIP), turn.as_matrix()


def urdf_angles(positions: dict[int, float]) -> np.ndarray:
    """Convert servo positions [counts] to the URDF's joint angles [rad], as LeRobot does."""
    middles = [(CALIBRATION[n]["range_min"] + CALIBRATION[n]["range_max"]) / 2 for n in NAMES[:5]]
    return (np.array([positions[k + 1] for k in range(5)]) - middles) * 2 * math.pi / 4096


@dataclass
class Rig:
    """The servos, their port, and the driver on the other end."""

    bus: FeetechBus
    port: Port
    emulator: Emulator
    robot: SoArm
    tape: Tape
    clock: ArmTime

    def true_m(self) -> np.ndarray:
        """Return the true position of the gripper's tip by the URDF [m]."""
        return urdf_tip(urdf_angles(self.bus.positions(self.clock())))[0]

    def is_moving(self) -> bool:
        """Return whether the emulated arm moves."""
        return self.bus.is_moving(self.clock())


@contextlib.contextmanager
def so101_rig(
    folder: Path, *, home: bool = True, time_scale: float = 4.0, **options: object
) -> Iterator[Rig]:
    """Plug the servos in, connect a driver and switch the torque on."""
    path = folder / "arm.json"
    path.write_bytes(calibration_file())
    bus, port, tape, clock = FeetechBus(), PtyPort(), Tape(), ArmTime(time_scale)
    options = SoArmOptions(
        **{"calibration": str(path), "reply_s": 0.1 * time_scale, "rate_hz": 25.0, **options}
    )
    with Emulator(bus, port, clock=clock, rng=np.random.default_rng(0)) as emulator:
        robot = SoArm(emulator.address, SO101, options, tap=tape, clock=clock, sleep=clock.sleep)
        try:
            if home:
                robot.connect()
                robot.home()
            yield Rig(bus, port, emulator, robot, tape, clock)
        finally:
            robot.close()


def wait_until(true) -> None:
    """Wait for a condition that a loaded machine may delay."""
    end_s = time.monotonic() + 5.0
    while not true():
        assert time.monotonic() < end_s
        time.sleep(0.001)
