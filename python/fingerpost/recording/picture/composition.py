"""All views and the plan in one picture, with a line of numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fingerpost.errors import InvalidInputError
from fingerpost.pointing import Fix, PlaneView
from fingerpost.recording.picture.marks import Observed, Pictured, RobotMarks, status_of
from fingerpost.recording.picture.on_plane import draw_point
from fingerpost.recording.picture.palette import (
    INK,
    MUTED,
    NORMAL,
    PAGE,
    POINT,
    ROBOT,
    STATUSES,
    TRUTH,
    colour_of,
)
from fingerpost.recording.picture.plan import draw_plan
from fingerpost.recording.picture.search import draw_chosen, draw_rejected
from fingerpost.recording.picture.view import draw_view
from fingerpost.recording.sheet import Image, Points, Sheet

MAX_WIDTH_PX = 1728
"""Greatest width of a composition: it fits a screen, and its text is legible at smaller sizes."""
_MARGIN_PX = 20
_GAP_PX = 16
_TITLE_PX = 38
_FOOTER_PX = 48
_CAPTION_PX = 52
_CAPTION_LINE_PX = 20
_CAPTION_TYPE_PX = 15
_KEY_PX = 460
_CELL_PX = (16, 640)
_ASPECTS = (1.0, 16.0 / 9.0)
_USUAL_ASPECT = 4.0 / 3.0


class Composition:
    """Pictures of a run, all of one size: every view, the plan, and a line with the numbers.

    The layout depends on the number of views and the aspect ratios of the first frames, and is kept
    for later pictures, so that they form a video.

    Parameters
    ----------
    plane_views
        Homographies of the views, in the rig's order; at least one.
    unit
        Name of the plane's unit.
    edges
        Whether to mark search lines with chosen and rejected edges, and to explain the result below
        each view.

    Raises
    ------
    InvalidInputError
        No view.
    """

    def __init__(self, plane_views: Sequence[PlaneView], *, unit: str, edges: bool = False) -> None:
        if not plane_views:
            raise InvalidInputError("plane_views is empty; a picture shows one view or more")
        self._views = tuple(plane_views)
        self._unit = unit
        self._edges = edges
        self._layout: _Layout | None = None

    def draw(
        self,
        observations: Sequence[Observed],
        fix: Fix,
        *,
        truth: ArrayLike | None = None,
        trail: ArrayLike = (),
        truth_trail: ArrayLike = (),
        robot: RobotMarks | None = None,
        plane_views: Sequence[PlaneView | None] = (),
    ) -> Image:
        """Draw one moment.

        Parameters
        ----------
        observations
            One per view, in the rig's order.
        fix
            The fix.
        truth, trail, truth_trail, robot
            As for `draw_plan`.
        plane_views
            Present homographies, if cameras may have moved; None for a view that has not.

        Returns
        -------
        (height, width, 3) of uint8
            Blue-green-red; of one size, with even sides, at every call.

        Raises
        ------
        InvalidInputError
            The numbers of observations and views differ, or an invalid image or truth.
        """
        if len(observations) != len(self._views):
            raise InvalidInputError(
                f"{len(observations)} observations; one for each of {len(self._views)} views "
                "is needed"
            )
        if self._layout is None:
            self._layout = _Layout.of(observations, _CAPTION_PX if self._edges else 0)
        layout, plan = self._layout, len(observations)
        moved = (*plane_views, *self._views[len(plane_views) :])
        views = [now or first for now, first in zip(moved, self._views, strict=True)]
        size_px = layout.cell_px
        page = Sheet.blank(layout.page_px, PAGE)
        for k, observed in enumerate(observations):
            _draw_view_title(page, layout, k, observed)
            page.pixels[layout.cell(k)] = draw_view(
                observed,
                views,
                k,
                fix,
                size_px=size_px,
                truth=truth,
                edges=self._edges,
                robot=robot,
            )
            if self._edges:
                _draw_caption(page, layout, k, observed)
        if self._edges:
            _draw_search_key(page, layout, plan)
        x, baseline = layout.title(plan)
        page.text("working plane", (x, baseline), 19, INK, bold=True, room=size_px[0])
        if robot is not None:
            _draw_robot_title(page, robot, x + size_px[0], baseline)
        page.pixels[layout.cell(plan)] = draw_plan(
            views,
            fix,
            unit=self._unit,
            size_px=size_px,
            truth=truth,
            trail=trail,
            truth_trail=truth_trail,
            robot=robot,
        )
        self._draw_footer(page, fix, with_truth=truth is not None)
        return page.pixels

    def _draw_footer(self, page: Sheet, fix: Fix, *, with_truth: bool) -> None:
        """Draw time, status and numbers at the left, and the key of the marks at the right."""
        width, height = page.size_px
        baseline = height - _FOOTER_PX / 2 + 6
        right = width - _MARGIN_PX
        colour, words = STATUSES[fix.status], fix.status.replace("_", "-")
        _, end = page.text(f"{fix.time_s:.2f} s", (_MARGIN_PX, baseline), 20, INK)
        begin = max(end + 24, _MARGIN_PX + 100)  # the words after it keep their place
        page.dot(np.array([begin, baseline - 6]), 5, colour)
        _, end = page.text(words, (begin + 13, baseline), 20, colour, bold=True)
        begin = end + 28
        said = _in_numbers(fix, self._unit, self._views[0].plane_size)
        _, end = page.text(said, (begin, baseline), 20, INK, room=right - begin)
        if right - end > _KEY_PX:
            _draw_key(page, right, baseline, with_truth=with_truth)


def _draw_view_title(page: Sheet, layout: _Layout, index: int, observed: Observed) -> None:
    """Write the view's name beside a mark in its colour; at the right, its status."""
    x, baseline = layout.title(index)
    status = status_of(observed)
    right = x + layout.cell_px[0]
    words = status.replace("_", "-")
    begin, _ = page.text(words, (right, baseline), 18, STATUSES[status], anchor=1.0)
    page.dot(np.array([begin - 12, baseline - 6]), 5, STATUSES[status])
    page.pixels[baseline - 14 : baseline + 1, x : x + 6] = colour_of(index)
    page.text(observed.view, (x + 16, baseline), 19, INK, bold=True, room=begin - 40 - x)


