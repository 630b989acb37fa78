"""A picture of advice: the map of predicted errors, the cameras, and the directions of pointing.

All three panels are plans seen from above, with the same orientation: X points to the right, and Y
up or down so that nothing is mirrored. A direction in the third panel is the pointing direction of
a hand on the first two.
"""

from __future__ import annotations

import math
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fingerpost.advise.moves import Bearings
from fingerpost.experiment.table import number
from fingerpost.recording import write_picture
from fingerpost.recording.picture.palette import (
    GRID,
    INK,
    MUTED,
    PAGE,
    PANEL,
    PLANE,
    STATUSES,
    VIEWS,
)
from fingerpost.recording.sheet import Colour, Sheet

if TYPE_CHECKING:
    from fingerpost.advise.advice import Advice, Direction

Array = NDArray[np.float64]

_WIDTH_PX, _MARGIN_PX = 1728, 24
_PANEL_PX = 544
_PANEL_TOP_PX = 132
_TEXT_TOP_PX = _PANEL_TOP_PX + _PANEL_PX + 104
_LINE_PX = 27
_WRAP = 165
_NOTES_SHOWN = 6

_HOPELESS: Colour = STATUSES["lost"]
_MOVED: Colour = STATUSES["ok"]
_RAMP = np.array(
    [
        (0x8E, 0x6A, 0x2B),
        (0x9C, 0xA8, 0x3F),
        (0x5E, 0xC8, 0xC4),
        (0x3C, 0x9E, 0xF0),
        (0x4A, 0x55, 0xD8),
    ],
    np.float64,
)
"""Blue-green-red from small errors to large ones; brightness alone orders it up to the middle."""

# Range of the colours in octaves of the error, with the typical one in the middle.
_OCTAVES = 2.0
# Margins of the map and the rose in their panels.
_MAP_BORDER = 0.12
_ROSE_RADIUS = 0.36
# Error of the longest bar of the rose, relative to the typical error.
_ROSE_REACH = 2.0
_TICKS = (1.0, 2.0, 5.0)


def draw_advice(advice: Advice, path: Path) -> None:
    """Draw advice into an image file; see `Advice.draw`."""
    notes = _notes(advice)
    height = _TEXT_TOP_PX + _LINE_PX * len(notes) + _MARGIN_PX
    page = Sheet.blank((_WIDTH_PX, height), PAGE)
    _draw_head(page, advice)
    scale = _Scale.of(advice)
    for k, (title, draw) in enumerate(
        (
            (f"95 % of the errors are below, {advice.unit}, by target", _draw_map),
            ("where the cameras stand", _draw_cameras),
            (f"the same, {advice.unit}, by direction of pointing", _draw_rose),
        )
    ):
        left = _MARGIN_PX + k * (_PANEL_PX + _MARGIN_PX)
        page.text(title, (left, _PANEL_TOP_PX - 14), 20, INK, bold=True)
        pixels = page.pixels[_PANEL_TOP_PX : _PANEL_TOP_PX + _PANEL_PX, left : left + _PANEL_PX]
        pixels[:] = PANEL
        draw(pixels, advice, scale)
    if scale.marked:
        _draw_scale(page, scale, advice.unit)
    _draw_camera_key(page, advice)
    _draw_rose_key(page)
    for row, (line, colour) in enumerate(notes):
        page.text(line, (_MARGIN_PX, _TEXT_TOP_PX + _LINE_PX * row), 19, colour)
    write_picture(path, page.pixels)


class _Scale:
    """Colours of errors; without an error there are no marks."""

    def __init__(self, usual: float, *, marked: bool) -> None:
        self.usual = usual
        self.marked = marked

    @classmethod
    def of(cls, advice: Advice) -> _Scale:
        """Return a scale with the typical error of the map in the middle."""
        errors = [cell.figures.percentile_95 for cell in advice.cells]
        known = [error for error in errors if math.isfinite(error) and error > 0.0]
        return cls(float(np.median(known)) if known else 1.0, marked=bool(known))

    def share(self, error: float) -> float:
        """Position on the scale, 0 to 1."""
        octaves = math.log2(max(error, 1e-12 * self.usual) / self.usual)
        return min(max(0.5 + octaves / (2.0 * _OCTAVES), 0.0), 1.0)

    def colour(self, error: float) -> Colour:
        """Colour of an error; the panel's without one."""
        if not math.isfinite(error):
            return PANEL
        place = self.share(error) * (len(_RAMP) - 1)
        below = min(int(place), len(_RAMP) - 2)
        mixed = _RAMP[below] + (place - below) * (_RAMP[below + 1] - _RAMP[below])
        blue, green, red = (round(float(value)) for value in mixed)
        return blue, green, red


