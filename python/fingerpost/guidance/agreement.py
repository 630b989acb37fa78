"""Consistency of the places that the gripper visited, and registration of the views by them.

Every view gives a homography from the robot's X, Y to its image (eq. 1 of the paper with the
robot's own coordinates on the plane). N places give 2N equations for its 8 degrees of freedom, so

* the weighted sum of squared residuals is χ² with 2N − 8 degrees of freedom if all places are
  consistent;
* wrong detections are the smallest set of places without which the rest are consistent, if no other
  set of that size explains the contradiction equally well;
* the covariance of the homography's entries gives the uncertainty of the plane, whatever its cause:
  places nearly on one line, too close together, too few, or poorly detected.

A place's error in the image is that of the finder and, through the homography, that of the arm. The
latter is common to all views, but treated as independent here, which makes a fix less certain,
never more.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.checks import covariance_array, finite_array, in_range
from fingerpost.errors import InvalidInputError
from fingerpost.guidance.errors import InconsistentPlaneError, PoorPlaneError
from fingerpost.homography import (
    MIN_REFERENCE_POINTS,
    transfer_jacobian_by_entries,
    transfer_jacobian_by_point,
    transfer_to_image,
)
from fingerpost.lens import Lens
from fingerpost.pointing import PlaneView

ALARM = 1e-3
"""Probability of a false alarm in a view; one costs a second visit."""

RIVAL_CHI2 = 13.8
"""Difference of χ² up to which another set explains a contradiction as well as the best one:
e^(13.8 / 2) is a likelihood ratio of a thousand."""

MAX_WRONG = 2
"""Greatest number of wrong places that are identified."""

MIN_CHECKED = 5
"""Least number of remaining places whose agreement is significant: 4 fit any homography."""

NARROW = 5.0
"""Least spread of the places, in standard deviations of the finder, for which they define a plane.
"""

NEARLY_A_LINE = 0.1
"""Ratio of the spread across to that along the line of best fit below which places are nearly
collinear."""


@dataclass(frozen=True, eq=False, slots=True)
class Sightings:
    """Detections of the gripper in one view, at the places it visited.

    Parameters
    ----------
    name
        Name of the view.
    pixels_px : (N, 2)
        One position per place, in the order of the visits [px].
    covariances_px2 : (N, 2, 2)
        Covariances of the finder alone, positive definite [px²].
    lens
        The view's lens, if known.
    """

    name: str
    pixels_px: NDArray[np.float64]
    covariances_px2: NDArray[np.float64]
    lens: Lens | None = None

    def __post_init__(self) -> None:
        pixels = finite_array(self.pixels_px, "pixels_px", ("N", 2))
        covariances = covariance_array(self.covariances_px2, "covariances_px2", ("N", 2, 2))
        if len(pixels) != len(covariances):
            raise InvalidInputError(
                f"view {self.name}: {len(pixels)} pixels_px but {len(covariances)} covariances_px2"
            )
        object.__setattr__(self, "pixels_px", pixels)
        object.__setattr__(self, "covariances_px2", covariances)


@dataclass(frozen=True, eq=False, slots=True)
class ViewTie:
    """Registration of one view with the robot.

    Attributes
    ----------
    name
        Name of the view.
    plane_view
        Its homography from the robot's X, Y [m], with the covariance of the entries.
    covariances_px2 : (N, 2, 2)
        Covariance of each place's pixel, from finder and arm [px²].
    residuals_px : (N, 2)
        Detected position less that predicted by the homography [px].
    distances : (N,)
        Mahalanobis distance of each place from its prediction by the others; its square is χ² with
        2 degrees of freedom. NaN for 4 places, which are not redundant.
    chi2, freedom
        Weighted sum of squared residuals, and its degrees of freedom.
    """

    name: str
    plane_view: PlaneView
    covariances_px2: NDArray[np.float64]
    residuals_px: NDArray[np.float64]
    distances: NDArray[np.float64]
    chi2: float
    freedom: int

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals' lengths [px]."""
        return float(np.sqrt(np.mean((self.residuals_px**2).sum(axis=1))))

    def sigma_m(self, positions_m: ArrayLike) -> NDArray[np.float64]:
        """Return the largest standard deviations (...) of places of the plane [m]."""
        positions = finite_array(positions_m, "positions_m", (..., 2))
        T, Σ = self.plane_view.image_from_plane, self.plane_view.entries_covariance
        by_entries = transfer_jacobian_by_entries(T, positions)
        by_point = np.linalg.inv(transfer_jacobian_by_point(T, positions))
        J = by_point @ by_entries
        return np.asarray(np.sqrt(np.linalg.eigvalsh(J @ Σ @ np.swapaxes(J, -1, -2))[..., -1]))


