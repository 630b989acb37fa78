"""A video file as a recorded source.

Every picture comes in order with the presentation time stored in the file (`CAP_PROP_POS_MSEC`,
which OpenCV's FFmpeg backend fills per frame, also at a variable rate). A stretch that cannot be
decoded is stepped over and reported through `logging`; OpenCV alone would end the video there.
A video stored rotated is turned as its header says, as every player shows it.

A decoder conceals damage, and every picture predicted from a damaged one is wrong as well. After a
complaint of the decoder (`messages`), all pictures therefore count as lost until the next
intra-coded one without a complaint (`Chain`). The decoder runs in one thread, so that it complains
before it returns the picture in question.

Limits, because OpenCV does not report these:

- If wrong bytes still decode to a valid picture, no decoder complains.
- AVI stores no times: a frame's time follows from its index. If damage hides frames from the
  reader, all later ones are dated too early by as many intervals, which no frame reveals. Missing
  frames are only noticed, and reported, at the end. MP4 and Matroska date every frame.
- Frames of another size than the first, as in joined videos, are scaled to that of the first.
"""

from __future__ import annotations

import logging
import math
import shlex
from pathlib import Path

import numpy as np

from fingerpost.capture.container import is_avi, is_cut_off, states_frame_count
from fingerpost.capture.messages import Listener
from fingerpost.capture.source import DAMAGED, UNDECODABLE, Frame, Loss, Source, SourceKind
from fingerpost.checks import opencv_path
from fingerpost.errors import CaptureError

_log = logging.getLogger(__name__)

_PLAUSIBLE_FPS = (0.1, 10_000.0)
_MAX_BELIEVED_COUNT = 10**8  # 38 days at 30 frames a second
# Each failed grab skips one packet of a damaged stretch. There are at most as many of them as the
# header states frames, and a damaged header may state any number.
_MAX_FAILED_GRABS = 10_000
# Containers round times to as much as 1 ms (Matroska, WebM): twice that for a difference of two.
_TIME_ROUNDING_S = 2e-3
# Intervals by which an intact recording may be shorter than its header states: headers round, and
# sound may be a little longer. For frames that are dated by index, the number is compared.
_SHORT_INTERVALS = 2.0
_SHORT_INTERVALS_IF_COUNTED = 0.5
_INTERLACED = "interlaced"


