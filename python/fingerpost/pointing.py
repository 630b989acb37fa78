"""From finger lines in N ≥ 2 views to the indicated point: section 2 of the paper.

R. Cipolla, P. A. Hadfield, N. J. Hollinghurst, "Uncalibrated stereo vision with pointing for a
man-machine interface", MVA 1994. The cameras are not calibrated; the reference points give the
homography from the working plane to each view (`PlaneView`, eq. 1). A finger line in an image
constrains the indicated point to a line of the plane (eq. 2); two such lines intersect in the point
(figure 2). All arithmetic stays in the image planes and the working plane.

Finger lines of different views are first interpolated to a common time (`align`). A lost hand or
an ill-conditioned intersection is a `Status` of the `Fix`, not an exception.
"""

import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from itertools import combinations, pairwise
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.checks import covariance_array, finite_array, in_range
from fingerpost.errors import DegenerateReferencePointsError, InvalidInputError
from fingerpost.homography import (
    estimate_image_from_plane,
    inverse,
    kronecker_product,
    transfer_by_inverse,
    transfer_to_image,
)
from fingerpost.lens import Lens
from fingerpost.uncertainty import (
    UNBOUNDED,
    Constraint,
    Ellipse,
    Intersection,
    blocks_of,
    confidence_ellipse,
    constraint,
    constraint_components,
    entries_form,
    homography_covariance,
    joint_of,
    largest_sigma,
    line_and_covariance,
    meeting_point,
    widened,
)

_LARGEST = float(np.finfo(np.float64).max)

USUAL_HALF_WIDTH_PX = 8.0
"""Half-width of the finger to which the pixel values of `PointingOptions` refer [px]. Deviations
of a finger from a cylinder scale with its image, so they grow for a wider finger; errors due to
pixels do not shrink for a slimmer one."""


class Status(StrEnum):
    """State of a view's hand, and of a fix."""

    OK = "ok"
    ACQUIRING = "acquiring"
    """The tracker has not yet confirmed a hand."""
    LOST = "lost"
    """The tracker has lost the hand."""
    ILL_CONDITIONED = "ill_conditioned"
    """The hand is tracked, but the point is not determined; `Fix.reason` explains why."""


# Where the 99 % ellipse ends, in standard deviations of two dimensions: √(−2 ln 0.01).
_END = math.sqrt(-2.0 * math.log(0.01))

# A fix without a point reports the most severe status of its views.
_SEVERITY = {Status.OK: 0, Status.ILL_CONDITIONED: 1, Status.ACQUIRING: 2, Status.LOST: 3}


@dataclass(frozen=True, slots=True)
class PointingOptions:
    """Conditions under which a point is accepted, and the allowance for systematic errors."""

    max_sigma: float = 0.2
    """Largest standard deviation of the indicated point in any direction [share of
    `PlaneView.plane_size`, > 0]. At 0.2 the 95 % ellipse is as long as the plane; a larger one
    carries no information beyond the plane itself. Below that the covariance is valid at any size,
    and the application decides how small it must be; robots have limits of their own. The system of
    1994 was accurate to 0.037. One point in a hundred lies outside its 99 % ellipse, of any size:
    at 0.02 such errors stay below 0.05."""

    nsigma: float = 4.0
    """Significance of the tests that accept or refuse a point [standard deviations, > 0]. To accept
    one, points further away than ``nsigma · max_sigma`` must be excluded by this many standard
    deviations; to refuse one as behind the fingertip, or for views that disagree, the excess must
    be this many."""

    bias_offset_px: float = 0.0
    """Standard deviation of the systematic lateral offset between the measured medial line and the
    finger's axis, at the anchor [px, ≥ 0]. It holds for half-widths up to `USUAL_HALF_WIDTH_PX` and
    grows in proportion beyond. 0 suits a cylinder; see `BARE_HAND`."""

    bias_angle_rad: float = 0.0
    """Standard deviation of the systematic error in direction, about the anchor [rad, ≥ 0]. Bent
    and conical fingers are biased above all in angle. 0 suits a cylinder; see `BARE_HAND`. If
    another stretch of a real finger is measured, its medial line turns by 0.01 to 0.02."""

    tip_sigma_px: float = 4.0
    """Standard deviation of the fingertip along the finger [px, ≥ 0]; it scales with the width as
    `bias_offset_px` does. A finger that touches the plane indicates its own tip, and must not be
    refused for pointing backwards. It touches with its pad: a finger 26 px wide indicated points up
    to 11 px behind its apex."""

    max_skew_s: float = 0.001
    """Largest difference between the time of a fix and those of its finger lines [s, ≥ 0]: at
    0.5 m/s a millisecond costs about 1 mm. `align` makes it zero."""

    max_gap_s: float = 0.1
    """Longest interval between two finger lines that `align` interpolates [s, > 0]."""

    max_wait_s: float = 0.1
    """Largest age of a view's newest finger line at which `align` still waits for the next
    [s, ≥ 0]."""

    def __post_init__(self) -> None:
        for name in ("max_sigma", "nsigma", "max_gap_s"):
            in_range(getattr(self, name), name, np.finfo(np.float64).tiny)
        for name in (
            "bias_offset_px",
            "bias_angle_rad",
            "tip_sigma_px",
            "max_skew_s",
            "max_wait_s",
        ):
            in_range(getattr(self, name), name, 0.0)


