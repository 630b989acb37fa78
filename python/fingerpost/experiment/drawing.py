"""A picture of an experiment: where the points fell, and whether the ellipses kept their word."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

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
from fingerpost.uncertainty import confidence_ellipse

if TYPE_CHECKING:
    from fingerpost.experiment.result import ExperimentResult

Array = NDArray[np.float64]
Colour = tuple[int, int, int]  # blue, green, red

_WIDTH, _HEIGHT = 1640, 980
_PLANE = (90, 120, 760)  # left, top, side of the plan view [px]
_COVERAGE = (1000, 120, 520)  # of the coverage plot
_FIGURES_TOP = 752

_INK: Colour = (50, 45, 40)
_FAINT: Colour = (150, 145, 140)
_GRID: Colour = (232, 230, 228)
_BAND: Colour = (246, 232, 215)
_HELD: Colour = (176, 118, 30)
_MISSED: Colour = (50, 60, 215)
_RECIPE: Colour = (30, 140, 240)

# More targets than these would hide each other; the figures count all of them.
_MOST_DRAWN = 400
# Ellipses are drawn so much larger that the usual one spans this share of the plane.
_VISIBLE_SHARE = 0.02
_MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
# The plan view shows so much around the plane, as a share of its side.
_MARGIN = 0.04

# OpenCV draws to 1/16 px.
_SHIFT = 4

# What the strokes of OpenCV's older fonts cannot write.
_PLAIN = str.maketrans({"×": "x", "±": "+/-", "–": "-", "²": "^2", "σ": "sigma", "é": "e"})


def draw_result(result: ExperimentResult, path: Path) -> None:
    """Draw a result into an image file; see `ExperimentResult.draw`."""
    canvas = _Canvas.blank()
    for row, line in enumerate(result.title):
        canvas.text((_PLANE[0], 44 + 30 * row), line, 0.72 if row == 0 else 0.56)
    _draw_plane(canvas, result)
    summary = result.summary
    if summary.points is not None:
        _draw_coverage(canvas, result.trials, summary)
    for row, line in enumerate(_figures(summary, result.unit, result.plane_size)):
        canvas.text((_COVERAGE[0], _FIGURES_TOP + 28 * row), line, 0.56)
    write_picture(path, canvas.image)


class _Canvas:
    """A sheet; places are in px, the first to the right, the second down."""

    def __init__(self, image: NDArray[np.uint8], corner: tuple[int, int] = (0, 0)) -> None:
        self.image = image
        self._corner = np.array(corner)

    @classmethod
    def blank(cls) -> _Canvas:
        """Take a white sheet."""
        return cls(np.full((_HEIGHT, _WIDTH, 3), 255, np.uint8))

    def window(self, place: tuple[int, int, int]) -> _Canvas:
        """Give a square of the sheet that keeps what is drawn within; places stay the sheet's."""
        left, top, side = place
        return _Canvas(self.image[top : top + side, left : left + side], (left, top))

    def lines(
        self, points: ArrayLike, colour: Colour, width: int = 1, *, closed: bool = False
    ) -> None:
        """Draw a polyline."""
        fixed = self._fixed(points)
        cv2.polylines(self.image, [fixed], closed, colour, width, cv2.LINE_AA, shift=_SHIFT)

    def area(self, points: ArrayLike, colour: Colour) -> None:
        """Fill a polygon."""
        cv2.fillPoly(self.image, [self._fixed(points)], colour, cv2.LINE_AA, shift=_SHIFT)

    def square(self, corner: Array, side: float, colour: Colour) -> None:
        """Fill a square, given its upper left corner."""
        self.area(corner + side * np.array([(0, 0), (1, 0), (1, 1), (0, 1)]), colour)

    def dot(self, place: ArrayLike, radius: float, colour: Colour) -> None:
        """Fill a circle."""
        u, v = self._fixed(place)[0, 0].tolist()
        size = round(radius * 2**_SHIFT)
        cv2.circle(self.image, (u, v), size, colour, cv2.FILLED, cv2.LINE_AA, shift=_SHIFT)

    def cross(self, place: Array, reach: float, colour: Colour) -> None:
        """Draw an ×."""
        for slope in (1.0, -1.0):
            arm = reach * np.array([1.0, slope])
            self.lines([place - arm, place + arm], colour)

    def text(
        self,
        place: tuple[float, float],
        text: str,
        size: float,
        colour: Colour = _INK,
        align: float = 0.0,
    ) -> None:
        """Write on a baseline; `align` 0 starts at the place, 1 ends there."""
        plain = text.translate(_PLAIN)
        font = cv2.FONT_HERSHEY_SIMPLEX
        (width, _), _ = cv2.getTextSize(plain, font, size, 1)
        u, v = round(place[0] - align * width), round(place[1])
        cv2.putText(self.image, plain, (u, v), font, size, colour, 1, cv2.LINE_AA)

    def _fixed(self, places: ArrayLike) -> NDArray[np.int32]:
        """Places as OpenCV takes them, (N, 1, 2)."""
        shifted = np.asarray(places, dtype=np.float64).reshape(-1, 1, 2) - self._corner
        return np.asarray(np.round(shifted * 2**_SHIFT), dtype=np.int32)


