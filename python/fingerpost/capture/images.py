"""Still images as a recorded source: one file per frame.

Images carry no times, so their names tell them (`fingerpost.capture.numbering`). Every pixel
format becomes 8-bit grey or 8-bit blue-green-red (`decode_image`); an image stored rotated is
turned as its EXIF tag says, as every viewer shows it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fingerpost.capture.numbering import taken
from fingerpost.capture.source import Frame, Source, SourceKind
from fingerpost.errors import CaptureError

_DIGITS = re.compile(r"(\d+)")
_JPEG_START = b"\xff\xd8"
_JPEG_END = b"\xff\xd9"
_JPEG_SCAN = b"\xff\xda"


def natural_order(path: Path) -> list[str | int]:
    """Return a sort key that puts `img2.png` before `img10.png`."""
    return [int(part) if part.isdecimal() else part for part in _DIGITS.split(str(path))]


class ImageSequence(Source):
    """Images read in the given order; sizes must agree."""

    kind = SourceKind.RECORDED

    def __init__(self, paths: Sequence[Path], *, fps: float, name: str) -> None:
        super().__init__(name)
        self._paths = paths
        self._taken = taken(paths, fps, name)
        self._index = 0
        self.frame_count = len(paths)

    def _next_frame(self) -> Frame:
        if self._index == len(self._paths):
            raise StopIteration
        place, self._index = self._index, self._index + 1
        index, time_s = self._taken[place]
        return Frame(index, time_s, decode_image(self._paths[place]))

    def _place(self, index: int) -> str:
        return next(
            str(path)
            for path, one in zip(self._paths, self._taken, strict=True)
            if one.place == index
        )

    def close(self) -> None:
        """Stop: no more frames will come."""
        self._index = len(self._paths)


def decode_image(path: Path) -> NDArray[np.uint8]:
    """Read an image file as 8-bit grey (h, w) or blue-green-red (h, w, 3).

    16-bit images are scaled by 255 / 65535 and rounded: their full range is taken to be used.
    An alpha channel is dropped and the colour kept as stored. Palettes become colour.

    Raises
    ------
    CaptureError
        The file cannot be read, is cut off, is no image, or holds floating-point pixels.
    """
    import cv2

    try:
        data = path.read_bytes()
    except OSError as error:
        raise CaptureError(f"{path}: {error.strerror}") from error
    if not data:
        raise CaptureError(f"{path}: the file is empty; an image is needed")
    try:
        image = cv2.imdecode(
            np.frombuffer(data, np.uint8), cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH
        )
    except cv2.error:
        image = None
    if image is None or _is_cut_off_jpeg(data):
        raise CaptureError(
            f"{path}: cannot be decoded: damaged, cut off, or not an image that OpenCV reads"
        )
    if image.dtype == np.uint16:
        return ((image.astype(np.uint32) + 128) // 257).astype(np.uint8)
    if image.dtype != np.uint8:
        raise CaptureError(
            f"{path}: pixels are stored as {image.dtype}; 8 or 16 bits per channel are read"
        )
    return np.ascontiguousarray(image, dtype=np.uint8)


def _is_cut_off_jpeg(data: bytes) -> bool:
    """Tell whether a JPEG lacks its end; OpenCV before 5 fills the missing part with grey.

    The end is looked for behind the start of the picture's data, because the thumbnail in the
    header has an end of its own.
    """
    if not data.startswith(_JPEG_START):
        return False
    position = len(_JPEG_START)
    while data[position : position + 2] != _JPEG_SCAN:
        if data[position : position + 1] != b"\xff" or position + 4 > len(data):
            return False  # not the plain sequence of segments; the decoder has judged it
        if data[position + 1] == 0xFF:  # fill byte before a marker
            position += 1
            continue
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    return _JPEG_END not in data[position:]