DEFAULT_OPTIONS = PointingOptions()
"""No allowance for bias."""

BARE_HAND = PointingOptions(bias_offset_px=0.4, bias_angle_rad=0.006)
"""Options of the main loop. A finger is neither round nor evenly lit: if its shaded flank is as
bright as the background, the measured edge lies inside the finger. The bend of a finger is measured
and is part of the covariance of its line (Rust, `axis`). Maximum-likelihood values for the lines of
a rendered hand over tables of wood, stone and cloth, dark, grey and white, in colour and in grey.
In 38 further films, with hands of many shapes, the 95 % ellipses contain 97 % of the
intersections of the exact lines and the 50 % ellipses 69 %; for hands found without a start pose,
95 % and 62 % (without points 60 mm off, where something else is followed). For a mechanical device
they contain all of 15 poses. These fingers are about 16 px wide."""

UNSEEN_HAND = replace(BARE_HAND, bias_angle_rad=0.0065)
"""Options to forecast a bare hand: its bend is unknown and is part of the allowance."""


@dataclass(frozen=True, eq=False, slots=True)
class FingerLine:
    """Axis of the pointing finger in one view at one time.

    Parameters
    ----------
    anchor_px : (2,)
        Point of the line at the middle of the measured stretch of the finger, where offset and
        angle are least correlated.
    angle_rad
        Direction of pointing in the image [rad], any value: 0 is +u (right), π/2 is +v (down).
    covariance : (2, 2)
        Covariance of the offset [px] along the normal ``(−sin, cos)`` and the angle [rad], at the
        anchor. Zero for a line known exactly.
    tip_px : (2,)
        Fingertip, ahead of the anchor; need not lie on the line exactly.
    time_s
        Capture time [s], on one clock for all views.
    half_length_px
        Half the length of the measured stretch [px], > 0. 0 means the distance from anchor to tip.
    half_width_px
        Half the finger's width [px], ≥ 0; 0 if unknown.
    stretch_px
        Interval along the line, from the anchor [px], over which the line represents the finger:
        the correction of a lens straightens it over this interval. (0, 0) means the measured
        stretch.

    Raises
    ------
    InvalidInputError
        NaN, wrong shapes, a matrix that is not a covariance, a tip behind the anchor, or a stretch
        that ends before it begins.
    """

    anchor_px: NDArray[np.float64]
    angle_rad: float
    covariance: NDArray[np.float64]
    tip_px: NDArray[np.float64]
    time_s: float
    half_length_px: float = 0.0
    half_width_px: float = 0.0
    stretch_px: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        anchor = finite_array(self.anchor_px, "anchor_px", (2,))
        tip = finite_array(self.tip_px, "tip_px", (2,))
        angle = in_range(self.angle_rad, "angle_rad", -_LARGEST, _LARGEST)
        along = (tip - anchor).tolist()
        ahead = along[0] * math.cos(angle) + along[1] * math.sin(angle)
        if ahead <= 0.0:
            raise InvalidInputError(
                f"tip_px {tip.tolist()} lies {-ahead:.3g} px behind anchor_px {anchor.tolist()} "
                f"in the direction {angle:.4g} rad; it is to lie ahead"
            )
        set_field = object.__setattr__
        set_field(self, "anchor_px", anchor)
        set_field(self, "angle_rad", angle)
        set_field(self, "covariance", covariance_array(self.covariance, "covariance", (2, 2)))
        set_field(self, "tip_px", tip)
        set_field(self, "time_s", in_range(self.time_s, "time_s", -_LARGEST, _LARGEST))
        half_length = in_range(self.half_length_px, "half_length_px", 0.0, _LARGEST)
        set_field(self, "half_length_px", half_length or ahead)
        half_width = in_range(self.half_width_px, "half_width_px", 0.0, _LARGEST)
        set_field(self, "half_width_px", half_width)
        begin, end = finite_array(self.stretch_px, "stretch_px", (2,)).tolist()
        if begin == end == 0.0:
            begin, end = -self.half_length_px, self.half_length_px
        if not begin < end:
            raise InvalidInputError(
                f"stretch_px begins at {begin:.4g} px and ends at {end:.4g} px; "
                "it is to end nearer to the tip"
            )
        set_field(self, "stretch_px", (begin, end))

    @property
    def largeness(self) -> float:
        """Ratio of the finger's half-width to `USUAL_HALF_WIDTH_PX`, at least 1."""
        return max(1.0, self.half_width_px / USUAL_HALF_WIDTH_PX)


