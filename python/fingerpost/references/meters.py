"""Measurement of references in a frame: search range, and conditions for a valid result."""

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
"""Search range about the previous sides, for a static and for a moving camera."""

CLOSE_PX = 0.5
"""Greatest displacement of the corners at which the first fit is final."""

LEAST_SUPPORT = 0.35
LEAST_SIDE = 0.15
"""Least share of the outline within the picture, and of its least visible side, that has edges."""

MOST_GROWTH = 2.5
"""Greatest ratio of the areas before and after a motion of the camera."""

FADED = 0.25
"""Least ratio of a side's step to its initial step; below, the side is covered."""


class Meter(Protocol):
    """Measures four points of the plane in a picture."""

    def measure(self, picture: Picture, near_px: Array) -> Measured | None:
        """Measure them near their previous positions; None if too little of them is visible."""

    def search(self, picture: Picture, near_px: Array) -> Measured | None:
        """Search the whole picture for them."""


class RectangleMeter:
    """Measures the corners of a rectangle by its sides.

    Parameters
    ----------
    size
        Lengths of the side from the first to the second corner and of the next one, in any unit.
    lens
        The view's distortion, if known.
    """

    def __init__(self, size: tuple[float, float], lens: Lens | None = None) -> None:
        self._size = size
        self._lens = lens
        self._channel: int | None = None
        self._steps: Array | None = None
        self._is_swift = False

    def measure(self, picture: Picture, near_px: Array) -> Measured | None:
        """Measure the corners near their previous positions; None if too little is visible."""
        if self._steps is None:
            self._channel = channel_of(picture, near_px)
        levels = tone(picture, self._channel)
        # A camera that has just moved far probably moves far again.
        for reach_px in (FAR_PX,) if self._is_swift else (NEAR_PX, FAR_PX):
            rough = fit_sides(levels, near_px, self._lens, reach_px=reach_px, steps=self._steps)
            if rough is None:
                continue
            sides: Sides | None = rough
            # If the steps are known and the displacement is small, the first fit is final.
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
        """Search the whole picture for it; its corners are ordered by the previous positions."""
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