def _draw_head(page: Sheet, advice: Advice) -> None:
    page.text("placement of the cameras", (_MARGIN_PX, 42), 28, INK, bold=True)
    expected, unit = advice.expected, advice.unit
    if math.isfinite(expected.median):
        words = (
            f"expected: median {number(expected.median)} {unit}, 95 % below "
            f"{number(expected.percentile_95)} {unit}, RMS {number(expected.rms)} {unit}   ·   "
            f"no point in {expected.hopeless:.0%} of the poses in view   ·   constraint lines "
            f"meet at {math.degrees(expected.crossing_rad):.0f}°"
        )
    else:
        words = "none of the expected poses will have a point"
    page.text(words, (_MARGIN_PX, 78), 20, MUTED)


def _draw_map(pixels: NDArray[np.uint8], advice: Advice, scale: _Scale) -> None:
    outline = advice.workspace.outline
    sheet = _plan(pixels, advice, outline, _MAP_BORDER)
    sheet.area(outline, PLANE)
    half = advice.cell_size / 2
    corners = half * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    for cell in advice.cells:
        error = cell.figures.percentile_95
        if math.isfinite(error):
            sheet.area(cell.middle + 0.97 * corners, scale.colour(error))
        place = sheet.place(cell.middle)
        words, colour = (number(error), PAGE) if math.isfinite(error) else ("none", _HOPELESS)
        size = 18 if len(advice.cells) <= 64 else 12
        sheet.text(words, place + np.array([0.0, 0.35 * size]), size, colour, anchor=0.5)
    for k, point in enumerate(advice.plane_points):
        place = sheet.place(point)
        sheet.dot(place, 6.0, PAGE)
        sheet.dot(place, 4.5, INK)
        if k < 2:  # the first two show the plane's axes
            away = place - sheet.place(advice.workspace.middle)
            where = place + 16.0 * np.sign(away)
            words = f"({point[0]:g}, {point[1]:g})"
            sheet.text(words, (where[0], where[1] + 6), 17, MUTED, anchor=0.5)


def _draw_cameras(pixels: NDArray[np.uint8], advice: Advice, scale: _Scale) -> None:  # noqa: ARG001
    standing = [view.camera.centre[:2] for view in advice.views]
    move = advice.recommended
    moved = [] if move is None else [move.camera.centre[:2]]
    everything = np.vstack([advice.workspace.outline, *standing, *moved])
    sheet = _plan(pixels, advice, everything, 0.16)
    sheet.area(advice.workspace.outline, PLANE)
    sheet.line(_closed(advice.workspace.outline), MUTED, 1)
    middle = advice.workspace.middle
    if move is not None:
        arc = _way(standing[move.view], moved[0], middle)
        sheet.line(arc, _MOVED, 2, dash=(9.0, 6.0), cased=True)
        sheet.line(np.array([moved[0], middle]), _MOVED, 1, dash=(4.0, 6.0))
        _mark(sheet, moved[0], _MOVED, f"{advice.views[move.view].name}, better", above=True)
    for k, view in enumerate(advice.views):
        colour = VIEWS[k % len(VIEWS)]
        sheet.line(np.array([standing[k], middle]), colour, 1)
        above = bool(sheet.place(standing[k])[1] < sheet.place(middle)[1])
        _mark(sheet, standing[k], colour, view.name, above=above)
    _draw_ruler(sheet, advice)


def _mark(sheet: Sheet, ground: Array, colour: Colour, name: str, *, above: bool) -> None:
    """Draw a camera at its position, with its name."""
    place = sheet.place(ground)
    sheet.dot(place, 10.0, PAGE)
    sheet.dot(place, 8.0, colour)
    beside = place + np.array([0.0, -18.0 if above else 30.0])
    sheet.text(name, beside, 19, colour, bold=True, anchor=0.5)