@dataclass(frozen=True, eq=False)
class PlaneView:
    """Homography from the working plane to one view, with its covariance.

    Build it with `from_reference_points`; the fields are read-only.
    """

    plane_points: NDArray[np.float64]
    """Reference points on the plane, (N, 2)."""
    image_from_plane: NDArray[np.float64]
    """Homography of eq. 1 into the ideal pinhole's pixels, ``W = 1`` at the reference centroid."""
    entries_covariance: NDArray[np.float64]
    """Covariance of its entries, (9, 9)."""
    lens: Lens | None
    plane_size: float = field(init=False)
    """Side of the square with the same diameter as the reference points [plane units]."""

    def __post_init__(self) -> None:
        between = self.plane_points[:, None] - self.plane_points
        diameter = np.hypot(between[..., 0], between[..., 1]).max()
        object.__setattr__(self, "plane_size", float(diameter / np.sqrt(2.0)))

    @classmethod
    def from_reference_points(
        cls,
        plane_points: ArrayLike,
        image_points_px: ArrayLike,
        covariances_px2: ArrayLike | None,
        lens: Lens | None = None,
    ) -> "PlaneView":
        """Estimate the homography of a view from its reference points.

        Parameters
        ----------
        plane_points : (N, 2)
            Reference points on the plane, N ≥ 4, any unit; the same coordinates in every view.
        image_points_px : (N, 2)
            Their images in the view, in the same order; may lie outside the frame.
        covariances_px2 : (2, 2), (N, 2, 2), (2N, 2N) or None
            Covariance of each image point [px²], or joint covariance of u and v of all points in
            turn, if their errors are correlated. None means that they are known exactly; from a
            standard deviation of about 0.07 px, their errors dominate that of the point.
        lens
            Distortion of the view, if known; corrected in reference points and finger lines.

        Returns
        -------
        PlaneView

        Raises
        ------
        DegenerateReferencePointsError
            As `fingerpost.homography.estimate_image_from_plane`; or points outside the domain of
            the lens model.
        InvalidInputError
            Wrong shapes, NaN, too few points, or a matrix that is not a covariance.
        """
        plane = finite_array(plane_points, "plane_points", ("N", 2))
        image = finite_array(image_points_px, "image_points_px", ("N", 2))
        covariances: NDArray[np.float64] | None = None
        joint = False
        if covariances_px2 is not None:
            joint = np.shape(covariances_px2) == (image.size, image.size)
            shape = (image.size, image.size) if joint else (..., 2, 2)
            covariances = covariance_array(covariances_px2, "covariances_px2", shape)
        if lens is not None:
            ideal = lens.undistort(image)
            outside = ~np.isfinite(ideal).all(axis=1)
            if outside.any():
                first = int(np.argmax(outside))
                raise DegenerateReferencePointsError(
                    f"image_points_px[{first}], {image[first].tolist()}, lies where {lens} folds "
                    "back; the lens model does not hold there"
                )
            if covariances is not None:
                jacobian = lens.undistort_jacobian(image)
                by_image = joint_of(jacobian) if joint else jacobian
                covariances = by_image @ covariances @ np.swapaxes(by_image, -1, -2)
            image = ideal
        each = blocks_of(covariances) if joint and covariances is not None else covariances
        T = estimate_image_from_plane(plane, image, each)
        if covariances is None:
            return cls(plane, T, np.zeros((9, 9)), lens)
        return cls(plane, T, homography_covariance(T, plane, covariances), lens)

    def moved(self, now_from_before: ArrayLike, covariance: ArrayLike) -> "PlaneView":
        """Return the view after a motion of its camera.

        Parameters
        ----------
        now_from_before : (3, 3)
            Homography from the previous to the present pinhole images of points of the plane [px].
        covariance : (9, 9)
            Covariance of its entries, row by row.

        Returns
        -------
        PlaneView
            Its covariance includes those of the previous view and of the motion.

        Raises
        ------
        InvalidInputError
            Wrong shapes, NaN, or a motion that puts the reference points behind the camera.
        """
        H = finite_array(now_from_before, "now_from_before", (3, 3))
        Σ_H = finite_array(covariance, "covariance", (9, 9))
        T = H @ self.image_from_plane
        in_front = T[2] @ [*self.plane_points.mean(axis=0), 1.0]
        if in_front <= 0.0:
            raise InvalidInputError("now_from_before puts the reference points behind the camera")
        by_view = kronecker_product(H, np.eye(3)) / in_front
        by_motion = kronecker_product(np.eye(3), self.image_from_plane.T) / in_front
        Σ_T = by_view @ self.entries_covariance @ by_view.T + by_motion @ Σ_H @ by_motion.T
        return PlaneView(self.plane_points, T / in_front, Σ_T, self.lens)

    def between(self, other: "PlaneView", part: float) -> "PlaneView":
        """Interpolate between two views of one camera that moves uniformly.

        Parameters
        ----------
        other
            The later view.
        part
            Fraction of the interval from this view to the later one, from 0 to 1.
        """
        if other is self:
            return self
        T = (1.0 - part) * self.image_from_plane + part * other.image_from_plane
        Σ_T = (1.0 - part) * self.entries_covariance + part * other.entries_covariance
        return PlaneView(self.plane_points, T, Σ_T, self.lens)

    def project(self, plane_points: ArrayLike) -> NDArray[np.float64]:
        """Project points of the plane into the image, lens distortion included.

        Parameters
        ----------
        plane_points : (..., 2)

        Returns
        -------
        (..., 2)
            Pixels; NaN beyond the horizon or outside the domain of the lens model.
        """
        ideal = transfer_to_image(self.image_from_plane, plane_points)
        if self.lens is None:
            return ideal
        seen = np.isfinite(ideal).all(axis=-1, keepdims=True)
        return np.where(seen, self.lens.distort(np.where(seen, ideal, 0.0)), np.nan)

    def back_project(self, image_points_px: ArrayLike) -> NDArray[np.float64]:
        """Back-project pixels onto the plane, lens distortion included.

        Parameters
        ----------
        image_points_px : (..., 2)

        Returns
        -------
        (..., 2)
            Plane units; NaN above the horizon or outside the domain of the lens model.
        """
        if self.lens is None:
            return transfer_by_inverse(self._plane_from_image, image_points_px)
        ideal = self.lens.undistort(image_points_px)
        seen = np.isfinite(ideal).all(axis=-1, keepdims=True)
        points = transfer_by_inverse(self._plane_from_image, np.where(seen, ideal, 0.0))
        return np.where(seen, points, np.nan)

    @cached_property
    def _plane_from_image(self) -> NDArray[np.float64]:
        return inverse(self.image_from_plane)

    @cached_property
    def _floats(self) -> tuple[list[list[float]], list[list[float]]]:
        """Homography and a factor of its covariance as floats, for the few lines of a frame."""
        return self.image_from_plane.tolist(), entries_form(self.entries_covariance).tolist()

    def constrain(self, finger: FingerLine, options: PointingOptions) -> Constraint | None:
        """Transfer an undistorted finger line to its constraint line on the plane: eq. 2.

        Parameters
        ----------
        finger
            Line returned by `through_pinhole`.
        options
            Its allowance for bias is added to the line's covariance.

        Returns
        -------
        Constraint or None
            None for the plane's horizon, which does not intersect the plane.
        """
        u, v = finger.anchor_px.tolist()
        (offset, both), (_, angle) = finger.covariance.tolist()
        bias_offset_px = options.bias_offset_px * finger.largeness
        line, covariance = constraint_components(
            *self._floats,
            (u, v),
            (math.cos(finger.angle_rad), math.sin(finger.angle_rad)),
            (offset + bias_offset_px**2, both, angle + options.bias_angle_rad**2),
        )
        return constraint(line, covariance)

    def ahead_of_tip(self, finger: FingerLine, found: Intersection) -> tuple[float, float] | None:
        """Return the distance in the image from a fingertip forward to a point of the plane.

        Along the finger's direction e it is ``e·(π(T X~) − tip)``, a quotient of two linear forms
        of X~ with the divisor W of eq. 1.

        Parameters
        ----------
        finger
            Line returned by `through_pinhole`.
        found
            The point, with its covariance.

        Returns
        -------
        (float, float) or None
            Distance [px] and its variance without that of the tip [px²]; None beyond the view's
            horizon.
        """
        (t11, t12, t13), (t21, t22, t23), (t31, t32, t33) = self._floats[0]
        x, y = found.point.tolist()
        W = t31 * x + t32 * y + t33
        if not W > 0.0:
            return None
        cos, sin = math.cos(finger.angle_rad), math.sin(finger.angle_rad)
        u, v = finger.tip_px.tolist()
        tip = cos * u + sin * v
        # By x, y and 1: the divided form.
        a, b, c = (
            cos * t11 + sin * t21 - tip * t31,
            cos * t12 + sin * t22 - tip * t32,
            cos * t13 + sin * t23 - tip * t33,
        )
        ahead = (a * x + b * y + c) / W
        by_x, by_y = (a - ahead * t31) / W, (b - ahead * t32) / W
        (xx, xy), (_, yy) = found.covariance.tolist()
        return ahead, (xx * by_x + 2.0 * xy * by_y) * by_x + yy * by_y**2

    def through_pinhole(self, finger: FingerLine) -> FingerLine | Status:
        """Undistort a finger line; ILL_CONDITIONED outside the domain of the lens model."""
        if self.lens is None:
            return finger
        begin, end = finger.stretch_px
        half, middle = (end - begin) / 2.0, (begin + end) / 2.0
        anchor, angle, covariance = self.lens.undistort_line(
            finger.anchor_px, finger.angle_rad, finger.covariance, half, middle
        )
        tip = self.lens.undistort(finger.tip_px)
        ahead = (tip - anchor) @ (math.cos(angle), math.sin(angle))
        if not ahead > 0.0:  # NaN outside the domain of the lens model
            return Status.ILL_CONDITIONED
        return replace(
            finger,
            anchor_px=anchor,
            angle_rad=angle,
            covariance=covariance,
            tip_px=tip,
            stretch_px=(-half, half),
        )


