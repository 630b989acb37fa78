"""The picture of one view."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from fingerpost.pointing import FingerLine, Fix, PlaneView
from fingerpost.recording.picture.marks import Observed, RobotMarks, SearchMarks, status_of
from fingerpost.recording.picture.on_plane import draw_fix, draw_references, draw_robot
from fingerpost.recording.picture.palette import INK, MUTED, PANEL, STATUSES, colour_of
from fingerpost.recording.picture.search import draw_search
from fingerpost.recording.picture.shapes import ahead, near_references, with_gaps
from fingerpost.recording.sheet import Image, Points, Sheet

# Dash and gap of an outline [px]; a tracked one is solid.
_DASHES = {"acquiring": (7.0, 5.0), "lost": (0.5, 6.5)}


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

    It shows the frame, scaled to fit; the reference points with their numbers; the template's
    outline in the colour of its status; the finger line; the projections of the indicated point and
    its 95 % ellipse; and, thin, the other views' constraint lines, which cross the finger line
    there.

    Parameters
    ----------
    observed
        Result of the view.
    plane_views
        Homographies of all views.
    index
        Index of this view.
    fix
        The fix.
    size_px
        Width and height of the picture, 1 to 32767; a frame of another aspect ratio leaves bars.
    truth : (2,)
        True indicated point [plane units], if known.
    edges
        Whether to mark search lines with chosen and rejected edges; magnified in a corner if the
        hand is small.
    robot
        Drawn if it is `in_views`.

    Returns
    -------
    (height, width, 3) of uint8
        Blue-green-red.

    Raises
    ------
    InvalidInputError
        An image that is not uint8 of one or three channels, a size out of range, or an invalid
        truth.
    """
    sheet = Sheet.blank(size_px, PANEL)
    if observed.frame is None or observed.frame.image.size == 0:
        sheet.text("no frame", np.array(size_px) / 2, 18, MUTED, anchor=0.5)
        return sheet.pixels
    view = plane_views[index]
    image = observed.frame.image
    sheet = sheet.with_image(image)
    draw_references(sheet, view.plane_points, view.project)
    if robot is not None and robot.in_views:
        draw_robot(sheet, robot, view.project)
    for k, line in enumerate(fix.constraint_lines):
        if line is not None and k != index:
            sheet.line(view.project(near_references(line, view.plane_points)), colour_of(k), 1)
    status = status_of(observed)
    outline = with_gaps(observed.contour_px)
    sheet.line(outline, STATUSES[status], 2, dash=_DASHES.get(status), cased=True)
    closeup = _closeup(sheet, image, observed.search) if edges else None
    if edges and closeup is None:
        draw_search(sheet, observed.search)
    if isinstance(observed.finger, FingerLine):
        sheet.line(ahead(observed.finger, sheet.corners()), colour_of(index), 2, cased=True)
    draw_fix(sheet, fix, truth, view.project)
    if closeup is not None:
        point = [] if fix.point is None else [view.project(fix.point)]
        _draw_closeup(sheet, image, closeup, observed, point)
    return sheet.pixels


# A search is magnified if that enlarges it by at least this factor. The magnified part of the frame
# exceeds the search by a factor and a length; its size is this share of the picture's shorter side.
_MAGNIFIED = 1.5
_CLOSEUP_BORDER = 1.15
_CLOSEUP_LEAST_PX = 16
_CLOSEUP_SHARE = 0.48
_CLOSEUP_MARGIN_PX = 8


def _closeup(sheet: Sheet, image: Image, search: SearchMarks) -> tuple[slice, slice] | None:
    """Return the rows and columns of an image around a search; None if it need not be magnified."""
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
    side_px, status = _closeup_px(sheet), status_of(observed)
    origin = np.array([columns.start, rows.start])
    blank = Sheet.blank((side_px, side_px), PANEL)
    inset = blank.with_image(image[part], origin)
    outline = with_gaps(observed.contour_px)
    inset.line(outline, STATUSES[status], 1, dash=_DASHES.get(status))
    draw_search(inset, observed.search)
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