@dataclass(frozen=True, eq=False, slots=True)
class Agreement:
    """Consistent places, and the registration by them.

    Attributes
    ----------
    wrong
        Indices of the smallest set of places without which the others are consistent; empty if all
        are.
    kept
        Indices of the others, in order.
    ties
        Registration of each view by the places kept.
    """

    wrong: tuple[int, ...]
    kept: tuple[int, ...]
    ties: tuple[ViewTie, ...]

    @property
    def checked(self) -> bool:
        """Whether there were enough places for their agreement to be significant."""
        return len(self.kept) >= MIN_CHECKED


def tie_view(positions_m: ArrayLike, sightings: Sightings, arm_sigma_m: float) -> ViewTie:
    """Register one view with the robot by all places.

    Parameters
    ----------
    positions_m : (N, 2)
        The robot's X, Y of the detected point at each place [m], N ≥ 4.
    sightings
        Its detections in the view.
    arm_sigma_m
        Standard deviation of the arm's own position in X and in Y [m], ≥ 0.

    Raises
    ------
    DegenerateReferencePointsError
        Places or pixels that determine no homography.
    InvalidInputError
        As `fingerpost.pointing.PlaneView.from_reference_points`.
    """
    X = finite_array(positions_m, "positions_m", ("N", 2))
    fit = _fit(X, sightings, arm_sigma_m)
    distances = np.full(len(X), np.nan)
    if len(X) > MIN_REFERENCE_POINTS:
        distances = np.array([_left_out(k, X, sightings, fit.total) for k in range(len(X))])
    return ViewTie(
        sightings.name, fit.view, fit.total, fit.residuals, distances, fit.chi2, 2 * len(X) - 8
    )


@dataclass(frozen=True, eq=False, slots=True)
class _Fit:
    """One view's homography by some places, without the distance of each place."""

    view: PlaneView
    total: NDArray[np.float64]
    residuals: NDArray[np.float64]

    @property
    def chi2(self) -> float:
        return float(np.sum(_squared_distances(self.residuals, self.total)))


def _fit(X: NDArray[np.float64], sightings: Sightings, arm_sigma_m: float) -> _Fit:
    pixels, covariances, lens = sightings.pixels_px, sightings.covariances_px2, sightings.lens
    first = PlaneView.from_reference_points(X, pixels, covariances, lens)
    arm = transfer_jacobian_by_point(first.image_from_plane, X)
    if lens is not None:
        arm = np.linalg.inv(lens.undistort_jacobian(pixels)) @ arm
    total = covariances + arm_sigma_m**2 * arm @ np.swapaxes(arm, 1, 2)
    view = PlaneView.from_reference_points(X, pixels, total, lens)
    return _Fit(view, total, pixels - view.project(X))


def agree(
    positions_m: ArrayLike,
    views: Sequence[Sightings],
    *,
    arm_sigma_m: float = 0.0,
    numbers: Sequence[int] | None = None,
) -> Agreement:
    """Find the places that are consistent in all views.

    Parameters
    ----------
    positions_m : (N, 2)
        The robot's X, Y of the detected point at each place [m].
    views
        One or more views, each with N sightings.
    arm_sigma_m
        Standard deviation of the arm's own position in X and in Y [m], ≥ 0.
    numbers
        Numbers of the places in messages; by default 1, 2, ...

    Raises
    ------
    PoorPlaneError
        Fewer than 4 places, or places or pixels that determine no homography.
    InconsistentPlaneError
        They contradict each other, and no set of at most `MAX_WRONG` places explains it, or more
        than one does; the message names the suspects.
    """
    X = finite_array(positions_m, "positions_m", ("N", 2))
    arm_sigma_m = in_range(arm_sigma_m, "arm_sigma_m", 0.0)
    if len(X) < MIN_REFERENCE_POINTS:
        raise PoorPlaneError(
            f"{len(X)} places found; a plane needs at least {MIN_REFERENCE_POINTS}, and "
            f"{MIN_CHECKED + 1} or more to identify a wrong one"
        )
    _refuse_a_line(X)
    for view in views:
        _refuse_narrow(X, view)
    everything = range(len(X))
    most = max(0, min(MAX_WRONG, len(X) - MIN_CHECKED))
    for count in range(most + 1):
        explained: dict[tuple[int, ...], float] = {}
        for wrong in itertools.combinations(everything, count):
            kept = tuple(k for k in everything if k not in wrong)
            if (chi2 := _agreed(X, views, kept, arm_sigma_m)) is not None:
                explained[wrong] = chi2
        best = min(explained.values(), default=0.0)
        likely = [wrong for wrong, chi2 in explained.items() if chi2 <= best + RIVAL_CHI2]
        if len(likely) == 1:
            (wrong,) = likely
            kept = tuple(k for k in everything if k not in wrong)
            ties = tuple(tie_view(X[list(kept)], _some(v, kept), arm_sigma_m) for v in views)
            return Agreement(wrong, kept, ties)
        if likely:
            raise InconsistentPlaneError(
                _ambiguous(likely, len(X), numbers or range(1, len(X) + 1))
            )
    raise InconsistentPlaneError(_unexplained(X, views, arm_sigma_m))