@dataclass(frozen=True, eq=False)
class ConstraintLine:
    """Line of the working plane to which one view's finger line constrains the indicated point.

    Parameters
    ----------
    line : (3,)
        ``(a, b, c)`` in plane units, ``a² + b² = 1``.
    covariance : (3, 3)
        Covariance of ``line``, from finger line, bias allowance and reference points.
    """

    line: NDArray[np.float64]
    covariance: NDArray[np.float64]

    def sigma_at(self, plane_points: ArrayLike) -> NDArray[np.float64]:
        """Return the standard deviation across the line at points on it, to draw its band.

        Parameters
        ----------
        plane_points : (..., 2)

        Returns
        -------
        (...)
            Plane units.
        """
        points = finite_array(plane_points, "plane_points", (..., 2))
        X = np.concatenate([points, np.ones_like(points[..., :1])], axis=-1)
        return np.asarray(np.sqrt(np.einsum("...i,ij,...j->...", X, self.covariance, X)))


@dataclass(frozen=True, eq=False)
class Fix:
    """Indicated point, covariance and status at a time.

    Parameters
    ----------
    time_s
        [s]
    status
        OK if and only if there is a point.
    constraint_lines
        One per view, in the views' order, kept for drawing; None where there is no finger line or
        its line misses the plane.
    point : (2,) or None
        Indicated point [plane units].
    covariance : (2, 2) or None
        Its covariance [plane units²]: first order, but no smaller than that of the lines at the end
        of its 99 % ellipse (`fingerpost.uncertainty.widened_covariance`). With status
        `ill_conditioned`, the covariance of the refused point, which shows the reason; infinite on
        the diagonal if the point is unbounded. None without two finger lines.
    crossing_angle_rad
        Largest angle between two constraint lines, from 0 to π/2 [rad]; None without two.
    reason
        Why the status is not `ok`, or which views did not contribute; else empty.
    targets
        Probability that the hand points at each of the rig's targets, by name; under None, that it
        points at no target. Empty without a point or without targets.
    """

    time_s: float
    status: Status
    constraint_lines: tuple[ConstraintLine | None, ...]
    point: NDArray[np.float64] | None = None
    covariance: NDArray[np.float64] | None = None
    crossing_angle_rad: float | None = None
    reason: str = ""
    targets: Mapping[str | None, float] = field(default_factory=dict)

    @property
    def target(self) -> str | None:
        """The most probable target; None if it is more probable that there is none."""
        return max(self.targets, key=self.targets.__getitem__) if self.targets else None

    def ellipse(self, confidence: float = 0.95) -> Ellipse | None:
        """Confidence ellipse of the indicated point; None without a point.

        Parameters
        ----------
        confidence
            Probability, from 0 to below 1.
        """
        if self.point is None or self.covariance is None:
            return None
        return confidence_ellipse(self.point, self.covariance, confidence)


