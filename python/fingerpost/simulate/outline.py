"""Exact outlines of sphere-swept cones as seen from a point.

A link is the convex hull of two spheres, and perspective preserves convex hulls, so its outline
consists of two arcs, where each sphere's tangent cone touches it, joined by two straight lines. The
straight lines lie in the two planes through the eye that touch both spheres: with unit normal n and
sphere centres c, radii r, they solve n·c_start = r_start, n·c_end = r_end, |n| = 1. The two
solutions are symmetric about the plane of the eye and the link's axis; this is why the axis of a
body of revolution is seen midway between its flanks.

The outline is given as points in space that project onto it, so the same code serves a camera
(divide by depth) and a lamp (cut with the plane).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerpost.simulate.camera import Camera

Array = NDArray[np.float64]

# Intervals per arc. The vertices inside an arc lie slightly outside the circle, so that polygon and
# sector have the same area: the error of a half circle of 7 px radius is then ± 0.001 px, with a
# ripple of 0.3 px that vanishes by blurring.
ARC_STEPS = 64
# Near plane at which links are cut; no object in view is this close.
NEAR_MM = 50.0
# Number of vertices of straight flanks, for lens distortion.
FLANK_STEPS = 48


@dataclass(frozen=True, eq=False)
class Outline:
    """Outlines of L links in the eye's coordinates (origin at the eye; x right, y down).

    The first ``ARC_STEPS + 1`` points run round the end sphere from the left flank over the apex to
    the right flank, the others round the start sphere from the right flank to the left; left and
    right as seen along the link from start to end.
    """

    points: Array  # (L, 2·(ARC_STEPS + 1), 3)
    apex: Array  # (L, 3) point of the outline where it meets the axis, beyond the end sphere
    end_on: NDArray[np.bool_]  # (L,) whether one sphere hides the other: no flanks

    @property
    def flanks(self) -> Array:
        """(L, 2, 2, 3) left and right flank, each from the start to the end of the link."""
        left = self.points[:, [-1, 0]]
        right = self.points[:, [ARC_STEPS + 1, ARC_STEPS]]
        return np.stack([left, right], axis=1)


def seen_links(camera: Camera, spheres_mm: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Links (2, L, 4) in camera coordinates, cut at the near plane.

    Returns the links, whose spheres now lie at least `NEAR_MM` in front of the camera, and a mask
    (L,) of those that are visible at all. If a link crosses the near plane, its sphere is moved
    along the link, so that the remaining part keeps its shape.
    """
    spheres = np.concatenate([camera.seen(spheres_mm[..., :3]), spheres_mm[..., 3:]], axis=-1)
    clearance = spheres[..., 2] - spheres[..., 3] - NEAR_MM
    kept = (clearance > 0).any(axis=0)
    start, end = spheres[:, kept]
    gap_start, gap_end = clearance[:, kept]
    span = np.where(gap_start == gap_end, 1.0, gap_start - gap_end)
    crossing = start + (gap_start / span)[:, None] * (end - start)
    start = np.where((gap_start <= 0)[:, None], crossing, start)
    end = np.where((gap_end <= 0)[:, None], crossing, end)
    return np.stack([start, end]), kept


def link_outlines(spheres: Array) -> Outline:
    """Outlines of links (2, L, 4) given in eye coordinates; the eye is outside every sphere."""
    centre, radius = spheres[..., :3], spheres[..., 3]
    squared = np.einsum("ilk,ilk->il", centre, centre)
    start_end = np.einsum("lk,lk->l", centre[0], centre[1])
    across = _cross(centre[0], centre[1])
    gram = np.einsum("lk,lk->l", across, across)
    seen_as_one = gram < 1e-18 * squared[0] * squared[1]
    across = np.where(seen_as_one[:, None], _any_perpendicular(centre[0]), across)
    across /= np.linalg.norm(across, axis=-1, keepdims=True)

    # n = weight_start·c_start + weight_end·c_end ± height·across, from n·c = r.
    gram = np.where(seen_as_one, 1.0, gram)
    weight = (squared[::-1] * radius - start_end * radius[::-1]) / gram
    height2 = 1 - np.einsum("il,il->l", weight, radius)
    end_on = seen_as_one | (height2 <= 0)
    height = np.sqrt(np.where(end_on, 1.0, height2))

    # Each sphere is seen along a circle; `along` points in its plane from start to end.
    along = _cross(across, centre) / np.sqrt(squared)[..., None]
    normal_along = weight[::-1] * np.einsum("ilk,ilk->il", centre[::-1], along)
    flank_angle = np.arctan2(height, -normal_along)
    sine = radius / np.sqrt(squared)
    circle_centre = centre * (1 - sine**2)[..., None]
    circle_radius = radius * np.sqrt(1 - sine**2)

    # Seen end on, the sphere that looks larger is the whole outline; the other arc is one point.
    larger = np.where(sine[1] >= sine[0], 1, 0)
    flank_angle = np.where(end_on, larger * np.pi, flank_angle)
    sphere = np.where(end_on, larger, [[0], [1]])
    link = np.arange(centre.shape[1])
    circle_centre, circle_radius = circle_centre[sphere, link], circle_radius[sphere, link]
    along = along[sphere, link]

    turn = np.linspace(-1.0, 1.0, ARC_STEPS + 1)
    end_angles = turn * flank_angle[1][:, None]
    start_angles = np.pi + turn * (np.pi - flank_angle[0])[:, None]
    arcs = []
    for i, angles in ((1, end_angles), (0, start_angles)):
        step = angles[:, 1] - angles[:, 0]
        radii = np.repeat(circle_radius[i][:, None], ARC_STEPS + 1, axis=1)
        radii[:, 1:-1] /= np.sqrt(np.sinc(step / np.pi))[:, None]
        sideways = (radii * np.cos(angles))[..., None] * along[i][:, None]
        upwards = (radii * np.sin(angles))[..., None] * across[:, None]
        arcs.append(circle_centre[i][:, None] + sideways + upwards)
    apex = circle_centre[1] + circle_radius[1][:, None] * along[1]
    return Outline(points=np.concatenate(arcs, axis=1), apex=apex, end_on=end_on)


def _cross(a: Array, b: Array) -> Array:
    """Cross product; `numpy.cross` takes longer to check its arguments than to multiply them."""
    following, last = [1, 2, 0], [2, 0, 1]
    return a[..., following] * b[..., last] - a[..., last] * b[..., following]


def pictured_outlines(camera: Camera, outline: Outline) -> Array:
    """Outlines (L, V, 2) in pictured pixels, continued beyond the lens's reach."""
    ideal = camera.project_seen(outline.points)
    if camera.k1 == 0:
        return ideal
    end_arc, start_arc = ideal[:, : ARC_STEPS + 1], ideal[:, ARC_STEPS + 1 :]
    part = np.linspace(0, 1, FLANK_STEPS + 2)[1:-1, None]
    right = end_arc[:, -1:] + part * (start_arc[:, :1] - end_arc[:, -1:])
    left = start_arc[:, -1:] + part * (end_arc[:, :1] - start_arc[:, -1:])
    return camera.pictured_everywhere(np.concatenate([end_arc, right, start_arc, left], axis=1))


def _any_perpendicular(vectors: Array) -> Array:
    """Return a vector at right angles to each of (L, 3), never zero."""
    smallest = np.argmin(np.abs(vectors), axis=-1)
    return _cross(vectors, np.eye(3)[smallest])
