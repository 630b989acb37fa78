"""Captures the messages of decoders while they decode.

FFmpeg, libjpeg and libpng conceal damage in pictures and return them like intact ones. They report
it only on the standard error stream, so its descriptor is redirected to a file while a picture is
decoded. Lines that other threads write meanwhile are passed on.

FFmpeg reports concealment as information, not as an error. It is therefore set to log information,
with the level of each line, while a listener is active. This is possible where OpenCV's package
includes FFmpeg as libraries, on Linux and macOS; elsewhere only errors are received. If
`OPENCV_FFMPEG_LOGLEVEL` is set, FFmpeg logs at that level to standard output, and nothing is
received.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import tempfile
import threading
from functools import cache
from itertools import chain
from pathlib import Path
from types import TracebackType
from typing import Self

_STDERR = 2
_ONE_AT_A_TIME = threading.Lock()

# FFmpeg's log level for information, and its flag to print the level of each line.
_INFORMATION, _WITH_LEVEL = 32, 2

# "[h264 @ 0x55ae9e1c95c0] [error] error while decoding MB 5 8", on terminals in colours.
_FFMPEG = re.compile(
    r"\[[\w,.:/ -]+ @ (?:0x)?[0-9a-fA-F]+\] ?(?:\[(?P<level>\w+)\] )?(?P<words>.*)"
)
_COLOURS = re.compile(r"\x1b\[[\d;]*m")
_GRAVE = (None, "error", "fatal", "panic")
_DAMAGE_NOTICES = ("concealing", "Packet corrupt")  # which FFmpeg does not log as errors
_OPENCV = re.compile(r"\[ ?(?:WARN|ERROR|INFO|DEBUG|FATAL):\d+@|OpenCV[(:]|> ")
_LIBRARIES = re.compile(
    r"Corrupt JPEG data|Premature end of JPEG|Unsupported marker type|libpng (?:error|warning)"
)
_CONTINUATION = (" ", "\t")

# Errors that damage no picture: in other streams, in parts that a decoder does not need, and the
# padding of webcams' JPEGs.
_HARMLESS = re.compile(
    r"APP fields|\bSEI\b|not implemented|Update your FFmpeg|libpng warning|"
    r": \d extraneous bytes before marker 0xd9"
)


class Listener:
    """Captures standard error in its `with` block; reusable.

    Attributes
    ----------
    lines
        Complaints of decoders in the last block.
    """

    def __init__(self) -> None:
        self.lines: tuple[str, ...] = ()
        self._ffmpeg = _ffmpeg()
        self._paper = -1
        self._saved = -1
        self._wishes = (0, 0)

    def __enter__(self) -> Self:
        self._paper = _paper(os.getpid())
        _ONE_AT_A_TIME.acquire()
        try:
            self._saved = os.dup(_STDERR)
        except OSError:  # closed before the program began
            self._saved = -1
        os.dup2(self._paper, _STDERR)
        if self._ffmpeg is not None:
            self._wishes = self._ffmpeg.av_log_get_level(), self._ffmpeg.av_log_get_flags()
            self._wish(_INFORMATION, _WITH_LEVEL)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._wish(*self._wishes)
        if self._saved < 0:
            os.close(_STDERR)
        else:
            os.dup2(self._saved, _STDERR)
            os.close(self._saved)
        size = os.lseek(self._paper, 0, os.SEEK_CUR)
        self.lines = self._read(size) if size else ()
        _ONE_AT_A_TIME.release()

    @property
    def complaint(self) -> str:
        """The first line of the last block that reports a damaged picture; empty without one."""
        return next((line for line in self.lines if not _HARMLESS.search(line)), "")

    def _wish(self, level: int, flags: int) -> None:
        if self._ffmpeg is not None:
            self._ffmpeg.av_log_set_level(level)
            self._ffmpeg.av_log_set_flags(flags)

    def _read(self, size: int) -> tuple[str, ...]:
        os.lseek(self._paper, 0, os.SEEK_SET)
        text = _COLOURS.sub("", os.read(self._paper, size).decode("utf-8", "replace"))
        os.ftruncate(self._paper, 0)
        os.lseek(self._paper, 0, os.SEEK_SET)
        lines, foreign = [], []
        for line in text.splitlines(keepends=True):
            if found := _FFMPEG.match(line):
                words = found["words"].strip()
                if found["level"] in _GRAVE or words.startswith(_DAMAGE_NOTICES):
                    lines.append(words)
            elif _LIBRARIES.match(line):
                lines.append(line.strip())
            elif not (_OPENCV.match(line) or line.startswith(_CONTINUATION) or line.isspace()):
                foreign.append(line)
        if foreign:
            with contextlib.suppress(OSError):
                os.write(_STDERR, "".join(foreign).encode("utf-8", "replace"))
        return tuple(lines)


@cache
def _paper(_process: int) -> int:
    """Open the file that receives standard error; a forked process has its own."""
    descriptor, name = tempfile.mkstemp(prefix="fingerpost-")
    with contextlib.suppress(OSError):  # some systems keep the names of open files
        Path(name).unlink()
    return descriptor


@cache
def _ffmpeg() -> ctypes.CDLL | None:
    """Return FFmpeg's library that logs messages, as OpenCV has loaded it, or None."""
    import cv2

    package = Path(cv2.__file__).parent
    places = (package.parent.glob("opencv_*.libs/libavutil*"), package.glob(".dylibs/libavutil*"))
    for path in chain(*places):
        with contextlib.suppress(OSError):
            return ctypes.CDLL(str(path))
    return None
