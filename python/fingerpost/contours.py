"""The parts of the active contour by themselves: B-splines, templates, shape spaces, search, fit.

For those who build another tracker of them, or teach how this one works. `ContourTracker` puts them
together, with the appearance of the hand, its motion and its finger line.

Examples
--------
An iteration of the paper places the outline, searches along its normals and solves for the step of
the shape vector (section 3.2, eqs. 3 to 7); eight of them, from a start that is 5 px and 3° off:

>>> import numpy as np
>>> from fingerpost import StartPose
>>> from fingerpost.contours import EdgeSearch, Fitter, ShapeSpace, Template
>>> from fingerpost.simulate import DevicePose, SimulatedRig, StartError
>>> frame = SimulatedRig().render(DevicePose.pointing_at((150, 260), hover_mm=120), rng=0)
>>> image, finger = frame.images[0], frame.truth.views[0].finger
>>> given = finger.start(StartError(offset_px=5.0, angle_deg=3.0), rng=0)
>>> start = StartPose(given.tip_px, np.radians(given.angle_deg), given.length_px)
>>> template = Template.pistol(given.thumb)
>>> space, shape = ShapeSpace.affine(start.centre_px, start.linear_px)
>>> for _ in range(8):
...     placed = space.place(shape, template, 100)
...     lines = EdgeSearch().search(image, placed.position_px, placed.normal, 20.0, "bright")
...     is_edge = ~placed.hidden & np.isfinite(lines.offset_px)
...     rows = space.normal_rows(shape, template, 100)[is_edge]
...     fit = Fitter().solve(rows, lines.offset_px[is_edge], lines.variance_px2[is_edge])
...     shape = shape + fit.step
>>> off_rad = space.axis(shape).angle_rad - finger.axis_angle_rad
"""

from fingerpost._core import (
    ArcLength,
    Axis,
    BasisRows,
    BSpline,
    ContourSamples,
    CurvePoints,
    EdgeSearch,
    FitReport,
    Fitter,
    PlacedContour,
    SearchLines,
    ShapeSpace,
    SplineFit,
    Template,
    sample_contour,
)

__all__ = [
    "ArcLength",
    "Axis",
    "BSpline",
    "BasisRows",
    "ContourSamples",
    "CurvePoints",
    "EdgeSearch",
    "FitReport",
    "Fitter",
    "PlacedContour",
    "SearchLines",
    "ShapeSpace",
    "SplineFit",
    "Template",
    "sample_contour",
]