def indicated_point(
    finger_lines: Sequence[FingerLine | Status],
    plane_views: Sequence[PlaneView],
    *,
    time_s: float,
    options: PointingOptions = DEFAULT_OPTIONS,
    names: Sequence[str] | None = None,
    absences: Mapping[int, str] = MappingProxyType({}),
    displacements: Mapping[int, float] = MappingProxyType({}),
) -> Fix:
    """Compute the indicated point on the working plane from all views at one time.

    Parameters
    ----------
    finger_lines
        One entry per view: its finger line, or the status of a view without one.
    plane_views
        The N ≥ 2 views in the same order.
    time_s
        Time of the fix [s]; all finger lines must have this time (`align`).
    options
        See `PointingOptions`.
    names
        Names of the views in `Fix.reason`, in their order; by default "view 0" and on.
    absences
        Reasons for missing finger lines that the status does not give, by index of the view.
    displacements
        Standard deviation of an unknown displacement of a view's constraint line [plane units], by
        index of the view: a disagreement of the views that no view alone can measure.

    Returns
    -------
    Fix
        Views without a finger line are left out. With fewer than two lines there is no point, and
        the status is the most severe of the views.

    Raises
    ------
    InvalidInputError
        Fewer than two views, another number of entries or names, an entry that is neither a line
        nor a status, or a finger line of another time.
    """
    if names is None:
        names = [f"view {k}" for k in range(len(plane_views))]
    _refuse_unmatched(finger_lines, plane_views, names, time_s, options)
    entries = [
        view.through_pinhole(entry) if isinstance(entry, FingerLine) else entry
        for entry, view in zip(finger_lines, plane_views, strict=True)
    ]
    seen = [k for k, entry in enumerate(entries) if isinstance(entry, FingerLine)]
    fingers = [entry for entry in entries if isinstance(entry, FingerLine)]
    missing = [entry for entry in entries if isinstance(entry, Status)]
    without = ", ".join(
        f"{name}: {absences[k]}" if k in absences else f"{name} is {entry}"
        for k, (name, entry) in enumerate(zip(names, entries, strict=True))
        if k not in seen
    )

    # Eq. 2: the finger line l_i of each image becomes the constraint line l_gp = Tᵀ l_i of the
    # plane, on which the indicated point lies.
    views = [plane_views[k] for k in seen]
    l_gp = [
        _displaced(view.constrain(finger, options), displacements.get(k, 0.0))
        for k, view, finger in zip(seen, views, fingers, strict=True)
    ]
    lines = _drawn(l_gp, seen, len(entries))
    if len(fingers) < 2:
        return Fix(time_s, max(missing, key=_SEVERITY.__getitem__), lines, reason=without)
    met = [line for line in l_gp if line is not None]
    if len(met) < len(l_gp):
        reason = "a finger line is the horizon of the plane and meets it nowhere"
        return Fix(time_s, Status.ILL_CONDITIONED, lines, covariance=UNBOUNDED, reason=reason)

    # Figure 2c: the constraint lines of two views intersect in the indicated point; those of more
    # views give it by least squares.
    found = meeting_point(met)
    crossing = _largest_crossing_angle(met)
    max_sigma = options.max_sigma * max(view.plane_size for view in plane_views)
    wide = widened(met, found, options.nsigma * max_sigma)
    doubt = (
        _uncertain(wide, max_sigma, crossing)
        or _views_disagree(found, len(fingers), options)
        # Figure 2, last step: the point is projected into the images.
        or _misplaced(found, views, fingers, [names[k] for k in seen], options)
    )
    if doubt:
        return Fix(time_s, Status.ILL_CONDITIONED, lines, None, wide, crossing, doubt)
    # The covariance of the lines at the end of the 99 % ellipse, if larger than that at the point.
    end = min(_END * largest_sigma(found.covariance), options.nsigma * max_sigma)
    covariance = widened(met, found, end)
    if doubt := _uncertain(covariance, max_sigma, crossing):
        return Fix(time_s, Status.ILL_CONDITIONED, lines, None, covariance, crossing, doubt)
    return Fix(time_s, Status.OK, lines, found.point, covariance, crossing, without)


