"""A picture of an experiment: the indicated points, and the coverage of the ellipses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fingerpost.experiment.summary import (
    GROSS_SHARE,
    Summary,
    binomial_band,
    chi2_quantile,
    is_gross,
)
from fingerpost.experiment.table import number
from fingerpost.experiment.trial import Trial
from fingerpost.recording import write_picture
from fingerpost.recording.sheet import Colour, Sheet
from fingerpost.uncertainty import confidence_ellipse

if TYPE_CHECKING:
    from fingerpost.experiment.result import ExperimentResult

Array = NDArray[np.float64]

_WIDTH, _HEIGHT = 1640, 980
_PLANE = (90, 120, 760)  # left, top, side of the plan view [px]
_COVERAGE = (1000, 120, 520)  # of the coverage plot
_FIGURES_TOP = 752

_TITLE_PX, _TEXT_PX, _SMALL_PX = 24, 19, 17

_PAPER: Colour = (255, 255, 255)
_INK: Colour = (50, 45, 40)
_FAINT: Colour = (150, 145, 140)
_GRID: Colour = (232, 230, 228)
_BAND: Colour = (246, 232, 215)
_HELD: Colour = (176, 118, 30)
_MISSED: Colour = (50, 60, 215)
_RECIPE: Colour = (30, 140, 240)

# Number of targets that are drawn, as more would overlap; the figures include all of them.
_MOST_DRAWN = 400
# Ellipses are enlarged so that the typical one spans this share of the plane.
_VISIBLE_SHARE = 0.02
_MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
# Margin of the plan view around the plane, as a share of its side.
_MARGIN = 0.04

_SQUARE = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])


def draw_result(result: ExperimentResult, path: Path) -> None:
    """Draw a result into an image file; see `ExperimentResult.draw`."""
    page = Sheet.blank((_WIDTH, _HEIGHT), _PAPER)
    for row, line in enumerate(result.title):
        place = (_PLANE[0], 44 + 30 * row)
        page.text(line, place, _TITLE_PX if row == 0 else _TEXT_PX, _INK, bold=row == 0)
    _draw_plane(page, result)
    summary = result.summary
    if summary.points is not None:
        _draw_coverage(page, result.trials, summary)
    for row, line in enumerate(_figures(summary, result.unit, result.plane_size)):
        page.text(line, (_COVERAGE[0], _FIGURES_TOP + 28 * row), _TEXT_PX, _INK)
    write_picture(path, page.pixels)


class _Plot:
    """A square plot on the page; the scene of its `sheet` is the plotted values."""

    def __init__(self, page: Sheet, place: tuple[int, int, int], low: Array, span: float) -> None:
        self._page = page
        self._left, self._top, self._side = place
        self._corner = np.array([self._left, self._top])
        self._low, self.span = low, span
        scale = self._side / span
        pixels_from_values = np.array(
            [[scale, 0.0, -scale * low[0]], [0.0, -scale, self._side + scale * low[1]]]
        )
        rows = slice(self._top, self._top + self._side)
        columns = slice(self._left, self._left + self._side)
        self.sheet = Sheet(page.pixels[rows, columns], pixels_from_values)

    def grid(self, ticks: Sequence[float], labels: Sequence[str]) -> None:
        """Lines and labels at the same values of both axes, where they are in the plot."""
        high = self._low + self.span
        for tick, label in zip(ticks, labels, strict=True):
            u, v = self._corner + self.sheet.place(np.array([tick, tick]))
            if self._low[0] <= tick <= high[0]:
                self.sheet.line(np.array([(tick, self._low[1]), (tick, high[1])]), _GRID, 1)
                below = self._top + self._side + 24
                self._page.text(label, (u, below), _SMALL_PX, _INK, anchor=0.5)
            if self._low[1] <= tick <= high[1]:
                self.sheet.line(np.array([(self._low[0], tick), (high[0], tick)]), _GRID, 1)
                self._page.text(label, (self._left - 10, v + 6), _SMALL_PX, _INK, anchor=1.0)

    def frame(self) -> None:
        """Draw the border."""
        self._page.line(_closed(self._corner + self._side * _SQUARE), _FAINT, 1)

    def square(self, middle: Array, side_px: float, colour: Colour) -> None:
        """Fill a square about a value."""
        around = side_px * (_SQUARE - 0.5)
        self.sheet.on_pixels().area(self.sheet.place(middle) + around, colour)


def _closed(points: Array) -> Array:
    return np.concatenate([points, points[:1]])


def _draw_plane(page: Sheet, result: ExperimentResult) -> None:
    plot = _plane_plot(page, result)
    step = _tick_step(plot.span)
    low = result.plane_points.min(axis=0).min()
    first = math.floor((low - plot.span) / step)
    ticks = [step * k for k in range(first, first + math.ceil(4 * plot.span / step))]
    plot.grid(ticks, [f"{tick:g}" for tick in ticks])
    shown = result.trials[:_MOST_DRAWN]
    magnification = _magnification(shown, plot.span)
    for trial in shown:
        _draw_trial(plot, trial, magnification, result.plane_size)
    for corner in result.plane_points:
        plot.square(corner, 8.0, _INK)
    plot.frame()
    _draw_plane_legend(page, result, len(shown), magnification)


def _plane_plot(page: Sheet, result: ExperimentResult) -> _Plot:
    seen = np.vstack([result.plane_points, [trial.target for trial in result.trials]])
    low, high = seen.min(axis=0), seen.max(axis=0)
    span = float((high - low).max()) * (1 + 2 * _MARGIN)
    return _Plot(page, _PLANE, (low + high - span) / 2, span)


def _draw_trial(plot: _Plot, trial: Trial, magnification: int, plane_size: float) -> None:
    sheet, target = plot.sheet, trial.target
    if trial.point is None or trial.covariance is None:
        sheet.cross(sheet.place(target), 4.5, _FAINT)
        return
    if is_gross(trial, plane_size):
        sheet.line(np.array([target, _clipped(target, trial.point, plot.span)]), _MISSED, 2)
        sheet.dot(sheet.place(target), 3.5, _MISSED)
        return
    ellipse = confidence_ellipse(trial.point, trial.covariance)
    colour = _HELD if trial.mahalanobis2 <= chi2_quantile(0.95) else _MISSED
    found = target + magnification * (trial.point - target)
    sheet.line(np.array([target, found]), colour, 1)
    sheet.line(_closed(target + magnification * (ellipse.polygon() - target)), colour, 1)
    sheet.dot(sheet.place(target), 2.5, _INK)


def _clipped(start: Array, end: Array, longest: float) -> Array:
    """End of an arrow that is not longer than the plot."""
    away = end - start
    return np.asarray(start + away * min(1.0, longest / math.hypot(*away)))


def _draw_plane_legend(
    page: Sheet, result: ExperimentResult, shown: int, magnification: int
) -> None:
    left, top, side = _PLANE
    scale = "at true scale" if magnification == 1 else f"{magnification} times as large"
    some = "" if shown == len(result.trials) else f"; the first {shown} of {len(result.trials)}"
    head = f"Targets ({result.unit}), with error and 95 % ellipse {scale}{some}"
    page.text(head, (left, top - 14), _TEXT_PX, _INK)
    turn = np.linspace(0, 2 * np.pi, 33)
    ellipse = np.stack([8 * np.cos(turn), 5 * np.sin(turn)], axis=1)
    dash = np.array([(-8.0, 0.0), (8.0, 0.0)])
    u, v = float(left), top + side + 56.0
    for label in (
        "reference point",
        "holds target",
        "misses it",
        "gross error, true scale",
        "no point",
    ):
        place = np.array([u + 8.0, v - 5.0])
        if label == "reference point":
            page.area(place + 8.0 * (_SQUARE - 0.5), _INK)
        elif label == "no point":
            page.cross(place, 4.5, _FAINT)
        elif label == "gross error, true scale":
            page.line(place + dash, _MISSED, 2)
        else:
            page.line(place + ellipse, _HELD if label == "holds target" else _MISSED, 1)
        _, u = page.text(label, (u + 24, v), _SMALL_PX, _INK)
        u += 28.0


def _draw_coverage(page: Sheet, trials: Sequence[Trial], summary: Summary) -> None:
    plot = _Plot(page, _COVERAGE, np.zeros(2), 1.0)
    sheet = plot.sheet
    squared = np.sort([trial.mahalanobis2 for trial in trials if trial.point is not None])
    nominal = np.linspace(0.0, 0.999, 200)
    low, high = np.array([binomial_band(len(squared), float(p)) for p in nominal]).T
    around = np.append(nominal, nominal[::-1]), np.append(low, high[::-1])
    sheet.area(np.stack(around, axis=-1), _BAND)
    ticks = np.linspace(0.0, 1.0, 6).tolist()
    plot.grid(ticks, [f"{100 * tick:g} %" for tick in ticks])
    sheet.line(np.array([(0.0, 0.0), (1.0, 1.0)]), _FAINT, 1)
    # An ellipse of confidence p contains squared distances up to −2 ln(1 − p).
    held = np.searchsorted(squared, -2.0 * np.log1p(-nominal), side="right") / len(squared)
    sheet.line(np.column_stack([nominal, held]), _HELD, 2)
    plot.frame()
    for coverage in summary.points.coverages if summary.points else ():
        sheet.dot(sheet.place(np.array([coverage.nominal, coverage.held])), 5, _HELD)
    if summary.recipe is not None:
        sheet.dot(sheet.place(np.array([0.95, summary.recipe.held])), 5, _RECIPE)
    left, top, side = _COVERAGE
    head = "Ellipses that hold their target, over what they promise"
    page.text(head, (left, top - 14), _TEXT_PX, _INK)
    u, v = float(left), top + side + 56.0
    for colour, label in (
        (_HELD, "fingerpost"),
        (_BAND, "honest, by chance (95 %)"),
        (_RECIPE, "the recipe of 1994"),
    ):
        page.area(np.array([u, v - 13.0]) + 14.0 * _SQUARE, colour)
        _, u = page.text(label, (u + 24, v), _SMALL_PX, _INK)
        u += 28.0


def _figures(summary: Summary, unit: str, plane_size: float) -> list[str]:
    """Return the most important figures."""
    gross = f"{summary.gross} gross errors > {number(GROSS_SHARE * plane_size)} {unit}"
    lines = [f"{summary.available} of {summary.targets} targets have a point; {gross}"]
    points = summary.points
    if points is None:
        return lines
    bound = summary.bound
    least = "" if bound is None else f"; Cramér–Rao bound {number(bound.rms)}"
    if points.nees is not None:  # not all errors are gross
        share = 100 * points.rms / plane_size
        lines.append(f"RMS {number(points.rms)} {unit} = {share:.3f} % of the plane{least}")
    lines += [
        f"median {number(points.median)}, 95th percentile {number(points.percentile_95)} {unit}",
        "ellipses of "
        + ", ".join(f"{100 * c.nominal:g}" for c in points.coverages)
        + " hold "
        + ", ".join(f"{100 * c.held:.1f}" for c in points.coverages)
        + " %",
        f"95 % ellipse: {number(points.ellipse_area)} {unit}² on average",
    ]
    if summary.recipe is not None:
        lines.append(
            f"the recipe of 1994: {number(summary.recipe.area)} {unit}², holds "
            f"{100 * summary.recipe.held:.1f} %"
        )
    if points.nees is not None:
        lines.append(f"NEES of the point {points.nees.mean:.2f} (honest: 1)")
    return lines


def _magnification(trials: Sequence[Trial], span: float) -> int:
    """Return the magnification of errors and ellipses, so that the typical ellipse is visible."""
    reaches = [
        math.sqrt(np.linalg.eigvalsh(trial.covariance)[-1])
        for trial in trials
        if trial.point is not None and trial.covariance is not None
    ]
    usual = 2.0 * float(np.median(reaches)) if reaches else 0.0
    fitting = [m for m in _MAGNIFICATIONS if m * usual <= _VISIBLE_SHARE * span]
    return fitting[-1] if fitting else 1


def _tick_step(span: float) -> float:
    """Return a round number that divides a span into four to ten parts."""
    power = float(10.0 ** math.floor(math.log10(span / 4.0)))
    return max(step for step in (power, 2 * power, 5 * power) if step <= span / 4.0)
