"""Cameras and network streams: the newest frame, stamped at the moment it was grabbed.

One thread per source grabs every frame on arrival and keeps only the newest. Otherwise frames
would wait in the driver's or the decoder's queue, and a consumer slower than the camera would
receive images whose age grows without bound. The thread owns the device from opening to release, so
a device that blocks can be abandoned but is never closed while it is read.

If a frame is overdue by its source's own rate, a consumer that reads several sources receives a
`Loss` in its place instead of waiting. A source that sends nothing for its time limit is lost, and
a warning is logged. Its thread reopens it, after pauses that double, until it is back.
"""

from __future__ import annotations

import atexit
import logging
import math
import os
import select
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from fingerpost.capture.as_sent import as_sent, picture_of
from fingerpost.capture.raw import STDIN, RawStream, StreamEndedError, raw_format
from fingerpost.capture.settings import CameraSettings, Control
from fingerpost.capture.source import OTHER_SIZE, Frame, Loss, Source, SourceKind
from fingerpost.capture.url import is_url, masked
from fingerpost.checks import opencv_path
from fingerpost.errors import CaptureError
from fingerpost.signals import leave_behind

_log = logging.getLogger(__name__)

_RETRY_S = 0.01
_JOIN_S = 2.0
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 2.0
"""Pauses between attempts to reopen a lost source: the first and the longest [s]."""
_ENDED_S = 0.5
"""A device that fails within this time has ended, as an unplugged one does; otherwise it timed out
[s]."""
_OVERDUE_S, _OVERDUE_PERIODS = 0.1, 2.0
"""A frame is overdue after the longer of both [s, periods]: finger lines are not interpolated over
more (`PointingOptions.max_gap_s`), and a camera of a lower rate is not late."""
_FIRST_OVERDUE_S = 1.0
"""The same while the rate is unknown: a view that dies at once does not hold the others up."""
FRESH_S = 0.01
"""Age up to which a waiting frame counts as fresh [s]."""
_KNOWN_PERIODS, _LATEST_PERIODS = 3, 9
"""Number of intervals between frames that define the usual one, and number that are kept."""


class Device(Protocol):
    """The part of `cv2.VideoCapture` that a reader needs."""

    def isOpened(self) -> bool:  # noqa: N802 - OpenCV's name
        """Return whether the device can be read."""

    def grab(self) -> bool:
        """Wait for the next frame and take it."""

    def retrieve(self) -> tuple[bool, Any]:
        """Decode the grabbed frame."""

    def release(self) -> None:
        """Release the device."""


@runtime_checkable
class Stamping(Protocol):
    """A device that reports the capture times of its pictures."""

    def captured_ns(self) -> int:
        """Return the capture time of the grabbed frame on the reader's clock [ns]."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks for the user on how the times are known."""


def connected(source: str | int, timeout_s: float, camera: CameraSettings | None = None) -> Device:
    """Open a camera, pipe or stream; `isOpened` reports whether that succeeded."""
    if source == STDIN:
        return RawStream(0, raw_format(camera), timeout_s=timeout_s, ends=True)
    import cv2

    if isinstance(source, int) or "://" not in source:
        device = source if isinstance(source, int) else opencv_path(Path(source), "device")
        if not isinstance(source, int) and Path(source).is_fifo():
            if (known := raw_format(camera)) is None:
                return _Pipe(source, timeout_s)
            descriptor = os.open(source, os.O_RDONLY | os.O_NONBLOCK)
            return RawStream(descriptor, known, timeout_s=timeout_s, ends=False)
        capture = cv2.VideoCapture(device)
        # Two cameras that send raw pixels exceed one USB bus; most can send JPEG instead.
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
        return as_sent(capture)
    return as_sent(cv2.VideoCapture(source, cv2.CAP_FFMPEG, _limits(timeout_s)))


def _limits(timeout_s: float) -> list[int]:
    import cv2

    timeout_ms = max(1, round(1000 * timeout_s))
    return [
        cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
        timeout_ms,
        cv2.CAP_PROP_READ_TIMEOUT_MSEC,
        timeout_ms,
    ]


