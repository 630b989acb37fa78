"""Pictures of a run: every view, and the plan of the working plane, as in the paper.

Figure 2 of Cipolla, Hadfield & Hollinghurst 1994 in one image: each view with the template's
outline, its finger line and the projection of the indicated point; beside them the plan, on which
the constraint lines of the views intersect in that point, with its 95 % ellipse (figure 4). Each
view has one colour, for its finger line in the picture and its constraint line on the plan. Below
them is one line with the numbers.

The colours can be distinguished by colour-blind people, and no information is in colour alone: an
outline is solid while tracking, dashed while waiting and dotted when the hand is lost, and the
status is written above it. If the edge search is shown, a dot is an edge that agrees with the fit
and a cross a rejected one; below each view is the explanation of its result.

Elements that cannot be drawn (no fix, an unbounded covariance, points beyond the horizon or far
outside the picture) are left out.
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
