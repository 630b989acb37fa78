"""Conversion from 16 to 8 bits per channel, by the number of bits that a sequence uses.

Pictures of 10, 12 or 14 bits are stored in 16-bit files, mostly without a shift: read as 16 bits,
they are black. The depth is determined once per sequence, from the greatest value in a sample of
it, so that all pictures are scaled equally.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

DEPTHS = (8, 10, 12, 14, 16)
"""Bits per channel of common cameras."""

SAMPLED = 16
"""Number of pictures of a sequence that determine its depth: one bright pixel suffices."""


class Depth:
    """Number of bits that a sequence uses, and conversion of its pictures to 8 bits.

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
        """Remark for the user on a depth below that of the files; else empty."""
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
    """Return the indices of the sampled pictures among `count`, evenly spaced."""
    return sorted({round(k) for k in np.linspace(0, count - 1, min(count, SAMPLED)).tolist()})
