"""Long straight edges of a picture: segments, and lines through several of them.

Segments are detected by OpenCV (LSD: Grompone von Gioi et al. 2010) in grey levels, in
high-pass-filtered and amplified grey levels, for edges such as that of white paper on a white desk,
and in colour differences. A line has a direction, given by its darker side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

MOST_LINES = 60
DIRECTIONS = 12
MOST_A_DIRECTION = 24
"""Greatest number of lines, number of direction bins in the half circle, and greatest number of
lines per bin; the strongest are kept. Wood has hundreds along its grain: without bins, 22 of 40
half-covered sheets on it are found instead of 36."""

LEAST_PART = 0.015
"""Least length of a segment, relative to the picture's diagonal."""

MOST_SEGMENTS = 1200

COLLINEAR_PX = 2.0
COLLINEAR_RAD = 0.06
"""Greatest distance of a segment's ends from its line, and greatest angle between both."""

GAIN = 4.0
AROUND_PX = 15.0
"""Amplification of faint edges, and sigma of the mean that is subtracted."""

COLOUR_GAIN = 2.0

LIGHT = np.array([1.0, 0.6, 0.3])
"""Weights of L, a and b that decide which of two colours is the lighter one: mostly L."""

BESIDE_PX = 3.0
"""Distance from a segment at which the levels of its two sides are sampled."""


@dataclass(frozen=True, eq=False)
class Line:
    """A straight edge.

    Attributes
    ----------
    point
        (2,) A point of the line [px].
    along
        (2,) Its direction; rotated by 90° from u to v, it points to the brighter side.
    intervals
        (M, 2) Visible parts: start and end as distances from the point [px]; disjoint, sorted.
    """

    point: Array
    along: Array
    intervals: Array
    contrast: float

    @property
    def length_px(self) -> float:
        """Visible length [px]."""
        return float((self.intervals[:, 1] - self.intervals[:, 0]).sum())

    @property
    def plainness(self) -> float:
        """Strength: greater for a long line of high contrast."""
        return self.length_px * float(np.sqrt(self.contrast))


def find_lines(picture: Picture) -> list[Line]:
    """Return the strongest straight edges of a picture (H, W) or (H, W, 3), strongest first."""
    segments = np.concatenate([_segments(channel) for channel in _channels(picture)])
    lengths = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    least_px = LEAST_PART * float(np.hypot(*picture.shape[:2]))
    order = np.argsort(-lengths, kind="stable")[:MOST_SEGMENTS]
    segments = segments[order[lengths[order] >= least_px]]
    if len(segments) == 0:
        return []
    here, there = _sides(_lab(picture), segments)
    darkens = (here - there) @ LIGHT < 0.0
    segments[darkens] = segments[darkens, ::-1]
    lines = _merged(segments, np.linalg.norm(here - there, axis=1))
    counts = np.zeros(DIRECTIONS, int)
    kept = []
    for line in sorted(lines, key=lambda line: -line.plainness):
        angle = np.arctan2(line.along[1], line.along[0]) % np.pi
        direction = int(angle / np.pi * DIRECTIONS) % DIRECTIONS
        counts[direction] += 1
        if counts[direction] <= MOST_A_DIRECTION:
            kept.append(line)
    return kept[:MOST_LINES]


def _channels(picture: Picture) -> list[Picture]:
    """Return the images in which edges are detected."""
    import cv2

    grey = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.2).astype(np.float32)
    faint = smooth - cv2.GaussianBlur(smooth, (0, 0), AROUND_PX)
    channels = [grey, np.clip(128.0 + GAIN * faint, 0, 255).astype(np.uint8)]
    if picture.ndim == 3:
        lab = cv2.GaussianBlur(_lab(picture)[..., 1:].astype(np.float32), (0, 0), 1.2)
        strong = np.clip(128.0 + COLOUR_GAIN * (lab - 128.0), 0, 255).astype(np.uint8)
        channels += [strong[..., 0].copy(), strong[..., 1].copy()]
    return channels


def _segments(channel: Picture) -> Array:
    """Detect segments (N, 2, 2), given by start and end."""
    import cv2

    found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(channel)[0]
    if found is None:
        return np.empty((0, 2, 2))
    return np.asarray(found, np.float64).reshape(-1, 2, 2)


def _sides(picture: Picture, segments: Array) -> list[Array]:
    """Return levels (N, C) at the middle of segments, on the side of the normal and the other."""
    import cv2

    middle, along = segments.mean(axis=1), segments[:, 1] - segments[:, 0]
    along = along / (np.linalg.norm(along, axis=1)[:, None] + np.finfo(float).tiny)
    off = BESIDE_PX * np.stack([-along[:, 1], along[:, 0]], axis=1)
    u, v = np.moveaxis(np.stack([middle + off, middle - off]).astype(np.float32), -1, 0)
    border = cv2.BORDER_REPLICATE
    levels = cv2.remap(picture, u.copy(), v.copy(), cv2.INTER_LINEAR, borderMode=border)
    return list(np.asarray(levels, np.float64).reshape(2, len(segments), -1))


def _lab(picture: Picture) -> Picture:
    """Return lightness and two colour differences, (H, W, 3)."""
    import cv2

    if picture.ndim == 2:
        return np.stack([picture, np.full_like(picture, 128), np.full_like(picture, 128)], axis=2)
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2LAB), np.uint8)


def _merged(segments: Array, contrasts: Array) -> list[Line]:
    """Merge segments that lie on one line, beginning with the longest."""
    along = segments[:, 1] - segments[:, 0]
    lengths = np.linalg.norm(along, axis=1)
    angles = np.arctan2(along[:, 1], along[:, 0])
    is_free = np.ones(len(segments), np.bool_)
    lines = []
    for k in range(len(segments)):
        if not is_free[k]:
            continue
        free = np.flatnonzero(is_free)
        members = np.array([k])
        for _ in range(3):
            point, direction = _through(segments[members], lengths[members])
            normal = np.array([-direction[1], direction[0]])
            off_px = np.abs((segments[free] - point) @ normal).max(axis=1)
            turned = angles[free] - np.arctan2(direction[1], direction[0])
            turned = np.abs((turned + np.pi) % (2.0 * np.pi) - np.pi)
            agrees = (off_px < COLLINEAR_PX) & (turned < COLLINEAR_RAD)
            agrees |= free == k
            before, members = members, free[agrees]
            if np.array_equal(before, members):
                break
        else:
            point, direction = _through(segments[members], lengths[members])
        is_free[members] = False
        spans = np.sort((segments[members] - point) @ direction, axis=1)
        contrast = float(np.median(contrasts[members]))
        lines.append(Line(point, direction, _union(spans), contrast))
    return lines


def _through(segments: Array, lengths: Array) -> tuple[Array, Array]:
    """Fit a line to segments, weighted by length; return its middle and direction."""
    ends = segments.reshape(-1, 2)
    weights = np.repeat(lengths, 2)
    middle = weights @ ends / weights.sum()
    about = ends - middle
    direction = np.linalg.eigh((about * weights[:, None]).T @ about)[1][:, 1]
    along = (segments[:, 1] - segments[:, 0]).sum(axis=0)
    return middle, direction * (1.0 if direction @ along >= 0.0 else -1.0)


def _union(spans: Array) -> Array:
    """Merge overlapping intervals (N, 2); return them sorted."""
    joined: list[list[float]] = []
    for begin, end in spans[np.argsort(spans[:, 0], kind="stable")].tolist():
        if joined and begin <= joined[-1][1]:
            joined[-1][1] = max(joined[-1][1], end)
        else:
            joined.append([begin, end])
    return np.array(joined)
