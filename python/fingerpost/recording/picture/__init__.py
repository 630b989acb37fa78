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

from fingerpost.recording.picture.composition import MAX_WIDTH_PX, Composition, point_in_numbers
from fingerpost.recording.picture.marks import (
    Observed,
    Pictured,
    RobotMarks,
    SearchMarks,
    status_of,
)
from fingerpost.recording.picture.plan import Plan, draw_plan
from fingerpost.recording.picture.view import draw_view

__all__ = [
    "MAX_WIDTH_PX",
    "Composition",
    "Observed",
    "Pictured",
    "Plan",
    "RobotMarks",
    "SearchMarks",
    "draw_plan",
    "draw_view",
    "point_in_numbers",
    "status_of",
]
