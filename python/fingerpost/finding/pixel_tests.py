"""Tests on the pixels about a finger.

They measure whether it lies in the plane, widens to a hand behind it, and has flanks of equal blur.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fingerpost._core import FingerLine
from fingerpost.capture import Frame
from fingerpost.finding.finger import Array, FingerDetection, places_about
from fingerpost.finding.foreground import AHEAD, BESIDE_AXIS
from fingerpost.pointing import PlaneView

NOISE_GREY = 4.0
"""Standard deviation of the noise where two images are compared [grey levels]."""

FLAT_SIMILARITY_RANGE = (0.4, 0.7)
"""Similarity of the contrasts along each flank and the end of a finger's outline to those at the
same points of the plane in another view, at which flatness is 0, and at which it is 1, as of a
print, a pen or a shadow."""


def flatness(
    views: tuple[PlaneView, PlaneView],
    greys: tuple[NDArray[np.uint8], NDArray[np.uint8]],
    fingers: Sequence[FingerDetection],
) -> Array:
    """Measure whether fingers of the first view lie in the plane, by the second view.

    Parameters
    ----------
    views
        Homographies of the two views.
    greys
        Their images.
    fingers
        N fingers of the first view.

    Returns
    -------
    (N,)
        Flatness: 0 for a finger above the plane or outside the second view, 1 for one whose image
        is the same in both views under the homography between them through the plane.
    """
    if not fingers:
        return np.zeros(0)
    e = np.array([(np.cos(finger.angle_rad), np.sin(finger.angle_rad)) for finger in fingers])
    e = e[:, None, None, None]
    n = np.stack([-e[..., 1], e[..., 0]], axis=-1)
    tips = np.array([finger.tip_px for finger in fingers])[:, None, None, None]
    half_widths = np.array([finger.half_width_px for finger in fingers])[:, None, None, None, None]
    # From the tip, in half-widths: inside and outside of left flank, right flank and end.
    here = tips + half_widths * (_OUTLINE[..., :1] * e + _OUTLINE[..., 1:] * n)
    a, b = _contrasts(greys[0], here), _contrasts(greys[1], _seen_by_second(views, here))
    similarity = (a * b).sum(axis=-1) / (np.maximum(a**2, b**2).sum(axis=-1) + NOISE_GREY**2)
    low, high = FLAT_SIMILARITY_RANGE
    flat = np.clip((similarity.min(axis=-1) - low) / (high - low), 0.0, 1.0)
    flat[np.isnan(flat)] = 0.0  # outside either image
    return np.asarray(flat)


def _seen_by_second(views: tuple[PlaneView, PlaneView], places_px: Array) -> Array:
    """Transfer points of the first view through the plane to the second; NaN beyond the horizon."""
    on_plane = views[0].back_project(places_px)
    is_seen = np.isfinite(on_plane).all(axis=-1, keepdims=True)
    return np.where(is_seen, views[1].project(np.where(is_seen, on_plane, 0.0)), np.nan)


def _contrasts(grey: NDArray[np.uint8], places_px: Array) -> Array:
    """Return the grey levels inside outlines (N, 2, 3, 8, 2) less those outside, (N, 3, 8)."""
    shown = _shown(grey, places_px)
    return np.asarray(shown[:, 0] - shown[:, 1])


def _outline() -> Array:
    """Return (2, 3, 8, 2) points inside and outside the three parts of a finger's outline."""
    back = -np.linspace(0.9, 4.0, 8)
    turn = np.linspace(-0.9, 0.9, 8)
    inside_outside = []
    for reach in (0.55, 1.5):
        flanks = [np.stack([back, np.full(8, side * reach)], axis=-1) for side in (-1.0, 1.0)]
        end = np.stack([reach * np.cos(turn) - 1.0, reach * np.sin(turn)], axis=-1)
        inside_outside.append([*flanks, end])
    return np.array(inside_outside)


_OUTLINE = _outline()

HAND_RANGE_HALF_WIDTHS = (4.5, 13.0)
"""Range behind the tip in which a finger may widen to its hand [half-widths]; the near end is for
a foreshortened one."""

BEHIND = -np.linspace(*HAND_RANGE_HALF_WIDTHS, 12)
BEHIND_ACROSS = [np.linspace(*across, 4) for across in ((-0.6, 0.6), (-3.2, -1.7), (1.7, 3.2))]
"""Sample positions there, along the axis, and across it: behind the finger, and beside its flanks
[half-widths]."""

INSIDE_ALONG, INSIDE_ACROSS = -np.linspace(1.0, 4.0, 12), np.linspace(-0.5, 0.5, 5)
"""Sample positions inside a finger [half-widths]."""

MIN_INSIDE_PIXELS = 20
"""Least number of pixels from which a finger's colour is measured."""

MAX_COLOUR_DISTANCE_SQUARED = {1: 6.6, 3: 11.3}
"""99 % quantiles of χ² by number of channels: greatest squared Mahalanobis distance of a pixel of
the finger's colour."""


