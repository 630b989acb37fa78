"""Time in a simulated world: instead of waiting, a caller advances it.

Bodies move, the cameras take pictures at their frame rate, and transfers between two pictures are
timed by byte. With one thread, the same seed gives the same session.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fingerpost.simulate import Camera, DevicePose

Array = NDArray[np.float64]
Image = NDArray[np.uint8]


class Cell(Protocol):
    """A cell with a pointing hand and a robot: with physics, or with kinematics alone."""

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras."""

    @property
    def gripper_mm(self) -> Array:
        """(3,) True position of the gripper's working point [mm]."""

    @property
    def jaw(self) -> float:
        """Opening of the gripper: 0 closed … 1 open."""

    @property
    def block_mm(self) -> Array:
        """(3,) centre of the wooden block [mm]."""

    @property
    def block_turn_rad(self) -> float:
        """Rotation of the block about the vertical [rad]."""

    def put_block(self, point_mm: tuple[float, float], turn_rad: float) -> None:
        """Place the block on the table, centred on a point [mm], rotated about the vertical."""

    def put_hand(self, pose: DevicePose | None) -> None:
        """Move the hand; None removes it."""

    def step_to(self, time_s: float) -> None:
        """Move all bodies up to a time [s]."""

    def picture(self) -> tuple[Image, ...]:
        """Take a picture with every camera: (height, width, 3) blue-green-red."""


class World:
    """The time of a cell.

    Parameters
    ----------
    cell : Cell
        The cell.
    frames_per_s : float
        Frame rate of the cameras [1/s], > 0.

    Attributes
    ----------
    on_frame : callable or None
        Called at every frame with the time [s]; None for no call.
    """

    def __init__(self, cell: Cell, frames_per_s: float) -> None:
        self.cell = cell
        self.frame_s = 1.0 / frames_per_s
        self.on_frame: Callable[[float], None] | None = None
        self._time_s = 0.0
        self._beat = 1

    @property
    def time_s(self) -> float:
        """Time since the world began [s]."""
        return self._time_s

    def now(self) -> float:
        """Return `time_s`, for use as a clock."""
        return self._time_s

    def advance(self, span_s: float) -> None:
        """Advance the time [s], ≥ 0.

        A callback at a frame may advance the time itself; this span then ends with the later one.
        """
        end_s = self._time_s + span_s
        while self._beat * self.frame_s <= end_s:
            self._move_to(self._beat * self.frame_s)
            self._beat += 1
            if self.on_frame is not None:
                self.on_frame(self._time_s)
        self._move_to(end_s)

    def to_next_frame(self) -> None:
        """Advance the time until the cameras have taken their next picture."""
        self.advance(self._beat * self.frame_s - self._time_s)

    def _move_to(self, time_s: float) -> None:
        if time_s > self._time_s:
            self.cell.step_to(time_s)
            self._time_s = time_s
