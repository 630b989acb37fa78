"""Cameras and network streams: the newest frame, stamped at the moment it was grabbed.

One thread per source grabs every frame as it comes and keeps the newest alone. Without it the
frames would wait in the driver's or the decoder's queue, and a consumer slower than the camera
would see an image whose age grows without bound. The thread owns the device from opening to
release, so a device that blocks can be left behind but is never torn down under its reader.
"""

from __future__ import annotations

import logging
import re
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from fingerpost.capture.source import Frame, Source, SourceKind
from fingerpost.checks import opencv_path
from fingerpost.errors import CaptureError

_log = logging.getLogger(__name__)

_RETRY_S = 0.01
_JOIN_S = 2.0
_PASSWORD = re.compile(r"(?<=://)[^/@]*@")


def masked(source: str | int) -> str:
    """Return the name of a live source for messages, without its user and password."""
    return f"camera {source}" if isinstance(source, int) else _PASSWORD.sub("***@", source)


class Device(Protocol):
    """The part of `cv2.VideoCapture` that a reader needs."""

    def isOpened(self) -> bool:  # noqa: N802 - OpenCV's name
        """Tell whether the device can be read."""

    def grab(self) -> bool:
        """Wait for the next frame and take it."""

    def retrieve(self) -> tuple[bool, Any]:
        """Decode the grabbed frame."""

    def release(self) -> None:
        """Give the device back."""


def connect(source: str | int, timeout_s: float) -> Device:
    """Open a camera or stream with OpenCV; whether that worked is for `isOpened` to say."""
    import cv2

    if isinstance(source, int) or "://" not in source:
        device = source if isinstance(source, int) else opencv_path(Path(source), "device")
        camera = cv2.VideoCapture(device)
        # Two cameras that send raw pixels exceed one USB bus; most can send JPEG instead.
        camera.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
        return camera
    timeout_ms = max(1, round(1000 * timeout_s))
    limits = [
        cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
        timeout_ms,
        cv2.CAP_PROP_READ_TIMEOUT_MSEC,
        timeout_ms,
    ]
    return cv2.VideoCapture(source, cv2.CAP_FFMPEG, limits)


class LiveSource(Source):
    """The newest frame of a camera or a network stream.

    Parameters
    ----------
    source
        A camera number, a camera device, or a URL.
    timeout_s
        How long opening may take, and how long the wait for a new frame, before the source
        counts as lost.
    clock
        Gives the time in nanoseconds; called right after each grab.
    connect
        Opens the device; called in the reader's thread.

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
        connect: Callable[[str | int, float], Device] = connect,
    ) -> None:
        super().__init__(masked(source))
        self._timeout_s = timeout_s
        self._clock = clock
        self._changed = threading.Condition()
        self._closed = False
        self._opened: bool | None = None
        self._newest: Frame | None = None
        self._frames_grabbed = 0
        self._failure: BaseException | None = None
        self._reader = threading.Thread(
            target=self._run, args=(connect, source), name=f"capture {self.name}", daemon=True
        )
        self._reader.start()
        try:
            self._await_opening()
            self.wait()
        except BaseException:
            self.close()
            raise

    @property
    def frames_grabbed(self) -> int:
        """How many frames the source has sent so far, fetched or not."""
        return self._frames_grabbed

    def wait(self) -> None:
        """Return when a frame is there that was not fetched yet, or the source is closed.

        Raises
        ------
        CaptureError
            None came within the source's time limit: the camera is lost.
        """
        if not self._await(lambda: self._newest is not None):
            raise self._lost(f"no new frame within {self._timeout_s:g} s")

    def _next_frame(self) -> Frame:
        self.wait()
        with self._changed:
            frame, self._newest = self._newest, None
        if frame is None:
            raise StopIteration
        return frame

    def close(self) -> None:
        """Stop the reader; one that is stuck in its device is left behind after 2 s."""
        with self._changed:
            self._closed = True
            self._newest = None
            self._changed.notify_all()
        self._reader.join(_JOIN_S)
        if self._reader.is_alive():
            _log.warning("%s: the device does not answer; its reader is left behind", self.name)

    def _await_opening(self) -> None:
        if not self._await(lambda: self._opened is not None):
            raise self._lost(f"did not open within {self._timeout_s:g} s")
        if not self._opened:
            raise self._lost(
                "cannot be opened; is it plugged in, switched on, allowed and not in use elsewhere?"
            )

    def _await(self, arrived: Callable[[], bool]) -> bool:
        """Wait until `arrived` or closed; False when the time is up or the reader has failed."""
        with self._changed:
            self._changed.wait_for(
                lambda: arrived() or self._closed or self._failure is not None, self._timeout_s
            )
            return arrived() or self._closed

    def _lost(self, what: str) -> CaptureError:
        if self._failure is not None:
            what = " ".join(str(self._failure).split()) or repr(self._failure)
        error = CaptureError(f"{self.name}: {what}")
        error.__cause__ = self._failure
        return error

    def _run(self, connect: Callable[[str | int, float], Device], source: str | int) -> None:
        """Open, read until told to stop, release: the whole life of the reader's thread."""
        try:
            device = connect(source, self._timeout_s)
            try:
                opened = device.isOpened()
                with self._changed:
                    self._opened = opened
                    self._changed.notify_all()
                if opened:
                    self._read(device)
            finally:
                device.release()
        except Exception as error:
            # A driver may raise anything; it belongs to whoever waits for the frame.
            with self._changed:
                self._failure = error
                self._changed.notify_all()

    def _read(self, device: Device) -> None:
        while not self._closed:
            grabbed = device.grab()
            time_ns = self._clock()
            ok, image = device.retrieve() if grabbed else (False, None)
            if not ok:
                time.sleep(_RETRY_S)
                continue
            image = np.ascontiguousarray(image, dtype=np.uint8)
            frame = Frame(self._frames_grabbed, time_ns / 1e9, image)
            with self._changed:
                if not self._closed:
                    self._newest = frame
                self._frames_grabbed += 1
                self._changed.notify_all()