def widening(frame: Frame, line: FingerLine, half_width_px: float) -> float:
    """Measure how far a finger widens behind, as to a hand; a pen does not.

    Parameters
    ----------
    frame
        The frame; its colours are used if it has any.
    line, half_width_px
        The finger's axis, and half its width [px].

    Returns
    -------
    float
        Part of the pixels behind the finger and beside its flanks, on the better side, that have
        the finger's colour, 0 to 1. One side suffices: an index finger is at the edge of its hand.
    """
    finger = frame, line, half_width_px
    inside = inside_levels(*finger)
    if inside is None:
        return 0.0
    channels = inside.shape[1]
    covariance = np.atleast_2d(np.cov(inside, rowvar=False)) + NOISE_GREY**2 * np.eye(channels)
    parts = []
    for across in BEHIND_ACROSS:
        differs = _levels(*finger, BEHIND, across) - inside.mean(axis=0)
        square = (differs @ np.linalg.inv(covariance) * differs).sum(axis=-1)
        # A comparison with NaN, outside the image, is False.
        part = (square < MAX_COLOUR_DISTANCE_SQUARED[channels]).mean(axis=1)
        parts.append(np.convolve(part, np.full(4, 0.25), mode="valid"))
    behind, left, right = parts
    return float(np.minimum(behind, np.maximum(left, right)).max())


def inside_levels(frame: Frame, line: FingerLine, half_width_px: float) -> Array | None:
    """Return the levels (N, channels) of a finger's inside; None below `MIN_INSIDE_PIXELS`."""
    inside = _levels(frame, line, half_width_px, INSIDE_ALONG, INSIDE_ACROSS)
    inside = inside.reshape(-1, inside.shape[2])
    inside = inside[np.isfinite(inside).all(axis=1)]
    return None if len(inside) < MIN_INSIDE_PIXELS else inside


ALONG = -np.linspace(1.2, 5.0, 9)
ACROSS = np.linspace(-0.65, 0.65, 11)
INSIDE, OUTSIDE = ACROSS < -0.33, ACROSS > 0.33
"""Sample positions of a flank: behind the tip, and across the flank [half-widths]."""

MIN_FLANK_ROWS = 7
"""Least number of rows from which a flank's blur is measured."""


def blur_asymmetry(frame: Frame, line: FingerLine, half_width_px: float) -> float:
    """Measure the difference of the blur of a finger's two flanks.

    An outline is as sharp as the image. A gradual edge, as of shading before a table of equal
    brightness, or of a soft shadow, is not an outline. Blur by motion or the lens is common to both
    flanks.

    Parameters
    ----------
    frame
        The frame; its colours are used if it has any.
    line, half_width_px
        The finger's axis, and half its width [px].

    Returns
    -------
    float
        Variance of the flank on the side of the normal (−sin, cos) less that of the other, each
        modelled as a blurred step [half-widths²]. A flank is sampled to 0.65 half-widths on either
        side: a standard deviation above 0.15 is underestimated, and saturates at about 0.35. NaN
        if either flank has too little contrast.
    """
    one, other = (
        _variance(_levels(frame, line, half_width_px, ALONG, side * (1.0 + ACROSS)))
        for side in (1.0, -1.0)
    )
    return one - other


def _variance(levels: Array) -> float:
    """Return the variance of a blurred step, from rows of levels (rows, across, channels).

    Rows are weighted by the square of their contrast: the least-squares mean of their normalised
    profiles.
    """
    levels = levels[np.isfinite(levels).all(axis=(1, 2))]
    behind = levels[:, OUTSIDE].mean(axis=1)
    contrast = levels[:, INSIDE].mean(axis=1) - behind
    weight = float(np.square(contrast).sum())
    if len(levels) < MIN_FLANK_ROWS or weight < len(levels) * NOISE_GREY**2:
        return np.nan
    # The background level is constant across and cancels in the derivative.
    profile = np.einsum("rac,rc->a", levels, contrast) / weight
    fall = np.maximum(-np.diff(profile), 0.0)
    at = 0.5 * (ACROSS[1:] + ACROSS[:-1])
    mean = (fall * at).sum() / fall.sum()
    return float((fall * np.square(at - mean)).sum() / fall.sum())


STRIPE_ALONG = -np.linspace(1.2, 4.0, 5)
STRIPE_REACH = np.arange(0.0, 6.01, 0.4)
CORE, NEIGHBOUR = STRIPE_REACH < 0.6, (STRIPE_REACH > 1.2) & (STRIPE_REACH < 3.0)
BESIDE, BEYOND = (
    (STRIPE_REACH > 1.4) & (STRIPE_REACH < 2.2),
    (STRIPE_REACH > 1.8) & (STRIPE_REACH < 3.4),
)
"""Sample positions along a band, and from its axis to either side [half-widths]: of its inside, of
the neighbourhood in which its contrast is measured, of what is directly beside it, and of where a
stripe of its own width beside it ends."""

