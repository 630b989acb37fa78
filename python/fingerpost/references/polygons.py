"""Area and convexity of polygons in an image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def signed_area(corners: Array) -> Array:
    """Return the areas (...) of polygons (..., N, 2) by the shoelace formula.

    They are positive if the corners run clockwise in the image, where v points downwards.
    """
    ahead = np.roll(corners, -1, axis=-2)
    return np.asarray(0.5 * _cross(corners, ahead).sum(axis=-1))


def is_convex(corners: Array) -> NDArray[np.bool_]:
    """Return which polygons (..., N, 2) turn the same way at every corner."""
    sides = np.roll(corners, -1, axis=-2) - corners
    turns = _cross(sides, np.roll(sides, -1, axis=-2))
    with np.errstate(invalid="ignore"):
        return np.asarray((turns > 0.0).all(axis=-1) | (turns < 0.0).all(axis=-1))


def contains(corners: Array, point: Array) -> bool:
    """Return whether a point (2,) lies inside a convex polygon (N, 2)."""
    turns = _cross(np.roll(corners, -1, axis=0) - corners, point - corners)
    return bool((turns > 0.0).all() or (turns < 0.0).all())


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
