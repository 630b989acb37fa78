"""Still images as a recorded source: one file per frame, or many pictures in one file.

The capture times of a sequence follow from the file names (`fingerpost.capture.numbering`). Pages
of a TIFF carry no times, so page k has the time k / fps; animations (GIF, APNG, WebP, AVIF) state
how long each picture is shown. Every pixel format becomes 8-bit grey or 8-bit blue-green-red; an
image stored rotated is turned as its EXIF tag says, as in every viewer. A picture that cannot be
decoded, or that its decoder has repaired, is a `Loss`.
"""

from __future__ import annotations

import contextlib
import mmap
import re
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from fingerpost.capture.depth import Depth, sampled
from fingerpost.capture.messages import Listener
from fingerpost.capture.numbering import taken
from fingerpost.capture.source import DAMAGED, UNDECODABLE, Frame, Loss, Source, SourceKind
from fingerpost.checks import opencv_path
from fingerpost.errors import CaptureError

_PASSED_ON = (b"\xff\xd8\xff", b"\x89PNG")  # formats that viewers of recordings can show
_DIGITS = re.compile(r"(\d+)")
_JPEG_START = b"\xff\xd8"
_JPEG_END = b"\xff\xd9"
_JPEG_SCAN = b"\xff\xda"
_NEXT_JPEG = _JPEG_START + b"\xff"
_MULTI_PICTURE = b"MPF\0"
_TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
# Pictures decoded at a time: to reach the first of them, OpenCV decodes all before it.
_CHUNK, _CHUNK_BYTES = 32, 64 << 20
# Players show a picture with a duration below the first of these for the second.
_SHORTEST_SHOWN_S, _SHOWN_S = 0.02, 0.1


def natural_order(path: Path) -> list[str | int]:
    """Return a sort key that puts `img2.png` before `img10.png`."""
    return [int(part) if part.isdecimal() else part for part in _DIGITS.split(str(path))]


class UndecodableError(Exception):
    """A picture of a sequence cannot be decoded or is damaged; the message names it and why."""


class _Pictures(Source):
    """Pictures by index; subclasses define how to load one, and its capture time."""

    kind = SourceKind.RECORDED
    has_own_clock = True

    def __init__(self, name: str, count: int) -> None:
        super().__init__(name)
        self._index = 0
        self.frame_count: int = count
        self._listener = Listener()
        self._depth = Depth([])

    @abstractmethod
    def _load(self, index: int) -> NDArray[np.generic]:
        """Decode a picture; raises `UndecodableError`."""

    @abstractmethod
    def _time_s(self, index: int) -> float: ...

    def _encoded(self) -> bytes:
        """Return the content of the file loaded last, if it holds only this picture."""
        return b""

    def _number(self, index: int) -> int:
        """Return the position of a picture in the stream it was taken from."""
        return index

    def _decide_depth(self) -> None:
        """Determine the depth from a sample, if the first readable picture has 16 bits."""
        pictures = self._sample()
        first = next(pictures, None)
        if first is not None and first.dtype == np.uint16:
            self._depth = Depth(chain([first], pictures))

    def _sample(self) -> Iterator[NDArray[np.generic]]:
        for index in sampled(self.frame_count):
            with contextlib.suppress(UndecodableError):
                yield self._load(index)

    @property
    def notes(self) -> tuple[str, ...]:
        """Further final remarks on the source, for people."""
        return (self._depth.note,) if self._depth.note else ()

    def _next_frame(self) -> Frame | Loss:
        if self._index >= self.frame_count:
            raise StopIteration
        index, self._index = self._index, self._index + 1
        number, time_s = self._number(index), self._time_s(index)
        try:
            loaded = self._load(index)
            image = self._depth.eight_bits(loaded)
        except UndecodableError as error:
            self._detail = self._detail or str(error)
            return Loss(number, time_s, UNDECODABLE)
        if image is None:
            more = f"{self._place(number)}: holds more than {self._depth.bits} bits"
            self._detail = self._detail or more
            return Loss(number, time_s, DAMAGED)
        encoded = self._encoded() if loaded.dtype == np.uint8 else b""
        return Frame(number, time_s, image, encoded if encoded.startswith(_PASSED_ON) else b"")

    def close(self) -> None:
        """Stop: no more frames will come."""
        self._index = self.frame_count


