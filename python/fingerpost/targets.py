"""Targets on the plane, and the probability that each is pointed at.

A target is the neighbourhood of a point, or a polygon and its neighbourhood. Its probability is the
integral of the indicated point's normal distribution over it; the integral over the rest of the
plane is the probability that no target is meant. The probabilities are calibrated under a uniform
prior: if people point at all places with equal probability, nine of ten targets reported with 0.9
are right.
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
"""Number of nodes that represent the distribution: probabilities are accurate to about 0.002."""

_GOLDEN_ANGLE_RAD = np.pi * (3.0 - np.sqrt(5.0))


@dataclass(frozen=True, eq=False)
class Target:
    """A target on the plane.

    Parameters
    ----------
    name
        Its name.
    corners : (N, 2)
        One point, or at least three corners of a polygon, in plane units.
    radius
        Margin around them [plane units]: above 0 for a point, at least 0 for a polygon.
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
        """Return the lower and upper corner (2,) of the target's bounding box."""
        return self.corners.min(axis=0) - self.radius, self.corners.max(axis=0) + self.radius

    def reach(self, points: ArrayLike) -> Array:
        """Return the signed distance of points to the border [plane units], negative outside.

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
    """Return which points a polygon contains: their rays cross its sides an odd number of times."""
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
        Where two overlap, a point belongs to the one in which it lies deeper.
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
        """Return the index of the target on which each point lies, or −1.

        Parameters
        ----------
        points : (M, 2)
        """
        points = finite_array(points, "points", ("M", 2))
        is_near = (self._lowest <= points.max(axis=0)) & (self._highest >= points.min(axis=0))
        near = np.flatnonzero(is_near.all(axis=1))  # most are far from a small ellipse
        if not len(near):
            return np.full(len(points), -1)
        reaches = np.stack([self._targets[k].reach(points) for k in near])
        return np.where(reaches.max(axis=0) >= 0.0, near[reaches.argmax(axis=0)], -1)

    def probabilities(self, point: ArrayLike, covariance: ArrayLike) -> dict[str | None, float]:
        """Return the probability that each target is pointed at; the key None means no target.

        Parameters
        ----------
        point : (2,)
            The indicated point [plane units].
        covariance : (2, 2)
            Its covariance [plane units²].

        Returns
        -------
        dict
            Sums to 1; empty without targets.
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
    """Return nodes of equal weight for the standard normal distribution, on a sunflower spiral."""
    rank = (np.arange(NODES) + 0.5) / NODES
    radius, angle = np.sqrt(-2.0 * np.log1p(-rank)), np.arange(NODES) * _GOLDEN_ANGLE_RAD
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
