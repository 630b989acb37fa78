"""The figures of an experiment as lines of text."""

import math
from collections.abc import Iterator

from fingerpost.experiment.summary import (
    CHANCE,
    GROSS_SHARE,
    LineFigures,
    Nees,
    PointFigures,
    Summary,
)

_LABEL = 30


def table_lines(summary: Summary, unit: str, plane_size: float) -> list[str]:
    """Return a summary as lines of text.

    Parameters
    ----------
    summary
        The figures.
    unit
        Name of the plane's unit.
    plane_size
        Side of the working plane [plane units].
    """
    return list(_Table(summary, unit, plane_size).lines())


class _Table:
    def __init__(self, summary: Summary, unit: str, plane_size: float) -> None:
        self._summary = summary
        self._unit = unit
        self._plane_size = plane_size

    def lines(self) -> Iterator[str]:
        summary = self._summary
        yield from self._counts()
        if summary.points is not None:
            yield ""
            yield from self._errors(summary.points)
            if summary.points.coverages:
                yield ""
                yield from self._ellipses(summary.points)
                yield ""
                yield from self._nees(summary.points)
        if summary.lines is not None:
            yield ""
            yield from _finger_lines(summary.lines)

    def _counts(self) -> Iterator[str]:
        summary = self._summary
        others = ", ".join(f"{count} {status}" for status, count in summary.statuses.items())
        yield _row(
            "available",
            _share(summary.available, summary.targets),
            f"the others: {others}" if others else "",
        )
        limit = number(GROSS_SHARE * self._plane_size)
        yield _row(
            f"gross errors > {limit} {self._unit}",
            _share(summary.gross, summary.available),
            f"{summary.gross_beyond_99} outside their 99 % ellipse; not in what is marked *"
            if summary.gross
            else "",
        )

    def _errors(self, points: PointFigures) -> Iterator[str]:
        yield _row("error of the point", f"{'% of plane':>12}{self._unit:>10}")
        for label, error in (
            ("RMS *", points.rms),
            ("RMS", points.rms_of_all),
            ("median", points.median),
            ("95th percentile", points.percentile_95),
            ("largest", points.largest),
            ("mean in X *", points.mean_error[0]),
            ("mean in Y *", points.mean_error[1]),
        ):
            yield self._error(label, error)
        bound = self._summary.bound
        if bound is not None:
            yield self._error("Cramér–Rao bound of RMS *", bound.rms)
            yield _row("  variance, bound / measured *", f"{bound.efficiency:12.3f}")

    def _error(self, label: str, error: float) -> str:
        if math.isnan(error):  # without points: all errors are gross
            return _row(f"  {label}", f"{'–':>12}{'–':>10}")
        share = 100.0 * error / self._plane_size
        return _row(f"  {label}", f"{share:12.4f}{number(error):>10}")

    def _ellipses(self, points: PointFigures) -> Iterator[str]:
        yield _row("ellipse", f"{'holds target':>12}", _by_chance())
        for coverage in points.coverages:
            low, high = coverage.chance
            yield _row(
                f"  {100 * coverage.nominal:g} %",
                f"{100 * coverage.held:10.1f} %",
                f"{100 * low:.1f}–{100 * high:.1f} %",
            )
        area = f"{self._unit}²"
        yield _row("  mean area of 95 %", f"{number(points.ellipse_area):>12} {area}")
        recipe = self._summary.recipe
        if recipe is None:
            return
        yield _row("  the recipe of 1994, 2 σ", f"{100 * recipe.held:10.1f} %")
        yield _row("    mean area", f"{number(recipe.area):>12} {area}")
        theirs = f"1994: {number(recipe.area_at_95)} {area}"
        # Points without any error are contained in ellipses of zero size.
        if points.ellipse_area_at_95 > 0.0:
            ratio = number(recipe.area_at_95 / points.ellipse_area_at_95)
            theirs = f"{theirs}, {ratio} times as large"
        yield _row(
            "  areas when both hold 95 %", f"{number(points.ellipse_area_at_95):>12} {area}", theirs
        )

    def _nees(self, points: PointFigures) -> Iterator[str]:
        yield _row("NEES * (honest: 1)", "", _by_chance())
        lines = self._summary.lines
        for label, nees in (
            ("point", points.nees),
            ("finger line, offset", lines and lines.nees_offset),
            ("finger line, angle", lines and lines.nees_angle),
            ("finger line, both", lines and lines.nees),
        ):
            if isinstance(nees, Nees):
                low, high = nees.chance
                yield _row(f"  {label}", f"{nees.mean:12.3f}", f"{low:.3f}–{high:.3f}")


def _finger_lines(lines: LineFigures) -> Iterator[str]:
    yield _row(f"{lines.count} finger lines *", f"{'RMS':>12}{'mean':>10}{'bound':>10}")
    degrees = math.degrees(1.0)
    for label, scale, rms, mean, bound in (
        ("offset, px", 1.0, lines.rms_offset_px, lines.mean_offset_px, lines.bound_offset_px),
        ("angle, deg", degrees, lines.rms_angle_rad, lines.mean_angle_rad, lines.bound_angle_rad),
    ):
        least = "" if bound is None else f"{scale * bound:10.5f}"
        yield _row(f"  {label}", f"{scale * rms:12.5f}{scale * mean:10.5f}{least}")
    if lines.efficiency_angle is not None:
        yield _row("  angle variance, bound / meas.", f"{lines.efficiency_angle:12.3f}")


def _row(label: str, value: str, note: str = "") -> str:
    return f"{label:<{_LABEL}}{value:<24}{note}".rstrip()


def _by_chance() -> str:
    return f"by chance ({100 * CHANCE:g} %)"


def _share(part: int, whole: int) -> str:
    percent = f" = {100 * part / whole:.1f} %" if whole else ""
    return f"{part:>6} of {whole}{percent}"


def number(value: float) -> str:
    """Format with three significant digits, without an exponent if possible."""
    if not math.isfinite(value) or value == 0.0 or not 1e-4 <= abs(value) < 1e6:
        return f"{value:.3g}"
    return f"{value:.{max(2 - math.floor(math.log10(abs(value))), 0)}f}"