class ImageSequence(_Pictures):
    """Images read in the given order, with times from their names; all of one size."""

    def __init__(self, paths: Sequence[Path], *, fps: float, name: str) -> None:
        super().__init__(name, len(paths))
        self._paths = paths
        self._data = b""
        self._taken = taken(paths, fps, name)
        if len(set(paths)) == 1:
            self._need_first()
        self._decide_depth()

    def _need_first(self) -> None:
        try:
            self._load(0)
        except UndecodableError as error:
            raise CaptureError(str(error)) from error

    def _load(self, index: int) -> NDArray[np.generic]:
        self._data = read_image(self._paths[index])
        return decoded_image(self._data, str(self._paths[index]), self._listener)

    def _encoded(self) -> bytes:
        return self._data

    def _time_s(self, index: int) -> float:
        return self._taken[index].time_s

    def _number(self, index: int) -> int:
        return self._taken[index].place

    def _place(self, index: int) -> str:
        return next(
            str(path)
            for path, one in zip(self._paths, self._taken, strict=True)
            if one.place == index
        )


class JpegFilm(_Pictures):
    """The pictures of a file of concatenated JPEGs, `fps` per second."""

    def __init__(self, path: Path, *, fps: float) -> None:
        with path.open("rb") as file:
            self._data = _mapped(file)
        self._places = list(_jpegs(self._data))
        self._picture = b""
        super().__init__(str(path), len(self._places))
        self._fps = fps

    def _load(self, index: int) -> NDArray[np.generic]:
        start, end = self._places[index]
        self._picture = self._data[start:end]
        return decoded_image(self._picture, self._place(index), self._listener)

    def _encoded(self) -> bytes:
        return self._picture

    def _time_s(self, index: int) -> float:
        return index / self._fps

    def close(self) -> None:
        """Close the file: no more frames will come."""
        super().close()
        self._data.close()


