"""Tracks references that are measured in every frame: a rectangle's sides or markers.

The measurements of a static camera are averaged until the covariance falls no further: pixel noise
is independent between frames, the roughness of an edge is not. If most of the four points are
displaced at once, the camera has moved, and averaging restarts. If too little of the references is
visible, the texture of the plane shows whether the camera has moved (`ReferenceWatch`): the
homography of a static plane is held, that of a moved one is updated by the texture until its
references are visible again.
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
"""Least displacement of a point (the greater of [px] and [standard deviations]), and least number
of displaced points by which the camera has moved: one occluded side displaces two."""

SETTLED_FRAMES = 5
"""Number of consistent measurements after which a camera counts as static again."""

MOST_AVERAGED = 200
LITTLE_LEFT = 0.1
"""Greatest number of averaged measurements; and greatest relative reduction of the covariance by
further ones at which frames are measured less often."""

LEAST_SCATTER = 3
"""Least number of measurements whose scatter estimates the share of noise in the covariance."""

ALL_NOISE = 0.8
"""Ratio of the scatter to the covariances above which these are noise alone: estimated from few
edges they are slightly too large."""

MEASURE_EVERY = 3
"""Interval between measured frames of a static camera whose average has converged."""

SEARCH_EVERY = 32
"""While no references are visible, the frames searched are those whose number is a power of two or
a multiple of this."""


@dataclass(frozen=True, eq=False)
class Measured:
    """Measured image positions of four points of the plane.

    Attributes
    ----------
    points_px
        (4, 2) Positions [px]; may lie outside the picture.
    covariance
        (8, 8) Joint covariance of u and v of each point in turn [px²].
    """

    points_px: Array
    covariance: Array

    @property
    def covariances_px2(self) -> Array:
        """(4, 2, 2) Marginal covariance of each point [px²]."""
        return blocks_of(self.covariance)


class _Mean:
    """Average of measurements of static points."""

    def __init__(self, first: Measured) -> None:
        self.count = 1
        self._points_px = first.points_px.ravel().copy()
        self._covariance = first.covariance.copy()
        self._squares = np.zeros(8)

    @property
    def points_px(self) -> Array:
        """(4, 2) Mean positions [px]."""
        return self._points_px.reshape(4, 2)

    @property
    def noise_part(self) -> float:
        """Share of a measurement's covariance that is independent between frames, 0 to 1."""
        if self.count < LEAST_SCATTER:
            return 0.0
        variances = self._squares / (self.count - 1)
        return min(float(np.mean(variances / np.diag(self._covariance))) / ALL_NOISE, 1.0)

    @property
    def covariance(self) -> Array:
        """(8, 8) Covariance of the mean [px²]."""
        noise = self.noise_part
        return self._covariance * (1.0 - noise + noise / self.count)

    @property
    def is_done(self) -> bool:
        """Whether more measurements would hardly reduce the covariance."""
        if self.count < SETTLED_FRAMES:
            return False
        noise = self.noise_part / self.count
        return self.count >= MOST_AVERAGED or noise < LITTLE_LEFT * (1.0 - self.noise_part + noise)

    def add(self, measured: Measured) -> None:
        """Add a measurement."""
        self.count += 1
        off = measured.points_px.ravel() - self._points_px
        self._points_px = self._points_px + off / self.count
        self._squares += off * (measured.points_px.ravel() - self._points_px)
        self._covariance = self._covariance + (measured.covariance - self._covariance) / self.count


class ReferenceFollower:
    """Estimates the homography of a view from references measured in every frame.

    Parameters
    ----------
    plane_points
        (4, 2) The measured points of the plane.
    meter
        Measures their images.
    first
        Approximate positions in the first frame.
    lens
        The view's distortion, if known.
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
        """Covariance of the averaged points, (8, 8) [px²]."""
        return self._mean.covariance

    def _begin(self, measured: Measured) -> None:
        """Restart the average at another position."""
        self._mean = _Mean(measured)
        self._missed = 0
        self._watch: ReferenceWatch | None = None
        self._plane_view = self._seen(measured.points_px, measured.covariance)

    def _seen(self, points_px: Array, covariance: Array) -> PlaneView:
        return PlaneView.from_reference_points(
            self._plane_points, points_px, covariance, self._lens
        )

    def plane_view(self, still: PlaneView) -> PlaneView | None:  # noqa: ARG002
        """Return the view's homography; None while unknown.

        Parameters
        ----------
        still
            That of the first frame; not used, because the references are measured.
        """
        return None if self.is_adrift else self._plane_view

    def doubt(self) -> None:
        """Discard the homography until references or texture confirm it: `ReferenceWatch.doubt`."""
        if self._watch is not None:
            self._watch.doubt()

    def look(
        self, grey: Picture, hand: Segment | None = None, picture: Picture | None = None
    ) -> None:
        """Process the next frame.

        Parameters
        ----------
        grey
            (H, W) Its grey levels.
        hand
            Region of a followed hand in the previous frame, if any.
        picture
            (H, W) or (H, W, 3) The same frame in colour, if available.
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
        """Update the watch on the texture, for use when the references are covered."""
        if self._mean.count >= SETTLED_FRAMES:
            if self._watch is None:
                self._watch = ReferenceWatch(self._mean.points_px.tolist(), self._lens)
            self._watch.look(grey, hand)

    def _take(self, measured: Measured) -> None:
        """Average a measurement, or restart the average with it if the camera has moved."""
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
        """Handle a frame without a measurement: hold, follow by texture, or search."""
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
        """Return the present positions of the points according to the texture [px]."""
        assert watch.motion is not None
        px = self._mean.points_px
        px = px if self._lens is None else self._lens.undistort(px)
        px = transfer_to_image(watch.motion.now_from_first, px)
        return px if self._lens is None else np.asarray(self._lens.distort(px))

    def _search(self, picture: Picture) -> None:
        """Search the whole picture for the references, at growing intervals, and restart there."""
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
