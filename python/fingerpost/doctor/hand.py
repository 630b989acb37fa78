"""Presence and contrast of the hand.

The tracker itself is run from the start pose over the frames. If it confirms a hand, contrast and
length are those of this hand; otherwise the levels along the start pose are compared with those
beside it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerpost._core import ContourTracker, StartPose, Template
from fingerpost.capture import Frame
from fingerpost.config import Start
from fingerpost.doctor.findings import Check, Finding, Severity

Array = NDArray[np.float64]

CONTRAST = (20.0, 9.0)
"""Contrast of the finger against its surroundings [grey levels]: at the first, errors are four
times those at contrast 80; on the simulated rig the tracker confirmed hands at 10, not at 8."""

NOTHING = 2.5
"""Least contrast of a finger [grey levels]."""

FINGER_PX = (30.0, 15.0)
"""Visible length of the index finger [px]: a line's error grows as length^-3/2; below the second
its flanks are too short to define a direction."""

SETTLES_WITHIN = 0.5
"""Distance from the start's tip, in finger lengths, within which a hand that the tracker follows
must have been once to be the one that is presented: on real and rendered footage it comes as near
as 0.3."""

LARGEST_FINGER_SHARE = 0.7
"""Greatest finger length relative to the image's shorter side: a larger hand leaves the image when
it points."""

# Distances inside and outside an edge at which levels are read [px], beyond its blur.
_BESIDE_PX = np.arange(3.0, 6.01, 1.0)
# Width of a finger over its length; and distance of its surroundings from its axis, in widths.
_FINGER_WIDTH = 0.2
_ALONG = np.linspace(0.25, 0.9, 14)
_INSIDE = np.linspace(-0.3, 0.3, 7)
_OUTSIDE = np.linspace(0.9, 1.5, 7)


@dataclass(frozen=True, slots=True)
class HandReadings:
    """See `fingerpost.doctor.findings.ViewReadings`; the length is the start's if none is found."""

    found: bool
    contrast: float
    finger_px: float


def read_hand(frames: Sequence[Frame], start: Start) -> HandReadings:
    """Track a hand from its start pose over some frames, at least one."""
    pose = StartPose(start.tip_px, math.radians(start.angle_deg), start.length_px)
    tracker = ContourTracker(Template.pistol(start.thumb), pose)
    contrasts: list[float] = []
    lengths: list[float] = []
    for frame in frames:
        track = tracker.update(frame.grey(), frame.time_s, frame.colour())
        line = track.finger_line
        if line is None:
            continue
        if not lengths and math.dist(line.tip_px, start.tip_px) > SETTLES_WITHIN * start.length_px:
            continue  # a hand that is still coming, or something else
        lines = tracker.search_lines()
        seen = np.isfinite(lines.offset_px)
        edges = (lines.position_px + lines.normal * lines.offset_px[:, None])[seen]
        contrasts.append(_contrast_across(frame, edges, lines.normal[seen]))
        # The anchor is the middle of the measured stretch of the finger.
        lengths.append(2.0 * math.dist(line.anchor_px, line.tip_px))
    if contrasts:
        return HandReadings(True, float(np.median(contrasts)), float(np.median(lengths)))
    there = max(_contrast_at_start(frame, start) for frame in (frames[0], frames[-1]))
    return HandReadings(False, there, start.length_px)


def judge_hand(
    view: str, readings: HandReadings, start: Start, size_px: tuple[int, int], frames: int
) -> Iterator[Finding]:
    """Find problems of hand and start pose."""
    width, height = size_px
    u, v = start.tip_px
    if not (0.0 <= u <= width - 1 and 0.0 <= v <= height - 1):
        yield Finding(
            Severity.ERROR,
            Check.HAND,
            view,
            f"start.tip_px ({u:g}, {v:g}) is outside the image of {width} × {height} px",
            "the template must wait where the hand can be seen",
        )
    faint = f"{CONTRAST[0]:.0f} or more is right: a table of another brightness, or other light"
    if readings.found:
        if readings.contrast < CONTRAST[0]:
            yield Finding(
                Severity.WARNING if readings.contrast >= CONTRAST[1] else Severity.ERROR,
                Check.CONTRAST,
                view,
                f"the finger stands out by {readings.contrast:.0f} grey levels",
                faint,
            )
    elif NOTHING < readings.contrast < CONTRAST[1]:
        yield Finding(
            Severity.ERROR,
            Check.CONTRAST,
            view,
            f"no hand is found in {frames} frames; if one waits at [view.start], it stands out by "
            f"{readings.contrast:.0f} grey levels",
            faint,
        )
    else:
        yield Finding(
            Severity.ERROR,
            Check.HAND,
            view,
            f"no hand is found at [view.start] in {frames} frames",
            "hold the hand where the template waits, or correct tip_px, angle_deg and length_px; "
            "if it comes later, look at more frames",
        )
    if readings.finger_px < FINGER_PX[0]:
        yield Finding(
            Severity.ERROR if readings.finger_px < FINGER_PX[1] else Severity.WARNING,
            Check.HAND,
            view,
            f"the finger is {readings.finger_px:.0f} px long",
            f"{FINGER_PX[0]:.0f} px or more is right: zoom in, come closer, or more pixels",
        )
    if readings.finger_px > LARGEST_FINGER_SHARE * min(size_px):
        yield Finding(
            Severity.WARNING,
            Check.HAND,
            view,
            f"the finger is {readings.finger_px:.0f} px long in an image of {width} × {height} px",
            "a hand that fills the image leaves it: zoom out or step back",
        )


def _contrast_across(frame: Frame, edges_px: Array, normals: Array) -> float:
    """Median step across edges (N, 2) of a contour with outward normals (N, 2)."""
    inside, outside = (
        _levels(frame, edges_px[:, None] + side * normals[:, None] * _BESIDE_PX[:, None]).mean(
            axis=1
        )
        for side in (-1.0, 1.0)
    )
    return float(np.median(np.abs(inside - outside))) if len(edges_px) else 0.0


def _contrast_at_start(frame: Frame, start: Start) -> float:
    """Contrast of the strip of the expected finger against the strips on both its sides."""
    angle = math.radians(start.angle_deg)
    along = np.array([math.cos(angle), math.sin(angle)])
    across = np.array([-along[1], along[0]])
    axis = np.array(start.tip_px) - start.length_px * _ALONG[:, None] * along
    width = _FINGER_WIDTH * start.length_px

    def strip(places: Array) -> Array:
        return _levels(frame, axis[:, None] + width * places[:, None] * across)

    inside = float(np.median(strip(_INSIDE)))
    beside = [float(np.median(strip(side * _OUTSIDE))) for side in (-1.0, 1.0)]
    return min(abs(inside - level) for level in beside)


def _levels(frame: Frame, places_px: Array) -> Array:
    """Grey levels at pixels (..., 2), bilinear; beyond the border, those of the border."""
    import cv2

    u, v = np.moveaxis(places_px.reshape(-1, 1, 2).astype(np.float32), -1, 0)
    grey = frame.grey().astype(np.float32)
    levels = cv2.remap(grey, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(levels, dtype=np.float64).reshape(places_px.shape[:-1])
