"""Advice as lines of text, and as JSON values."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from fingerpost.advise.forecast import Figures
from fingerpost.experiment.table import number

if TYPE_CHECKING:
    from fingerpost.advise.advice import Advice

_MOVES_SHOWN = 5


def table_lines(advice: Advice) -> Iterator[str]:
    """Yield advice as lines of text."""
    unit = advice.unit
    yield (
        f"{'view':<12}{'azimuth':>9}{'elevation':>11}{'distance':>10} {unit:<4}"
        f"{'focal px':>10}{'px per mm':>11}{'finger px':>11}{'in view':>9}"
    )
    for view in advice.views:
        focal = f"{view.camera.focal_px.mean():.0f}"
        yield (
            f"{view.name:<12}{round(view.bearings.azimuth_deg):>8}°{view.bearings.elevation_deg:>10.0f}°"
            f"{number(view.bearings.distance):>10} {'':<4}{focal:>10}"
            f"{view.px_per_mm:>11.2f}{_whole(view.finger_px):>11}{view.in_view:>9.0%}"
        )
    yield ""
    yield from _expected(advice)
    yield ""
    yield f"95 % of the errors are below, in {unit}, by target (X to the right, Y upwards):"
    yield from _map(advice)
    yield ""
    yield "by direction of pointing, 0° towards the cameras, positive anticlockwise from above:"
    yield f"  {'azimuth':<16}{'95 %, ' + unit:>10}{'no point':>10}"
    yield from _directions(advice)
    yield ""
    if advice.moves:
        yield f"moving one camera{'':<32}{'95 %, ' + unit:>10}{'no point':>10}{'lines meet':>12}"
        yield _move_row("as they stand", advice.moves[0].before)
        for move in advice.moves[:_MOVES_SHOWN]:
            yield _move_row(move.words(advice.views[move.view].name), move.after)
        yield ""
    for flag in advice.flags:
        yield f"note: {flag.view + ': ' if flag.view else ''}{flag.text}"
    yield f"advice: {advice.recommendation}"


def as_dict(advice: Advice) -> dict[str, Any]:
    """Return advice as JSON values."""
    return {
        "unit": advice.unit,
        "views": [
            {
                "name": view.name,
                "azimuth_deg": view.bearings.azimuth_deg,
                "elevation_deg": view.bearings.elevation_deg,
                "distance": view.bearings.distance,
                "focal_px": view.camera.focal_px.tolist(),
                "focal_sigma": view.camera.focal_sigma,
                "misfit": view.camera.misfit,
                "px_per_mm": view.px_per_mm,
                "finger_px": _or_none(view.finger_px),
                "in_view": view.in_view,
            }
            for view in advice.views
        ],
        "flags": [
            {"concern": flag.concern.value, "view": flag.view, "text": flag.text}
            for flag in advice.flags
        ],
        "expected": _figures(advice.expected),
        "shares": advice.shares,
        "cell_size": advice.cell_size,
        "cells": [
            {"x": cell.middle[0], "y": cell.middle[1], **_figures(cell.figures)}
            for cell in advice.cells
        ],
        "directions": [
            {
                "azimuth_deg": direction.azimuth_deg,
                "expected": direction.expected,
                "hopeless_direction": direction.hopeless,
                **_figures(direction.figures),
            }
            for direction in advice.directions
        ],
        "moves": [
            {
                "view": advice.views[move.view].name,
                "way": move.way.value,
                "amount": move.amount,
                "words": move.words(advice.views[move.view].name),
                "typical_error": move.typical_error,
                **_figures(move.after),
            }
            for move in advice.moves
        ],
        "recommendation": advice.recommendation,
    }


def _expected(advice: Advice) -> Iterator[str]:
    expected, unit = advice.expected, advice.unit
    yield f"expected poses in view{'':<20}{expected.in_view:>8.0%}"
    if not expected.in_view:
        return
    yield f"  of these without a point{'':<16}{expected.hopeless:>8.0%}{_reasons(expected)}"
    if math.isnan(expected.rms):
        return
    for label, value in (
        ("RMS", expected.rms),
        ("median", expected.median),
        ("95 % are below", expected.percentile_95),
    ):
        yield f"  error, {label:<33}{number(value):>8} {unit}"
    yield f"  constraint lines meet at{'':<16}{math.degrees(expected.crossing_rad):>8.0f}°"
    parts = ", ".join(f"{part} {share:.0%}" for part, share in advice.shares.items())
    yield f"  squared error from: {parts}"


def _reasons(figures: Figures) -> str:
    reasons = ", ".join(
        f"{doubt.replace('_', ' ')} {share:.0%}" for doubt, share in figures.doubts.items()
    )
    return f"   ({reasons})" if reasons else ""


def _map(advice: Advice) -> Iterator[str]:
    columns = sorted({round(float(cell.middle[0]), 9) for cell in advice.cells})
    rows = sorted({round(float(cell.middle[1]), 9) for cell in advice.cells}, reverse=True)
    by_place = {
        (round(float(cell.middle[0]), 9), round(float(cell.middle[1]), 9)): cell.figures
        for cell in advice.cells
    }
    for row in rows:
        values = (by_place.get((column, row)) for column in columns)
        yield f"  {number(row):>8} " + "".join(
            f"{'' if figures is None else _short(figures.percentile_95):>8}" for figures in values
        )
    yield f"  {'':>8} " + "".join(f"{number(column):>8}" for column in columns)


def _directions(advice: Advice) -> Iterator[str]:
    for direction in sorted(advice.directions, key=lambda direction: direction.azimuth_deg):
        figures = direction.figures
        if not figures.in_view:
            share, note = "–", "out of view"
        else:
            share, note = f"{figures.hopeless:.0%}", "hopeless" if direction.hopeless else ""
        outside = "" if direction.expected else "not expected"
        words = ", ".join(word for word in (note, outside) if word)
        yield (
            f"  {direction.azimuth_deg:>+5.0f}°{'':<10}{_short(figures.percentile_95):>10}"
            f"{share:>10}  {words}"
        ).rstrip()


def _move_row(words: str, figures: Figures) -> str:
    crossing = math.degrees(figures.crossing_rad)
    angle = f"{crossing:.0f}°" if math.isfinite(crossing) else "–"
    hopeless = f"{figures.hopeless:.0%}" if math.isfinite(figures.hopeless) else "–"
    return f"  {words:<47}{_short(figures.percentile_95):>10}{hopeless:>10}{angle:>12}"


def _whole(value: float) -> str:
    return f"{value:.0f}" if math.isfinite(value) else "–"


def _short(value: float) -> str:
    return number(value) if math.isfinite(value) else "–"


def _figures(figures: Figures) -> dict[str, Any]:
    return {
        "poses": figures.poses,
        "in_view": _or_none(figures.in_view),
        "hopeless": _or_none(figures.hopeless),
        "doubts": figures.doubts,
        "rms": _or_none(figures.rms),
        "median": _or_none(figures.median),
        "percentile_95": _or_none(figures.percentile_95),
        "crossing_deg": _or_none(math.degrees(figures.crossing_rad)),
    }


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
