"""Tell where on a plane a hand points, and how sure that is.

Two or more ordinary cameras, four reference points on the plane, a pointing hand. Nothing is
calibrated. See `track` for the whole path and `ContourTracker` for one view.
"""

from fingerpost._core import ContourTracker, StartPose, Template
from fingerpost.config import Rig
from fingerpost.errors import FingerpostError
from fingerpost.pipeline import Pointer, track
from fingerpost.pointing import Fix, Status

__all__ = [
    "ContourTracker",
    "FingerpostError",
    "Fix",
    "Pointer",
    "Rig",
    "StartPose",
    "Status",
    "Template",
    "track",
]
