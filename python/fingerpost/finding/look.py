"""What the pixels about a finger tell.

Whether it lies in the plane, has a hand behind it, and is outlined on both sides.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fingerpost._core import FingerLine
from fingerpost.capture import Frame
from fingerpost.finding.finger import Array, Sighting
from fingerpost.pointing import PlaneView

NOISE_GREY = 4.0
"""Grey levels that are noise when two pictures are compared."""

ALIKE_IN_PLANE = (0.4, 0.7)
"""How far the contrasts along a finger's outline, each flank and the end for itself, are those that
another view shows at the same place of the plane, from where it begins to look flat, and from
where it is: a print, a pen, a shadow."""


def flatness(
    views: tuple[PlaneView, PlaneView],
    greys: tuple[NDArray[np.uint8], NDArray[np.uint8]],
    fingers: Sequence[Sighting],
) -> Array:
    """Tell which fingers of the first view lie in the plane, by what the second shows there.

    Parameters
    ----------
    views
        How the two views see the plane.
    greys
        What they see.
    fingers
        N fingers of the first view.

    Returns
    -------
    (N,)
        0 for what stands above the plane or is not seen by the second view, 1 for what looks the
        same in both after the map from one to the other through the plane.
    """
    flat = np.zeros(len(fingers))
    for k, finger in enumerate(fingers):
        e = np.array([np.cos(finger.angle_rad), np.sin(finger.angle_rad)])
        n = np.array([-e[1], e[0]])
        # From the tip, in half-widths: inside and outside of left flank, right flank and end.
        places = _OUTLINE[..., :1] * e + _OUTLINE[..., 1:] * n
        here = np.array(finger.tip_px) + finger.half_width_px * places
        a, b = _contrasts(greys[0], here), _contrasts(greys[1], _seen_by_second(views, here))
        if np.isnan(a).any() or np.isnan(b).any():
            continue
        alike = (a * b).sum(axis=-1) / (np.maximum(a**2, b**2).sum(axis=-1) + NOISE_GREY**2)
        low, high = ALIKE_IN_PLANE
        flat[k] = min(max((alike.min() - low) / (high - low), 0.0), 1.0)
    return flat


def _seen_by_second(views: tuple[PlaneView, PlaneView], places_px: Array) -> Array:
    """Return where the second view shows what the first shows of the plane, NaN for what is not."""
    on_plane = views[0].back_project(places_px)
    is_seen = np.isfinite(on_plane).all(axis=-1, keepdims=True)
    return np.where(is_seen, views[1].project(np.where(is_seen, on_plane, 0.0)), np.nan)


def _contrasts(grey: NDArray[np.uint8], places_px: Array) -> Array:
    """Return how far what is inside of an outline differs from what is outside."""
    inside, outside = _shown(grey, places_px)
    return np.asarray(inside - outside)


def _outline() -> Array:
    """Return (2, 3, 8, 2) places inside and outside of the three parts of a finger's outline."""
    back = -np.linspace(0.9, 4.0, 8)
    turn = np.linspace(-0.9, 0.9, 8)
    inside_outside = []
    for reach in (0.55, 1.5):
        flanks = [np.stack([back, np.full(8, side * reach)], axis=-1) for side in (-1.0, 1.0)]
        end = np.stack([reach * np.cos(turn) - 1.0, reach * np.sin(turn)], axis=-1)
        inside_outside.append([*flanks, end])
    return np.array(inside_outside)


_OUTLINE = _outline()

WIDENS = (4.5, 13.0)
"""How far behind its tip a finger may widen to its hand [half-widths]; foreshortened, sooner."""

INSIDE_SEEN = 20
"""Pixels of a finger that tell its colours."""

ALIKE = {1: 6.6, 3: 11.3}
"""Squared distances from these colours, in standard deviations, below which 99 % of what is of one
colour lies: a grey level and three channels."""


def widening(frame: Frame, line: FingerLine, half_width_px: float) -> float:
    """Tell how far a finger widens behind, as it does to a hand and a pen does not.

    Parameters
    ----------
    frame
        What shows it: its colours, if it has any.
    line, half_width_px
        The finger's axis, and half its width [px].

    Returns
    -------
    float
        The part of what lies behind it and beside its flanks, on the better side, that looks like
        the finger, 0 to 1: an index finger is at the edge of its hand.
    """
    finger = frame, line, half_width_px
    inside = inside_levels(*finger)
    if inside is None:
        return 0.0
    channels = inside.shape[1]
    covariance = np.atleast_2d(np.cov(inside, rowvar=False)) + NOISE_GREY**2 * np.eye(channels)
    rows = -np.linspace(*WIDENS, 12)
    alike = []
    for across in ((-0.6, 0.6), (-3.2, -1.7), (1.7, 3.2)):
        differs = _levels(*finger, rows, np.linspace(*across, 4)) - inside.mean(axis=0)
        square = (differs @ np.linalg.inv(covariance) * differs).sum(axis=-1)
        # NaN, outside of the picture, is not alike.
        part = (square < ALIKE[channels]).mean(axis=1)
        alike.append(np.convolve(part, np.full(4, 0.25), mode="valid"))
    behind, left, right = alike
    return float(np.minimum(behind, np.maximum(left, right)).max())