class _Pipe:
    """A named pipe as a device.

    Opening a pipe blocks until there is a writer, and OpenCV opens nothing else meanwhile. It is
    therefore opened here without blocking, and FFmpeg receives the open pipe, which keeps its time
    limits.
    """

    def __init__(self, path: str, timeout_s: float) -> None:
        import cv2

        self._descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        if not self._is_written_to(timeout_s):
            os.close(self._descriptor)
            raise CaptureError(f"nothing was written to it within {timeout_s:g} s")
        name = f"pipe:{self._descriptor}"
        self._capture = cv2.VideoCapture(name, cv2.CAP_FFMPEG, _limits(timeout_s))

    def _is_written_to(self, longest_s: float) -> bool:
        end_s = time.monotonic() + longest_s
        while time.monotonic() < end_s:
            if select.select([self._descriptor], [], [], _RETRY_S)[0] and self._has_writer():
                return True
            time.sleep(_RETRY_S)
        return False

    def _has_writer(self) -> bool:
        """Distinguish data from the end of a pipe without a writer, which is readable as well."""
        import fcntl
        import termios

        waiting = bytearray(4)
        fcntl.ioctl(self._descriptor, termios.FIONREAD, waiting)
        return any(waiting)

    def isOpened(self) -> bool:  # noqa: N802 - OpenCV's name
        return self._capture.isOpened()

    def grab(self) -> bool:
        return self._capture.grab()

    def retrieve(self) -> tuple[bool, Any]:
        return self._capture.retrieve()

    def release(self) -> None:
        self._capture.release()
        os.close(self._descriptor)


