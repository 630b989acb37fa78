"""A video file as a recorded source.

Every frame comes in order with the presentation time stored in the file (`CAP_PROP_POS_MSEC`,
which OpenCV's FFmpeg backend fills per frame, also at a variable rate). A stretch that cannot be
decoded is stepped over and reported through `logging`; OpenCV alone would end the video there.
A video stored rotated is turned as its header says, as every player shows it.

What OpenCV does not tell, nobody behind it can know:

- Where single bytes are wrong, the decoder mends the picture by guess from what is around it or
  before it, and says nothing. Such frames are believed.
- AVI stores no times: a frame's time is its place in the count. Where damage hides frames from the
  reader, all later ones are dated too early by as many intervals, and no frame shows it. That some
  are missing is seen at the end alone, and reported there. MP4 and Matroska date every frame.
- Frames of another size than the first one's, as behind the seam of two videos, come scaled to it.
"""

from __future__ import annotations

import logging
import math
from pathlib import Path

import numpy as np

from fingerpost.capture.source import Frame, Source, SourceKind
from fingerpost.checks import opencv_path
from fingerpost.errors import CaptureError

_log = logging.getLogger(__name__)

_PLAUSIBLE_FPS = (0.1, 10_000.0)
_MAX_BELIEVED_COUNT = 10**8  # 38 days at 30 frames a second
# Each failed grab passes over one packet of a damaged stretch. There are at most as many of them
# as the header promises frames, and a damaged header may promise anything.
_MAX_FAILED_GRABS = 10_000
# Containers round times to as much as 1 ms (Matroska, WebM), which a step of two such times
# can show twice.
_TIME_ROUNDING_S = 2e-3
# How much shorter than its header says an undamaged recording may be: headers round, and sound may
# run on a little longer. Frames that are dated by their count are counted.
_SHORT_INTERVALS = 2.0
_SHORT_INTERVALS_IF_COUNTED = 0.5


class FrameTimes:
    """Index and time of each frame of a video, from what its container says.

    Times that do not increase are replaced by the last time plus one frame interval, with one
    warning. In a video of constant rate a leap of several intervals means frames that could not
    be read: they are counted, so that the views of a rig stay in step behind the damage. In a
    video of variable rate nothing but the count of failed reads can tell.

    Parameters
    ----------
    interval_s
        The nominal time between two frames.
    name
        The source's name, for messages.

    Attributes
    ----------
    constant_rate
        Whether every step so far was a whole number of intervals.
    """

    def __init__(self, interval_s: float, name: str) -> None:
        self._interval_s = interval_s
        self._name = name
        self.constant_rate = True
        self._warned = False
        self._last: tuple[int, float] | None = None

    def place(self, container_time_s: float, failed_reads: int) -> tuple[int, float]:
        """Return (index, time_s) of the frame just read after `failed_reads` failures."""
        if self._last is None:
            start_s = container_time_s if math.isfinite(container_time_s) else 0.0
            self._last = failed_reads, start_s
            return self._last
        last_index, last_s = self._last
        time_s = container_time_s
        if not time_s > last_s or math.isinf(time_s):
            time_s = last_s + self._interval_s
            if not self._warned:
                self._warned = True
                _log.warning(
                    "%s: frame %d has no time after its predecessor's; using %.4g frames a second",
                    self._name,
                    last_index + 1,
                    1 / self._interval_s,
                )
        missing = failed_reads
        step_s = time_s - last_s
        intervals = max(1, round(step_s / self._interval_s))
        on_grid = abs(step_s - intervals * self._interval_s) <= _TIME_ROUNDING_S
        if self.constant_rate and on_grid:
            missing = intervals - 1
        self.constant_rate = self.constant_rate and on_grid
        if missing:
            _log.warning(
                "%s: %d damaged or missing frames between %.3f s and %.3f s",
                self._name,
                missing,
                last_s,
                time_s,
            )
        self._last = last_index + 1 + missing, time_s
        return self._last


class VideoFile(Source):
    """The frames of a video file; `fps` serves where the file states no believable rate."""

    kind = SourceKind.RECORDED

    def __init__(self, path: Path, *, fps: float) -> None:
        super().__init__(str(path))
        import cv2

        self._capture = cv2.VideoCapture(opencv_path(path, "source"))
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
        stated_fps = self._capture.get(cv2.CAP_PROP_FPS)
        if _PLAUSIBLE_FPS[0] <= stated_fps <= _PLAUSIBLE_FPS[1]:
            fps = stated_fps
        count = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)
        self.frame_count = int(count) if 0 < count < _MAX_BELIEVED_COUNT else None
        self._interval_s = 1 / fps
        self._times = FrameTimes(self._interval_s, self.name)
        self._end_s = 0.0
        self._end_index = 0
        self._dates_by_count = _is_avi(path)
        self._first = self._read()
        if self._first is None:
            self.close()
            raise CaptureError(
                f"{path}: no frame can be read; a video or an image that OpenCV decodes is needed"
            )

    def _next_frame(self) -> Frame:
        frame, self._first = self._first or self._read(), None
        if frame is None:
            if self._capture.isOpened():
                self._report_early_end()
            self.close()
            raise StopIteration
        return frame

    def _read(self) -> Frame | None:
        """Decode the next readable frame, stepping over damage; None at the end."""
        import cv2

        promised = (self.frame_count or 0) - self._end_index
        for failed in range(min(max(promised, 0), _MAX_FAILED_GRABS) + 1):
            if not self._capture.grab():
                continue
            ok, image = self._capture.retrieve()
            if ok:
                container_s = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
                index, time_s = self._times.place(container_s, failed)
                self._end_index, self._end_s = index + 1, time_s + self._interval_s
                return Frame(index, time_s, np.ascontiguousarray(image, dtype=np.uint8))
        return None

    def _report_early_end(self) -> None:
        """Warn if the recording is shorter than its header says; a variable rate proves nothing."""
        short_s = (self.frame_count or 0) * self._interval_s - self._end_s
        slack = _SHORT_INTERVALS_IF_COUNTED if self._dates_by_count else _SHORT_INTERVALS
        if not self._times.constant_rate or short_s <= slack * self._interval_s:
            return
        _log.warning(
            "%s: ends at %.3f s although its header says %.3f s: cut off or damaged%s",
            self.name,
            self._end_s,
            self._end_s + short_s,
            f"; as AVI stores no times, frames behind damage are dated up to {short_s:.3f} s early"
            if self._dates_by_count
            else "",
        )

    def close(self) -> None:
        """Close the file: no more frames will come."""
        self._first = None
        self._capture.release()


def _is_avi(path: Path) -> bool:
    with path.open("rb") as file:
        head = file.read(12)
    return head[:4] == b"RIFF" and head[8:] == b"AVI "