def inside_levels(frame: Frame, line: FingerLine, half_width_px: float) -> Array | None:
    """Return the levels (N, channels) of a finger's inside; None if hardly any of it is seen."""
    inside = _levels(
        frame, line, half_width_px, -np.linspace(1.0, 4.0, 12), np.linspace(-0.5, 0.5, 5)
    )
    inside = inside.reshape(-1, inside.shape[2])
    inside = inside[np.isfinite(inside).all(axis=1)]
    return None if len(inside) < INSIDE_SEEN else inside


ALONG = -np.linspace(1.2, 5.0, 9)
ACROSS = np.linspace(-0.65, 0.65, 11)
INSIDE, OUTSIDE = ACROSS < -0.33, ACROSS > 0.33
"""Where the flanks are looked at: behind the tip, and across the flank [half-widths]."""

FLANK_SEEN = 7
"""Rows of a flank that tell how soft it is."""


def softness(frame: Frame, line: FingerLine, half_width_px: float) -> float:
    """Tell how much softer the one flank of a finger is than the other.

    An outline is as sharp as the picture. A flank that shades off, before a table as bright as
    where it is lit, or where a soft shadow ends, is none; blur by motion or by the lens softens
    both flanks.

    Parameters
    ----------
    frame
        What shows it: its colours, if it has any.
    line, half_width_px
        The finger's axis, and half its width [px].

    Returns
    -------
    float
        Difference of the variances of the two flanks, each taken for a blurred step, positive if
        that on the side of the normal (−sin, cos) is the softer [half-widths²]. A flank is looked
        at to 0.65 half-widths on either side: softer ones than 0.15 seem less soft than they are,
        and none softer than about 0.35. NaN where either hardly shows.
    """
    one, other = (
        _variance(_levels(frame, line, half_width_px, ALONG, side * (1.0 + ACROSS)))
        for side in (1.0, -1.0)
    )
    return one - other


def _variance(levels: Array) -> float:
    """Return the variance of the step that rows of levels (rows, across, channels) show.

    Rows count by the square of their contrast: so much the mean of their profiles, each in parts of
    its own contrast, owes to them.
    """
    levels = levels[np.isfinite(levels).all(axis=(1, 2))]
    behind = levels[:, OUTSIDE].mean(axis=1)
    contrast = levels[:, INSIDE].mean(axis=1) - behind
    weight = float(np.square(contrast).sum())
    if len(levels) < FLANK_SEEN or weight < len(levels) * NOISE_GREY**2:
        return np.nan
    # Less what is behind, which is the same all across.
    profile = np.einsum("rac,rc->a", levels, contrast) / weight
    fall = np.maximum(-np.diff(profile), 0.0)
    at = 0.5 * (ACROSS[1:] + ACROSS[:-1])
    mean = (fall * at).sum() / fall.sum()
    return float((fall * np.square(at - mean)).sum() / fall.sum())


def _levels(
    frame: Frame, line: FingerLine, half_width_px: float, along: Array, across: Array
) -> Array:
    """Return the levels about a finger, its colours if it has any: (along, across, channels).

    `along` is the way from the tip in the finger's direction, `across` that to its normal's side
    [half-widths]; NaN outside the picture.
    """
    colours = frame.colour()
    image = frame.grey() if colours is None else colours
    e = np.array([np.cos(line.angle_rad), np.sin(line.angle_rad)])
    n = np.array([-e[1], e[0]])
    places = along[:, None, None] * e + across[:, None] * n
    levels = _shown(image, line.tip_px + half_width_px * places)
    return levels.reshape(len(along), len(across), -1)


def _shown(image: NDArray[np.uint8], places: Array) -> Array:
    """Return the levels of the nearest pixels, NaN outside the picture."""
    x, y = np.moveaxis(np.rint(places), -1, 0)
    inside = (x >= 0) & (y >= 0) & (x < image.shape[1]) & (y < image.shape[0])
    rows, columns = (np.where(inside, c, 0.0).astype(int) for c in (y, x))
    levels = np.asarray(image[rows, columns], dtype=float)
    levels[~inside] = np.nan
    return levels
