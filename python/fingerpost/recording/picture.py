"""Pictures of a run: what every view sees, and the plan of the working plane, as in the paper.

Figure 2 of Cipolla, Hadfield & Hollinghurst 1994 in one image: each view with the template's
outline, its finger line and the indicated point projected back into it; beside them the plan, on
which the constraint lines of the views meet in that point, with its 95 % ellipse (figure 4). A view
keeps its colour everywhere, so that its finger line in the picture and its constraint line on the
plan are seen to be one thing. Under all of it stands one line with the numbers.

Colour-blind people can tell the colours apart, and no meaning rests on colour alone: an outline is
solid while it tracks, dashed while it waits and dotted when it has lost the hand, and the status
stands above it in words. Where the search is shown too, a dot is an edge that agrees with the fit
and a cross one that was rejected; under each view stands why the frame went the way it did.

What cannot be drawn (no fix, no bound on it, points beyond the horizon or far outside the picture)
is left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.checks import finite_array
from fingerpost.errors import InvalidInputError
from fingerpost.homography import transfer_jacobian_by_point
from fingerpost.lines import clip_to_rectangle, line_at_angle
from fingerpost.pointing import ConstraintLine, FingerLine, Fix, PlaneView, Status
from fingerpost.recording.sheet import CASING, Colour, Image, Points, Sheet, affine


def _colour(red_green_blue: int) -> Colour:
    return red_green_blue & 255, red_green_blue >> 8 & 255, red_green_blue >> 16


PAGE = CASING
PANEL = _colour(0x1B222A)
PLANE = _colour(0x26303A)
GRID = _colour(0x37434F)
MUTED = _colour(0x93A0AD)
INK = _colour(0xECF0F3)
POINT = _colour(0xFF1473)
"""The indicated point, its ellipse and its trail."""
TRUTH = INK
"""Where the hand truly points, where that is known."""
VIEWS = (_colour(0x56B4E9), _colour(0xF2A33A), _colour(0xF0E442), _colour(0x9A4DFF))
"""One per view, from the first again when there are more views."""
NORMAL = _colour(0xB9C4CE)
"""A line along which edges were looked for."""
REJECTED = _colour(0xFF6B52)
"""An edge that does not agree with the fit."""
ROBOT = _colour(0xA8E05F)
"""The robot's gripper and where it went."""
BLOCK = _colour(0xDEBC8C)
"""What it carries."""
STATUSES = {
    "tracking": _colour(0x4FDBA5),
    "ok": _colour(0x4FDBA5),
    "acquiring": INK,
    "lost": _colour(0xFF6B52),
    "ill_conditioned": _colour(0xF2A33A),
}

# Dash and gap of an outline [px]; a tracked one is solid.
_DASHES = {"acquiring": (7.0, 5.0), "lost": (0.5, 6.5)}

# Points of an outline further apart than so many of its usual steps belong to different fingers.
_OUTLINE_GAP = 5.0

# Search lines are marked about so far apart, to leave the outline's colour to be seen, and a
# rejected edge by a cross that reaches so far.
_EDGE_SPACING_PX = 9.0
_CROSS_PX = 2.6

# A search is magnified if it grows by this factor at least: the part of the frame around it, by a
# factor and a length wider than the search, to this share of the picture's shorter side.
_MAGNIFIED = 1.5
_CLOSEUP_BORDER = 1.15
_CLOSEUP_LEAST_PX = 16
_CLOSEUP_SHARE = 0.48
_CLOSEUP_MARGIN_PX = 8

MAX_WIDTH_PX = 1728
"""Widest composition: it fits a screen, and its words stay legible where it is shown smaller."""

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

# The plan shows this share of the reference points' extent around them, and about so many ticks.
_PLAN_BORDER = 0.09
_TICKS = 5


class Pictured(Protocol):
    """A frame; `fingerpost.capture.Frame` is one."""

    @property
    def image(self) -> Image:
        """(height, width) grey or (height, width, 3) blue-green-red."""


