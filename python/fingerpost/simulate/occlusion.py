"""Discs that hide a given fraction of the tracked contour."""

import math

import numpy as np
from numpy.typing import NDArray

from fingerpost.errors import InvalidInputError
from fingerpost.simulate.camera import Camera
from fingerpost.simulate.device import Body
from fingerpost.simulate.outline import link_outlines, pictured_outlines, seen_links
from fingerpost.simulate.pose import DevicePose
from fingerpost.simulate.render import Occluder

Array = NDArray[np.float64]

# Spacing of samples along the contour.
CONTOUR_STEP_PX = 0.25
# Radius of a disc, in widths of the finger; the last one is cut to fit.
RADIUS_WIDTHS = (0.35, 0.9)


def occluders_on(
    camera: Camera,
    body: Body,
    pose: DevicePose,
    fraction: float,
    levels: tuple[float, float],
    rng: np.random.Generator,
) -> tuple[Occluder, ...]:
    """Discs in random places that together cover `fraction` of the contour in one view."""
    contour, width = visible_contour(camera, body, pose)
    wanted = round(fraction * len(contour))
    bare = contour
    discs = []
    while (missing := wanted - (len(contour) - len(bare))) > 0:
        radius = width * rng.uniform(*RADIUS_WIDTHS)
        heading, shift = rng.uniform(0, 2 * math.pi), radius * math.sqrt(rng.uniform(0, 0.5))
        centre = rng.choice(bare) + shift * np.array([math.cos(heading), math.sin(heading)])
        distance = np.linalg.norm(bare - centre, axis=1)
        if (distance <= radius).sum() > missing:
            radius = float(np.sort(distance)[missing - 1])
        bare = bare[distance > radius]
        discs.append(Occluder((float(centre[0]), float(centre[1])), radius, rng.uniform(*levels)))
    return tuple(discs)


def visible_contour(camera: Camera, body: Body, pose: DevicePose) -> tuple[Array, float]:
    """Contour of finger and thumb inside the image, and the width of the finger [px].

    Returns
    -------
    numpy.ndarray
        (N, 2) pictured pixels at equal distances; those inside another part are left out.
    float
        Mean width of the finger in the image.
    """
    seen, kept = seen_links(camera, body.placed(pose.world_from_device))
    if not kept.all():
        raise InvalidInputError(
            f"pose {pose} reaches behind the camera {camera.name!r}; move the device or the camera"
        )
    outlines = pictured_outlines(camera, link_outlines(seen))
    tracked = [body.finger] if body.thumb is None else [body.finger, body.thumb]
    contour = []
    for link in tracked:
        points = _evenly_spaced(outlines[link])
        for other in range(len(outlines)):
            if other != link:
                points = points[~_inside_convex(outlines[other], points)]
        contour.append(points)
    points = np.concatenate(contour)
    points = points[camera.contains(points)]
    if len(points) == 0:
        raise InvalidInputError(f"pose {pose} is outside the image of camera {camera.name!r}")
    radii = seen[:, body.finger, 3] / seen[:, body.finger, 2] * camera.f_px
    return points, float(radii.sum())


def _evenly_spaced(polygon: Array) -> Array:
    """Points every CONTOUR_STEP_PX along a closed polygon."""
    closed = np.concatenate([polygon, polygon[:1]])
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    place = np.arange(0, length[-1], CONTOUR_STEP_PX)
    return np.stack([np.interp(place, length, closed[:, i]) for i in range(2)], axis=-1)


def _inside_convex(polygon: Array, points: Array) -> NDArray[np.bool_]:
    """Whether points (N, 2) lie inside a convex polygon (V, 2), clockwise on the screen."""
    side = np.roll(polygon, -1, axis=0) - polygon
    offset = points[:, None] - polygon
    return np.asarray((side[:, 0] * offset[..., 1] - side[:, 1] * offset[..., 0] >= -1e-9).all(-1))
