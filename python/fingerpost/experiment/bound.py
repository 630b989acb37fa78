"""The Cramér–Rao bound: least error of an unbiased estimate from a given picture.

A step edge of contrast A behind a Gaussian blur σ_b and a pixel's aperture, in white noise σ_n,
determines its position across itself with the Fisher information, per pixel of contour,

    I = A² / (2 √π · s · σ_n²),   s² = σ_b² + 1/12.

The model of the hand is two straight, independent flanks: a flank on side σ = ±1 lies
``σ (d + ϑ p) + w₀ + w₁ p`` outwards at the abscissa p along the finger, where the axis's offset d
and angle ϑ are to be estimated and the width w₀ and taper w₁ are unknown. With
``J = (σ, σ p, 1, p)`` the information on the four is ``∫ I · J Jᵀ ds`` over the visible parts of
both flanks: inside the image, and without overlap of the thumb. Its inverse bounds (d, ϑ). The axes
of all views then bound the indicated point to first order, as in `fingerpost.uncertainty`, at the
true point and with the reference points' covariance.

The bound is for one picture of each view and a uniformly bright finger on a plain table. A tracker
with more information (the finger's width, earlier pictures) may be better; with shading the true
bound is different.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerpost.pointing import PlaneView
from fingerpost.simulate import Camera, DevicePose, FingerTruth
from fingerpost.simulate.device import Body
from fingerpost.simulate.occlusion import CONTOUR_STEP_PX, visible_contour
from fingerpost.uncertainty import constraint_lines, intersect

# Distance of contour points from their flank; a lens bends it by less between two vertices.
_ON_FLANK_PX = 1e-3
# Shorter pieces of a flank determine no direction.
_LEAST_FLANK_PX = 2.0


@dataclass(frozen=True, eq=False, slots=True)
class LineBound:
    """Least covariance of one view's finger line.

    Attributes
    ----------
    anchor_px : (2,)
        The middle of the flanks, on the exact axis [ideal px].
    angle_rad
        Angle of the exact axis [rad].
    covariance : (2, 2)
        Covariance of offset [px] at the anchor and angle [rad].
    """

    anchor_px: NDArray[np.float64]
    angle_rad: float
    covariance: NDArray[np.float64]

    def at(self, point_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the covariance of the offset at another abscissa, and of the angle."""
        along = (point_px - self.anchor_px) @ (math.cos(self.angle_rad), math.sin(self.angle_rad))
        shift = np.array([[1.0, along], [0.0, 1.0]])
        return np.asarray(shift @ self.covariance @ shift.T)


def edge_information(contrast: float, noise: float, blur_px: float) -> float:
    """Fisher information on an edge's position along its normal, per pixel of contour [px⁻³].

    Parameters
    ----------
    contrast
        Step of the edge [grey levels].
    noise
        Standard deviation of the white noise [grey levels], > 0.
    blur_px
        Standard deviation of the Gaussian point spread function [px], ≥ 0.
    """
    spread_px = math.hypot(blur_px, 12**-0.5)
    return contrast**2 / (2.0 * math.sqrt(math.pi) * spread_px * noise**2)


def line_bound(
    camera: Camera, body: Body, pose: DevicePose, finger: FingerTruth, information: float
) -> LineBound | None:
    """Least covariance of the axis of a finger in one view.

    Parameters
    ----------
    camera, body, pose
        The rendered view.
    finger
        Truth of the finger in this view.
    information
        Result of `edge_information`.

    Returns
    -------
    LineBound or None
        None unless both flanks are visible in part.
    """
    contour = camera.ideal(visible_contour(camera, body, pose)[0])
    anchor = finger.flanks_px.mean(axis=(0, 1))
    along = np.array([math.cos(finger.axis_angle_rad), math.sin(finger.axis_angle_rad)])
    moments = []
    for base, tip in finger.flanks_px:
        flank = (tip - base) / np.linalg.norm(tip - base)
        place, across = np.array([flank, (-flank[1], flank[0])]) @ (contour - base).T
        within = (place >= 0.0) & ((contour - tip) @ flank <= 0.0)
        on_flank = within & (abs(across) < _ON_FLANK_PX)
        p = (contour[on_flank] - anchor) @ along
        if len(p) * CONTOUR_STEP_PX < _LEAST_FLANK_PX:
            return None
        # The motion of a flank along its own normal is that along the axis's normal times the
        # cosine of the angle between them.
        step = (flank @ along) ** 2 * CONTOUR_STEP_PX
        moments.append([step * (p**power).sum() for power in (0, 1, 2)])
    covariance = axis_covariance(np.array(moments), information)
    return LineBound(anchor, finger.axis_angle_rad, covariance)


def axis_covariance(
    flank_moments_px: NDArray[np.float64], information: float
) -> NDArray[np.float64]:
    """Least covariance of an axis between two free flanks.

    Parameters
    ----------
    flank_moments_px : (..., 2, 3)
        ``∫ (1, p, p²) ds`` over the visible stretches of the left and of the right flank, with p
        from the anchor along the axis [px, px², px³].
    information
        Result of `edge_information`.

    Returns
    -------
    (..., 2, 2)
        Covariance of offset [px] at the anchor and angle [rad].
    """
    m0, m1, m2 = np.moveaxis(flank_moments_px, -1, 0)
    straight = np.stack([np.stack([m0, m1], axis=-1), np.stack([m1, m2], axis=-1)], axis=-1)
    # J = (σ, σ p, 1, p) gives four blocks of the same moments: of d and ϑ, of w₀ and w₁, and mixed
    # ones, in which the flanks' moments have opposite signs.
    both, between = straight.sum(axis=-3), straight[..., 1, :, :] - straight[..., 0, :, :]
    hidden = between @ np.linalg.solve(both, between)
    return np.asarray(np.linalg.inv(information * (both - hidden)))


def point_bound(
    plane_views: Sequence[PlaneView], line_bounds: Sequence[LineBound]
) -> NDArray[np.float64] | None:
    """Least covariance of the indicated point.

    Parameters
    ----------
    plane_views
        The N ≥ 2 views, from exact reference points with the covariance of the noisy ones.
    line_bounds
        One per view.

    Returns
    -------
    (2, 2) or None
        Plane units²; None if the exact constraint lines are parallel.
    """
    T = np.array([view.image_from_plane for view in plane_views])
    Σ_T = np.array([view.entries_covariance for view in plane_views])
    anchor = np.array([bound.anchor_px for bound in line_bounds])
    angle = np.array([bound.angle_rad for bound in line_bounds])
    covariance = np.array([bound.covariance for bound in line_bounds])
    least = intersect(*constraint_lines(T, Σ_T, anchor, angle, covariance)).covariance
    return least if np.isfinite(least).all() else None
