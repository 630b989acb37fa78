"""Exposure, noise and focus of a view's pictures.

Everything is measured in the region of the hand: between the reference points, within the image.

- **Noise** from the differences of successive frames, whose median is insensitive to motion in less
  than half of the region; if frames are repeated or frozen by compression, from the second
  differences of one frame (Immerkær 1996, with the median in place of the mean).
- **Blur** from the steepest edges: a step of height A blurred by a Gaussian of σ rises at most
  ``A / (√(2π) σ)`` per pixel. The sharper quarter is used, as soft edges may be soft in the scene.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerpost.doctor.findings import Check, Finding, Severity

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

# A colour that is nearly white saturates one channel long before the luma.
CLIPPED_LEVEL = 253
"""Grey levels from here up count as clipped."""

CLIPPED_SHARE = (0.25, 0.7)
"""Above the first share parts of a hand may be invisible, above the second nearly all of it."""

DARK_LEVEL = (40.0, 12.0)
"""95th percentile of the grey levels: below the first, noise and quantisation are large relative to
any contrast; below the second no hand was found on the simulated rig."""

NOISE = (8.0, 50.0)
"""Standard deviation of the noise [grey levels]: an error of 1 mm at 2 levels is one of 4 mm at 8;
at 60, hands of contrast 80 were not found on the simulated rig, at 45 they were."""

BLUR_PX = (2.5, math.inf)
"""Standard deviation of the blur [px]: beyond, the flanks of a finger of 15 px merge. That reduces
accuracy; the tracker still follows at 5."""

_NOISE_PER_MAD = 1.4826
_LAPLACIAN_GAIN = 6.0
_FEWEST_PIXELS = 400
# Number of frames used: differences between neighbours, edges in each.
_LOOKED_AT = 5
_STEEPEST = 3000
_FLAT = 1e-3
_PROFILE_PX = np.arange(-10.0, 10.01, 0.5)
# Smoothing of profiles, for which the result is corrected: noise would steepen any edge.
_SMOOTHING_PX = 1.5
_FEWEST_EDGES = 100
_SHARPER_QUARTER = 25.0
# Least step of an edge, in standard deviations of the noise and in grey levels.
_EDGE_IN_NOISE, _EDGE_LEVELS = 8.0, 12.0


@dataclass(frozen=True, slots=True)
class PictureReadings:
    """See `fingerpost.doctor.findings.ViewReadings`."""

    grey_percentiles: tuple[float, float, float]
    clipped: float
    noise: float
    blur_px: float | None


def read_pictures(frames: Sequence[Grey], region: NDArray[np.bool_]) -> PictureReadings:
    """Measure pictures.

    Parameters
    ----------
    frames
        At least one; (height, width) of uint8.
    region : (height, width)
        Mask of the region of interest.
    """
    looked_at = [frames[k] for k in _spread(len(frames), _LOOKED_AT)]
    levels = np.concatenate([frame[region] for frame in looked_at])
    low, middle, high = np.percentile(levels, (1, 50, 95)).tolist()
    noise = _noise(frames, region)
    return PictureReadings(
        grey_percentiles=(low, middle, high),
        clipped=float(np.mean(levels >= CLIPPED_LEVEL)),
        noise=noise,
        blur_px=_blur_px(looked_at, region, noise),
    )


def judge_pictures(view: str, readings: PictureReadings) -> Iterator[Finding]:
    """Find problems of the pictures."""
    severity = _above(readings.clipped, CLIPPED_SHARE)
    if severity is not None:
        yield Finding(
            severity,
            Check.EXPOSURE,
            view,
            f"{readings.clipped:.0%} of the picture between the reference points is clipped white",
            f"at most {CLIPPED_SHARE[0]:.0%} is right: expose less, or dim the light",
        )
    brightest = readings.grey_percentiles[2]
    severity = _above(-brightest, (-DARK_LEVEL[0], -DARK_LEVEL[1]))
    if severity is not None:
        yield Finding(
            severity,
            Check.EXPOSURE,
            view,
            f"the picture is dark: 95 % of it is below grey level {brightest:.0f}",
            f"{DARK_LEVEL[0]:.0f} or more is right: more light, or a longer exposure",
        )
    severity = _above(readings.noise, NOISE)
    if severity is not None:
        yield Finding(
            severity,
            Check.NOISE,
            view,
            f"the noise is {readings.noise:.1f} grey levels",
            f"at most {NOISE[0]:.0f} is right: more light and less gain",
        )
    if readings.blur_px is not None:
        severity = _above(readings.blur_px, BLUR_PX)
        if severity is not None:
            yield Finding(
                severity,
                Check.FOCUS,
                view,
                f"even the sharper edges are blurred by {readings.blur_px:.1f} px",
                f"at most {BLUR_PX[0]:g} px is right: focus on the plane, clean the lens",
            )


def region_between(points_px: Array, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the mask of the region between points (N, 2); the whole image if that is tiny.

    Parameters
    ----------
    shape
        Height and width.
    """
    import cv2

    mask = np.zeros(shape, np.uint8)
    # Points far outside would overflow OpenCV's integers.
    limit = 16.0 * max(shape)
    hull = cv2.convexHull(np.clip(points_px, -limit, limit).astype(np.float32))
    cv2.fillConvexPoly(mask, np.round(hull).astype(np.int32), 1)
    region = mask.astype(bool)
    return region if region.sum() >= _FEWEST_PIXELS else np.ones(shape, dtype=bool)


