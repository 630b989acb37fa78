"""Silhouettes of capsules above the plane in an image, as unions of discs.

A plane homography T and the camera's centre C determine the whole camera: a point Q at height h
above the plane lies on the ray from C that meets the plane at F = (C_h Q − h C) / (C_h − h), so

    image_from_space = T · [[C_h, 0, −C_x, 0], [0, C_h, −C_y, 0], [0, 0, −1, C_h]] / C_h

(Hartley & Zisserman, Multiple View Geometry, 2nd ed., section 8.1.1). A capsule is a chain of
spheres. The image of a sphere of radius r at Q is a disc about the image of Q, with the image of r
as its radius, exact to second order in r over the distance.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

SPACING = 0.5
"""Distance between the centres of a capsule's spheres [radii]; their union is narrower than the
capsule by 1 − √(1 − SPACING²/4) = 3 % at most."""


@dataclass(frozen=True, slots=True)
class Capsule:
    """All points within a radius of a segment.

    Attributes
    ----------
    start, end : (3,)
        The segment's ends: X, Y and height above the plane [plane units].
    radius : float
        [plane units], > 0.
    """

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float

    def spheres(self) -> Array:
        """Return spheres (N, 4) that cover the capsule: centre and radius."""
        start, end = np.array(self.start), np.array(self.end)
        count = 1 + math.ceil(math.dist(self.start, self.end) / (SPACING * self.radius))
        shares = np.linspace(0.0, 1.0, count)[:, None]
        return np.column_stack([start + shares * (end - start), np.full(count, self.radius)])

    def distance(self, point: Array) -> float:
        """Return the distance of a point (3,) from the segment [plane units]."""
        start = np.array(self.start)
        way = np.array(self.end) - start
        share = float((point - start) @ way) / max(float(way @ way), np.finfo(float).tiny)
        return float(np.linalg.norm(point - start - min(max(share, 0.0), 1.0) * way))


def image_from_space(image_from_plane: Array, centre: ArrayLike) -> Array:
    """Return the camera matrix (3, 4) of a view of the plane.

    Parameters
    ----------
    image_from_plane : (3, 3)
        Homography of the plane.
    centre : (3,)
        The camera's centre: X, Y and height above the plane, above 0.
    """
    x, y, height = np.asarray(centre, dtype=float)
    foot = np.array([[height, 0.0, -x, 0.0], [0.0, height, -y, 0.0], [0.0, 0.0, -1.0, height]])
    return np.asarray(image_from_plane @ foot / height)


@dataclass(frozen=True, eq=False, slots=True)
class Silhouette:
    """Part of an image: a union of discs.

    Attributes
    ----------
    centres_px : (N, 2)
        In ideal pinhole pixels.
    radii_px : (N,)
    """

    centres_px: Array
    radii_px: Array

    @classmethod
    def none(cls) -> Silhouette:
        """Return the empty silhouette."""
        return cls(np.empty((0, 2)), np.empty(0))

    @classmethod
    def of(cls, capsules: Iterable[Capsule], camera_matrix: Array, centre: ArrayLike) -> Silhouette:
        """Project capsules; spheres behind the camera, or around its centre, have no image.

        Parameters
        ----------
        capsules
            In plane coordinates.
        camera_matrix : (3, 4)
            As returned by `image_from_space`.
        centre : (3,)
            The camera's centre.
        """
        parts = [capsule.spheres() for capsule in capsules]
        if not parts or not np.isfinite(camera_matrix).all():
            return cls.none()
        spheres = np.concatenate(parts)
        centres, radii = spheres[:, :3], spheres[:, 3]
        away = centres - np.asarray(centre, dtype=float)
        distance = np.linalg.norm(away, axis=1)
        seen = distance > 2.0 * radii
        centres, radii, away, distance = (a[seen] for a in (centres, radii, away, distance))
        # Two directions across the ray; the image of a sphere is nearly a circle.
        ray = away / np.maximum(distance, np.finfo(float).tiny)[:, None]
        across = np.cross(ray, np.eye(3)[np.argmin(np.abs(ray), axis=1)])
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        rims = [centres + radii[:, None] * side for side in (across, np.cross(ray, across))]
        (at, depth), *edges = (_projected(camera_matrix, points) for points in (centres, *rims))
        radii_px = np.max([np.linalg.norm(edge - at, axis=1) for edge, _ in edges], axis=0)
        ahead = depth > 0.0
        return cls(at[ahead], radii_px[ahead])

    def covers(self, points_px: ArrayLike) -> NDArray[np.bool_]:
        """Return which points (M, 2) [ideal px] lie in the silhouette: (M,)."""
        points = np.asarray(points_px, dtype=float)
        apart = np.linalg.norm(points[:, None] - self.centres_px, axis=2)
        return np.asarray((apart <= self.radii_px).any(axis=1))


def _projected(camera_matrix: Array, points: Array) -> tuple[Array, Array]:
    """Return the images (N, 2) of points (N, 3) and their depths (N,), positive in front."""
    image = points @ camera_matrix[:, :3].T + camera_matrix[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        return image[:, :2] / image[:, 2:], image[:, 2]
