"""One moment of a run, as it goes from the main loop to the page: plain values and one JPEG a view.

What is drawn over a picture and the picture itself travel together, so that they always belong to
one instant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerpost.pipeline import Observation, Step
from fingerpost.pointing import FingerLine, Fix, PlaneView
from fingerpost.recording.picture import SearchMarks, status_of

LARGEST_PX = 1280
"""Pictures with a longer side are shown reduced: a page has no more room for one view."""

_JPEG_QUALITY = 80


@dataclass(frozen=True, eq=False, slots=True)
class ViewMoment:
    """What one view saw.

    Attributes
    ----------
    name
        The view's.
    status
        As `recording.picture.status_of`, or "moved" while its camera is adrift.
    follows
        Whether a template lies on something; else the hand is looked for everywhere.
    reasons
        Why the frame went the way it did.
    time_s
        When the frame was captured; None without one.
    jpeg
        The picture; empty where there is none.
    size_px
        Width and height of the frame in whose pixels the rest is, which the picture shows whole.
    contour_px : (N, 2)
        The template's outline.
    finger
        The finger line, or None.
    plane_view
        How the view saw the plane.
    search
        The last search for edges.
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
        """Return what a view saw, its picture encoded."""
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
        How many steps were before it.
    frame
        Index of the first view's frame in its source.
    views
        In the rig's order.
    fix
        Where the hand points.
    begun_s, told_s
        When the work on it began, and when its fix was reported, by the monotonic clock; a
        camera's begins with the capture.
    """

    number: int
    frame: int
    views: tuple[ViewMoment, ...]
    fix: Fix
    begun_s: float
    told_s: float

    @classmethod
    def of(cls, step: Step, number: int, begun_s: float, told_s: float) -> Moment:
        """Return the moment of a step, with its pictures encoded."""
        views = tuple(map(ViewMoment.of, step.observations))
        return cls(number, step.index, views, step.fix, begun_s, told_s)


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
