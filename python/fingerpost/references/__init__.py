"""Detection of a view's reference points, and the homography of a camera that moves.

`ReferenceWatch` decides from the frames of one view whether its camera is static and, if not, how
the working plane has moved in the image.
"""

from fingerpost.references.following import Measured, ReferenceFollower
from fingerpost.references.markers import MarkersMeter, marker_cells, sheet_markers
from fingerpost.references.meters import Meter, RectangleMeter
from fingerpost.references.polygons import contains, signed_area
from fingerpost.references.rectangles import (
    LEAST_LIKENESS,
    Candidate,
    find_rectangles,
    likeness,
    likeness_in_either_order,
    size_scores,
    turned,
)
from fingerpost.references.reduction import Reduction
from fingerpost.references.registration import PlaneMotion, PlaneRegistration, Segment
from fingerpost.references.sides import Sides, fit_sides
from fingerpost.references.watch import ADRIFT_PX, MOVED_PX, TEST_EVERY, ReferenceWatch

__all__ = [
    "ADRIFT_PX",
    "LEAST_LIKENESS",
    "MOVED_PX",
    "TEST_EVERY",
    "Candidate",
    "MarkersMeter",
    "Measured",
    "Meter",
    "PlaneMotion",
    "PlaneRegistration",
    "RectangleMeter",
    "Reduction",
    "ReferenceFollower",
    "ReferenceWatch",
    "Segment",
    "Sides",
    "contains",
    "find_rectangles",
    "fit_sides",
    "likeness",
    "likeness_in_either_order",
    "marker_cells",
    "sheet_markers",
    "signed_area",
    "size_scores",
    "turned",
]