class LiveSource(Source):
    """The newest frame of a camera or a network stream.

    Parameters
    ----------
    source
        A camera number, a camera device, a named pipe, or a URL; or an argument of `connect`.
    timeout_s
        Time limit for opening, and for a new frame, after which the source counts as lost [s].
    clock
        Returns the time [ns]; called right after each grab, unless the device is `Stamping`.
    camera
        Requested camera settings, or the format of the raw frames on a pipe.
    connect
        Opens the device; called in the reader's thread. By default chosen by `source`.

    Raises
    ------
    CaptureError
        The source cannot be opened, or sends no frame, within `timeout_s` each.
    """

    kind = SourceKind.LIVE

    def __init__(
        self,
        source: str | int,
        *,
        timeout_s: float,
        clock: Callable[[], int],
        camera: CameraSettings | None = None,
        connect: Callable[[str | int, float], Device] | None = None,
    ) -> None:
        super().__init__("standard input" if source == STDIN else masked(source))
        self._camera = camera
        self._differences: tuple[str, ...] = ()
        self._stamping: Stamping | None = None
        self._timeout_s = timeout_s
        self._clock = clock
        self._connect = connect or partial(connected, camera=camera)
        self._changed = threading.Condition()
        self._closed = False
        self._opened: bool | None = None
        self._newest: Frame | None = None
        self._frames_grabbed = 0
        self._failure: BaseException | None = None
        self._silent_since = time.monotonic()
        self._periods_s: deque[float] = deque(maxlen=_LATEST_PERIODS)
        self._fetched_s = -math.inf  # arrival of the last frame fetched
        self._stalls = 0
        self._is_slow = False
        self._is_lost = False
        self._has_other_size = False
        self._reader = threading.Thread(
            target=self._run, args=(source,), name=f"capture {self.name}", daemon=True
        )
        self._reader.start()
        try:
            self._await_opening()
            if not self._await(lambda: self._newest is not None, self._timeout_s):
                raise self._error(f"no new frame within {self._timeout_s:g} s")
        except BaseException:
            self.close()
            raise

    @property
    def frames_grabbed(self) -> int:
        """Number of frames received from the source, fetched or not."""
        return self._frames_grabbed

    @property
    def silent_s(self) -> float:
        """Time since the source sent anything [s]."""
        return time.monotonic() - self._silent_since

    @property
    def notes(self) -> tuple[str, ...]:
        """Further final remarks on the source, for people."""
        times = "once" if self._stalls == 1 else f"{self._stalls} times"
        stalls = f"sent nothing for {self._timeout_s:g} s and more, {times}"
        return (
            *self._differences,
            *(self._stamping.notes if self._stamping else ()),
            *([self._slowness()] if self._is_slow else ()),
            *([stalls] if self._stalls else ()),
        )

    def _slowness(self) -> str:
        rate = f"sends {1.0 / self.period_s:.2g} pictures a second"
        return f"{rate}; more than {1.0 / _OVERDUE_S:.0f} are needed to bring views to one time"

    @property
    def due_in_s(self) -> float:
        """Time until the next frame is overdue [s]."""
        period_s = self.period_s
        if math.isinf(period_s):
            return _FIRST_OVERDUE_S - self.silent_s
        return max(_OVERDUE_S, _OVERDUE_PERIODS * period_s) - self.silent_s

    @property
    def period_s(self) -> float:
        """Usual time between frames [s]; infinite while unknown."""
        with self._changed:
            periods_s = [*self._periods_s]
        return statistics.median(periods_s) if len(periods_s) >= _KNOWN_PERIODS else math.inf

    @property
    def has_next(self) -> bool:
        """Whether a frame is available or the source is closed, so that `next` does not wait."""
        with self._changed:
            return self._newest is not None or self._closed

    @property
    def is_stale(self) -> bool:
        """Whether the waiting frame is old, and its successor will come soon enough.

        That is, within the interval over which finger lines are interpolated from the last frame
        fetched.
        """
        with self._changed:
            if self._newest is None:
                return False
            arrived_s = self._silent_since
        period_s = self.period_s
        is_near = arrived_s + period_s - self._fetched_s <= _OVERDUE_S
        return FRESH_S < time.monotonic() - arrived_s < period_s and is_near

    def pass_over(self) -> None:
        """Discard the waiting frame in favour of the next one."""
        with self._changed:
            self._newest = None

    def wait(self, at_most_s: float = math.inf) -> None:
        """Return when a new frame is available, or the source is closed or lost.

        Parameters
        ----------
        at_most_s
            Longest wait [s].
        """
        end_s = time.monotonic() + at_most_s
        while not self._is_lost:
            left_s = min(self._timeout_s - self.silent_s, end_s - time.monotonic())
            if self._await(lambda: self._newest is not None, left_s):
                return
            if self.silent_s >= self._timeout_s:
                self._is_lost = True
                self._stalls += 1
                _log.warning(
                    "%s: no new frame within %g s: lost until it sends again",
                    self.name,
                    self._timeout_s,
                )
            elif time.monotonic() >= end_s:
                return

    def overdue(self) -> Loss | None:
        """Return the loss in place of a frame that is overdue or lost."""
        if self.has_next or not (self._is_lost or self.due_in_s <= 0.0):
            return None
        loss = self._loss()
        return replace(loss, time_s=loss.time_s + self.offset_s)

    def linger(self, longest_s: float) -> None:
        """Wait for a frame of a lost source."""
        self._await(lambda: self._newest is not None, longest_s)

    def _next_frame(self) -> Frame | Loss:
        self.wait()
        with self._changed:
            frame, self._newest = self._newest, None
            self._fetched_s = self._silent_since
        if frame is not None:
            self._say_of(frame)
            return frame
        if self._closed:
            raise StopIteration
        return self._loss()

    def _say_of(self, frame: Frame) -> None:
        """Warn, once, if a frame shows that its source is back, or too slow."""
        if self._is_lost:
            self._is_lost = False
            _log.warning("%s: sends again", self.name)
        if not self._is_slow and frame.index > _LATEST_PERIODS and self.period_s > _OVERDUE_S:
            self._is_slow = True
            _log.warning("%s: %s", self.name, self._slowness())

    def _of_one_size(self, frame: Frame) -> Frame | Loss:
        seen = super()._of_one_size(frame)
        if self._has_other_size and isinstance(seen, Frame):
            self._has_other_size = False
            _log.warning("%s: its first size again", self.name)
        return seen

    def _other_size(self, frame: Frame, first: tuple[int, int]) -> Loss:
        """Count a loss: the camera may be reset, or the right one be plugged in again."""
        if not self._has_other_size:
            self._has_other_size = True
            height, width = frame.image.shape[:2]
            _log.warning(
                "%s: %d × %d px, where the first picture has %d × %d: lost until that size is back",
                self.name,
                width,
                height,
                first[1],
                first[0],
            )
        return Loss(frame.index, frame.time_s, OTHER_SIZE)

    def _loss(self) -> Loss:
        why = f"no picture has come for {self.silent_s:.1f} s"
        return Loss(self._frames_grabbed, self._clock() / 1e9, why)

    def _count(self) -> None:
        """Do nothing: a source that sends nothing loses no pictures."""

    def close(self) -> None:
        """Stop the reader; one that blocks in its device is abandoned after 2 s."""
        with self._changed:
            self._closed = True
            self._newest = None
            self._changed.notify_all()
        self._reader.join(_JOIN_S)
        if self._reader.is_alive():
            _log.warning("%s: the device does not answer; its reader is left behind", self.name)
            leave_behind(self._reader)
            # A decoder that returns while the interpreter shuts down crashes the process. That of a
            # stream returns by its own time limits, that of a device may never return.
            if is_url(self.name):
                opening_and_reading_s = 2.0 * self._timeout_s
                atexit.register(self._reader.join, opening_and_reading_s)

    def _await_opening(self) -> None:
        if not self._await(lambda: self._opened is not None, self._timeout_s):
            raise self._error(f"did not open within {self._timeout_s:g} s")
        if not self._opened:
            raise self._error(
                "cannot be opened; is it plugged in, switched on, allowed and not in use elsewhere?"
            )

    def _await(self, arrived: Callable[[], bool], longest_s: float) -> bool:
        """Wait until `arrived` or closed; False if the time is up or the reader has failed."""
        with self._changed:
            self._changed.wait_for(
                lambda: arrived() or self._closed or self._failure is not None, max(longest_s, 0.0)
            )
            return arrived() or self._closed

    def _error(self, what: str) -> CaptureError:
        if self._failure is not None:
            what = " ".join(str(self._failure).split()) or repr(self._failure)
        error = CaptureError(f"{self.name}: {what}")
        error.__cause__ = self._failure
        return error

    def _run(self, source: str | int) -> None:
        """Open and read repeatedly until stopped: the reader's thread."""
        pause_s = 0.0
        while not self._pause(pause_s):
            grabbed = self._frames_grabbed
            try:
                self._open_and_read(source)
            except StreamEndedError:
                self._end()
            except Exception as error:
                # A driver may raise anything; at the start the error is for the waiting consumer.
                if not self._frames_grabbed:
                    self._fail(error)
            if not self._frames_grabbed:
                return
            has_sent = self._frames_grabbed > grabbed
            pause_s = _FIRST_PAUSE_S if has_sent else min(2 * pause_s, _LONGEST_PAUSE_S)

    def _pause(self, longest_s: float) -> bool:
        """Wait; return whether the source has been closed."""
        with self._changed:
            return self._changed.wait_for(lambda: self._closed, longest_s)

    def _fail(self, error: Exception) -> None:
        with self._changed:
            self._failure = error
            self._changed.notify_all()

    def _end(self) -> None:
        """End the stream after the newest frame."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _ask(self, device: Device) -> None:
        """Apply the settings to a camera, and report once how the result differs from them."""
        if self._camera is None or not isinstance(device, Control):
            return
        differences = tuple(self._camera.apply(device))
        for difference in set(differences) - set(self._differences):
            _log.warning("%s: %s", self.name, difference)
        self._differences = differences

    def _open_and_read(self, source: str | int) -> None:
        device = self._connect(source, self._timeout_s)
        try:
            opened = device.isOpened()
            if opened:
                self._ask(device)
            self._stamping = device if isinstance(device, Stamping) else None
            with self._changed:
                self._opened = opened
                self._changed.notify_all()
            if opened:
                self._read(device)
        finally:
            device.release()

    def _read(self, device: Device) -> None:
        """Grab frames until closed, or until the source is lost by its time limit."""
        started_s = time.monotonic()
        while not self._closed:
            asked_s = time.monotonic()
            grabbed = device.grab()
            time_ns = self._clock()
            if grabbed and self._stamping is not None:
                time_ns = self._stamping.captured_ns()
            ok, sent = device.retrieve() if grabbed else (False, None)
            image, encoded = picture_of(sent) if ok and sent is not None else (None, b"")
            if image is None:
                now_s = time.monotonic()
                has_waited = now_s - asked_s > _RETRY_S
                longest_s = self._timeout_s if has_waited else min(self._timeout_s, _ENDED_S)
                if self._frames_grabbed and min(self.silent_s, now_s - started_s) > longest_s:
                    return
                time.sleep(_RETRY_S)
                continue
            frame = Frame(self._frames_grabbed, time_ns / 1e9, image, encoded)
            with self._changed:
                if not self._closed:
                    self._newest = frame
                self._note_arrival()
                self._changed.notify_all()

    def _note_arrival(self) -> None:
        """Count a frame, and store the interval since the previous one."""
        now_s = time.monotonic()
        if self._frames_grabbed:
            self._periods_s.append(now_s - self._silent_since)
        self._frames_grabbed += 1
        self._silent_since = now_s