class _Axes:
    """A square plot: values to places, frame, ticks."""

    def __init__(
        self, canvas: _Canvas, place: tuple[int, int, int], low: Array, span: float
    ) -> None:
        self._canvas = canvas
        self._left, self._top, self.side = place
        self._low, self.span = low, span

    def at(self, values: ArrayLike) -> Array:
        """Places (..., 2) of values (..., 2); the second value grows upwards."""
        share = (np.asarray(values, dtype=np.float64) - self._low) / self.span
        return np.stack(
            [self._left + self.side * share[..., 0], self._top + self.side * (1 - share[..., 1])],
            axis=-1,
        )

    def grid(self, ticks: Sequence[float], labels: Sequence[str]) -> None:
        """Lines and labels at the same values of both axes, where they are in the plot."""
        for axis in (0, 1):
            for tick, label in zip(ticks, labels, strict=True):
                share = (tick - self._low[axis]) / self.span
                if not 0.0 <= share <= 1.0:
                    continue
                along = round(share * self.side)
                if axis == 0:
                    u, bottom = self._left + along, self._top + self.side
                    self._canvas.lines([(u, self._top), (u, bottom)], _GRID)
                    self._canvas.text((u, bottom + 24), label, 0.5, align=0.5)
                else:
                    v, right = self._top + self.side - along, self._left + self.side
                    self._canvas.lines([(self._left, v), (right, v)], _GRID)
                    self._canvas.text((self._left - 10, v + 6), label, 0.5, align=1.0)

    def frame(self) -> None:
        """Draw the border."""
        corners = self._low + self.span * np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
        self._canvas.lines(self.at(corners), _FAINT, closed=True)


def _draw_plane(canvas: _Canvas, result: ExperimentResult) -> None:
    axes = _plane_axes(canvas, result)
    step = _tick_step(axes.span)
    low = result.plane_points.min(axis=0).min()
    first = math.floor((low - axes.span) / step)
    ticks = [step * k for k in range(first, first + math.ceil(4 * axes.span / step))]
    axes.grid(ticks, [f"{tick:g}" for tick in ticks])
    shown = result.trials[:_MOST_DRAWN]
    magnification = _magnification(shown, axes.span)
    window = canvas.window(_PLANE)
    for trial in shown:
        _draw_trial(window, axes, trial, magnification, result)
    for corner in axes.at(result.plane_points):
        canvas.square(corner - 4.0, 8.0, _INK)
    axes.frame()
    _draw_plane_legend(canvas, result, len(shown), magnification)


def _plane_axes(canvas: _Canvas, result: ExperimentResult) -> _Axes:
    seen = np.vstack([result.plane_points, [trial.target for trial in result.trials]])
    low, high = seen.min(axis=0), seen.max(axis=0)
    span = float((high - low).max()) * (1 + 2 * _MARGIN)
    return _Axes(canvas, _PLANE, (low + high - span) / 2, span)


def _draw_trial(
    canvas: _Canvas, axes: _Axes, trial: Trial, magnification: int, result: ExperimentResult
) -> None:
    target = axes.at(trial.target)
    if trial.point is None or trial.covariance is None:
        canvas.cross(target, 4.5, _FAINT)
        return
    if is_gross(trial, result.plane_size):
        end = _clipped(trial.target, trial.point, axes)
        canvas.lines([target, axes.at(end)], _MISSED, 2)
        canvas.dot(target, 3.5, _MISSED)
        return
    ellipse = confidence_ellipse(trial.point, trial.covariance)
    colour = _HELD if trial.mahalanobis2 <= chi2_quantile(0.95) else _MISSED
    outline = trial.target + magnification * (ellipse.polygon() - trial.target)
    canvas.lines(
        [target, axes.at(trial.target + magnification * (trial.point - trial.target))], colour
    )
    canvas.lines(axes.at(outline), colour, closed=True)
    canvas.dot(target, 2.5, _INK)


def _clipped(start: Array, end: Array, axes: _Axes) -> Array:
    """End of an arrow that is not longer than the plot."""
    away = end - start
    return np.asarray(start + away * min(1.0, axes.span / math.hypot(*away)))