def _draw_robot_title(page: Sheet, robot: RobotMarks, right: float, baseline: float) -> None:
    """Write the robot's activity at the right of a title, beside its mark."""
    begin, _ = page.text(robot.words, (right, baseline), 18, ROBOT, anchor=1.0)
    for x in (begin - 20.0, begin - 10.0):
        page.line(np.array([[x, baseline - 12.0], [x, baseline - 1.0]]), ROBOT, 3)


def _draw_caption(page: Sheet, layout: _Layout, index: int, observed: Observed) -> None:
    """Write the explanation of a view's result below it."""
    x, baseline = layout.caption(index)
    colours = [STATUSES[status_of(observed)], MUTED]
    for k, (words, colour) in enumerate(zip(observed.reasons, colours, strict=False)):
        place = (x, baseline + k * _CAPTION_LINE_PX)
        page.text(words, place, _CAPTION_TYPE_PX, colour, room=layout.cell_px[0])


def _draw_search_key(page: Sheet, layout: _Layout, index: int) -> None:
    """Draw the key of the search marks below the plan."""
    x, baseline = layout.caption(index)
    right = x + layout.cell_px[0]
    keys: list[tuple[str, Callable[[Sheet, Points], None] | None]] = [
        ("edge agrees", draw_chosen),
        ("edge rejected", draw_rejected),
        ("no edge found", None),
    ]
    left = float(x)
    for words, draw_mark in keys:
        middle = np.array([left + 8.0, baseline - 5.0])
        page.line(middle + np.array([[-8.0, 0.0], [8.0, 0.0]]), NORMAL, 1)
        if draw_mark is not None:
            draw_mark(page, middle + np.array([3.0, 0.0]))
        begin = left + 24.0
        _, end = page.text(words, (begin, baseline), _CAPTION_TYPE_PX, MUTED, room=right - begin)
        left = end + 24.0