class AlignmentState(StrEnum):
    """Outcome of `align` for a view."""

    ALIGNED = "aligned"
    WAIT = "wait"
    """The view's next frame is needed, and may still come."""
    GAP = "gap"
    """The neighbours in time are too far apart, in time or in pose, to interpolate."""
    LATE = "late"
    """The view has fallen too far behind."""


@dataclass(frozen=True, slots=True)
class Alignment:
    """Finger line of one view at a requested time.

    Parameters
    ----------
    state
        ALIGNED if and only if there is a line.
    line
        The finger line at that time, or None.
    reason
        Why there is no line, with times in seconds; else empty.
    """

    state: AlignmentState
    line: FingerLine | None
    reason: str


def align(
    history: Sequence[FingerLine], time_s: float, options: PointingOptions = DEFAULT_OPTIONS
) -> Alignment:
    """Interpolate the finger line of one view at `time_s` between its neighbours in time.

    Anchor and angle follow the parabola through the two neighbours and the preceding line (angles
    along the shorter way round). On a circle of 80 mm at 0.5 m/s and 30 frames a second, its
    interpolation error is a tenth of that of a straight line. Interpolation is linear if there is
    no third line, or if the parabola's weights would give the measurement errors a larger variance
    than that of one frame. Lengths, widths and the tip's position in the finger's own frame are
    interpolated linearly. The nearest frame is no substitute: at 0.5 m/s and 20 ms it is wrong by
    some 17 mm. Nothing is extrapolated.

    The measurement errors of the lines are taken to be independent, so their covariances add with
    squared weights: halfway between two lines the variance is 0.72 of theirs by the parabola, 0.5
    by the straight line. Of a hand held still in rendered frames it is 0.88 and 0.78, for a part of
    the error does not change from frame to frame. The deviation of the hand's motion from the curve
    is not included.

    Parameters
    ----------
    history
        The view's latest finger lines, oldest first, times strictly increasing; may be empty.
        Frames in which the hand was lost are absent.
    time_s
        Requested time [s].
    options
        `max_gap_s` and `max_wait_s` apply.

    Returns
    -------
    Alignment

    Raises
    ------
    InvalidInputError
        Times that do not increase, or a time that is not finite.
    """
    time_s = in_range(time_s, "time_s", -_LARGEST, _LARGEST)
    times = [line.time_s for line in history]
    for k, (earlier, later) in enumerate(pairwise(times)):
        if not earlier < later:
            raise InvalidInputError(
                f"history[{k + 1}] is of {later} s, after {earlier} s; times are to increase"
            )
    following = bisect_left(times, time_s)
    if following == len(times):
        behind = time_s - times[-1] if times else 0.0
        state = AlignmentState.LATE if behind > options.max_wait_s else AlignmentState.WAIT
        newest = f"the newest finger line is {behind:.4g} s old" if times else "no finger line yet"
        return Alignment(state, None, newest)
    if times[following] == time_s:
        return Alignment(AlignmentState.ALIGNED, history[following], "")
    if following == 0:
        ahead = times[0] - time_s
        return Alignment(AlignmentState.GAP, None, f"the first finger line is {ahead:.4g} s later")
    before, after = history[following - 1], history[following]
    gap = after.time_s - before.time_s
    if gap > options.max_gap_s:
        reason = f"no finger line for {gap:.4g} s; at most {options.max_gap_s:g} s are bridged"
        return Alignment(AlignmentState.GAP, None, reason)
    turn = _turn(before, after)
    if abs(turn) > _MAX_TURN_RAD:
        reason = f"the finger line turns by {turn:.3g} rad between two frames"
        return Alignment(AlignmentState.GAP, None, reason)
    preceding = history[following - 2] if following > 1 else None
    lines = _on_parabola(preceding, before, after, time_s, options) or [before, after]
    return Alignment(AlignmentState.ALIGNED, _interpolated(lines, time_s), "")