def _draw_ruler(sheet: Sheet, advice: Advice) -> None:
    """Draw a round length to scale into the upper left corner."""
    across = np.diff(sheet.corners(), axis=0)[0, 0]
    length = _round_below(0.3 * float(across))
    px = length / float(across) * sheet.size_px[0]
    ends = np.array([[20.0, 24.0], [20.0 + px, 24.0]])
    pixels = sheet.on_pixels()
    pixels.line(ends, INK, 2)
    for end in ends:
        pixels.line(end + np.array([[0.0, -5.0], [0.0, 5.0]]), INK, 2)
    sheet.text(f"{length:g} {advice.unit}", (20, 50), 17, MUTED)


def _draw_rose(pixels: NDArray[np.uint8], advice: Advice, scale: _Scale) -> None:
    radius = _ROSE_RADIUS * _PANEL_PX
    sheet = Sheet(pixels, _turned(advice, radius, np.full(2, _PANEL_PX / 2)))
    reach = _ROSE_REACH * scale.usual
    step = _round_below(reach / 2)
    rings = [k * step / reach for k in range(1, int(reach / step) + 1)]
    width = 2.0 * math.pi / len(advice.directions)
    for direction in advice.directions:
        _draw_sector(sheet, advice, direction, width, reach, scale)
    for ring in rings if scale.marked else ():
        sheet.line(_closed(_arc(0.0, 2.0 * math.pi, ring)), GRID, 1)
        place = sheet.place(np.zeros(2)) + np.array([0.0, -ring * radius - 4.0])
        sheet.text(f"{ring * reach:g}", place, 16, INK, anchor=0.5)
    for k, view in enumerate(advice.views):
        heading = float(advice.workspace.heading_rad(np.array(view.bearings.azimuth_deg)))
        ray = np.array([math.cos(heading), math.sin(heading)])
        colour = VIEWS[k % len(VIEWS)]
        place = sheet.place(1.18 * ray)
        sheet.line(np.array([1.04 * ray, 1.12 * ray]), colour, 3)
        sheet.dot(place, 6.0, colour)
        down = 26.0 if place[1] > _PANEL_PX / 2 else -14.0
        sheet.text(view.name, place + np.array([0.0, down]), 18, colour, anchor=0.5)


def _draw_sector(
    sheet: Sheet, advice: Advice, direction: Direction, width: float, reach: float, scale: _Scale
) -> None:
    """Draw one direction: a bar as long as the error; hatched to the rim if it is hopeless."""
    heading = float(advice.workspace.heading_rad(np.array(direction.azimuth_deg)))
    first, last = heading - 0.46 * width, heading + 0.46 * width
    opacity = 1.0 if direction.expected else 0.4
    if direction.hopeless:
        sheet.area(_wedge(first, last, 1.0), _HOPELESS, 0.3 * opacity)
        for share in np.linspace(0.15, 1.0, 12):
            sheet.line(_arc(first, last, float(share)), _HOPELESS, 1)
        return
    error = direction.figures.percentile_95
    sheet.area(_wedge(first, last, min(error / reach, 1.0)), scale.colour(error), opacity)
    rim = direction.figures.hopeless
    if rim > 0.0:  # the share without a point, as a part of the rim's width
        inner = _arc(first, last, 1.0)
        outer = _arc(first, last, 1.0 + 0.16 * rim)[::-1]
        sheet.area(np.concatenate([inner, outer]), _HOPELESS)


def _draw_scale(page: Sheet, scale: _Scale, unit: str) -> None:
    """Draw the colours below the map, with round numbers."""
    left, top = _MARGIN_PX, _PANEL_TOP_PX + _PANEL_PX + 14
    for x in range(_PANEL_PX):
        octaves = (x / (_PANEL_PX - 1) - 0.5) * 2.0 * _OCTAVES
        page.pixels[top : top + 14, left + x] = scale.colour(scale.usual * 2.0**octaves)
    least, most = scale.usual * 2.0**-_OCTAVES, scale.usual * 2.0**_OCTAVES
    decade = float(10.0 ** math.floor(math.log10(least)))
    ticks = [decade * 10.0**k * tick for k in range(3) for tick in _TICKS]
    for tick in ticks:
        if least <= tick <= most:
            place = left + scale.share(tick) * (_PANEL_PX - 1)
            page.line(np.array([[place, top + 14.0], [place, top + 20.0]]), INK, 1)
            page.text(f"{tick:g} {unit}", (place, top + 38), 16, MUTED, anchor=0.5)


