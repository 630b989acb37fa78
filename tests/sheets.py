"""Pictures of rectangles on a table, with exact corners."""

import math

import numpy as np

SIZE = (640, 480)


def corners_of_view(rng, size=(210.0, 297.0), picture=SIZE, distance=(1.6, 2.6)):
    """Return the image corners (4, 2) of a rectangle (0, 0), (w, 0), (w, h), (0, h).

    The random camera is 30° to 75° above the table, on the near side, with a roll of up to 8°.
    """
    w, h = size
    elevation, azimuth = np.radians(rng.uniform(30, 75)), np.radians(rng.uniform(-150, -30))
    centre = np.array([w / 2, h / 2, 0.0])
    ray = np.array(
        [
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
        ]
    )
    eye = centre + ray * math.hypot(w, h) * rng.uniform(*distance)
    ahead = -ray
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    roll = np.radians(rng.uniform(-8, 8))
    down = np.cross(ahead, right)
    right, down = (
        math.cos(roll) * right + math.sin(roll) * down,
        math.cos(roll) * down - math.sin(roll) * right,
    )
    plane = np.array([[0, 0, 0], [w, 0, 0], [w, h, 0], [0, h, 0]], float) - eye
    f = 1.1 * picture[0]
    seen = plane @ np.stack([right, down, ahead], axis=1)
    return f * seen[:, :2] / seen[:, 2:] + [picture[0] / 2 - 0.5, picture[1] / 2 - 0.5]


def inside(corners_px, picture=SIZE, sigma_px=0.8):
    """Return the part of each pixel inside a convex outline blurred by a Gaussian, 0 to 1."""
    erf = np.vectorize(math.erf, otypes=[float])
    v, u = np.indices(picture[::-1]).astype(float)
    x, y = np.asarray(corners_px).T
    turn = np.sign(x @ np.roll(y, -1) - y @ np.roll(x, -1))
    part = np.ones(picture[::-1])
    # A pixel's square has a variance of 1/12.
    spread = math.sqrt(2.0 * (sigma_px**2 + 1.0 / 12.0))
    for a, b in zip(corners_px, np.roll(corners_px, -1, axis=0), strict=True):
        along = (b - a) / np.linalg.norm(b - a)
        d = turn * (along[0] * (v - a[1]) - along[1] * (u - a[0])) / spread
        near = np.abs(d) < 4.0
        side = (d > 0.0).astype(float)
        side[near] = 0.5 + 0.5 * erf(d[near])
        part *= side
    return part


def noisy(levels, rng, noise):
    """Add Gaussian noise to grey levels and round them to 8 bits."""
    return np.clip(np.round(levels + noise * rng.normal(size=levels.shape)), 0, 255).astype(
        np.uint8
    )


def covered(levels, corners_px, rng, part):
    """Cover a part of each side of an outline by a disc of another level."""
    v, u = np.indices(levels.shape).astype(float)
    levels = levels.copy()
    for a, b in zip(corners_px, np.roll(corners_px, -1, axis=0), strict=True):
        centre = a + rng.uniform(0.2, 0.8) * (b - a)
        radius = 0.5 * part * np.linalg.norm(b - a)
        levels[np.hypot(u - centre[0], v - centre[1]) < radius] = rng.uniform(20, 235)
    return levels
