"""Pinhole cameras with one term of radial distortion, and their placement around the workspace.

World coordinates are millimetres: the working plane is Z = 0, Z points up. Camera coordinates
follow OpenCV: x right, y down, z forwards. Pixel (0, 0) is the centre of the top-left pixel, u
right, v down.

An *ideal* pixel is where the pinhole alone would image a point; the *pictured* pixel is where it
lands behind the lens: with m = (u − c)/f, the lens moves m to m·(1 + k1·|m|²), which is OpenCV's
model with every other coefficient 0.
"""

import math
import re
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.checks import finite_array
from fingerpost.errors import InvalidInputError
from fingerpost.simulate import checks

Array = NDArray[np.float64]

# A barrel lens (k1 < 0) folds the image over where r·(1 + k1·r²) stops growing, at r² = 1/(3|k1|).
# The model is used up to this fraction of that radius.
USABLE_FOLD_FRACTION = 0.95
# Greatest normalised radius: 89.9° off the axis.
WIDEST_RADIUS = 1000.0
# Pixels around the image that the lens must still map, because the blur extends beyond the border.
LENS_MARGIN_PX = 32


@dataclass(frozen=True, eq=False)
class Camera:
    """One simulated camera.

    Parameters
    ----------
    name
        The view's name: letters, digits, ``_`` and ``-``.
    width_px, height_px
        Size of the image [px], 16 to 8192.
    f_px
        Focal length [px], 10 to 1e6. The principal point is the middle of the image.
    camera_from_world
        (3, 4) rotation and translation [mm].
    k1
        Radial distortion, −1 to 1. The lens must reach the corners of the image.
    time_skew_s
        Delay of this camera's exposure relative to the rig's clock [s], −1 to 1.
    """

    name: str
    width_px: int
    height_px: int
    f_px: float
    camera_from_world: Array
    k1: float = 0.0
    time_skew_s: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not re.fullmatch(r"[\w-]+", self.name, re.ASCII):
            raise InvalidInputError(
                f"camera name is {self.name!r}; it must be letters, digits, _ and -"
            )
        checks.whole("width_px", self.width_px, 16, 8192)
        checks.whole("height_px", self.height_px, 16, 8192)
        checks.number("f_px", self.f_px, 10, 1e6)
        checks.number("k1", self.k1, -1, 1)
        checks.number("time_skew_s", self.time_skew_s, -1, 1)
        pose = finite_array(self.camera_from_world, "camera_from_world", (3, 4)).copy()
        rotation = pose[:, :3]
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9) or (
            np.linalg.det(rotation) < 0
        ):
            raise InvalidInputError(
                "camera_from_world[:, :3] is not a rotation; its rows must be orthonormal and "
                "right-handed"
            )
        pose.setflags(write=False)
        object.__setattr__(self, "camera_from_world", pose)
        corner = math.hypot(self.width_px / 2, self.height_px / 2) + LENS_MARGIN_PX
        reach = self._lens_radius
        if self.k1 < 0 and corner / self.f_px >= reach * (1 + self.k1 * reach**2):
            raise InvalidInputError(
                f"k1 is {self.k1:g} with f_px {self.f_px:g}; this lens folds over before it "
                f"reaches the corners of {self.width_px} × {self.height_px} px"
            )

    @property
    def principal_point_px(self) -> Array:
        """(2,) middle of the image [px]."""
        return np.array([(self.width_px - 1) / 2, (self.height_px - 1) / 2])

    @property
    def centre_mm(self) -> Array:
        """(3,) optical centre in the world [mm]."""
        return -self.camera_from_world[:, :3].T @ self.camera_from_world[:, 3]

    @cached_property
    def image_from_camera(self) -> Array:
        """(3, 3) intrinsic matrix of the ideal camera."""
        K = np.diag([self.f_px, self.f_px, 1.0])
        K[:2, 2] = self.principal_point_px
        return K

    @cached_property
    def image_from_world(self) -> Array:
        """(3, 4) matrix of the ideal camera: world mm → homogeneous ideal pixels."""
        return self.image_from_camera @ self.camera_from_world

    @cached_property
    def image_from_plane(self) -> Array:
        """(3, 3) homography T: plane mm → ideal pixels, with t33 = 1 (eq. 1 of the paper)."""
        T: Array = self.image_from_world[:, [0, 1, 3]]
        return np.asarray(T / T[2, 2])

    def project(self, points_mm: ArrayLike) -> Array:
        """Ideal pixels (..., 2) of world points (..., 3) in mm; NaN for points not in front."""
        return self.project_seen(self.seen(np.asarray(points_mm, dtype=np.float64)))

    def seen(self, points_mm: Array) -> Array:
        """Camera coordinates [mm] of world points (..., 3)."""
        R, t = self.camera_from_world[:, :3], self.camera_from_world[:, 3]
        return np.asarray(points_mm @ R.T + t, dtype=np.float64)

    def project_seen(self, points_mm: Array) -> Array:
        """Ideal pixels of points (..., 3) in camera coordinates; NaN for points not in front."""
        depth = np.where(points_mm[..., 2:] > 0, points_mm[..., 2:], np.nan)
        return points_mm[..., :2] / depth * self.f_px + self.principal_point_px

    def pictured(self, ideal_px: ArrayLike) -> Array:
        """Pictured pixels of ideal pixels (..., 2); NaN where the lens does not image them."""
        m = (np.asarray(ideal_px, dtype=np.float64) - self.principal_point_px) / self.f_px
        radius = np.hypot(m[..., 0], m[..., 1])
        scale = np.where(radius <= self._lens_radius, 1 + self.k1 * radius**2, np.nan)
        return m * scale[..., None] * self.f_px + self.principal_point_px

    def ideal(self, pictured_px: ArrayLike) -> Array:
        """Ideal pixels of pictured pixels (..., 2): the inverse of `pictured`, to rounding."""
        px = np.asarray(pictured_px, dtype=np.float64)
        ideal = self.ideal_everywhere(px)
        m = (ideal - self.principal_point_px) / self.f_px
        within = np.hypot(m[..., 0], m[..., 1]) <= self._lens_radius
        return np.where(within[..., None], ideal, np.nan)

    def pictured_everywhere(self, ideal_px: Array) -> Array:
        """`pictured`, continued straight beyond the lens's reach.

        Outlines leave the image; the straight continuation keeps what lies outside outside, where
        the polynomial of a barrel lens would fold it back into view.
        """
        if self.k1 == 0:
            return ideal_px
        m = (ideal_px - self.principal_point_px) / self.f_px
        radius = np.maximum(np.hypot(m[..., 0], m[..., 1]), 1e-12)
        scale = self._through_lens(radius) / radius
        return m * scale[..., None] * self.f_px + self.principal_point_px

    def ideal_everywhere(self, pictured_px: Array) -> Array:
        """Return the exact inverse of `pictured_everywhere`."""
        if self.k1 == 0:
            return pictured_px
        m = (pictured_px - self.principal_point_px) / self.f_px
        target = np.maximum(np.hypot(m[..., 0], m[..., 1]), 1e-12)
        reach = self._lens_radius
        radius = np.minimum(target, reach)
        # Newton's method on r·(1 + k1·r²) = target: for k1 < 0 it starts left of the root of a
        # concave function, for k1 > 0 right of the root of a convex one; it converges from both.
        for _ in range(50):
            step = (radius * (1 + self.k1 * radius**2) - target) / (1 + 3 * self.k1 * radius**2)
            radius = np.minimum(radius - step, reach)
            if np.abs(step).max() < 1e-15:
                break
        if math.isfinite(reach):
            edge, slope = reach * (1 + self.k1 * reach**2), 1 + 3 * self.k1 * reach**2
            radius = np.where(target > edge, reach + (target - edge) / slope, radius)
        return m * (radius / target)[..., None] * self.f_px + self.principal_point_px

    def contains(self, pictured_px: ArrayLike, border_px: float = 0.0) -> NDArray[np.bool_]:
        """Whether pictured pixels (..., 2) lie in the image, at least `border_px` from its edge."""
        px = np.asarray(pictured_px, dtype=np.float64)
        low = border_px - 0.5
        size = np.array([self.width_px, self.height_px])
        return np.asarray(((px >= low) & (px <= size - 1 - low)).all(axis=-1))

    @property
    def _lens_radius(self) -> float:
        """Normalised ideal radius up to which the lens model holds."""
        if self.k1 >= 0:
            return math.inf
        return min(USABLE_FOLD_FRACTION / math.sqrt(3 * -self.k1), WIDEST_RADIUS)

    def _through_lens(self, radius: Array) -> Array:
        """Radius behind the lens of an ideal radius, continued straight beyond the lens's reach."""
        within = np.minimum(radius, self._lens_radius)
        bent = within * (1 + self.k1 * within**2)
        return np.asarray(bent + (radius - within) * (1 + 3 * self.k1 * within**2))


