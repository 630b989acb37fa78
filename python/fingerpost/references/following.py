"""Follows references that are measured anew in every frame, a rectangle's sides or markers.

While a camera keeps still its measurements are averaged, until the covariance falls no further:
what pixels' noise adds is another in every frame, what is rough about an edge is not. A camera that
was knocked shows most of the four points elsewhere at once; from there the average begins anew.
Where too little of them is visible, the texture of the plane shows whether the camera has moved
(`ReferenceWatch`): what is known of a plane that stands still is held, and a plane that has moved
is followed by it until its references are seen again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fingerpost.homography import transfer_to_image
from fingerpost.lens import Lens
from fingerpost.pointing import PlaneView
from fingerpost.references.registration import Segment
from fingerpost.references.watch import ReferenceWatch
from fingerpost.uncertainty import blocks_of

if TYPE_CHECKING:
    from fingerpost.references.meters import Meter

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

MOVED_PX = 0.3
MOVED_SIGMAS = 4.0
MOVED_POINTS = 3
"""A camera has moved by which so many of the four points are off by so much: a side that something
covers takes two with it."""

SETTLED_FRAMES = 5
"""A camera that keeps still for so many measurements stands again."""

MOST_AVERAGED = 200
LITTLE_LEFT = 0.1
"""Frames are measured seldom when that can lessen the covariance by no more than this part, and are
averaged up to so many."""

LEAST_SCATTER = 3
"""Least number of measurements whose scatter estimates the noise part of the covariance."""

ALL_NOISE = 0.8
"""Ratio of the scatter to the covariances from which these are taken for noise alone: from few
edges they are estimated a little too large."""

MEASURE_EVERY = 3
"""One frame in so many of a camera that keeps still is measured then."""

SEARCH_EVERY = 32
"""While references are not seen, frames are searched whose number is a power of two, or a multiple
of this."""


@dataclass(frozen=True, eq=False)
class Measured:
    """Four points of the plane as one frame shows them.

    Attributes
    ----------
    points_px
        (4, 2) [px]; may lie outside of the picture.
    covariance
        (8, 8) Of u and v of the points, one after the other [px²].
    """

    points_px: Array
    covariance: Array

    @property
    def covariances_px2(self) -> Array:
        """(4, 2, 2) The covariance of each point alone."""
        return blocks_of(self.covariance)


class _Mean:
    """The average of measurements of points that keep still."""

    def __init__(self, first: Measured) -> None:
        self.count = 1
        self._points_px = first.points_px.ravel().copy()
        self._covariance = first.covariance.copy()
        self._squares = np.zeros(8)

    @property
    def points_px(self) -> Array:
        """(4, 2) [px]."""
        return self._points_px.reshape(4, 2)

    @property
    def noise_part(self) -> float:
        """The part of a measurement's covariance that is another one in every frame, 0 to 1."""
        if self.count < LEAST_SCATTER:
            return 0.0
        variances = self._squares / (self.count - 1)
        return min(float(np.mean(variances / np.diag(self._covariance))) / ALL_NOISE, 1.0)

    @property
    def covariance(self) -> Array:
        """(8, 8) [px²]."""
        noise = self.noise_part
        return self._covariance * (1.0 - noise + noise / self.count)

    @property
    def is_done(self) -> bool:
        """Whether more measurements would hardly lessen the covariance."""
        if self.count < SETTLED_FRAMES:
            return False
        noise = self.noise_part / self.count
        return self.count >= MOST_AVERAGED or noise < LITTLE_LEFT * (1.0 - self.noise_part + noise)

    def add(self, measured: Measured) -> None:
        """Take one more measurement."""
        self.count += 1
        off = measured.points_px.ravel() - self._points_px
        self._points_px = self._points_px + off / self.count
        self._squares += off * (measured.points_px.ravel() - self._points_px)
        self._covariance = self._covariance + (measured.covariance - self._covariance) / self.count