class PictureStack(_Pictures):
    """The pictures of one animation (GIF, APNG, WebP, AVIF), or the pages of one TIFF.

    They are decoded in chunks: memory does not grow with the length of the file.
    """

    def __init__(self, path: Path, count: int, *, fps: float) -> None:
        super().__init__(str(path), count)
        self._file = opencv_path(path, "source")
        self._is_animation = path_is_animation(path)
        self._fps = fps
        self._chunk: Sequence[NDArray[np.generic]] = ()
        self._chunk_start, self._chunk_size = 0, 1
        self._starts_s = [0.0]
        if not self._is_animation:  # those have 8 bits
            self._decide_depth()

    def _load(self, index: int) -> NDArray[np.generic]:
        if not self._chunk_start <= index < self._chunk_start + len(self._chunk):
            self._read_chunk(index)
        if not self._chunk and self._chunk_size > 1:  # one damaged picture hides all of a chunk
            self._chunk_size = 1
            self._read_chunk(index)
        if index >= self._chunk_start + len(self._chunk):
            raise UndecodableError(f"{self._place(index)} cannot be decoded: damaged or cut off")
        picture = self._chunk[index - self._chunk_start]
        self._chunk_size = max(1, min(_CHUNK, _CHUNK_BYTES // picture.nbytes))
        return picture[..., :3] if picture.ndim == 3 else picture

    def _read_chunk(self, start: int) -> None:
        import cv2

        self._chunk, self._chunk_start = (), start
        with contextlib.suppress(cv2.error), self._listener:
            if self._is_animation:
                _, animation = cv2.imreadanimation(self._file, start, self._chunk_size)
                self._chunk = animation.frames
                self._add_durations(start, animation.durations)
            else:
                flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH
                _, self._chunk = cv2.imreadmulti(self._file, start, self._chunk_size, flags=flags)
        if self._listener.complaint:
            self._chunk = self._chunk[:-1]  # the complaint is of the picture decoded last

    def _add_durations(self, start: int, durations_ms: Sequence[int]) -> None:
        """Store the durations of pictures that follow directly on the known ones."""
        if start + 1 == len(self._starts_s):
            shown_s = np.asarray(durations_ms, np.float64) / 1000
            shown_s[shown_s < _SHORTEST_SHOWN_S] = _SHOWN_S
            self._starts_s += (self._starts_s[-1] + np.cumsum(shown_s)).tolist()

    def _time_s(self, index: int) -> float:
        if not self._is_animation:
            return index / self._fps
        with contextlib.suppress(UndecodableError):
            self._load(index)
        known = len(self._starts_s) - 1
        return self._starts_s[min(index, known)] + max(0, index - known) / self._fps


def picture_count(path: Path) -> int:
    """Count the pictures of an image file; 1 also if it cannot be read."""
    import cv2

    with Listener():
        try:
            return max(1, cv2.imcount(opencv_path(path, "source")))
        except cv2.error:
            return 1


def is_motion_jpeg(path: Path) -> bool:
    """Return whether a file consists of concatenated JPEGs: a film without a container.

    Phones also append a second picture, but list it in a segment of the first.
    """
    with path.open("rb") as file, contextlib.closing(_mapped(file)) as data:
        scan = _jpeg_scan(data)
        if scan < 0 or data.find(_MULTI_PICTURE, 0, scan) >= 0:
            return False
        end = data.find(_JPEG_END, scan) + len(_JPEG_END)
        return end >= len(_JPEG_END) and data[end : end + len(_JPEG_START)] == _JPEG_START


def _mapped(file: BinaryIO) -> mmap.mmap:
    return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)


def _jpegs(data: mmap.mmap) -> Iterator[tuple[int, int]]:
    """Yield start and end of each JPEG; one without an end marker ends before the next."""
    start = data.find(_NEXT_JPEG)
    while start >= 0:
        # Neither a start nor an end marker can occur in the data of a picture.
        scan = max(_jpeg_scan(data, start), start + len(_JPEG_START))
        following = data.find(_NEXT_JPEG, scan)
        end = data.find(_JPEG_END, scan, following if following >= 0 else len(data))
        yield (
            start,
            end + len(_JPEG_END) if end >= 0 else following if following >= 0 else len(data),
        )
        start = following


def path_is_animation(path: Path) -> bool:
    """Return whether a file of several pictures states their durations: all but TIFF do."""
    with path.open("rb") as file:
        return file.read(4) not in _TIFF_STARTS


def read_image(path: Path) -> bytes:
    """Return the content of an image file.

    Raises
    ------
    UndecodableError
        The file cannot be read, or is empty.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UndecodableError(f"{path}: {error.strerror}") from error
    if not data:
        raise UndecodableError(f"{path}: the file is empty; an image is needed")
    return data


def decoded_image(data: bytes, place: str, listener: Listener) -> NDArray[np.generic]:
    """Decode the content of an image file to grey (h, w) or blue-green-red (h, w, 3).

    It has 8 or 16 bits. An alpha channel is dropped and the colour kept as stored. Palettes become
    colour.

    Parameters
    ----------
    data
        The content.
    place
        Where it was found, for messages.
    listener
        Detects whether the decoder repairs it.

    Raises
    ------
    UndecodableError
        It is truncated, damaged, or not an image.
    CaptureError
        It holds floating-point pixels.
    """
    import cv2

    image = None
    with contextlib.suppress(cv2.error), listener:
        image = cv2.imdecode(
            np.frombuffer(data, np.uint8), cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH
        )
    if image is None or _is_cut_off_jpeg(data) or listener.complaint:
        raise UndecodableError(
            f"{place}: cannot be decoded: damaged, cut off, or not an image that OpenCV reads"
        )
    if image.dtype not in (np.uint8, np.uint16):
        raise CaptureError(
            f"{place}: pixels are stored as {image.dtype}; 8 or 16 bits per channel are read"
        )
    return image


def _is_cut_off_jpeg(data: bytes) -> bool:
    """Return whether a JPEG lacks its end; OpenCV before 5 fills the missing part with grey.

    The end marker is searched behind the start of the picture's data, because the thumbnail in the
    header has one of its own.
    """
    scan = _jpeg_scan(data)
    return scan >= 0 and data.find(_JPEG_END, scan) < 0


def _jpeg_scan(data: bytes | mmap.mmap, start: int = 0) -> int:
    """Return where the data of a JPEG's picture begin; −1 if only its decoder can find that."""
    if data[start : start + len(_JPEG_START)] != _JPEG_START:
        return -1
    position = start + len(_JPEG_START)
    while data[position : position + 2] != _JPEG_SCAN:
        if data[position : position + 1] != b"\xff" or position + 4 > len(data):
            return -1  # not the plain sequence of segments
        if data[position + 1] == 0xFF:  # fill byte before a marker
            position += 1
            continue
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    return position