def _above(value: float, limits: tuple[float, float]) -> Severity | None:
    """Return the severity of a value that should be below the first limit, or None."""
    if value <= limits[0]:
        return None
    return Severity.ERROR if value > limits[1] else Severity.WARNING


def _spread(count: int, wanted: int) -> list[int]:
    """Return indices evenly from the first to the last, at most the wanted number."""
    return sorted({round(k) for k in np.linspace(0, count - 1, min(count, wanted)).tolist()})


def _noise(frames: Sequence[Grey], region: NDArray[np.bool_]) -> float:
    changes = (
        [
            later[region].astype(np.int16) - earlier[region].astype(np.int16)
            for earlier, later in (
                (frames[k], frames[k + 1]) for k in _spread(len(frames) - 1, _LOOKED_AT)
            )
        ]
        if len(frames) > 1
        else []
    )
    between = _spread_of(np.concatenate(changes)) / math.sqrt(2.0) if changes else 0.0
    return between if between > 0.0 else _noise_within(frames[0], region)


def _noise_within(frame: Grey, region: NDArray[np.bool_]) -> float:
    import cv2

    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    second = cv2.filter2D(frame.astype(np.float32), -1, kernel)
    return _spread_of(np.asarray(second)[region]) / _LAPLACIAN_GAIN


def _spread_of(values: NDArray[np.generic]) -> float:
    """Robust standard deviation about 0, with the median interpolated between integer levels."""
    size = np.abs(values.astype(np.float64))
    median = float(np.median(size))
    below, at = float(np.mean(size < median)), float(np.mean(size == median))
    if median == 0.0:
        # More than half are equal: the noise is below the rounding.
        return 0.0 if at > 0.9 else _NOISE_PER_MAD * 0.5 * (0.5 / at)
    return _NOISE_PER_MAD * (median - 0.5 + (0.5 - below) / at)


def _blur_px(frames: Sequence[Grey], region: NDArray[np.bool_], noise: float) -> float | None:
    """Blur of the sharper edges; None with too few edges."""
    each = np.concatenate([_edge_blurs_px(frame, region, noise) for frame in frames])
    if len(each) < _FEWEST_EDGES:
        return None
    return float(np.percentile(each, _SHARPER_QUARTER))


def _edge_blurs_px(frame: Grey, region: NDArray[np.bool_], noise: float) -> Array:
    import cv2

    picture = frame.astype(np.float32)
    # Light smoothing keeps the direction across an edge from being that of the noise.
    smooth = cv2.GaussianBlur(picture, (0, 0), 1.5)
    gradient = np.stack(
        [cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)], axis=-1
    )
    steepness = np.hypot(gradient[..., 0], gradient[..., 1])
    within = steepness[region]
    first = max(within.size - _STEEPEST, 0)
    least = max(float(np.partition(within, first)[first]), _FLAT)
    row, column = np.nonzero(region & (steepness >= least))
    if not len(row):
        return np.empty(0)
    across = gradient[row, column] / steepness[row, column, None]
    place = np.stack([column, row], axis=-1)[:, None] + across[:, None] * _PROFILE_PX[:, None]
    place = place.astype(np.float32)
    # Averaged over a few pixels along the edge, which does not blur it.
    along = np.stack([-across[:, 1], across[:, 0]], axis=-1)[:, None].astype(np.float32)
    profile = np.mean(
        [
            cv2.remap(
                picture,
                np.ascontiguousarray((place + shift * along)[..., 0]),
                np.ascontiguousarray((place + shift * along)[..., 1]),
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )
            for shift in (-1.0, 0.0, 1.0)
        ],
        axis=0,
    )
    step = float(_PROFILE_PX[1] - _PROFILE_PX[0])
    smoothed = cv2.GaussianBlur(
        profile.astype(np.float32), (0, 0), _SMOOTHING_PX / step, sigmaY=1e-3
    )
    rise = np.diff(np.asarray(smoothed), axis=1) / step
    height, top = np.ptp(profile, axis=1), rise.max(axis=1)
    centred = np.abs(_PROFILE_PX[:-1] + step / 2)[rise.argmax(axis=1)] <= 1.0
    edge = centred & (height > max(_EDGE_IN_NOISE * noise, _EDGE_LEVELS)) & (top > 0.0)
    squared = (height[edge] / top[edge]) ** 2 / (2.0 * math.pi) - _SMOOTHING_PX**2
    return np.asarray(np.sqrt(np.maximum(squared, 0.0)), dtype=np.float64)
