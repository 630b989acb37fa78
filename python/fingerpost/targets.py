"""Things on the plane to point at, and how probably each of them is what is pointed at.

A target is the neighbourhood of a point, or a polygon and its neighbourhood. Its probability is
the share of the indicated point's normal distribution, the whole ellipse, that lies on it; the
share that lies on no target is the probability of none of them. So of answers that are given with
0.9 nine in ten are right, where people may point anywhere: at one place as likely as at another.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.checks import covariance_array, finite_array, in_range
from fingerpost.errors import InvalidInputError

Array = NDArray[np.float64]

NODES = 2000
"""The distribution is looked at in so many places: shares are known to 0.002 or so."""

_GOLDEN_ANGLE_RAD = np.pi * (3.0 - np.sqrt(5.0))


@dataclass(frozen=True, eq=False)
class Target:
    """A thing on the plane.

    Parameters
    ----------
    name
        What it is called.
    corners : (N, 2)
        One point, or three and more corners of a polygon, in plane units.
    radius
        How far it reaches beyond them [plane units]: above 0 for a point, 0 and more for a polygon.
    rest
        Whether it is a place for the hand to rest at, where nothing is selected.

    Raises
    ------
    InvalidInputError
        Two corners, corners on a line, a radius out of range.
    """

    name: str
    corners: Array
    radius: float = 0.0
    rest: bool = False

    def __post_init__(self) -> None:
        corners = finite_array(self.corners, "corners", ("N", 2))
        object.__setattr__(self, "corners", corners)
        least = np.finfo(np.float64).tiny if len(corners) == 1 else 0.0
        in_range(self.radius, f"radius of target {self.name!r}", least)
        if len(corners) == 1:
            return
        spread = corners - corners.mean(axis=0)
        if len(corners) < 3 or np.linalg.matrix_rank(spread, tol=1e-9 * np.abs(spread).max()) < 2:
            raise InvalidInputError(
                f"target {self.name!r}: three corners or more, not on a line, make a polygon"
            )

    def bounds(self) -> tuple[Array, Array]:
        """Give the corners (2,) of the box that holds all of it, the lower ones first."""
        return self.corners.min(axis=0) - self.radius, self.corners.max(axis=0) + self.radius

    def reach(self, points: ArrayLike) -> Array:
        """Tell how far points lie inside of the target [plane units]; below 0 outside.

        Parameters
        ----------
        points : (M, 2)
        """
        points = finite_array(points, "points", ("M", 2))
        if len(self.corners) == 1:
            return np.asarray(self.radius - np.hypot(*(points - self.corners[0]).T))
        begin, along = self.corners, np.roll(self.corners, -1, axis=0) - self.corners
        away = points[:, None] - begin
        share = np.clip(
            np.einsum("mns,ns->mn", away, along) / np.maximum(np.sum(along**2, axis=1), 1e-300),
            0.0,
            1.0,
        )
        distance = np.hypot(*np.moveaxis(away - share[..., None] * along, -1, 0)).min(axis=1)
        inside = _is_inside(self.corners, points)
        return np.asarray(self.radius + np.where(inside, distance, -distance))


def _is_inside(corners: Array, points: Array) -> NDArray[np.bool_]:
    """Tell which points a polygon holds: rays from them cross its sides an odd number of times."""
    (x0, y0), (x1, y1) = corners.T, np.roll(corners, -1, axis=0).T
    x, y = points[:, :1], points[:, 1:]
    spans = (y0 > y) != (y1 > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = x0 + (y - y0) * (x1 - x0) / (y1 - y0)
    return np.asarray((spans & (x < crossing)).sum(axis=1) % 2 == 1)


class Targets:
    """All targets of a plane.

    Parameters
    ----------
    targets
        Where two overlap, a point is of that which it lies deeper in.
    """

    def __init__(self, targets: Sequence[Target]) -> None:
        self._targets = tuple(targets)
        corners = [
            (t.corners.min(axis=0) - t.radius, t.corners.max(axis=0) + t.radius) for t in self
        ]
        self._lowest, self._highest = np.array(corners).reshape(-1, 2, 2).swapaxes(0, 1)

    def __iter__(self) -> Iterator[Target]:
        return iter(self._targets)

    def __len__(self) -> int:
        return len(self._targets)

    def at(self, points: ArrayLike) -> NDArray[np.int64]:
        """Tell which target points lie on: its place, or −1.

        Parameters
        ----------
        points : (M, 2)
        """
        points = finite_array(points, "points", ("M", 2))
        is_near = (self._lowest <= points.max(axis=0)) & (self._highest >= points.min(axis=0))
        near = np.flatnonzero(is_near.all(axis=1))  # most are far off a small ellipse
        if not len(near):
            return np.full(len(points), -1)
        reaches = np.stack([self._targets[k].reach(points) for k in near])
        return np.where(reaches.max(axis=0) >= 0.0, near[reaches.argmax(axis=0)], -1)

    def probabilities(self, point: ArrayLike, covariance: ArrayLike) -> dict[str | None, float]:
        """Tell how probably each target is pointed at; None stands for none of them.

        Parameters
        ----------
        point : (2,)
            The indicated point [plane units].
        covariance : (2, 2)
            Of it [plane units²].

        Returns
        -------
        dict
            Sums up to 1; nothing at all without targets.
        """
        if not self._targets:
            return {}
        mean = finite_array(point, "point", (2,))
        values, axes = np.linalg.eigh(covariance_array(covariance, "covariance", (2, 2)))
        places = mean + (_normal_nodes() * np.sqrt(np.maximum(values, 0.0))) @ axes.T
        counts = np.bincount(self.at(places) + 1, minlength=len(self._targets) + 1) / NODES
        names: list[str | None] = [None, *(target.name for target in self._targets)]
        return dict(zip(names, counts.tolist(), strict=True))


@cache
def _normal_nodes() -> Array:
    """Places of equal weight that stand for the standard normal distribution: a sunflower's."""
    rank = (np.arange(NODES) + 0.5) / NODES
    radius, angle = np.sqrt(-2.0 * np.log1p(-rank)), np.arange(NODES) * _GOLDEN_ANGLE_RAD
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