def _draw_camera_key(page: Sheet, advice: Advice) -> None:
    """Write height and distance of the cameras below them."""
    left, baseline = 2 * _MARGIN_PX + _PANEL_PX, _PANEL_TOP_PX + _PANEL_PX + 30
    begin = float(left)
    standing = [
        (view.name, view.bearings, VIEWS[k % len(VIEWS)]) for k, view in enumerate(advice.views)
    ]
    if advice.recommended is not None:
        bearings = Bearings.of(advice.recommended.camera, advice.workspace)
        standing.append(("better", bearings, _MOVED))
    for name, bearings, colour in standing:
        words = (
            f"{name} {bearings.elevation_deg:.0f}° up, {number(bearings.distance)} {advice.unit}"
        )
        room = left + _PANEL_PX - begin
        if begin > left and 9.0 * len(words) > room:
            begin, baseline = float(left), baseline + 24
        _, end = page.text(words, (begin, baseline), 17, colour, room=_PANEL_PX)
        begin = end + 24.0


def _draw_rose_key(page: Sheet) -> None:
    left, baseline = 3 * _MARGIN_PX + 2 * _PANEL_PX, _PANEL_TOP_PX + _PANEL_PX + 30
    square = np.array([(0, -13), (14, -13), (14, 1), (0, 1)]) + np.array([left, baseline])
    page.area(square, _HOPELESS, 0.5)
    page.text("hopeless; red rim: share without a point", (left + 22, baseline), 17, MUTED)
    page.text("faint: not among the expected poses", (left + 22, baseline + 24), 17, MUTED)


def _notes(advice: Advice) -> list[tuple[str, Colour]]:
    """Lines under the panels: the advice, then what is doubtful."""
    lines = [(line, _MOVED) for line in textwrap.wrap(f"Advice: {advice.recommendation}.", _WRAP)]
    for flag in advice.flags[:_NOTES_SHOWN]:
        words = f"{flag.view + ': ' if flag.view else ''}{flag.text}."
        lines += [(line, MUTED) for line in textwrap.wrap(words, _WRAP, subsequent_indent="    ")]
    return lines


def _plan(pixels: NDArray[np.uint8], advice: Advice, points: Array, border: float) -> Sheet:
    """Sheet of a panel that shows some points of the plane completely."""
    lower, upper = points.min(axis=0), points.max(axis=0)
    scale = _PANEL_PX * (1.0 - 2.0 * border) / float((upper - lower).max())
    matrix = _turned(advice, scale, np.full(2, _PANEL_PX / 2))
    matrix[:, 2] -= matrix[:, :2] @ ((lower + upper) / 2)
    return Sheet(pixels, matrix)


def _turned(advice: Advice, scale: float, origin_px: Array) -> Array:
    """(2, 3) scaling that mirrors nothing as seen from above: image rows run downwards."""
    return np.column_stack([scale * np.diag([1.0, -advice.workspace.anticlockwise]), origin_px])


def _arc(first: float, last: float, radius: float) -> Array:
    angles = np.linspace(first, last, max(3, math.ceil(abs(last - first) / 0.05)))
    return np.asarray(radius * np.stack([np.cos(angles), np.sin(angles)], axis=1))


def _wedge(first: float, last: float, radius: float) -> Array:
    return np.concatenate([np.zeros((1, 2)), _arc(first, last, radius)])


def _way(start: Array, end: Array, middle: Array) -> Array:
    """Path of a camera on the ground: round the workspace, or straight."""
    (from_radius, from_angle), (to_radius, to_angle) = (
        (float(np.hypot(*away)), math.atan2(away[1], away[0]))
        for away in (start - middle, end - middle)
    )
    turn = math.remainder(to_angle - from_angle, math.tau)
    share = np.linspace(0.0, 1.0, 48)
    radius, angle = from_radius + share * (to_radius - from_radius), from_angle + share * turn
    return np.asarray(middle + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def _closed(points: Array) -> Array:
    return np.concatenate([points, points[:1]])


def _round_below(value: float) -> float:
    """Largest of 1, 2 and 5 times a power of ten that is not above a value."""
    decade = float(10.0 ** math.floor(math.log10(value)))
    return max(tick * decade for tick in _TICKS if tick * decade <= value * (1.0 + 1e-9))
