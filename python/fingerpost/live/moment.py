"""One moment of a run, sent from the main loop to the page: plain values and one JPEG per view.

A picture and the scene drawn over it are sent together, so that they always belong to one instant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerpost.pipeline import Observation, Step
from fingerpost.pointing import FingerLine, Fix, PlaneView
from fingerpost.recording.picture import SearchMarks, status_of

LARGEST_PX = 1280
"""Longest side of a picture that is shown at full size [px]: a page has no more room for a view."""

_JPEG_QUALITY = 80


@dataclass(frozen=True, eq=False, slots=True)
class ViewMoment:
    """Result of one view.

    Attributes
    ----------
    name
        Name of the view.
    status
        As `recording.picture.status_of`, or "moved" while its camera is adrift.
    follows
        Whether a tracker follows a finger; otherwise the whole image is searched.
    reasons
        Explanation of the result.
    time_s
        Capture time of the frame; None without one.
    jpeg
        The picture; empty without one.
    size_px
        Width and height of the frame to whose pixels all coordinates refer; the picture shows it
        completely.
    contour_px : (N, 2)
        The template's outline.
    finger
        The finger line, or None.
    plane_view
        Homography of the view.
    search
        The last edge search.
    """

    name: str
    status: str
    follows: bool
    reasons: tuple[str, ...]
    time_s: float | None
    jpeg: bytes
    size_px: tuple[int, int]
    contour_px: NDArray[np.float64]
    finger: FingerLine | None
    plane_view: PlaneView | None
    search: SearchMarks

    @classmethod
    def of(cls, seen: Observation) -> ViewMoment:
        """Return a view's result, with its picture encoded."""
        frame = seen.frame
        size_px = (0, 0) if frame is None else (frame.image.shape[1], frame.image.shape[0])
        return cls(
            name=seen.view,
            status="moved" if seen.is_adrift else status_of(seen),
            follows=seen.track is not None,
            reasons=seen.reasons,
            time_s=None if frame is None else frame.time_s,
            jpeg=b"" if frame is None else encoded(frame.image),
            size_px=size_px,
            contour_px=seen.contour_px,
            finger=seen.finger if isinstance(seen.finger, FingerLine) else None,
            plane_view=seen.plane_view,
            search=seen.search,
        )


@dataclass(frozen=True, eq=False, slots=True)
class Moment:
    """One step of the main loop.

    Attributes
    ----------
    number
        Number of earlier steps.
    frame
        Index of the first view's frame in its source.
    views
        Results of the views, in the rig's order.
    fix
        The fix.
    begun_s, reported_s
        Monotonic times at which processing began (for a camera, the capture) and at which the fix
        was reported.
    """

    number: int
    frame: int
    views: tuple[ViewMoment, ...]
    fix: Fix
    begun_s: float
    reported_s: float

    @classmethod
    def of(cls, step: Step, number: int, begun_s: float, reported_s: float) -> Moment:
        """Return the moment of a step, with its pictures encoded."""
        views = tuple(map(ViewMoment.of, step.observations))
        return cls(number, step.index, views, step.fix, begun_s, reported_s)


def encoded(image: NDArray[np.uint8]) -> bytes:
    """Return a picture as JPEG, reduced to `LARGEST_PX` if it is larger."""
    import cv2

    longest = max(image.shape[:2])
    if longest > LARGEST_PX:
        height, width = (max(1, round(side * LARGEST_PX / longest)) for side in image.shape[:2])
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        image = np.asarray(small, dtype=np.uint8)
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return data.tobytes()