# Beyond a quarter turn between two frames, the sense of rotation is ambiguous.
_MAX_TURN_RAD = np.pi / 2


def _turn(before: FingerLine, after: FingerLine) -> float:
    """Angle from one line to the other, the shorter way round, from −π to π [rad]."""
    return math.remainder(after.angle_rad - before.angle_rad, 2.0 * math.pi)


def _on_parabola(
    preceding: FingerLine | None,
    before: FingerLine,
    after: FingerLine,
    time_s: float,
    options: PointingOptions,
) -> list[FingerLine]:
    """Return the three lines of the parabola; an empty list to interpolate linearly."""
    if preceding is None or before.time_s - preceding.time_s > options.max_gap_s:
        return []
    if abs(_turn(preceding, before)) > _MAX_TURN_RAD:
        return []
    lines = [preceding, before, after]
    # If two of them are close in time, the parabola amplifies their errors.
    return lines if sum(w * w for w in _lagrange_weights(lines, time_s)) <= 1.0 else []


def _lagrange_weights(lines: Sequence[FingerLine], time_s: float) -> list[float]:
    """Return the weights of lines in the interpolating polynomial at a time."""
    times_s = [line.time_s for line in lines]
    return [
        math.prod((time_s - other) / (own - other) for other in times_s if other != own)
        for own in times_s
    ]


def _interpolated(lines: Sequence[FingerLine], time_s: float) -> FingerLine:
    """Evaluate the interpolating polynomial; the last two lines are the neighbours in time."""
    *_, before, after = lines
    weights = _lagrange_weights(lines, time_s)
    angle = before.angle_rad + sum(
        weight * _turn(before, line) for line, weight in zip(lines, weights, strict=True)
    )
    anchor = np.array(weights) @ np.array([line.anchor_px for line in lines])
    # An offset moves the anchor along its own line's normal; express it along the new normal.
    errors = [
        weight * np.diag([np.cos(angle - line.angle_rad), 1.0])
        for line, weight in zip(lines, weights, strict=True)
    ]
    share = (time_s - before.time_s) / (after.time_s - before.time_s)
    tip_in_finger = sum(
        part * (_finger_axes(line.angle_rad) @ (line.tip_px - line.anchor_px))
        for part, line in ((1.0 - share, before), (share, after))
    )
    return FingerLine(
        anchor_px=anchor,
        angle_rad=angle,
        covariance=np.sum(
            [error @ line.covariance @ error for error, line in zip(errors, lines, strict=True)],
            axis=0,
        ),
        tip_px=anchor + tip_in_finger @ _finger_axes(angle),
        time_s=time_s,
        half_length_px=(1.0 - share) * before.half_length_px + share * after.half_length_px,
        half_width_px=(1.0 - share) * before.half_width_px + share * after.half_width_px,
        stretch_px=(
            (1.0 - share) * before.stretch_px[0] + share * after.stretch_px[0],
            (1.0 - share) * before.stretch_px[1] + share * after.stretch_px[1],
        ),
    )


