"""What a recorder takes; `fingerpost.capture` and `fingerpost.pipeline` have it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fingerpost.pointing import Fix, PlaneView
from fingerpost.recording.picture.marks import Observed
from fingerpost.recording.tables import PointRow, TrackRow


class Seen(Protocol):
    """A view's frame, or its loss, which has no image but says why."""

    @property
    def index(self) -> int:
        """Position in its source."""

    @property
    def time_s(self) -> float:
        """Capture time [s]."""


class WholeFromReduced(Protocol):
    """How frames were reduced; `fingerpost.references.Reduction` is one."""

    @property
    def whole_from_reduced(self) -> NDArray[np.float64]:
        """(3, 3) From pixels of the reduced image to those of the whole one."""


class Recordable(Observed, Protocol):
    """What one view saw; `fingerpost.pipeline.Observation` is one."""

    @property
    def reduction(self) -> WholeFromReduced:
        """How its frame was reduced."""

    @property
    def plane_view(self) -> PlaneView | None:
        """How it saw the plane."""

    def track_row(self) -> TrackRow | None:
        """Return its row of `tracks.csv`."""


class RecordableStep(Protocol):
    """What was made of the frames of a time; `fingerpost.pipeline.Step` is one."""

    @property
    def observations(self) -> Sequence[Recordable]:
        """One per view."""

    @property
    def fix(self) -> Fix:
        """Where the hand points."""

    def point_row(self) -> PointRow:
        """Return its row of `points.csv`."""
