"""One target of an experiment: result of the pointer, and truth."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fingerpost.errors import InvalidInputError
from fingerpost.pipeline import Observation, Step
from fingerpost.pointing import FingerLine, PlaneView, Status
from fingerpost.simulate import FingerTruth
from fingerpost.uncertainty import Ellipse, nsigma_ellipse

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, slots=True)
class LineTrial:
    """Comparison of one view's finger line with the exact projected axis, both undistorted.

    Attributes
    ----------
    view
        Name of the view.
    error : (2,)
        Error of the offset [px], along the line's normal at its anchor, and of the angle [rad].
    covariance : (2, 2)
        Their covariance according to the tracker.
    bound : (2, 2) or None
        Their least possible covariance (see `bound`); None if unknown.
    """

    view: str
    error: Array
    covariance: Array
    bound: Array | None


@dataclass(frozen=True, eq=False)
class Trial:
    """One target.

    Attributes
    ----------
    index
        Number of the target, or index of the frame in footage.
    target : (2,)
        The true indicated point [plane units].
    status
        Status of the fix.
    reason
        Why its status is not `ok`; may be empty.
    point : (2,) or None
        The indicated point [plane units]; None unless the status is `ok`.
    covariance : (2, 2) or None
        Its covariance [plane units²].
    recipe
        Its ellipse by the recipe of 1994 (see `paper_ellipse`); None without a point.
    bound : (2, 2) or None
        Least covariance of the point [plane units²]; None if unknown.
    lines
        The finger lines; empty for footage.
    """

    index: int
    target: Array
    status: Status
    reason: str = ""
    point: Array | None = None
    covariance: Array | None = None
    recipe: Ellipse | None = None
    bound: Array | None = None
    lines: tuple[LineTrial, ...] = ()

    @cached_property
    def error(self) -> float:
        """Distance of the point from the target [plane units]; NaN without a point."""
        return math.nan if self.point is None else math.dist(self.point, self.target)

    @cached_property
    def mahalanobis2(self) -> float:
        """Squared error in standard deviations: χ² with 2 degrees of freedom if consistent."""
        if self.point is None or self.covariance is None:
            return math.nan
        return squared_in_sigmas(self.point - self.target, self.covariance)


def squared_in_sigmas(error: Array, covariance: Array) -> float:
    """``eᵀ Σ⁻¹ e``; infinite for an error in a direction of zero variance."""
    try:
        squared = float(error @ np.linalg.solve(covariance, error))
    except np.linalg.LinAlgError:
        return math.inf
    return squared if squared >= 0.0 else math.inf


def line_error(line: FingerLine, finger: FingerTruth) -> Array:
    """Compare a finger line with the exact projected axis.

    Returns
    -------
    (2,)
        Offset [px], along the normal ``(−sin, cos)`` at the line's anchor, and angle [rad]:
        measured minus true.
    """
    normal = np.array([-math.sin(finger.axis_angle_rad), math.cos(finger.axis_angle_rad)])
    offset = (line.anchor_px - finger.axis_point_px) @ normal
    return np.array([offset, math.remainder(line.angle_rad - finger.axis_angle_rad, math.tau)])


def paper_ellipse(
    observations: Sequence[Observation], plane_views: Sequence[PlaneView]
) -> Ellipse | None:
    """Compute the ellipse "two standard deviations (95 %)" of the paper.

    Its σ follow directly from the residual offsets of each view's contour: for an offset line with
    residuals of standard deviation r, measured on a finger of length L, σ is r for the position and
    ``r √12 / L`` (r over the standard deviation of the positions along the finger) for the
    orientation. There is no division by √N, because residuals of a template that does not fit
    exactly do not average out like noise. `fingerpost.uncertainty.nsigma_ellipse` projects ± 2σ.

    Parameters
    ----------
    observations
        Observations of all views at one time.
    plane_views
        The views.

    Returns
    -------
    Ellipse or None
        None unless every view has a finger line and they are not parallel on the plane.
    """
    lines = []
    residuals = []
    for observation, view in zip(observations, plane_views, strict=True):
        finger = observation.finger
        if isinstance(finger, FingerLine):
            finger = view.through_pinhole(finger)
        if isinstance(finger, Status) or observation.track is None:
            return None
        lines.append(finger)
        residuals.append(observation.track.diagnostics.residual_rms_px)
    length_px = np.array([2.0 * finger.half_length_px for finger in lines])
    sigma = np.array(residuals)[:, None] * np.stack(
        [np.ones_like(length_px), math.sqrt(12.0) / length_px], axis=1
    )
    try:
        return nsigma_ellipse(
            np.array([view.image_from_plane for view in plane_views]),
            np.array([finger.anchor_px for finger in lines]),
            np.array([finger.angle_rad for finger in lines]),
            sigma[:, :, None] ** 2 * np.eye(2),
        )
    except InvalidInputError:  # parallel
        return None


def trial_of(
    step: Step,
    plane_views: Sequence[PlaneView],
    *,
    index: int,
    target: Array,
    bound: Array | None = None,
    lines: tuple[LineTrial, ...] = (),
) -> Trial:
    """Compare a pointer's result for one frame with the truth."""
    fix = step.fix
    if fix.point is None:
        return Trial(index, target, fix.status, fix.reason, bound=bound, lines=lines)
    recipe = paper_ellipse(step.observations, plane_views)
    return Trial(
        index,
        target,
        fix.status,
        fix.reason,
        fix.point,
        fix.covariance,
        recipe,
        bound,
        lines,
    )
