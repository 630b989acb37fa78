"""The figures of an experiment, each with its formula.

With e the error of a point, Σ the covariance of its fix, and n points:

- *gross errors*: ``|e|`` above `GROSS_SHARE` of the plane (20 mm of 400 mm). They are excluded from
  RMS, mean error, NEES and efficiency only.
- *RMS* ``√(mean |e|²)``; median and 95th percentile of ``|e|``.
- *coverage* at p: share of the points with ``eᵀ Σ⁻¹ e ≤ −2 ln(1 − p)``.
- *NEES* (normalised estimation error squared) ``mean(eᵀ Σ⁻¹ e) / dof``: 1 if Σ is consistent, above
  if it is too small.
- *area* of the 95 % ellipse ``5.991 π √det Σ``. *At equal coverage* both our ellipses and those of
  the 1994 recipe are scaled until 95 % of them contain their target.
- *efficiency* ``Σ tr B / Σ |e|²``, B the Cramér–Rao bound of each pose (see `bound`): the share of
  the picture's information that is used, if the references are exact.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerpost.experiment.trial import LineTrial, Trial, squared_in_sigmas
from fingerpost.pointing import Status
from fingerpost.uncertainty import confidence_ellipse

Array = NDArray[np.float64]

GROSS_SHARE = 0.05
"""Errors above this share of the plane's size are gross: something else was tracked."""

NOMINAL_COVERAGES = (0.50, 0.68, 0.95, 0.99)

CHANCE = 0.95
"""Probability that a figure of consistent covariances is within its stated band."""

# Standard deviations of a normal distribution that contain `CHANCE`.
_CHANCE_SIGMAS = 1.959964


@dataclass(frozen=True)
class Coverage:
    """Share of ellipses of one nominal confidence that contain their target."""

    nominal: float  # confidence of the ellipse, 0…1
    held: float  # share that contain the target, 0…1
    chance: tuple[float, float]  # band of the share for consistent covariances


@dataclass(frozen=True)
class Nees:
    """Normalised estimation error squared."""

    mean: float
    chance: tuple[float, float]  # band of the mean for consistent covariances


@dataclass(frozen=True)
class PointFigures:
    """Figures of the indicated points; lengths in plane units."""

    rms: float  # without gross errors
    rms_of_all: float
    median: float
    percentile_95: float
    largest: float
    mean_error: tuple[float, float]  # in X and Y, without gross errors
    coverages: tuple[Coverage, ...]  # empty if points have no covariance
    nees: Nees | None  # None if every error is gross, or points have no covariance
    ellipse_area: float  # mean of the 95 % ellipses, plane units²; NaN without covariance
    ellipse_area_at_95: float  # the same, scaled until 95 % contain their target


@dataclass(frozen=True)
class RecipeFigures:
    """Figures of the 1994 ellipse, "two standard deviations (95 %)"."""

    held: float  # share that contain the target, 0…1
    area: float  # mean, plane units²
    area_at_95: float  # the same, scaled until 95 % contain their target


@dataclass(frozen=True)
class BoundFigures:
    """The Cramér–Rao bound of the poses without gross errors, and the efficiency."""

    rms: float  # least RMS, plane units
    efficiency: float  # 1 reaches the bound


@dataclass(frozen=True)
class LineFigures:
    """Figures of the finger lines of all views, for points without gross errors."""

    count: int
    rms_offset_px: float
    rms_angle_rad: float
    mean_offset_px: float
    mean_angle_rad: float
    nees_offset: Nees
    nees_angle: Nees
    nees: Nees  # of both, with their correlation
    bound_offset_px: float | None  # least RMS
    bound_angle_rad: float | None
    efficiency_angle: float | None  # variances, bound over measured


@dataclass(frozen=True)
class Summary:
    """All figures of an experiment."""

    targets: int
    available: int  # targets with a point
    statuses: dict[str, int]  # of the others
    gross: int  # of the available
    gross_beyond_99: int  # of these, outside their 99 % ellipse
    points: PointFigures | None  # None without a point
    recipe: RecipeFigures | None  # None without any ellipse
    bound: BoundFigures | None  # None if unknown
    lines: LineFigures | None  # None for footage

    @property
    def availability(self) -> float:
        """Share of the targets with a point, 0 to 1."""
        return self.available / self.targets


def summarise(trials: Sequence[Trial], plane_size: float) -> Summary:
    """Figures of trials.

    Parameters
    ----------
    trials
        At least one.
    plane_size
        Side of the working plane [plane units], > 0.
    """
    available = [trial for trial in trials if trial.point is not None]
    gross = [trial for trial in available if is_gross(trial, plane_size)]
    fair = [trial for trial in available if not is_gross(trial, plane_size)]
    refused = Counter(trial.status for trial in trials if trial.status is not Status.OK)
    return Summary(
        targets=len(trials),
        available=len(available),
        statuses={str(status): refused[status] for status in sorted(refused)},
        gross=len(gross),
        gross_beyond_99=sum(trial.mahalanobis2 > chi2_quantile(0.99) for trial in gross),
        points=_points(available, fair) if available else None,
        recipe=_recipe(available),
        bound=_bound(fair),
        lines=_lines([line for trial in fair for line in trial.lines]),
    )


def is_gross(trial: Trial, plane_size: float) -> bool:
    """Whether a trial has a point that is off by a gross error."""
    return trial.error > GROSS_SHARE * plane_size


def chi2_quantile(confidence: float) -> float:
    """Quantile of χ² with 2 degrees of freedom: an ellipse's squared radius, in sigmas."""
    return -2.0 * math.log1p(-confidence)


