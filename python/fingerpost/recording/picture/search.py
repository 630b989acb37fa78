"""Marks of the edge search: search lines, edges that agree with the fit, and rejected edges."""

from __future__ import annotations

import numpy as np

from fingerpost.recording.picture.marks import SearchMarks
from fingerpost.recording.picture.palette import INK, NORMAL, REJECTED
from fingerpost.recording.sheet import CASING, Points, Sheet

# Spacing of the marked search lines, so that the outline remains visible; and size of the cross of
# a rejected edge.
_EDGE_SPACING_PX = 9.0
_CROSS_PX = 2.6


def draw_search(sheet: Sheet, search: SearchMarks) -> None:
    """Draw search lines, edges that agree with the fit and edges that were rejected."""
    lines = sheet.place(search.lines_px)
    marked = _spaced(lines.mean(axis=1))
    lines, edges = lines[marked], sheet.place(search.edges_px[marked])
    pixels = sheet.on_pixels()
    pixels.line(_broken(lines), NORMAL, 1)
    for edge, agrees in zip(edges, search.agrees[marked], strict=True):
        (draw_chosen if agrees else draw_rejected)(pixels, edge)


def _spaced(places: Points) -> slice:
    """Return the slice that thins out places along the outline."""
    steps = np.hypot(*np.diff(places, axis=0).T)
    steps = steps[np.isfinite(steps)]
    spacing = float(np.median(steps)) if len(steps) else _EDGE_SPACING_PX
    return slice(None, None, max(1, round(_EDGE_SPACING_PX / max(spacing, 0.5))))


def draw_chosen(sheet: Sheet, place: Points) -> None:
    """Mark an edge that agrees with the fit."""
    sheet.dot(place, 2.6, CASING)
    sheet.dot(place, 1.8, INK)


def draw_rejected(sheet: Sheet, place: Points) -> None:
    """Mark an edge that was rejected."""
    diagonals = _CROSS_PX * np.array([[[-1.0, -1.0], [1.0, 1.0]], [[-1.0, 1.0], [1.0, -1.0]]])
    sheet.on_pixels().line(_broken(place + diagonals), REJECTED, 1, cased=True)


def _broken(lines: Points) -> Points:
    """Join lines (N, K, 2) into one, with NaN between them."""
    gaps = np.full((len(lines), 1, 2), np.nan)
    return np.concatenate([lines, gaps], axis=1).reshape(-1, 2)
