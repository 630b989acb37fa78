"""Predicted covariance of the indicated point of a pose.

A pose of the finger is projected into every recovered camera. The covariance of its line there is
the bound for two straight flanks of that length in pixels (`fingerpost.experiment.bound`), divided
by the tracker's efficiency; the rest is `fingerpost.pointing.indicated_point` itself, which adds
reference points and bias allowance, and returns `ill_conditioned` as for a measured hand. No
pictures and no random numbers are involved.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from fingerpost.advise.camera import PlaneCamera
from fingerpost.advise.options import LEAST, AdviceOptions
from fingerpost.advise.poses import Poses
from fingerpost.experiment.bound import axis_covariance, edge_information
from fingerpost.pointing import FingerLine, PlaneView, Status, indicated_point

Array = NDArray[np.float64]

SHORTEST_FLANK_PX = 10.0
"""Length of the flanks in the image below which a tracker cannot measure the finger's direction."""

# Bisections of a radius: to 10⁻⁷ of its greatest value.
_RADIUS_STEPS = 24
# Directions over which the error's distribution is averaged: exact to five digits for 20 : 1.
_TURNS = 64


class Doubt(StrEnum):
    """Why a pose will have no point."""

    OUT_OF_VIEW = "out_of_view"
    """The whole finger is inside fewer than two images."""
    END_ON = "end_on"
    """Fewer than two cameras see the finger from the side."""
    TOO_SHORT = "too_short"
    """The finger is shorter than `SHORTEST_FLANK_PX` in the image."""
    COPLANAR = "coplanar"
    """The finger is so nearly coplanar with the cameras that the constraint lines are almost
    parallel: `ill_conditioned`."""
    BEHIND = "behind"
    """A camera does not see the indicated point of the plane."""


@dataclass(frozen=True, eq=False)
class Figures:
    """Prediction for a group of poses.

    Attributes
    ----------
    poses
        Number of poses.
    in_view
        Share of them that are completely inside two images or more, 0 to 1.
    hopeless
        Share of those in view without a point, 0 to 1; NaN if none is in view.
    doubts
        The same for each reason.
    rms, median, percentile_95
        Statistics of the error's length over the poses with a point [plane units]; NaN without any.
    crossing_rad
        Median angle between the constraint lines.
    """

    poses: int
    in_view: float
    hopeless: float
    doubts: dict[str, float]
    rms: float
    median: float
    percentile_95: float
    crossing_rad: float


@dataclass(frozen=True, eq=False)
class Forecast:
    """Prediction for P poses in V views.

    Attributes
    ----------
    doubt : (P,) of Doubt or None
        Reason for the absence of a point; None with a point.
    covariance : (P, 2, 2)
        Covariance of the indicated point [plane units²]; NaN without one.
    crossing_rad : (P,)
        Angle between the constraint lines; NaN without two.
    length_px : (P, V)
        Length of the flanks; NaN behind a camera.
    ray_rad : (P, V)
        Angle between the finger and the viewing ray, from 0 to π/2.
    inside : (P, V)
        Whether the whole finger is inside the image.
    """

    doubt: NDArray[np.object_]
    covariance: Array
    crossing_rad: Array
    length_px: Array
    ray_rad: Array
    inside: NDArray[np.bool_]

    @property
    def answered(self) -> NDArray[np.bool_]:
        """(P,) Whether there is a point."""
        return np.array([doubt is None for doubt in self.doubt], dtype=np.bool_)

    @property
    def in_view(self) -> NDArray[np.bool_]:
        """(P,) Whether the whole finger is inside two images or more."""
        return np.array([doubt is not Doubt.OUT_OF_VIEW for doubt in self.doubt], dtype=np.bool_)

    def figures(self, chosen: NDArray[np.bool_] | slice = slice(None)) -> Figures:
        """Return the figures of chosen poses."""
        answered, in_view, doubt = self.answered[chosen], self.in_view[chosen], self.doubt[chosen]
        seen = int(in_view.sum())
        shares = {
            reason.value: int((doubt == reason).sum()) / seen
            for reason in Doubt
            if reason is not Doubt.OUT_OF_VIEW and (doubt == reason).any()
        }
        covariance = self.covariance[chosen][answered]
        squared = np.trace(covariance, axis1=1, axis2=2)
        crossing = self.crossing_rad[chosen][answered]
        return Figures(
            poses=len(answered),
            in_view=seen / len(answered) if len(answered) else math.nan,
            hopeless=1.0 - int(answered.sum()) / seen if seen else math.nan,
            doubts=shares,
            rms=math.sqrt(float(squared.mean())) if len(squared) else math.nan,
            median=error_radius(covariance, 0.5),
            percentile_95=error_radius(covariance, 0.95),
            crossing_rad=float(np.median(crossing)) if len(crossing) else math.nan,
        )

    def typical_error(self, chosen: NDArray[np.bool_], limit: float) -> float:
        """Geometric mean of the RMS errors of poses, with `limit` for those without a point.

        Halving an error has the same weight at any size, and gaining a point has the greatest: this
        is the criterion by which cameras are compared.
        """
        rms = np.full(len(self.doubt), limit)
        answered = self.answered
        squared = np.trace(self.covariance[answered], axis1=1, axis2=2)
        rms[answered] = np.minimum(np.sqrt(squared), limit)
        return float(np.exp(np.log(rms[chosen]).mean())) if chosen.any() else limit


