"""A film in WebM, each picture at its own time, playable up to the last one at any time.

OpenCV's writer gives every picture the same duration, does not report a full disk, and buffers
pictures. The container is therefore written here: it consists of a few elements (RFC 8794, EBML;
RFC 9559, Matroska). The pictures are key frames of VP8, from lossy WebP files (RFC 9649), which
contain one `VP8 ` chunk. Every browser plays them.

Each picture is a separate cluster, and the segment's size is unknown until the film is closed: a
truncated file plays up to its end. Closing adds the duration and the index for seeking.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fingerpost.errors import RecordingError

LARGEST_PX = 16383
"""Longest side of a picture of VP8."""

_QUALITY = 80
_UNKNOWN_SIZE = b"\x01" + b"\xff" * 7
_CUE_EVERY_MS = 1000
_LAST_SHOWN_MS = 40  # a film of one picture
_INDEX_ROOM = 160

_EBML, _SEGMENT, _VOID = "1A45DFA3", "18538067", "EC"
_SEEK_HEAD, _SEEK, _SEEK_ID, _SEEK_POSITION = "114D9B74", "4DBB", "53AB", "53AC"
_INFO, _TIME_SCALE, _DURATION, _MUXER, _WRITER = "1549A966", "2AD7B1", "4489", "4D80", "5741"
_TRACKS, _TRACK, _CUES, _CLUSTER = "1654AE6B", "AE", "1C53BB6B", "1F43B675"


def _element(identifier: str, *content: bytes) -> bytes:
    data = b"".join(content)
    return bytes.fromhex(identifier) + (len(data) | 1 << 56).to_bytes(8, "big") + data


def _number(identifier: str, value: int) -> bytes:
    return _element(identifier, value.to_bytes(8, "big"))


def _void(size: int) -> bytes:
    """Return a placeholder element of a given size, to be overwritten."""
    return _element(_VOID, bytes(size - 9))


class WebmFilm:
    """A film that grows by one picture at a time, encoded by another thread.

    Parameters
    ----------
    path
        The file, existing and empty.
    drops
        Whether to drop a picture while the previous one is being encoded; else it waits.
    """

    def __init__(self, path: Path, *, drops: bool) -> None:
        self._path, self._drops = path, drops
        self._file = path.open("r+b", buffering=0)
        self._encoder = ThreadPoolExecutor(1, thread_name_prefix="film")
        self._pending: Future[None] | None = None
        self._start_s = 0.0
        self._last_ms, self._interval_ms = -1, _LAST_SHOWN_MS
        self._cues: list[tuple[int, int]] = []
        self._places: dict[str, int] = {}
        self._segment = self._duration = 0

    def write(self, image: NDArray[np.uint8], time_s: float) -> None:
        """Append a picture with the time from which it is shown.

        Parameters
        ----------
        image : (height, width, 3)
            Blue-green-red.
        time_s
            Time relative to the first picture [s]; if not after the last, it becomes 1 ms later.

        Raises
        ------
        RecordingError
            The previous picture could not be written: the disk is full.
        """
        if self._drops and self._pending is not None and not self._pending.done():
            return
        self._settle()
        if self._last_ms < 0:
            self._start_s = time_s
        time_ms = max(self._last_ms + 1, round(1000 * (time_s - self._start_s)))
        if self._last_ms >= 0:
            self._interval_ms = time_ms - self._last_ms
        self._last_ms = time_ms
        self._pending = self._encoder.submit(self._append, image.copy(), time_ms)

    def close(self) -> None:
        """Complete the film.

        Raises
        ------
        RecordingError
            As `write`.
        """
        try:
            self._settle()
            self._guarded(self._complete)
        finally:
            self._encoder.shutdown()
            self._file.close()

    def _settle(self) -> None:
        pending, self._pending = self._pending, None
        if pending is not None:
            pending.result()

    def _append(self, image: NDArray[np.uint8], time_ms: int) -> None:
        self._guarded(lambda: self._append_encoded(image, time_ms))

    def _guarded(self, work: Callable[[], None]) -> None:
        try:
            work()
        except OSError as error:
            raise RecordingError(
                f"{self._path}: cannot be written any more: {error.strerror}; "
                "it plays up to the last picture that is there"
            ) from error

    def _append_encoded(self, image: NDArray[np.uint8], time_ms: int) -> None:
        if not self._segment:
            self._begin(image.shape[1], image.shape[0])
        place = self._file.tell()
        if not self._cues or time_ms >= self._cues[-1][0] + _CUE_EVERY_MS:
            self._cues.append((time_ms, place - self._segment))
        block = b"\x81" + struct.pack(">hB", 0, 0x80) + _key_frame(image)
        self._write(_element(_CLUSTER, _number("E7", time_ms), _element("A3", block)))

    def _begin(self, width: int, height: int) -> None:
        numbers = {"4286": 1, "42F7": 1, "42F2": 4, "42F3": 8, "4287": 2, "4285": 2}
        head = (_number(identifier, value) for identifier, value in numbers.items())
        self._write(_element(_EBML, *head, _element("4282", b"webm")))
        self._write(bytes.fromhex(_SEGMENT) + _UNKNOWN_SIZE)
        self._segment = self._file.tell()
        self._write(_void(_INDEX_ROOM))
        self._places[_INFO] = self._file.tell() - self._segment
        names = _element(_MUXER, b"fingerpost"), _element(_WRITER, b"fingerpost")
        info = _element(_INFO, _number(_TIME_SCALE, 10**6), *names, _void(len(_duration(0))))
        self._write(info)
        self._duration = self._file.tell() - len(_duration(0))
        self._places[_TRACKS] = self._file.tell() - self._segment
        video = _element("E0", _number("B0", width), _number("BA", height))
        track = _number("D7", 1), _number("73C5", 1), _number("83", 1), _number("9C", 0)
        self._write(_element(_TRACKS, _element(_TRACK, *track, _element("86", b"V_VP8"), video)))

    def _complete(self) -> None:
        if not self._segment:
            return
        end = self._places[_CUES] = self._file.tell() - self._segment
        cues = (
            _element(
                "BB",
                _number("B3", time_ms),
                _element("B7", _number("F7", 1), _number("F1", place)),
            )
            for time_ms, place in self._cues
        )
        self._write(written := _element(_CUES, *cues))
        seeks = (
            _element(
                _SEEK,
                _element(_SEEK_ID, bytes.fromhex(identifier)),
                _number(_SEEK_POSITION, place),
            )
            for identifier, place in self._places.items()
        )
        head = _element(_SEEK_HEAD, *seeks)
        self._write_at(self._segment, head + _void(_INDEX_ROOM - len(head)))
        self._write_at(self._duration, _duration(self._last_ms + self._interval_ms))
        size = end + len(written)
        self._write_at(self._segment - 8, (size | 1 << 56).to_bytes(8, "big"))

    def _write_at(self, place: int, data: bytes) -> None:
        self._file.seek(place)
        self._write(data)

    def _write(self, data: bytes) -> None:
        left = memoryview(data)
        while left:
            left = left[self._file.write(left) or 0 :]


def _duration(duration_ms: float) -> bytes:
    return _element(_DURATION, struct.pack(">d", duration_ms))


def _key_frame(image: NDArray[np.uint8]) -> bytes:
    """Return a picture as a key frame of VP8: the only chunk of a lossy WebP file."""
    import cv2

    try:
        file = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])[1].tobytes()
    except cv2.error:
        file = b""
    if file[12:16] != b"VP8 ":
        raise RecordingError(
            f"a picture of {image.shape[1]} x {image.shape[0]} pixels cannot be encoded as VP8; "
            f"at most {LARGEST_PX} on each side is right"
        )
    return file[20 : 20 + int.from_bytes(file[16:20], "little")]
