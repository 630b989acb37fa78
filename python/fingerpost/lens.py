"""Radial lens distortion, and its removal from points and finger lines.

A pinhole maps the plane by a homography and lines to lines; a lens does not. All measurements in a
view, both reference points and finger lines, are therefore moved to their images in a pinhole with
the same ``fx, fy, cx, cy`` before any geometry. Correcting only one of the two is no better than
correcting neither, because their errors partly cancel.

Model: the lens maps an undistorted direction ``m`` with ``r = |m|`` to ``m (1 + k1 r² + k2 r⁴)``
(Brown 1971, radial terms, as OpenCV's ``k1, k2``). The map of radii
``ρ(r) = r (1 + k1 r² + k2 r⁴)`` increases only up to a radius where ``1 + 3 k1 r² + 5 k2 r⁴ = 0``;
beyond it the model folds back and describes no lens. Results for such points are NaN.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.checks import covariance_array, finite_array, in_range

_TINY = float(np.finfo(np.float64).tiny)
_LARGEST = float(np.finfo(np.float64).max)

# Real lenses stay below 1; the limit only keeps powers of the radius finite.
_MAX_COEFFICIENT = 100.0

# Below the fold 1 + k1 r² + k2 r⁴ exceeds 4/9 for any k1 and k2: its smallest value there is
# 1 − k1²/(4 k2) with k1² < 20 k2/9 (no fold), and larger with a fold. It brackets the radius.
_LEAST_STRETCH = 4.0 / 9.0

# Newton's method takes about five steps, bisection near the fold some thirty more.
_MAX_ITERATIONS = 100
_CONVERGED_SHARE = 4e-16


@dataclass(frozen=True)
class Lens:
    """Pinhole and radial distortion of one view.

    Parameters
    ----------
    fx, fy
        Focal lengths [px], positive.
    cx, cy
        Principal point [px]; pixel (0, 0) is the centre of the top-left pixel.
    k1, k2
        Radial distortion [1], from −100 to 100; barrel distortion has ``k1 < 0``.

    Raises
    ------
    InvalidInputError
        A value outside its range, or not finite.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float = 0.0
    _max_radius: float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("fx", "fy"):
            in_range(getattr(self, name), f"lens {name}", _TINY, _LARGEST)
        for name in ("cx", "cy"):
            in_range(getattr(self, name), f"lens {name}", -_LARGEST, _LARGEST)
        for name in ("k1", "k2"):
            in_range(getattr(self, name), f"lens {name}", -_MAX_COEFFICIENT, _MAX_COEFFICIENT)
        object.__setattr__(self, "_max_radius", _fold_radius(self.k1, self.k2))

    @property
    def radial(self) -> tuple[float, float, float, float, float, float, float]:
        """fx, fy, cx, cy, k1, k2, and the radius of the fold, which may be infinite."""
        return self.fx, self.fy, self.cx, self.cy, self.k1, self.k2, self._max_radius

    def distort(self, points_px: ArrayLike) -> NDArray[np.float64]:
        """Map pixels of the pinhole to pixels of the lens's image.

        Parameters
        ----------
        points_px : (..., 2)
            Pixels of the pinhole.

        Returns
        -------
        (..., 2)
            Pixels of the image; NaN beyond the fold.
        """
        m = self._direction(points_px)
        r2 = (m**2).sum(axis=-1, keepdims=True)
        inside = r2 < self._max_radius**2
        return self._pixel(np.where(inside, m * self._stretch(r2), np.nan))

    def distort_jacobian(self, points_px: ArrayLike) -> NDArray[np.float64]:
        """Differentiate `distort`.

        Parameters
        ----------
        points_px : (..., 2)
            Pixels of the pinhole.

        Returns
        -------
        (..., 2, 2)
            Symmetric up to ``fx / fy``; NaN beyond the fold.
        """
        m = self._direction(points_px)
        r2 = (m**2).sum(axis=-1)[..., None, None]
        growth = 2.0 * self.k1 + 4.0 * self.k2 * r2
        jacobian = self._stretch(r2) * np.eye(2) + growth * m[..., :, None] * m[..., None, :]
        jacobian *= np.array([[1.0, self.fx / self.fy], [self.fy / self.fx, 1.0]])
        return np.where(r2 < self._max_radius**2, jacobian, np.nan)

    def undistort(self, points_px: ArrayLike) -> NDArray[np.float64]:
        """Map pixels of the lens's image to pixels of the pinhole.

        Solves ``ρ(r) = |n|`` for the radius by Newton's method inside a bracket. (The usual fixed
        point iteration ``m ← n / (1 + k1 |m|²)`` has the same solution, but converges slowly near
        the fold and diverges for strong pincushion distortion.)

        Parameters
        ----------
        points_px : (..., 2)
            Pixels of the image.

        Returns
        -------
        (..., 2)
            Pixels of the pinhole; NaN where the model has no such point.
        """
        n = self._direction(points_px)
        rho = np.hypot(n[..., 0], n[..., 1])
        r = self._undistorted_radius(rho)
        share = np.divide(r, rho, out=np.ones_like(r), where=rho > 0.0)
        return self._pixel(n * share[..., None])

    def undistort_jacobian(self, points_px: ArrayLike) -> NDArray[np.float64]:
        """Differentiate `undistort`: invert `distort_jacobian` at the undistorted point.

        Parameters
        ----------
        points_px : (..., 2)
            Pixels of the image.

        Returns
        -------
        (..., 2, 2)
            NaN where `undistort` is.
        """
        return self._undistort_jacobian_at(self.undistort(points_px))

    def _undistort_jacobian_at(self, undistorted: NDArray[np.float64]) -> NDArray[np.float64]:
        """Differentiate `undistort` where its results are these points."""
        known = np.isfinite(undistorted)
        centre = np.array([self.cx, self.cy])
        inverse = np.linalg.inv(self.distort_jacobian(np.where(known, undistorted, centre)))
        return np.where(known[..., None], inverse, np.nan)

    def undistort_line(
        self,
        anchor_px: ArrayLike,
        angle_rad: float,
        covariance: ArrayLike,
        half_length_px: float,
        middle_px: float = 0.0,
    ) -> tuple[NDArray[np.float64], float, NDArray[np.float64]]:
        """Return the pinhole's image of a straight body from a line fitted to the lens's image.

        The image of a straight finger is slightly curved, and the line fitted to it intersects the
        curve where a least-squares line intersects a parabola: at ``± half_length / √3`` from the
        middle (the two Gauss-Legendre nodes). These two points, unlike the anchor, lie on the
        image; they are undistorted, and the new line passes through them.

        Parameters
        ----------
        anchor_px : (2,)
            Point of the line.
        angle_rad
            Direction of the line in the image.
        covariance : (2, 2)
            Of (offset along the normal [px], angle [rad]) at the anchor.
        half_length_px
            Half the length of the segment that the line was fitted to, > 0.
        middle_px
            Distance from the anchor forward to the middle of that segment.

        Returns
        -------
        anchor_px : (2,)
            Midpoint of the moved points.
        angle_rad : float
        covariance : (2, 2)
            First order, at the new anchor.
            All three are NaN if the line leaves the domain of the lens model.
        """
        anchor = finite_array(anchor_px, "anchor_px", (2,))
        angle = float(finite_array(angle_rad, "angle_rad", ()))
        covariance = covariance_array(covariance, "covariance", (2, 2))
        half = in_range(half_length_px, "half_length_px", _TINY, _LARGEST)
        middle = in_range(middle_px, "middle_px", -_LARGEST, _LARGEST)
        tangent = np.array([np.cos(angle), np.sin(angle)])
        normal = np.array([-tangent[1], tangent[0]])
        lever = middle + np.array([-1.0, 1.0]) * half / np.sqrt(3.0)
        on_image = anchor + lever[:, None] * tangent
        undistorted = self.undistort(on_image)
        near, far = undistorted
        new_tangent = far - near
        length = np.hypot(*new_tangent)
        new_normal = np.array([-new_tangent[1], new_tangent[0]]) / length
        # Derivative of each moved point's distance from the new line by the old (offset, angle).
        leave = (self._undistort_jacobian_at(undistorted) @ normal) @ new_normal
        leave = leave[:, None] * np.column_stack([np.ones(2), lever])
        jacobian = np.stack([leave.mean(axis=0), (leave[1] - leave[0]) / length])
        return (
            (near + far) / 2,
            float(np.arctan2(new_tangent[1], new_tangent[0])),
            jacobian @ covariance @ jacobian.T,
        )

    def _direction(self, points_px: ArrayLike) -> NDArray[np.float64]:
        points_px = finite_array(points_px, "points_px", (..., 2))
        return np.asarray((points_px - [self.cx, self.cy]) / [self.fx, self.fy])

    def _pixel(self, direction: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(direction * [self.fx, self.fy] + [self.cx, self.cy])

    def _undistorted_radius(self, rho: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the root of ``ρ(r) = rho`` below the fold; NaN where there is none."""
        if np.isfinite(self._max_radius):
            reach = self._max_radius * self._stretch(np.array(self._max_radius**2))
            rho = np.where(rho < reach, rho, np.nan)
        low, high = np.zeros_like(rho), np.minimum(rho / _LEAST_STRETCH, self._max_radius)
        r = np.minimum(rho, high)
        for _ in range(_MAX_ITERATIONS):
            r2 = r**2
            excess = r * self._stretch(r2) - rho
            low, high = np.where(excess <= 0.0, r, low), np.where(excess >= 0.0, r, high)
            slope = 1.0 + r2 * (3.0 * self.k1 + 5.0 * r2 * self.k2)
            newton = r - np.divide(excess, slope, out=np.full_like(r, np.inf), where=slope > 0.0)
            following = np.where((newton >= low) & (newton <= high), newton, (low + high) / 2)
            moved = np.abs(following - r)
            r = following
            if not np.any(moved > _CONVERGED_SHARE * r):
                break
        return r

    def _stretch(self, r2: NDArray[np.float64]) -> NDArray[np.float64]:
        return 1.0 + r2 * (self.k1 + r2 * self.k2)


def _fold_radius(k1: float, k2: float) -> float:
    """Return the smallest root of ``1 + 3 k1 r² + 5 k2 r⁴ = 0``; infinite if there is none."""
    if k2 == 0.0:
        return float(np.sqrt(-1.0 / (3.0 * k1))) if k1 < 0.0 else np.inf
    discriminant = 9.0 * k1**2 - 20.0 * k2
    if discriminant < 0.0:
        return np.inf
    # The citardauq form is exact for the small root even if k2 is tiny.
    halves = (-3.0 * k1 + np.sqrt(discriminant), -3.0 * k1 - np.sqrt(discriminant))
    roots = [2.0 / half for half in halves if half > 0.0]
    return float(np.sqrt(min(roots))) if roots else np.inf
