"""Recovery of a camera's pose and focal length from its view of the plane.

The projection of a hand above the plane requires more than the homography of eq. 1: the camera's
pose and field of view. For a pinhole with square pixels the homography is ``T ∝ K [r₁ r₂ t]``, and
``r₁, r₂`` are orthogonal and of equal length, which gives two equations for the unknowns in ``K``
(Zhang 2000); with a principal point near the image centre, one determines the focal length. Their
accuracy depends on the view: if a camera looks straight down, there is no perspective, and every
focal length fits.

Focal length, principal point and pose are therefore estimated jointly, as the maximum a posteriori
of the reference points and priors on cameras (`FOCAL_PRIOR`, `PRINCIPAL_POINT_PRIOR`): the data
dominate where they determine the camera, else the priors do, as `PlaneCamera.focal_sigma` shows. If
the rig file gives a lens, only the pose is estimated.

The third coordinate is the height above the plane on the side of the camera, regardless of the
orientation of the plane's axes: plane coordinates may be left-handed when seen from above
(`PlaneCamera.mirrored`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.checks import finite_array, in_range
from fingerpost.homography import normalising_similarity
from fingerpost.lens import Lens
from fingerpost.pointing import PlaneView

Array = NDArray[np.float64]

FOCAL_PRIOR = (1.1, math.log(2.0))
"""Prior of an unknown focal length, relative to the longer side of the image (a field of view of
49°), and standard deviation of its logarithm: 26° to 85° are within one."""

PRINCIPAL_POINT_PRIOR = 0.02
"""Standard deviation of the principal point from the image centre, in u and in v, relative to the
longer side."""

USABLE_FOCAL_SIGMA = 0.2
"""Relative standard deviation above which a view does not determine its own focal length."""

LARGEST_PX = 100_000
"""Longest side of an image."""

_MAX_ITERATIONS = 200
_CONVERGED_STEP = 1e-10
_LARGEST_DAMPING = 1e12


@dataclass(frozen=True, eq=False)
class PlaneCamera:
    """A camera over the working plane.

    Attributes
    ----------
    size_px
        Width and height of its image.
    focal_px : (2,)
        Focal lengths along u and v; equal unless a lens says otherwise.
    principal_point_px : (2,)
        Intersection of the optical axis with the image.
    camera_from_plane : (3, 4)
        Transform from plane coordinates and height ``(X, Y, height)`` to the camera's (right, down,
        forwards), in plane units. Its rotation is a reflection if `mirrored`.
    lens
        Distortion of the view, if known.
    focal_sigma
        Relative standard deviation of the focal length; 0 if a lens gives it. If it is close to
        that of `FOCAL_PRIOR`, the focal length is assumed rather than measured.
    misfit
        χ² per degree of freedom of reference points and priors, about 1 for a valid camera. Far
        above, the plane's coordinates are not to scale or the image is cropped.
    mirrored
        Whether plane coordinates turn clockwise from X to Y as seen by the camera from above.
    """

    size_px: tuple[int, int]
    focal_px: Array
    principal_point_px: Array
    camera_from_plane: Array
    lens: Lens | None
    focal_sigma: float
    misfit: float
    mirrored: bool

    @property
    def centre(self) -> Array:
        """(3,) Camera centre: X, Y and height [plane units]."""
        return np.asarray(-self.camera_from_plane[:, :3].T @ self.camera_from_plane[:, 3])

    @property
    def axis(self) -> Array:
        """(3,) Unit vector of the optical axis."""
        return self.camera_from_plane[2, :3]

    @property
    def image_from_plane(self) -> Array:
        """(3, 3) homography of eq. 1 into the ideal pinhole's pixels."""
        K = np.diag([*self.focal_px, 1.0])
        K[:2, 2] = self.principal_point_px
        return np.asarray(K @ self.camera_from_plane[:, [0, 1, 3]])

    def project(self, points: Array) -> Array:
        """Ideal pixels (..., 2) of points (..., 3); NaN where not in front of the camera."""
        seen = points @ self.camera_from_plane[:, :3].T + self.camera_from_plane[:, 3]
        depth = np.where(seen[..., 2:] > 0.0, seen[..., 2:], np.nan)
        return np.asarray(seen[..., :2] / depth * self.focal_px + self.principal_point_px)

    def shows(self, ideal_px: Array, border_px: float = 0.0) -> NDArray[np.bool_]:
        """Whether ideal pixels (..., 2) lie in the image, at least `border_px` from its edge."""
        pictured = ideal_px
        if self.lens is not None:
            seen = np.isfinite(ideal_px).all(axis=-1, keepdims=True)
            pictured = self.lens.distort(np.where(seen, ideal_px, 0.0))
            pictured = np.where(seen, pictured, np.nan)
        low = border_px - 0.5
        inside = (pictured >= low) & (pictured <= np.array(self.size_px) - 1.0 - low)
        return np.asarray(inside.all(axis=-1))

    def px_per_unit(self, point: Array) -> float:
        """Image length of a unit at a point (3,) perpendicular to the viewing ray [px]."""
        depth = float(self.axis @ (point - self.centre))
        return float(self.focal_px.mean()) / depth

    def moved(self, plane_from_plane: Array, about: Array) -> PlaneCamera:
        """Return the camera, rotated and scaled about a point.

        Parameters
        ----------
        plane_from_plane : (3, 3)
            Rotation, times a factor of the distance, of the camera about `about` (3,).
        """
        scale = np.cbrt(np.linalg.det(plane_from_plane))
        rotation = self.camera_from_plane[:, :3] @ plane_from_plane.T / scale
        centre = about + plane_from_plane @ (self.centre - about)
        return replace(self, camera_from_plane=np.column_stack([rotation, -rotation @ centre]))

    def zoomed(self, factor: float) -> PlaneCamera:
        """Return the camera with a longer focal length, whose lens is then unknown."""
        return replace(self, focal_px=self.focal_px * factor, lens=None)


