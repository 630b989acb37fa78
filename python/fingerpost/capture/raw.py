"""Raw frames from a pipe, as FFmpeg and GStreamer write them: rawvideo, or YUV4MPEG2 (y4m).

    ffmpeg -i ... -f rawvideo -pix_fmt bgr24 -        frames without headers; the size is not stated
    ffmpeg -i ... -f yuv4mpegpipe -pix_fmt yuv420p -  a header states it, a line precedes each frame

Data are read as fast as they arrive, so that no frame waits in the pipe.
"""

from __future__ import annotations

import io
import math
import os
import select
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerpost.capture.settings import CameraSettings
from fingerpost.errors import CaptureError, InvalidInputError

Picture = NDArray[np.uint8]

STDIN = "-"
"""The source that is standard input."""

_Y4M = b"YUV4MPEG2 "
_Y4M_FRAME = "FRAME"
# Layouts of the colour spaces of y4m; the variants of 4:2:0 differ only in chroma siting.
_Y4M_SPACES = {
    **dict.fromkeys(("420", "420jpeg", "420paldv", "420mpeg2"), "YU12"),
    "mono": "GREY",
}
_LONGEST_LINE = 256  # of a y4m header
_WAIT_S = 0.05
_LARGEST_SIDE_PX = 32767
_OF_A_PIPE = ("width", "height", "fourcc", "fps")


class StreamEndedError(Exception):
    """The writer has closed the pipe, which ends the stream."""


@dataclass(frozen=True, slots=True)
class _Layout:
    """Memory layout of a frame.

    Attributes
    ----------
    shape
        Shape of the array that OpenCV converts, by width and height.
    conversion
        OpenCV's name of the conversion; empty if none is needed.
    is_halved
        Whether colours have half the resolution, so that width and height must be even.
    """

    shape: Callable[[int, int], tuple[int, ...]]
    conversion: str = ""
    is_halved: bool = False


def _planes(width: int, height: int) -> tuple[int, ...]:
    return height * 3 // 2, width


_LAYOUTS = {
    "BGR3": _Layout(lambda w, h: (h, w, 3)),
    "RGB3": _Layout(lambda w, h: (h, w, 3), "COLOR_RGB2BGR"),
    "GREY": _Layout(lambda w, h: (h, w)),
    "YUYV": _Layout(lambda w, h: (h, w, 2), "COLOR_YUV2BGR_YUYV", is_halved=True),
    "YU12": _Layout(_planes, "COLOR_YUV2BGR_I420", is_halved=True),
    "NV12": _Layout(_planes, "COLOR_YUV2BGR_NV12", is_halved=True),
}
_OTHER_NAMES = {"I420": "YU12", "YUY2": "YUYV", "Y800": "GREY"}


class RawFormat:
    """Size and layout of raw frames.

    Parameters
    ----------
    width, height
        Size [px].
    fourcc
        "BGR3" (FFmpeg's bgr24), "RGB3" (rgb24), "GREY" (gray), "YUYV" (yuyv422), "YU12" or "I420"
        (yuv420p), "NV12" (nv12).

    Raises
    ------
    InvalidInputError
        Another layout, an impossible size, or an odd size with a layout that requires even ones.
    """

    def __init__(self, width: int, height: int, fourcc: str) -> None:
        layout = _LAYOUTS.get(_OTHER_NAMES.get(fourcc, fourcc))
        if layout is None:
            raise InvalidInputError(
                f"fourcc of raw frames is {fourcc}; {', '.join(_LAYOUTS)} can be read"
            )
        if not 1 <= min(width, height) <= max(width, height) <= _LARGEST_SIDE_PX:
            raise InvalidInputError(
                f"raw frames of {width} × {height} px; sides from 1 to {_LARGEST_SIDE_PX} are right"
            )
        if layout.is_halved and (width % 2 or height % 2):
            raise InvalidInputError(
                f"{fourcc} frames of {width} × {height} px; this layout has even sides"
            )
        self.words = f"{width} × {height} px in {fourcc}"
        self._layout = layout
        self._shape = layout.shape(width, height)
        self.bytes = math.prod(self._shape)

    def picture(self, data: bytearray) -> Picture:
        """Convert the bytes of a frame to a new picture, grey or blue-green-red."""
        raw = np.frombuffer(data, np.uint8).reshape(self._shape)
        if not self._layout.conversion:
            return raw.copy()
        import cv2

        return np.asarray(cv2.cvtColor(raw, getattr(cv2, self._layout.conversion)), np.uint8)


def raw_format(camera: CameraSettings | None) -> RawFormat | None:
    """Return the format of raw frames by a rig's camera settings; None without a size.

    Raises
    ------
    InvalidInputError
        The settings include some that no pipe has, or a format that cannot be read.
    """
    if camera is None:
        return None
    strange = [name for name in camera.asked if name not in _OF_A_PIPE]
    if strange:
        raise InvalidInputError(
            f"camera.{strange[0]} cannot be set through a pipe; set it where the frames come from"
        )
    if camera.size_px is None:
        raise InvalidInputError("camera of a pipe needs width and height: those of its frames")
    return RawFormat(*camera.size_px, camera.fourcc or "BGR3")