class Observed(Protocol):
    """What one view saw in one frame; `fingerpost.pipeline.Observation` is one."""

    @property
    def view(self) -> str:
        """The view's name."""

    @property
    def frame(self) -> Pictured | None:
        """The frame; None where it could not be read."""

    @property
    def contour_px(self) -> Points:
        """(N, 2) outline of the template [px]."""

    @property
    def search(self) -> SearchMarks:
        """The last search for edges around it."""

    @property
    def reasons(self) -> Sequence[str]:
        """Why the frame went the way it did: the verdict, then details."""

    @property
    def finger(self) -> FingerLine | Status:
        """The finger line, or why there is none."""


@dataclass(frozen=True, eq=False)
class SearchMarks:
    """A search for edges along the normals of a contour, in the order along it.

    Parameters
    ----------
    lines_px : (N, 2, 2)
        Both ends of each search line [px].
    edges_px : (N, 2)
        The edge that each line found [px]; NaN where there is none.
    agrees : (N,) of bool
        Whether that edge agrees with the fit; the others are rejected.
    """

    lines_px: Points
    edges_px: Points
    agrees: NDArray[np.bool_]

    @classmethod
    def none(cls) -> SearchMarks:
        """Return the marks of a frame that was not searched."""
        return cls(np.empty((0, 2, 2)), np.empty((0, 2)), np.empty(0, np.bool_))


@dataclass(frozen=True, eq=False)
class RobotMarks:
    """A robot on the plan, and in views that do not show it themselves.

    Parameters
    ----------
    gripper : (2,)
        Point of the plane under or over the gripper [plane units].
    jaw_width
        Opening of the jaws [plane units], ≥ 0.
    jaw_angle_rad
        Direction in which they close, from the plane's X towards its Y [rad].
    trail : (N, 2)
        Where the gripper was before, oldest first [plane units].
    block : (M, 2) or None
        Outline of what it carries, or shall carry [plane units].
    place : (2,) or None
        Where that shall go [plane units].
    words
        What it does.
    in_views
        Whether to mark gripper and block in the views too.
    jaw_length
        Length of a jaw as drawn [plane units], ≥ 0.
    """

    gripper: ArrayLike
    jaw_width: float
    jaw_angle_rad: float
    trail: ArrayLike = ()
    block: ArrayLike | None = None
    place: ArrayLike | None = None
    words: str = ""
    in_views: bool = False
    jaw_length: float = 0.0

    def jaws(self) -> Points:
        """(2, 2, 2) ends of both jaws."""
        along = np.array([math.cos(self.jaw_angle_rad), math.sin(self.jaw_angle_rad)])
        across = np.array([-along[1], along[0]])
        middle = finite_array(self.gripper, "gripper", (2,))
        sides = np.array([[-0.5], [0.5]]) * self.jaw_width * along
        ends = np.array([[-0.5], [0.5]]) * self.jaw_length * across
        return np.asarray(middle + sides[:, None] + ends[None])


