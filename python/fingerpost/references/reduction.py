"""Reduction of pictures by an integer factor, and the transform of their pixel coordinates.

48 million pixels of a table determine its position no better than one million: blur scales with the
picture, and texture exists at every scale. Large pictures are therefore processed at a size at
which time and memory are small compared with those of decoding.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.lens import Lens


@dataclass(frozen=True)
class Reduction:
    """Reduction of a picture by averaging squares of pixels.

    Parameters
    ----------
    factor
        Side of a square [px], an integer from 1.
    """

    factor: int

    @classmethod
    def of(cls, shape: tuple[int, ...], largest_px: int) -> Reduction:
        """Return the least reduction after which no side of a picture (H, W) exceeds a limit."""
        return cls(math.ceil(max(shape[:2]) / largest_px))

    @property
    def whole_from_reduced(self) -> NDArray[np.float64]:
        """(3, 3) Transform from pixels of the reduced picture to those of the full one."""
        factor, shift = float(self.factor), 0.5 * self.factor - 0.5
        return np.array([[factor, 0.0, shift], [0.0, factor, shift], [0.0, 0.0, 1.0]])

    def picture(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Reduce a picture (H, W) or (H, W, 3); incomplete squares at its end are dropped."""
        if self.factor == 1:
            return picture
        import cv2

        height, width = (max(size // self.factor, 1) for size in picture.shape[:2])
        used = picture[: height * self.factor, : width * self.factor]
        return np.asarray(cv2.resize(used, (width, height), interpolation=cv2.INTER_AREA), np.uint8)

    def points(self, points_px: ArrayLike) -> NDArray[np.float64]:
        """Transform points (..., 2) of the full picture to the reduced one [px]."""
        return (np.asarray(points_px, np.float64) + 0.5) / self.factor - 0.5

    def whole(self, reduced_px: ArrayLike) -> NDArray[np.float64]:
        """Transform points (..., 2) of the reduced picture to the full one [px]."""
        return (np.asarray(reduced_px, np.float64) + 0.5) * self.factor - 0.5

    def lens(self, lens: Lens | None) -> Lens | None:
        """Return the lens in pixels of the reduced picture, from one of the full picture."""
        if lens is None:
            return None
        cx, cy = self.points((lens.cx, lens.cy)).tolist()
        return dataclasses.replace(
            lens, fx=lens.fx / self.factor, fy=lens.fy / self.factor, cx=cx, cy=cy
        )

    def whole_lens(self, lens: Lens) -> Lens:
        """Return the lens in pixels of the full picture, from one of the reduced picture."""
        cx, cy = self.whole((lens.cx, lens.cy)).tolist()
        return dataclasses.replace(
            lens, fx=lens.fx * self.factor, fy=lens.fy * self.factor, cx=cx, cy=cy
        )
