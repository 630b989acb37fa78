"""Predicted covariance of the indicated point of a pose.

A pose of the finger is projected into every recovered camera. Its line there gets the covariance
that two straight flanks of that length in pixels allow (`fingerpost.experiment.bound`), divided by
the share of it that the tracker reaches; the rest is `fingerpost.pointing.indicated_point` itself,
which adds reference points and bias allowance, and says `ill_conditioned` where it would say so of
a measured hand. No picture is taken and nothing is drawn at random.
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
"""A finger whose flanks are shorter in the image has no direction that a tracker could tell."""

# Bisections of a radius: to 10⁻⁷ of its greatest value.
_RADIUS_STEPS = 24
# Directions over which the error's distribution is averaged: exact to five digits for 20 : 1.
_TURNS = 64


class Doubt(StrEnum):
    """Why a pose will have no point."""

    OUT_OF_VIEW = "out_of_view"
    """Fewer than two images hold the whole finger."""
    END_ON = "end_on"
    """Fewer than two cameras see the finger from aside."""
    TOO_SHORT = "too_short"
    """The finger takes fewer than `SHORTEST_FLANK_PX` in the image."""
    COPLANAR = "coplanar"
    """The finger lies so nearly in one plane with the cameras that their lines run parallel on the
    working plane: `ill_conditioned`."""
    BEHIND = "behind"
    """A camera does not see the plane where the finger points."""


@dataclass(frozen=True, eq=False)
class Figures:
    """What is predicted for a group of poses.

    Attributes
    ----------
    poses
        How many.
    in_view
        Share of them that two images or more hold as a whole, 0 to 1.
    hopeless
        Share of those in view that will have no point, 0 to 1; NaN if none is in view.
    doubts
        The same for each reason.
    rms, median, percentile_95
        Of the error's length, of the poses with a point [plane units]; NaN if there is none.
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
    """What is predicted for P poses seen by V views.

    Attributes
    ----------
    doubt : (P,) of Doubt or None
        None where there will be a point.
    covariance : (P, 2, 2)
        Of the indicated point [plane units²]; NaN where there is none.
    crossing_rad : (P,)
        Between the constraint lines; NaN without two.
    length_px : (P, V)
        Of the flanks; NaN behind a camera.
    ray_rad : (P, V)
        Between the finger and the view ray, from 0 to π/2.
    inside : (P, V)
        Whether the image holds the whole finger.
    """

    doubt: NDArray[np.object_]
    covariance: Array
    crossing_rad: Array
    length_px: Array
    ray_rad: Array
    inside: NDArray[np.bool_]

    @property
    def answered(self) -> NDArray[np.bool_]:
        """(P,) where there will be a point."""
        return np.array([doubt is None for doubt in self.doubt], dtype=np.bool_)

    @property
    def in_view(self) -> NDArray[np.bool_]:
        """(P,) where two images or more hold the whole finger."""
        return np.array([doubt is not Doubt.OUT_OF_VIEW for doubt in self.doubt], dtype=np.bool_)

    def figures(self, chosen: NDArray[np.bool_] | slice = slice(None)) -> Figures:
        """Sum up the poses chosen."""
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
        """Geometric mean of the RMS errors of poses, one without a point counting as `limit`.

        It weighs a halved error alike wherever it is halved, and a pose that gets its point above
        all: what cameras are compared by.
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
    """Forecast poses.

    Parameters
    ----------
    poses
        What to expect.
    cameras
        At least two.
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
    aside = ray >= math.radians(options.poses.view_ray_deg)
    usable = inside & aside & (length >= SHORTEST_FLANK_PX)
    count = len(poses)
    doubt = np.full(count, None, dtype=object)
    covariance = np.full((count, 2, 2), np.nan)
    crossing = np.full(count, np.nan)
    for i in range(count):
        if usable[i].sum() < 2:
            doubt[i] = _unseen(inside[i], aside[i])
            continue
        lines = [each.line(i) if usable[i, k] else Status.LOST for k, each in enumerate(seen)]
        fix = indicated_point(lines, plane_views, time_s=0.0, options=options.pointing)
        crossing[i] = math.nan if fix.crossing_angle_rad is None else fix.crossing_angle_rad
        if fix.point is None:
            doubt[i] = _untold(poses.target[i], plane_views)
        else:
            covariance[i] = fix.covariance
    return Forecast(doubt, covariance, crossing, length, ray, inside)


def ideal_view(camera: PlaneCamera, plane_points: Array, sigma_px: float) -> PlaneView:
    """How a camera sees the plane, in the pixels of the ideal pinhole.

    Raises
    ------
    InvalidInputError
        Reference points behind the camera.
    """
    image = camera.project(np.pad(plane_points, ((0, 0), (0, 1))))
    return PlaneView.from_reference_points(plane_points, image, sigma_px**2 * np.eye(2))


def error_radius(covariance: Array, probability: float) -> float:
    """Distance within which points with Gaussian errors lie with a probability, taken together.

    For an error ``Λ^½ r (cos φ, sin φ)`` with r² twice an exponential and φ uniform,
    ``P(|e| > R) = mean over φ of exp(−R² / 2(λ₁ cos² φ + λ₂ sin² φ))``; averaged over the points,
    solved for R by bisection.

    Parameters
    ----------
    covariance : (P, 2, 2)
        One per point; NaN is the answer to none.
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
    """Give options in which one part of the error is (nearly) absent.

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
    """P poses as one camera sees them."""

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
    # Flanks run from the knuckle to where the round end of the finger begins.
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
    # Where there are no flanks there is no line; the identity keeps the arithmetic quiet.
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


def _unseen(inside: NDArray[np.bool_], aside: NDArray[np.bool_]) -> Doubt:
    """Why a pose is not seen by two views."""
    if inside.sum() < 2:
        return Doubt.OUT_OF_VIEW
    return Doubt.END_ON if (inside & aside).sum() < 2 else Doubt.TOO_SHORT


def _untold(target: Array, plane_views: Sequence[PlaneView]) -> Doubt:
    """Why a pose that is seen will have no point."""
    hidden = any(np.isnan(view.project(target)).any() for view in plane_views)
    return Doubt.BEHIND if hidden else Doubt.COPLANAR
