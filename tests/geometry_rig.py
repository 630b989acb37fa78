"""Exact rigs for tests of the geometry: pinhole cameras above a plane, and a rod pointing at it.

Lengths in mm, plane Z = 0, pixels with u right and v down. The standard rig: cameras 2 m away, 30°
apart, 42° above the table, a 400 mm workspace that fills 65 % of 640 px.
"""

from dataclasses import dataclass

import numpy as np

from fingerpost.pointing import FingerLine, PlaneView

SIDE = 400.0
CORNERS = np.array([[0.0, 0.0], [SIDE, 0.0], [SIDE, SIDE], [0.0, SIDE]])
CENTRE = np.array([SIDE / 2, SIDE / 2, 0.0])


@dataclass(frozen=True)
class Camera:
    """P = K [R | t]."""

    projection: np.ndarray
    position: np.ndarray

    @property
    def image_from_plane(self) -> np.ndarray:
        return self.projection[:, [0, 1, 3]]

    def project(self, points: np.ndarray) -> np.ndarray:
        y = points @ self.projection[:, :3].T + self.projection[:, 3]
        assert np.all(y[..., 2] > 0), "behind the camera"
        return y[..., :2] / y[..., 2:]


def camera(
    azimuth_deg: float = 0.0,
    elevation_deg: float = 42.0,
    distance_mm: float = 2000.0,
    focal_px: float = 1692.0,
    centre_px: tuple[float, float] = (319.5, 239.5),
) -> Camera:
    """Return a camera on the side Y < 0 that points at the middle of the workspace."""
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    outward = np.array(
        [
            np.sin(azimuth) * np.cos(elevation),
            -np.cos(azimuth) * np.cos(elevation),
            np.sin(elevation),
        ]
    )
    right = np.cross(-outward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(-outward, right), -outward])
    position = CENTRE + distance_mm * outward
    K = np.array([[focal_px, 0, centre_px[0]], [0, focal_px, centre_px[1]], [0, 0, 1]])
    return Camera(K @ np.column_stack([R, -R @ position]), position)


def stereo(half_angle_deg: float = 15.0) -> list[Camera]:
    return [camera(-half_angle_deg), camera(half_angle_deg)]


@dataclass(frozen=True)
class Rod:
    """A straight pointing device: its axis meets the plane in `target`."""

    target: np.ndarray
    tip: np.ndarray
    base: np.ndarray


def rod(
    target: np.ndarray,
    azimuth_deg: float,
    slant_deg: float,
    tip_height_mm: float,
    length_mm: float = 80.0,
) -> Rod:
    """Return a rod pointing down by `slant_deg`; azimuth 0: towards the cameras (−Y), 180: away."""
    azimuth, slant = np.radians([azimuth_deg, slant_deg])
    direction = np.array(
        [np.sin(azimuth) * np.cos(slant), -np.cos(azimuth) * np.cos(slant), -np.sin(slant)]
    )
    tip = np.array([*target, 0.0]) - direction * tip_height_mm / np.sin(slant)
    return Rod(np.asarray(target, dtype=float), tip, tip - length_mm * direction)


def random_rod(rng: np.random.Generator, azimuth_deg: tuple[float, float] = (-100.0, 100.0)) -> Rod:
    """Draw a rod: target in the workspace, tip 5–25 cm up, slant 25–65°, length 70–90 mm."""
    return rod(
        rng.uniform(0.05, 0.95, 2) * SIDE,
        rng.uniform(*azimuth_deg),
        rng.uniform(25.0, 65.0),
        rng.uniform(50.0, 250.0),
        rng.uniform(70.0, 90.0),
    )


def view_ray_angle_deg(view: Camera, pointing: Rod) -> float:
    """Return the angle between the rod and the ray through its tip; near 0 it is seen end-on."""
    along = pointing.tip - pointing.base
    ray = pointing.tip - view.position
    cosine = abs(along @ ray) / np.linalg.norm(along) / np.linalg.norm(ray)
    return float(np.degrees(np.arccos(cosine)))


def seen_rod(
    rng: np.random.Generator,
    cameras: list[Camera],
    azimuth_deg: tuple[float, float] = (-100.0, 100.0),
    min_ray_angle_deg: float = 25.0,
) -> Rod:
    """Draw a rod that no camera sees end-on."""
    while True:
        pointing = random_rod(rng, azimuth_deg)
        if min(view_ray_angle_deg(c, pointing) for c in cameras) > min_ray_angle_deg:
            return pointing


def finger_line(
    view: Camera,
    pointing: Rod,
    covariance: np.ndarray | None = None,
    time_s: float = 0.0,
    noise: np.ndarray = (0.0, 0.0),
) -> FingerLine:
    """Project the rod's axis; displace the line by `noise` = (offset px, angle rad)."""
    base, tip = view.project(np.stack([pointing.base, pointing.tip]))
    middle, along = (base + tip) / 2, tip - base
    angle = np.arctan2(along[1], along[0])
    normal = np.array([-np.sin(angle), np.cos(angle)])
    return FingerLine(
        anchor_px=middle + noise[0] * normal,
        angle_rad=angle + noise[1],
        covariance=np.zeros((2, 2)) if covariance is None else covariance,
        tip_px=tip,
        time_s=time_s,
    )


def plane_view(
    view: Camera,
    covariances_px2: np.ndarray | None = None,
    plane_points: np.ndarray = CORNERS,
    noise_px: np.ndarray | float = 0.0,
) -> PlaneView:
    points = np.column_stack([plane_points, np.zeros(len(plane_points))])
    return PlaneView.from_reference_points(
        plane_points, view.project(points) + noise_px, covariances_px2
    )


def central_differences(function, x: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return the Jacobian of `function` at `x`, a column per entry, with steps 1e-5 `scale`."""
    columns = []
    for k, size in enumerate(np.asarray(scale, dtype=float)):
        step = np.zeros(len(x))
        step[k] = 1e-5 * size
        columns.append((function(x + step) - function(x - step)) / (2 * step[k]))
    return np.stack(columns, axis=-1)


def random_warp(rng: np.random.Generator, extent: float) -> np.ndarray:
    """Draw a homography that is far from affine, with W > 0 on all of ``[0, extent]²``."""
    turn = rng.uniform(0, 2 * np.pi)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    warp = np.eye(3)
    warp[:2, :2] = (
        rng.uniform(0.5, 2.0)
        * rotation
        @ np.array([[1.0, rng.uniform(-0.5, 0.5)], [0.0, rng.uniform(0.5, 2.0)]])
    )
    warp[:2, 2] = rng.uniform(-extent, extent, 2)
    warp[2, :2] = rng.uniform(-0.3, 0.3, 2) / extent
    return warp


def covariance_of(samples: np.ndarray) -> np.ndarray:
    return np.cov(np.asarray(samples), rowvar=False)