def predict(
    poses: Poses,
    cameras: Sequence[PlaneCamera],
    plane_points: Array,
    options: AdviceOptions,
    unit_mm: float,
) -> Forecast:
    """Predict the points of poses.

    Parameters
    ----------
    poses
        The expected poses.
    cameras
        At least two cameras.
    plane_points : (N, 2)
        The reference points.
    options
        See `AdviceOptions`.
    unit_mm
        Length of a plane unit [mm].

    Raises
    ------
    InvalidInputError
        Reference points behind a camera.
    """
    plane_views = [
        ideal_view(camera, plane_points, options.reference_sigma_px) for camera in cameras
    ]
    seen = [_seen_by(camera, poses, options, unit_mm) for camera in cameras]
    length, ray = (
        np.stack([getattr(each, k) for each in seen], axis=1) for k in ("length_px", "ray_rad")
    )
    inside = np.stack([each.inside for each in seen], axis=1)
    lateral = ray >= math.radians(options.poses.view_ray_deg)
    usable = inside & lateral & (length >= SHORTEST_FLANK_PX)
    count = len(poses)
    doubt = np.full(count, None, dtype=object)
    covariance = np.full((count, 2, 2), np.nan)
    crossing = np.full(count, np.nan)
    for i in range(count):
        if usable[i].sum() < 2:
            doubt[i] = _unseen(inside[i], lateral[i])
            continue
        lines = [each.line(i) if usable[i, k] else Status.LOST for k, each in enumerate(seen)]
        fix = indicated_point(lines, plane_views, time_s=0.0, options=options.pointing)
        crossing[i] = math.nan if fix.crossing_angle_rad is None else fix.crossing_angle_rad
        if fix.point is None:
            doubt[i] = _without_point(poses.target[i], plane_views)
        else:
            covariance[i] = fix.covariance
    return Forecast(doubt, covariance, crossing, length, ray, inside)


def ideal_view(camera: PlaneCamera, plane_points: Array, sigma_px: float) -> PlaneView:
    """Return a camera's homography from the plane, in pixels of the ideal pinhole.

    Raises
    ------
    InvalidInputError
        Reference points behind the camera.
    """
    image = camera.project(np.pad(plane_points, ((0, 0), (0, 1))))
    return PlaneView.from_reference_points(plane_points, image, sigma_px**2 * np.eye(2))


def error_radius(covariance: Array, probability: float) -> float:
    """Return the radius that contains a given share of Gaussian errors of several points.

    For an error ``Λ^½ r (cos φ, sin φ)`` with r² twice an exponential and φ uniform,
    ``P(|e| > R) = mean over φ of exp(−R² / 2(λ₁ cos² φ + λ₂ sin² φ))``; averaged over the points,
    solved for R by bisection.

    Parameters
    ----------
    covariance : (P, 2, 2)
        One per point; the result is NaN without any.
    probability
        Above 0, below 1.
    """
    if not len(covariance):
        return math.nan
    turn = (np.arange(_TURNS) + 0.5) * np.pi / (2 * _TURNS)
    minor, major = np.maximum(np.linalg.eigvalsh(covariance), 0.0).T[..., None]
    doubled = 2.0 * (major * np.cos(turn) ** 2 + minor * np.sin(turn) ** 2)
    if not doubled.max() > 0.0:
        return 0.0
    low, high = 0.0, math.sqrt(-float(doubled.max()) * math.log1p(-probability))
    for _ in range(_RADIUS_STEPS):
        middle = (low + high) / 2
        with np.errstate(divide="ignore"):
            outside = float(np.exp(-(middle**2) / doubled).mean())
        low, high = (middle, high) if outside > 1.0 - probability else (low, middle)
    return (low + high) / 2


