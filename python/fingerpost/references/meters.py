"""What measures references anew in a frame: where it looks, and when it believes what it sees."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fingerpost.lens import Lens
from fingerpost.references.following import Measured
from fingerpost.references.polygons import signed_area
from fingerpost.references.rectangles import channel_of, find_rectangles, tone, turned
from fingerpost.references.sides import Sides, fit_sides

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

NEAR_PX = 3.0
FAR_PX = 12.0
"""How far sides are looked for from where they were: of a still camera, and of one that moves."""

CLOSE_PX = 0.5
"""Corners that are found no further from where they were need not be looked for once more."""

LEAST_SUPPORT = 0.35
LEAST_SIDE = 0.15
"""The part of the outline in the picture, and of its least visible side, that must show."""

MOST_GROWTH = 2.5
"""How many times as large, or small, a camera that was knocked may show it."""

FADED = 0.25
"""A side whose step is less than this part of what it was is covered."""


class Meter(Protocol):
    """Measures four points of the plane in a picture."""

    def measure(self, picture: Picture, near_px: Array) -> Measured | None:
        """Measure them near to where they were; None where too little of them shows."""

    def search(self, picture: Picture, near_px: Array) -> Measured | None:
        """Look for them in all of the picture."""


class RectangleMeter:
    """Measures the corners of a rectangle by its sides.

    Parameters
    ----------
    size
        The side from its first to its second corner, and the next one, in any unit.
    lens
        The view's distortion, if it is known.
    """

    def __init__(self, size: tuple[float, float], lens: Lens | None = None) -> None:
        self._size = size
        self._lens = lens
        self._channel: int | None = None
        self._steps: Array | None = None
        self._is_swift = False

    def measure(self, picture: Picture, near_px: Array) -> Measured | None:
        """Measure the corners near to where they were; None where too little of it shows."""
        if self._steps is None:
            self._channel = channel_of(picture, near_px)
        levels = tone(picture, self._channel)
        # Of a camera that has just moved far, the next picture shows them far off again.
        for reach_px in (FAR_PX,) if self._is_swift else (NEAR_PX, FAR_PX):
            rough = fit_sides(levels, near_px, self._lens, reach_px=reach_px, steps=self._steps)
            if rough is None:
                continue
            sides: Sides | None = rough
            # From nearby, with the steps known, the first fit is as good as any.
            if self._steps is None or np.abs(rough.corners_px - near_px).max() > CLOSE_PX:
                sides = fit_sides(
                    levels, rough.corners_px, self._lens, reach_px=NEAR_PX, steps=rough.steps
                )
            if sides is not None and self._is_believed(sides):
                self._is_swift = bool(np.abs(sides.corners_px - near_px).max() > NEAR_PX)
                if self._steps is None:
                    self._steps = sides.steps
                return Measured(sides.corners_px, sides.covariance)
        self._is_swift = False
        return None

    def search(self, picture: Picture, near_px: Array) -> Measured | None:
        """Look for it in all of the picture; its corners are taken for the nearest ones."""
        area = float(signed_area(near_px))
        for candidate in find_rectangles(picture, self._size, self._lens):
            best = min(
                turned(candidate.sides, clockwise=area > 0.0),
                key=lambda sides: float(np.linalg.norm(sides.corners_px - near_px, axis=1).sum()),
            )
            if abs(math.log(float(signed_area(best.corners_px)) / area)) < math.log(MOST_GROWTH):
                return Measured(best.corners_px, best.covariance)
        return None

    def _is_believed(self, sides: Sides) -> bool:
        if sides.support < LEAST_SUPPORT or sides.shares.min() < LEAST_SIDE:
            return False
        if self._steps is None:
            return True
        return bool((np.abs(sides.steps) >= FADED * np.abs(self._steps)).all())