class RawStream:
    """An open pipe as a device that returns raw frames.

    Parameters
    ----------
    descriptor
        File descriptor open for reading; closed by `release` unless it is standard input.
    known
        Format of the frames; None for a stream that states it (y4m).
    timeout_s
        Time limit for the first bytes [s].
    ends
        Whether the end of the pipe ends the stream; otherwise it is a pause until the next writer.

    Raises
    ------
    CaptureError
        No data in time, or data without a format or with one that cannot be read.
    """

    def __init__(
        self, descriptor: int, known: RawFormat | None, *, timeout_s: float, ends: bool
    ) -> None:
        self._file = io.FileIO(descriptor, closefd=descriptor != 0)
        self._ends = ends
        self._got = bytearray()
        self._is_y4m = self._needs_line = False
        self._picture: Picture | None = None
        self._has_given = False
        try:
            self._format = self._read_format(known, timeout_s)
        except BaseException:
            self._file.close()
            raise

    def _read_format(self, known: RawFormat | None, timeout_s: float) -> RawFormat:
        """Return the format, by the first bytes."""
        end_s = time.monotonic() + timeout_s
        while not self._fill(len(_Y4M)) and time.monotonic() < end_s:
            pass
        if not self._got:
            raise CaptureError(f"nothing was written to it within {timeout_s:g} s")
        self._is_y4m = self._needs_line = self._got.startswith(_Y4M)
        if not self._is_y4m and known is None:
            raise CaptureError(
                "raw frames do not state their size; camera = { width = ..., height = ... } in the "
                "view's table is needed, or a y4m stream"
            )
        if not self._is_y4m:
            return known  # type: ignore[return-value]  # not None: checked above
        while (line := self._line()) is None:
            if time.monotonic() > end_s:
                raise CaptureError(f"its y4m header did not come within {timeout_s:g} s")
        return y4m_format(line)

    def isOpened(self) -> bool:  # noqa: N802 - OpenCV's name
        """Return True: the first bytes have been read."""
        return True

    def grab(self) -> bool:
        """Read the available data; return whether a frame is complete.

        Raises
        ------
        StreamEndedError
            The writer has closed the pipe, and that ends the stream.
        CaptureError
            The pipe was closed before the first frame was complete, or the data are not valid y4m.
        """
        if self._needs_line:
            line = self._line()
            if line is None:
                return False
            if not line.startswith(_Y4M_FRAME):
                raise CaptureError("its y4m frames do not follow one another: it is damaged")
            self._needs_line = False
        if not self._fill(self._format.bytes):
            return False
        self._picture = self._format.picture(self._got)
        self._got.clear()
        self._needs_line, self._has_given = self._is_y4m, True
        return True

    def retrieve(self) -> tuple[bool, Picture | None]:
        """Return the frame that was grabbed."""
        return self._picture is not None, self._picture

    def release(self) -> None:
        """Close the pipe."""
        self._file.close()

    def _line(self) -> str | None:
        """Read a line of a y4m stream; None while it is incomplete."""
        while b"\n" not in self._got:
            if len(self._got) > _LONGEST_LINE:
                raise CaptureError("its y4m lines have no end: it is damaged")
            if not self._fill(len(self._got) + 1):
                return None
        line = self._got.decode("latin-1").rstrip("\n")
        self._got.clear()  # nothing was read beyond the line
        return line

    def _fill(self, count: int) -> bool:
        """Read until there are `count` bytes; False if none arrives for `_WAIT_S`."""
        while (missing := count - len(self._got)) > 0:
            if os.name == "posix" and not select.select([self._file], [], [], _WAIT_S)[0]:
                return False
            data = self._file.read(missing)
            if data is None:
                return False
            if not data:
                self._end()
                return False
            self._got += data
        return True

    def _end(self) -> None:
        """Raise the error for the end of the pipe; do nothing if another writer may follow."""
        got, self._needs_line = len(self._got), self._is_y4m
        self._got.clear()
        if not self._ends:
            return
        if self._has_given:
            raise StreamEndedError
        if not got:
            raise CaptureError("it ended before the first frame; was there an error in the writer?")
        raise CaptureError(
            f"it ended within the first frame, of {self._format.words}: are width, height and "
            "fourcc those of the writer?"
        )


def y4m_format(header: str) -> RawFormat:
    """Parse the format in the first line of a y4m stream.

    Raises
    ------
    CaptureError
        There is no format, or one that cannot be read.
    """
    fields = {word[0]: word[1:] for word in header.split()[1:]}
    space = fields.get("C", "420")
    if not (fields.get("W", "").isdecimal() and fields.get("H", "").isdecimal()):
        raise CaptureError(f"its y4m header {header!r} has no size")
    if space not in _Y4M_SPACES:
        raise CaptureError(f"its y4m frames have the pixels {space}; -pix_fmt yuv420p is right")
    return RawFormat(int(fields["W"]), int(fields["H"]), _Y4M_SPACES[space])