def binomial_band(
    count: int, probability: float, confidence: float = CHANCE
) -> tuple[float, float]:
    """Return the band of the share of successes by chance.

    Parameters
    ----------
    count
        Number of independent tries, ≥ 1.
    probability
        Probability of success in each, 0 to 1.
    confidence
        Least probability that the share is in the band.

    Returns
    -------
    tuple
        Smallest and largest share: quantiles of the binomial distribution, exact.
    """
    if not 0.0 < probability < 1.0:
        return probability, probability
    successes = np.arange(count + 1)
    log_factorials = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, count + 1)))])
    log_masses = (
        log_factorials[count]
        - log_factorials[successes]
        - log_factorials[count - successes]
        + successes * math.log(probability)
        + (count - successes) * math.log1p(-probability)
    )
    below = np.cumsum(np.exp(log_masses))
    tail = (1.0 - confidence) / 2.0
    low, high = np.searchsorted(below, [tail, 1.0 - tail])
    return float(low) / count, min(float(high), count) / count


def _held_by_95(squared: Array) -> float:
    """Return the least value that 95 % of the values do not exceed."""
    return float(np.percentile(squared, 95, method="inverted_cdf"))


def _points(available: Sequence[Trial], fair: Sequence[Trial]) -> PointFigures:
    errors = np.array([trial.error for trial in available])
    fair_errors = np.array([trial.error for trial in fair])
    shifts = np.array([np.asarray(trial.point) - trial.target for trial in fair]).reshape(-1, 2)
    mean_x, mean_y = shifts.mean(axis=0).tolist() if fair else (math.nan, math.nan)
    squared = np.array([trial.mahalanobis2 for trial in available])
    areas = [
        confidence_ellipse(trial.point, trial.covariance).area
        for trial in available
        if trial.point is not None and trial.covariance is not None
    ]
    has_ellipses = len(areas) == len(available)
    area = float(np.mean(areas)) if has_ellipses else math.nan
    return PointFigures(
        rms=_rms(fair_errors),
        rms_of_all=_rms(errors),
        median=float(np.median(errors)),
        percentile_95=float(np.percentile(errors, 95)),
        largest=float(errors.max()),
        mean_error=(mean_x, mean_y),
        coverages=tuple(
            _coverage(squared, nominal) for nominal in NOMINAL_COVERAGES if has_ellipses
        ),
        nees=_nees(np.array([trial.mahalanobis2 for trial in fair]), 2)
        if fair and has_ellipses
        else None,
        ellipse_area=area,
        ellipse_area_at_95=area * _held_by_95(squared) / chi2_quantile(0.95),
    )


def _coverage(squared: Array, nominal: float) -> Coverage:
    held = float(np.mean(squared <= chi2_quantile(nominal)))
    return Coverage(nominal, held, binomial_band(len(squared), nominal))


def _nees(squared: Array, freedom: int) -> Nees:
    # χ² / k has mean 1 and variance 2 / k.
    reach = _CHANCE_SIGMAS * math.sqrt(2.0 / (freedom * len(squared)))
    return Nees(float(np.mean(squared)) / freedom, (1.0 - reach, 1.0 + reach))


def _recipe(available: Sequence[Trial]) -> RecipeFigures | None:
    drawn = [(trial.target, trial.recipe) for trial in available if trial.recipe is not None]
    # An exact line has no residuals, and its ellipse no size.
    drawn = [(target, ellipse) for target, ellipse in drawn if ellipse.semi_axes.min() > 0.0]
    if not drawn:
        return None
    squared = []
    for target, ellipse in drawn:
        c, s = math.cos(ellipse.angle_rad), math.sin(ellipse.angle_rad)
        along = np.array([[c, s], [-s, c]]) @ (target - ellipse.centre) / ellipse.semi_axes
        squared.append(float(along @ along))
    area = float(np.mean([ellipse.area for _, ellipse in drawn]))
    return RecipeFigures(
        held=float(np.mean(np.array(squared) <= 1.0)),
        area=area,
        area_at_95=area * _held_by_95(np.array(squared)),
    )


def _bound(fair: Sequence[Trial]) -> BoundFigures | None:
    known = [
        (float(np.trace(trial.bound)), trial.error**2) for trial in fair if trial.bound is not None
    ]
    if not known:
        return None
    least, measured = np.mean(known, axis=0).tolist()
    return BoundFigures(math.sqrt(least), least / measured if measured else math.inf)


def _lines(lines: Sequence[LineTrial]) -> LineFigures | None:
    if not lines:
        return None
    errors = np.array([line.error for line in lines])
    covariances = np.array([line.covariance for line in lines])
    with np.errstate(divide="ignore", invalid="ignore"):
        each = errors**2 / np.diagonal(covariances, axis1=1, axis2=2)
    both = np.array([squared_in_sigmas(line.error, line.covariance) for line in lines])
    rms_offset, rms_angle = np.sqrt(np.mean(errors**2, axis=0)).tolist()
    mean_offset, mean_angle = errors.mean(axis=0).tolist()
    bounds = [np.diag(line.bound) for line in lines if line.bound is not None]
    bound_offset = bound_angle = efficiency = None
    if len(bounds) == len(lines):
        bound_offset, bound_angle = np.sqrt(np.mean(bounds, axis=0)).tolist()
        efficiency = (bound_angle / rms_angle) ** 2 if rms_angle else math.inf
    return LineFigures(
        count=len(lines),
        rms_offset_px=rms_offset,
        rms_angle_rad=rms_angle,
        mean_offset_px=mean_offset,
        mean_angle_rad=mean_angle,
        nees_offset=_nees(each[:, 0], 1),
        nees_angle=_nees(each[:, 1], 1),
        nees=_nees(both, 2),
        bound_offset_px=bound_offset,
        bound_angle_rad=bound_angle,
        efficiency_angle=efficiency,
    )


def _rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(errors**2))) if len(errors) else math.nan
