"""Overlay videos.

The codec follows from the file's suffix: VP8 for `.webm`, which browsers play and in which every
frame has its own time (`webm`); MPEG-4 for `.mp4` and `.mkv`, motion JPEG for `.avi`, in which
frames are repeated or left out to match the times.

Frames are written to `name.part.suffix`, which is renamed when it is closed: a file with the final
name is always complete. If such a part already exists, the new one is called `name.part2.suffix`
and so on. A run that is killed leaves its part: `.webm` plays up to its last frame, `.avi` and
`.mkv` up to their last seconds, while an `.mp4` cannot be played, because its index comes at the
end.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from fingerpost.checks import opencv_path
from fingerpost.errors import InvalidInputError, RecordingError
from fingerpost.recording.interrupts import uninterrupted
from fingerpost.recording.webm import WebmFilm

if TYPE_CHECKING:
    import cv2

_CODECS = {".webm": "VP8", ".mp4": "mp4v", ".mkv": "mp4v", ".avi": "MJPG"}
DEFAULT_FPS = 25.0
"""Frame rate for frames without times, if the rate is unknown [1/s]."""

_LEAST_FREE_BYTES = 1 << 20
_FPS = (1.0, 240.0)
_LONGEST_GAP = 250
"""Longest gap that is filled, in frames: 10 s at 25 frames a second; a longer one is shortened."""


class VideoWriter:
    """A video that is opened at the size of its first frame; a context manager.

    Parameters
    ----------
    path
        The file; an existing one is replaced when the video is complete. Suffix `.webm`, `.mp4`,
        `.mkv` or `.avi`.
    fps
        Frames per second, > 0, for frames without times, and for containers with a constant rate.
        None for the rate of the first two times.
    drops
        Whether a `.webm` drops frames while its encoder is busy; else `write` waits.

    Raises
    ------
    InvalidInputError
        Another suffix, a folder that does not exist or is not writable, a name that OpenCV cannot
        use, or `fps` not above 0.

    Attributes
    ----------
    path
        The file.
    part
        The file with the frames until the video is complete; created empty at once.
    """

    def __init__(self, path: str | Path, *, fps: float | None, drops: bool = False) -> None:
        self.path = Path(path)
        if self.path.suffix.lower() not in _CODECS:
            raise InvalidInputError(f"{path}: a name ending in {', '.join(_CODECS)} is needed")
        if not self.path.parent.is_dir():
            raise InvalidInputError(f"{path}: the folder {self.path.parent} does not exist")
        if self.path.is_dir():
            raise InvalidInputError(f"{path}: is a folder; the name of a video is needed")
        if fps is not None and not 0 < fps < float("inf"):
            raise InvalidInputError(f"fps = {fps}: must be a finite number above 0")
        opencv_path(self.path, "video")  # refused before the part is created
        self.part = self._reserved()
        self._fps = fps
        self._film: WebmFilm | None = None
        if self.path.suffix.lower() == ".webm":
            self._film = WebmFilm(self.part, drops=drops)
        self._held: tuple[NDArray[np.uint8], float] | None = None
        self._start_s = 0.0
        self._given = 0
        self._shown = np.empty((0, 0, 3), np.uint8)
        self._writer: cv2.VideoWriter | None = None
        self._size = (0, 0)
        self._count = 0
        self._is_full = self._is_closed = False

    def _reserved(self) -> Path:
        """Create a new file next to the video's."""
        number = 1
        while True:
            tag = "part" if number == 1 else f"part{number}"
            part = self.path.with_name(f"{self.path.stem}.{tag}{self.path.suffix}")
            try:
                part.open("xb").close()
            except FileExistsError:
                number += 1
            except (OSError, ValueError) as error:  # ValueError: a name that no file can have
                reason = error.strerror if isinstance(error, OSError) else error
                raise InvalidInputError(
                    f"{self.path}: cannot be written: {reason}; "
                    "name a file in a folder that may be written into"
                ) from error
            else:
                return part

    def write(self, image: NDArray[np.uint8], time_s: float | None = None) -> None:
        """Append a frame.

        Codecs require even sizes: an odd last row or column is repeated.

        Parameters
        ----------
        image : (height, width) or (height, width, 3), uint8
            Grey, or blue-green-red; all of one size.
        time_s
            Time from which it is shown, relative to the first one's; None for the next at `fps`.

        Raises
        ------
        InvalidInputError
            Not such an image, or not of the first one's size.
        RecordingError
            The encoder refuses to open the file at this size, or the disk is full.
        """
        image = self._checked(image)
        if time_s is None:
            time_s = self._given / (self._fps or DEFAULT_FPS)
        self._given += 1
        if self._film is not None:
            self._film.write(image, time_s)
        elif self._fps is not None:
            self._write_at(image, time_s)
        elif self._held is None:
            self._held = image, time_s
        else:
            first, first_s = self._held
            step_s = time_s - first_s
            self._fps = float(np.clip(1.0 / step_s, *_FPS)) if step_s > 0.0 else DEFAULT_FPS
            self._write_at(first, first_s)
            self._write_at(image, time_s)

    def _checked(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return an image with three channels and even sides; refuse invalid ones."""
        import cv2

        if image.dtype != np.uint8 or image.ndim not in (2, 3) or image.shape[2:] not in ((), (3,)):
            raise InvalidInputError(
                f"image of shape {image.shape} and type {image.dtype}: "
                "(height, width) or (height, width, 3) of uint8 is needed"
            )
        size = image.shape[1], image.shape[0]
        if not self._given:
            self._size = size
        if size != self._size:
            raise InvalidInputError(
                f"image of {size[0]} x {size[1]} pixels: "
                f"the video's first one has {self._size[0]} x {self._size[1]}"
            )
        if image.ndim == 2:
            image = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
        if size[0] % 2 or size[1] % 2:
            image = np.pad(image, ((0, size[1] % 2), (0, size[0] % 2), (0, 0)), mode="edge")
        return image

    def _write_at(self, image: NDArray[np.uint8], time_s: float) -> None:
        """Write a frame at the position of its time, repeating the previous one up to there.

        A frame whose position is taken is left out.
        """
        if self._writer is None:
            self._start_s, self._writer = time_s, self._open(self._size)
        place = round((time_s - self._start_s) * (self._fps or DEFAULT_FPS))
        missing = min(place - self._count, _LONGEST_GAP)
        for shown in (self._shown,) * missing + (image,) * (missing >= 0):
            with uninterrupted():  # a written frame must be counted
                self._writer.write(shown)
                self._count += 1
        self._shown = image
        if shutil.disk_usage(self.part.parent).free < _LEAST_FREE_BYTES:
            self._is_full = True
            raise RecordingError(f"{self.part}: cannot be written any more: the disk is full")

    def _open(self, size: tuple[int, int]) -> cv2.VideoWriter:
        import cv2

        even = size[0] + size[0] % 2, size[1] + size[1] % 2
        codec = _CODECS[self.path.suffix.lower()]
        part = opencv_path(self.part, "video")
        fps = self._fps or DEFAULT_FPS
        writer = cv2.VideoWriter(part, cv2.VideoWriter.fourcc(*codec), fps, even)
        if not writer.isOpened():
            raise RecordingError(
                f"{self.path}: the encoder {codec} does not open for {size[0]} x {size[1]} pixels "
                f"at {fps:g} frames a second"
            )
        return writer

    def close(self) -> None:
        """Complete and rename the video; without a frame there is no file.

        After `write` has found the disk full, the part keeps its name.

        Raises
        ------
        RecordingError
            Frames are missing in the file: most often, the disk is full.
        """
        if self._is_closed:
            return
        self._is_closed = True
        if self._film is not None:
            self._film.close()
        elif self._held is not None and self._writer is None:
            self._write_at(*self._held)
        if not self._given or (self._film is None and self._writer is None):
            self.part.unlink(missing_ok=True)
            return
        if self._writer is not None:
            self._close_writer(self._writer)
        if not self._is_full:
            self.part.replace(self.path)

    def _close_writer(self, writer: cv2.VideoWriter) -> None:
        import cv2

        writer.release()
        self._writer = None
        written = cv2.VideoCapture(opencv_path(self.part, "video"))
        count = written.get(cv2.CAP_PROP_FRAME_COUNT)
        written.release()
        if count != self._count:
            raise RecordingError(
                f"{self.part}: not all of {self._count} frames could be written; is the disk full?"
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