def draw_view(
    observed: Observed,
    plane_views: Sequence[PlaneView],
    index: int,
    fix: Fix,
    *,
    size_px: tuple[int, int],
    truth: ArrayLike | None = None,
    edges: bool = False,
    robot: RobotMarks | None = None,
) -> Image:
    """Draw one view: figure 2a of the paper, with the ellipse of figure 4.

    The frame, scaled to fit; the reference points with their numbers; the template's outline in
    the colour of its status; the finger line; the indicated point and its 95 % ellipse, projected
    back; and, thin, the other views' constraint lines, which cross the finger line there.

    Parameters
    ----------
    observed
        What the view saw.
    plane_views
        How all views see the plane.
    index
        Which of them this view is.
    fix
        Where the hand points.
    size_px
        Width and height of the picture, 1 to 32767; a frame of other proportions leaves bars.
    truth : (2,)
        Where the hand truly points [plane units], if known.
    edges
        Whether to mark where the tracker looked for edges, those that it chose and those that it
        rejected; magnified in a corner where the hand is small.
    robot
        Marked if it is `in_views`.

    Returns
    -------
    (height, width, 3) of uint8
        Blue-green-red.

    Raises
    ------
    InvalidInputError
        An image that is not uint8 of one or three channels, a size out of range, or a truth that
        is no point.
    """
    sheet = Sheet.blank(size_px, PANEL)
    if observed.frame is None or observed.frame.image.size == 0:
        sheet.text("no frame", np.array(size_px) / 2, 18, MUTED, anchor=0.5)
        return sheet.pixels
    view = plane_views[index]
    image = observed.frame.image
    sheet = sheet.with_image(image)
    _draw_references(sheet, view.plane_points, view.project)
    if robot is not None and robot.in_views:
        _draw_robot(sheet, robot, view.project)
    for k, line in enumerate(fix.constraint_lines):
        if line is not None and k != index:
            sheet.line(view.project(_near_references(line, view.plane_points)), _of_view(k), 1)
    status = _status(observed)
    outline = _with_gaps(observed.contour_px)
    sheet.line(outline, STATUSES[status], 2, dash=_DASHES.get(status), cased=True)
    closeup = _closeup(sheet, image, observed.search) if edges else None
    if edges and closeup is None:
        _draw_search(sheet, observed.search)
    if isinstance(observed.finger, FingerLine):
        sheet.line(_ahead(observed.finger, sheet.corners()), _of_view(index), 2, cased=True)
    _draw_fix(sheet, fix, truth, view.project)
    if closeup is not None:
        point = [] if fix.point is None else [view.project(fix.point)]
        _draw_closeup(sheet, image, closeup, observed, point)
    return sheet.pixels


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

    Axes in plane units, of one scale and never mirrored against what the views show; reference
    points, constraint lines in the band of one standard deviation, indicated point with its 95 %
    ellipse. A point outside the plan becomes an arrow at its border.

    Parameters
    ----------
    plane_views
        How all views see the plane.
    fix
        Where the hand points.
    unit
        Name of the plane's unit.
    size_px
        Width and height of the picture, 1 to 32767.
    truth : (2,)
        Where the hand truly points [plane units], if known.
    trail : (N, 2)
        Points indicated before, oldest first [plane units].
    truth_trail : (N, 2)
        Where the hand truly pointed before; NaN breaks it.
    robot
        A robot over the plane.

    Returns
    -------
    (height, width, 3) of uint8
        Blue-green-red.

    Raises
    ------
    InvalidInputError
        A size out of range, or a truth that is no point.
    """
    points = plane_views[0].plane_points
    plan = Plan.of(plane_views[0], size_px)
    sheet = Sheet.blank(size_px, PANEL)
    _draw_axes(sheet, plan, unit)
    window = Sheet(sheet.pixels[plan.rows, plan.columns], plan.window_from_plane)
    window.area(points[_hull(points)], PLANE)
    _draw_grid(window, plan)
    _draw_references(window, points, _as_they_are)
    for k, line in enumerate(fix.constraint_lines):
        if line is not None:
            _draw_constraint_line(window, plan, line, _of_view(k))
    if robot is not None:
        window.line(_rows(robot.trail), _mixed(PLANE, ROBOT, 0.6), 1)
        _draw_robot(window, robot, _as_they_are)
    window.line(_rows(truth_trail), TRUTH, 1)
    _draw_trail(window, _rows(trail))
    _draw_fix(window, fix, truth, _as_they_are)
    if fix.point is not None:
        _draw_arrow(window, plan, fix.point)
    return sheet.pixels


class Composition:
    """Pictures of a run, all of one size: every view, the plan, and a line with the numbers.

    The layout follows the number of views and the proportions of the first frames; later pictures
    keep it, so that they make a video.

    Parameters
    ----------
    plane_views
        How the views see the plane, in the rig's order; at least one.
    unit
        Name of the plane's unit.
    edges
        Whether to mark where the tracker looked for edges, those that it chose and those that it
        rejected, and to say under each view why its frame went the way it did.

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
    ) -> Image:
        """Draw one moment.

        Parameters
        ----------
        observations
            One per view, in the rig's order.
        fix
            Where the hand points.
        truth, trail, truth_trail, robot
            As for `draw_plan`.

        Returns
        -------
        (height, width, 3) of uint8
            Blue-green-red; of one size, with even sides, at every call.

        Raises
        ------
        InvalidInputError
            Another number of observations than views, an image that is none, or a truth that is
            no point.
        """
        if len(observations) != len(self._views):
            raise InvalidInputError(
                f"{len(observations)} observations; one for each of {len(self._views)} views "
                "is needed"
            )
        if self._layout is None:
            self._layout = _Layout.of(observations, _CAPTION_PX if self._edges else 0)
        layout, plan = self._layout, len(observations)
        size_px = layout.cell_px
        page = Sheet.blank(layout.page_px, PAGE)
        for k, observed in enumerate(observations):
            _draw_view_title(page, layout, k, observed)
            page.pixels[layout.cell(k)] = draw_view(
                observed,
                self._views,
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
            self._views,
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
        """Time, status and numbers from the left; at the right, what the marks mean."""
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


@dataclass(frozen=True, eq=False)
class Plan:
    """Where the plan shows what: a window onto the plane inside a picture, axes around it."""

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

        X points to the right. Y points up, or down where the view sees it so: from the side of
        the cameras, nothing is mirrored. Where the view sees X run up or down rather than across,
        Y runs across, in the direction in which it is seen, so that both pictures lie alike.
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
        """Pixels (..., 2) of the whole picture that show points of the plane."""
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


# --- what is drawn ----------------------------------------------------------------------------


def _draw_references(
    sheet: Sheet, plane_points: Points, project: Callable[[Points], Points]
) -> None:
    """Draw the outline around the reference points, and their numbers, which start at 1."""
    corners = plane_points[_hull(plane_points)]
    along = np.linspace(0.0, 1.0, 16, endpoint=False)[:, None]  # a lens bends straight sides
    sides = [
        a + along * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
    ]
    sheet.line(project(np.concatenate([*sides, corners[:1]])), INK, 1, cased=True)
    places = sheet.place(project(plane_points))
    if np.isnan(places).all():
        return
    middle, to_baseline = np.nanmean(places, axis=0), np.array([1.0, 6.0])
    for number, place in enumerate(places, start=1):
        outwards = place - middle
        label = place + 16.0 * outwards / max(math.hypot(*outwards), 1.0)
        sheet.dot(place, 3.0, INK)
        sheet.dot(label, 9.0, CASING)
        sheet.text(str(number), label + to_baseline, 14, INK, anchor=0.5)


def _draw_search(sheet: Sheet, search: SearchMarks) -> None:
    """Draw search lines, edges that agree with the fit and edges that were rejected."""
    lines = sheet.place(search.lines_px)
    marked = _spaced(lines.mean(axis=1))
    lines, edges = lines[marked], sheet.place(search.edges_px[marked])
    pixels = sheet.on_pixels()
    pixels.line(_broken(lines), NORMAL, 1)
    for edge, agrees in zip(edges, search.agrees[marked], strict=True):
        (_draw_chosen if agrees else _draw_rejected)(pixels, edge)


def _closeup(sheet: Sheet, image: Image, search: SearchMarks) -> tuple[slice, slice] | None:
    """Give the rows and columns of an image that show a search; None if it needs no magnifier."""
    size = np.array(image.shape[1::-1])
    places = np.concatenate([search.lines_px.mean(axis=1), search.edges_px])
    places = places[((places >= 0.0) & (places < size)).all(axis=1)]  # false for NaN
    if not len(places):
        return None
    lower, upper = places.min(axis=0), places.max(axis=0)
    side = round(_CLOSEUP_BORDER * float((upper - lower).max())) + _CLOSEUP_LEAST_PX
    ends = sheet.place(np.array([[0.0, 0.0], [side, 0.0]]))
    if _MAGNIFIED * (ends[1, 0] - ends[0, 0]) > _closeup_px(sheet) or side > size.min():
        return None
    x, y = np.clip(np.rint((lower + upper - side) / 2).astype(int), 0, size - side).tolist()
    return slice(y, y + side), slice(x, x + side)


def _draw_closeup(
    sheet: Sheet,
    image: Image,
    part: tuple[slice, slice],
    observed: Observed,
    points: Sequence[Points],
) -> None:
    """Draw a search magnified, in the corner furthest from it and from other points."""
    rows, columns = part
    side_px, status = _closeup_px(sheet), _status(observed)
    origin = np.array([columns.start, rows.start])
    blank = Sheet.blank((side_px, side_px), PANEL)
    inset = blank.with_image(image[part], origin)
    outline = _with_gaps(observed.contour_px)
    inset.line(outline, STATUSES[status], 1, dash=_DASHES.get(status))
    _draw_search(inset, observed.search)
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    around = corners[[0, 1, 2, 3, 0]]
    blank.line(around * (side_px - 1), INK, 1)
    length = columns.stop - columns.start
    sheet.line(origin - 0.5 + around * length, INK, 1, cased=True)

    room = np.array(sheet.size_px) - side_px - 2 * _CLOSEUP_MARGIN_PX
    begins = _CLOSEUP_MARGIN_PX + corners * room
    kept_clear = sheet.place(np.array([origin + length / 2.0, *points]))
    away = np.linalg.norm(begins[:, None] + side_px / 2.0 - kept_clear, axis=-1)
    x, y = begins[np.nanmin(away, axis=1).argmax()].astype(int).tolist()
    sheet.pixels[y : y + side_px, x : x + side_px] = inset.pixels


def _closeup_px(sheet: Sheet) -> int:
    return int(_CLOSEUP_SHARE * min(sheet.size_px))


def _draw_chosen(sheet: Sheet, place: Points) -> None:
    sheet.dot(place, 2.6, CASING)
    sheet.dot(place, 1.8, INK)


def _draw_rejected(sheet: Sheet, place: Points) -> None:
    diagonals = _CROSS_PX * np.array([[[-1.0, -1.0], [1.0, 1.0]], [[-1.0, 1.0], [1.0, -1.0]]])
    sheet.on_pixels().line(_broken(place + diagonals), REJECTED, 1, cased=True)


def _draw_fix(
    sheet: Sheet, fix: Fix, truth: ArrayLike | None, project: Callable[[Points], Points]
) -> None:
    """Draw the 95 % ellipse, where the hand truly points, and the indicated point."""
    ellipse = fix.ellipse(0.95)
    if ellipse is not None:
        outline = project(ellipse.polygon(72))
        sheet.area(outline, POINT, 0.4)
        sheet.line(np.concatenate([outline, outline[:1]]), POINT, 1)
    if truth is not None:
        sheet.cross(sheet.place(project(finite_array(truth, "truth", (2,)))), 8.0, TRUTH)
    if fix.point is not None:
        _draw_point(sheet, sheet.place(project(fix.point)))


def _draw_point(sheet: Sheet, place: Points) -> None:
    sheet.dot(place, 5.5, CASING)
    sheet.dot(place, 4.5, INK)
    sheet.dot(place, 3.0, POINT)


def _draw_robot(sheet: Sheet, robot: RobotMarks, project: Callable[[Points], Points]) -> None:
    """Draw the block, where it shall go, and the gripper's two jaws over it."""
    if robot.place is not None:
        place = sheet.place(project(finite_array(robot.place, "place", (2,))))
        turn = np.linspace(0.0, 2.0 * np.pi, 25)
        ring = place + 9.0 * np.column_stack([np.cos(turn), np.sin(turn)])
        sheet.on_pixels().line(ring, BLOCK, 2, dash=(5.0, 4.0))
    if robot.block is not None:
        block = project(_rows(robot.block))
        sheet.area(block, BLOCK, 0.85)
    jaws = [project(jaw) for jaw in robot.jaws()]
    for jaw in jaws:
        sheet.line(jaw, ROBOT, 4, cased=True)
    sheet.line(np.array([jaw.mean(axis=0) for jaw in jaws]), ROBOT, 1)


def _draw_robot_title(page: Sheet, robot: RobotMarks, right: float, baseline: float) -> None:
    """Say at the right of a title what the robot does, beside its mark."""
    begin, _ = page.text(robot.words, (right, baseline), 18, ROBOT, anchor=1.0)
    for x in (begin - 20.0, begin - 10.0):
        page.line(np.array([[x, baseline - 12.0], [x, baseline - 1.0]]), ROBOT, 3)


def _draw_constraint_line(
    window: Sheet, plan: Plan, constraint: ConstraintLine, colour: Colour
) -> None:
    """Draw the line through the whole window, in its band of one standard deviation."""
    ends = clip_to_rectangle(constraint.line, plan.lower, plan.upper)
    if ends is None:
        return
    points = _between(ends, 33)
    with np.errstate(invalid="ignore"):  # the variance of an exact line may round to below zero
        away = constraint.sigma_at(points)[:, None] * constraint.line[:2]
    window.area(np.concatenate([points + away, (points - away)[::-1]]), colour, 0.25)
    window.line(ends, colour, 2)


def _draw_trail(window: Sheet, trail: Points) -> None:
    """Draw dots that fade with age."""
    for place, youth in zip(window.place(trail), np.linspace(0.3, 0.8, len(trail)), strict=True):
        window.dot(place, 2.5, _mixed(PLANE, POINT, youth))


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


def _draw_view_title(page: Sheet, layout: _Layout, index: int, observed: Observed) -> None:
    """Write the view's name beside a mark in its colour; at the right, its status."""
    x, baseline = layout.title(index)
    status = _status(observed)
    right = x + layout.cell_px[0]
    begin, _ = page.text(status, (right, baseline), 18, STATUSES[status], anchor=1.0)
    page.dot(np.array([begin - 12, baseline - 6]), 5, STATUSES[status])
    page.pixels[baseline - 14 : baseline + 1, x : x + 6] = _of_view(index)
    page.text(observed.view, (x + 16, baseline), 19, INK, bold=True, room=begin - 40 - x)


def _draw_caption(page: Sheet, layout: _Layout, index: int, observed: Observed) -> None:
    """Say under a view why its frame went the way it did."""
    x, baseline = layout.caption(index)
    colours = [STATUSES[_status(observed)], MUTED]
    for k, (words, colour) in enumerate(zip(observed.reasons, colours, strict=False)):
        place = (x, baseline + k * _CAPTION_LINE_PX)
        page.text(words, place, _CAPTION_TYPE_PX, colour, room=layout.cell_px[0])


def _draw_search_key(page: Sheet, layout: _Layout, index: int) -> None:
    """Say under the plan what the marks of a search mean."""
    x, baseline = layout.caption(index)
    right = x + layout.cell_px[0]
    keys: list[tuple[str, Callable[[Sheet, Points], None] | None]] = [
        ("edge agrees", _draw_chosen),
        ("edge rejected", _draw_rejected),
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
    """Say what the marks of a fix mean."""
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
    _draw_point(page, centre)


def _in_numbers(fix: Fix, unit: str, plane_size: float) -> str:
    """Give the fix to a thousandth of the plane; without one, say why."""
    if fix.point is None or fix.covariance is None:
        return fix.reason
    digits = max(0, -math.floor(math.log10(plane_size / 1000.0)))
    axes = [
        f"{axis} {value:.{digits}f} ± {sigma:.{digits}f}"
        for axis, value, sigma in zip(
            "XY", fix.point, np.sqrt(np.diag(fix.covariance)), strict=True
        )
    ]
    crossing = math.degrees(fix.crossing_angle_rad or 0.0)
    return f"{'   '.join(axes)} {unit}   lines cross at {crossing:.0f}°"


# --- where it is drawn ------------------------------------------------------------------------


@dataclass(frozen=True)
class _Layout:
    """A grid of equal cells, one per view and the last for the plan, each with a title above."""

    columns: int
    rows: int
    cell_px: tuple[int, int]
    caption_px: int
    """Height of what stands below each cell."""

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
        """Width and height of the whole, even as videos want them."""
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
    """Middle of the frames' proportions, within what suits a plan."""
    shapes = [frame.image.shape for frame in frames if frame is not None and frame.image.size]
    if not shapes:
        return _USUAL_ASPECT
    return float(np.clip(np.median([shape[1] / shape[0] for shape in shapes]), *_ASPECTS))


def _inner(length: int, *, before: int, after: int) -> slice:
    """Take a length between two borders, which give way where it is too short for them."""
    if length < 2 * (before + after):
        before = after = length // 4
    return slice(before, length - after)


def _ahead(finger: FingerLine, corners: Points) -> Points:
    """Give the finger line from the tip on, as far as it lies between two corners."""
    ends = clip_to_rectangle(line_at_angle(finger.anchor_px, finger.angle_rad), *corners)
    if ends is None:
        return np.empty((0, 2))
    along = np.array([math.cos(finger.angle_rad), math.sin(finger.angle_rad)])
    reach = np.sort((ends - finger.anchor_px) @ along)
    tip = float((finger.tip_px - finger.anchor_px) @ along)
    if reach[1] <= tip:
        return np.empty((0, 2))
    return np.asarray(finger.anchor_px + np.outer([max(tip, reach[0]), reach[1]], along))


def _near_references(line: ConstraintLine, plane_points: Points) -> Points:
    """Give the part of a constraint line around the reference points, in small steps."""
    lower, upper = plane_points.min(axis=0), plane_points.max(axis=0)
    border = 0.25 * (upper - lower)
    ends = clip_to_rectangle(line.line, lower - border, upper + border)
    return np.empty((0, 2)) if ends is None else _between(ends, 65)


def _between(ends: Points, count: int) -> Points:
    return np.asarray(ends[0] + np.linspace(0.0, 1.0, count)[:, None] * (ends[1] - ends[0]))


def _with_gaps(outline: Points) -> Points:
    """Put a row of NaN between two fingers of an outline, so that no line joins them."""
    if len(outline) < 3:
        return outline
    steps = np.hypot(*np.diff(outline, axis=0).T)
    jumps = np.flatnonzero(steps > _OUTLINE_GAP * np.median(steps)) + 1
    return np.insert(outline, jumps, np.nan, axis=0)


def _spaced(places: Points) -> slice:
    """Leave out places that stand too close together along the outline."""
    steps = np.hypot(*np.diff(places, axis=0).T)
    steps = steps[np.isfinite(steps)]
    spacing = float(np.median(steps)) if len(steps) else _EDGE_SPACING_PX
    return slice(None, None, max(1, round(_EDGE_SPACING_PX / max(spacing, 0.5))))


def _broken(lines: Points) -> Points:
    """Put (N, K, 2) lines into one, with NaN between them."""
    gaps = np.full((len(lines), 1, 2), np.nan)
    return np.concatenate([lines, gaps], axis=1).reshape(-1, 2)


def _hull(points: Points) -> NDArray[np.intp]:
    """Give the indices of the corners of the convex hull, in order."""
    import cv2

    lower, upper = points.min(axis=0), points.max(axis=0)
    unit = ((points - lower) / (upper - lower)).astype(np.float32)
    return np.asarray(cv2.convexHull(unit, returnPoints=False), np.intp).ravel()


def _status(observed: Observed) -> str:
    return "tracking" if isinstance(observed.finger, FingerLine) else observed.finger.value


def _of_view(index: int) -> Colour:
    return VIEWS[index % len(VIEWS)]


def _as_they_are(points: Points) -> Points:
    return points


def _rows(points: ArrayLike) -> Points:
    return np.asarray(points, np.float64).reshape(-1, 2)


def _mixed(ground: Colour, colour: Colour, share: float) -> Colour:
    blue, green, red = (round(a + share * (b - a)) for a, b in zip(ground, colour, strict=True))
    return blue, green, red
