"""The plan of the working plane."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fingerpost.homography import transfer_jacobian_by_point
from fingerpost.lines import clip_to_rectangle
from fingerpost.pointing import ConstraintLine, Fix, PlaneView
from fingerpost.recording.picture.marks import RobotMarks, as_rows
from fingerpost.recording.picture.on_plane import draw_fix, draw_references, draw_robot
from fingerpost.recording.picture.palette import (
    GRID,
    MUTED,
    PANEL,
    PLANE,
    POINT,
    ROBOT,
    TRUTH,
    colour_of,
    mixed,
)
from fingerpost.recording.picture.shapes import between, hull
from fingerpost.recording.sheet import Colour, Image, Points, Sheet, affine

# Border around the reference points, relative to their extent; and approximate number of ticks.
_PLAN_BORDER = 0.09
_TICKS = 5


def draw_plan(
    plane_views: Sequence[PlaneView],
    fix: Fix,
    *,
    unit: str,
    size_px: tuple[int, int],
    truth: ArrayLike | None = None,
    trail: ArrayLike = (),
    truth_trail: ArrayLike = (),
    robot: RobotMarks | None = None,
) -> Image:
    """Draw the plan of the working plane: figure 2c of the paper.

    It has axes in plane units, of equal scale and never mirrored relative to the views; reference
    points, constraint lines with a band of one standard deviation, and the indicated point with its
    95 % ellipse. A point outside the plan becomes an arrow at its border.

    Parameters
    ----------
    plane_views
        Homographies of all views.
    fix
        The fix.
    unit
        Name of the plane's unit.
    size_px
        Width and height of the picture, 1 to 32767.
    truth : (2,)
        True indicated point [plane units], if known.
    trail : (N, 2)
        Earlier indicated points, oldest first [plane units].
    truth_trail : (N, 2)
        Earlier true points; NaN interrupts the trail.
    robot
        A robot over the plane.

    Returns
    -------
    (height, width, 3) of uint8
        Blue-green-red.

    Raises
    ------
    InvalidInputError
        A size out of range, or an invalid truth.
    """
    points = plane_views[0].plane_points
    plan = Plan.of(plane_views[0], size_px)
    sheet = Sheet.blank(size_px, PANEL)
    _draw_axes(sheet, plan, unit)
    window = Sheet(sheet.pixels[plan.rows, plan.columns], plan.window_from_plane)
    window.area(points[hull(points)], PLANE)
    _draw_grid(window, plan)
    draw_references(window, points, _as_they_are)
    for k, line in enumerate(fix.constraint_lines):
        if line is not None:
            _draw_constraint_line(window, plan, line, colour_of(k))
    if robot is not None:
        window.line(as_rows(robot.trail), mixed(PLANE, ROBOT, 0.6), 1)
        draw_robot(window, robot, _as_they_are)
    window.line(as_rows(truth_trail), TRUTH, 1)
    _draw_trail(window, as_rows(trail))
    draw_fix(window, fix, truth, _as_they_are)
    if fix.point is not None:
        _draw_arrow(window, plan, fix.point)
    return sheet.pixels


@dataclass(frozen=True, eq=False)
class Plan:
    """Layout of the plan: a window onto the plane inside a picture, with axes around it."""

    rows: slice
    columns: slice
    lower: Points
    """(2,) least coordinates in the window [plane units]."""
    upper: Points
    """(2,) largest coordinates in the window [plane units]."""
    window_from_plane: Points
    """(2, 3) plane units → pixels of the window."""
    across: int
    """The plane's axis that runs across the picture: 0 is X, 1 is Y."""

    @classmethod
    def of(cls, view: PlaneView, size_px: tuple[int, int]) -> Plan:
        """Plan of a view's plane for a picture of a given size.

        X points to the right. Y points up, or down if the view sees it so: the plan is not
        mirrored as seen from the cameras. If X runs vertically in the view, Y runs horizontally in
        the plan, in the same direction as in the view, so that both have the same orientation.
        """
        columns = _inner(size_px[0], before=66, after=18)
        rows = _inner(size_px[1], before=18, after=46)
        window_px = np.array([columns.stop - columns.start, rows.stop - rows.start])
        lower, upper = view.plane_points.min(axis=0), view.plane_points.max(axis=0)
        turn = transfer_jacobian_by_point(view.image_from_plane, view.plane_points.mean(axis=0))
        seen = turn * (upper - lower)  # the plane's sides, in pixels of the view
        across = int(abs(seen[1, 0]) > abs(seen[0, 0]) and abs(seen[0, 1]) > abs(seen[1, 1]))
        order = [across, 1 - across]
        scale = float((window_px[order] / ((upper - lower) * (1.0 + 2.0 * _PLAN_BORDER))).min())
        middle, reach = (lower + upper) / 2, window_px[order] / scale / 2
        to_right = np.sign(turn[0, 1]) if across else 1.0
        downwards = to_right * np.sign(np.linalg.det(turn)) * (-1.0 if across else 1.0)
        stretch = scale * np.diag([to_right, downwards])[:, order]
        offset = (window_px - 1) / 2 - stretch @ middle
        window_from_plane = np.column_stack([stretch, offset])
        return cls(rows, columns, middle - reach, middle + reach, window_from_plane, across)

    def place(self, points: ArrayLike) -> Points:
        """Return the pixels (..., 2) of points of the plane in the whole picture."""
        corner = np.array([self.columns.start, self.rows.start])
        return np.asarray(affine(self.window_from_plane, np.asarray(points, np.float64)) + corner)

    def ticks(self, axis: int) -> list[tuple[float, float]]:
        """Round numbers along an axis (0 is X, 1 is Y), each with its pixel in the window."""
        rough = float((self.upper - self.lower).min()) / _TICKS
        power = 10.0 ** math.floor(math.log10(rough))
        steps = [power, 2.0 * power, 5.0 * power, 10.0 * power]
        step = min(steps, key=lambda nice: abs(math.log(nice / rough)))
        first, last = math.ceil(self.lower[axis] / step), math.floor(self.upper[axis] / step)
        row = int(axis != self.across)
        stretch, offset = self.window_from_plane[row, axis], self.window_from_plane[row, 2]
        return [(k * step, float(stretch * k * step + offset)) for k in range(first, last + 1)]