@dataclass(frozen=True)
class Workspace:
    """The square on the working plane, and the reference points that define its coordinates.

    Plane coordinates are world X and Y in mm. The reference points are the corners (0, 0),
    (side, 0), (side, side), (0, side), followed, if there are more than four, by the other points
    of the grid, row by row.
    """

    side_mm: float = 400.0  # mm, 10…10,000
    points_per_side: int = 2  # 2…20; 2 is the four corners

    def __post_init__(self) -> None:
        checks.number("side_mm", self.side_mm, 10, 10_000)
        checks.whole("points_per_side", self.points_per_side, 2, 20)

    @property
    def points_mm(self) -> Array:
        """(N, 2) reference points on the plane [mm]."""
        last = self.points_per_side - 1
        corners = [(0, 0), (last, 0), (last, last), (0, last)]
        grid = [(i, j) for j in range(last + 1) for i in range(last + 1)]
        order = corners + [cell for cell in grid if cell not in corners]
        return np.array(order, dtype=np.float64) * (self.side_mm / last)


@dataclass(frozen=True)
class Placement:
    """Placement of the cameras: on a circle around the workspace, aimed at its middle.

    The defaults are the rig of Cipolla, Hadfield & Hollinghurst (1994): two cameras 2 m away and
    30° apart. Azimuth 0 is the side of the workspace's negative Y, positive to the right as seen
    from there.
    """

    distance_m: float = 2.0  # m from the aim, 0.1…20
    azimuths_deg: tuple[float, ...] = (-15.0, 15.0)  # deg, one per camera, −180…180
    elevation_deg: float = 42.0  # deg above the plane, 5…90
    width_px: int = 640  # px
    height_px: int = 480  # px
    f_px: float | None = None  # px; None: the workspace takes `workspace_fill` of the width
    workspace_fill: float = 0.65  # of the width, in the view where it is widest, 0.05…2
    aim_height_mm: float = 0.0  # mm, height of the aim above the workspace's middle, 0…1000
    k1: tuple[float, ...] = (0.0,)  # radial distortion, one for all or one per camera, −1…1
    time_skews_s: tuple[float, ...] = (0.0,)  # s after the rig's clock, one for all or per camera

    def __post_init__(self) -> None:
        checks.number("distance_m", self.distance_m, 0.1, 20)
        if not isinstance(self.azimuths_deg, tuple) or not self.azimuths_deg:
            raise InvalidInputError(
                f"azimuths_deg is {self.azimuths_deg!r}; it must be a tuple of one angle per camera"
            )
        for i, azimuth in enumerate(self.azimuths_deg):
            checks.number(f"azimuths_deg[{i}]", azimuth, -180, 180)
        checks.number("elevation_deg", self.elevation_deg, 5, 90)
        if self.f_px is not None:
            checks.number("f_px", self.f_px, 10, 1e6)
        checks.number("workspace_fill", self.workspace_fill, 0.05, 2)
        checks.number("aim_height_mm", self.aim_height_mm, 0, 1000)
        self._per_camera("k1", self.k1)
        self._per_camera("time_skews_s", self.time_skews_s)

    @classmethod
    def webcams(cls) -> "Placement":
        """Two webcams close by: 0.75 m away, 30° apart, f = 622 px at 640 × 480."""
        return cls(distance_m=0.75, f_px=622.0)

    def cameras(self, workspace: Workspace) -> tuple[Camera, ...]:
        """Return the cameras, named ``left`` and ``right`` if they are two, else ``view0``, …."""
        count = len(self.azimuths_deg)
        names = ["left", "right"] if count == 2 else [f"view{i}" for i in range(count)]
        if count == 2 and self.azimuths_deg[0] > self.azimuths_deg[1]:
            names.reverse()
        k1 = self._per_camera("k1", self.k1)
        skews = self._per_camera("time_skews_s", self.time_skews_s)
        pinholes = [
            Camera(
                name=names[i],
                width_px=self.width_px,
                height_px=self.height_px,
                f_px=1e6 if self.f_px is None else self.f_px,
                camera_from_world=self._camera_from_world(azimuth, workspace),
            )
            for i, azimuth in enumerate(self.azimuths_deg)
        ]
        f_px = self._filling_f_px(pinholes, workspace) if self.f_px is None else self.f_px
        return tuple(
            replace(camera, f_px=f_px, k1=k1[i], time_skew_s=skews[i])
            for i, camera in enumerate(pinholes)
        )

    def _per_camera(self, name: str, values: tuple[float, ...]) -> tuple[float, ...]:
        count = len(self.azimuths_deg)
        if not isinstance(values, tuple) or len(values) not in (1, count):
            raise InvalidInputError(
                f"{name} is {values!r}; it must be a tuple of one value, or of one for each of the "
                f"{count} cameras"
            )
        each = [checks.number(f"{name}[{i}]", value, -1, 1) for i, value in enumerate(values)]
        return tuple(each * count if len(each) == 1 else each)

    def _camera_from_world(self, azimuth_deg: float, workspace: Workspace) -> Array:
        azimuth, elevation = math.radians(azimuth_deg), math.radians(self.elevation_deg)
        outwards = np.array(
            [
                math.cos(elevation) * math.sin(azimuth),
                -math.cos(elevation) * math.cos(azimuth),
                math.sin(elevation),
            ]
        )
        right = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
        rotation = np.stack([right, np.cross(-outwards, right), -outwards])
        middle = workspace.side_mm / 2
        aim = np.array([middle, middle, self.aim_height_mm])
        centre = aim + outwards * self.distance_m * 1000
        return np.hstack([rotation, (-rotation @ centre)[:, None]])

    def _filling_f_px(self, cameras: list[Camera], workspace: Workspace) -> float:
        corners = np.pad(workspace.points_mm[:4], ((0, 0), (0, 1)))
        widths = [np.ptp(camera.project(corners)[:, 0]) / camera.f_px for camera in cameras]
        widest = max(widths)
        if not np.isfinite(widest):
            raise InvalidInputError(
                f"distance_m is {self.distance_m:g}; a camera stands too close to see all of the "
                f"{workspace.side_mm:g} mm workspace"
            )
        return float(self.workspace_fill * self.width_px / widest)
