"""Conversion of a sharp picture to that of a sensor: blur, square pixels, noise, 8 bit.

Sharp pictures live on a *fine grid* of `fineness` × `fineness` cells per pixel, each cell holding
the exact mean over its area. Convolved with a sampled Gaussian and averaged over each pixel they
give the picture through a Gaussian point spread function on square pixels: the edge of a half plane
becomes an error function of variance blur² + 1/12 (with the pixel's own shape in the higher
moments), exactly where the half plane ends.
"""

import math
from functools import cache
from statistics import NormalDist
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Picture = NDArray[np.float32]

# Greatest number of cells across a pixel, for any blur.
FINEST = 6
# Truncation of the Gaussian; the omitted part is 6e-7 of it.
KERNEL_SIGMAS = 5.0
# Noise is drawn as 16-bit integers that index a table of normal quantiles: several times faster
# than a normal generator, equally white, and truncated only beyond 4.3 sigma.
QUANTILES = 1 << 16


class Optics:
    """Gaussian blur and square pixels.

    Parameters
    ----------
    blur_px
        Sigma of the Gaussian [px], 0 to 5.
    cells_per_sigma
        Cells of the fine grid per sigma. An edge that runs along the grid is off by at most
        0.0003 px with 3 and by 0.001 px with 2; any other edge by far less.
    """

    def __init__(self, blur_px: float, cells_per_sigma: int) -> None:
        if blur_px == 0:
            self.fineness, radius = 1, 0
        else:
            self.fineness = min(max(math.ceil(cells_per_sigma / blur_px), 2), FINEST)
            radius = math.ceil(KERNEL_SIGMAS * blur_px * self.fineness)
        # Extent of the filter beyond a pixel's own border, in whole pixels.
        self.margin_px = math.ceil(radius / self.fineness)
        reach = self.margin_px * self.fineness
        offset = np.arange(-reach, reach + 1) / self.fineness
        gaussian = np.exp(-0.5 * (offset / blur_px) ** 2) if blur_px else np.ones(1)
        gaussian[np.abs(np.arange(-reach, reach + 1)) > radius] = 0
        # Blur and average over the pixel are one filter, evaluated once per pixel.
        kernel = np.convolve(gaussian / gaussian.sum(), np.full(self.fineness, 1 / self.fineness))
        self._kernel = kernel.astype(np.float32)

    def cells(self, pictured_px: Array) -> Array:
        """Fine-grid coordinates of pixels (..., 2); cell (i, j) is [j, j + 1) × [i, i + 1)."""
        return (pictured_px + (0.5 + self.margin_px)) * self.fineness

    def pixels_of_cells(self, cells: Array) -> Array:
        """Return the inverse of `cells`."""
        return cells / self.fineness - (0.5 + self.margin_px)

    def pixels(self, fine: Picture) -> Picture:
        """Blur a fine picture and average it over pixels.

        Parameters
        ----------
        fine
            ((H + 2·margin_px)·fineness, (W + 2·margin_px)·fineness[, C]).

        Returns
        -------
        numpy.ndarray
            (H, W[, C]).
        """
        step, one = self.fineness, np.ones(1, np.float32)
        height, width = (n // step - 2 * self.margin_px for n in fine.shape[:2])
        # Along columns, only the sums that a pixel needs: cell rows p, p + step, … are multiplied
        # by every step-th tap of the kernel.
        down = np.zeros((height, *fine.shape[1:]), np.float32)
        for phase in range(step):
            taps = self._kernel[phase::step]
            rows = fine[phase::step]
            down += _correlated(rows, one, taps)[:height]
        return np.ascontiguousarray(_correlated(down, self._kernel, one)[:, ::step][:, :width])


def _correlated(picture: Picture, across: Picture, down: Picture) -> Picture:
    """Correlate with a separable kernel whose first tap lies on the pixel itself."""
    border = cv2.BORDER_CONSTANT
    return np.asarray(cv2.sepFilter2D(picture, -1, across, down, anchor=(0, 0), borderType=border))


def sensed(
    light: Picture, noise: float, rng: np.random.Generator | None, *, quantise: bool
) -> NDArray[Any]:
    """Grey levels of a picture with white noise of a given sigma; uint8 if quantised.

    The same draw with −sigma mirrors the noise.
    """
    white = light if rng is None else standard_normal(light.shape, rng)
    sigma = 0.0 if rng is None else noise
    # One pass that adds, rounds and saturates.
    kind = cv2.CV_8U if quantise else cv2.CV_32F
    return np.asarray(cv2.addWeighted(light, 1.0, white, sigma, 0.0, dtype=kind))


def standard_normal(shape: tuple[int, ...], rng: np.random.Generator) -> Picture:
    """White noise of sigma 1."""
    count = math.prod(shape)
    words = rng.integers(0, 2**64 - 1, -(-count // 4), dtype=np.uint64, endpoint=True)
    index = words.astype("<u8", copy=False).view("<u2")[:count]
    # No index is out of bounds; the mode only avoids NumPy's check.
    return _normal_quantiles().take(index, mode="wrap").reshape(shape)


@cache
def _normal_quantiles() -> Picture:
    """QUANTILES equally likely values of a normal distribution, of variance exactly 1."""
    upper = [NormalDist().inv_cdf((i + 0.5) / QUANTILES) for i in range(QUANTILES // 2, QUANTILES)]
    half = np.array(upper)
    half /= math.sqrt(np.mean(half**2))
    return np.concatenate([-half[::-1], half]).astype(np.float32)