class ReferenceFollower:
    """Tells how a view sees the plane, by references that are measured anew.

    Parameters
    ----------
    plane_points
        (4, 2) The points of the plane that are measured.
    meter
        What measures them.
    first
        About where they are in the first frame that is looked at.
    lens
        The view's distortion, if it is known.
    """

    def __init__(
        self, plane_points: Array, meter: Meter, first: Measured, lens: Lens | None = None
    ) -> None:
        self._plane_points = plane_points
        self._meter = meter
        self._lens = lens
        self._frames = 0
        self._is_measured = False
        self._begin(first)
        self.moved_px = 0.0
        self.is_adrift = False
        self.is_held = False

    @property
    def covariance(self) -> Array:
        """Covariance of the points as averaged so far, (8, 8) [px²]."""
        return self._mean.covariance

    def _begin(self, measured: Measured) -> None:
        """Begin to average anew, at another place."""
        self._mean = _Mean(measured)
        self._missed = 0
        self._watch: ReferenceWatch | None = None
        self._plane_view = self._seen(measured.points_px, measured.covariance)

    def _seen(self, points_px: Array, covariance: Array) -> PlaneView:
        return PlaneView.from_reference_points(
            self._plane_points, points_px, covariance, self._lens
        )

    def plane_view(self, still: PlaneView) -> PlaneView | None:  # noqa: ARG002
        """Return how the view sees the plane; None while that is not known.

        Parameters
        ----------
        still
            How it was seen at first; what is measured anew does not depend on it.
        """
        return None if self.is_adrift else self._plane_view

    def doubt(self) -> None:
        """Hold nothing until references or texture are seen again, as `ReferenceWatch.doubt`."""
        if self._watch is not None:
            self._watch.doubt()

    def look(
        self, grey: Picture, hand: Segment | None = None, picture: Picture | None = None
    ) -> None:
        """Take the next frame.

        Parameters
        ----------
        grey
            (H, W) Its grey levels.
        hand
            Where a hand was in the frame before, if one is followed.
        picture
            (H, W) or (H, W, 3) The same frame with its colours, if it has any.
        """
        self._frames += 1
        picture = grey if picture is None else picture
        self._watched(grey, hand)
        has_moved = self._watch is not None and self._watch.moved_px > 0.0
        stands = self._mean.is_done and not (self.is_adrift or self.is_held or has_moved)
        if stands and self._frames % MEASURE_EVERY != 0:
            return
        measured = None if self.is_adrift else self._meter.measure(picture, self._mean.points_px)
        if measured is not None:
            self._take(measured)
        else:
            self._without(picture)

    def _watched(self, grey: Picture, hand: Segment | None) -> None:
        """Have the texture known of a camera that stands, for when the references are covered."""
        if self._mean.count >= SETTLED_FRAMES:
            if self._watch is None:
                self._watch = ReferenceWatch(self._mean.points_px.tolist(), self._lens)
            self._watch.look(grey, hand)

    def _take(self, measured: Measured) -> None:
        """Average a measurement, or begin anew with it where the camera has moved."""
        self.is_adrift = self.is_held = False
        self._missed = 0
        if not self._is_measured:
            self._is_measured = True
            self._begin(measured)
            return
        off_px = np.linalg.norm(measured.points_px - self._mean.points_px, axis=1)
        variances = np.diag(measured.covariance + self._mean.covariance).reshape(4, 2).sum(axis=1)
        is_off = off_px > np.maximum(MOVED_PX, MOVED_SIGMAS * np.sqrt(variances))
        if is_off.sum() >= MOVED_POINTS:
            self.moved_px = float(np.mean(off_px))
            self._begin(measured)
            return
        if is_off.any() or self._mean.count >= MOST_AVERAGED:
            return
        self._mean.add(measured)
        self._plane_view = self._seen(self._mean.points_px, self._mean.covariance)
        if self._mean.count >= SETTLED_FRAMES:
            self.moved_px = 0.0

    def _without(self, picture: Picture) -> None:
        """Do without measurement: hold what stands still, follow by texture, or search."""
        watch = self._watch
        if watch is not None:
            if watch.motion is not None:
                guess = self._moved(watch)
                measured = self._meter.measure(picture, guess)
                if measured is not None:
                    self._take(measured)
                    return
                still = self._seen(self._mean.points_px, self._mean.covariance)
                motion = watch.motion
                self._plane_view = still.moved(motion.now_from_first, motion.covariance)
                self.moved_px, self.is_adrift, self.is_held = watch.moved_px, False, False
                return
            if watch.moved_px == 0.0 and not (self.is_adrift or watch.is_adrift):
                self.is_held = True
                self._search(picture)
                return
        self.is_adrift, self.is_held = True, False
        self._search(picture)

    def _moved(self, watch: ReferenceWatch) -> Array:
        """Return where the texture says that the points are now."""
        assert watch.motion is not None
        px = self._mean.points_px
        px = px if self._lens is None else self._lens.undistort(px)
        px = transfer_to_image(watch.motion.now_from_first, px)
        return px if self._lens is None else np.asarray(self._lens.distort(px))

    def _search(self, picture: Picture) -> None:
        """Look for the references in all of a picture, ever more seldom, and begin anew there."""
        self._missed += 1
        if self._missed & (self._missed - 1) and self._missed % SEARCH_EVERY:
            return
        found = self._meter.search(picture, self._mean.points_px)
        if found is None:
            return
        measured = self._meter.measure(picture, found.points_px)
        if measured is not None:
            self.moved_px = float(
                np.mean(np.linalg.norm(measured.points_px - self._mean.points_px, axis=1))
            )
            self._begin(measured)
            self.is_adrift, self.is_held, self._is_measured = False, False, True
