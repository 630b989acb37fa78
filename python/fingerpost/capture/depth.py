"""From 16 bits a channel to 8, by the bits that a sequence of pictures uses.

Cameras of 10, 12 or 14 bits are stored in 16-bit files, most of them without a shift: taken for
what they are called, their pictures are black. The depth is decided once for a sequence, from the
greatest value in a sample of it, so that no picture is scaled unlike another.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

DEPTHS = (8, 10, 12, 14, 16)
"""Bits a channel that cameras have."""

SAMPLED = 16
"""So many pictures of a sequence are asked for its depth: any bright pixel in one decides."""


class Depth:
    """The bits in use in a sequence, and its pictures in 8 bits.

    Parameters
    ----------
    pictures
        A sample of the sequence, `uint8` or `uint16`.
    """

    def __init__(self, pictures: Iterable[NDArray[np.generic]]) -> None:
        greatest = max((int(p.max()) for p in pictures if p.dtype == np.uint16), default=0xFFFF)
        self.bits = next(bits for bits in DEPTHS if greatest < 1 << bits)

    @property
    def note(self) -> str:
        """What is to be said of a depth that is less than the files have room for."""
        return f"16-bit pictures use {self.bits} bits, scaled" if self.bits < max(DEPTHS) else ""

    def eight_bits(self, picture: NDArray[np.generic]) -> NDArray[np.uint8] | None:
        """Scale a picture to 0 to 255 and round; None for one with values above the depth."""
        if picture.dtype == np.uint8:
            return np.ascontiguousarray(picture, dtype=np.uint8)
        most = (1 << self.bits) - 1
        if picture.max() > most:
            return None
        return ((picture.astype(np.uint32) * 255 + most // 2) // most).astype(np.uint8)


def sampled(count: int) -> list[int]:
    """Places of the pictures that are asked for the depth of `count`, evenly spread."""
    return sorted({round(k) for k in np.linspace(0, count - 1, min(count, SAMPLED)).tolist()})
