"""Pictures reduced by a whole factor, and what that does to their pixels.

A table seen by 48 million pixels shows no more of where it is than by one million: what blurs a
picture grows with it, and texture is found at every scale. So large pictures are worked on at a
size at which time and memory are small beside those of decoding them.
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
    """A picture whose pixels are means of squares of another one's.

    Parameters
    ----------
    factor
        The side of such a square [px], a whole number from 1.
    """

    factor: int

    @classmethod
    def of(cls, shape: tuple[int, ...], largest_px: int) -> Reduction:
        """Return the least one by which no side of a picture (H, W) is longer than a limit [px]."""
        return cls(math.ceil(max(shape[:2]) / largest_px))

    @property
    def whole_from_reduced(self) -> NDArray[np.float64]:
        """(3, 3) What takes pixels of the reduced picture to the whole one's."""
        factor, shift = float(self.factor), 0.5 * self.factor - 0.5
        return np.array([[factor, 0.0, shift], [0.0, factor, shift], [0.0, 0.0, 1.0]])

    def picture(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Reduce a picture (H, W) or (H, W, 3); rows and columns that are left over fall away."""
        if self.factor == 1:
            return picture
        import cv2

        height, width = (max(size // self.factor, 1) for size in picture.shape[:2])
        used = picture[: height * self.factor, : width * self.factor]
        return np.asarray(cv2.resize(used, (width, height), interpolation=cv2.INTER_AREA), np.uint8)

    def points(self, points_px: ArrayLike) -> NDArray[np.float64]:
        """Return where the reduced picture shows points (..., 2) of the whole one [px]."""
        return (np.asarray(points_px, np.float64) + 0.5) / self.factor - 0.5

    def whole(self, reduced_px: ArrayLike) -> NDArray[np.float64]:
        """Return where the whole picture shows points (..., 2) of the reduced one [px]."""
        return (np.asarray(reduced_px, np.float64) + 0.5) * self.factor - 0.5

    def lens(self, lens: Lens | None) -> Lens | None:
        """Return the lens of the reduced picture."""
        if lens is None:
            return None
        cx, cy = self.points((lens.cx, lens.cy)).tolist()
        return dataclasses.replace(
            lens, fx=lens.fx / self.factor, fy=lens.fy / self.factor, cx=cx, cy=cy
        )

    def whole_lens(self, lens: Lens) -> Lens:
        """Return the lens of the whole picture, of that of the reduced one."""
        cx, cy = self.whole((lens.cx, lens.cy)).tolist()
        return dataclasses.replace(
            lens, fx=lens.fx * self.factor, fy=lens.fy * self.factor, cx=cx, cy=cy
        )
