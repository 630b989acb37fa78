"""The robot cell without physics: a simulated robot, the simulated rig's hand, and a block.

For systems without MuJoCo. The hand is rendered and tracked as usual; arm and block are not
rendered and have no mass, and a gripper that closes around the block holds it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fingerpost.robot import SimulatedRobot
from fingerpost.simulate import (
    Background,
    Camera,
    DevicePose,
    Hand,
    Lighting,
    Sensor,
    SimulatedRig,
)

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

BLOCK_MM = 30.0
CLOSED = 0.5
"""Opening below which the gripper holds the block."""


class KinematicCell:
    """The cell.

    Parameters
    ----------
    cameras
        The cameras.
    hand
        The pointing hand.
    robot
        The simulated robot, with the world's clock.
    rng
        Random numbers of the cameras' noise.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        hand: Hand,
        robot: SimulatedRobot,
        *,
        rng: np.random.Generator,
    ) -> None:
        self._rig = SimulatedRig(
            cameras,
            device=hand,
            background=Background(texture="wood"),
            lighting=Lighting(side_light=0.2, limb_darkening=0.2, shadow=0.4),
            sensor=Sensor(channels="bgr", cells_per_sigma=1),
        )
        self._robot = robot
        self._rng = rng
        self._pose: DevicePose | None = None
        self._block_mm = np.array([0.0, 0.0, BLOCK_MM / 2])
        self._turn_rad = 0.0
        self._from_gripper_mm: Array | None = None

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras."""
        return self._rig.cameras

    @property
    def gripper_mm(self) -> Array:
        """(3,) Position of the gripper [mm]."""
        return 1000 * self._robot.position[:3]

    @property
    def jaw(self) -> float:
        """Opening of the gripper: 0 closed … 1 open."""
        return self._robot.opening

    @property
    def block_mm(self) -> Array:
        """(3,) centre of the block [mm]."""
        return self._block_mm

    @property
    def block_turn_rad(self) -> float:
        """Rotation of the block about the vertical [rad]."""
        return self._turn_rad

    def put_block(self, point_mm: tuple[float, float], turn_rad: float) -> None:
        """Place the block on the table, centred on a point [mm], rotated about the vertical."""
        self._turn_rad = turn_rad
        self._block_mm = np.array([*point_mm, BLOCK_MM / 2])

    def put_hand(self, pose: DevicePose | None) -> None:
        """Move the hand; None removes it."""
        self._pose = pose

    def step_to(self, time_s: float) -> None:  # noqa: ARG002 - the robot has its own clock
        """Move the block with the gripper, or release it."""
        gripper = self.gripper_mm
        if self.jaw >= CLOSED:
            if self._from_gripper_mm is not None:
                self._block_mm = np.array([*self._block_mm[:2], BLOCK_MM / 2])
                self._from_gripper_mm = None
            return
        away = self._block_mm - gripper
        if self._from_gripper_mm is None and math.hypot(*away) < BLOCK_MM:
            self._from_gripper_mm = away
        if self._from_gripper_mm is not None:
            self._block_mm = gripper + self._from_gripper_mm

    def picture(self) -> tuple[Image, ...]:
        """Take a picture with every camera: (height, width, 3) blue-green-red."""
        return self._rig.render(self._pose, rng=self._rng).images