def _draw_plane_legend(
    canvas: _Canvas, result: ExperimentResult, shown: int, magnification: int
) -> None:
    left, top, side = _PLANE
    scale = "at true scale" if magnification == 1 else f"{magnification} times as large"
    some = "" if shown == len(result.trials) else f"; the first {shown} of {len(result.trials)}"
    canvas.text(
        (left, top - 14),
        f"Targets ({result.unit}), with error and 95 % ellipse {scale}{some}",
        0.56,
    )
    u, v = left, top + side + 56
    canvas.square(np.array([u, v - 9.0]), 8.0, _INK)
    canvas.text((u + 16, v), "reference point", 0.5)
    u += 175
    for colour, mark, label in (
        (_HELD, "o", "holds target"),
        (_MISSED, "o", "misses it"),
        (_MISSED, "-", "gross error, true scale"),
        (_FAINT, "x", "no point"),
    ):
        place = np.array([u + 8.0, v - 5.0])
        if mark == "o":
            turn = np.linspace(0, 2 * np.pi, 32, endpoint=False)
            canvas.lines(
                place + np.stack([8 * np.cos(turn), 5 * np.sin(turn)], axis=1), colour, closed=True
            )
        elif mark == "-":
            canvas.lines([(u, v - 5), (u + 16, v - 5)], colour, 2)
        else:
            canvas.cross(place, 4.5, colour)
        canvas.text((u + 24, v), label, 0.5)
        u += 54 + 8 * len(label)


def _draw_coverage(canvas: _Canvas, trials: Sequence[Trial], summary: Summary) -> None:
    axes = _Axes(canvas, _COVERAGE, np.zeros(2), 1.0)
    squared = np.sort([trial.mahalanobis2 for trial in trials if trial.point is not None])
    nominal = np.linspace(0.0, 0.999, 200)
    low, high = np.array([binomial_band(len(squared), float(p)) for p in nominal]).T
    band = np.stack([np.tile(nominal, 2), np.append(low, high)], axis=-1)
    around = [*range(len(low)), *reversed(range(len(low), len(band)))]
    canvas.area(axes.at(band[around]), _BAND)
    ticks = np.linspace(0.0, 1.0, 6).tolist()
    axes.grid(ticks, [f"{100 * tick:g} %" for tick in ticks])
    canvas.lines(axes.at([(0.0, 0.0), (1.0, 1.0)]), _FAINT)
    # An ellipse of confidence p holds what lies within −2 ln(1 − p).
    held = np.searchsorted(squared, -2.0 * np.log1p(-nominal), side="right") / len(squared)
    canvas.lines(axes.at(np.column_stack([nominal, held])), _HELD, 2)
    axes.frame()
    for coverage in summary.points.coverages if summary.points else ():
        canvas.dot(axes.at((coverage.nominal, coverage.held)), 5, _HELD)
    if summary.recipe is not None:
        canvas.dot(axes.at((0.95, summary.recipe.held)), 5, _RECIPE)
    left, top, side = _COVERAGE
    canvas.text((left, top - 14), "Ellipses that hold their target, over what they promise", 0.56)
    u = left
    for colour, label in (
        (_HELD, "fingerpost"),
        (_BAND, "honest, by chance (95 %)"),
        (_RECIPE, "the recipe of 1994"),
    ):
        v = top + side + 56
        canvas.square(np.array([u, v - 13.0]), 14.0, colour)
        canvas.text((u + 24, v), label, 0.5)
        u += 60 + 9 * len(label)


def _figures(summary: Summary, unit: str, plane_size: float) -> list[str]:
    """List the figures that matter most."""
    gross = f"{summary.gross} gross errors > {number(GROSS_SHARE * plane_size)} {unit}"
    lines = [f"{summary.available} of {summary.targets} targets have a point; {gross}"]
    points = summary.points
    if points is None:
        return lines
    bound = summary.bound
    least = "" if bound is None else f"; Cramer-Rao bound {number(bound.rms)} {unit}"
    lines += [
        f"RMS {number(points.rms)} {unit} = {100 * points.rms / plane_size:.3f} % of the plane"
        f"{least}",
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
    """How much larger errors and ellipses are drawn, so that the usual ellipse can be seen."""
    reaches = [
        math.sqrt(np.linalg.eigvalsh(trial.covariance)[-1])
        for trial in trials
        if trial.point is not None and trial.covariance is not None
    ]
    usual = 2.0 * float(np.median(reaches)) if reaches else 0.0
    fitting = [m for m in _MAGNIFICATIONS if m * usual <= _VISIBLE_SHARE * span]
    return fitting[-1] if fitting else 1


def _tick_step(span: float) -> float:
    """Give a round number that goes four to ten times into a span."""
    power = float(10.0 ** math.floor(math.log10(span / 4.0)))
    return max(step for step in (power, 2 * power, 5 * power) if step <= span / 4.0)