def need_certainty(
    agreement: Agreement, corners_m: ArrayLike, max_sigma_m: float
) -> NDArray[np.float64]:
    """Check that the plane is certain enough everywhere in a region.

    Parameters
    ----------
    agreement
        Agreement of the visited places.
    corners_m : (C, 2)
        Corners of the region in the robot's X, Y [m].
    max_sigma_m
        Largest accepted standard deviation in any direction [m], > 0.

    Returns
    -------
    (V, C)
        The standard deviations: one row per view, one column per corner [m].

    Raises
    ------
    PoorPlaneError
        It is not; the message names the view, the corner and the most likely reason.
    """
    corners = finite_array(corners_m, "corners_m", ("N", 2))
    sigma_m = np.array([tie.sigma_m(corners) for tie in agreement.ties])
    view, corner = np.unravel_index(int(np.argmax(sigma_m)), sigma_m.shape)
    if sigma_m[view, corner] <= max_sigma_m:
        return sigma_m
    tie = agreement.ties[view]
    raise PoorPlaneError(
        f"view {tie.name}: the plane is uncertain by {1000 * sigma_m[view, corner]:.1f} mm (σ) at "
        f"({corners[corner, 0]:g}, {corners[corner, 1]:g}) m, at most {1000 * max_sigma_m:g} mm "
        f"will do; {_remedy(tie, corners)}"
    )


def chi2_limit(freedom: int, tail: float) -> float:
    """Return the χ² that is exceeded with a given probability.

    For an even number of degrees of freedom 2m, P(χ² > x) = e^(−x/2) Σ_{j<m} (x/2)^j / j!; it falls
    from 1 to 0, so it is bisected.

    Parameters
    ----------
    freedom
        Degrees of freedom, even, ≥ 2.
    tail
        The probability, between 0 and 1.

    Raises
    ------
    InvalidInputError
        An odd number of degrees of freedom, or a probability outside that range.
    """
    if freedom < 2 or freedom % 2:
        raise InvalidInputError(f"freedom is {freedom}; an even number from 2 is needed")
    if not 0 < tail < 1:
        raise InvalidInputError(f"tail is {tail}; a number between 0 and 1 is needed")
    low, high = 0.0, 2.0 * freedom
    while _chi2_tail(high, freedom) > tail:
        low, high = high, 2 * high
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if _chi2_tail(middle, freedom) > tail else (low, middle)
    return high


