"""Region over the plane in which the gripper may be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.checks import finite_array, in_range
from fingerpost.errors import InvalidInputError

FURTHEST = 1e9
"""Greatest coordinate; a table's are smaller in any unit, and much greater ones overflow in areas.
"""

# Least turn at a corner, relative to its sides: below, it is a rounding error.
FLAT_SHARE = 1e-9


@dataclass(frozen=True, eq=False)
class SafeRegion:
    """A convex polygon of the plane, and a range of heights above it.

    It is convex, and so is its image under a homography with W > 0; a straight path between two of
    its points therefore never leaves it.

    Parameters
    ----------
    corners : (N, 2)
        Corners in plane coordinates, N ≥ 3, in order, clockwise or anticlockwise; convex; none
        beyond `FURTHEST`.
    lowest_m, highest_m : float
        Heights above the plane [m]; the lower first.

    Raises
    ------
    InvalidInputError
        Too few corners, NaN, too far, not convex, without area, or heights in the wrong order.
    """

    corners: NDArray[np.float64]
    lowest_m: float
    highest_m: float

    def __post_init__(self) -> None:
        corners = finite_array(self.corners, "corners", ("N", 2))
        if (abs(corners) > FURTHEST).any():
            raise InvalidInputError(
                f"corners {corners.tolist()} reach too far; up to {FURTHEST:g} is right"
            )
        if len(corners) < 3:
            raise InvalidInputError(f"corners: {len(corners)} found; at least 3 are needed")
        lowest = in_range(self.lowest_m, "lowest_m", -np.inf)
        highest = in_range(self.highest_m, "highest_m", lowest)
        object.__setattr__(self, "corners", _counter_clockwise(corners))
        object.__setattr__(self, "lowest_m", lowest)
        object.__setattr__(self, "highest_m", highest)

    @property
    def centre(self) -> NDArray[np.float64]:
        """Mean of the corners, which lies inside (2,)."""
        return np.asarray(self.corners.mean(axis=0))

    def contains(
        self, point: ArrayLike, above_m: float, *, within: float = 0.0, within_m: float = 0.0
    ) -> bool:
        """Whether a point at a height is inside.

        Parameters
        ----------
        point : (2,)
            Plane coordinates.
        above_m : float
            Height above the plane [m].
        within, within_m : float
            Tolerance outside the region, in the plane [plane units] and in height [m].
        """
        point = finite_array(point, "point", (2,))
        inside = bool((self._distances(point) >= -within).all())
        return inside and self.lowest_m - within_m <= above_m <= self.highest_m + within_m

    def clamp(self, point: ArrayLike, above_m: float) -> tuple[NDArray[np.float64], float]:
        """Return the nearest permitted point (2,) and height [m]; unchanged if inside."""
        point = finite_array(point, "point", (2,))
        above_m = min(max(in_range(above_m, "above_m", -np.inf), self.lowest_m), self.highest_m)
        if (self._distances(point) >= 0).all():
            return point, above_m
        sides = np.roll(self.corners, -1, axis=0) - self.corners
        along = ((point - self.corners) * sides).sum(axis=1) / (sides**2).sum(axis=1)
        nearest = self.corners + np.clip(along, 0.0, 1.0)[:, None] * sides
        return nearest[np.argmin(((nearest - point) ** 2).sum(axis=1))], above_m

    def inset(self, distance: float, height_m: float) -> SafeRegion:
        """Return the region without its rim.

        Parameters
        ----------
        distance : float
            Width of the rim [plane units], ≥ 0.
        height_m : float
            Distance from the lowest and the highest height [m], ≥ 0.

        Raises
        ------
        InvalidInputError
            The result would be empty or have fewer corners.
        """
        distance = in_range(distance, "distance", 0.0)
        height_m = in_range(height_m, "height_m", 0.0)
        normals = self._normals()
        offsets = (normals * self.corners).sum(axis=1) + distance
        before = np.roll(normals, 1, axis=0)
        corners = np.array(
            [
                np.linalg.solve(np.array([n_before, n]), np.array([c_before, c]))
                for n_before, n, c_before, c in zip(
                    before, normals, np.roll(offsets, 1), offsets, strict=True
                )
            ]
        )
        left = self.highest_m - self.lowest_m - 2 * height_m
        sides = np.roll(corners, -1, axis=0) - corners
        was = np.roll(self.corners, -1, axis=0) - self.corners
        if left < 0 or ((sides * was).sum(axis=1) <= 0).any():
            raise InvalidInputError(
                f"the safe region is too small for a rim of {distance:g} and {height_m:g} m"
            )
        return SafeRegion(corners, self.lowest_m + height_m, self.highest_m - height_m)

    def _distances(self, point: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance of a point from every side, positive inside."""
        return np.asarray(((point - self.corners) * self._normals()).sum(axis=1))

    def _normals(self) -> NDArray[np.float64]:
        """Return the unit normals of the sides, inwards."""
        sides = np.roll(self.corners, -1, axis=0) - self.corners
        normals = np.column_stack([-sides[:, 1], sides[:, 0]])
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def _counter_clockwise(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the corners of a convex polygon anticlockwise; refuse any other polygon."""
    sides = np.roll(corners, -1, axis=0) - corners
    lengths = np.linalg.norm(sides, axis=1)
    following = np.roll(sides, -1, axis=0)
    turns = sides[:, 0] * following[:, 1] - sides[:, 1] * following[:, 0]
    way_round = np.sign(turns.sum())
    slack = FLAT_SHARE * lengths * np.roll(lengths, -1)
    if (lengths == 0).any() or (way_round * turns <= slack).any():
        raise InvalidInputError(
            f"corners {corners.tolist()} are not a convex polygon: every corner must turn the "
            "same way, and none may lie on a straight side"
        )
    angles = np.arctan2(turns, (sides * following).sum(axis=1))
    if abs(angles.sum()) > 3 * np.pi:  # 2π for a convex polygon; a star turns by more
        raise InvalidInputError(f"corners {corners.tolist()} go round more than once")
    return corners if way_round > 0 else corners[::-1]