def _inner(length: int, *, before: int, after: int) -> slice:
    """Return the part of a length between two borders, which shrink if it is too short."""
    if length < 2 * (before + after):
        before = after = length // 4
    return slice(before, length - after)


def _draw_axes(sheet: Sheet, plan: Plan, unit: str) -> None:
    """Draw ticks with numbers at the left and the lower side, and name the axes."""
    left, top, right, bottom = (
        plan.columns.start,
        plan.rows.start,
        plan.columns.stop,
        plan.rows.stop,
    )
    across, up = "XY"[plan.across], "YX"[plan.across]
    for value, x in plan.ticks(plan.across):
        sheet.line(np.array([[left + x, bottom], [left + x, bottom + 5]]), MUTED, 1)
        sheet.text(f"{value:g}", (left + x, bottom + 21), 15, MUTED, anchor=0.5)
    for value, y in plan.ticks(1 - plan.across):
        sheet.line(np.array([[left - 6, top + y], [left - 1, top + y]]), MUTED, 1)
        sheet.text(f"{value:g}", (left - 10, top + y + 5), 15, MUTED, anchor=1.0)
    sheet.text(f"{across} / {unit}", (right, bottom + 38), 15, MUTED, anchor=1.0)
    sheet.text(f"{up} / {unit}", (8, top - 2), 15, MUTED)


def _draw_grid(window: Sheet, plan: Plan) -> None:
    (width, height), pixels = window.size_px, window.on_pixels()
    for _, x in plan.ticks(plan.across):
        pixels.line(np.array([[x, 0.0], [x, height]]), GRID, 1)
    for _, y in plan.ticks(1 - plan.across):
        pixels.line(np.array([[0.0, y], [width, y]]), GRID, 1)


def _draw_constraint_line(
    window: Sheet, plan: Plan, constraint: ConstraintLine, colour: Colour
) -> None:
    """Draw the line through the whole window, with its band of one standard deviation."""
    ends = clip_to_rectangle(constraint.line, plan.lower, plan.upper)
    if ends is None:
        return
    points = between(ends, 33)
    with np.errstate(invalid="ignore"):  # the variance of an exact line may round to below zero
        away = constraint.sigma_at(points)[:, None] * constraint.line[:2]
    window.area(np.concatenate([points + away, (points - away)[::-1]]), colour, 0.25)
    window.line(ends, colour, 2)


def _draw_trail(window: Sheet, trail: Points) -> None:
    """Draw dots that fade with age."""
    for place, youth in zip(window.place(trail), np.linspace(0.3, 0.8, len(trail)), strict=True):
        window.dot(place, 2.5, mixed(PLANE, POINT, youth))


def _draw_arrow(window: Sheet, plan: Plan, point: Points) -> None:
    """Draw an arrow at the border towards a point outside the window."""
    centre = (np.array(window.size_px) - 1) / 2
    away = affine(plan.window_from_plane, point) - centre
    if (np.abs(away) <= centre).all():
        return
    tip = centre + away / (np.abs(away) / np.maximum(centre - 4.0, 1.0)).max()
    along = away / math.hypot(*away)
    back, across = tip - 16.0 * along, 8.0 * along[::-1] * (-1.0, 1.0)
    window.on_pixels().area(np.array([tip, back + across, back - across]), POINT)


def _as_they_are(points: Points) -> Points:
    return points