class FrameTimes:
    """Index and time of each frame of a video, from the times in its container.

    Times that do not increase are replaced by the last time plus one frame interval, with one
    warning. In a video of constant rate a gap of several intervals means frames that could not be
    read: they are counted, so that the views of a rig stay synchronous after the damage. In a video
    of variable rate only the number of failed reads counts.

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


class Chain:
    """Determines which pictures of a video are intact: those not predicted from a damaged one.

    With pictures that are predicted from later ones (B), the output of a decoder is delayed by the
    length of their longest run plus one. A complaint may concern any picture that has entered it.
    """

    def __init__(self) -> None:
        self._is_broken = False
        self._step = 0
        self._complained = 0
        self._run = self._longest_run = 0

    def take(self, kind: str, *, complained: bool) -> bool:
        """Return whether a picture is intact.

        Parameters
        ----------
        kind
            "I" for an intra-coded picture; "P", "B" and others are predicted.
        complained
            Whether the decoder has complained since the last picture.
        """
        self._step += 1
        self._run = self._run + 1 if kind == "B" else 0
        self._longest_run = max(self._longest_run, self._run)
        if complained:
            self._is_broken, self._complained = True, self._step
        delay = self._longest_run + 1 if self._longest_run else 0
        if self._is_broken and kind == "I" and self._step - self._complained > delay:
            self._is_broken = False
        return not self._is_broken


class VideoFile(Source):
    """The frames of a video file.

    Parameters
    ----------
    path
        The file.
    fps
        Frame rate if the file states no plausible one [1/s].
    name
        Name in messages; by default the path.
    """

    kind = SourceKind.RECORDED
    has_own_clock = True

    def __init__(self, path: Path, *, fps: float, name: str = "") -> None:
        super().__init__(name or str(path))
        import cv2

        self._path = path
        self._listener = Listener()
        with self._listener:
            self._capture = cv2.VideoCapture(
                opencv_path(path, "source"), cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1]
            )
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
        stated_fps = self._capture.get(cv2.CAP_PROP_FPS)
        if _PLAUSIBLE_FPS[0] <= stated_fps <= _PLAUSIBLE_FPS[1]:
            fps = stated_fps
        count = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)
        self.frame_count = int(count) if 0 < count < _MAX_BELIEVED_COUNT else None
        self._interval_s = 1 / fps
        self._times = FrameTimes(self._interval_s, self.name)
        self._chain = Chain()
        self._end_s = 0.0
        self._end_index = 0
        self._first = self._read()
        if self._first is None or self._conversion:
            wrong = self._why_nothing()
            self.close()
            raise CaptureError(wrong)

    def _why_nothing(self) -> str:
        """Return why no picture can be read, and the remedy."""
        import cv2

        codec = _codec(int(self._capture.get(cv2.CAP_PROP_FOURCC)))
        with self._listener:
            packets = cv2.VideoCapture(
                opencv_path(self._path, "source"), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1]
            )
            has_pictures = packets.grab()
        if not codec or not has_pictures:
            return (
                f"{self.name}: no frame can be read; a video or an image that OpenCV decodes is "
                "needed"
            )
        source = shlex.quote(self.name)
        target = shlex.quote(f"{Path(self.name).stem}-h264.mp4")
        to_h264 = f"-c:v libx264 -crf 14 {target}"
        if _INTERLACED in self._conversion:
            return (
                f"{self.name}: {codec} video that is interlaced, which this OpenCV cannot read; "
                f"deinterlace it: ffmpeg -i {source} -vf yadif {to_h264}"
            )
        return (
            f"{self.name}: {codec} video, which this OpenCV cannot decode; "
            f"convert it: ffmpeg -i {source} {to_h264}"
        )

    def _next_frame(self) -> Frame | Loss:
        seen, self._first = self._first or self._read(), None
        if seen is None:
            if self._capture.isOpened():
                self._report_early_end()
            self.close()
            raise StopIteration
        return seen

    def _read(self) -> Frame | Loss | None:
        """Decode the next picture, skipping damage; None at the end."""
        import cv2

        complaint = self._conversion = ""
        promised = (self.frame_count or 0) - self._end_index
        for failed in range(min(max(promised, 0), _MAX_FAILED_GRABS) + 1):
            with self._listener:
                grabbed = self._capture.grab()
            complaint = complaint or self._listener.complaint
            if not grabbed:
                continue
            with self._listener:
                ok, image = self._capture.retrieve()
            self._conversion = self._listener.complaint
            if ok:
                container_s = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
                index, time_s = self._times.place(container_s, failed)
                self._end_index, self._end_s = index + 1, time_s + self._interval_s
                kind = chr(int(self._capture.get(cv2.CAP_PROP_FRAME_TYPE)))
                is_sound = self._chain.take(kind, complained=bool(complaint) or failed > 0)
                self._detail = self._detail or complaint or self._conversion
                if self._conversion:
                    return Loss(index, time_s, UNDECODABLE)
                if not is_sound:
                    return Loss(index, time_s, DAMAGED)
                return Frame(index, time_s, np.ascontiguousarray(image, dtype=np.uint8))
        return None

    def _report_early_end(self) -> None:
        """Warn of a truncated file, as far as its container shows it."""
        if is_cut_off(self._path):
            _log.warning(
                "%s: ends at %.3f s: the file is shorter than it says: cut off",
                self.name,
                self._end_s,
            )
            return
        if not states_frame_count(self._path):
            return
        dates_by_count = is_avi(self._path)
        short_s = (self.frame_count or 0) * self._interval_s - self._end_s
        slack = _SHORT_INTERVALS_IF_COUNTED if dates_by_count else _SHORT_INTERVALS
        # With a variable rate this is no evidence.
        if not self._times.constant_rate or short_s <= slack * self._interval_s:
            return
        _log.warning(
            "%s: ends at %.3f s although its header says %.3f s: cut off or damaged%s",
            self.name,
            self._end_s,
            self._end_s + short_s,
            f"; as AVI stores no times, frames behind damage are dated up to {short_s:.3f} s early"
            if dates_by_count
            else "",
        )

    def close(self) -> None:
        """Close the file: no more frames will come."""
        self._first = None
        self._capture.release()


# Common names of codecs, by their names in files.
_CODEC_NAMES = {
    "av01": "AV1",
    "avc1": "H.264",
    "h264": "H.264",
    "hev1": "H.265",
    "hvc1": "H.265",
    "hevc": "H.265",
    "vp09": "VP9",
    "vp90": "VP9",
    "apch": "ProRes",
    "apcn": "ProRes",
    "apcs": "ProRes",
    "apco": "ProRes",
    "ap4h": "ProRes",
    "aprn": "ProRes RAW",
    "aprh": "ProRes RAW",
}


def _codec(fourcc: int) -> str:
    """Return the name of a codec; empty if there is none."""
    if fourcc in (-1, 0):
        return ""
    name = fourcc.to_bytes(4, "little", signed=fourcc < 0).decode("latin-1").strip("\0 ")
    return _CODEC_NAMES.get(name.lower(), name if name.isprintable() else hex(fourcc))