def _finger_axes(angle_rad: float) -> NDArray[np.float64]:
    """Tangent and normal of a finger line, as rows."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, s], [-s, c]])


def _displaced(line: Constraint | None, sigma: float) -> Constraint | None:
    """Add the variance of an unknown displacement [plane units] to a constraint line."""
    if line is None or not sigma:
        return line
    *rest, one = line
    return (*rest, one + sigma**2)  # type: ignore[return-value]


def _drawn(
    constraints: Sequence[Constraint | None], seen: Sequence[int], views: int
) -> tuple[ConstraintLine | None, ...]:
    """Constraint lines in the order of all views, None where there is none."""
    each: list[ConstraintLine | None] = [None] * views
    for k, line in zip(seen, constraints, strict=True):
        if line is not None:
            each[k] = ConstraintLine(*line_and_covariance(line))
    return tuple(each)


def _largest_crossing_angle(constraints: Sequence[Constraint]) -> float:
    return max(
        math.atan2(abs(a * q - b * p), abs(a * p + b * q))
        for (a, b, *_), (p, q, *_) in combinations(constraints, 2)
    )


def _uncertain(widened: NDArray[np.float64], max_sigma: float, crossing_rad: float) -> str:
    """Return why the point is too uncertain; empty if it is accepted."""
    sigma = largest_sigma(widened)
    if math.isfinite(sigma):
        if sigma <= max_sigma:
            return ""
        found = f"standard deviation {sigma:.3g}"
    else:
        found = "no bound on the point"
    return (
        f"{found} along the constraint lines, which cross at {np.degrees(crossing_rad):.3g}°; "
        f"at most {max_sigma:.3g} is accepted"
    )


def _views_disagree(found: Intersection, views: int, options: PointingOptions) -> str:
    """Return why three or more constraint lines are inconsistent; empty if they are consistent."""
    freedom = views - 2
    if freedom == 0:
        return ""
    # Wilson and Hilferty 1931: the cube root of χ² / freedom is close to normal.
    variance = 2.0 / (9.0 * freedom)
    limit = freedom * (1.0 - variance + options.nsigma * np.sqrt(variance)) ** 3
    if found.chi2 <= limit:
        return ""
    return (
        f"the views contradict each other: χ² = {found.chi2:.3g}, at most {limit:.3g} is expected"
    )


def _misplaced(
    found: Intersection,
    views: Sequence[PlaneView],
    fingers: Sequence[FingerLine],
    names: Sequence[str],
    options: PointingOptions,
) -> str:
    """Return why a view contradicts the point, which lies behind its fingertip; else empty."""
    placed = []
    for name, view, finger in zip(names, views, fingers, strict=True):
        place = view.ahead_of_tip(finger, found)
        if place is None:
            return f"the point lies beyond the horizon of {name}"
        ahead, variance = place
        tip_sigma_px = options.tip_sigma_px * finger.largeness
        placed.append((ahead, math.sqrt(variance + tip_sigma_px**2)))
    excess = [ahead + options.nsigma * sigma_px for ahead, sigma_px in placed]
    k = excess.index(min(excess))
    if excess[k] >= 0.0:
        return ""
    return f"the point lies {-placed[k][0]:.3g} px behind the finger tip in {names[k]}"


def _refuse_unmatched(
    finger_lines: Sequence[FingerLine | Status],
    plane_views: Sequence[PlaneView],
    names: Sequence[str],
    time_s: float,
    options: PointingOptions,
) -> None:
    if len(plane_views) < 2:
        raise InvalidInputError(f"{len(plane_views)} plane_views; pointing needs two or more")
    if len(names) != len(plane_views):
        raise InvalidInputError(
            f"{len(names)} names for {len(plane_views)} plane_views; one for each is needed"
        )
    if len(finger_lines) != len(plane_views):
        raise InvalidInputError(
            f"{len(finger_lines)} finger_lines for {len(plane_views)} plane_views; "
            "one entry for each is needed, a Status where a view has no finger line"
        )
    in_range(time_s, "time_s", -_LARGEST, _LARGEST)
    for k, entry in enumerate(finger_lines):
        if isinstance(entry, FingerLine):
            skew = entry.time_s - time_s
            if abs(skew) > options.max_skew_s:
                raise InvalidInputError(
                    f"finger_lines[{k}] is {skew:+.4g} s off the fix; at most "
                    f"{options.max_skew_s:g} s are right: align() brings views to one time"
                )
        elif not isinstance(entry, Status) or entry is Status.OK:
            raise InvalidInputError(
                f"finger_lines[{k}] is {entry!r}; a FingerLine, or the Status of a view without one"
            )
