"""Common rectangles by name, and the units of planes."""

from __future__ import annotations

import math

from fingerpost.errors import InvalidInputError

SIZES_MM = {
    "a4": (210.0, 297.0),
    "a3": (297.0, 420.0),
    "letter": (215.9, 279.4),
    "credit-card": (85.6, 53.98),
}
"""Width and height of upright sheets and of cards (ISO 216, ANSI Y14.1, ISO 7810) [mm]."""

UNITS_MM = {"µm": 1e-3, "mm": 1.0, "cm": 10.0, "dm": 100.0, "m": 1000.0, "in": 25.4, "inch": 25.4}
"""Plane units of known length, by name [mm]."""

NAMES = '"A4", "letter", "A3", "credit-card" or [w, h] in the plane\'s unit'

Size = str | tuple[float, float]
Corners = tuple[tuple[float, float], ...]


def sides_of(size: Size, unit: str) -> tuple[float, float]:
    """Return the two sides of a rectangle.

    Parameters
    ----------
    size
        A name in `SIZES_MM`, in upper or lower case; or the sides themselves, in the unit.
    unit
        Name of the plane's unit; a name of a size needs one of `UNITS_MM`.

    Raises
    ------
    InvalidInputError
        No such name, a unit without a known length, or sides that are not finite and > 0.
    """
    if not isinstance(size, str):
        if not all(math.isfinite(side) and side > 0.0 for side in size):
            raise InvalidInputError(f"size is {list(size)}; two lengths > 0 are right")
        return size
    if size.lower() not in SIZES_MM:
        raise InvalidInputError(f'size is "{size}"; needed: {NAMES}')
    if unit not in UNITS_MM:
        raise InvalidInputError(
            f'size is "{size}" and plane.unit "{unit}", whose length is not known; '
            f"{', '.join(UNITS_MM)} are, or give size as [w, h]"
        )
    width_mm, height_mm = SIZES_MM[size.lower()]
    return width_mm / UNITS_MM[unit], height_mm / UNITS_MM[unit]


def corners_of(sides: tuple[float, float]) -> Corners:
    """Return the corners of a rectangle: the plane's origin first, then along X."""
    width, height = sides
    return ((0.0, 0.0), (width, 0.0), (width, height), (0.0, height))