def recover_camera(
    plane_view: PlaneView,
    image_points_px: ArrayLike,
    size_px: tuple[int, int],
    *,
    sigma_px: float,
) -> PlaneCamera:
    """Estimate the camera from the reference points of a view.

    Parameters
    ----------
    plane_view
        The view, from its reference points.
    image_points_px : (N, 2)
        Their images, in the order of ``plane_view.plane_points``, with lens distortion.
    size_px
        Width and height of the image, up to `LARGEST_PX`.
    sigma_px
        Standard deviation of each image point in u and in v [px], > 0.

    Returns
    -------
    PlaneCamera

    Raises
    ------
    InvalidInputError
        A size out of range, points that do not belong to the view, or points inconsistent with any
        camera: coordinates that are far from true to scale.
    """
    width, height = (in_range(side, "size_px", 1.0, LARGEST_PX) for side in size_px)
    sigma = in_range(sigma_px, "sigma_px", np.finfo(np.float64).tiny)
    given = finite_array(image_points_px, "image_points_px", plane_view.plane_points.shape)
    lens = plane_view.lens
    x = given if lens is None else lens.undistort(given)
    longer = max(width, height)
    problem = _Problem(
        plane=plane_view.plane_points,
        image_px=x,
        sigma_px=sigma,
        middle_px=np.array([(width - 1.0) / 2.0, (height - 1.0) / 2.0]),
        focal_px=FOCAL_PRIOR[0] * longer,
        offset_sigma_px=PRINCIPAL_POINT_PRIOR * longer,
        lens=lens,
    )
    found = [problem.solved(start) for start in problem.starts(plane_view.image_from_plane)]
    best = min(found, key=lambda state: problem.cost(state))
    covariance = np.linalg.inv(problem.normal_matrix(best))
    focal, centre = problem.intrinsics(best)
    rotation = best.pose[:, :3]
    shift = best.pose[:, 3] - rotation[:, :2] @ problem.plane.mean(axis=0)
    return PlaneCamera(
        size_px=(int(width), int(height)),
        focal_px=focal,
        principal_point_px=centre,
        camera_from_plane=np.column_stack([rotation, shift]),
        lens=lens,
        focal_sigma=math.sqrt(covariance[0, 0]) if lens is None else 0.0,
        misfit=problem.cost(best) / max(problem.freedom, 1),
        mirrored=bool(np.linalg.det(rotation) < 0.0),
    )


