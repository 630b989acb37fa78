"""A ROS arm behind an emulated rosbridge server."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fingerpost.robot.emulator.ports import ArmTime, Emulator, HostPort
from fingerpost.robot.emulator.rosbridge import RosbridgeServer
from fingerpost.robot.rosbridge import RosbridgeArm, RosbridgeOptions

GRIPPER = {"open_service": "/fingerpost/open", "close_service": "/fingerpost/close"}


@dataclass
class Rig:
    """The server, its port, and the driver on the other end."""

    server: RosbridgeServer
    emulator: Emulator
    robot: RosbridgeArm
    clock: ArmTime

    def true_m(self) -> np.ndarray:
        """Return the true position of the tool [m]."""
        return self.server.position_m(self.clock())

    def is_moving(self) -> bool:
        """Return whether the emulated arm moves."""
        return self.server.is_moving(self.clock())


@contextlib.contextmanager
def rosbridge_rig(
    *, home: bool = True, time_scale: float = 4.0, **options: object
) -> Iterator[Rig]:
    """Serve an arm, connect a driver and make it ready."""
    server, clock = RosbridgeServer(), ArmTime(time_scale)
    options = RosbridgeOptions(
        **{
            "start_service": "/fingerpost/start",
            **GRIPPER,
            "max_age_s": 0.4 * time_scale,
            "service_s": 0.5 * time_scale,
            "rate_hz": 25.0,
            "max_speed_m_s": 0.3,
            **options,
        }
    )
    rng = np.random.default_rng(0)
    with Emulator(server, HostPort(), clock=clock, rng=rng) as emulator:
        host, _, port = emulator.address.partition(":")
        robot = RosbridgeArm(host, int(port), options, clock=clock, sleep=clock.sleep)
        try:
            if home:
                robot.connect()
                robot.home()
            yield Rig(server, emulator, robot, clock)
        finally:
            robot.close()