MAX_RETURN = 0.3
"""Greatest distance from the finger's own levels at which they return beside it, as a part of that
of its neighbourhood: 0 to 0.25 in nearly every frame on a striped glove, above 0.4 in 95 % and more
of the frames of fingers on wood, paper and a mat."""

MAX_DIFFERENCE = 0.2
"""Greatest difference of the levels directly beside a stripe on both sides, and least one by which
these bands end, as a part of their contrast to its inside. At the edge of a striped glove 75 % of
the frames have both, with a return on one side; of fingers on wood, paper and a mat, 0.1 %."""


def is_stripe(frame: Frame, line: FingerLine, half_width_px: float) -> bool:
    """Whether a band is a stripe among stripes.

    Its levels return beyond its neighbours on both sides; or on one, as at the edge of a striped
    object, and both neighbours are bands of one level. An index finger has the table on one side
    at least, whatever is on the other.

    Parameters
    ----------
    frame
        The frame; its colours are used if it has any.
    line, half_width_px
        The band's axis, and half its width [px].

    Returns
    -------
    bool
        False as well where the band does not stand out, or the image ends on one side.
    """
    sides = [
        _levels(frame, line, half_width_px, STRIPE_ALONG, side * STRIPE_REACH).mean(axis=0)
        for side in (1.0, -1.0)
    ]
    inside = np.mean([side[CORE].mean(axis=0) for side in sides], axis=0)
    returns = [_returns(np.linalg.norm(side - inside, axis=-1)) for side in sides]
    return all(returns) or (any(returns) and _is_between_equal_bands(sides, inside))


def _is_between_equal_bands(sides: Sequence[Array], inside: Array) -> bool:
    """Whether levels (reach, channels) show a band of the same level on both sides of an inside."""
    beside = [side[BESIDE].mean(axis=0) for side in sides]
    most = MAX_DIFFERENCE * float(np.linalg.norm(np.mean(beside, axis=0) - inside))
    ends = [
        np.linalg.norm(side[BEYOND] - level, axis=-1).max() > most
        for side, level in zip(sides, beside, strict=True)
    ]
    return float(np.linalg.norm(beside[0] - beside[1])) < most and all(ends)


def _returns(differs: Array) -> bool:
    """Whether levels along `STRIPE_REACH` differ from the inside's, and return to them beyond."""
    far = int(np.argmax(np.where(NEIGHBOUR, np.nan_to_num(differs), -1.0)))
    beyond = differs[far + 1 :]
    known = beyond[np.isfinite(beyond)]
    if differs[far] < 2.0 * NOISE_GREY or len(known) == 0:
        return False
    return bool(known.min() < MAX_RETURN * differs[far])


SIDES = np.linspace(1.6, 2.4, 3)
"""Sample positions on either side of a band that continues a finger [half-widths]."""


def contrast_ahead(frame: Frame, line: FingerLine, half_width_px: float) -> float:
    """Return the contrast of a band that continues a finger ahead of its tip.

    A dark nail or the fingertip of a cut glove differs from the table on both of its sides.

    Parameters
    ----------
    frame
        The frame; its colours are used if it has any.
    line, half_width_px
        The finger's axis, and half its width [px].

    Returns
    -------
    float
        Smaller one of the distances between the band's mean level and those of its sides, in
        standard deviations of the levels of the sides; 0 if the band is between them. NaN where the
        image ends.
    """
    band = _levels(frame, line, half_width_px, AHEAD, BESIDE_AXIS)
    sides = [_levels(frame, line, half_width_px, AHEAD, side * SIDES) for side in (1.0, -1.0)]
    one, other = (band.mean(axis=(0, 1)) - side.mean(axis=(0, 1)) for side in sides)
    if one @ other <= 0.0:
        return 0.0
    scatter = np.mean([side.var(axis=(0, 1)).sum() for side in sides])
    contrast = min(np.linalg.norm(one), np.linalg.norm(other))
    return float(contrast / np.sqrt(scatter + NOISE_GREY**2))


def _levels(
    frame: Frame, line: FingerLine, half_width_px: float, along: Array, across: Array
) -> Array:
    """Sample the levels about a finger, in colour if possible: (along, across, channels).

    `along` is the coordinate from the tip in the finger's direction, `across` that along its normal
    [half-widths]; NaN outside the image.
    """
    colours = frame.colour()
    image = frame.grey() if colours is None else colours
    levels = _shown(image, places_about(line, half_width_px, along, across))
    return levels.reshape(len(along), len(across), -1)


def _shown(image: NDArray[np.uint8], places: Array) -> Array:
    """Return the levels of the nearest pixels, NaN outside the image."""
    pixels = np.rint(places)
    x, y = pixels[..., 0], pixels[..., 1]
    inside = (x >= 0) & (y >= 0) & (x < image.shape[1]) & (y < image.shape[0])
    nearest = np.where(inside[..., None], pixels, 0.0).astype(np.intp)
    levels = image[nearest[..., 1], nearest[..., 0]].astype(np.float64)
    levels[~inside] = np.nan
    return levels
