"""Time in a simulated world: nothing waits, whoever would wait lets it pass.

Bodies move, the cameras take their pictures on the beat, and what goes on between two pictures has
its own time to the byte. A world of one thread gives the same session for the same seed.
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
    """A place where a hand points and a robot moves: under physics, or by kinematics alone."""

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """What looks on."""

    @property
    def gripper_mm(self) -> Array:
        """(3,) where the gripper's working point really is [mm]."""

    @property
    def jaw(self) -> float:
        """How far the gripper is open: 0 closed … 1 open."""

    @property
    def block_mm(self) -> Array:
        """(3,) centre of the wooden block [mm]."""

    @property
    def block_turn_rad(self) -> float:
        """How the block is turned about the vertical [rad]."""

    def put_block(self, point_mm: tuple[float, float], turn_rad: float) -> None:
        """Lay the block on the table, its middle over a point [mm], turned about the vertical."""

    def put_hand(self, pose: DevicePose | None) -> None:
        """Move the hand; None takes it away."""

    def step_to(self, time_s: float) -> None:
        """Let everything move until a time [s]."""

    def picture(self) -> tuple[Image, ...]:
        """Take a picture with every camera: (height, width, 3) blue-green-red."""


class World:
    """The time of a cell.

    Parameters
    ----------
    cell : Cell
        What moves in it.
    frames_per_s : float
        Beat of the cameras [1/s], > 0.

    Attributes
    ----------
    on_frame : callable or None
        Called on every beat with the time [s]; None while nobody looks.
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
        """Return `time_s`, for whoever wants a clock."""
        return self._time_s

    def advance(self, span_s: float) -> None:
        """Let a span of time pass [s], ≥ 0.

        What is called on a beat may let time pass itself; then this span is over when the later
        one is.
        """
        end_s = self._time_s + span_s
        while self._beat * self.frame_s <= end_s:
            self._move_to(self._beat * self.frame_s)
            self._beat += 1
            if self.on_frame is not None:
                self.on_frame(self._time_s)
        self._move_to(end_s)

    def to_next_frame(self) -> None:
        """Let time pass until the cameras have taken their next picture."""
        self.advance(self._beat * self.frame_s - self._time_s)

    def _move_to(self, time_s: float) -> None:
        if time_s > self._time_s:
            self.cell.step_to(time_s)
            self._time_s = time_s