@dataclass(frozen=True, eq=False)
class _State:
    """Focal length and principal point relative to their priors, and the pose."""

    log_focal: float
    offset_px: Array
    pose: Array  # (3, 4), from plane coordinates about the reference points' centroid


@dataclass(frozen=True, eq=False)
class _Problem:
    """Least-squares problem of the camera: residuals of the reference points, then priors."""

    plane: Array
    image_px: Array
    sigma_px: float
    middle_px: Array
    focal_px: float
    offset_sigma_px: float
    lens: Lens | None

    @cached_property
    def unit(self) -> float:
        """Unit of length of the camera's translation [plane units]."""
        return float(1.0 / normalising_similarity(self.plane)[0, 0])

    @cached_property
    def points(self) -> Array:
        """(N, 3) reference points about their centroid, at height 0 [plane units]."""
        return np.pad(self.plane - self.plane.mean(axis=0), ((0, 0), (0, 1)))

    @property
    def freedom(self) -> int:
        """Degrees of freedom; priors count as equations."""
        return 2 * len(self.plane) - 6

    def intrinsics(self, state: _State) -> tuple[Array, Array]:
        """Focal lengths and principal point [px]."""
        if self.lens is not None:
            lens = self.lens
            return np.array([lens.fx, lens.fy]), np.array([lens.cx, lens.cy])
        focal = self.focal_px * math.exp(state.log_focal)
        return np.full(2, focal), self.middle_px + state.offset_px

    def starts(self, image_from_plane: Array) -> list[_State]:
        """Return initial cameras: the solution of a homography's two equations, and the prior."""
        plane_from_centred = np.eye(3)
        plane_from_centred[:2, 2] = self.plane.mean(axis=0)
        T = image_from_plane @ plane_from_centred
        if self.lens is not None:
            return [self._posed(0.0, T)]
        shift = np.eye(3)
        shift[:2, 2] = -self.middle_px
        h1, h2, _ = (shift @ T).T
        # ω = diag(f⁻², f⁻², 1): h₁ᵀ ω h₂ = 0 and h₁ᵀ ω h₁ = h₂ᵀ ω h₂ are linear in f⁻².
        slopes = np.array([h1[:2] @ h2[:2], (h1[:2] @ h1[:2] - h2[:2] @ h2[:2]) / 2.0])
        levels = np.array([h1[2] * h2[2], (h1[2] ** 2 - h2[2] ** 2) / 2.0])
        usual = [math.log(factor) for factor in (0.5, 1.0, 2.5)]
        squared = slopes @ slopes
        inverse = -(slopes @ levels) / squared if squared > 0.0 else 0.0
        if inverse > 0.0:
            log_focal = -0.5 * math.log(inverse * self.focal_px**2)
            if abs(log_focal) < 10.0 * FOCAL_PRIOR[1]:
                usual.insert(0, log_focal)
        return [self._posed(log_focal, T) for log_focal in usual]

    def _posed(self, log_focal: float, T: Array) -> _State:
        """Nearest pose to ``K⁻¹ T``."""
        state = _State(log_focal, np.zeros(2), np.eye(3, 4))
        focal, centre = self.intrinsics(state)
        K = np.diag([*focal, 1.0])
        K[:2, 2] = centre
        columns = np.linalg.solve(K, T)
        columns /= np.sqrt(np.linalg.norm(columns[:, 0]) * np.linalg.norm(columns[:, 1]))
        if columns[2, 2] < 0.0:
            columns = -columns  # the plane is in front
        first, second = columns[:, 0], columns[:, 1]
        # The height is positive towards the camera: its centre −Rᵀt is at r₃·t < 0.
        up = np.cross(first, second)
        up *= -np.copysign(1.0, up @ columns[:, 2])
        U, _, Vt = np.linalg.svd(np.column_stack([first, second, up]))
        return _State(log_focal, np.zeros(2), np.column_stack([U @ Vt, columns[:, 2]]))

    def residuals(self, state: _State) -> tuple[Array, Array]:
        """Whitened residuals, and their derivative by a step of the parameters.

        The parameters are the logarithm of the focal length, the principal point [px], a rotation
        of the camera [rad] and a translation [mean distance of the reference points]; with a lens,
        only the last two.
        """
        focal, centre = self.intrinsics(state)
        turned = self.points @ state.pose[:, :3].T
        seen = turned + state.pose[:, 3]
        depth = seen[:, 2:]
        ray = seen[:, :2] / depth
        off = (self.image_px - ray * focal - centre) / self.sigma_px

        by_seen = np.zeros((len(seen), 2, 3))
        by_seen[:, 0, 0], by_seen[:, 1, 1] = focal[0], focal[1]
        by_seen[:, :, 2] = -ray * focal
        by_seen /= depth[..., None]
        by_turn = -by_seen @ _cross_matrix(turned)
        by_shift = by_seen * self.unit
        by_focal = (ray * focal)[..., None]
        by_centre = np.broadcast_to(np.eye(2), (len(seen), 2, 2))
        jacobian = np.concatenate([by_focal, by_centre, by_turn, by_shift], axis=2)
        jacobian = jacobian.reshape(-1, 9) / self.sigma_px
        if self.lens is not None:
            return off.ravel(), jacobian[:, 3:]
        known = np.append(state.log_focal / FOCAL_PRIOR[1], state.offset_px / self.offset_sigma_px)
        beliefs = np.zeros((3, 9))
        beliefs[0, 0] = 1.0 / FOCAL_PRIOR[1]
        beliefs[1, 1] = beliefs[2, 2] = 1.0 / self.offset_sigma_px
        return np.append(off.ravel(), -known), np.concatenate([jacobian, beliefs])

    def stepped(self, state: _State, step: Array) -> _State:
        """Take a step of the parameters."""
        if self.lens is not None:
            step = np.append(np.zeros(3), step)
        rotation = rotation_by(step[3:6]) @ state.pose[:, :3]
        shift = state.pose[:, 3] + step[6:] * self.unit
        return _State(
            state.log_focal + float(step[0]),
            state.offset_px + step[1:3],
            np.column_stack([rotation, shift]),
        )

    def cost(self, state: _State) -> float:
        """χ²; infinite where a point lies behind the camera."""
        seen = self.points @ state.pose[:, :3].T + state.pose[:, 3]
        if not (seen[:, 2] > 0.0).all():
            return math.inf
        residuals, _ = self.residuals(state)
        return float(residuals @ residuals)

    def normal_matrix(self, state: _State) -> Array:
        """Information on the parameters."""
        _, jacobian = self.residuals(state)
        return np.asarray(jacobian.T @ jacobian)

    def solved(self, state: _State) -> _State:
        """Levenberg-Marquardt."""
        cost, damping = self.cost(state), 1e-3
        for _ in range(_MAX_ITERATIONS):
            residuals, jacobian = self.residuals(state)
            information = jacobian.T @ jacobian
            while damping < _LARGEST_DAMPING:
                damped = information + damping * np.diag(np.diagonal(information))
                step = np.linalg.solve(damped, jacobian.T @ residuals)
                following = self.stepped(state, np.asarray(step, np.float64))
                following_cost = self.cost(following)
                if following_cost <= cost:
                    break
                damping *= 4.0
            else:
                return state
            state, cost, damping = following, following_cost, damping / 10.0
            if np.abs(step[-6:-3]).max() < _CONVERGED_STEP and np.abs(step).max() < 1e-8:
                return state
        return state


def _cross_matrix(vectors: Array) -> Array:
    """Matrices (N, 3, 3) of the cross product with vectors (N, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)


def rotation_by(vector: Array) -> Array:
    """Return the rotation (3, 3) about a vector, by its length in radians (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    (cross,) = _cross_matrix(vector[None])
    if angle < 1e-12:
        return np.asarray(np.eye(3) + cross)
    return np.asarray(
        np.eye(3)
        + math.sin(angle) / angle * cross
        + (1.0 - math.cos(angle)) / angle**2 * cross @ cross
    )
