"""What decoders say while they decode.

FFmpeg, libjpeg and libpng mend damaged pictures by guess and hand them over like sound ones. That
they did is written to the standard error stream and nowhere else; so the stream's descriptor leads
to a file while a picture is decoded. Lines that no decoder wrote, by other threads meanwhile, are
passed on.

A process whose `OPENCV_FFMPEG_LOGLEVEL` is below 16 (errors) has silenced FFmpeg: nothing is heard.
"""

from __future__ import annotations

import contextlib
import os
import re
import tempfile
import threading
from types import TracebackType
from typing import Self

_STDERR = 2
_ONE_AT_A_TIME = threading.Lock()

# "[h264 @ 0x55ae9e1c95c0] error while decoding MB 5 8", and what continues such a line.
_FFMPEG = re.compile(r"\[(?P<part>[\w,.:/ -]+) @ (?:0x)?[0-9a-fA-F]+\] ?(?P<words>.*)")
_OPENCV = re.compile(r"\[ ?(?:WARN|ERROR|INFO|DEBUG|FATAL):\d+@|OpenCV[(:]|> ")
_LIBRARIES = re.compile(
    r"Corrupt JPEG data|Premature end of JPEG|Unsupported marker type|libpng (?:error|warning)"
)
_CONTINUATION = (" ", "\t")

# Errors that cost no picture: what stands beside the pictures, what a decoder does without, and how
# webcams pad their JPEGs.
_HARMLESS = re.compile(
    r"APP fields|\bSEI\b|not implemented|Update your FFmpeg|libpng warning|"
    r": \d extraneous bytes before marker 0xd9"
)


class Listener:
    """Hears what is written to standard error in its `with` block; used again and again.

    Attributes
    ----------
    lines
        What decoders wrote in the last block, without addresses: "h264: error while decoding ...".
    """

    def __init__(self) -> None:
        self.lines: tuple[str, ...] = ()
        self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 - lives as long as this
        self._saved: int | None = None

    def __enter__(self) -> Self:
        _ONE_AT_A_TIME.acquire()
        try:
            self._saved = os.dup(_STDERR)
        except OSError:  # closed before the program began
            self._saved = None
        os.dup2(self._file.fileno(), _STDERR)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._saved is None:
            os.close(_STDERR)
        else:
            os.dup2(self._saved, _STDERR)
            os.close(self._saved)
        _ONE_AT_A_TIME.release()
        self.lines = self._read() if self._file.tell() else ()

    @property
    def complaint(self) -> str:
        """The first line of the last block that tells of a damaged picture; empty without one."""
        return next((line for line in self.lines if not _HARMLESS.search(line)), "")

    def _read(self) -> tuple[str, ...]:
        self._file.seek(0)
        text = self._file.read().decode("utf-8", "replace")
        self._file.seek(0)
        self._file.truncate()
        lines, foreign = [], []
        for line in text.splitlines(keepends=True):
            if found := _FFMPEG.match(line):
                lines.append(f"{found['part']}: {found['words'].strip()}")
            elif _LIBRARIES.match(line):
                lines.append(line.strip())
            elif not (_OPENCV.match(line) or line.startswith(_CONTINUATION) or line.isspace()):
                foreign.append(line)
        if foreign:
            with contextlib.suppress(OSError):
                os.write(_STDERR, "".join(foreign).encode("utf-8", "replace"))
        return tuple(lines)

    def close(self) -> None:
        """Give the file back."""
        self._file.close()
