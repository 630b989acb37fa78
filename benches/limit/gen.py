"""A rendered finger with exact truth, for `limit.c`; not a part of fingerpost.

    python benches/limit/gen.py OUT_DIR

A bright capsule (a finger seen against a dark background) moves under a slowly varying affine map,
with soft edges, shading, a background gradient and pixel noise. Written for NAME in finger_vga
(256 frames of 640 × 480) and finger_hd (64 of 1920 × 1080), 211 MB in all:

    NAME.u8       the frames, raw, n × height × width
    NAME.truth    float64, n × 6: a11 a12 a21 a22 tx ty (image from template)
    NAME.tmpl     float64, 100 × 4: template point x y, outward normal x y
    NAME.txt      "n height width points radius half_length"

Template coordinates are centred on the shape; pixel centres are integers.
"""

import sys
from math import erf
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

EDGE_BLUR_PX, NOISE = 1.2, 4.0
FOREGROUND, BACKGROUND = 190.0, 45.0
POINTS = 100
SEED = 7
GAUSSIAN_Z = np.linspace(-6, 6, 4001)
GAUSSIAN_CDF = np.vectorize(erf)(GAUSSIAN_Z / np.sqrt(2)) * 0.5 + 0.5


def capsule_distance(x: Array, y: Array, radius: float, half_length: float) -> Array:
    """Distance to a capsule along x, negative inside."""
    return np.hypot(x - np.clip(x, -half_length, half_length), y) - radius


def template(radius: float, half_length: float) -> Array:
    """Points at equal steps along the capsule, with outward normals."""
    straight, cap = 2 * half_length, np.pi * radius
    points, normals = [], []
    for s in (np.arange(POINTS) + 0.5) / POINTS * 2 * (straight + cap):
        if s < straight:
            point, normal = (-half_length + s, radius), (0.0, 1.0)
        elif s < straight + cap:
            angle = np.pi / 2 - (s - straight) / radius
            normal = (np.cos(angle), np.sin(angle))
            point = (half_length + radius * normal[0], radius * normal[1])
        elif s < 2 * straight + cap:
            point, normal = (half_length - (s - straight - cap), -radius), (0.0, -1.0)
        else:
            angle = -np.pi / 2 - (s - 2 * straight - cap) / radius
            normal = (np.cos(angle), np.sin(angle))
            point = (-half_length + radius * normal[0], radius * normal[1])
        points.append(point)
        normals.append(normal)
    n = np.array(normals, float)
    return np.c_[np.array(points), n / np.linalg.norm(n, axis=1, keepdims=True)]


def pose(i: int, n: int, scale: float, width: int, height: int) -> tuple[Array, Array]:
    """Affine map and shift of frame i of a closed loop of n frames."""
    u = 2 * np.pi * i / n
    turn = 0.35 + 0.30 * np.sin(2 * u)
    size = 1 + 0.06 * np.sin(3 * u + 1)
    shear = 0.05 * np.sin(2 * u + 2)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    A = size * rotation @ np.array([[1, shear], [0, 1]])
    shift_u, shift_v = 75 * scale * np.sin(2 * u), 60 * scale * np.sin(3 * u + 0.7)
    return A, np.array([width / 2 + shift_u, height / 2 + shift_v])


def distance(x: Array, y: Array, A: Array, t: Array, radius: float, half_length: float) -> Array:
    """Signed distance in image pixels to the moved capsule, to first order."""
    inverse = np.linalg.inv(A)
    x, y = x - t[0], y - t[1]
    p, q = inverse[0, 0] * x + inverse[0, 1] * y, inverse[1, 0] * x + inverse[1, 1] * y
    step = 1e-3

    def at(p: Array, q: Array) -> Array:
        return capsule_distance(p, q, radius, half_length)

    slope_p = (at(p + step, q) - at(p - step, q)) / (2 * step)
    slope_q = (at(p, q + step) - at(p, q - step)) / (2 * step)
    slope_u = slope_p * inverse[0, 0] + slope_q * inverse[1, 0]
    slope_v = slope_p * inverse[0, 1] + slope_q * inverse[1, 1]
    return at(p, q) / np.maximum(np.hypot(slope_u, slope_v), 1e-9)


def render(
    A: Array,
    t: Array,
    radius: float,
    half_length: float,
    width: int,
    height: int,
    rng: np.random.Generator,
) -> NDArray[np.uint8]:
    """One frame."""
    v, u = np.mgrid[0:height, 0:width].astype(np.float32)
    image = BACKGROUND + 12 * (u / width) + 8 * (v / height)
    # Only the neighbourhood of the shape needs the distance.
    reach = (half_length + 2 * radius) * 1.3 + 10
    u0, u1 = int(max(0, t[0] - reach)), int(min(width, t[0] + reach))
    v0, v1 = int(max(0, t[1] - reach)), int(min(height, t[1] + reach))
    near = np.s_[v0:v1, u0:u1]
    d = distance(u[near].astype(float), v[near].astype(float), A, t, radius, half_length)
    coverage = np.interp(-d / EDGE_BLUR_PX, GAUSSIAN_Z, GAUSSIAN_CDF)
    depth = np.clip(1 + d / radius, 0, 1)
    # Round look: a darker rim, without a slope at the edge itself.
    shade = FOREGROUND - 25 * depth * depth * (3 - 2 * depth)
    image[near] += coverage * (shade - image[near])
    image += rng.standard_normal(image.shape, dtype=np.float32) * NOISE
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def write_sequence(out: Path, name: str, width: int, height: int, n: int, scale: float) -> None:
    """Write the four files of one sequence."""
    radius, half_length = 18 * scale, 75 * scale
    rng = np.random.default_rng(SEED)
    truth = []
    with (out / f"{name}.u8").open("wb") as frames:
        for i in range(n):
            A, t = pose(i, 256, scale, width, height)
            truth.append([*A.ravel(), *t])
            frames.write(render(A, t, radius, half_length, width, height, rng).tobytes())
    np.array(truth).tofile(out / f"{name}.truth")
    template(radius, half_length).tofile(out / f"{name}.tmpl")
    shape = f"{n} {height} {width} {POINTS} {radius} {half_length}\n"
    (out / f"{name}.txt").write_text(shape, encoding="ascii")


def main() -> None:
    """Write both sequences."""
    if len(sys.argv) != 2:
        sys.exit("usage: python gen.py OUT_DIR")
    out = Path(sys.argv[1])
    out.mkdir(parents=True, exist_ok=True)
    write_sequence(out, "finger_vga", 640, 480, 256, 1.0)
    write_sequence(out, "finger_hd", 1920, 1080, 64, 2.25)


if __name__ == "__main__":
    main()