def _chi2_tail(x: float, freedom: int) -> float:
    terms = itertools.accumulate(
        range(1, freedom // 2), lambda term, j: term * x / 2 / j, initial=1.0
    )
    return math.exp(-x / 2) * sum(terms)


def _agreed(
    X: NDArray[np.float64], views: Sequence[Sightings], kept: tuple[int, ...], arm_sigma_m: float
) -> float | None:
    """Return the χ² of all views by some places; None if these are inconsistent in one of them.

    Four places in general position fit any homography; collinear ones determine none.
    """
    freedom = 2 * len(kept) - 8
    limit = chi2_limit(freedom, ALARM) if freedom else math.inf
    total = 0.0
    for view in views:
        try:
            chi2 = _fit(X[list(kept)], _some(view, kept), arm_sigma_m).chi2
        except InvalidInputError:  # they determine no homography
            return None
        if chi2 > limit:
            return None
        total += chi2
    return total


def _some(view: Sightings, kept: tuple[int, ...]) -> Sightings:
    """Return the sightings of some places."""
    index = list(kept)
    return Sightings(view.name, view.pixels_px[index], view.covariances_px2[index], view.lens)


def _left_out(
    k: int, X: NDArray[np.float64], sightings: Sightings, total: NDArray[np.float64]
) -> float:
    """Return the Mahalanobis distance of a pixel from its prediction by the other places."""
    others = np.arange(len(X)) != k
    try:
        view = PlaneView.from_reference_points(
            X[others], sightings.pixels_px[others], total[others], sightings.lens
        )
    except InvalidInputError:
        return math.inf  # the other places determine no homography
    by_entries = transfer_jacobian_by_entries(view.image_from_plane, X[k])
    predicted = by_entries @ view.entries_covariance @ by_entries.T
    if sightings.lens is not None:
        ideal = transfer_to_image(view.image_from_plane, X[k])
        distort = np.linalg.inv(sightings.lens.undistort_jacobian(sightings.lens.distort(ideal)))
        predicted = distort @ predicted @ distort.T
    residual = sightings.pixels_px[k] - view.project(X[k])
    return float(np.sqrt(_squared_distances(residual, predicted + total[k])))


def _squared_distances(
    residuals: NDArray[np.float64], covariances: NDArray[np.float64]
) -> NDArray[np.float64]:
    solved = np.linalg.solve(covariances, residuals[..., None])[..., 0]
    return np.asarray((residuals * solved).sum(axis=-1))


def _spread(points: NDArray[np.float64]) -> tuple[float, float]:
    """Root mean square spread along and across the line of best fit."""
    along, across = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(along / math.sqrt(len(points))), float(across / math.sqrt(len(points)))


def _refuse_a_line(X: NDArray[np.float64]) -> None:
    along, across = _spread(X)
    if not across > 1e-6 * along:
        raise PoorPlaneError(
            "all places lie on one line; a plane needs places that spread in two directions"
        )


def _refuse_narrow(X: NDArray[np.float64], view: Sightings) -> None:
    _, across_px = _spread(view.pixels_px)
    sigma_px = _sigma_px(view.covariances_px2)
    if across_px < NARROW * sigma_px:
        raise PoorPlaneError(
            f"view {view.name}: the places spread by only {across_px:.1f} px in the image, found "
            f"to {sigma_px:.1f} px: "
            + (_line_remedy(X) or "bring the camera nearer or higher, or visit a wider region")
        )


def _line_remedy(X: NDArray[np.float64]) -> str:
    """Return the remark that places are nearly collinear, if they are."""
    along, across = _spread(X)
    if across >= NEARLY_A_LINE * along:
        return ""
    return (
        f"the places lie nearly on one line (spread {1000 * along:.0f} by {1000 * across:.0f} mm): "
        "spread them in two directions, by a wider region"
    )


def _sigma_px(covariances_px2: NDArray[np.float64]) -> float:
    """Root mean square of the standard deviations of u and v."""
    return float(np.sqrt(np.trace(covariances_px2, axis1=1, axis2=2).mean() / 2))


def _remedy(tie: ViewTie, corners: NDArray[np.float64]) -> str:
    """Return the most likely cause of a plane's uncertainty, and the remedy."""
    X = tie.plane_view.plane_points
    if remedy := _line_remedy(X):
        return remedy
    if float(np.ptp(X, axis=0).max()) < 0.5 * float(np.ptp(corners, axis=0).max()):
        return "the places cover little of the region: visit more of it"
    return (
        f"{len(X)} places, found to {_sigma_px(tie.covariances_px2):.1f} px: visit more, find the "
        "gripper better, or bring the camera nearer"
    )


def _ambiguous(explained: Sequence[tuple[int, ...]], count: int, numbers: Sequence[int]) -> str:
    suspects = sorted({place for wrong in explained for place in wrong})
    named = ", ".join(f"{numbers[place]}" for place in suspects)
    return (
        f"one of the places {named} is wrong, but which one cannot be determined from {count}: "
        "visit more places"
    )


def _unexplained(X: NDArray[np.float64], views: Sequence[Sightings], arm_sigma_m: float) -> str:
    try:
        ties = [tie_view(X, view, arm_sigma_m) for view in views]
    except InvalidInputError:
        return (
            "no homography fits what the views found at the places visited: see that what is found "
            "is the gripper, at every place the same part of it"
        )
    tie = max(ties, key=lambda one: one.chi2 / max(one.freedom, 1))
    expected_px = math.sqrt(2) * _sigma_px(tie.covariances_px2)
    return (
        f"view {tie.name}: the places miss one homography by {tie.rms_px:.2f} px (RMS) where "
        f"{expected_px:.2f} px is expected of the finder; give the view's lens, see that the "
        "gripper is held alike everywhere, or state a larger sigma for the finder"
    )
