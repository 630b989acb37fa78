"""Inputs of a recorder, implemented by `fingerpost.capture` and `fingerpost.pipeline`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fingerpost.pointing import Fix, PlaneView
from fingerpost.recording.picture.marks import Observed
from fingerpost.recording.tables import PointRow, TrackRow


class Seen(Protocol):
    """A view's frame, or its loss, which has a reason instead of an image."""

    @property
    def index(self) -> int:
        """Position in its source."""

    @property
    def time_s(self) -> float:
        """Capture time [s]."""


class WholeFromReduced(Protocol):
    """Reduction of frames; `fingerpost.references.Reduction` is one."""

    @property
    def whole_from_reduced(self) -> NDArray[np.float64]:
        """(3, 3) Transform from pixels of the reduced image to those of the full one."""


class Recordable(Observed, Protocol):
    """Result of one view; `fingerpost.pipeline.Observation` is one."""

    @property
    def reduction(self) -> WholeFromReduced:
        """Reduction of its frame."""

    @property
    def plane_view(self) -> PlaneView | None:
        """Its homography."""

    def track_row(self) -> TrackRow | None:
        """Return its row of `tracks.csv`."""


class RecordableStep(Protocol):
    """Results of the frames of one time; `fingerpost.pipeline.Step` is one."""

    @property
    def observations(self) -> Sequence[Recordable]:
        """One per view."""

    @property
    def fix(self) -> Fix:
        """The fix."""

    def point_row(self) -> PointRow:
        """Return its row of `points.csv`."""