def _draw_key(page: Sheet, right: float, baseline: float, *, with_truth: bool) -> None:
    """Draw the key of the marks of a fix."""
    middle = baseline - 6
    if with_truth:
        begin, _ = page.text("truth", (right, baseline), 18, MUTED, anchor=1.0)
        page.cross(np.array([begin - 16, middle]), 8.0, TRUTH)
        right = begin - 44
    words = "indicated point, 95 % ellipse"
    begin, _ = page.text(words, (right, baseline), 18, MUTED, anchor=1.0)
    centre, turn = np.array([begin - 28, middle]), np.linspace(0.0, 2.0 * np.pi, 49)
    ring = centre + np.column_stack([16.0 * np.cos(turn), 9.0 * np.sin(turn)])
    page.area(ring, POINT, 0.4)
    page.line(ring, POINT, 1)
    draw_point(page, centre)


def _in_numbers(fix: Fix, unit: str, plane_size: float) -> str:
    """Return the fix to a thousandth of the plane; without one, the reason."""
    if fix.point is None or fix.covariance is None:
        return fix.reason
    crossing = math.degrees(fix.crossing_angle_rad or 0.0)
    point = point_in_numbers(fix.point, fix.covariance, unit=unit, plane_size=plane_size)
    return f"{point}   lines cross at {crossing:.0f}°"


def point_in_numbers(
    point: ArrayLike, covariance: ArrayLike, *, unit: str, plane_size: float
) -> str:
    """Return an indicated point as text, to a thousandth of the plane.

    Parameters
    ----------
    point : (2,)
        The point, in plane units.
    covariance : (2, 2)
        Its covariance, in plane units²; each coordinate is followed by its standard deviation.
    unit
        Name of the plane's unit.
    plane_size
        Side of the working plane, in its unit, > 0.
    """
    digits = max(0, -math.floor(math.log10(plane_size / 1000.0)))
    axes = [
        f"{axis} {value:.{digits}f} ± {sigma:.{digits}f}"
        for axis, value, sigma in zip(
            "XY", np.asarray(point), np.sqrt(np.diag(covariance)), strict=True
        )
    ]
    return f"{'   '.join(axes)} {unit}"


@dataclass(frozen=True)
class _Layout:
    """A grid of equal cells, one per view and the last for the plan, each with a title above."""

    columns: int
    rows: int
    cell_px: tuple[int, int]
    caption_px: int
    """Height of the caption below each cell."""

    @classmethod
    def of(cls, observations: Sequence[Observed], caption_px: int) -> _Layout:
        cells = len(observations) + 1
        columns = cells if cells <= 3 else math.ceil(math.sqrt(cells))
        space = MAX_WIDTH_PX - 2 * _MARGIN_PX - (columns - 1) * _GAP_PX
        least, largest = _CELL_PX
        width = max(least, min(space // columns, largest))
        aspect = _middle_aspect(observed.frame for observed in observations)
        return cls(columns, math.ceil(cells / columns), (width, round(width / aspect)), caption_px)

    @property
    def page_px(self) -> tuple[int, int]:
        """Width and height of the whole, even as required for videos."""
        width = 2 * _MARGIN_PX + self.columns * (self.cell_px[0] + _GAP_PX) - _GAP_PX
        height = self.rows * self._row_px + _FOOTER_PX
        return width + width % 2, height + height % 2

    def title(self, index: int) -> tuple[int, int]:
        """Where the baseline of a cell's title starts."""
        x, y = self._corner(index)
        return x, y - 12

    def cell(self, index: int) -> tuple[slice, slice]:
        """Rows and columns of a cell."""
        x, y = self._corner(index)
        return slice(y, y + self.cell_px[1]), slice(x, x + self.cell_px[0])

    def caption(self, index: int) -> tuple[int, int]:
        """Where the baseline of a cell's caption starts."""
        x, y = self._corner(index)
        return x, y + self.cell_px[1] + _CAPTION_LINE_PX

    @property
    def _row_px(self) -> int:
        return _TITLE_PX + self.cell_px[1] + self.caption_px

    def _corner(self, index: int) -> tuple[int, int]:
        row, column = divmod(index, self.columns)
        x = _MARGIN_PX + column * (self.cell_px[0] + _GAP_PX)
        return x, row * self._row_px + _TITLE_PX


def _middle_aspect(frames: Iterable[Pictured | None]) -> float:
    """Return the median aspect ratio of the frames, within a range suitable for the plan."""
    shapes = [frame.image.shape for frame in frames if frame is not None and frame.image.size]
    if not shapes:
        return _USUAL_ASPECT
    return float(np.clip(np.median([shape[1] / shape[0] for shape in shapes]), *_ASPECTS))