def without(options: AdviceOptions, part: str) -> AdviceOptions:
    """Return options in which one part of the error is (nearly) absent.

    Parameters
    ----------
    part
        ``references``, ``noise`` or ``bias``.
    """
    nearly = 1e-6
    match part:
        case "references":
            return replace(
                options, reference_sigma_px=max(nearly * options.reference_sigma_px, LEAST)
            )
        case "noise":
            return replace(options, noise=max(nearly * options.noise, LEAST))
        case _:
            pointing = replace(options.pointing, bias_offset_px=0.0, bias_angle_rad=0.0)
            return replace(options, pointing=pointing)


@dataclass(frozen=True, eq=False)
class _Seen:
    """P poses in one camera."""

    anchor_px: Array
    angle_rad: Array
    covariance: Array
    tip_px: Array
    length_px: Array
    half_width_px: Array
    ray_rad: Array
    inside: NDArray[np.bool_]

    def line(self, i: int) -> FingerLine:
        return FingerLine(
            self.anchor_px[i],
            float(self.angle_rad[i]),
            self.covariance[i],
            self.tip_px[i],
            0.0,
            float(self.length_px[i]) / 2,
            float(self.half_width_px[i]),
        )


def _seen_by(camera: PlaneCamera, poses: Poses, options: AdviceOptions, unit_mm: float) -> _Seen:
    length, radius = options.length_mm / unit_mm, options.diameter_mm / 2 / unit_mm
    # Flanks extend from the knuckle to the start of the finger's round end.
    base, end = poses.tip - length * poses.direction, poses.tip - radius * poses.direction
    base_px, end_px, tip_px = (camera.project(points) for points in (base, end, poses.tip))
    along = end_px - base_px
    flank_px = np.hypot(*along.T)
    ray = poses.tip - camera.centre
    distance = np.linalg.norm(ray, axis=1)
    cosine = np.abs((ray * poses.direction).sum(axis=1)) / distance
    around = radius * camera.focal_px.mean() / distance
    border = options.poses.border_px + float(np.nanmax(around, initial=0.0))
    moments = np.zeros((len(poses), 2, 3))
    moments[..., 0], moments[..., 2] = flank_px[:, None], flank_px[:, None] ** 3 / 12.0
    information = edge_information(options.contrast, options.noise, options.blur_px)
    # Without flanks there is no line; the identity avoids warnings.
    moments[~(flank_px > 0.0)] = np.array([1.0, 0.0, 1.0])
    return _Seen(
        anchor_px=(base_px + end_px) / 2,
        angle_rad=np.arctan2(along[:, 1], along[:, 0]),
        covariance=axis_covariance(moments, information * options.efficiency),
        tip_px=tip_px,
        length_px=flank_px,
        half_width_px=around,
        ray_rad=np.arccos(np.clip(cosine, 0.0, 1.0)),
        inside=camera.shows(base_px, border) & camera.shows(tip_px, border),
    )


def _unseen(inside: NDArray[np.bool_], lateral: NDArray[np.bool_]) -> Doubt:
    """Return why a pose is not seen by two views."""
    if inside.sum() < 2:
        return Doubt.OUT_OF_VIEW
    return Doubt.END_ON if (inside & lateral).sum() < 2 else Doubt.TOO_SHORT


def _without_point(target: Array, plane_views: Sequence[PlaneView]) -> Doubt:
    """Return why a visible pose has no point."""
    hidden = any(np.isnan(view.project(target)).any() for view in plane_views)
    return Doubt.BEHIND if hidden else Doubt.COPLANAR
